"""Executed pages: every build contains the files that a run of a page wrote.

Sphinx runs a page only if its source changed since the last build. The files of the run are kept
in `docs/_build/executed`, beside the page's doctree, and every build copies them into its site.
"""

from __future__ import annotations

import os
import re
import shutil
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment


def kept(app: Sphinx) -> Path:
    """Return the folder of the files that pages wrote, with one folder for each page."""
    return Path(app.doctreedir) / "executed" / "pages"


def keep_pictures(app: Sphinx) -> None:
    """Keep the figures of the pages there too."""
    folder = str(kept(app).parent)
    app.env.mystnb_config = app.env.mystnb_config.copy(output_folder=folder)


def forget(app: Sphinx, env: BuildEnvironment, page: str) -> None:
    """Remove the files of a page before it is run again, or when it is removed."""
    shutil.rmtree(kept(app) / page, ignore_errors=True)


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


def announce(app: Sphinx, page: str, source: list[str]) -> None:
    """Pass the name of the page to the kernel that runs it."""
    os.environ["FFLIN_DOCS_PAGE"] = page


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


def deliver(app: Sphinx, error: Exception | None) -> None:
    """Copy the files of all pages into the site."""
    folder = Path(app.outdir) / "pages"
    shutil.rmtree(folder, ignore_errors=True)
    if error is None and kept(app).exists():
        shutil.copytree(kept(app), folder)


def setup(app: Sphinx) -> dict[str, Any]:
    """Register with Sphinx."""
    # Read and write pages on all cores, without -j auto: running the tutorials takes longest.
    app.parallel = max(app.parallel, os.cpu_count() or 1)
    # Files that Sphinx keeps for its next build are not part of the site.
    app.doctreedir = app.srcdir / "_build"
    here = str(Path(__file__).parent)
    # The kernels find the module `pages`, use one thread each, and print nothing about themselves.
    path = filter(None, (here, os.environ.get("PYTHONPATH")))
    os.environ["PYTHONPATH"] = os.pathsep.join(path)
    os.environ.setdefault("PYDEVD_DISABLE_FILE_VALIDATION", "1")
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    os.environ["FFLIN_DOCS_KEPT"] = str(kept(app))
    app.connect("builder-inited", keep_pictures, priority=900)  # after myst_nb has chosen
    app.connect("env-purge-doc", forget)
    app.connect("env-before-read-docs", spread)
    app.connect("source-read", announce)
    app.connect("html-page-context", name_figures)
    app.connect("build-finished", deliver)
    return {"version": "1", "parallel_read_safe": True, "parallel_write_safe": True}
