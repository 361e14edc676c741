"""Reaction wheels on a model: the joints of those with an inertia, the momentum of the others."""

from collections.abc import Sequence

import numpy as np
import pinocchio as pin

from fflin.base.errors import InputError
from fflin.base.validation import Array, frozen
from fflin.robot.equipment.mounting import Mounted, difference
from fflin.robot.inputs import Input, ReactionWheel, named_wheels
from fflin.robot.joints import ROOT, Joint, find_frame
from fflin.robot.urdf.links import is_impossible

_Z = np.array([0.0, 0.0, 1.0])


def carrier(model: pin.Model, wheel: ReactionWheel) -> tuple[int, Array]:
    """Return the joint that carries a wheel, and its axis (3,) in that joint's frame."""
    joint, placement = find_frame(model, wheel.frame)
    return joint, placement.rotation @ np.array(wheel.axis)


def stored_momentum(model: pin.Model, inputs: Sequence[Input]) -> tuple[tuple[int, Array], ...]:
    """Return the momentum (3,) [N m s] of wheels without inertia on each joint, in its frame."""
    stored: dict[int, Array] = {}
    for _, wheel in named_wheels(inputs):
        if wheel.momentum:
            joint, axis = carrier(model, wheel)
            stored[joint] = stored.get(joint, np.zeros(3)) + wheel.momentum * axis
    return tuple((joint, frozen(momentum)) for joint, momentum in stored.items())


def mounted_wheels(
    model: pin.Model, bodies: list[pin.Inertia], inputs: Sequence[Input]
) -> list[Mounted]:
    """Return the wheels with an inertia, and subtract each wheel from its body."""
    parts = []
    for name, wheel in named_wheels(inputs):
        if not wheel.inertia:
            continue
        joint, axis = carrier(model, wheel)
        spinning = pin.Inertia(0.0, np.zeros(3), float(wheel.inertia) * np.outer(axis, axis))
        rest = difference(bodies[joint], spinning)
        moments = np.linalg.eigvalsh(rest.inertia).tolist()
        if is_impossible(rest.mass, moments):
            of = "the base" if joint == ROOT else f"the link of joint '{model.names[joint]}'"
            about = float(axis @ bodies[joint].inertia @ axis)
            lock = "" if joint == ROOT else f", or lock '{model.names[joint]}' if it is the wheel's"
            raise InputError(
                f"wheel '{name}' of {wheel.inertia:g} kg m^2 has a larger inertia than the link "
                "that carries it: "
                f"{of} has {about:.3g} kg m^2 about its axis, so that {moments[0]:.3g} kg m^2 "
                "would be left without the wheel; the URDF's inertia must include the wheels, so "
                f"correct the URDF or the wheel{lock}"
            )
        bodies[joint] = rest
        placement = pin.SE3(turned_to(axis), np.zeros(3))
        own = pin.Inertia(0.0, np.zeros(3), float(wheel.inertia) * np.outer(_Z, _Z))
        turning = Joint(name, 0, 0, unbounded=True, prismatic=False)
        parts.append(Mounted(turning, joint, placement, pin.JointModelRUBZ(), own))
    return parts


def turned_to(axis: Array) -> Array:
    """Return a rotation (3, 3) that maps z to an axis, exact for x, y and z."""
    beside = np.cross(np.eye(3)[np.abs(axis).argmin()], axis)
    beside /= np.linalg.norm(beside)
    return np.column_stack((beside, np.cross(axis, beside), axis))
