"""The site of the documents is whole and needs no network."""

import contextlib
import http.server
import os
import re
import sys
import threading
from functools import partial
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

import fflin
from tests.support.browser import Watched
from tests.support.patience import finished

pytestmark = pytest.mark.docs

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The folder that FFLIN_SITE says was built already, or one that is built here.

    All workers of a run share one site: the first one builds it, and the others wait.
    """
    if built := os.environ.get("FFLIN_SITE"):
        return Path(built).resolve()
    for package in ("sphinx", "myst_nb", "numpydoc", "furo", "filelock"):
        pytest.importorskip(package, reason="the extra docs is not installed")
    from filelock import FileLock

    default = tmp_path_factory.getbasetemp()
    folder = (
        default.parent if "PYTEST_XDIST_WORKER" in os.environ else default
    ) / "site"
    with FileLock(f"{folder}.lock"):
        if not (folder / "index.html").exists():
            _build(folder)
    return folder


def _build(folder):
    """Build the site in another folder, and move it to its place when it is complete."""
    part = folder.with_suffix(".part")
    command = [sys.executable, "-m", "sphinx", "-q", "-W", "docs", part]
    # Where the kernels are not compiled yet, that takes a processor some minutes.
    done = finished(
        command, cwd=ROOT, capture_output=True, text=True, watch={"limit": 1200.0}
    )
    assert done.returncode == 0, done.stderr
    part.rename(folder)


class Page(HTMLParser):
    """What a page loads, where its links lead, and the places in it that links may name."""

    def __init__(self, path):
        super().__init__()
        self.loads, self.links, self.places = [], [], set()
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag, attrs):
        given = dict(attrs)
        self.places.update(given[key] for key in ("id", "name") if given.get(key))
        led = tag == "a" or given.get("rel") in ("next", "prev", "search", "index")
        if led and given.get("href"):
            self.links.append(given["href"])
        elif tag in (
            "script",
            "img",
            "iframe",
            "link",
            "source",
            "video",
            "object",
            "embed",
        ):
            self.loads += [
                given[key] for key in ("src", "href", "data") if given.get(key)
            ]


@pytest.fixture(scope="module")
def pages(site):
    default = [path for path in site.rglob("*.html") if "_static" not in path.parts]
    return {path: Page(path) for path in default}


@pytest.mark.process
def test_nothing_is_loaded_from_elsewhere_and_all_that_is_loaded_is_there(site, pages):
    assert len(pages) > len(fflin.__all__)
    for path, page in pages.items():
        for address in page.loads:
            parts = urlsplit(address)
            if parts.scheme != "data":
                assert not parts.scheme and not parts.netloc, (
                    f"{path.name} loads {address}"
                )
                assert (path.parent / unquote(parts.path)).exists(), (
                    f"{path.name}: {address}"
                )
    for path in site.rglob("*.css"):
        text = path.read_text(encoding="utf-8")
        assert not re.search(r"url\(\s*['\"]?(https?:)?//|@import[^;]*//", text), path


@pytest.mark.process
def test_every_picture_is_described(site, pages):
    figures = 0
    for path in pages:
        for tag in re.findall(r"<img [^>]*>", path.read_text(encoding="utf-8")):
            alt = re.search(r'alt="([^"]*)"', tag)
            assert alt and "_images/" not in alt[1], f"{path.name}: {tag}"
            figures += alt[1].startswith("Figure: ") and ".svg" in tag
    assert figures > 10


@pytest.mark.process
def test_links_lead_somewhere(site, pages):
    for path, page in pages.items():
        for address in page.links:
            parts = urlsplit(address)
            if parts.scheme or parts.netloc:
                continue
            goal = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            assert goal.is_file(), f"{path.name} links to {address}"
            if parts.fragment and goal in pages:
                assert unquote(parts.fragment) in pages[goal].places, (
                    f"{path.name}: {address}"
                )


@pytest.mark.process
def test_the_site_is_small_and_has_a_page_for_every_public_name(site):
    size = sum(path.stat().st_size for path in site.rglob("*") if path.is_file())
    assert size < 30e6
    for name in fflin.__all__:
        text = (site / "reference" / "names" / f"fflin.{name}.html").read_text(
            encoding="utf-8"
        )
        assert f'id="fflin.{name}"' in text and "Examples" in text


@pytest.mark.browser
def test_formulas_search_and_pages_that_play_work_from_disk(site, browser):
    asked = []

    @contextlib.contextmanager
    def opened(page, ready):
        page, _, query = page.partition("?")
        with Watched(
            browser, f"{(site / page).as_uri()}?{query}", ready=ready
        ) as watched:
            yield watched
        asked.extend(watched.requests)

    many = "document.querySelectorAll('mjx-container svg').length > 100"
    with opened("derivation.html", many) as watched:
        assert not watched.page.query_selector_all("[data-mml-node=merror]")
    result = "document.querySelectorAll('ul.search li').length > 5"
    with opened("search.html?q=momentum", result) as watched:
        assert "momentum_reduction" in watched.page.inner_text("ul.search")
        watched.page.wait_for_selector("ul.search p.context")
        excerpts = watched.page.query_selector_all("ul.search p.context")
        assert any("momentum" in each.inner_text() for each in excerpts)
    framed = "document.querySelector('iframe.fflin-page')"
    with opened("tutorials/first_loop.html", framed) as watched:
        element = watched.page.query_selector("iframe.fflin-page")
        element.scroll_into_view_if_needed()
        watched.wait("window.fflin && fflin.ready", element.content_frame())
    assert all(
        url.startswith(("file:", "data:", "blob:", "about:")) for url in asked
    ), asked


@pytest.mark.browser
@pytest.mark.parametrize("width", [1280, 390])
def test_the_front_page_shows_its_motion_without_panel(site, browser, width):
    ready = "document.querySelector('.fflin-hero.drawn')"
    address = (site / "index.html").as_uri()
    with Watched(browser, address, ready=ready, size=(width, 900)) as watched:
        element = watched.page.query_selector(".fflin-hero iframe")
        frame = element.content_frame()
        for part in ("panel", "bar"):
            assert not frame.is_visible(f"#{part}")
        start = frame.evaluate("fflin.state.time")
        watched.wait(f"fflin.state.time > {start}", frame)
        # The picture that stands there before is no taller and no wider.
        still = watched.page.query_selector(".fflin-hero img")
        assert still.bounding_box() == element.bounding_box()


# Words that people type, and pages of which one must be among the first three hits.
SOUGHT = {
    "spring": {"guide/equilibria_modes", "guide/robot_files"},
    "thruster": {"guide/inputs"},
    "MATLAB": {"guide/files"},
    "quaternion": {"conventions"},
    "gain margin": {"guide/lqr_kalman"},
    "thrust allocation": {"guide/inputs"},
    "noise": {"guide/lqr_kalman"},
    "attitude control": {"guide/attitude_control", "tutorials/attitude_control"},
    "momentum unloading": {"guide/attitude_control"},
    "orbit": {"guide/orbits"},
    "docking": {"guide/capture"},
    "flexible": {"guide/flexible"},
    "solar array": {"guide/flexible"},
    "slosh": {"guide/flexible"},
    "Nastran": {"guide/flexible"},
    "Craig-Bampton": {"guide/flexible"},
    "citation": {"start"},
    "cite": {"start"},
    "conda": {"start"},
    "colab": {"start"},
    "notebook": {"start", "tutorials/index"},
    "install on Windows": {"start"},
    "install on macOS": {"start"},
    "platforms": {"start"},
    "quaternion sign": {"conventions"},
    "closed loop poles": {"guide/lqr_kalman"},
}


class _Quiet(http.server.SimpleHTTPRequestHandler):
    def do_GET(self):
        if self.path == "/favicon.ico":  # which browsers ask for on their own
            self.send_response(204)
            self.end_headers()
        else:
            super().do_GET()

    def log_message(self, *given):
        pass


@pytest.fixture(scope="module")
def served(site):
    """The address of the site on a server of this machine: excerpts need one."""
    handler = partial(_Quiet, directory=site)
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()
        thread.join()


@pytest.mark.browser
def test_the_search_finds_the_page_of_a_task_first_and_shows_an_excerpt(
    served, browser
):
    missed = {}
    with Watched(
        browser, f"{served}/search.html", ready="typeof Search === 'object'"
    ) as watched:
        for word, pages in SOUGHT.items():
            watched.page.fill("input[name=q]", word)
            with watched.page.expect_navigation():
                watched.page.press("input[name=q]", "Enter")
            watched.page.wait_for_selector("p.search-summary:has-text('finished')")
            watched.page.wait_for_selector("ul.search p.context")
            hits = watched.page.query_selector_all("ul.search li")[:3]
            result = [hit.query_selector("a").get_attribute("href") for hit in hits]
            if not pages & {address.partition(".html")[0] for address in result}:
                missed[word] = result
    assert not missed
