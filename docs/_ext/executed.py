"""Executed pages: pictures, warnings, and the HTML pages that cells show.

Sphinx runs a page only if its source changed since the last build. A cell that shows an HTML page
of fflin contains this page in its output. In the site, each such HTML page is a file of its own,
which the browser loads when the reader scrolls to it. All of them share one file with the viewer.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tempfile
from html import unescape
from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment

# A frame that contains its page; see `fflin.base.html.frame`.
_FRAME = re.compile(
    r'<iframe class="fflin-page" title="([^"]*)"[^>]*? height="(\d+)"'
    r'[^>]*? srcdoc="([^"]*)"></iframe>'
)

# Warnings appear as on the command line, without the place in a notebook that nobody sees.
_STARTUP = """\
import warnings

warnings.showwarning = lambda message, category, *_: print(f"{category.__name__}: {message}")


def drawing(figure):
    # An SVG is sharp on every screen.
    import io

    content = io.StringIO()
    figure.savefig(content, format="svg")
    return content.getvalue()


formatter = get_ipython().display_formatter.formatters["image/svg+xml"]
formatter.for_type_by_name("fflin.base.shown_figure", "ShownFigure", drawing)
"""


def keep_pictures(app: Sphinx) -> None:
    """Keep the figures of the pages beside their doctrees."""
    folder = str(Path(app.doctreedir) / "executed")
    app.env.mystnb_config = app.env.mystnb_config.copy(output_folder=folder)


def prepare_kernels(app: Sphinx) -> None:
    """Write the code that each kernel runs first."""
    folder = Path(app.doctreedir) / "ipython"
    startup = folder / "profile_default" / "startup"
    startup.mkdir(parents=True, exist_ok=True)
    (startup / "warnings.py").write_text(_STARTUP, "utf-8")
    os.environ["IPYTHONDIR"] = str(folder)


def spread(app: Sphinx, env: BuildEnvironment, pages: list[str]) -> None:
    """Spread the tutorials, which take longest, over the batches that are read side by side."""
    run = [page for page in pages if page.startswith("tutorials/")]
    run.sort(key=lambda page: page != "tutorials/tracking")  # the longest begins first
    others = [page for page in pages if page not in run]
    pages.clear()
    for k, page in enumerate(run):
        share = slice(k * len(others) // len(run), (k + 1) * len(others) // len(run))
        pages += [page, *others[share]]
    pages += [] if run else others


def move_frames(app: Sphinx, doctree: nodes.document, page: str) -> None:
    """Write the HTML pages in the outputs of a page to files, and show these files."""
    if app.builder.format != "html":
        return
    folder = Path(app.outdir) / "pages" / page
    for old in folder.glob("*.html"):
        old.unlink()
    up = "../" * page.count("/")

    def moved(frame: re.Match[str]) -> str:
        title, height, content = map(unescape, frame.groups())
        name = re.sub(r"\W+", "_", title.removesuffix(".html"))
        while (folder / f"{name}.html").exists():
            name += "_"
        folder.mkdir(parents=True, exist_ok=True)
        (folder / f"{name}.html").write_text(content, "utf-8")
        address = f"{up}pages/{page}/{name}.html"
        return (
            f'<iframe class="fflin-page" src="{address}" height="{height}" loading="lazy" '
            f'title="{name}"></iframe>'
            f'<p class="fflin-page-link"><a href="{address}">{name}.html by itself</a></p>'
        )

    for output in doctree.findall(nodes.raw):
        text = output.astext()
        if "srcdoc=" in text:
            output.children = [nodes.Text(_FRAME.sub(moved, text))]
            output.rawsource = ""


def name_figures(
    app: Sphinx, page: str, template: str, context: dict[str, Any], doctree: object
) -> None:
    """Describe each figure that a page drew by the heading above it, not by the name of a file."""
    heading = ""

    def describe(match: re.Match[str]) -> str:
        nonlocal heading
        if match["title"] is None:
            return f'<img alt="Figure: {heading}"'
        heading = re.sub(r"<[^>]*>", "", match["title"]).replace('"', "&quot;")
        return match[0]

    pattern = r'<h[1-3]>(?P<title>.*?)<a class="headerlink"|<img alt="[^"]*_images/[^"]*"'
    if "body" in context:
        context["body"] = re.sub(pattern, describe, context["body"])


def remove_strays(app: Sphinx, error: Exception | None) -> None:
    """Remove the files of pages that no longer exist."""
    folder = Path(app.outdir) / "pages"
    for file in folder.rglob("*.html"):
        if file.parent.relative_to(folder).as_posix() not in app.env.all_docs:
            file.unlink()


# At the address #hero, a page shows the scene alone, and plays it again and again. Where readers
# prefer reduced motion, the scene stays at a time at which the robot turns.
_HERO = """<script>
if (location.hash === "#hero") {
  const begin = () => {
    if (!window.fflin || !window.fflin.ready) return;
    clearInterval(wait);
    fflin.plain(true, false);
    parent.postMessage("fflin-hero", "*");
    if (matchMedia("(prefers-reduced-motion: reduce)").matches) {
      fflin.pause();
      fflin.seek(8);
      return;
    }
    fflin.play();
    setInterval(() => { if (!fflin.state.playing) fflin.play(); }, 1500);
  };
  const wait = setInterval(begin, 50);
}
</script>
</body>"""


def write_hero(app: Sphinx, error: Exception | None) -> None:
    """Run the Python of the front page, and write the page of its motion for the front page."""
    if error or app.builder.format != "html":
        return
    source = (Path(app.srcdir) / "index.md").read_text("utf-8")
    code = re.search(r"```python\n(.*?motion\.html.*?)```", source, re.DOTALL)
    if code is None:
        return
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run([sys.executable, "-c", code[1]], cwd=folder, check=True)
        text = (Path(folder) / "motion.html").read_text("utf-8")
    target = Path(app.outdir) / "pages" / "index" / "motion.html"
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_text(text.replace("</body>", _HERO), "utf-8")


_VIEWER = re.compile(r'<script type="text/plain" id="meshcat">(.*?)</script>', re.DOTALL)
# Puts the viewer, as text, in the place of the script that loads it.
_SHARED = """(() => {{
  const viewer = document.createElement("script");
  viewer.type = "text/plain";
  viewer.id = "meshcat";
  viewer.textContent = {text};
  document.currentScript.replaceWith(viewer);
}})();
"""


def share_viewer(app: Sphinx, error: Exception | None) -> None:
    """Write the viewer, most of each HTML page of a scene, to one file that all pages load."""
    folder = Path(app.outdir) / "pages"
    target = folder / "viewer.js"
    for file in folder.rglob("*.html"):
        page = file.read_text("utf-8")
        found = _VIEWER.search(page)
        if found is None:
            continue
        text = _SHARED.format(text=json.dumps(found[1]))
        if not target.exists() or target.read_text("utf-8") != text:
            target.write_text(text, "utf-8")
        up = "../" * len(file.parent.relative_to(folder).parts)
        page = page.replace(found[0], f'<script src="{up}viewer.js"></script>')
        # "file:" is the address of a site that is read from disk.
        page = page.replace("script-src ", "script-src 'self' file: ", 1)
        file.write_text(page, "utf-8")


def setup(app: Sphinx) -> dict[str, Any]:
    """Register with Sphinx."""
    # Read and write pages on all cores, without -j auto: running the tutorials takes longest.
    app.parallel = max(app.parallel, os.cpu_count() or 1)
    # Files that Sphinx keeps for its next build are not part of the site.
    app.doctreedir = app.srcdir / "_build"
    # The kernels use one thread each, and print nothing about themselves.
    os.environ.setdefault("PYDEVD_DISABLE_FILE_VALIDATION", "1")
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    app.connect("builder-inited", prepare_kernels)
    app.connect("builder-inited", keep_pictures, priority=900)  # after myst_nb has chosen
    app.connect("env-before-read-docs", spread)
    app.connect("doctree-resolved", move_frames)
    app.connect("html-page-context", name_figures)
    app.connect("build-finished", remove_strays)
    app.connect("build-finished", write_hero)
    app.connect("build-finished", share_viewer, priority=900)  # after all pages are written
    return {"version": "1", "parallel_read_safe": True, "parallel_write_safe": True}
