"""Frames of a model by name."""

import pinocchio as pin

from fflin.base.errors import unknown

ROOT = 1  # index of the free-flyer among Pinocchio's joints; 0 is the universe


def find_frame(model: pin.Model, name: str) -> tuple[int, pin.SE3]:
    """Return the joint that carries a frame and its placement there.

    Of frames that share the name, a link's comes first.

    Raises
    ------
    UnknownNameError
        If there is none on the robot.
    """
    frames = [frame for frame in model.frames.tolist() if frame.parentJoint >= ROOT]
    found = [frame for frame in frames if frame.name == name]
    if not found:
        raise unknown("frame", str(name), [frame.name for frame in frames])
    frame = next((frame for frame in found if frame.type == pin.FrameType.BODY), found[0])
    return frame.parentJoint, pin.SE3(frame.placement)
