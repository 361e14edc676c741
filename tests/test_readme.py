"""What the README shows must run, as it stands there."""

import re
import shlex
import subprocess
import sys
from pathlib import Path

import fflin

README = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")


def code_blocks(language):
    return re.findall(rf"```{language}\n(.*?)```", README, re.DOTALL)


def test_python_examples_run(tmp_path):
    (tmp_path / "example.py").write_text("\n".join(code_blocks("python")))
    done = subprocess.run(
        [sys.executable, "example.py"], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


def test_commands_run(tmp_path):
    commands = [
        shlex.split(line)
        for block in code_blocks("sh")
        for line in block.splitlines()
        if line.startswith("fflin ")
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


def test_two_commands_set_up_from_nothing():
    """One for the main job, one for the tests; what they install is what the project declares."""
    setups = [line for block in code_blocks("sh") for line in block.splitlines() if "venv" in line]
    assert len(setups) == 2
    job, tests = setups
    assert job.startswith("python3 -m venv .venv && .venv/bin/pip install -q -e . && ")
    # The part behind the installation, in this environment.
    for step in job.split(" && ")[2:]:
        arguments = shlex.split(step.removeprefix(".venv/bin/fflin "))
        done = subprocess.run(
            [sys.executable, "-m", "fflin", *arguments], capture_output=True, text=True, check=False
        )
        assert done.returncode == 0 and done.stdout
    assert tests.endswith(".venv/bin/pytest")


def test_every_bundled_robot_is_named():
    from fflin.robots import find_robot

    for name in fflin.list_robots():
        if find_robot(name).origin == "fflin":
            assert f"`{name}`" in README
