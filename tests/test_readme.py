"""The examples and commands of the README, of the first pages and of the command line run."""

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

import fflin

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
COMMANDS = (ROOT / "docs" / "command_line.md").read_text(encoding="utf-8")


def code_blocks(language, text=README):
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.DOTALL | re.MULTILINE)


@pytest.mark.docs
@pytest.mark.parametrize("page", ["README.md", "docs/index.md", "docs/peers.md"])
def test_python_examples_run(tmp_path, page):
    text = (ROOT / page).read_text(encoding="utf-8")
    (tmp_path / "example.py").write_text("\n".join(code_blocks("python", text)))
    done = subprocess.run(
        [sys.executable, "example.py"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "undecided" not in done.stderr


def test_the_moving_picture_is_small_and_as_wide_as_the_readme():
    image = pytest.importorskip("PIL.Image")
    path, still = re.findall(r'(?:src|srcset)="([^"]+)"', README)[::-1]
    assert (ROOT / path).stat().st_size < 2e6
    with image.open(ROOT / path) as film, image.open(ROOT / still) as picture:
        assert film.size == picture.size and film.width == 830
        assert film.n_frames >= 48 and film.info["loop"] == 0
        # The robot moves: the first and the middle picture differ at many points.
        first = film.convert("L").histogram()
        film.seek(film.n_frames // 2)
        middle = film.convert("L").histogram()
    assert first != middle


def test_one_example_on_all_front_pages():
    index = (ROOT / "docs" / "index.md").read_text(encoding="utf-8")
    assert code_blocks("python", index) == code_blocks("python")


def test_links_lead_somewhere():
    pages = [
        path
        for folder in ("", "robots", "examples", "benchmarks", ".github")
        for path in (ROOT / folder).glob("*.md")
    ]
    for page in (*pages, *(ROOT / "docs").glob("**/*.md")):
        prose = re.sub(
            r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL
        )
        for link in re.findall(r"\]\((?!http)([^)#]+)", prose):
            assert (page.parent / link).exists(), f"{page.name}: {link}"


@pytest.mark.docs
def test_commands_run(tmp_path):
    commands = [
        shlex.split(line)
        for block in code_blocks("sh", COMMANDS)
        for line in block.splitlines()
    ]
    assert len(commands) >= 4
    for command in commands:
        done = subprocess.run(
            [sys.executable, "-m", *command],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr


@pytest.mark.docs
def test_two_commands_set_up_from_nothing():
    """One for the main job, one for the tests; what they install is what the project declares."""
    setups = [
        line
        for block in code_blocks("sh")
        for line in block.splitlines()
        if "venv" in line
    ]
    assert len(setups) == 2
    job, tests = setups
    # With matplotlib, so that every command further down runs after it.
    assert job.startswith(
        "python3 -m venv .venv && .venv/bin/pip install -q -e '.[plot]' && "
    )
    # The part behind the installation, in this environment.
    for step in job.split(" && ")[2:]:
        arguments = shlex.split(step.removeprefix(".venv/bin/fflin "))
        done = subprocess.run(
            [sys.executable, "-m", "fflin", *arguments],
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0 and done.stdout
        assert not done.stderr  # no warning of the first robot that a reader meets
    # The verdict comes first, then the matrices, which are cut.
    assert "check" in job.split(" && ")[2]
    assert "more columns, see -o" in done.stdout
    assert tests.endswith(".venv/bin/pytest")


def test_every_bundled_robot_is_named():
    from fflin.robot.catalog import find_robot

    for name in fflin.list_robots():
        if find_robot(name).origin == "fflin":
            assert f"`{name}`" in (ROOT / "robots" / "README.md").read_text(
                encoding="utf-8"
            )
