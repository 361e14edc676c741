"""Joint angles and rates that look like degrees are named in a warning; others are not."""

import math
import warnings

import numpy as np
import pytest

import fflin
from fflin.base.validation import looks_like_degrees
from fflin.robot.fields import warn_of_degrees
from tests.support.commands import run, warned
from tests.support.robots import BUNDLED

LOOKS = "look like degrees"


@pytest.fixture(scope="module")
def arm():
    return fflin.load("servicer_7dof")


@pytest.mark.parametrize(
    ("value", "limits", "expected"),
    [
        (30.0, (-2.0, 2.0), True),
        (-30.0, (-2.0, 2.0), True),
        (6.0, (-2.0, 2.0), False),  # less than one rotation
        (30.0, (-40.0, 40.0), False),  # within the limits
        (30.0, (-math.inf, math.inf), False),
        (math.inf, (-2.0, 2.0), False),
        (360.0, (-2.0, 2.0), True),
        (361.0, (-2.0, 2.0), False),  # more than one rotation in degrees, too
        (1000.0, (-2.0, 2.0), False),  # a weight or limit that stands for any value
        (720.0, (-13.0, 13.0), True),
    ],
)
def test_an_angle_beyond_one_rotation_and_its_limits_looks_like_degrees(
    value, limits, expected
):
    assert looks_like_degrees(value, *limits) is expected


def test_one_warning_names_all_values_and_states_radians(arm):
    values = {"q_m.joint_1": 30.0, "qdot_m.joint_2": -45.0, "q_m.joint_3": 1.0}
    with pytest.warns(fflin.FflinWarning) as caught:
        warn_of_degrees(arm, values)
    (message,) = [str(one.message) for one in caught]
    assert "q_m.joint_1 = 30, qdot_m.joint_2 = -45;" in message
    assert "0.524 for 30 deg" in message


def test_wheels_sliding_joints_and_the_base_are_never_suspected():
    wheel = fflin.ReactionWheel((0, 0, 1), inertia=1e-5)
    robot = fflin.load("cubesat", inputs=[fflin.BaseTorque(), wheel])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_of_degrees(robot, {"q_m.wheel_1": 300.0, "qdot_m.wheel_1": 300.0})
        warn_of_degrees(robot, {"r_b.x": 300.0, "omega_b.x": 300.0})


def test_a_continuous_joint_may_have_any_angle():
    robot = fflin.load("kinova")
    joint = next(joint for joint in robot.joints if joint.unbounded)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_of_degrees(robot, {f"q_m.{joint.name}": 30.0})


def displaced(arm, angle):
    """Return the neutral configuration with joint_1 at an angle [rad]."""
    q = arm.neutral()
    q[arm.joint("joint_1").idx_q] = angle
    return q


def uses(arm):
    """Return {where joint angles are given: call with a factor on an angle of 0.5 rad}."""
    lin = fflin.linearize(arm)
    t = np.linspace(0.0, 1.0, 3)
    rest = fflin.Trajectory(
        arm, t, np.tile(arm.neutral(), (3, 1)), np.zeros((3, arm.nv)), np.zeros((3, 15))
    )
    feedback = fflin.TrajectoryFeedback(
        rest, fflin.tvlqr(fflin.linearize_trajectory(arm, rest))
    )
    gain = fflin.lqr(lin)
    law = fflin.StateFeedback(lin, gain.K)
    return {
        "grid": lambda x: fflin.grid(arm, {"joint_1": [0.0, x]}),
        "range": lambda x: fflin.random_configurations(
            arm, 2, ranges={"joint_1": (0.0, x)}
        ),
        "rate": lambda x: fflin.velocity(arm, {"joint_1": x}),
        "bryson": lambda x: fflin.bryson(lin, {"q_m.joint_1": x}),
        "weights": lambda x: arm.replace(weights={"bryson": {"q_m": x}}),
        "limits": lambda x: arm.replace(limits={"q_m.joint_1": x}),
        "q0": lambda x: fflin.simulate(
            arm, q0=displaced(arm, x), duration=0.1, dt=0.05
        ),
        "offset": lambda x: feedback.beside({"q_m.joint_1": x}),
        "dispersion": lambda x: fflin.monte_carlo(
            arm, law, {"q_m.joint_1": x}, runs=1, duration=0.5, dt=0.1
        ),
    }


@pytest.mark.parametrize(
    "use",
    [
        "grid",
        "range",
        "rate",
        "bryson",
        "weights",
        "limits",
        "q0",
        "offset",
        "dispersion",
    ],
)
def test_degrees_are_suspected_wherever_joint_values_are_given(arm, use):
    call = uses(arm)[use]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        call(0.1)
    assert not [one for one in caught if LOOKS in str(one.message)]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        call(30.0)
    messages = [str(one.message) for one in caught if LOOKS in str(one.message)]
    assert len({*messages}) == 1 and "0.524 for 30 deg" in messages[0]


def test_a_configuration_in_degrees_gets_the_angle_in_radians(arm):
    with pytest.warns(fflin.FflinWarning, match=r"joint_1. at 30 \(deg\?\) is outside"):
        fflin.configuration(arm, {"joint_1": 30.0})
    with pytest.warns(fflin.FflinWarning) as caught:
        fflin.configuration(arm, {"joint_1": 3.1})
    assert "deg?" not in str(caught[0].message)


def test_a_largest_value_without_meaning_raises_no_suspicion(arm):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Q = fflin.bryson(fflin.linearize(arm), {"q_m.joint_1": 1000.0})
    assert Q.max() == pytest.approx(1e-6, rel=1e-12)


def test_commands_warn_once():
    messages = warned("lqr", "servicer_7dof", "--bryson", "q_m.joint_1=30")
    assert len([one for one in messages if LOOKS in one]) == 1


@pytest.mark.parametrize(
    "name",
    BUNDLED,
)
def test_bundled_robots_within_their_limits_raise_no_suspicion(name):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        robot = fflin.load(name)
        fflin.random_configurations(robot, 3)
        limits = {f"q_m.{joint}": 3.0 for joint in robot.joint_names}
        robot.replace(limits=limits, weights={"bryson": {"r_b": 10.0, "omega_b": 10.0}})
    assert not [one for one in caught if LOOKS in str(one.message)]
    assert run("info", name)[0] == 0
