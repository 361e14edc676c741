"""Outputs as they are written on a command line."""

import pytest

import fflin
from fflin.robot.outputs import parse_output

SPECS = {
    "state": (fflin.FullState(),),
    "base": (fflin.BasePose(),),
    "joints": (fflin.JointPositions(),),
    "rates": (fflin.JointVelocities(),),
    "joints:hinge_*": (fflin.JointPositions(("hinge_*",)),),
    "rates:a:b": (fflin.JointVelocities(("a:b",)),),
    "com": (fflin.CenterOfMass(),),
    "momentum": (fflin.Momentum(),),
    "frame:tool": (fflin.FramePose("tool"), fflin.FrameVelocity("tool")),
    "pose:a:b": (fflin.FramePose("a:b"),),
    "velocity:tool": (fflin.FrameVelocity("tool"),),
    "relative:tool:base": (fflin.RelativePose("tool", "base"),),
    "gyroscope:tool": (fflin.Gyroscope("tool"),),
    "accelerometer:tool": (fflin.Accelerometer("tool"),),
}


@pytest.mark.parametrize(("text", "outputs"), SPECS.items())
def test_every_spec(text, outputs):
    assert parse_output(text) == outputs


def test_invalid_text_gives_an_error_with_a_valid_example():
    for text in ("frame", "frame:"):
        with pytest.raises(fflin.InputError, match="frame:NAME"):
            parse_output(text)
    for text in ("relative", "relative:tool", "relative::base", "relative:tool:"):
        with pytest.raises(fflin.InputError, match="relative:NAME:TO"):
            parse_output(text)
    with pytest.raises(fflin.InputError, match="'base:tool'"):
        parse_output("base:tool")
    with pytest.raises(fflin.UnknownNameError, match="'momentm'"):
        parse_output("momentm")
    with pytest.raises(
        fflin.UnknownNameError, match="state, base, star_tracker, joints"
    ):
        parse_output("")


def test_patterns_of_joints_are_joints_of_the_robot():
    robot = fflin.load("servicer_7dof")
    outputs = [
        fflin.JointPositions(("panel_*", "joint_3")),
        fflin.JointVelocities(("q_m",)),
    ]
    names = fflin.linearize(robot.replace(outputs=outputs)).output_names
    assert names[:3] == ("q_m.panel_left", "q_m.panel_right", "q_m.joint_3")
    assert names[3:] == tuple(f"qdot_m.{name}" for name in robot.joint_names)
    with pytest.raises(fflin.UnknownNameError, match=r"'hinge_\*'"):
        fflin.linearize(robot.replace(outputs=[fflin.JointPositions(("hinge_*",))]))
    assert (
        fflin.linearize(
            fflin.load("cubesat", outputs=[fflin.JointPositions()])
        ).C.shape[0]
        == 0
    )


def test_ranges_of_random_points_take_patterns():
    robot = fflin.load("servicer_7dof")
    drawn = fflin.random_configurations(
        robot, 5, ranges={"panel_*": (0.1, 0.1), "q_m": (0, 0)}
    )
    q = fflin.sweep(robot, drawn).q
    assert set(q[:, -2:].ravel()) == {0.1} and not q[:, 7:-2].any()
