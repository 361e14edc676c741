"""Notebooks, run by a kernel: pictures for figures, cards for results, pages inline, once."""

import base64
import importlib.util
import os
import struct
from pathlib import Path
from unittest import mock

import pytest

from tests.support.cards import Parsed

nbformat = pytest.importorskip("nbformat", reason="the extra test is not installed")
pytest.importorskip("nbclient", reason="the extra test is not installed")
pytest.importorskip("ipykernel", reason="the extra test is not installed")

pytestmark = [pytest.mark.docs, pytest.mark.process]

DOCS = Path(__file__).parents[1] / "docs"

SETUP = """
import fflin
robot = fflin.load("planar_detumble")
lin = fflin.linearize(robot)
gain = fflin.lqr(lin, 1.0, 1.0)
motion = fflin.simulate(robot, fflin.StateFeedback(lin, gain.K), duration=1.0)
"""


def run(*cells, folder, variables=()):
    """Run cells of code in one kernel; return the outputs of each."""
    from nbclient import NotebookClient

    made = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(x) for x in cells])
    resources = {"metadata": {"path": str(folder)}}
    with mock.patch.dict(os.environ, dict(variables)):
        NotebookClient(made, timeout=None, resources=resources).execute()
    return [cell.outputs for cell in made.cells]


def data(outputs, kind):
    """Return the data of one kind in the outputs of a cell."""
    return [x["data"][kind] for x in outputs if kind in x.get("data", {})]


def pixels(picture):
    """Return the width and height of a PNG picture."""
    content = base64.b64decode(picture)
    assert content.startswith(b"\x89PNG")
    return struct.unpack(">II", content[16:24])


@pytest.mark.parametrize("backend", ["agg", "svg", ""])
def test_a_figure_is_shown_once_as_a_picture_whatever_the_backend(tmp_path, backend):
    variables = {"MPLBACKEND": backend} if backend else {}
    cells = [
        SETUP,
        "fflin.plot_poles(gain)",
        "figure = fflin.plot_matrices(lin)",
        "figure",
        "import sys\nprint('matplotlib.pyplot' in sys.modules)",
        "import matplotlib.pyplot as plt\nfflin.plot_motion(motion)",
        "print(plt.get_fignums())",
    ]
    _, poles, silent, matrices, pyplot, later, numbers = run(
        *cells, folder=tmp_path, variables=variables
    )
    for outputs in (poles, matrices, later):
        (picture,) = data(outputs, "image/png")
        assert len(outputs) == 1 and min(pixels(picture)) > 300
    assert not silent
    assert [pyplot[0]["text"], numbers[0]["text"]] == ["False\n", "[]\n"]


def test_results_are_cards_and_pages_are_inline_and_stored_once(tmp_path):
    cells = [
        SETUP,
        *("robot", "lin", "gain", "fflin.check(robot, lin)", "fflin.modes(lin)"),
        "page = fflin.visualize(robot, motion, html='motion.html')\npage",
        "page",
        "motion",
        "motion",
        "motion  # in another cell",
        "import os\nprint(os.fspath(page), str(page), page.is_file())",
        "print(fflin.visualize(robot, motion).name.startswith('fflin-planar'))",
        "fflin.visualize(robot)",
    ]
    _, *cards, page, again, motion, repeated, elsewhere, path, temporary, live = run(
        *cells, folder=tmp_path
    )
    for outputs in cards:
        (card,) = data(outputs, "text/html")
        assert {"div", "style"} <= Parsed(card).tags
    # A cell with the same text counts as the same cell, which is run again.
    (card,) = data(repeated, "text/html")
    assert len(Parsed(card).frames) == 1
    for first, second in ((page, again), (motion, elsewhere)):
        (card,) = data(first, "text/html")
        (frame,) = Parsed(card).frames
        assert frame["srcdoc"].lower().startswith("<!doctype html>")
        (card,) = data(second, "text/html")
        parsed = Parsed(card)
        assert not parsed.frames and "already shows this page" in parsed.text
    assert frame["srcdoc"] != (tmp_path / "motion.html").read_text()  # fewer frames
    assert path[0]["text"] == "motion.html motion.html True\n"
    assert temporary[0]["text"] == "True\n"  # and no browser was opened
    (card,) = data(live, "text/html")
    (frame,) = Parsed(card).frames
    assert frame["src"].startswith("http://127.0.0.1:") and frame["src"] in card


@pytest.mark.parametrize("page", ["first_loop", "flexible"])
def test_a_downloaded_tutorial_shows_pictures_and_pages(page, tmp_path):
    pytest.importorskip("sphinx", reason="the extra docs is not installed")
    spec = importlib.util.spec_from_file_location(
        "notebooks", DOCS / "_ext" / "notebooks.py"
    )
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    text = (DOCS / "tutorials" / f"{page}.md").read_text(encoding="utf-8")
    cells = [x for x in module.notebook(text)["cells"] if x["cell_type"] == "code"]
    sources = [x["source"] for x in cells]
    outputs = run(*sources, folder=tmp_path)
    pages = 0
    for source, shown in zip(sources, outputs, strict=True):
        last = source.splitlines()[-1]
        if last.startswith("fflin.plot_"):
            assert len(data(shown, "image/png")) == 1
        if last.startswith("fflin.visualize("):
            (card,) = data(shown, "text/html")
            pages += len(Parsed(card).frames)
    assert pages == 1 and any("fflin.plot_" in source for source in sources)
