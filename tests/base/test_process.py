"""Processes of fflin import nothing from the working folder, nor from a document's."""

import os
import sys
from pathlib import Path

import pytest

import fflin
from fflin.base.process import Progress, Status, import_path_without
from fflin.batch.run import OwnWorkers
from tests.support.commands import run, run_in_process

pytestmark = pytest.mark.process

XACRO = """<robot name="r" xmlns:xacro="http://www.ros.org/wiki/xacro">
<xacro:property name="m" value="2"/><link name="l"><inertial><mass value="${m}"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>"""

# What the processes import, the standard library's included.
LATE = ("xacro", "xacrodoc", "yaml", "ctypes")
ALL = (
    *LATE,
    "json",
    "signal",
    "fflin",
    "pickle",
    "multiprocessing",
    "socket",
    "contextlib",
)


@pytest.fixture
def poison(tmp_path, monkeypatch):
    """Fill the working folder with modules of these names, each of which leaves a mark."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "r.urdf.xacro").write_text(XACRO)

    def fill(*names):
        for name in names:
            mark = str(tmp_path / f"{name}.mark")
            (tmp_path / f"{name}.py").write_text(f"open({mark!r}, 'w')\n")

    yield fill
    assert not list(tmp_path.glob("*.mark"))


def test_the_path_is_without_a_folder_by_any_of_its_names(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "inside").mkdir()
    (tmp_path / "link").symlink_to(tmp_path)
    names = ["", ".", str(tmp_path), "link", f"{tmp_path}/inside/.."]
    monkeypatch.setattr(sys, "path", [*names, "inside", f"{tmp_path}/not_there.zip"])
    assert import_path_without("") == ["inside", f"{tmp_path}/not_there.zip"]
    assert import_path_without("inside") == [*names, f"{tmp_path}/not_there.zip"]


@pytest.mark.parametrize("beside", [False, True])
def test_an_expansion_runs_no_code_next_to_it(beside, poison, tmp_path, monkeypatch):
    pytest.importorskip("xacrodoc")
    poison(*ALL)
    monkeypatch.setattr(sys, "path", ["", str(tmp_path), *sys.path])
    if beside:  # the document's folder is another than the working folder
        monkeypatch.chdir("/")
    assert fflin.load(tmp_path / "r.urdf.xacro").model.inertias[1].mass == 2.0


def test_a_worker_starts_without_the_working_folder(poison):
    poison(*ALL)
    with OwnWorkers(1) as workers:
        assert workers.submit(os.getpid).result() != os.getpid()


def test_a_command_imports_nothing_from_the_working_folder(poison, tmp_path):
    pytest.importorskip("xacrodoc")
    poison(*LATE)
    code, out, _ = run(
        "info", "r.urdf.xacro", cwd=tmp_path, PYTHONPATH=f"{os.pathsep}{tmp_path}"
    )
    assert code == 0 and "mass 2 kg" in out


def test_the_program_imports_nothing_from_the_working_folder(poison, tmp_path):
    """With `python -m fflin`, Python itself puts the working folder first on the path."""
    pytest.importorskip("xacrodoc")
    poison(*LATE, "json", "signal", "pathlib")
    package = str(Path(fflin.__file__).parents[1])
    code, out, error = run_in_process(
        "info", "r.urdf.xacro", cwd=tmp_path, PYTHONPATH=package
    )
    assert code == 0, error
    assert "mass 2 kg" in out


def test_a_long_run_shows_its_hint(monkeypatch, capsys):
    now = [0.0]
    monkeypatch.setattr("fflin.base.process.time.monotonic", lambda: now[0])
    bar = Progress(True)
    for now[0] in (15.0, 25.0):
        bar(1, 4, hint="(faster: --engine compiled)")
    early, late = capsys.readouterr().err.split("\r")[1:]
    assert "faster" not in early and late.rstrip().endswith(
        "75 s left (faster: --engine compiled)"
    )
    assert len(late) <= 80


def test_without_a_terminal_a_line_appears_at_once_and_now_and_then(
    monkeypatch, capsys
):
    now = [0.0]
    monkeypatch.setattr("fflin.base.process.time.monotonic", lambda: now[0])
    line = Status()
    for now[0] in (0.0, 1.0, 19.0, 21.0, 22.0):
        line.say(f"at {now[0]:g} s")
    line.close()
    assert capsys.readouterr().err == "fflin: at 0 s\nfflin: at 21 s\n"


def test_on_a_terminal_one_line_is_updated(monkeypatch, capsys):
    now = [0.0]
    monkeypatch.setattr("fflin.base.process.time.monotonic", lambda: now[0])
    monkeypatch.setattr("fflin.base.process.on_terminal", lambda: True)
    line = Status()
    for now[0] in (0.0, 1.1, 1.15, 2.0):
        line.say(f"at {now[0]:g} s")
    line.close()
    assert capsys.readouterr().err == "".join(
        f"\r\x1b[2K{text}" for text in ("at 1.1 s", "at 2 s", "")
    )
