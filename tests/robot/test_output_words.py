"""Outputs as they are written on a command line."""

import pytest

import fflin
from fflin.robot.outputs import parse_output

SPECS = {
    "state": (fflin.FullState(),),
    "base": (fflin.BasePose(),),
    "joints": (fflin.JointPositions(),),
    "rates": (fflin.JointVelocities(),),
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


def test_mistakes_say_what_to_write():
    for text in ("frame", "frame:"):
        with pytest.raises(fflin.InputError, match="is of no frame; write frame:NAME"):
            parse_output(text)
    for text in ("relative", "relative:tool", "relative::base", "relative:tool:"):
        with pytest.raises(fflin.InputError, match="fewer than two frames; write relative:NAME:TO"):
            parse_output(text)
    with pytest.raises(fflin.InputError, match="'base:tool' is of the whole robot; write base"):
        parse_output("base:tool")
    with pytest.raises(fflin.UnknownNameError, match="'momentm'; did you mean momentum"):
        parse_output("momentm")
    with pytest.raises(fflin.UnknownNameError, match="there are: state, base, joints"):
        parse_output("")
