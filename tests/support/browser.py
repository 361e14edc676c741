"""Chromium for the tests of pages; where there is none, they are skipped."""

import contextlib
import os
import shutil

import pytest

from tests.support.patience import STALL

ARGUMENTS = (
    *(
        "--use-angle=swiftshader",
        "--enable-unsafe-swiftshader",
        "--ignore-gpu-blocklist",
    ),
    *("--disable-background-networking", "--disable-quic", "--no-first-run"),
    *("--disable-component-update", "--disable-sync", "--disable-dev-shm-usage"),
)

# that a page may take for what is waited for: half a minute, if nothing else runs
FRAMES = 1800

# Without a graphics card pixels cost much more than all else: WebGL draws only while it should.
PAINT = """
window.painting = PAINTED;
for (const name of ["drawArrays", "drawElements", "drawArraysInstanced", "drawElementsInstanced"]) {
    const draw = WebGL2RenderingContext.prototype[name];
    WebGL2RenderingContext.prototype[name] = function (...given) {
        if (window.painting) draw.apply(this, given);
    };
}"""


@contextlib.contextmanager
def chromium():
    """Yield a browser of playwright that is Debian's Chromium.

    Until it is closed this thread counts as one whose event loop runs: `asyncio.run` needs another.
    """
    playwright = pytest.importorskip(
        "playwright.sync_api", reason="playwright is not installed"
    )
    program = shutil.which("chromium") or shutil.which("google-chrome")
    if program is None:
        pytest.skip("no chromium; apt install chromium")
    arguments = [*ARGUMENTS, *(["--no-sandbox"] if os.geteuid() == 0 else [])]
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(
            executable_path=program, args=arguments, timeout=3e3 * STALL
        )
        yield browser
        browser.close()


class Watched:
    """A page, what it complained of and what it asked for.

    As a context it is closed at the end, and must not have complained. What WebGL draws is seen
    once on a page that is `painted`, and whenever a picture of it is taken.
    """

    def __init__(
        self,
        browser,
        url,
        size=(800, 600),
        ready="window.fflin && fflin.ready",
        painted=False,
    ):
        self.said, self.errors, self.requests = [], [], []
        self.page = browser.new_page(viewport={"width": size[0], "height": size[1]})
        self.page.set_default_timeout(1e3 * STALL)
        self.page.on("console", self._console)
        self.page.on("pageerror", lambda error: self._complain(str(error)))
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.add_init_script(PAINT.replace("PAINTED", str(painted).lower()))
        self.page.goto(url, wait_until="commit", timeout=0)
        self.wait(ready)
        self.drawn()
        self.do("painting = false")

    def __enter__(self):
        return self

    def __exit__(self, kind, error, trace):
        self.page.close()
        assert error or not self.errors, self.errors

    def _console(self, message):
        self.said.append(message.text)
        # the tests read them
        advice = message.text.startswith("Canvas2D: Multiple readback")
        if message.type in ("error", "warning") and not advice:
            self.errors.append(message.text)

    def _complain(self, text):
        self.said.append(text)
        self.errors.append(text)

    def wait(self, expression, frame=None):
        """Wait until an expression of JavaScript holds, on the page or in a frame of it.

        Patience is measured in frames that the browser draws, of which a busy machine draws fewer.
        """
        held = (frame or self.page).evaluate(
            f"""new Promise((done) => {{
                let left = {FRAMES};
                const look = () => {{
                    if ({expression}) done(true);
                    else if (left-- > 0) requestAnimationFrame(look);
                    else done(false);
                }};
                look();
            }})"""
        )
        assert held, (
            f"{FRAMES} frames did not bring {expression}; the page said {self.said}"
        )

    def do(self, expression):
        """Evaluate JavaScript."""
        return self.page.evaluate(expression)

    def resize(self, width, height):
        """Give the window another size, and wait until it has it."""
        self.page.set_viewport_size({"width": width, "height": height})
        self.wait(f"innerWidth === {width} && innerHeight === {height}")
        self.drawn()

    def drawn(self):
        """Wait until all that was asked for before is on the screen."""
        frame = "await new Promise(requestAnimationFrame);"
        self.do(f"(async () => {{ {3 * frame} }})()")

    def pose(self, path):
        """Return position and quaternion of a node of meshcat's scene."""
        node = f"viewer.scene_tree.find({list(path)!r}).object"
        return self.do(
            f"[...{node}.position.toArray(), ...{node}.quaternion.toArray()]"
        )

    def picture(self):
        """Return what is on the screen, (height, width, 3), without the panels."""
        import io

        import numpy as np
        from PIL import Image

        overlay = "document.getElementById('overlay').style.display"
        self.do(f"{overlay} = 'none', painting = true, viewer.set_dirty()")
        self.drawn()
        shot = self.page.screenshot(timeout=0)
        self.do(f"{overlay} = '', painting = false")
        return np.asarray(Image.open(io.BytesIO(shot)).convert("RGB"), dtype=int)
