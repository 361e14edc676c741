"""Wheels and other bodies on new joints, subtracted from the links whose inertia includes them."""

from __future__ import annotations

from collections.abc import Sequence
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

    The new joints come after all other joints that their carrier carries.
    """
    new = model.copy()
    for part in parts:
        on = part.carrier if isinstance(part.carrier, str) else model.names[part.carrier]
        # Models built in code may lack frames of their joints.
        if not new.existFrame(on, pin.FrameType.JOINT):
            new.addJointFrame(new.getJointId(on))
        alone = pin.Model()
        alone.addJoint(0, part.motion, pin.SE3.Identity(), part.name)
        alone.addJointFrame(1)
        new = pin.appendModel(new, alone, new.getFrameId(on, pin.FrameType.JOINT), part.placement)
    carry_over(model, new)
    for name, body in zip(model.names, bodies, strict=True):
        new.inertias[new.getJointId(name)] = body
    new.name, new.gravity, armature = model.name, model.gravity, new.armature.copy()
    for part in parts:
        index = new.getJointId(part.name)
        new.inertias[index], armature[new.idx_vs[index]] = part.inertia, part.armature
    new.armature = armature
    return new


def carry_over(model: pin.Model, new: pin.Model) -> None:
    """Copy the arrays of joints that `appendModel` leaves out from a model to the new model."""
    for name in ("armature", "lowerVelocityLimit"):
        values, old = getattr(new, name).copy(), getattr(model, name)
        for index in range(ROOT, model.njoints):
            at, size = new.idx_vs[new.getJointId(model.names[index])], model.nvs[index]
            values[at : at + size] = old[model.idx_vs[index] :][:size]
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
