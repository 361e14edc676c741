"""Reaction wheels on a model: the joints of those with an inertia, the momentum of the others."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from fflin.base.errors import InputError
from fflin.base.frozen import frozen
from fflin.base.validation import Array
from fflin.robot.fields import checked_inputs, kept_start
from fflin.robot.frames import ROOT, find_frame
from fflin.robot.inputs import Input, ReactionWheel, named_wheels
from fflin.robot.joints import Joint
from fflin.robot.urdf.links import is_impossible

# What Pinocchio keeps of each degree of freedom, and of each entry of q, beside the joint itself.
_OF_VELOCITY = (
    *("armature", "damping", "rotorInertia", "rotorGearRatio"),
    *("lowerEffortLimit", "upperEffortLimit", "lowerVelocityLimit", "upperVelocityLimit"),
    *("lowerDryFrictionLimit", "upperDryFrictionLimit"),
)
_OF_POSITION = ("lowerPositionLimit", "upperPositionLimit", "positionLimitMargin")

_Z = np.array([0.0, 0.0, 1.0])


class _Mounted(NamedTuple):
    """A wheel by its name, its axis (3,) in its carrier's frame, and its inertia [kg m^2]."""

    name: str
    axis: Array
    inertia: float


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


def with_inputs(robot: Any, inputs: Any) -> Any:
    """Return a robot with other inputs, and with the wheels among them as joints."""
    bare = robot._bare
    checked = checked_inputs(inputs, bare.joint, bare.joint_names, robot.passive)
    wheels = [(name, wheel) for name, wheel in named_wheels(checked) if wheel.inertia]
    model, joints, followers = bare.model, bare.joints, bare.followers
    if wheels:
        model = _with_wheels(model, wheels)
        turning = (Joint(name, 0, 0, unbounded=True, prismatic=False) for name, _ in wheels)
        placed = [joint.within(model) for joint in (*joints, *turning)]
        joints = tuple(sorted(placed, key=lambda joint: joint.idx_v))
        followers = tuple(
            each._replace(joint=each.joint.within(model), leader=each.leader.within(model))
            for each in followers
        )
    names = [joint.name for joint in joints]
    of_joints: dict[str, Any] = {
        field: {name: x for name, x in getattr(robot, field).items() if name in names}
        for field in ("stiffness", "damping", "rest")
    }
    return replace(
        robot,
        **{"model": model, "joints": joints, "followers": followers, "inputs": checked},
        start=kept_start(robot.start, names),
        _wheelless=bare if wheels else None,
        **of_joints,
    )


def _with_wheels(model: pin.Model, wheels: Sequence[tuple[str, ReactionWheel]]) -> pin.Model:
    """Return a model with one more joint for each wheel, which the bodies of this one count."""
    carried: dict[int, list[_Mounted]] = {}
    bodies = [pin.Inertia(body) for body in model.inertias.tolist()]
    for name, wheel in wheels:
        if model.existJointName(name) or model.existFrame(name):
            raise InputError(
                f"wheel '{name}' has the name of a joint or frame of the robot; give it another "
                "name"
            )
        joint, axis = carrier(model, wheel)
        mounted = _Mounted(name, axis, float(wheel.inertia or 0.0))
        of = "the base" if joint == ROOT else f"the link of joint '{model.names[joint]}'"
        bodies[joint] = _without(bodies[joint], mounted, of)
        carried.setdefault(joint, []).append(mounted)
    return _rebuilt(model, bodies, carried)


def _without(body: pin.Inertia, wheel: _Mounted, of: str) -> pin.Inertia:
    """Take J a a^T out of a body."""
    name, axis, inertia = wheel
    rest = body.inertia - inertia * np.outer(axis, axis)
    moments = np.linalg.eigvalsh(rest).tolist()
    if is_impossible(body.mass, moments):
        about = float(axis @ body.inertia @ axis)
        raise InputError(
            f"wheel '{name}' of {inertia:g} kg m^2 has more inertia than its carrier: {of} has "
            f"{about:.3g} kg m^2 about its axis, which leaves a principal moment of "
            f"{moments[0]:.3g}; the inertia in the URDF must include the wheels: correct the URDF "
            "or the wheel"
        )
    return pin.Inertia(body.mass, body.lever, rest)


def _rebuilt(
    model: pin.Model, bodies: Sequence[pin.Inertia], carried: dict[int, list[_Mounted]]
) -> pin.Model:
    new = pin.Model()
    new.name, new.gravity = model.name, model.gravity
    moved = {0: 0}  # old index to new
    for item in _depth_first(model, carried):
        if isinstance(item, int):
            placement, name = model.jointPlacements[item], model.names[item]
            moved[item] = new.addJoint(
                moved[model.parents[item]], model.joints[item], placement, name
            )
            new.appendBodyToJoint(moved[item], bodies[item], pin.SE3.Identity())
            continue
        parent, (name, axis, inertia) = item
        placement = pin.SE3(turned_to(axis), np.zeros(3))
        index = new.addJoint(moved[parent], pin.JointModelRUBZ(), placement, name)
        spinning = pin.Inertia(0.0, np.zeros(3), inertia * np.outer(_Z, _Z))
        new.appendBodyToJoint(index, spinning, pin.SE3.Identity())
    carry_over(model, new, moved)
    # The parent of a frame is an index among frames: they stay in order, and new ones come last.
    for frame in model.frames.tolist()[1:]:
        copy = pin.Frame(frame)
        copy.parentJoint = moved[frame.parentJoint]
        new.addFrame(copy, False)
    for name in (name for wheels in carried.values() for name, *_ in wheels):
        new.addJointFrame(new.getJointId(name))
    return new


def turned_to(axis: Array) -> Array:
    """Return a rotation (3, 3) that takes z to an axis, without rounding if it is x, y or z."""
    beside = np.cross(np.eye(3)[np.abs(axis).argmin()], axis)
    beside /= np.linalg.norm(beside)
    return np.column_stack((beside, np.cross(axis, beside), axis))


def _depth_first(
    model: pin.Model, carried: dict[int, list[_Mounted]], root: int = ROOT
) -> Iterator[int | tuple[int, _Mounted]]:
    """Yield the joints from a root on, and the wheels of each after all that hang on it."""
    # Else the joints would not be in depth-first order, without which CRBA is wrong.
    yield root
    for child in model.children[root]:
        yield from _depth_first(model, carried, child)
    for wheel in carried.get(root, []):
        yield root, wheel


def carry_over(model: pin.Model, new: pin.Model, moved: dict[int, int]) -> None:
    """Copy what a model keeps of its joints beside them."""
    for names, begin, length in (_OF_VELOCITY, "idx_vs", "nvs"), (_OF_POSITION, "idx_qs", "nqs"):
        sizes, old_at, new_at = getattr(model, length), getattr(model, begin), getattr(new, begin)
        for name in names:
            values, old = getattr(new, name).copy(), getattr(model, name)
            for index, to in moved.items():
                size = sizes[index]
                values[new_at[to] : new_at[to] + size] = old[old_at[index] : old_at[index] + size]
            setattr(new, name, values)
