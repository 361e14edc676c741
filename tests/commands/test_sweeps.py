"""fflin sweep as a user runs it."""

import re
import sys

import numpy as np
import pinocchio as pin
import pytest

import fflin
from tests.support.commands import refused, run
from tests.support.messages import any_wording, says
from tests.support.patience import in_own_session

pytest.importorskip("h5py")


@pytest.mark.exhaustive
def test_grid_random_and_file_say_the_same(tmp_path, robots):
    robot = robots["ets_vii"]
    code, out, err = run(
        *("sweep", "ets_vii", "--grid", "joint_2=-1:1:3", "--grid", "joint_4=-2:0:2"),
        *("--joint", "joint_1=0.2", "-o", tmp_path / "g.h5"),
    )
    assert code == 0 and says(out, "g.h5", "6 points, 24 states, 12 inputs")
    assert re.match(
        r"fflin: linearising 'ets_vii' about 6 points; .*g\.h5 takes [\d.]+ kB\n", err
    )
    batch = fflin.LinearBatch.load(tmp_path / "g.h5", robot)
    assert batch.joint_positions[:, :4] == pytest.approx(
        np.array([[0.2, a, 0.0, b] for a in (-1.0, 0.0, 1.0) for b in (-2.0, 0.0)])
    )
    code, *_ = run(
        *("sweep", "ets_vii", "--grid", "joint_2=-1:1:3", "--grid", "joint_4=-2:0:2"),
        *("--joint", "joint_1=0.2", "--workers", 2, "-o", tmp_path / "f.npz"),
    )
    again = fflin.LinearBatch.load(tmp_path / "f.npz", robot)
    assert code == 0 and np.abs(again.B_lower - batch.B_lower).max() < 1e-13
    code, *_ = run(
        *("sweep", "ets_vii", "--random", 7, "--seed", 5, "--range", "joint_3=0.1:0.2"),
        *("--velocity", "joint_1=0.3", "--frame", "world", "-o", tmp_path / "r.npz"),
    )
    drawn = fflin.LinearBatch.load(tmp_path / "r.npz", robot)
    expected = fflin.random_configurations(
        robot, 7, seed=5, ranges={"joint_3": (0.1, 0.2)}
    )
    assert code == 0 and np.array_equal(drawn.q, expected.rows(0, 7))
    lin = fflin.linearize(
        robot, drawn.q[4], fflin.velocity(robot, {"joint_1": 0.3}), frame="world"
    )
    assert drawn[4].A == pytest.approx(lin.A, abs=1e-12)


@pytest.mark.compiled
def test_the_engine_can_be_chosen(tmp_path):
    points = ("sweep", "canadarm2", "--random", 5, "--engine")
    for engine in ("compiled", "python"):
        assert run(*points, engine, "-o", tmp_path / f"{engine}.npz")[0] == 0
    one, other = (
        fflin.LinearBatch.load(tmp_path / f"{engine}.npz")
        for engine in ("compiled", "python")
    )
    assert one.A == pytest.approx(other.A, abs=1e-12)
    with any_wording():
        outputs = ("--output", "com", "-o", tmp_path / "a.npz")
        code, _, error = run(*points, "compiled", *outputs)
        assert code == 2 and "engine='compiled'" in error
        assert "--engine" in refused(*points, "fast", *outputs)


