"""Derivatives over a parameter of bodies, held against differences of another route."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from fflin.base.errors import InputError
from fflin.base.validation import Array
from fflin.dynamics.aba import Aba
from fflin.dynamics.state import StateMap
from fflin.linear.certificate import aba_route
from fflin.linear.sampling import held_exponential
from fflin.uncertainty.model_slopes import ModelSlopes, with_bodies
from fflin.uncertainty.parameters import Parameter

if TYPE_CHECKING:
    from fflin.uncertainty.sensitivity import Slope

# Of a difference over a parameter, relative to what M has of it.
_STEP = 2e-3
# Smaller changes by such a step, of A or B, are in their rounding.
_LEAST = 1e-6


def difference(slopes: ModelSlopes, one: Parameter, slope: Slope) -> float:
    """Return how far fourth-order differences of A and B over a parameter are from its slope."""
    if not one.bodies:
        raise InputError(f"'{one.name}' is no parameter of a body; only these are checked so")
    lin, robot = slopes.lin, slopes.robot
    step = _STEP / slopes.bodies.share(one.bodies)

    def at(times: float) -> tuple[Array, Array]:
        model = robot.model.copy()
        for joint, body in with_bodies(robot, one, times * step).items():
            model.inertias[joint] = body
        state = StateMap(replace(robot, model=model), reference=lin.reference, frame=lin.frame)
        route = aba_route(state, Aba(state), lin.q, lin.v, lin.u0, moving=lin.moving)
        return held_exponential(*route[:2], lin.dt) if lin.dt else route[:2]

    worst = 0.0
    for *stepped, now, exact in zip(
        *map(at, (-2.0, -1.0, 1.0, 2.0, 0.0)), (slope.dA, slope.dB), strict=True
    ):
        far, near, nearer, farther = stepped
        by_steps = (far - 8.0 * near + 8.0 * nearer - farther) / (12.0 * step)
        size = max(np.abs(by_steps).max(), _LEAST * np.abs(now).max() / step)
        worst = max(worst, float(np.abs(by_steps - exact).max() / size))
    return worst
