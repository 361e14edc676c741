"""Chromium for the tests of pages; where there is none, they are skipped."""

import contextlib
import os
import shutil

import pytest

from tests.support.patience import PATIENCE

ARGUMENTS = (
    *("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"),
    *("--disable-background-networking", "--disable-quic", "--no-first-run"),
    *("--disable-component-update", "--disable-sync", "--disable-dev-shm-usage"),
)


@contextlib.contextmanager
def chromium():
    """Yield a browser of playwright that is Debian's Chromium."""
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    program = shutil.which("chromium") or shutil.which("google-chrome")
    if program is None:
        pytest.skip("no chromium; apt install chromium")
    arguments = [*ARGUMENTS, *(["--no-sandbox"] if os.geteuid() == 0 else [])]
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(
            executable_path=program, args=arguments, timeout=1e3 * PATIENCE
        )
        yield browser
        browser.close()


class Watched:
    """A page, what it complained of and what it asked for."""

    def __init__(self, browser, url, size=(960, 600)):
        self.errors, self.requests = [], []
        self.page = browser.new_page(viewport={"width": size[0], "height": size[1]})
        self.page.set_default_timeout(1e3 * PATIENCE)
        self.page.on("console", self._console)
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.goto(url)
        self.page.wait_for_function("window.fflin && fflin.ready")

    def _console(self, message):
        if message.type in ("error", "warning"):
            self.errors.append(message.text)

    def do(self, expression):
        """Evaluate JavaScript."""
        return self.page.evaluate(expression)

    def resize(self, width, height):
        """Give the window another size, and wait until it has it."""
        self.page.set_viewport_size({"width": width, "height": height})
        self.page.wait_for_function(f"innerWidth === {width} && innerHeight === {height}")
        self.drawn()

    def drawn(self):
        """Wait until all that was asked for before is on the screen."""
        frame = "await new Promise(requestAnimationFrame);"
        self.do(f"(async () => {{ {3 * frame} }})()")

    def pose(self, path):
        """Return position and quaternion of a node of meshcat's scene."""
        node = f"viewer.scene_tree.find({list(path)!r}).object"
        return self.do(f"[...{node}.position.toArray(), ...{node}.quaternion.toArray()]")

    def picture(self):
        """Return what is on the screen, (height, width, 3), without the panels."""
        import io

        import numpy as np
        from PIL import Image

        self.do("document.getElementById('overlay').style.display = 'none'")
        shot = self.page.screenshot()
        self.do("document.getElementById('overlay').style.display = ''")
        return np.asarray(Image.open(io.BytesIO(shot)).convert("RGB"), dtype=int)
