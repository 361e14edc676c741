"""C and D: the derivatives of the outputs carried into the chart, the frame and the inputs.

Numbers of equations are those of docs/derivation.md.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from fflin.base.rotation import skew
from fflin.base.validation import Array
from fflin.dynamics.actuation import Actuation
from fflin.dynamics.chart import Chart
from fflin.dynamics.rnea import Rates
from fflin.dynamics.state import ANGULAR, LINEAR, StateMap

if TYPE_CHECKING:
    from fflin.dynamics.output_kinds import Sensed


def output_equations(
    state: StateMap,
    actuation: Actuation,
    chart: Chart,
    sensed: Sensed,
    rates: Rates,
    nu: Array,
    u: Array,
) -> tuple[Array, Array]:
    """Return C (ny, nx) and D (ny, nu) of the outputs that are not states."""
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
        D[:] = actuation.over_inputs(chart, by_u)  # (8.3)
    for turned, part in zip(state.axes, (ANGULAR, LINEAR), strict=True):
        if turned:
            turn += by_nu[:, part].dot(skew(nu[part]))

    C = np.zeros((len(by_q), state.nx))
    C[:, g.q_b] = chart.over_q_b(turn)  # (8.2)
    C[:, g.r_b] = by_q[:, LINEAR].dot(chart.R.T)
    C[:, g.q_m] = by_q_m  # (8.3)
    C[:, -len(nu) :] = state.to_frame(chart, by_nu.T).T
    return C, D
