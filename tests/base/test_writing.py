"""The one rule for files: a regular one or a new name, never an input, whole or not at all."""

import csv
import io
import json
import os
import re
import shutil
import stat
import sys
from pathlib import Path

import numpy as np
import pytest

import fflin
from fflin.base.writing import (
    check_output_path,
    csv_table,
    reason,
    replacing,
    write_atomically,
)
from fflin.robot.catalog import bundled_directory
from tests.support.commands import run
from tests.support.marks import exhaustive
from tests.support.messages import says
from tests.support.patience import finished

# What each command writes, with the option that names it.
WRITERS = {
    "m.npz": ("linearize", "-o"),
    "m.mat": ("linearize", "-o"),
    "m.json": ("linearize", "-o"),
    "m.csv": ("linearize", "-o"),
    "g.npz": ("lqr", "--reduce", "-o"),
    "b.npz": ("sweep", "--random", "5", "-o"),
    "b.h5": ("sweep", "--random", "5", "-o"),
    "s.npz": ("simulate", "--duration", "0.1", "--free", "-o"),
    "s.csv": ("simulate", "--duration", "0.1", "--free", "-o"),
    "s.html": ("simulate", "--duration", "0.1", "--free", "--html"),
    "s.png": ("simulate", "--duration", "0.1", "--free", "--plot"),
}


@pytest.fixture
def urdf(tmp_path):
    return Path(
        shutil.copy(bundled_directory() / "astrobee_arm.urdf", tmp_path / "own.urdf")
    )


def written(name):
    """The file that a name leads to: of csv models a table."""
    return "m.B.csv" if name == "m.csv" else name


