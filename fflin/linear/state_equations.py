"""A, B and f0 of the accelerations and their slopes, at a point or at many.

Numbers of equations are those of docs/derivation.md.
"""

import numpy as np

from fflin.base.rotation import skew
from fflin.base.validation import Array
from fflin.dynamics.actuation import Actuation
from fflin.dynamics.chart import Chart, times
from fflin.dynamics.names import ANGULAR, LINEAR
from fflin.dynamics.rnea import Rates
from fflin.dynamics.state import StateMap


def at_rest(state: StateMap) -> Array:
    """Return A (nx, nx) where nothing moves, pulls or pushes: N in its upper right block (2.1)."""
    nv = state.nx // 2
    A: Array = np.zeros((state.nx, state.nx))
    A[:nv, nv:] = np.diag([0.5] * 3 + [1.0] * (nv - 3))
    return A


def assemble(
    state: StateMap,
    actuation: Actuation,
    chart: Chart,
    nu: Array,
    u: Array,
    rates: Rates,
    A: Array,
    *,
    moving: bool,
) -> Array:
    """Write A (.., nx, nx) and the lower half of B about one point or many; return f0 (.., nx).

    The rates' slopes are A's lower half itself, and their by_u that of B: both are carried from
    base axes to the chart and frame where they stand. A's upper half is that of `at_rest`.
    """
    g, nv = state.groups, state.nx // 2
    omega_in_reference, v_in_reference = state.axes
    w, v = nu[..., ANGULAR], nu[..., LINEAR]
    W = skew(w)
    by_turn, by_nu = rates.by_turn, rates.by_nu
    _add_turns(state, actuation, u, rates, w, W)
    if state.orbit:  # (14.5)
        spin = chart.R.mT @ state.orbit[0]
        by_turn[..., ANGULAR, :] += W @ skew(spin)

    # Attitude and position.
    by_q_b = chart.rate_over_q_b(w, W)
    if not chart.standing:
        # Q R^T = Q^T.
        A[..., g.q_b, g.omega_b] = chart.N.mT if omega_in_reference else chart.N  # (4.1)
    if omega_in_reference:
        by_q_b += chart.over_q_b(chart.N @ W)
    A[..., g.q_b, g.q_b] = by_q_b  # (4.2)
    if not v_in_reference:
        V = skew(v)
        A[..., g.r_b, g.q_b] = -chart.over_q_b(chart.R @ V)  # (4.3)
        A[..., g.r_b, g.v_b] = chart.R
    if moving:
        A[..., g.q_b, g.q_b] = -W  # (5.2)
        A[..., g.r_b, g.r_b] = -W  # (5.3)

    # Accelerations.
    by_turn[...] = chart.over_q_b(by_turn)
    chart.turn(state.in_reference, rates.slopes)  # (4.6)
    chart.turn(state.in_reference, by_nu.mT)
    chart.turn(state.in_reference, rates.by_u)  # (4.7)
    actuation.turn_columns(chart, rates.by_u)
    a = rates.c.copy()
    a[..., LINEAR] += rates.gravity
    if state.orbit:  # (14.6)
        turn, pull = state.orbit
        A[..., g.v_b, g.r_b], by_nu[..., LINEAR, LINEAR] = pull, 0.0 - 2.0 * skew(turn)
        by_nu[..., ANGULAR, ANGULAR] -= skew(spin)
        a[..., ANGULAR] += times(W, spin)
        a[..., LINEAR] -= 2.0 * times(skew(spin), v)
    if not v_in_reference:
        by_nu[..., LINEAR, ANGULAR] += V  # (4.5)
        by_nu[..., LINEAR, LINEAR] -= W
        a[..., LINEAR] -= times(W, v)  # (3.2)
    chart.turn(state.in_reference, a[..., None])
    return np.concatenate((chart.rate(w), chart.rotated(v), nu[..., 6:], a), -1)  # (4.8)


def _add_turns(
    state: StateMap, actuation: Actuation, u: Array, rates: Rates, w: Array, W: Array
) -> None:
    """Make the slopes over turns of the base Theta (.., 6 + n, 3) of (4.4)."""
    omega_in_reference, v_in_reference = state.axes
    by_turn, c = rates.by_turn, rates.c
    for columns, _ in actuation.held:
        by_turn += rates.by_u[..., columns] @ skew(u[..., columns])
    if omega_in_reference:
        by_turn += rates.by_nu[..., ANGULAR] @ W
        by_turn[..., ANGULAR, :] -= skew(c[..., ANGULAR])
    if v_in_reference:
        by_turn[..., LINEAR, :] -= skew(c[..., LINEAR])
    else:
        by_turn[..., LINEAR, :] += skew(rates.gravity)


def drift(state: StateMap, f0: Array, gravity: Array) -> Array:
    """Return the own rate (.., nx) of a reference that moves along, after (5.3)."""
    rate: Array = f0.copy()
    weight = (gravity * gravity).sum(axis=-1, keepdims=True)
    if weight.any():
        turning = rate[..., state.groups.q_b]
        turning -= (turning * gravity).sum(axis=-1, keepdims=True) / weight * gravity
    return rate
