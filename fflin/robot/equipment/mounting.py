"""Wheels and other bodies on new joints, subtracted from the links whose inertia includes them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import pinocchio as pin

from fflin.base.errors import InputError
from fflin.base.validation import Array, frozen
from fflin.robot.inputs import Input, ReactionWheel, named_wheels
from fflin.robot.joints import ROOT, Joint, find_frame
from fflin.robot.urdf.description import is_impossible

if TYPE_CHECKING:
    from fflin.robot.robot import Robot

# Arrays of a Pinocchio model: first those with an entry for each entry of v, then for each entry
# of q.
_OF_VELOCITY = (
    *("armature", "damping", "rotorInertia", "rotorGearRatio"),
    *("lowerEffortLimit", "upperEffortLimit", "lowerVelocityLimit", "upperVelocityLimit"),
    *("lowerDryFrictionLimit", "upperDryFrictionLimit"),
)
_OF_POSITION = ("lowerPositionLimit", "upperPositionLimit", "positionLimitMargin")


class Mounted(NamedTuple):
    """A mounted body, and the joint on which it moves relative to its carrier.

    `carrier` is the index of a joint of the bare model, or the name of a mounted body. `placement`
    is the joint's placement in the carrier's frame. `inertia` is the body in the joint's frame.
    """

    joint: Joint
    carrier: int | str
    placement: pin.SE3
    motion: pin.JointModel
    inertia: pin.Inertia
    armature: float = 0.0

    @property
    def name(self) -> str:
        """Name of the joint."""
        return self.joint.name


def with_mounted(model: pin.Model, bodies: list[pin.Inertia], parts: list[Mounted]) -> pin.Model:
    """Return a model with a new joint for each part, and with new inertias of the old bodies.

    The new joints have no frames yet.
    """
    on: dict[int | str, list[Mounted]] = {}
    for part in parts:
        on.setdefault(part.carrier, []).append(part)
    new = pin.Model()
    new.name, new.gravity = model.name, model.gravity
    moved, added = {0: 0}, dict[int | str, int]()
    # CRBA needs the joints in depth-first order; mounted bodies come after a joint's other joints.
    left: list[int | Mounted] = [ROOT]
    while left:
        item = left.pop()
        if isinstance(item, Mounted):
            key: int | str = item.name
            index = new.addJoint(added[item.carrier], item.motion, item.placement, item.name)
            body, children = item.inertia, []
        else:
            key, parent, placement = item, moved[model.parents[item]], model.jointPlacements[item]
            index = new.addJoint(parent, model.joints[item], placement, model.names[item])
            body, children, moved[item] = bodies[item], model.children[item].tolist(), index
        added[key] = index
        left += [*reversed(on.get(key, [])), *reversed(children)]
        # The body is not passed to appendBodyToJoint, which divides by its mass (perhaps zero).
        new.appendBodyToJoint(index, pin.Inertia.Zero(), pin.SE3.Identity())
        new.inertias[index] = body
    carry_over(model, new, moved)
    armature = new.armature.copy()
    for part in parts:
        armature[new.idx_vs[added[part.name]]] = part.armature
    new.armature = armature
    # Frames refer to their parent frames by index. So old frames keep their order, and new frames
    # come last.
    for frame in model.frames.tolist()[1:]:
        copy = pin.Frame(frame)
        copy.parentJoint = moved[frame.parentJoint]
        new.addFrame(copy, False)
    return new


def carry_over(model: pin.Model, new: pin.Model, moved: Mapping[int, int]) -> None:
    """Copy armatures, limits and similar arrays of joints; `moved` is {old index: new index}."""
    for names, begin, length in (_OF_VELOCITY, "idx_vs", "nvs"), (_OF_POSITION, "idx_qs", "nqs"):
        sizes, old_at, new_at = getattr(model, length), getattr(model, begin), getattr(new, begin)
        for name in names:
            values, old = getattr(new, name).copy(), getattr(model, name)
            for index, to in moved.items():
                size = sizes[index]
                values[new_at[to] : new_at[to] + size] = old[old_at[index] : old_at[index] + size]
            setattr(new, name, values)


def carrier(model: pin.Model, wheel: ReactionWheel) -> tuple[int, Array]:
    """Return the joint that carries a wheel, and its axis (3,) in that joint's frame."""
    joint, placement = find_frame(model, wheel.frame)
    return joint, placement.rotation @ np.array(wheel.axis)


def stored_momentum(robot: Robot) -> tuple[tuple[int, Array], ...]:
    """Angular momentum stored in the wheels without inertia, by the joint that carries them.

    Each entry is the joint index and the vector (3,) [N m s] in joint axes.
    """
    stored: dict[int, Array] = {}
    for _, wheel in named_wheels(robot.inputs):
        if wheel.momentum:
            joint, axis = carrier(robot.model, wheel)
            stored[joint] = stored.get(joint, np.zeros(3)) + wheel.momentum * axis
    return tuple((joint, frozen(momentum)) for joint, momentum in stored.items())


def mounted_wheels(
    model: pin.Model, bodies: list[pin.Inertia], inputs: Sequence[Input]
) -> list[Mounted]:
    """Return the wheels that have an inertia, and subtract each from the body that includes it."""
    parts = []
    for name, wheel in named_wheels(inputs):
        if not wheel.inertia:
            continue
        joint, axis = carrier(model, wheel)
        spinning = pin.Inertia(0.0, np.zeros(3), wheel.inertia * np.outer(axis, axis))
        rest = bodies[joint] - spinning
        moments = np.linalg.eigvalsh(rest.inertia).tolist()
        about = float(axis @ bodies[joint].inertia @ axis)
        # If the link is the wheel itself, only rounding errors of its inertia remain.
        if is_impossible(rest.mass, moments) or wheel.inertia > (1.0 - 1e-9) * about:
            lock = "" if joint == ROOT else f", or lock '{model.names[joint]}' if it is the wheel's"
            raise InputError(
                f"wheel '{name}' of {wheel.inertia:g} kg m^2 must have less inertia than the "
                f"link that carries it, but {carrier_name(model, joint)} has {about:.3g} kg m^2 "
                "about the axis of the wheel; the inertia in the URDF must include the wheels, so "
                f"correct the URDF or the wheel{lock}"
            )
        bodies[joint] = rest
        placement = pin.SE3(turned_to(axis), np.zeros(3))
        own = pin.Inertia(0.0, np.zeros(3), np.diag([0.0, 0.0, wheel.inertia]))
        turning = Joint(name, unbounded=True)
        parts.append(Mounted(turning, joint, placement, pin.JointModelRUBZ(), own))
    return parts


def carrier_name(model: pin.Model, joint: int) -> str:
    """Return the name of the body on a joint, for messages."""
    return "the base" if joint == ROOT else f"the link of joint '{model.names[joint]}'"


def turned_to(axis: Array) -> Array:
    """Return a rotation (3, 3) that maps z to an axis, exact for x, y and z."""
    beside = np.cross(np.eye(3)[np.abs(axis).argmin()], axis)
    beside /= np.linalg.norm(beside)
    return np.column_stack((beside, np.cross(axis, beside), axis))
