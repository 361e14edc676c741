"""Pictures of a page, taken by a Chromium that is there."""

from __future__ import annotations

import asyncio
import base64
import io
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any

from fflin.base.errors import FileError, MissingPackageError

_NAMES = (
    *("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome"),
    *("microsoft-edge", "msedge"),
)

# WebGL without a graphics card, and nothing that asks the network.
_ARGUMENTS = (
    *("--headless=new", "--remote-debugging-port=0", "--hide-scrollbars", "--mute-audio"),
    *("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"),
    *("--disable-background-networking", "--disable-quic", "--no-first-run"),
    *("--no-default-browser-check", "--disable-component-update", "--disable-sync"),
    *("--disable-dev-shm-usage", "--disable-extensions"),
)

_PATIENCE = 120.0  # seconds for a slow machine without a graphics card

_GIF_FPS = 12
_GIF_FRAMES = 96


def find_chromium() -> str:
    """Return the path of a Chromium.

    Raises
    ------
    MissingPackageError
        If there is none.
    """
    found = next(filter(None, map(shutil.which, _NAMES)), None)
    if found is None:
        raise MissingPackageError(
            "pictures are taken by Chromium, which is not found; install it (Debian: apt install "
            "chromium), or open the HTML file and take them by hand"
        )
    return found


def take_png(page: Path, times: Sequence[float], size: tuple[int, int]) -> bytes:
    """Return a PNG of a motion's page: with its panel at one time, a strip of it at several.

    Parameters
    ----------
    page : Path
        HTML file of `visualize`.
    times : sequence of float
        Of the motion [s].
    size : tuple of int
        Width and height of each picture [pixels].
    """
    frames = _film(page, times, size, plain=len(times) > 1)
    if len(frames) == 1:
        return frames[0]
    from PIL import Image

    strip = Image.new("RGB", (size[0] * len(frames), size[1]))
    for index, frame in enumerate(frames):
        strip.paste(Image.open(io.BytesIO(frame)), (index * size[0], 0))
    content = io.BytesIO()
    strip.save(content, "PNG", optimize=True)
    return content.getvalue()


def take_gif(page: Path, span: tuple[float, float], speed: float, size: tuple[int, int]) -> bytes:
    """Return a GIF of a motion's page.

    Parameters
    ----------
    page : Path
    span : tuple of float
        When the motion begins and ends [s].
    speed : float
        Seconds of it per second; a long one is shown faster.
    size : tuple of int
        Width and height [pixels].
    """
    from PIL import Image

    start, duration = span[0], span[1] - span[0]
    count = round(max(2, min(_GIF_FRAMES, duration / speed * _GIF_FPS)))
    times = [start + duration * index / (count - 1) for index in range(count)]
    frames = _film(page, times, size, plain=True)
    images = [Image.open(io.BytesIO(frame)).convert("RGB") for frame in frames]
    palette = images[0].quantize(160)
    images = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    content = io.BytesIO()
    images[0].save(
        content, "GIF", save_all=True, append_images=images[1:], duration=1000 // _GIF_FPS, loop=0
    )
    return content.getvalue()


def _film(page: Path, times: Sequence[float], size: tuple[int, int], *, plain: bool) -> list[bytes]:
    """Return a PNG of the page at each time."""
    started: list[subprocess.Popen[bytes]] = []
    # In a notebook this thread has an event loop already.
    with ThreadPoolExecutor(1) as other:
        film = other.submit(lambda: asyncio.run(_browse(page, times, size, plain, started)))
        try:
            return film.result()
        except BaseException:
            # At Ctrl-C the browser is there or about to be, and the other thread would go on.
            while not (started or film.done()):
                time.sleep(0.01)
            for process in started:
                _end(process)
            raise


