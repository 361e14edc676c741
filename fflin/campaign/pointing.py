"""Misaligned inputs: actual directions of thrusters, wheels, torques and forces."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pinocchio as pin

from fflin.base.validation import Array
from fflin.kernel.tree import PIN_ANGULAR, PIN_LINEAR, Tree
from fflin.robot.equipment.mounting import turned_to
from fflin.robot.inputs import Input, ReactionWheel, Thruster, named_inputs
from fflin.robot.joints import ROOT, find_frame
from fflin.robot.robot import Robot

_ALONG: dict[type, str] = {Thruster: "direction", ReactionWheel: "axis"}


def turned(direction: object, angles: Array) -> Array:
    """Return a direction rotated by angles (N, 2) [rad] about two perpendicular axes, (N, 3)."""
    first, second, along = turned_to(np.array(direction, dtype=float)).T
    size = np.linalg.norm(angles, axis=1)[:, None]
    side = angles[:, 1:] * first - angles[:, :1] * second
    found: Array = np.cos(size) * along + np.sinc(size / np.pi) * side
    return found


def columns_of(robot: Robot, angles: Array) -> Array:
    """Return the actual axes of tau_b and F_b in each run, as in `ActuatorFaults`."""
    found: list[Array] = [np.zeros((len(angles), 0))]
    for item, names, first in _indexed(robot):
        if len(item.ENTRIES) == len(names) == 3:
            found += [turned(axis, angles[:, first + k]) for k, axis in enumerate(np.eye(3))]
    return np.concatenate(found, axis=1)


def misaligned(robot: Robot, angles: Array) -> Robot:
    """Return a robot whose thrusters and wheels are rotated by angles (nu, 2)."""
    inputs = []
    for item, _, at in _indexed(robot):
        key = _ALONG.get(type(item))
        other = {key: turned(getattr(item, key), angles[at : at + 1])[0]} if key else {}
        inputs.append(replace(item, **other) if key else item)
    return robot.replace(inputs=inputs)


def in_lanes(robot: Robot, tree: Tree, angles: Array) -> dict[str, Array]:
    """Return wrenches, stored momenta, joint placements and inertia changes of each run (N,)."""
    model, count, names = robot._bare.model, len(angles), list(robot.model.names)
    wrench = np.tile(tree.wrench, (count, 1)).reshape(count, -1, 6)
    stored = np.tile(tree.stored, (count, 1)).reshape(count, -1, 3)
    fixed = np.tile(tree.fixed, (count, 1)).reshape(count, -1, 12)
    bodies = np.zeros((count, tree.bodies.size // 10, 10))
    inputs, storing = tree.input.tolist(), tree.stored_body.tolist()
    for item, own, at in _indexed(robot):
        if not (key := _ALONG.get(type(item))):
            continue
        any_item: Any = item
        joint, placement = find_frame(model, any_item.frame)
        body = names.index(model.names[joint]) - ROOT
        axes = tree.axes[body].T @ placement.rotation
        before, after = np.array(getattr(item, key)), turned(getattr(item, key), angles[:, at])
        if at in inputs:
            units = [replace(any_item, **{key: axis}).wrench for axis in np.eye(3)]
            columns = np.column_stack([placement.act(pin.Force(unit)).vector for unit in units])
            parts = [tree.axes[body].T @ columns[rows] for rows in (PIN_ANGULAR, PIN_LINEAR)]
            wrench[:, inputs.index(at)] += (after - before) @ np.concatenate(parts).T
        if getattr(item, "momentum", 0.0):
            change = any_item.momentum * (after - before) @ axes.T
            stored[:, storing.index(body)] += change
        if inertia := getattr(item, "inertia", None):
            wheel = names.index(own[0]) - ROOT
            turns = [axes @ turned_to(each) for each in after]
            fixed[:, wheel, :9] = np.array([turn.ravel("F") for turn in turns])
            a, b = after @ axes.T, axes @ before
            change = np.outer(b, b) - a[:, :, None] * a[:, None]
            row, column = np.triu_indices(3)
            bodies[:, body, 4:] += inertia * change[:, row, column]
    of = {"wrench": wrench, "stored": stored, "fixed": fixed, "bodies": bodies}
    return {name: each.reshape(count, -1) for name, each in of.items()}


def _indexed(robot: Robot) -> Iterator[tuple[Input, tuple[str, ...], int]]:
    """Yield each input, the names of its entries, and the index of its first entry in u."""
    first = 0
    for item, names in named_inputs(robot.inputs):
        yield item, names, first
        first += len(names)
