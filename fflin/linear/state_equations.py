"""A, B and f0, assembled from accelerations and their derivatives at one or many points.

Equation numbers refer to docs/derivation.md.
"""

import numpy as np

from fflin.base.rotation import product, skew
from fflin.base.validation import Array
from fflin.dynamics.actuation import Actuation
from fflin.dynamics.chart import Chart, times
from fflin.dynamics.names import ANGULAR, LINEAR
from fflin.dynamics.rnea import Rates
from fflin.dynamics.state import StateMap


def at_rest(state: StateMap) -> Array:
    """Return A (nx, nx) at rest without forces, with N in its upper right block (2.1)."""
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
    g, nv, lower = state.groups, state.nx // 2, rates.slopes
    omega_in_reference, v_in_reference = state.axes
    w, v = nu[..., ANGULAR], nu[..., LINEAR]
    W = skew(w)
    by_turn = _over_turns(state, actuation, u, rates, w, W)
    f0 = np.concatenate((chart.rate(w), chart.rotated(v), nu[..., 6:], rates.c), -1)  # (4.8)
    if state.orbit:  # (14.5)
        spin = chart.R.mT @ state.orbit[0]
        by_turn[..., ANGULAR, :] += W @ skew(spin)

    # Attitude and position; `at_rest` is what does not change at the reference.
    if moving:
        A[..., g.q_b, g.q_b] = A[..., g.r_b, g.r_b] = -W  # (5.2), (5.3)
    else:
        by_q_b = chart.rate_over_q_b(w, W)
        if omega_in_reference:
            by_q_b += chart.over_q_b(product(chart.N, W))
        A[..., g.q_b, g.q_b] = by_q_b  # (4.2)
    if not chart.standing:
        # Q R^T = Q^T.
        A[..., g.q_b, g.omega_b] = chart.N.mT if omega_in_reference else chart.N  # (4.1)
        if not v_in_reference:
            A[..., g.r_b, g.v_b] = chart.R
    if not v_in_reference:
        V = skew(v)
        A[..., g.r_b, g.q_b] = -chart.over_q_b(chart.turned(V))  # (4.3)

    # Accelerations.
    chart.over_q_b(by_turn, out=lower[..., g.q_b])
    if not chart.standing:
        chart.turn_rows(state.in_reference, lower)  # (4.6)
        chart.turn_columns(state.in_reference, lower[..., nv:])
        chart.turn_rows(state.in_reference, rates.by_u)  # (4.7)
        actuation.turn_columns(chart, rates.by_u)
    if state.falls:
        f0[..., g.v_b] += rates.gravity
    if state.orbit:  # (14.6)
        turn, pull = state.orbit
        A[..., g.v_b, g.r_b], A[..., g.v_b, g.v_b] = pull, 0.0 - 2.0 * skew(turn)
        A[..., g.omega_b, g.omega_b] -= skew(spin)
        f0[..., g.omega_b] += times(W, spin)
        f0[..., g.v_b] -= 2.0 * times(skew(spin), v)
    if not v_in_reference:
        A[..., g.v_b, g.omega_b] += V  # (4.5)
        A[..., g.v_b, g.v_b] -= W
        f0[..., g.v_b] -= times(W, v)  # (3.2)
    if not chart.standing:
        chart.turn_rows(state.in_reference, f0[..., nv:, None])
    return f0


def _over_turns(
    state: StateMap, actuation: Actuation, u: Array, rates: Rates, w: Array, W: Array
) -> Array:
    """Return the derivatives of the rates over base rotations, Theta (.., 6 + n, 3) of (4.4)."""
    omega_in_reference, v_in_reference = state.axes
    by_turn, c = rates.by_turn.copy(), rates.c
    for columns, _ in actuation.held:
        by_turn += product(rates.by_u[..., columns], skew(u[..., columns]))
    if omega_in_reference:
        by_turn += product(rates.by_nu[..., ANGULAR], W)
        by_turn[..., ANGULAR, :] -= skew(c[..., ANGULAR])
    if v_in_reference:
        by_turn[..., LINEAR, :] -= skew(c[..., LINEAR])
    elif state.falls:
        by_turn[..., LINEAR, :] += skew(rates.gravity)
    return by_turn


def drift(state: StateMap, f0: Array, gravity: Array) -> Array:
    """Return the own rate (.., nx) of a reference that moves along, after (5.3)."""
    rate: Array = f0.copy()
    weight = (gravity * gravity).sum(axis=-1, keepdims=True)
    if weight.any():
        turning = rate[..., state.groups.q_b]
        turning -= (turning * gravity).sum(axis=-1, keepdims=True) / weight * gravity
    return rate
