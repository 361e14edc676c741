"""Frames of a model by name."""

from typing import NamedTuple

import pinocchio as pin

from fflin.base.errors import unknown

ROOT = 1  # index of the free-flyer among Pinocchio's joints; 0 is the universe


class Carried(NamedTuple):
    """Location of a frame: the joint that carries it, and its placement on that joint."""

    joint: int
    placement: pin.SE3


def frame_index(model: pin.Model, name: str) -> int:
    """Return the index of a frame of the robot; a link's comes before a joint's of that name."""
    # Pinocchio's own look-up refuses a name that a link and a joint share, and takes a link called
    # universe for the world.
    frames = {i: f for i, f in enumerate(model.frames.tolist()) if f.parentJoint >= ROOT}
    # The comparison with an array would be one.
    found = [i for i, f in frames.items() if isinstance(name, str) and f.name == name]
    if not found:
        raise unknown("frame", str(name), [frame.name for frame in frames.values()])
    return next((i for i in found if frames[i].type == pin.FrameType.BODY), found[0])


def find_frame(model: pin.Model, name: str | None) -> Carried:
    """Return the location of a frame, see `frame_index`; of the base's root frame for None."""
    if name is None:
        return Carried(ROOT, pin.SE3.Identity())
    frame = model.frames[frame_index(model, name)]
    return Carried(frame.parentJoint, pin.SE3(frame.placement))


def find_joint(model: pin.Model, name: str) -> Carried:
    """Return the location of a joint's frame, even if the joint was welded."""
    if model.existJointName(name):
        return Carried(model.getJointId(name), pin.SE3.Identity())
    frame = model.frames[model.getFrameId(name, pin.FrameType.FIXED_JOINT)]
    return Carried(frame.parentJoint, pin.SE3(frame.placement))
