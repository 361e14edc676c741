"""The commands along a trajectory, from files that other programs wrote."""

import csv

import numpy as np
import pinocchio as pin
import pytest
from scipy.io import savemat

import fflin
from tests.support.commands import refused, run
from tests.support.messages import says


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    """A motion under held inputs on the base in world axes: as .csv, by hand, and as .mat."""
    folder = tmp_path_factory.mktemp("tracking")
    robot = fflin.load("planar_detumble")
    u = (
        np.random.default_rng(2).normal(size=(4, 9))
        * np.r_[np.ones(6), 0.02 * np.ones(3)]
    )
    motion = fflin.simulate(
        *(robot, lambda t, q, v: u[min(int(t / 0.5 + 1e-9), 3)]),
        v0=fflin.velocity(robot, {"omega_b.z": 0.3, "joint_1": 0.2}),
        **{"duration": 2.0, "dt": 0.01, "sample": 0.5, "every": 10, "frame": "world"},
    )
    names = ["t", *motion.state_names, *motion.input_names]
    with (folder / "flown.csv").open("w", newline="") as file:
        rows = np.column_stack((motion.t, motion.x, motion.u)).tolist()
        csv.writer(file).writerows([names, *rows[:-1], [*rows[-1][:19], *[""] * 9]])
    arrays = {
        "t": motion.t,
        "x": motion.x,
        "u": motion.u,
        "frame": "world",
        "hold": "previous",
    }
    savemat(folder / "flown.mat", arrays)
    return folder, robot, motion.trajectory()


@pytest.mark.exhaustive
def test_the_chain_goes_from_a_file_to_gains(flown):
    folder, robot, motion = flown
    given = (
        "planar_detumble",
        "--trajectory",
        folder / "flown.csv",
        "--frame",
        "world",
    )
    code, out, err = run("linearize", *given, "-o", folder / "ltv.npz")
    assert (code, err) == (0, "")
    assert says(out, "21 knots, 0 to 2 s", "'world'")
    assert "residual " in out
    along = fflin.LinearTrajectory.load(folder / "ltv.npz", robot)
    expected = fflin.linearize_trajectory(robot, motion)
    assert along.A == pytest.approx(expected.A, abs=1e-12 * np.abs(expected.A).max())
    assert along.residual.max() < 1e-8
    mat = ("planar_detumble", "--trajectory", folder / "flown.mat")
    code, out, _ = run("linearize", *mat, "--dt", "0.1", "-o", folder / "sampled.npz")
    assert code == 0
    assert fflin.LinearTrajectory.load(folder / "sampled.npz", robot).dt == 0.1

    code, out, err = run("check", *mat, "--plot", folder / "check.png")
    assert (code, err) == (0, "")
    assert (folder / "check.png").stat().st_size
    assert "A and B of planar_detumble: verified" in out

    weights = ("--bryson", "q_b=0.05", "--bryson", "tau_m=0.5", "--qf", "q_b=9")
    code, out, err = run(
        "tvlqr", *given, *weights, "--sample", "0.1", "-o", folder / "gains.npz"
    )
    assert (code, err) == (0, "")
    schedule = fflin.GainSchedule.load(folder / "gains.npz")
    assert schedule.dt == 0.1
    assert schedule.Q[0, 0] == pytest.approx(0.05**-2)
    assert schedule.R[8, 8] == pytest.approx(4.0)
    assert np.diag(schedule.Qf)[:4].tolist() == [9.0, 9.0, 9.0, 0.0]
    assert schedule.trajectory(robot).residual.max() < 1e-8
    assert says(out, "q_b, tau_m")
    assert not schedule.verified  # as the csv is not


def test_an_inconsistent_motion_is_reported_and_an_invalid_trajectory_is_refused(flown):
    folder = flown[0]
    given = ("planar_detumble", "--trajectory", folder / "flown.csv")
    code, out, _ = run("check", *given, "--hold", "previous")
    assert code == 0
    assert says(out, "usual causes")
    assert "--joint" in refused("linearize", *given, "--joint", "joint_1=0.2")
    assert "--rpy" in refused("check", *given, "--rpy", "1", "0", "0")
    assert "--plot" in refused("linearize", *given, "--plot", folder / "none.png")
    assert not (folder / "none.png").exists()
    assert "--reduce" in refused("tvlqr", *given, "--reduce")
    assert "'q_m.joint_4'" in refused(
        "linearize", "ets_vii", "--trajectory", folder / "flown.csv"
    )
    assert "nosuch.csv" in refused(
        "tvlqr", "planar_detumble", "--trajectory", "nosuch.csv"
    )
    assert "0.3 s" in refused("tvlqr", *given, "--frame", "world", "--sample", "0.3")


