"""A robot's equipment: reaction wheels, flexible appendages and slosh, as joints of its model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin

from fflin.base.errors import InputError
from fflin.robot.equipment.appendage_bodies import mounted_appendages
from fflin.robot.equipment.appendages import (
    Appendage,
    FlexibleAppendage,
    checked_appendages,
    rigid_inertia,
)
from fflin.robot.equipment.mounting import (
    Mounted,
    difference,
    inertia_of,
    mounted_wheels,
    with_mounted,
)
from fflin.robot.fields import checked_inputs, of_joints
from fflin.robot.joints import find_frame
from fflin.robot.mass_properties import LinkMass, as_inertia

if TYPE_CHECKING:
    from fflin.robot.robot import Robot


def with_inputs(robot: Robot, inputs: object) -> Robot:
    """Return a robot with other inputs, and with the wheels among them as joints."""
    return _equipped(robot, inputs, robot.appendages)


def with_appendages(robot: Robot, appendages: object) -> Robot:
    """Return a robot with other flexible appendages and slosh, whose modes are joints."""
    checked = checked_appendages(appendages)
    bare, taken = robot._bare, set[int]()
    for item in checked:
        if isinstance(item, FlexibleAppendage) and item.rigid and item.inertia is not None:
            joint = find_frame(bare.model, item.frame).joint
            if joint in taken:
                raise InputError(
                    f"'{item.title}' is the second appendage with rigid=True on its body; use "
                    "rigid=True for only one appendage of each body"
                )
            taken.add(joint)
            bare = _with_rigid(bare, item)
    if taken:
        robot = replace(robot, links=bare.links, urdf_sha256=bare.urdf_sha256, _unequipped=bare)
        checked = tuple(
            replace(item, rigid=False) if isinstance(item, FlexibleAppendage) else item
            for item in checked
        )
    return _equipped(robot, robot.inputs, checked)


def _with_rigid(bare: Robot, item: FlexibleAppendage) -> Robot:
    """Return a robot in which the appendage's link has the inertia from the appendage's file."""
    assert item.inertia is not None
    joint, placement = find_frame(bare.model, item.frame)
    of_file, body = rigid_inertia(item.inertia), bare.model.inertias[joint]
    placed = of_file.se3Action(placement)
    of_link, links = body, dict(bare.links)
    if link := bare.pieces.get(item.frame):
        of_link = as_inertia(link)
    if item.frame in links:
        at_center = pin.SE3(np.eye(3), of_file.lever)
        links[item.frame] = LinkMass(of_file.mass, of_file.inertia, at_center)
    rest = difference(body, of_link)
    negative = inertia_of(-placed.mass, placed.lever, -placed.inertia)
    return replace(bare.with_bodies({joint: difference(rest, negative)}), links=links)


def _equipped(robot: Robot, inputs: object, appendages: Sequence[Appendage]) -> Robot:
    bare = robot._bare
    checked = checked_inputs(inputs, bare.joint, bare.joint_names, robot.passive)
    model, joints, followers = bare.model, bare.joints, bare.followers
    bodies = [pin.Inertia(body) for body in model.inertias.tolist()]
    wheels = mounted_wheels(model, bodies, checked)
    modes, springs = mounted_appendages(model, bodies, appendages, bare.pieces)
    parts = [*wheels, *modes]
    if parts:
        _require_new_names(model, parts)
        model = with_mounted(model, bodies, parts)
        for part in parts:
            model.addJointFrame(model.getJointId(part.name))
        placed = [joint.within(model) for joint in (*joints, *(part.joint for part in parts))]
        joints = tuple(sorted(placed, key=lambda joint: joint.idx_v))
        followers = tuple(each.within(model) for each in followers)
    names = [joint.name for joint in joints]
    own = {joint.name for joint in robot.joints if joint.mode}
    by_joint: dict[str, Any] = {
        field: {name: x for name, x in getattr(robot, field).items() if name in names}
        for field in ("stiffness", "damping", "rest")
    }
    for field, values in springs.items():
        if appendages is robot.appendages:  # their springs may have been replaced since
            break
        by_joint[field] = {k: x for k, x in by_joint[field].items() if k not in own} | values
    for field in ("point", "target", "start"):
        by_joint[field] = of_joints(getattr(robot, field), names)
    return replace(
        robot,
        **{"model": model, "joints": joints, "followers": followers, "inputs": checked},
        appendages=tuple(appendages),
        _unequipped=bare if parts else None,
        _removed=tuple(
            dict.fromkeys(
                name for name in (*robot._removed, *robot.joint_names) if name not in names
            )
        ),
        **by_joint,
    )


def _require_new_names(model: pin.Model, parts: Sequence[Mounted]) -> None:
    """Raise `InputError` if two joints would have the same name."""
    taken = {*model.names, *(frame.name for frame in model.frames.tolist())}
    for part in parts:
        if part.name in taken:
            raise InputError(
                f"'{part.name}' has the name of another joint, frame, wheel or mode of the robot; "
                "give the wheel or the appendage another name"
            )
        taken.add(part.name)
