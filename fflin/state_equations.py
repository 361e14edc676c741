"""A: the kinematics, and the accelerations' slopes carried into the chart and the frame."""

import numpy as np

from fflin.actuation import Actuation
from fflin.rates import Rates
from fflin.rotation import skew
from fflin.state import ANGULAR, LINEAR, Chart, StateMap
from fflin.validation import Array

# Of a base that stands at the reference.
STANDING = Chart(np.zeros(3), 1.0, np.eye(3))


def at_rest(state: StateMap) -> Array:
    """Return A (nx, nx) where nothing moves, pulls or pushes: N in its upper right block."""
    nv = 6 + state.robot.n
    A: Array = np.zeros((state.nx, state.nx))
    A[:nv, nv:] = np.diag([0.5] * 3 + [1.0] * (nv - 3))
    return A


def state_equations(
    A_at_rest: Array,
    state: StateMap,
    actuation: Actuation,
    chart: Chart,
    rates: Rates,
    nu: Array,
    u: Array,
) -> tuple[Array, Array, Array]:
    """Return A (nx, nx), B (nx, nu) and f0 (nx,); `nu` (6 + n,) and `u` (nu,) in base axes."""
    groups, nv = state.groups, len(nu)
    A = A_at_rest.copy()
    _set_kinematics(A, state, chart, nu)
    lower = A[-nv:]
    lower[:, groups.q_m] = rates.by_q_m
    lower[:, -nv:] = rates.by_nu
    B: Array = np.zeros((state.nx, len(u)))
    B[-nv:] = rates.by_u
    c = rates.c.copy()
    _set_turning(lower, state, actuation, chart, (nu, u, c), rates)
    f0: Array = np.concatenate((nu, c))
    f0[groups.q_b] *= 0.5
    if chart is not STANDING:
        f0[groups.q_b] = chart.Q @ f0[groups.q_b]
        f0[groups.r_b] = chart.R @ f0[groups.r_b]
        for rows in (f0[nv:], lower, lower[:, -nv:].T, B[-nv:]):
            state.to_frame(chart, rows)
        for columns, _ in actuation.held:
            B[:, columns] = B[:, columns] @ chart.R.T
    return A, B, f0


def _set_kinematics(A: Array, state: StateMap, chart: Chart, nu: Array) -> None:
    """Set what the motion changes in the rows of q_b and r_b; `nu` (6 + n,) in base axes."""
    g, (turned_angular, turned_linear) = state.groups, state.axes
    w, Q, J, R = nu[ANGULAR], chart.Q, chart.J, chart.R
    slope = -0.5 * skew(w)
    if chart is not STANDING:
        slope -= np.outer(0.5 * w, chart.q_b / chart.q0)
        A[g.q_b, g.omega_b] = 0.5 * Q @ R.T if turned_angular else 0.5 * Q
    if turned_angular:
        slope += 0.5 * Q.dot(skew(w)).dot(J)
    A[g.q_b, g.q_b] = slope
    if not turned_linear:
        A[g.r_b, g.v_b] = R
        A[g.r_b, g.q_b] = -R.dot(skew(nu[LINEAR])).dot(J)


def _set_turning(
    lower: Array,
    state: StateMap,
    actuation: Actuation,
    chart: Chart,
    point: tuple[Array, Array, Array],
    rates: Rates,
) -> None:
    r"""Complete the velocity rows (6 + n, nx) for what is held in which axes.

    `point` is (nu, u, c): velocity (6 + n,) and input (nu,) in base axes, and the acceleration
    (6 + n,) of the base origin and the joints in base axes, without gravity.

    A turn :math:`\delta\theta` of the base under a vector s held in reference axes
    changes its base components by :math:`[s]_\times \delta\theta`: so the velocities,
    inputs and gravity that are held in reference axes change, and the accelerations turn
    back. A v_b in base axes has the rate :math:`c + g - \omega \times v_b`. The rate in the
    frame is left in `c`.
    """
    groups = state.groups
    turned_angular, turned_linear = state.axes
    nu, u, c = point
    w, v = nu[ANGULAR], nu[LINEAR]
    turn = np.zeros((len(nu), 3))
    for columns, _ in actuation.held:
        turn += rates.by_u[:, columns].dot(skew(u[columns]))
    if turned_angular:
        turn += lower[:, groups.omega_b].dot(skew(w))
        turn[ANGULAR] -= skew(c[ANGULAR])
    if turned_linear:
        turn[LINEAR] -= skew(c[LINEAR])
    else:
        turning = skew(w)
        lower[LINEAR, groups.omega_b] += skew(v)
        lower[LINEAR, groups.v_b] -= turning
        turn[LINEAR] += skew(rates.gravity)
        c[LINEAR] -= turning.dot(v)
    c[LINEAR] += rates.gravity
    lower[:, groups.q_b] = turn.dot(chart.J)