def chain(folder, *options, file="flown.csv"):
    given = (
        "--trajectory",
        folder / file,
        *(("--frame", "world") * (file == "flown.csv")),
    )
    return run("simulate", "planar_detumble", *given, *options, cwd=folder)


OFFSET = ("--offset", "yaw=1", "--offset", "q_m=0.05", "--offset", "omega_b.z=0.05")


@pytest.mark.exhaustive
def test_a_trajectory_is_followed_from_next_to_it_to_files(flown):
    folder, robot, motion = flown
    code, out, err = chain(
        folder,
        *OFFSET,
        "--bryson",
        "q_b=0.02",
        "--bryson",
        "q_m=0.05",
        "--limit",
        "tau_m=0.5",
        "--html",
        "a.html",
        "--plot",
        "a.png",
        "-o",
        "a.npz",
    )
    assert (code, err) == (0, "")
    assert says(out, "attitude")
    assert all(
        (folder / name).stat().st_size > 10_000 for name in ("a.html", "a.png", "a.npz")
    )
    run_ = fflin.Motion.load(folder / "a.npz")
    assert run_.tracked
    assert run_.t[-1] == 2.0
    # As the schedule in its file does, and as Python does.
    weights = ("--bryson", "q_b=0.02", "--bryson", "q_m=0.05", "-o", "gains.npz")
    given = ("--trajectory", folder / "flown.csv", "--frame", "world")
    assert run("tvlqr", "planar_detumble", *given, *weights, cwd=folder)[0] == 0
    alone = ("--schedule", "gains.npz", *OFFSET, "--limit", "tau_m=0.5", "-o", "c.npz")
    assert run("simulate", "planar_detumble", *alone, cwd=folder)[0] == 0
    np.testing.assert_allclose(
        fflin.Motion.load(folder / "c.npz").x, run_.x, atol=1e-12
    )
    # The start is where it was asked to be.
    state = fflin.StateMap(
        robot, reference=pin.XYZQUATToSE3(motion.q[0, :7]), frame="local"
    )
    expected_value, point = (
        state.to_state(item.q[0], item.v[0]) for item in (motion, run_)
    )
    e = np.zeros(18)
    e[2], e[6:9], e[11] = np.sin(np.radians(0.5)), 0.05, 0.05
    np.testing.assert_allclose(point - expected_value, e, atol=1e-12)


def test_an_offset_may_be_more_than_half_a_turn(flown):
    folder, _, motion = flown
    assert (
        chain(folder, "--offset", "yaw=200", "--duration", 0.01, "-o", "turned.npz")[0]
        == 0
    )
    q = fflin.Motion.load(folder / "turned.npz").q[0], motion.q[0]
    point, expected_value = (pin.XYZQUATToSE3(item[:7]).rotation for item in q)
    np.testing.assert_allclose(
        expected_value.T @ point, pin.rpy.rpyToMatrix(0, 0, np.radians(200)), atol=1e-9
    )


@pytest.mark.exhaustive
def test_a_sampled_trajectory_of_a_mat_file_is_followed_past_its_end(flown):
    folder = flown[0]
    code, _, err = chain(
        folder,
        "--sample",
        0.1,
        "--offset",
        "yaw=1",
        "--duration",
        60,
        "-o",
        "d.npz",
        file="flown.mat",
    )
    assert (code, err) == (0, "")
    motion = fflin.Motion.load(folder / "d.npz")
    assert motion.t[-1] == 60.0
    held = motion.u[:-1].reshape(-1, 10, 9)
    np.testing.assert_array_equal(held, np.repeat(held[:, :1], 10, axis=1))
    assert motion.attitude_error[-1] < 0.05 < motion.attitude_error.max()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--free",), "--free"),
        (("--target-joint", "joint_1=1"), "--target-joint"),
        (("--rpy", 1, 0, 0), "--rpy"),
        (("--offset", "yaw=1", "--offset", "q_b.x=0.1"), "q_b"),
        (("--offset", "q_b=0.8"), "1.39"),
        (("--offset", "jaw=1"), "'jaw'"),
        (("--schedule", "other.npz"), "remove --trajectory"),
        (("--integral", "q_b"), "no integral action"),
        (("--schedule", "other.npz", "--q", "q_b=1"), "remove --trajectory, --q"),
        (("--allocate",), "thrusters"),
    ],
)
def test_arguments_that_a_trajectory_defines_are_refused(flown, options, message):
    folder, robot, motion = flown
    if not (folder / "other.npz").exists():
        along = fflin.linearize_trajectory(robot, motion.resampled(0.5))
        fflin.tvlqr(along).save(folder / "other.npz")
    given = ("--trajectory", folder / "flown.mat")
    assert message in refused(
        "simulate", "planar_detumble", *given, *options, cwd=folder
    )


