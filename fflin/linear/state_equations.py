"""A: the kinematics, and the accelerations' slopes carried into the chart and the frame."""

from typing import NamedTuple

import numpy as np

from fflin.base.rotation import skew
from fflin.base.validation import Array
from fflin.dynamics.actuation import Actuation
from fflin.dynamics.chart import Chart
from fflin.dynamics.state import ANGULAR, LINEAR, StateMap


class Point(NamedTuple):
    """A point or many, each with a leading axis of them; all in base axes.

    Attributes
    ----------
    nu : ndarray (.., 6 + n)
        Velocity.
    u : ndarray (.., nu)
        Input.
    c : ndarray (.., 6 + n)
        Acceleration of the base origin and the joints, without gravity and omega x v_b.
    gravity : ndarray (3,) or (.., 3)
    """

    nu: Array
    u: Array
    c: Array
    gravity: Array


# Of a base that stands at the reference.
STANDING = Chart(np.zeros(3), 1.0, np.eye(3))


def at_rest(state: StateMap) -> Array:
    """Return A (nx, nx) where nothing moves, pulls or pushes: N in its upper right block."""
    nv = 6 + state.robot.n
    A: Array = np.zeros((state.nx, state.nx))
    A[:nv, nv:] = np.diag([0.5] * 3 + [1.0] * (nv - 3))
    return A


def state_equations(
    state: StateMap,
    actuation: Actuation,
    chart: Chart,
    point: Point,
    A: Array,
    B_lower: Array,
) -> Array:
    """Complete A and B in place with the kinematics, chart and frame, and return f0 (.., nx).

    All arguments may be of many points, each with a leading axis of them.

    Parameters
    ----------
    state : StateMap
    actuation : Actuation
    chart : Chart
    point : Point
    A : ndarray (.., nx, nx)
        In its upper half that at rest; in its lower the slopes of c over q_m and the velocities in
        base axes, and zeros for q_b and r_b.
    B_lower : ndarray (.., 6 + n, nu)
        The slopes of c over the inputs in base axes.
    """
    groups, nv = state.groups, state.nx // 2
    nu, u, c = point.nu, point.u, point.c.copy()
    _set_kinematics(A, state, chart, nu)
    lower = A[..., nv:, :]
    _set_turning(lower, B_lower, state, actuation, chart, (nu, u, c), point.gravity)
    f0 = np.concatenate((nu, c), axis=-1)
    f0[..., groups.q_b] *= 0.5
    if chart is not STANDING:
        f0[..., groups.q_b] = turned(chart.Q, f0[..., groups.q_b])
        f0[..., groups.r_b] = turned(chart.R, f0[..., groups.r_b])
        for rows in (f0[..., nv:, None], lower, lower[..., nv:].mT, B_lower):
            _to_frame(state, chart, rows)
        for columns, _ in actuation.held:
            B_lower[..., columns] = B_lower[..., columns] @ chart.R.mT
    return f0


def turned(matrices: Array, vectors: Array) -> Array:
    """Return matrices (.., 3, 3) times vectors (.., 3)."""
    product: Array = (matrices @ vectors[..., None])[..., 0]
    return product


def _turned_columns(chart: Chart, by_turn: Array) -> Array:
    """Return slopes (.., k, 3) over turns of the base as slopes over q_b."""
    return 2.0 * by_turn if chart is STANDING else by_turn @ chart.J


def _to_frame(state: StateMap, chart: Chart, vectors: Array) -> None:
    """Turn velocities or wrenches (.., 6 + n, k) in place from base axes to the frame's."""
    for rows, held in zip((ANGULAR, LINEAR), state.axes, strict=True):
        if held:
            vectors[..., rows, :] = chart.R @ vectors[..., rows, :]


def ride_along(state: StateMap, point: Point, A: Array, f0: Array) -> Array:
    """Make A (.., nx, nx) and f0 (.., nx) those of the error from a reference that moves along.

    The reference turns and flies with the point, so that the error does not.

    Returns
    -------
    ndarray (.., nx)
        The reference's own rate, that of its attitude without turns about gravity.
    """
    groups = state.groups
    turning = skew(point.nu[..., ANGULAR])
    A[..., groups.q_b, groups.q_b] = A[..., groups.r_b, groups.r_b] = -turning
    drift: Array = f0.copy()
    weight = (point.gravity * point.gravity).sum(axis=-1, keepdims=True)
    if weight.any():
        rate = drift[..., groups.q_b]
        along = (rate * point.gravity).sum(axis=-1, keepdims=True) / weight
        rate -= along * point.gravity
    f0[...] = 0.0
    return drift


def _set_kinematics(A: Array, state: StateMap, chart: Chart, nu: Array) -> None:
    """Set what the motion changes in the rows of q_b and r_b; `nu` (.., 6 + n) in base axes."""
    g, (turned_angular, turned_linear) = state.groups, state.axes
    w, Q, J, R = nu[..., ANGULAR], chart.Q, chart.J, chart.R
    turning = skew(w)
    slope = -0.5 * turning
    if chart is not STANDING:
        slope -= 0.5 * w[..., :, None] * (chart.q_b / chart.q0)[..., None, :]
        A[..., g.q_b, g.omega_b] = 0.5 * (Q @ R.mT if turned_angular else Q)
    if turned_angular:
        slope += 0.5 * (Q @ turning @ J)
    A[..., g.q_b, g.q_b] = slope
    if not turned_linear:
        A[..., g.r_b, g.v_b] = R
        A[..., g.r_b, g.q_b] = -_turned_columns(chart, R @ skew(nu[..., LINEAR]))


def _set_turning(
    lower: Array,
    B_lower: Array,
    state: StateMap,
    actuation: Actuation,
    chart: Chart,
    rates: tuple[Array, Array, Array],
    gravity: Array,
) -> None:
    r"""Complete the velocity rows (.., 6 + n, nx) for what is held in which axes.

    `rates` is (nu, u, c): velocity (.., 6 + n) and input (.., nu) in base axes, and the
    acceleration (.., 6 + n) of the base origin and the joints in base axes, without gravity.

    A turn :math:`\delta\theta` of the base under a vector s held in reference axes
    changes its base components by :math:`[s]_\times \delta\theta`: so the velocities,
    inputs and gravity that are held in reference axes change, and the accelerations turn
    back. A v_b in base axes has the rate :math:`c + g - \omega \times v_b`. The rate in the
    frame is left in `c`.
    """
    groups = state.groups
    turned_angular, turned_linear = state.axes
    nu, u, c = rates
    w, v = nu[..., ANGULAR], nu[..., LINEAR]
    turn = np.zeros((*nu.shape, 3))
    for columns, _ in actuation.held:
        turn += B_lower[..., columns] @ skew(u[..., columns])
    if turned_angular:
        turn += lower[..., groups.omega_b] @ skew(w)
        turn[..., ANGULAR, :] -= skew(c[..., ANGULAR])
    if turned_linear:
        turn[..., LINEAR, :] -= skew(c[..., LINEAR])
    else:
        turning = skew(w)
        lower[..., LINEAR, groups.omega_b] += skew(v)
        lower[..., LINEAR, groups.v_b] -= turning
        turn[..., LINEAR, :] += skew(gravity)
        c[..., LINEAR] -= turned(turning, v)
    c[..., LINEAR] += gravity
    lower[..., groups.q_b] = _turned_columns(chart, turn)
