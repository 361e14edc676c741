"""A, B and f0, assembled from accelerations and their derivatives at one or many points.

Equation numbers refer to docs/derivation.md.
"""

from functools import partial

import numpy as np

from fflin.base.rotation import skew
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
    B_lower: Array,
    *,
    moving: bool,
) -> Array:
    """Write A and the lower half of B, and return f0 (.., nx)."""
    g, dot = state.groups, slice(state.nx // 2, state.nx)
    omega_in_reference, v_in_reference = state.axes
    w, v = nu[..., ANGULAR], nu[..., LINEAR]
    W = skew(w)
    by_turn = _over_turns(state, actuation, nu, u, rates)
    if state.orbit:  # (14.5)
        spin = chart.R.mT @ state.orbit[0]
        by_turn[..., ANGULAR, :] += W @ skew(spin)
    F = partial(chart.to_reference, state.in_reference)

    # Attitude and position.
    # Q R^T = Q^T.
    A[..., g.q_b, g.omega_b] = chart.N.mT if omega_in_reference else chart.N  # (4.1)
    by_q_b = chart.rate_over_q_b(w, W)
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
    F(chart.over_q_b(by_turn), out=A[..., dot, g.q_b])  # (4.6)
    F(rates.by_q_m, out=A[..., dot, g.q_m])
    F(F(rates.by_nu.mT, out=A[..., dot, dot].mT).mT, out=A[..., dot, dot])
    F(actuation.over_inputs(chart, rates.by_u, out=B_lower), out=B_lower)  # (4.7)
    a = rates.c.copy()
    a[..., LINEAR] += rates.gravity
    if state.orbit:  # (14.6)
        turn, pull = state.orbit
        A[..., g.v_b, g.r_b], A[..., g.v_b, g.v_b] = pull, 0.0 - 2.0 * skew(turn)
        A[..., g.omega_b, g.omega_b] -= skew(spin)
        a[..., ANGULAR] += times(W, spin)
        a[..., LINEAR] -= 2.0 * times(skew(spin), v)
    if not v_in_reference:
        A[..., g.v_b, g.omega_b] += V  # (4.5)
        A[..., g.v_b, g.v_b] -= W
        a[..., LINEAR] -= times(W, v)  # (3.2)

    f0 = chart.rate(w), chart.rotated(v), nu[..., 6:], F(a[..., None])[..., 0]  # (4.8)
    return np.concatenate(f0, -1)


def _over_turns(state: StateMap, actuation: Actuation, nu: Array, u: Array, rates: Rates) -> Array:
    """Return the derivatives of the rates over base rotations, Theta (.., 6 + n, 3) of (4.4)."""
    omega_in_reference, v_in_reference = state.axes
    by_turn = np.zeros((*nu.shape, 3)) + rates.by_turn
    for columns, _ in actuation.held:
        by_turn += rates.by_u[..., columns] @ skew(u[..., columns])
    if omega_in_reference:
        by_turn += rates.by_nu[..., ANGULAR] @ skew(nu[..., ANGULAR])
        by_turn[..., ANGULAR, :] -= skew(rates.c[..., ANGULAR])
    if v_in_reference:
        by_turn[..., LINEAR, :] -= skew(rates.c[..., LINEAR])
    else:
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
