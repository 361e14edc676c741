"""Every tutorial is a notebook that can be downloaded, with the code of its page."""

import ast
import importlib.util
import json
import re
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[1] / "docs"
PAGES = sorted(
    path.stem for path in (DOCS / "tutorials").glob("*.md") if path.stem != "index"
)

pytest.importorskip("sphinx", reason="the extra docs is not installed")
nbformat = pytest.importorskip("nbformat", reason="the extra docs is not installed")


@pytest.fixture(scope="module")
def notebook():
    spec = importlib.util.spec_from_file_location(
        "notebooks", DOCS / "_ext" / "notebooks.py"
    )
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.notebook


@pytest.mark.parametrize("page", PAGES)
def test_a_tutorial_is_a_valid_notebook(page, notebook):
    text = (DOCS / "tutorials" / f"{page}.md").read_text(encoding="utf-8")
    content = json.dumps(notebook(text))
    assert len(content) < 30_000
    made = nbformat.reads(content, as_version=4)
    nbformat.validate(made)
    code = [cell.source for cell in made.cells if cell.cell_type == "code"]
    cells = len(re.findall(r"^```\{code-cell\}$", text, re.MULTILINE))
    assert len(code) == cells and made.cells[0].source.startswith("# ")
    for source in code:
        ast.parse(source)
        assert "pages." not in source
    prose = "".join(cell.source for cell in made.cells if cell.cell_type == "markdown")
    assert "code-cell" not in prose and ".md)" not in prose


def test_the_index_offers_every_notebook():
    index = (DOCS / "tutorials" / "index.md").read_text(encoding="utf-8")
    assert sorted(re.findall(r"<\.\./_build/notebooks/(\w+)\.ipynb>", index)) == PAGES
