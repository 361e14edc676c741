"""The commands along a trajectory, from files that other programs wrote."""

import csv

import numpy as np
import pytest
from scipy.io import savemat

import fflin
from tests.support.commands import refused, run


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    """A motion under held inputs on the base in world axes: as .csv, by hand, and as .mat."""
    folder = tmp_path_factory.mktemp("tracking")
    robot = fflin.load("planar_detumble")
    u = np.random.default_rng(2).normal(size=(4, 9)) * np.r_[np.ones(6), 0.02 * np.ones(3)]
    motion = fflin.simulate(
        *(robot, lambda t, q, v: u[min(int(t / 0.5 + 1e-9), 3)]),
        v0=fflin.velocity(robot, {"omega_b.z": 0.3, "joint_1": 0.2}),
        **{"duration": 2.0, "dt": 0.01, "sample": 0.5, "every": 10, "frame": "world"},
    )
    names = ["t", *motion.state_names, *motion.input_names]
    with (folder / "flown.csv").open("w", newline="") as file:
        rows = np.column_stack((motion.t, motion.x, motion.u)).tolist()
        csv.writer(file).writerows([names, *rows[:-1], [*rows[-1][:19], *[""] * 9]])
    arrays = {"t": motion.t, "x": motion.x, "u": motion.u, "frame": "world", "hold": "previous"}
    savemat(folder / "flown.mat", arrays)
    return folder, robot, motion.trajectory()


def test_the_chain_goes_from_a_file_to_gains(flown):
    folder, robot, motion = flown
    given = ("planar_detumble", "--trajectory", folder / "flown.csv", "--frame", "world")
    code, out, err = run("linearize", *given, "-o", folder / "ltv.npz")
    assert (code, err) == (0, "")
    assert "21 knots, 0 to 2 s, inputs held, frame='world'" in out
    assert "residual " in out
    along = fflin.LinearTrajectory.load(folder / "ltv.npz", robot)
    expected = fflin.linearize_trajectory(robot, motion)
    assert along.A == pytest.approx(expected.A, abs=1e-12 * np.abs(expected.A).max())
    assert along.residual.max() < 1e-8
    mat = ("planar_detumble", "--trajectory", folder / "flown.mat")
    code, out, _ = run("linearize", *mat, "--dt", "0.1", "-o", folder / "sampled.npz")
    assert code == 0
    assert fflin.LinearTrajectory.load(folder / "sampled.npz", robot).dt == 0.1

    code, out, err = run("check", *mat)
    assert (code, err) == (0, "")
    assert "OK: 123 figures hold" in out

    weights = ("--bryson", "q_b=0.05", "--bryson", "tau_m=0.5", "--qf", "q_b=9")
    code, out, err = run("tvlqr", *given, *weights, "--dt", "0.1", "-o", folder / "gains.npz")
    assert (code, err) == (0, "")
    schedule = fflin.GainSchedule.load(folder / "gains.npz")
    assert schedule.dt == 0.1
    assert schedule.Q[0, 0] == pytest.approx(0.05**-2)
    assert schedule.R[8, 8] == pytest.approx(4.0)
    assert np.diag(schedule.Qf)[:4].tolist() == [9.0, 9.0, 9.0, 0.0]
    assert schedule.trajectory(robot).residual.max() < 1e-8
    assert "weights: q_b, tau_m as given, the others from" in out
    assert not schedule.verified  # as the csv is not


def test_what_is_no_motion_is_said_and_what_is_no_trajectory_refused(flown):
    folder = flown[0]
    given = ("planar_detumble", "--trajectory", folder / "flown.csv")
    code, out, _ = run("check", *given, "--hold", "previous")
    assert code == 0
    assert "with u and v in frame world they hold to" in " ".join(out.split())
    assert "give either" in refused("linearize", *given, "--joint", "joint_1=0.2")
    assert "give either" in refused("check", *given, "--rpy", "1", "0", "0")
    assert "leave it out" in refused("tvlqr", *given, "--reduce")
    assert "no column named 'q_m.joint_4'" in refused(
        "linearize", "ets_vii", "--trajectory", folder / "flown.csv"
    )
    assert "cannot be read" in refused("tvlqr", "planar_detumble", "--trajectory", "nosuch.csv")
    assert "expected a part of" in refused("tvlqr", *given, "--frame", "world", "--dt", "0.3")
