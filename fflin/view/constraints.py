"""Marks of a robot's constraints on the page, and their forces and torques."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from fflin.base.validation import Array
from fflin.dynamics.impact import Impact
from fflin.robot.constraints import Constraint, Hinge
from fflin.robot.equipment.assembly import turned_to
from fflin.robot.joints import ROOT, find_frame
from fflin.robot.robot import Robot
from fflin.simulation.motion import Motion


class Reaction(NamedTuple):
    """Force and torque of a constraint on its `frame` at N frames of an animation."""

    constraint: Constraint
    active: Array  # (N,): 1 if the robot has the constraint, 0 otherwise
    point: Array  # (N, 3) [m] origin of the frame in the world
    force: Array  # (N, 3) [N] in world axes
    torque: Array  # (N, 3) [N m] about the origin of the frame, in world axes


def constraint_marks(
    robot: Robot, nodes: Sequence[Sequence[str]], items: Sequence[Constraint]
) -> list[dict[str, object]]:
    """Return the marks of constraints, each with the node of its body and its pose on the body.

    The axis z of the pose is the axis of a hinge. A constraint is marked at its `frame` or, if the
    robot lacks this frame, at its `to`. A constraint without both is omitted.
    """
    marks = list[dict[str, object]]()
    for item in items:
        name = next((name for name in item.frames if robot.model.existFrame(name)), "")
        if not name:
            continue
        joint, placement = find_frame(robot.model, name)
        if name != item.frame and item.placement is not None:
            placement = placement * item.placement
        if isinstance(item, Hinge):
            axis = turned_to(np.array(item.axis))
            placement = placement * pin.SE3(axis, np.zeros(3))
        x, y, z, *quaternion = pin.SE3ToXYZQUAT(placement).tolist()
        marks.append(
            {
                "name": item.title,
                "kind": item.KEY,
                "path": nodes[joint - ROOT],
                "position": [x, y, z],
                "quaternion": quaternion,
            }
        )
    return marks


def reactions(robot: Robot, motion: Motion, shown: Array) -> list[Reaction]:
    """Return the reactions of all constraints at the samples of a motion with indices `shown`.

    `robot` is the robot of a motion without phases. In a motion of several phases, each phase has
    its own constraints.
    """
    reactions = dict[str, Reaction]()
    for part_robot, part, first in _parts(robot, motion):
        rows = np.flatnonzero((shown >= first) & (shown < first + len(part.t)))
        data = part_robot.create_data()
        for item in part_robot.constraints:
            if item.title not in reactions:
                active = np.zeros(len(shown))
                vectors = np.zeros((3, len(shown), 3))
                reactions[item.title] = Reaction(item, active, *vectors)
            reaction = reactions[item.title]
            reaction.active[rows] = 1.0
            forces = _recorded("force", item, motion)[shown[rows]]
            torques = _recorded("torque", item, motion)[shown[rows]]
            for row, force, torque in zip(rows, forces, torques, strict=True):
                q = part.q[shown[row] - first]
                pin.framesForwardKinematics(part_robot.model, data, q)
                reaction.point[row] = _pose(part_robot, data, item.frame).translation
                axes = _axes(part_robot, data, item)
                reaction.force[row] = axes @ force
                reaction.torque[row] = axes @ torque
    return list(reactions.values())


def _parts(robot: Robot, motion: Motion) -> Iterator[tuple[Robot, Motion, int]]:
    """Yield the robot and the motion of each phase, and the index of its first sample."""
    phases = [part for part in motion._phases if not isinstance(part, Impact)]
    if not phases:
        yield motion._robot or robot, motion, 0
    first = 0
    for part in phases:
        yield part._robot, part, first
        first += len(part.t)


def _recorded(kind: str, item: Constraint, motion: Motion) -> Array:
    """Return the "force" or "torque" (N, 3) of a constraint in the axes of its placement.

    It is zero if it is not recorded.
    """
    names = list(motion.constraint_names)
    vectors = np.zeros((len(motion.t), 3))
    for column, axis in enumerate("xyz"):
        name = f"{item.title}.{kind}.{axis}"
        if name in names:
            vectors[:, column] = motion.constraint_forces[:, names.index(name)]
    return vectors


def _pose(robot: Robot, data: pin.Data, name: str) -> pin.SE3:
    joint, placement = find_frame(robot.model, name)
    return data.oMi[joint] * placement


def _axes(robot: Robot, data: pin.Data, item: Constraint) -> Array:
    """Return the axes (3, 3), in the world, in which the force of a constraint is given."""
    pose = item.placement
    if pose is None:
        pose = _pose(robot, data, item.frame)
    elif item.to is not None:
        pose = _pose(robot, data, item.to) * pose
    rotation: Array = pose.rotation
    return rotation
