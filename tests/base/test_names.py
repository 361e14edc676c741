"""Names, groups and patterns mean the same wherever something is named."""

import re

import numpy as np
import pytest

import fflin
from fflin.base.names import by_name, chosen, matching, runs

NAMES = (
    "q_b.x",
    "q_m.hinge_1",
    "q_m.hinge_2",
    "q_m.arm[1]",
    "qdot_m.hinge_1",
    "tau_m.boom.2",
)


@pytest.mark.parametrize(
    ("key", "result"),
    [
        ("q_m.hinge_2", [2]),
        ("q_m", [1, 2, 3]),
        ("q_m.hinge_*", [1, 2]),
        ("hinge_2", [2]),
        ("hinge_?", None),  # of q_m and of qdot_m
        ("*hinge_?", [1, 2, 4]),
        ("*.x", [0]),
        ("arm[1]", [3]),
        ("boom.2", [5]),
        ("boom.*", [5]),
        ("*", [0, 1, 2, 3, 4, 5]),
    ],
)
def test_keys_of_robot_files_have_their_documented_meaning(key, result):
    if result is None:
        with pytest.raises(fflin.InputError, match=r"q_m\.hinge_"):
            matching("state", key, NAMES)
    else:
        assert matching("state", key, NAMES) == result


@pytest.mark.parametrize("key", ["hinge_9", "q_n", "q_m.hinge_9*", "q_m.", ""])
def test_a_key_that_stands_for_nothing_is_refused(key):
    with pytest.raises(fflin.UnknownNameError, match=re.escape(f"'{key}'")):
        matching("state", key, NAMES)


def test_a_name_goes_before_a_pattern_and_that_before_a_group():
    values = {"q_m.hinge_1": 3, "q_m.hinge_*": 2, "q_m": 1}
    for order in (values, dict(reversed(values.items()))):
        assert by_name("state", order, NAMES) == {1: 3, 2: 2, 3: 1}
    # So does an entry that stands for itself.
    for values in (
        {"arm[1]": 3, "q_m": 1},
        {"q_m": 1, "arm[1]": 3},
        {"arm*": 2, "arm[1]": 3},
    ):
        assert by_name("state", values, NAMES)[3] == 3
    assert chosen("state", ["qdot_m", "q_m.hinge_*", "q_m.hinge_1"], NAMES) == [1, 2, 4]


def test_robots_take_patterns_of_joints():
    robot = fflin.load("canadarm2", lock={"joint_?": 0.1, "joint_7": None})
    assert robot.n == 0
    assert robot.locked[-2:] == ("joint_6=0.1", "joint_7=0.0")
    robot = fflin.load(
        "canadarm2", stiffness={"q_m": 1.0, "joint_3": 3.0}, rest={"joint_*": 0.2}
    )
    assert robot.stiffness == {
        f"joint_{i}": 3.0 if i == 3 else 1.0 for i in range(1, 8)
    }
    assert set(robot.rest.values()) == {0.2}
    with pytest.raises(fflin.UnknownNameError, match="joint_9"):
        robot.replace(damping={"joint_9*": 1.0})


def test_wheels_are_not_joints_of_a_pattern():
    robot = fflin.load("cubesat").replace(
        inputs=[fflin.ReactionWheel((0, 0, 1), inertia=1e-5, name="spin")]
    )
    with pytest.raises(fflin.UnknownNameError):
        robot.replace(damping={"sp*": 1.0})


def test_weights_and_limits_take_the_same_patterns():
    robot = fflin.load("canadarm2")
    lin = fflin.linearize(robot)
    wanted = fflin.bryson(lin, {"q_m": 0.1, "q_b": 1.0})
    assert np.array_equal(fflin.bryson(lin, {"q_m.joint_*": 0.1, "q_b.?": 1.0}), wanted)
    wanted = fflin.bryson(lin, {"tau_b": 2.0, "tau_m": 2.0, "F_b": 1.0})
    assert np.array_equal(fflin.bryson(lin, {"tau_?.*": 2.0, "F_b": 1.0}), wanted)
    K = fflin.lqr(lin, {"?_?.*": 1.0, "q_m.joint_1": 2.0}, {"*": 1.0}).K
    assert np.array_equal(
        K,
        fflin.lqr(
            lin, {"q_b": 1, "r_b": 1, "v_b": 1, "q_m": 1, "q_m.joint_1": 2}, 1.0
        ).K,
    )
    run = {"x0": np.r_[0.1, np.zeros(25)], "duration": 0.5}
    policy = fflin.StateFeedback(lin, K)
    one = fflin.simulate(robot, policy, limits={"joint_*": 0.01, "tau_b": 0.02}, **run)
    two = fflin.simulate(robot, policy, limits={"tau_m": 0.01, "tau_b.?": 0.02}, **run)
    assert np.array_equal(one.u, two.u)
    assert np.abs(one.u[:, 6:]).max() == 0.01
    with pytest.raises(fflin.InputError, match="inputs"):
        fflin.bryson(lin, {"*.x": 1.0})


def test_thrusters_and_wheels_have_groups_too():
    robot = fflin.load("cubesat").replace(
        inputs=[
            fflin.Thruster("base", (0.1, 0, 0), (0, 0, 1), name="nozzle"),
            fflin.Thruster("base", (0, 0.1, 0), (0, 0, 1), name="tau_m_like"),
            fflin.ReactionWheel((0, 0, 1), name="spin"),
            fflin.BaseTorque(),
            fflin.BaseForce(),
        ]
    )
    lin = fflin.linearize(robot)
    wanted = fflin.bryson(
        lin, {"nozzle": 2.0, "tau_m_like": 2.0, "spin": 3.0, "tau_b": 1.0, "F_b": 1.0}
    )
    named = {"thrust": 2.0, "wheel.sp*": 3.0, "tau_b": 1.0, "F_b.*": 1.0}
    assert np.array_equal(fflin.bryson(lin, named), wanted)
    assert np.array_equal(wanted[:3] ** -0.5, [2.0, 2.0, 3.0])
    motion = fflin.simulate(
        robot,
        lambda *_: np.full(9, 5.0),
        duration=0.02,
        limits={"thrust": 1.0, "wheel": 2.0},
    )
    assert motion.u[0, :3].tolist() == [1.0, 1.0, 2.0]


def test_runs_are_of_one_group_or_of_one_unit():
    names = (
        "q_b.x",
        "q_b.y",
        "q_m.a",
        "q_m.b",
        "up",
        "down",
        "turn",
        "tool.pose.x",
        "tool.pose.y",
    )
    units = ("1", "1", "rad", "m", "N", "N", "N m", "m", "m")
    assert runs(names, units) == [
        (0, 1, "q_b", "1"),
        (2, 3, "q_m", "rad|m"),
        (4, 5, "", "N"),
        (6, 6, "", "N m"),
        (7, 8, "tool.pose", "m"),
    ]
