"""Curves of goals in closed loops for figures: gains over frequency and step responses."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from fflin.base.validation import Array
from fflin.tuning.channels import Channel, Ends
from fflin.tuning.closed_loop import ClosedLoop
from fflin.tuning.criteria import gains_at, grid_of, scaled, weights_at
from fflin.tuning.goals import Goal, Margin, MaxGain, RollOff, Track
from fflin.tuning.verification import step_errors

# Frequencies of a curve, and how far it extends beyond the least and the largest pole.
_POINTS, _BEYOND = 400, 10.0

# Instants of the step response of a continuous loop.
_INSTANTS = 1501

# Largest ratio of the frequencies of a curve.
_RANGE = 1e5


@dataclass(frozen=True, eq=False)
class GoalLoops:
    """Goal with its closed loops in the models of a search, the nominal model first.

    `scaling` contains the logarithms of the factors of the channels of a margin.
    """

    goal: Goal
    ends: Ends | None
    loops: tuple[tuple[ClosedLoop, Channel | None], ...]
    scaling: Array


class Curves(NamedTuple):
    """Curves (m, k) of a goal over frequencies [rad/s] or times [s] (k,), one for each model.

    `low` and `high` (k,) are the limits; they are infinite where the goal has none.
    """

    title: str
    where: Array
    values: Array
    low: Array
    high: Array
    over_time: bool


def curves_of(item: GoalLoops) -> Curves | None:
    """Return the curves of a goal; None for goals of poles and of variances."""
    goal, ends = item.goal, item.ends
    if ends is None or not item.loops:
        return None
    if isinstance(goal, Track):
        return _steps(goal, item)
    if not isinstance(goal, MaxGain | RollOff | Margin):
        return None
    factors = np.exp(item.scaling) if isinstance(goal, Margin) else None
    grid = _frequencies(item.loops[0][0], ends)
    rows = []
    for loop, channel in item.loops:
        assert channel is not None
        system = scaled(loop.system(channel), factors)
        weights = weights_at(loop, ends, grid)
        rows.append(gains_at(loop, system, ends, grid) / weights)
    plant = item.loops[0][0].plant
    limit = 1.0 / weights_at(item.loops[0][0], ends, grid)
    times = np.array([plant.time(w) for w in grid.tolist()])
    low, high = ends.band
    limit = np.where((times >= low) & (times <= high), limit, math.inf)
    nothing = np.full(len(grid), -math.inf)
    return Curves(goal.label, times, np.array(rows), nothing, limit, False)


def _frequencies(loop: ClosedLoop, ends: Ends) -> Array:
    """Return frequencies [rad/s] of the plant: equally spaced in the logarithm, and at poles."""
    everywhere = Ends(
        ends.sources, ends.sinks, ends.source_sizes, ends.sink_sizes, ends.weight
    )
    examined = grid_of(loop, everywhere)
    examined = examined[np.isfinite(examined) & (examined > 0.0)]
    sizes = np.abs(loop.poles)
    sizes = sizes[sizes > 0.0]
    least, most = sizes.min() / _BEYOND, sizes.max() * _BEYOND
    low, high = (loop.plant.warped(end) for end in ends.band)
    least = min(least, max(low, least * 1e-3) / _BEYOND)
    if math.isfinite(low):
        most = max(most, low * _BEYOND)
    if loop.plant.dt:
        most = min(most, _BEYOND / loop.plant.dt)
    least = max(least, most / _RANGE)
    grid = np.geomspace(least, most, _POINTS)
    inside = examined[(examined > least) & (examined < most)]
    edges = [end for end in (low, high) if least < end < most]
    return np.unique(np.concatenate((grid, inside, edges)))


def _steps(goal: Track, item: GoalLoops) -> Curves:
    """Return the step responses of a goal with its template."""
    rows = []
    times: Array = np.linspace(0.0, goal.examined, _INSTANTS)
    for loop, channel in item.loops:
        assert channel is not None
        dt = loop.plant.dt
        instants, errors = step_errors(goal, loop.system(channel), dt)
        if dt:
            times = instants
        rows.append(1.0 + np.interp(times, instants, errors))
    low, high = goal.bounds(times)
    return Curves(goal.label, times, np.array(rows), 1.0 + low, 1.0 + high, True)