@pytest.mark.parametrize("name", WRITERS)
def test_an_input_is_never_written_to_whatever_its_name(
    name, urdf, tmp_path, capsys, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    command, *options = WRITERS[name]
    target, before = tmp_path / written(name), urdf.read_bytes()
    for link in (os.symlink, os.link):
        link(urdf, target)
        code, _, error = run(command, urdf, *options, name)
        assert code == 2 and "input file" in error and "\n" == error[-1]
        assert urdf.read_bytes() == before and target.samefile(urdf)
        assert sorted(path.name for path in tmp_path.iterdir()) == sorted(
            ("own.urdf", target.name)
        )
        target.unlink()


@pytest.mark.parametrize("name", WRITERS)
def test_a_pipe_is_never_written_to(name, urdf, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    command, *options = WRITERS[name]
    target = tmp_path / written(name)
    os.mkfifo(target)
    code, _, error = run(command, urdf, *options, name)
    assert code == 2 and "regular file" in error
    assert stat.S_ISFIFO(target.stat().st_mode) and len(list(tmp_path.iterdir())) == 2


@pytest.mark.parametrize(
    "name", [*(name for name in WRITERS if name != "s.png"), *exhaustive("s.png")]
)
def test_a_link_is_followed_and_modes_are_kept(
    name, urdf, tmp_path, capsys, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    command, *options = WRITERS[name]
    (tmp_path / "there").mkdir()
    old, target = tmp_path / "there" / "old", tmp_path / written(name)
    old.write_text("old")
    old.chmod(0o640)
    target.symlink_to(old)
    force = ["--force"] * (target.suffix in (".npz", ".mat", ".json", ".csv", ".h5"))
    code, _, error = run(command, urdf, *options, name, *force)
    assert code == 0, error
    assert target.is_symlink() and len(old.read_bytes()) > 100
    assert old.stat().st_mode & 0o777 == 0o640
    target.unlink()
    before = os.umask(0o027)
    try:
        assert run(command, urdf, *options, name)[0] == 0
    finally:
        os.umask(before)
    assert target.stat().st_mode & 0o777 == 0o640
    assert not list(tmp_path.glob("**/.fflin*")) and not list(
        tmp_path.glob("**/*.part")
    )


def test_an_unfinished_file_is_under_the_rule(urdf, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    before = urdf.read_bytes()
    (tmp_path / "x.h5.part").symlink_to(urdf)
    code, _, error = run("sweep", urdf, "--random", "5", "-o", "x.h5")
    assert code == 2 and "input file" in error and urdf.read_bytes() == before
    (tmp_path / "x.h5.part").unlink()
    os.mkfifo(tmp_path / "x.h5.part")
    code, _, error = run("sweep", urdf, "--random", "5", "-o", "x.h5")
    assert code == 2 and "regular file" in error


def test_other_inputs_are_protected_too(urdf, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "in.json").write_text('[[input]]\ntype = "base_torque"\n')
    command = ("linearize", urdf, "--inputs", "in.json", "-o", "in.json")
    code, _, error = run(*command)
    assert code == 2 and "input file" in error
    os.link("in.json", "q.h5")
    code, _, error = run(
        "sweep", urdf, "--random", 3, "--inputs", "in.json", "-o", "q.h5"
    )
    assert code == 2 and "input file" in error and error.count("\n") == 1


def test_a_session_may_overwrite_a_file_that_it_read(
    urdf, tmp_path, capsys, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    robot = fflin.load(urdf)
    t, q = np.array([0.0, 1.0]), np.tile(robot.neutral(), (2, 1))
    rest = fflin.Trajectory(
        robot, t, q, np.zeros((2, robot.nv)), np.zeros((2, robot.nv))
    )
    for name in ("t.csv", "t.npz"):
        rest.save(name)
        read = fflin.Trajectory.load(name, robot)
        assert run("info", urdf)[0] == 0  # keeps its own files alone
        fflin.Trajectory(robot, 2.0 * t, q, read.v, read.u).save(name)
        assert fflin.Trajectory.load(name, robot).t[-1] == 2.0


def linked(tmp_path, read, *command):
    """Run a command whose output leads to a file that is read; check that it stays."""
    before = read.read_bytes()
    (tmp_path / command[-1]).symlink_to(read)
    done = finished(
        [sys.executable, "-m", "fflin", *command],
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    assert read.read_bytes() == before and (tmp_path / command[-1]).is_symlink()
    message = [line for line in done.stderr.splitlines() if "warning" not in line]
    assert done.returncode == 2 and len(message) == 1
    assert says(message[0], str(command[-1]), f"input file {read}")


@pytest.mark.process
@pytest.mark.parametrize("included", ["inc.xacro", "deep.xacro", "mass.yaml"])
def test_files_that_a_xacro_reads_are_protected(included, tmp_path):
    pytest.importorskip("xacrodoc")
    namespace = 'xmlns:xacro="http://www.ros.org/wiki/xacro"'
    (tmp_path / "mass.yaml").write_text("m: 3\n")
    (tmp_path / "deep.xacro").write_text(
        f"""<robot {namespace}>
        <xacro:property name="of" value="${{xacro.load_yaml('mass.yaml')}}"/></robot>"""
    )
    (tmp_path / "inc.xacro").write_text(
        f"""<robot {namespace}><xacro:include filename="deep.xacro"/>
        <link name="l"><inertial><mass value="${{of['m']}}"/>
        <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>"""
    )
    (tmp_path / "x.urdf.xacro").write_text(
        f'<robot name="r" {namespace}><xacro:include filename="inc.xacro"/></robot>'
    )
    target = tmp_path / "there"
    target.mkdir()
    for name in ("x.urdf.xacro", "inc.xacro", "deep.xacro", "mass.yaml"):
        (tmp_path / name).rename(target / name)
    linked(
        tmp_path,
        target / included,
        "linearize",
        "there/x.urdf.xacro",
        "--force",
        "-o",
        "o.json",
    )


@pytest.mark.process
@pytest.mark.parametrize(
    "command",
    [
        ("linearize", "--force", "-o", "o.json"),
        ("simulate", "--duration", ".1", "--html", "o.html"),
    ],
)
@pytest.mark.parametrize("source", ["visual", "collision"])
def test_meshes_of_a_robot_are_protected(source, command, urdf, tmp_path):
    mesh = tmp_path / "package" / "m.stl"
    mesh.parent.mkdir()
    mesh.write_text("solid m\nendsolid m\n")
    named = f'<{source}><geometry><mesh filename="package://package/m.stl"/></geometry></{source}></link>'
    urdf.write_text(urdf.read_text().replace("</link>", named, 1))
    linked(tmp_path, mesh, command[0], urdf.name, *command[1:])


@pytest.mark.parametrize(
    "second, option", [("m.png", "--png"), ("link.png", "--png"), ("./m.png", "-o")]
)
def test_two_outputs_of_one_name_are_refused_before_work(
    second, option, urdf, tmp_path, capsys, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "link.png").symlink_to("m.png")
    before = sorted(tmp_path.iterdir())
    monkeypatch.setattr(fflin, "simulate", None)  # the work
    code, _, error = run("simulate", urdf, "--plot", "m.png", option, second)
    assert code == 2 and error.count("\n") == 1
    assert "m.png" in error or "link.png" in error
    assert sorted(tmp_path.iterdir()) == before


def test_a_device_is_refused():
    with pytest.raises(fflin.FileError, match="regular file"):
        write_atomically({Path("/dev/null"): b"x"})
    assert stat.S_ISCHR(os.stat("/dev/null").st_mode)


def test_whatever_fails_leaves_all_as_it_was(tmp_path):
    old, new = tmp_path / "old.npz", tmp_path / "new.npz"
    old.write_text("old")
    with pytest.raises(ZeroDivisionError), replacing(old, new) as files:
        files[0].write_text("half")
        raise ZeroDivisionError
    assert old.read_text() == "old" and list(tmp_path.iterdir()) == [old]
    with pytest.raises(fflin.FileError, match="File name too long") as caught:
        check_output_path(tmp_path / ("a" * 5000 + ".npz"))
    assert len(str(caught.value)) < 400
    with pytest.raises(fflin.FileError, match="folder"):
        check_output_path(tmp_path / "none" / "x.npz")
    loop = tmp_path / "loop.npz"
    loop.symlink_to(loop)
    with pytest.raises(fflin.FileError, match="written"):
        check_output_path(loop)


_LIMITED = """
import json, resource, sys
from fflin.commands.cli import main
resource.setrlimit(resource.RLIMIT_FSIZE, (1024, 1024))
for command in json.loads(sys.argv[1]):
    print(main(command), file=sys.stderr)
"""


@pytest.mark.process
def test_a_limit_of_the_size_of_a_file_is_one_line(tmp_path):
    """As where the disk is full; all in one process, which must outlive them."""
    writers = {**WRITERS, "large.h5": ("sweep", "--random", "300", "-o")}
    commands = [
        [first, "astrobee_arm", *rest, name] for name, (first, *rest) in writers.items()
    ]
    done = finished(
        [sys.executable, "-c", _LIMITED, json.dumps(commands)],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        env={**os.environ, "NUMBA_DISABLE_JIT": "1"},
    )
    message = [
        line
        for line in done.stderr.splitlines()
        if not re.search("warning|about .* points|compiling|font_manager", line)
    ]
    assert done.returncode == 0 and message[1::2] == ["2"] * len(commands), done.stderr
    for line in message[::2]:
        assert re.match(r"fflin: error: .*File too large", line), line
    assert not list(tmp_path.iterdir())


def test_room_that_is_not_there_is_reported_before_work(tmp_path, monkeypatch):
    """The disk is full although it said that it has room, as with quotas."""
    pytest.importorskip("h5py")

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "posix_fallocate", full)
    robot = fflin.load("cubesat")
    begun = []
    with pytest.raises(fflin.FileError, match=r"x\.h5\.part.*No space left"):
        fflin.sweep(
            robot,
            fflin.random_configurations(robot, 50),
            out=tmp_path / "x.h5",
            progress=lambda *counts: begun.append(counts),
        )
    assert not begun and not list(tmp_path.iterdir())


def test_the_room_of_a_sweep_is_its_own_from_the_start(tmp_path):
    pytest.importorskip("h5py")
    robot = fflin.load("cubesat")
    held = []

    def look(done, _):
        if not held:
            result = os.stat(tmp_path / "x.h5.part")
            held.append(result.st_blocks * 512 / result.st_size)

    points = fflin.random_configurations(robot, 1500)
    fflin.sweep(
        robot, points, out=tmp_path / "x.h5", chunk=100, progress=look, threads=1
    )
    assert held[0] >= 1.0


def test_a_reason_is_never_empty():
    assert reason(EOFError()) == "the file ends too early"
    assert reason(NotImplementedError()) == "NotImplementedError"
    assert reason(KeyError("q")) == "it has no entry 'q'"


def test_names_with_breaks_and_spaces_are_read_back_from_a_table():
    cells = ["a\rb", "c ", "d\ne", " x", 'q"', "a\r\nb", ","]
    content = csv_table([cells, cells])
    assert list(csv.reader(io.StringIO(content.decode(), newline=""))) == [cells, cells]
    assert csv_table([["a", 1.5], ["b", 2]]) == b"a,1.5\nb,2\n"
