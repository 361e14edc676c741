"""Magnetorquers on the page of a robot, and the magnetic field at the robot."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypedDict

import numpy as np

from fflin.base.rotation import rotation_matrices
from fflin.base.validation import Array
from fflin.dynamics.disturbance import true_field
from fflin.dynamics.state import Actuation, StateMap
from fflin.robot.inputs import Magnetorquer
from fflin.robot.joints import ROOT, find_frame
from fflin.robot.robot import Robot

# Path of a node of the scene.
Path = list[str]


class Rod(TypedDict):
    """Magnetorquer as the page draws it: a rod in the frame of the joint that carries it."""

    name: str
    path: Path
    position: list[float]
    axis: list[float]


def rods(robot: Robot, nodes: Sequence[Path]) -> list[Rod]:
    """Return the drawing of each magnetorquer; `nodes` are the paths of the bodies' nodes."""
    drawn = list[Rod]()
    for item, (name, *_) in robot.named_inputs:
        if not isinstance(item, Magnetorquer):
            continue
        joint, placement = find_frame(robot.model, item.frame)
        axis = placement.rotation @ np.array(item.axis)
        drawn.append(
            {
                "name": name,
                "path": nodes[joint - ROOT],
                "position": placement.translation.tolist(),
                "axis": axis.tolist(),
            }
        )
    return drawn


def fluxes(state: StateMap, t: Array) -> Array:
    """Return the magnetic flux density (N, 3) [T] at times t (N,) [s], in world axes.

    It is the true field, which contains `field_scale` and `field_rotation` of the robot's
    disturbance. There is no row if the robot has no magnetorquers.
    """
    field = state.field
    if not Actuation(state).torquers or field is None:
        return np.zeros((0, 3))
    magnetic = true_field(state.robot, field)
    return np.array([magnetic.at(time) for time in t.tolist()])


def moments(state: StateMap, u: Array) -> Array:
    """Return the moments (N, k) [A m^2] of k magnetorquers, from inputs u (N, nu)."""
    return u[:, [index for _, index, _ in Actuation(state).torquers]]


def magnetic_torque(state: StateMap, poses: Array, u: Array, flux: Array) -> Array:
    """Return the sum (N, 3) [N m] of the torques of all magnetorquers, in world axes.

    `poses` (N, njoints - 1, 7) are the poses of the bodies, and `flux` (N, 3) is in world axes.
    """
    total = np.zeros((len(flux), 3))
    for joint, index, axis in Actuation(state).torquers:
        rotation = rotation_matrices(poses[:, joint - ROOT, 3:])
        total += u[:, index, None] * (rotation @ axis)
    return np.cross(total, flux)


def scales(robot: Robot, values: Array) -> list[float]:
    """Return the moment [A m^2] of the longest arrow of each magnetorquer.

    It is the limit of the magnetorquer. Magnetorquers without a limit share the largest of all
    moments `values` (N, k).
    """
    largest = float(np.abs(values).max(initial=0.0))
    items = [item for item in robot.inputs if isinstance(item, Magnetorquer)]
    return [largest if item.max is None else float(np.max(item.max)) for item in items]