async def _browse(
    page: Path,
    times: Sequence[float],
    size: tuple[int, int],
    plain: bool,
    started: list[subprocess.Popen[bytes]],
) -> list[bytes]:
    program = find_chromium()
    # Where there is such a thing, it ends with this process, however that ends.
    guard = shutil.which("setpriv")
    guarded = [guard, "--pdeathsig", "TERM"] if guard and sys.platform == "linux" else []
    with tempfile.TemporaryDirectory(prefix="fflin-", ignore_cleanup_errors=True) as folder:
        root = ["--no-sandbox"] if getattr(os, "geteuid", lambda: 1)() == 0 else []
        process = subprocess.Popen(
            [*guarded, program, *_ARGUMENTS, *root, f"--user-data-dir={folder}", "about:blank"],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            # What it leaves behind goes with the folder, unless the path of its socket, which may
            # have some hundred letters, got too long by that.
            env={**os.environ, **({"TMPDIR": folder} if len(folder) < 56 else {})},
            start_new_session=True,
        )
        started.append(process)
        patience = 0.0  # with what was broken off, which may be busy with a picture for long
        try:
            pictures = await asyncio.wait_for(
                _shoot(Path(folder, "DevToolsActivePort"), page, times, size, plain),
                _PATIENCE + 3.0 * len(times),
            )
            patience = 5.0
            return pictures
        except (asyncio.TimeoutError, OSError, _BrowserError) as error:
            raise FileError(
                f"{program} takes no picture of {page}: {str(error) or 'it does not answer'}"
            ) from None
        finally:
            with suppress(subprocess.TimeoutExpired):
                process.wait(patience)
            _end(process)


def _end(process: subprocess.Popen[bytes]) -> None:
    """End the browser and all that it started."""
    if hasattr(os, "killpg"):
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
    else:
        process.kill()
    process.wait()


class _BrowserError(Exception):
    """What the browser answers where it does not do as it is told."""


async def _shoot(
    ready: Path, page: Path, times: Sequence[float], size: tuple[int, int], plain: bool
) -> list[bytes]:
    from tornado.websocket import WebSocketClosedError, websocket_connect

    while not (ready.is_file() and len(ready.read_text().split()) == 2):
        await asyncio.sleep(0.05)
    port, path = ready.read_text().split()
    socket = await websocket_connect(f"ws://127.0.0.1:{port}{path}", max_message_size=2**28)
    try:
        return await _Tab(socket).shoot(page, times, size, plain)
    finally:
        # Told to go it clears up behind itself, which it does not when it is ended.
        with suppress(WebSocketClosedError):
            await socket.write_message(json.dumps({"id": 0, "method": "Browser.close"}))
        socket.close()
        while await asyncio.wait_for(socket.read_message(), 10.0) is not None:
            pass


class _Tab:
    """One page of a browser, told what to do by the DevTools protocol."""

    def __init__(self, socket: Any) -> None:
        self._socket = socket
        self._number = 0
        self._session: dict[str, str] = {}

    async def tell(self, method: str, **parameters: Any) -> dict[str, Any]:
        self._number += 1
        command = {"id": self._number, "method": method, "params": parameters, **self._session}
        await self._socket.write_message(json.dumps(command))
        while True:
            message = await self._socket.read_message()
            if message is None:
                raise _BrowserError("the connection is lost")
            answer = json.loads(message)
            if answer.get("id") == self._number:
                if "error" in answer:
                    raise _BrowserError(answer["error"].get("message"))
                result: dict[str, Any] = answer["result"]
                return result

    async def evaluate(self, expression: str) -> Any:
        answer = await self.tell(
            "Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True
        )
        if "exceptionDetails" in answer:
            raise _BrowserError(answer["exceptionDetails"].get("text"))
        return answer["result"].get("value")

    async def shoot(
        self, page: Path, times: Sequence[float], size: tuple[int, int], plain: bool
    ) -> list[bytes]:
        target = await self.tell("Target.createTarget", url="about:blank")
        attached = await self.tell(
            "Target.attachToTarget", targetId=target["targetId"], flatten=True
        )
        self._session = {"sessionId": attached["sessionId"]}
        metrics = {"width": size[0], "height": size[1], "deviceScaleFactor": 1, "mobile": False}
        await self.tell("Emulation.setDeviceMetricsOverride", **metrics)
        await self.tell("Page.navigate", url=page.resolve().as_uri() + "#pause")
        while not await self.evaluate("Boolean(window.fflin && window.fflin.ready)"):
            await asyncio.sleep(0.05)
        if plain:
            await self.evaluate("fflin.plain(true)")
        pictures = []
        for moment in times:
            # Two frames: one that draws, one after which it is on the screen.
            await self.evaluate(
                f"fflin.seek({float(moment)!r}); new Promise(done => requestAnimationFrame(() => "
                "requestAnimationFrame(() => done(1))))"
            )
            picture = await self.tell("Page.captureScreenshot", format="png")
            pictures.append(base64.b64decode(picture["data"]))
        return pictures
