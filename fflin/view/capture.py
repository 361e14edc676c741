"""Pictures of an HTML page, taken by an installed Chromium."""

from __future__ import annotations

import base64
import io
import json
import os
import shutil
import signal
import subprocess
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from fflin.base.errors import FileError, MissingPackageError

_NAMES = (
    "chromium",
    "chromium-browser",
    "google-chrome",
    "google-chrome-stable",
    "chrome",
    "microsoft-edge",
    "msedge",
)

# Options for a headless browser, which reads its commands from a pipe. They also enable WebGL
# without a graphics card, and disable background network access.
_ARGUMENTS = (
    "--headless=new",
    "--remote-debugging-pipe",
    "--hide-scrollbars",
    "--mute-audio",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--disable-background-networking",
    "--disable-quic",
    "--no-first-run",
    "--no-default-browser-check",
    "--disable-component-update",
    "--disable-sync",
    "--disable-dev-shm-usage",
    "--disable-extensions",
)

# Chromium reads commands from file descriptor 3 and answers on file descriptor 4. Both are pipes to
# this process. When this process ends, the pipes are closed, and Chromium exits.
_WITH_PIPES = 'exec "$0" "$@" 3<&0 4>&1 </dev/null >/dev/null'

# Time limit of a browser [s], and the time added for each picture [s]. They are long enough for a
# slow machine without a graphics card.
_PATIENCE, _PER_PICTURE = 120.0, 3.0

# Sizes [px] of a single picture of the whole page, of a picture in a strip, and of a GIF.
_PICTURE, _STRIP, _GIF = (1280, 720), (640, 480), (640, 400)
_GIF_FPS, _GIF_FRAMES = 12, 96


def find_chromium() -> str:
    """Return the path of an installed Chromium, or raise `MissingPackageError`."""
    program = next(filter(None, map(shutil.which, _NAMES)), None)
    if program is None:
        raise MissingPackageError(
            "Chromium, which takes the pictures, is not found; install it (Debian: apt install "
            "chromium), or open the HTML file in a browser and take screenshots"
        )
    return program


def take_png(page: str, times: Sequence[float]) -> bytes:
    """Return a PNG of a motion's page at one time [s], or a strip with one picture per time."""
    if len(times) == 1:
        return _screenshots(page, times, _PICTURE)[0]
    from PIL import Image

    width, height = _STRIP
    strip = Image.new("RGB", (width * len(times), height))
    frames = _screenshots(page, times, _STRIP, legends=1)
    for index, frame in enumerate(frames):
        strip.paste(Image.open(io.BytesIO(frame)), (index * width, 0))
    content = io.BytesIO()
    strip.save(content, "PNG", optimize=True)
    return content.getvalue()


def take_gif(page: str, start: float, end: float, speed: float) -> bytes:
    """Return a GIF of a motion's page over a time span [s]; long spans are shown faster."""
    from PIL import Image

    wanted = (end - start) / speed * _GIF_FPS
    count = round(max(2, min(_GIF_FRAMES, wanted)))
    times = [start + (end - start) * index / (count - 1) for index in range(count)]
    frames = _screenshots(page, times, _GIF, legends=count)
    images = [Image.open(io.BytesIO(frame)).convert("RGB") for frame in frames]
    # With one palette for all frames and without dithering, the background does not flicker.
    palette = images[0].quantize(160)
    images = [
        image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images
    ]
    content = io.BytesIO()
    images[0].save(
        content,
        "GIF",
        save_all=True,
        append_images=images[1:],
        duration=1000 // _GIF_FPS,
        loop=0,
    )
    return content.getvalue()


def _screenshots(
    page: str,
    times: Sequence[float],
    size: tuple[int, int],
    legends: int | None = None,
) -> list[bytes]:
    """Return a PNG of the page at each time [s] of the motion.

    By default, every picture shows the whole page. If `legends` is given, every picture shows only
    the scene, and the first `legends` pictures also show the legend.
    """
    program = find_chromium()
    try:
        with _browser(program, _PATIENCE + _PER_PICTURE * len(times)) as (
            browser,
            folder,
        ):
            file = Path(folder, "page.html")
            file.write_text(page, encoding="utf-8")
            metrics = {
                "width": size[0],
                "height": size[1],
                "deviceScaleFactor": 1,
                "mobile": False,
            }
            browser.tell("Emulation.setDeviceMetricsOverride", **metrics)
            browser.tell("Page.navigate", url=file.resolve().as_uri() + "#pause")
            while not browser.evaluate("Boolean(window.fflin && window.fflin.ready)"):
                time.sleep(0.05)
            shots = []
            for index, moment in enumerate(times):
                if legends is not None:
                    with_legend = json.dumps(index < legends)
                    browser.evaluate(f"fflin.plain(true, {with_legend})")
                # Wait for two animation frames: the first draws the scene, and the second starts
                # after the drawing is displayed.
                browser.evaluate(
                    f"fflin.seek({float(moment)!r}); new Promise(done => requestAnimationFrame(() "
                    "=> requestAnimationFrame(() => done(1))))"
                )
                shot = browser.tell("Page.captureScreenshot", format="png")
                shots.append(base64.b64decode(shot["data"]))
            return shots
    except (OSError, _BrowserError) as error:
        raise FileError(
            f"{program} cannot take a picture of the page: {error}"
        ) from None


