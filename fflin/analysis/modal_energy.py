"""Kinetic energy of the bodies of a robot in a mode shape."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin

from fflin.analysis.momentum import ReducedModel
from fflin.dynamics.chart import Chart
from fflin.dynamics.state import StateMap
from fflin.linear.model import LinearModel
from fflin.robot.frames import ROOT

if TYPE_CHECKING:
    from fflin.robot.robot import Robot


def energy_by_body(
    robot: Robot | None, lin: LinearModel, shapes: Sequence[Any]
) -> list[Mapping[str, float]]:
    """Return {body: fraction of the kinetic energy} of shapes (nx,), see `Mode`.

    Without a robot the mappings are empty.
    """
    if robot is None:
        return [{} for _ in shapes]
    state = StateMap(robot, reference=lin.reference, frame=lin.frame)
    chart, data = state.chart(lin.q), robot.create_data()
    names = ("base", *list(robot.model.names)[ROOT + 1 :])
    inertias = robot.model.inertias.tolist()[ROOT:]
    found: list[Mapping[str, float]] = []
    for shape in shapes:
        # All velocities of a mode are its pole times the displacements.
        moved = displacement(lin, chart, shape)
        energies = np.zeros(len(names))
        for part in (moved.real, moved.imag):
            pin.forwardKinematics(robot.model, data, lin.q, state.spread(part))
            twists = data.v.tolist()[ROOT:]
            energies += [body.vtiv(V) for body, V in zip(inertias, twists, strict=True)]
        fractions = energies / energies.sum()
        order = np.argsort(-fractions.round(9), kind="stable").tolist()
        found.append({names[i]: float(fractions[i]) for i in order})
    return found


def displacement(lin: LinearModel, chart: Chart, shape: Any) -> Any:
    """Return the displacements (6 + n,) of a shape: rotation and translation in base axes."""
    moved = shape[: len(shape) // 2]
    if isinstance(lin, ReducedModel):
        moved = lin.T[: len(lin.T) // 2, : len(moved)] @ moved
    turned, shifted = chart.J @ moved[:3], chart.R.T @ moved[3:6]
    return np.concatenate((turned, shifted, moved[6:]))
