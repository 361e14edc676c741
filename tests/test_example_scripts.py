"""Every script of examples/ runs, and its picture is small and shown."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[1] / "examples"
SCRIPTS = sorted(path.stem for path in FOLDER.glob("*.py"))


@pytest.mark.docs
@pytest.mark.parametrize("name", SCRIPTS)
def test_an_example_draws_its_picture(name, tmp_path):
    if name == "mpc":
        pytest.importorskip("piqp")
    done = subprocess.run(
        [sys.executable, FOLDER / f"{name}.py"],
        cwd=tmp_path,
        env={**os.environ, "MPLBACKEND": "agg"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "Warning" not in done.stderr
    assert (tmp_path / f"{name}.png").read_bytes().startswith(b"\x89PNG")


def test_the_page_shows_every_example():
    page = (FOLDER / "README.md").read_text(encoding="utf-8")
    assert re.findall(r"^## (\w+)\.py$", page, re.MULTILINE) == re.findall(
        r"\]\((\w+)\.png\)", page
    )
    assert (
        sorted(re.findall(r"\]\((\w+)\.png\)", page)) == SCRIPTS and len(SCRIPTS) <= 10
    )
    for name in SCRIPTS:
        text = (FOLDER / f"{name}.py").read_text(encoding="utf-8")
        assert text.split('"""')[1] in page
        assert text.count("\n") <= 30
        assert (FOLDER / f"{name}.png").stat().st_size < 70_000


def test_the_gallery_has_a_small_moving_picture_of_every_example():
    page = (FOLDER.parent / "docs" / "examples.md").read_text(encoding="utf-8")
    pictures = re.findall(r'src="(_static/examples/(\w+)\.webp)"', page)
    assert sorted(name for _, name in pictures) == SCRIPTS
    for path, name in pictures:
        content = (FOLDER.parent / "docs" / path).read_bytes()
        assert b"ANIM" in content[:64] and len(content) < 60_000
        assert f"../examples/{name}.py" in page
