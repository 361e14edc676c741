"""Saved gains of robots with constraints: simulated again, and as C code."""

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.control.gain import model_of
from tests.simulation.test_constraints import GRIP, JOINTS
from tests.support.c_code import COMPILERS, needs_compiler, outcome
from tests.support.commands import refused, run

WELD = ("--weld", "tool_left=tool_right")
BENT = ("--joint", "left_2=0.7", "--joint", "right_2=-0.6")
FLIGHT = ("--duration", "0.5", "--dt", "0.1", "--engine", "python")


def arms(*constraints):
    """Return a dual arm with constraints, and a q whose base is displaced."""
    robot = fflin.load("dual_arm").replace(constraints=constraints)
    pose = pin.SE3(pin.rpy.rpyToMatrix(0.1, 0.2, -0.3), np.array([0.1, 0.2, 0.3]))
    return robot, fflin.configuration(robot, JOINTS, pose)


def reloaded(gain, folder):
    gain.save(folder / "gain.json")
    return fflin.Gain.load(folder / "gain.json")


@pytest.mark.parametrize("dt", [0.0, 0.1], ids=["continuous", "sampled"])
def test_a_saved_gain_has_the_same_model(dt, tmp_path):
    robot, q = arms(GRIP)
    lin = fflin.linearize(robot, q)
    if dt:
        lin = lin.discretize(dt)
    gain = reloaded(fflin.lqr(lin), tmp_path)
    assert gain.dependent == lin.dependent and len(gain.dependent) == 12
    assert np.abs(gain.dependent_x0).max() > 0.1
    # The constraint of the other robot has no placement yet.
    again, _ = arms(fflin.Weld("tool_left", "tool_right"))
    model = model_of(gain, again, "the gain was made", lin.reference)
    model = model.discretize(dt) if dt else model
    assert model.state_names == lin.state_names
    for name in ("A", "B", "x0", "u0", "q"):
        expected = getattr(lin, name)
        np.testing.assert_allclose(getattr(model, name), expected, atol=1e-12)


def test_a_gain_with_integrals_and_coordinates_that_the_user_chose_is_saved(tmp_path):
    robot, q = arms(GRIP)
    lin = fflin.linearize(robot, q, independent=["q_b", "r_b", "left_1", "right_2"])
    gain = reloaded(fflin.lqr(lin, integral_action=["q_b"]), tmp_path)
    again, _ = arms(GRIP)
    model = model_of(gain, again, "the gain was made", lin.reference)
    assert model.state_names == lin.state_names
    policy = fflin.StateFeedback(model, gain)
    assert policy.integrals == gain.integrals and len(policy.integrals) == 3


def test_gains_with_and_without_constraints_are_told_apart(tmp_path):
    robot, q = arms(GRIP)
    free, _ = arms()
    held = reloaded(fflin.lqr(fflin.linearize(robot, q)), tmp_path)
    with pytest.raises(fflin.InputError, match="has no constraints"):
        model_of(held, free, "the gain was made", pin.SE3.Identity())
    loose = reloaded(fflin.lqr(fflin.linearize(free, q)), tmp_path)
    with pytest.raises(fflin.InputError, match="fewer independent states"):
        model_of(loose, robot, "the gain was made", pin.SE3.Identity())


@pytest.mark.parametrize(
    "other", [fflin.Hinge("tool_left", "tool_right"), fflin.Weld("base")]
)
def test_a_gain_of_other_constraints_is_refused(other, tmp_path):
    robot, q = arms(GRIP)
    lin = fflin.linearize(robot, q)
    gain = reloaded(fflin.lqr(lin), tmp_path)
    with pytest.raises(fflin.InputError, match="the constraints of the gain"):
        model_of(gain, arms(other)[0], "the gain was made", lin.reference)


@needs_compiler
def test_c_code_of_a_saved_gain_flies_like_the_policy(tmp_path):
    robot, q = arms(GRIP)
    lin = fflin.linearize(robot, q).discretize(0.1)
    gain = fflin.lqr(lin)
    folder = fflin.write_c(reloaded(gain, tmp_path), tmp_path / "c", robot=robot)
    code, message = outcome(folder, COMPILERS[0])
    assert (code, message) == (0, "all cases agree, 0 differences\n")
    header = (folder / "controller.h").read_text()
    comment = header[header.index("Constraints of the robot") :]
    comment = comment[: comment.index("Sample time")]
    assert all(name in comment for name in lin.dependent)
    assert lin.state_names[0] not in comment
    start = q.copy()
    start[:3] += 0.02
    known = {"q0": start, "duration": 0.5, "dt": 0.1, "engine": "python"}
    motions = [
        fflin.simulate(robot, law, **known)
        for law in (fflin.StateFeedback(lin, gain.K), fflin.CLaw(folder))
    ]
    np.testing.assert_allclose(motions[1].u, motions[0].u, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(motions[1].x, motions[0].x, rtol=0.0, atol=1e-12)
    assert np.abs(motions[0].u).max() > 1e-3


def test_a_gain_of_a_welded_robot_is_simulated_from_its_file(tmp_path):
    gain, both = tmp_path / "gain.npz", (tmp_path / "one.npz", tmp_path / "two.npz")
    given = ("dual_arm", *WELD, *BENT)
    assert run("lqr", *given, "-o", gain)[0] == 0
    at = ("--rpy", "0", "3", "0")
    target = ("--target-joint", "left_2=0.7", "--target-joint", "right_2=-0.6")
    assert run("simulate", *given, *at, *target, *FLIGHT, "-o", both[0])[0] == 0
    options = (*at, *FLIGHT, "--gain", gain)
    assert run("simulate", *given, *options, "-o", both[1])[0] == 0
    one, two = map(fflin.Motion.load, both)
    np.testing.assert_allclose(two.u, one.u, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(two.x, one.x, rtol=0.0, atol=1e-12)
    assert np.abs(one.u).max() > 1e-3
    pose = ("--gain", gain, "--target-rpy", "0", "0", "1", *FLIGHT)
    assert "already contains the pose" in refused("simulate", *given, *pose)


@needs_compiler
@pytest.mark.exhaustive
def test_a_gain_of_a_welded_robot_is_exported_with_its_weld(tmp_path):
    gain = tmp_path / "gain.npz"
    assert run("lqr", "dual_arm", *WELD, *BENT, "-o", gain)[0] == 0
    assert run("export", gain, *WELD, "-o", tmp_path / "c")[0] == 0
    assert outcome(tmp_path / "c", COMPILERS[0])[0] == 0
    text = refused("export", gain, "--robot", "dual_arm", "-o", tmp_path / "d")
    assert "has no constraints" in text
