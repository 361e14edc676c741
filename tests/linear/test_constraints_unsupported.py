"""Functions that do not support constraints refuse a robot with constraints."""

import numpy as np
import pinocchio as pin
import pytest

import fflin


@pytest.fixture(scope="module")
def robot():
    return fflin.load(
        "dual_arm", constraints=[fflin.Weld("tool_left", "tool_right", name="grasp")]
    )


@pytest.fixture(scope="module")
def lin(robot):
    return fflin.linearize(robot)


PAYLOAD = pin.Inertia(1.0, np.zeros(3), np.eye(3))
CALLS = {
    "capture": lambda robot, _: fflin.capture(robot, "tool_left", PAYLOAD),
    "capture of a payload": lambda robot, _: fflin.capture(
        fflin.load("planar_detumble"), "hand", robot
    ),
    "from_tool": lambda robot, lin: fflin.from_tool(robot, "drake", lin.q),
    "generalized_jacobian": lambda robot, _: fflin.generalized_jacobian(
        robot, frame="tool_left"
    ),
    "jam": lambda robot, _: fflin.jam(robot, "left_1"),
    "linearize_orbit": lambda robot, _: fflin.linearize_orbit(
        robot.replace(orbit=500e3)
    ),
    "relative_equilibria": lambda robot, _: fflin.relative_equilibria(robot),
    "sensitivity": lambda _, lin: fflin.sensitivity(lin),
    "to": lambda _, lin: lin.to("mujoco"),
    "gain.to": lambda _, lin: fflin.lqr(lin).to("drake"),
    "transform": lambda robot, lin: fflin.transform(robot, lin, "pinocchio"),
    "uncertain": lambda robot, _: fflin.uncertain(robot, {"base.mass": 0.1}),
}


@pytest.mark.parametrize("name", CALLS)
def test_a_function_without_support_names_the_constraints(name, robot, lin):
    with pytest.raises(fflin.InputError, match=r"not support constraints.*grasp"):
        CALLS[name](robot, lin)


def test_a_gain_in_a_file_needs_the_linear_model(robot, lin, tmp_path):
    gain = fflin.lqr(lin)
    gain.save(tmp_path / "gain.npz")
    loaded = fflin.Gain.load(tmp_path / "gain.npz")
    with pytest.raises(
        fflin.InputError, match=r"constraints.*StateFeedback\(lin, gain\)"
    ):
        fflin.write_c(loaded, tmp_path / "code", robot=robot)
    policy = fflin.StateFeedback(lin, loaded)
    np.testing.assert_array_equal(policy.feedback_gain, gain.K)
