"""Two robots welded into one: the base of the second is fixed to a frame of the first."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from hashlib import sha256
from typing import Any

import numpy as np
import pinocchio as pin

from fflin.base.errors import InputError
from fflin.robot.frames import ROOT, find_frame
from fflin.robot.joints import Follower, Joint
from fflin.robot.link_masses import LinkMass
from fflin.robot.robot import Robot
from fflin.robot.wheels import carry_over, with_inputs


def joined(robot: Robot, frame: str, other: Robot, placement: pin.SE3, prefix: str) -> Robot:
    """Return a robot with the base of another, all PREFIX.NAME and no motors, welded to a frame."""
    bare = robot._bare
    joint, at = find_frame(bare.model, frame)
    _require_new_names(robot, prefix)
    model = _joined(bare.model, joint, other.model.copy(), at * placement, prefix)

    def renamed(joint: Joint) -> Joint:
        return joint._replace(name=f"{prefix}.{joint.name}").within(model)

    own = [each.within(model) for each in bare.joints]
    theirs = [renamed(each) for each in other.joints]
    followers = [
        *(
            f._replace(joint=f.joint.within(model), leader=f.leader.within(model))
            for f in bare.followers
        ),
        *(Follower(renamed(f.joint), renamed(f.leader), *f[2:]) for f in other.followers),
    ]
    both: dict[str, Any] = {
        name: {**getattr(robot, name), **_prefixed(getattr(other, name), prefix)}
        for name in ("stiffness", "damping", "rest", "urdf_damping", "links")
    }
    if not other.links:  # a body alone: its own parameters have its name
        body = other.model.inertias[ROOT]
        at_center = pin.SE3(np.eye(3), body.lever)
        both["links"][prefix] = LinkMass(body.mass, body.inertia, at_center)
    told = f"{robot.urdf_sha256} {other.urdf_sha256} {frame} {placement} {prefix}"
    weighed = b"".join(each.toDynamicParameters().tobytes() for each in model.inertias.tolist())
    whole = replace(
        robot,
        model=model,
        _wheelless=None,
        name=f"{robot.name}+{other.name}",
        urdf_sha256=sha256(told.encode() + weighed).hexdigest(),
        joints=tuple(sorted((*own, *theirs), key=lambda each: each.idx_v)),
        followers=tuple(followers),
        attached=(*robot.attached, (prefix, other)),
        **both,
    )
    return with_inputs(whole, robot.inputs)


def _prefixed(values: Mapping[str, Any], prefix: str) -> dict[str, Any]:
    return {f"{prefix}.{name}": value for name, value in values.items()}


def _require_new_names(robot: Robot, prefix: str) -> None:
    if not prefix or "." in prefix:
        raise InputError(f"prefix is {prefix!r}, expected a word without dots, such as 'payload'")
    taken = {*robot.model.names, *(frame.name for frame in robot.model.frames.tolist())}
    if any(name == prefix or name.startswith(f"{prefix}.") for name in taken):
        raise InputError(
            f"'{robot.name}' already has joints or frames named '{prefix}'; give another prefix"
        )


def _joined(
    model: pin.Model, joint: int, other: pin.Model, placement: pin.SE3, prefix: str
) -> pin.Model:
    """Return the model, in whose tree the other's joints come after all that the joint carries."""
    new = pin.Model()
    new.name, new.gravity = model.name, model.gravity
    moved, others = {0: 0}, dict[int, int]()
    for of, index in _in_order(model, joint, other):
        one, there = (model, moved) if of is model else (other, others)
        on = there[one.parents[index]]
        place, name = one.jointPlacements[index], one.names[index]
        if of is other:
            name = f"{prefix}.{name}"
            place = placement * place if one.parents[index] == ROOT else place
        there[index] = new.addJoint(on, one.joints[index], place, name)
        new.appendBodyToJoint(there[index], one.inertias[index], pin.SE3.Identity())
        if of is model and index == joint:
            others[ROOT] = there[index]
            new.appendBodyToJoint(there[index], other.inertias[ROOT], placement)
    carry_over(model, new, moved)
    carry_over(other, new, {index: at for index, at in others.items() if index > ROOT})
    for frame in model.frames.tolist()[1:]:
        copy = pin.Frame(frame)
        copy.parentJoint = moved[frame.parentJoint]
        new.addFrame(copy, False)
    on = others[ROOT]
    new.addFrame(pin.Frame(prefix, on, placement, pin.FrameType.BODY), False)
    for frame in other.frames.tolist()[1:]:
        if frame.parentJoint >= ROOT:
            copy = pin.Frame(frame)
            copy.name, copy.parentJoint = f"{prefix}.{frame.name}", others[frame.parentJoint]
            copy.parentFrame = 0
            if frame.parentJoint == ROOT:
                copy.placement = placement * frame.placement
            new.addFrame(copy, False)
    return new


def _in_order(
    model: pin.Model, joint: int, other: pin.Model, root: int = ROOT
) -> Iterator[tuple[pin.Model, int]]:
    """Yield the joints depth first; the other model's joints follow all that hang on the joint."""
    yield model, root
    for child in model.children[root]:
        yield from _in_order(model, joint, other, child)
    if root == joint:
        yield from ((other, index) for index in range(ROOT + 1, other.njoints))


def body_alone(inertia: pin.Inertia, name: str) -> Robot:
    """Return a body as a robot without joints."""
    from fflin.robot.loading import from_model

    model = pin.Model()
    model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "root_joint")
    model.appendBodyToJoint(1, inertia, pin.SE3.Identity())
    model.addJointFrame(1)
    return from_model(model, name=name)


def inertia_of(value: Any) -> pin.Inertia:
    """Return the inertia of a body that has mass, or raise `InputError`."""
    second = 0.5 * np.trace(value.inertia) * np.eye(3) - value.inertia
    least, size = np.linalg.eigvalsh(second)[0], np.trace(value.inertia)
    if not value.mass > 0.0 or least < -1e-9 * size:
        raise InputError(
            f"payload of {value.mass:g} kg has an inertia that is not physically realisable; give "
            "a mass above 0, and principal moments none of which exceeds the sum of the other two"
        )
    return value
