"""Frames of a model by name."""

import pinocchio as pin

from fflin.base.errors import unknown

ROOT = 1  # index of the free-flyer among Pinocchio's joints; 0 is the universe


def frame_index(model: pin.Model, name: str) -> int:
    """Return the index of a frame.

    Of frames that share the name, a link's comes first. Pinocchio's own look-up refuses a name
    that a link and a joint share, and takes a link called universe for the world.

    Raises
    ------
    UnknownNameError
        If there is none on the robot.
    """
    frames = {i: f for i, f in enumerate(model.frames.tolist()) if f.parentJoint >= ROOT}
    # The comparison with an array would be one.
    found = [i for i, f in frames.items() if isinstance(name, str) and f.name == name]
    if not found:
        raise unknown("frame", str(name), [frame.name for frame in frames.values()])
    return next((i for i in found if frames[i].type == pin.FrameType.BODY), found[0])


def find_frame(model: pin.Model, name: str) -> tuple[int, pin.SE3]:
    """Return the joint that carries a frame, see `frame_index`, and its placement there."""
    frame = model.frames[frame_index(model, name)]
    return frame.parentJoint, pin.SE3(frame.placement)
