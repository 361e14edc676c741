"""What a reader of a tutorial sees first."""

import ast
import re
import warnings
from pathlib import Path

import pytest

import fflin

TUTORIALS = Path(__file__).parents[1] / "docs" / "tutorials"
PAGES = sorted(path.stem for path in TUTORIALS.glob("*.md") if path.stem != "index")


def first_robot(page):
    """Return what a page does up to its first robot, as a module, or None where it has none."""
    text = (TUTORIALS / f"{page}.md").read_text(encoding="utf-8")
    cells = re.findall(r"```\{code-cell\}\n(?::[^\n]*\n)*(.*?)```", text, re.DOTALL)
    done = []
    for cell in cells:
        if "load(" not in cell and not cell.startswith("import fflin"):
            continue
        for statement in ast.parse(cell).body:
            done.append(statement)
            if isinstance(statement, ast.Assign) and "load(" in ast.unparse(statement):
                return ast.Module(done, [])
    return None


@pytest.mark.parametrize("page", [page for page in PAGES if page != "own_urdf"])
def test_a_tutorial_begins_without_a_warning(page, tmp_path, monkeypatch):
    # The page about one's own URDF shows what its file makes fflin warn of.
    module = first_robot(page)
    assert module is not None
    names = {}
    monkeypatch.chdir(tmp_path)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        exec(compile(module, page, "exec"), names)
    assert isinstance(names["robot"], fflin.Robot)