@pytest.mark.parametrize(
    "arguments, message",
    [
        ((), "--grid"),
        (("--grid", "joint_22=0:1:3"), "'joint_22'"),
        (("--grid", "joint_2=0:1"), "JOINT=LO:HI:N"),
        (("--grid", "joint_2=1:1:3"), "'joint_2=1:1:3'"),
        (("--grid", "joint_2=0:1:0"), "--grid"),
        (("--grid", "joint_2=0:1:2", "--grid", "joint_2=0:1:3"), "'joint_2'"),
        (("--grid", "joint_2=0:1:2", "--joint", "joint_2=1"), "grid"),
        (("--random", "3", "--range", "joint_22=0:1"), "'joint_22'"),
        (("--random", "0"), "--random"),
        (("--random", "3", "--range", "joint_1=-1e308:1e308"), "overflow"),
        (("--random", "3", "--grid", "joint_2=0:1:2"), "--grid"),
        (("--random", "3", "-o", "none/x.npz"), "none"),
    ],
)
def test_invalid_input_is_one_line(arguments, message, tmp_path):
    error = refused("sweep", "ets_vii", "-o", "out.npz", *arguments, cwd=tmp_path)
    assert re.search(message, error), error
    assert not list(tmp_path.iterdir())


def test_more_points_than_fit_are_refused(tmp_path):
    many = ("--grid", "joint_2=0:1:100000", "--grid", "joint_3=0:1:100000")
    code, out, err = run("sweep", "ets_vii", *many, "-o", "out.npz", cwd=tmp_path)
    assert (code, out) == (2, "")
    assert re.fullmatch(
        r"fflin: error: 10,000,000,000 .*memory.*", err.splitlines()[-1]
    )
    assert not list(tmp_path.iterdir())


def test_a_missing_file_or_ending_is_one_line(tmp_path):
    assert "-o" in refused("sweep", "ets_vii", "--random", "3", cwd=tmp_path)
    assert ".npz, .h5" in refused(
        "sweep", "ets_vii", "--random", "3", "-o", "x.mat", cwd=tmp_path
    )


def test_the_reference_may_be_the_world(tmp_path, robots):
    options = ("--random", "3", "--rpy", "30", "0", "0", "--reference", "world", "-o")
    code, *_ = run("sweep", "ets_vii", *options, tmp_path / "w.h5")
    assert code == 0
    batch = fflin.LinearBatch.load(tmp_path / "w.h5", robots["ets_vii"])
    lin = fflin.linearize(robots["ets_vii"], batch.q[1], reference=pin.SE3.Identity())
    assert batch[1].x0[0] == pytest.approx(np.sin(np.pi / 12), rel=1e-12)
    assert batch[1].x0 == pytest.approx(lin.x0, abs=1e-14)
    assert batch[1].A == pytest.approx(lin.A, abs=1e-14)


INTERRUPTED = """
import os, signal, sys
from fflin.base import process
from fflin.__main__ import main
counted = process.Progress.__call__
def update(bar, done, total):
    counted(bar, done, total)
    os.killpg(0, signal.SIGINT)
process.Progress.__call__ = update
sys.exit(main())
"""


@pytest.mark.process
@pytest.mark.parametrize("workers", [(), ("--workers", "2")])
def test_ctrl_c_keeps_finished_work_and_leaves_no_process(workers, tmp_path):
    """The whole group is interrupted, as a terminal does it."""
    pytest.importorskip("h5py")
    command = [
        sys.executable,
        "-c",
        INTERRUPTED,
        "sweep",
        "ets_vii",
        "--random",
        "100000",
    ]
    options = ["--velocity", "joint_1=0.3", "-o", "x.h5", *workers]
    with in_own_session([*command, *options], tmp_path) as process:
        # These end with the last process that has them.
        _, error = process.communicate()
    assert process.returncode == 130
    *_, last = error.splitlines()
    going_on = (
        r"fflin: stopped at [\d,]+ of 100,000 points; "
        r"the same command resumes from x.h5.part"
    )
    assert re.fullmatch(going_on, last)
    assert "Traceback" not in error
    assert [entry.name for entry in tmp_path.iterdir()] == ["x.h5.part"]


def test_a_sweep_that_is_refused_says_only_why(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "g.h5.part").write_bytes(b"not a file of HDF5")
    # Only one line on stderr: no line on the work and its size before the error.
    assert "g.h5.part" in refused("sweep", "ets_vii", "--random", "6", "-o", "g.h5")