def test_the_table_of_a_motion_is_not_a_trajectory(flown):
    folder, robot, _ = flown
    fflin.simulate(robot, duration=0.1, dt=0.05).save(folder / "table.csv")
    given = ("--trajectory", folder / "table.csv")
    assert "save motion.trajectory()" in refused("simulate", "planar_detumble", *given)


def test_gains_of_another_robot_are_refused(flown):
    folder, robot, motion = flown
    fflin.tvlqr(fflin.linearize_trajectory(robot, motion)).save(folder / "own.npz")
    message = refused("simulate", "ets_vii", "--schedule", "own.npz", cwd=folder)
    assert says(message, "'planar_detumble'", "'ets_vii'")
    assert "--trajectory" in refused("simulate", "ets_vii", "--offset", "yaw=1")


@pytest.mark.parametrize("options", [(), ("--sample", "0.1")])
def test_a_gain_from_a_file_regulates_as_the_one_that_is_designed(tmp_path, options):
    lqr = (
        "lqr",
        "ets_vii",
        "--joint",
        "joint_1=0.5",
        "--weights",
        "identity",
        *options,
    )
    assert run(*lqr, "-o", "gain.npz", cwd=tmp_path)[0] == 0
    start = ("simulate", "ets_vii", "--rpy", 5, 0, 0, "--duration", 2, "-o")
    designed = ("--target-joint", "joint_1=0.5", "--weights", "identity", *options)
    assert run(*start, "a.npz", *designed, cwd=tmp_path)[0] == 0
    code, _, err = run(*start, "b.npz", "--gain", "gain.npz", cwd=tmp_path)
    assert (code, "gain" in err) == (0, False)
    a, b = (fflin.Motion.load(tmp_path / name) for name in ("a.npz", "b.npz"))
    np.testing.assert_allclose(b.x, a.x, atol=1e-9)
    np.testing.assert_allclose(b.linear, a.linear, atol=1e-9)
    message = refused(
        *start, "c.npz", "--gain", "gain.npz", "--q", "q_b=1", cwd=tmp_path
    )
    assert "--gain" in message
    other = refused("simulate", "canadarm2", "--gain", "gain.npz", cwd=tmp_path)
    assert says(other, "gain.npz", "'ets_vii'", "'canadarm2'")


def test_a_gain_about_the_world_feeds_back_the_state_that_it_was_designed_for(tmp_path):
    """Its columns belong to an attitude and a position from the world, not from its own point."""
    world = ("--reference", "world", "--weights", "identity", "-o", "gain.npz")
    pose = ("--rpy", 40, 30, 20, "--position", 1, 2, 3)
    assert run("lqr", "cubesat", *pose, *world, cwd=tmp_path)[0] == 0
    start = ("--rpy", 55, 20, 20, "--position", 1.1, 2, 3)
    run(
        "simulate",
        "cubesat",
        *start,
        "--gain",
        "gain.npz",
        "--duration",
        1,
        "-o",
        "m.npz",
        cwd=tmp_path,
    )
    gain, motion = (
        fflin.Gain.load(tmp_path / "gain.npz"),
        fflin.Motion.load(tmp_path / "m.npz"),
    )
    state = fflin.StateMap(fflin.load("cubesat"))
    x = state.to_state(motion.q[0], motion.v[0])
    np.testing.assert_allclose(
        motion.u[0], gain.u0 - gain.K @ (x - gain.x0), rtol=1e-9, atol=1e-12
    )


def test_gains_of_thrusters_say_that_nothing_is_allocated(tmp_path):
    thruster = '[[input]]\ntype = "thruster"\nframe = "base"\nposition = [0.1, 0, 0]\n'
    base = '[[input]]\ntype = "base_torque"\n[[input]]\ntype = "base_force"\n'
    message = []
    for name, text in (
        ("with", base + thruster + "direction = [0, 1, 0]\n"),
        ("without", base),
    ):
        (tmp_path / f"{name}.toml").write_text(text)
        given = ("cubesat", "--inputs", f"{name}.toml")
        options = ("--duration", "5", "--knots", "6", "-o", f"{name}.npz")
        assert run("plan", *given, *options, cwd=tmp_path)[0] == 0
        code, out, _ = run("tvlqr", *given, "--trajectory", f"{name}.npz", cwd=tmp_path)
        assert code == 0
        message.append("no allocation" in out)
    assert message == [True, False]