@contextmanager
def _browser(program: str, patience: float) -> Iterator[tuple[_Browser, str]]:
    """Yield a browser and its folder of temporary files, which is removed at the end.

    After `patience` seconds, the browser is killed.
    """
    with tempfile.TemporaryDirectory(
        prefix="fflin-", ignore_cleanup_errors=True
    ) as folder:
        options = [*_ARGUMENTS]
        if getattr(os, "geteuid", lambda: 1)() == 0:
            options.append("--no-sandbox")
        command = [program, *options, f"--user-data-dir={folder}", "about:blank"]
        # Temporary files of the browser go into `folder`, which is removed at the end. One of these
        # files is a socket, whose path may have at most about 100 characters. So if the path of
        # `folder` is long, the browser uses the default folder for temporary files.
        environment = {**os.environ}
        if len(folder) < 56:
            environment["TMPDIR"] = folder
        process = subprocess.Popen(
            ["sh", "-c", _WITH_PIPES, *command],
            bufsize=0,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=environment,
            start_new_session=True,
        )
        timer = threading.Timer(patience, _kill, [process])
        timer.daemon = True
        with process:
            try:
                timer.start()
                browser = _Browser(process)
                yield browser, folder
                # When the command pipe is closed, the browser removes its temporary files and
                # exits. If the browser were killed at once, these files would remain.
                browser.commands.close()
                with suppress(subprocess.TimeoutExpired):
                    process.wait(5.0)
            finally:
                timer.cancel()
                _kill(process)


def _kill(process: subprocess.Popen[bytes]) -> None:
    """End the browser and all its child processes."""
    with suppress(ProcessLookupError, PermissionError):
        os.killpg(process.pid, signal.SIGKILL)


class _BrowserError(Exception):
    """Error for a command that fails in the browser or gets no answer."""


class _Browser:
    """A browser with one tab, controlled by the DevTools protocol."""

    def __init__(self, process: subprocess.Popen[bytes]) -> None:
        assert process.stdin and process.stdout
        self.commands, self._answers = process.stdin, process.stdout
        self._rest = b""
        self._number = 0
        # Session of the tab to which commands are sent. Before the tab exists, `_session` is empty,
        # and commands are sent to the browser itself.
        self._session: dict[str, str] = {}
        target = self.tell("Target.createTarget", url="about:blank")
        attached = self.tell(
            "Target.attachToTarget", targetId=target["targetId"], flatten=True
        )
        self._session = {"sessionId": attached["sessionId"]}

    def tell(self, method: str, **parameters: object) -> dict[str, Any]:
        """Send a command and return the answer."""
        self._number += 1
        command = {
            "id": self._number,
            "method": method,
            "params": parameters,
            **self._session,
        }
        with suppress(BrokenPipeError):  # reading the answer reports the error
            self.commands.write(json.dumps(command).encode() + b"\0")
        answer: dict[str, Any] = {}
        while answer.get("id") != self._number:  # skip messages that are not the answer
            pieces = [self._rest]
            while b"\0" not in pieces[-1]:
                pieces.append(self._answers.read(2**20))
                if not pieces[-1]:
                    raise _BrowserError("the browser does not respond")
            text, _, self._rest = b"".join(pieces).partition(b"\0")
            answer = json.loads(text)
        if "error" in answer:
            raise _BrowserError(answer["error"].get("message"))
        result: dict[str, Any] = answer["result"]
        return result

    def evaluate(self, expression: str) -> Any:
        """Return the value of a JavaScript expression; for a promise, wait for the result."""
        answer = self.tell(
            "Runtime.evaluate",
            expression=expression,
            awaitPromise=True,
            returnByValue=True,
        )
        if "exceptionDetails" in answer:
            raise _BrowserError(answer["exceptionDetails"].get("text"))
        return answer["result"].get("value")
