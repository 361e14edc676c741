"""C and D: derivatives of the outputs, transformed to the chart, the frame and the inputs.

Equation numbers refer to docs/derivation.md.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pinocchio as pin

from fflin.base.rotation import skew
from fflin.base.validation import Array
from fflin.dynamics.chart import Chart
from fflin.dynamics.names import ANGULAR, LINEAR
from fflin.dynamics.rnea import Rates
from fflin.linear.prepared import Prepared


def output_equations(
    ready: Prepared, data: pin.Data, chart: Chart, rates: Rates, x0: Array, point: Sequence[Array]
) -> dict[str, Array]:
    """Return C, D and y0 at a point: q, v, and nu (6 + n,) and u (nu,) in base axes."""
    sensing, state, actuation, a = ready.sensing, ready.map, ready.actuation, rates.c.copy()
    q, v, nu, u = point
    assert sensing is not None
    if sensing.needs_acceleration:
        a[LINEAR] += rates.gravity - skew(nu[ANGULAR]).dot(nu[LINEAR])  # (3.2)
    sensed = sensing.evaluate(data, q, v, state.spread(a))
    g = state.groups
    by_q, by_nu = state.columns(sensed.by_q), state.columns(sensed.by_v)
    turn, by_q_m = by_q[:, ANGULAR].copy(), by_q[:, 6:]
    D: Array = np.zeros((len(by_q), len(u)))
    if sensed.by_a is not None:
        by_rate = state.columns(sensed.by_a)
        rate_by_nu = rates.by_nu.copy()
        rate_by_nu[LINEAR, ANGULAR] += skew(nu[LINEAR])  # (4.5)
        rate_by_nu[LINEAR, LINEAR] -= skew(nu[ANGULAR])
        by_nu += by_rate.dot(rate_by_nu)
        by_q_m = by_q_m + by_rate.dot(rates.by_q_m)
        turn += by_rate[:, LINEAR].dot(skew(rates.gravity))
        by_u = by_rate.dot(rates.by_u)
        for columns, _ in actuation.held:
            turn += by_u[:, columns].dot(skew(u[columns]))
        actuation.turn_columns(chart, by_u)
        D[:] = by_u  # (8.3)
    for turned, part in zip(state.axes, (ANGULAR, LINEAR), strict=True):
        if turned:
            turn += by_nu[:, part].dot(skew(nu[part]))

    C = np.zeros((len(by_q), state.nx))
    C[:, g.q_b] = chart.over_q_b(turn)  # (8.2)
    C[:, g.r_b] = by_q[:, LINEAR].dot(chart.R.T)
    C[:, g.q_m] = by_q_m  # (8.3)
    C[:, -len(nu) :] = state.to_frame(chart, by_nu.T).T
    for row, index in sensing.states:
        C[row, index] = 1.0
        sensed.y[row] = x0[index]
    return {"C": C, "D": D, "y0": sensed.y}
