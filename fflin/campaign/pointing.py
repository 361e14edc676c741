"""Misaligned inputs: actual directions of thrusters, wheels, torques and forces."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pinocchio as pin

from fflin.base.validation import Array
from fflin.kernel.tree import PIN_ANGULAR, PIN_LINEAR, Tree
from fflin.robot.equipment.assembly import turned_to
from fflin.robot.inputs import ReactionWheel, Thruster, named_inputs
from fflin.robot.joints import ROOT, find_frame
from fflin.robot.robot import Robot


def turned(direction: object, angles: Array) -> Array:
    """Return a direction rotated by angles (N, 2) [rad] about two perpendicular axes, (N, 3)."""
    first, second, along = turned_to(np.array(direction, dtype=float)).T
    size = np.linalg.norm(angles, axis=1)[:, None]
    side = angles[:, 1:] * first - angles[:, :1] * second
    found: Array = np.cos(size) * along + np.sinc(size / np.pi) * side
    return found


def misaligned(robot: Robot, angles: Array) -> Robot:
    """Return a robot whose thrusters and wheels are rotated by angles (nu, 2)."""
    inputs = list(robot.inputs)
    for place, item, _, at in _mounted(robot):
        inputs[place] = _pointed(item, turned(_direction(item), angles[at : at + 1])[0])
    return robot.replace(inputs=inputs)


def in_lanes(robot: Robot, tree: Tree, angles: Array) -> dict[str, Array]:
    """Return wrenches, stored momenta, joint placements and inertia changes of each run (N,)."""
    model, count, names = robot._bare.model, len(angles), list(robot.model.names)
    wrench = np.tile(tree.wrench, (count, 1)).reshape(count, -1, 6)
    stored = np.tile(tree.stored, (count, 1)).reshape(count, -1, 3)
    fixed = np.tile(tree.fixed, (count, 1)).reshape(count, -1, 12)
    bodies = np.zeros((count, tree.bodies.size // 10, 10))
    inputs, storing = tree.input.tolist(), tree.stored_body.tolist()
    for _, item, own, at in _mounted(robot):
        joint, placement = find_frame(model, item.frame)
        body = names.index(model.names[joint]) - ROOT
        axes = tree.axes[body].T @ placement.rotation
        before, after = _direction(item), turned(_direction(item), angles[:, at])
        if at in inputs:
            forces = [placement.act(pin.Force(_pointed(item, x).wrench)).vector for x in np.eye(3)]
            columns = np.column_stack(forces)
            parts = [tree.axes[body].T @ columns[rows] for rows in (PIN_ANGULAR, PIN_LINEAR)]
            wrench[:, inputs.index(at)] += (after - before) @ np.concatenate(parts).T
        if isinstance(item, ReactionWheel) and item.momentum:
            stored[:, storing.index(body)] += item.momentum * (after - before) @ axes.T
        if isinstance(item, ReactionWheel) and item.inertia:
            wheel = names.index(own[0]) - ROOT
            fixed[:, wheel, :9] = [(axes @ turned_to(each)).ravel("F") for each in after]
            a, b = after @ axes.T, axes @ before
            change = np.outer(b, b) - a[:, :, None] * a[:, None]
            row, column = np.triu_indices(3)
            bodies[:, body, 4:] += item.inertia * change[:, row, column]
    of = {"wrench": wrench, "stored": stored, "fixed": fixed, "bodies": bodies}
    return {name: each.reshape(count, -1) for name, each in of.items()}


def _direction(item: Thruster | ReactionWheel) -> Array:
    return np.array(item.direction if isinstance(item, Thruster) else item.axis)


def _pointed(item: Thruster | ReactionWheel, along: Array) -> Thruster | ReactionWheel:
    """Return a thruster or wheel with another direction."""
    if isinstance(item, Thruster):
        return replace(item, direction=along.tolist())
    return replace(item, axis=along.tolist())


def _mounted(
    robot: Robot,
) -> Iterator[tuple[int, Thruster | ReactionWheel, tuple[str, ...], int]]:
    """Yield each thruster and wheel: its index in `inputs`, itself, its names, its index in u."""
    first = 0
    for place, (item, names) in enumerate(named_inputs(robot.inputs)):
        if isinstance(item, Thruster | ReactionWheel):
            yield place, item, names, first
        first += len(names)
