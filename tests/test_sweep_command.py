"""fflin sweep as a user runs it."""

import re

import numpy as np
import pytest
from test_cli import refused, run

import fflin

pytest.importorskip("h5py")


def test_grid_random_and_file_say_the_same(tmp_path, robots):
    robot = robots["ets_vii"]
    code, out, err = run(
        *("sweep", "ets_vii", "--grid", "joint_2=-1:1:3", "--grid", "joint_4=-2:0:2"),
        *("--joint", "joint_1=0.2", "-o", tmp_path / "g.h5"),
    )
    assert code == 0 and out == f"wrote {tmp_path / 'g.h5'}: 6 points, 24 states, 12 inputs\n"
    assert re.match(r"fflin: 6 points of 'ets_vii', [\d.]+ kB to .*g\.h5\n", err)
    batch = fflin.LinearBatch.load(tmp_path / "g.h5", robot)
    assert batch.joint_positions[:, :4] == pytest.approx(
        np.array([[0.2, a, 0.0, b] for a in (-1.0, 0.0, 1.0) for b in (-2.0, 0.0)])
    )
    np.savez(tmp_path / "q.npz", q=batch.q)
    code, *_ = run(
        *("sweep", "ets_vii", "--configurations", tmp_path / "q.npz"),
        *("--workers", 2, "-o", tmp_path / "f.npz"),
    )
    again = fflin.LinearBatch.load(tmp_path / "f.npz", robot)
    assert code == 0 and np.abs(again.B_lower - batch.B_lower).max() < 1e-13
    code, *_ = run(
        *("sweep", "ets_vii", "--random", 7, "--seed", 5, "--range", "joint_3=0.1:0.2"),
        *("--velocity", "joint_1=0.3", "--frame", "world", "-o", tmp_path / "r.npz"),
    )
    drawn = fflin.LinearBatch.load(tmp_path / "r.npz", robot)
    expected = fflin.random_configurations(robot, 7, seed=5, ranges={"joint_3": (0.1, 0.2)})
    assert code == 0 and np.array_equal(drawn.q, expected.rows(0, 7))
    lin = fflin.linearize(robot, drawn.q[4], fflin.velocity(robot, {"joint_1": 0.3}), frame="world")
    assert drawn[4].A == pytest.approx(lin.A, abs=1e-12)


@pytest.mark.parametrize(
    "arguments, message",
    [
        ((), "by one of --grid, --random and --configurations"),
        (("--grid", "joint_22=0:1:3"), "no joint named 'joint_22'; did you mean joint_2"),
        (("--grid", "joint_2=0:1"), "is not JOINT=LO:HI:N"),
        (("--grid", "joint_2=1:1:3"), "'joint_2=1:1:3' is empty"),
        (("--grid", "joint_2=0:1:0"), "0 is too few"),
        (("--grid", "joint_2=0:1:2", "--grid", "joint_2=0:1:3"), "names 'joint_2' twice"),
        (("--grid", "joint_2=0:1:2", "--joint", "joint_2=1"), "is on the grid and in joints"),
        (
            ("--grid", "joint_2=0:1:100000", "--grid", "joint_3=0:1:100000"),
            r"10,000,000,000 points of 'ets_vii', [\d.]+ TB: add --yes",
        ),
        (("--random", "0"), "0 is too few"),
        (("--random", "3", "--grid", "joint_2=0:1:2"), "by one of --grid"),
        (("--random", "3", "--joint", "joint_2=1", "--range", "joint_2=0:1"), "give either"),
        (("--configurations", "none.npz"), "none.npz: cannot be read"),
        (("--random", "3", "--workers", "2", "--dask", "x"), "give either"),
    ],
)
def test_bad_input_is_one_line(arguments, message, tmp_path):
    error = refused("sweep", "ets_vii", *arguments, "-o", "out.npz", cwd=tmp_path)
    assert re.search(message, error), error
    assert not list(tmp_path.iterdir())


def test_what_is_missing_or_damaged_is_one_line(tmp_path, robots):
    assert "-o says where" in refused("sweep", "ets_vii", "--random", "3", cwd=tmp_path)
    assert "expected one of .npz, .h5" in refused(
        "sweep", "ets_vii", "--random", "3", "-o", "x.mat", cwd=tmp_path
    )
    q = np.tile(robots["ets_vii"].neutral(), (9, 1))
    q[4, 8] = np.nan
    np.savez(tmp_path / "q.npz", q=q)
    error = refused("sweep", "ets_vii", "--configurations", "q.npz", "-o", "x.npz", cwd=tmp_path)
    assert error.startswith("fflin: error: configuration 4: q[8] is nan")
    assert [entry.name for entry in tmp_path.iterdir()] == ["q.npz"]
