"""Assembly of A, B, f0, C and D from accelerations, outputs and their derivatives.

Equation numbers refer to docs/derivation.md.
"""

from collections.abc import Sequence

import numpy as np
import pinocchio as pin

from fflin.base.rotation import product, skew
from fflin.base.validation import Array
from fflin.dynamics.contact import Contact
from fflin.dynamics.coordinates import ANGULAR, LINEAR, Chart, times
from fflin.dynamics.outputs import Sensing
from fflin.dynamics.rnea import AccelerationDerivatives, Turning
from fflin.dynamics.state import Actuation, StateMap


def assemble(
    actuation: Actuation,
    chart: Chart,
    nu: Array,
    u: Array,
    rates: AccelerationDerivatives,
    A: Array,
    *,
    moving: bool,
    turning: Turning | None = None,
) -> Array:
    """Complete A (.., nx, nx) and the lower half of B for one or many points; return f0 (.., nx).

    On entry, the upper half of A must be [0, N], as at rest (2.1). `rates.slopes` must be a view of
    the lower half of A. `rates.by_u` is the lower half of B. On entry, both arrays must contain
    derivatives in base axes. The function converts both in place to the chart and the frame. `nu`
    and `u` are in base axes. `turning` is required in an elliptic orbit, and in orbit if v_b is in
    base axes.
    """
    state = actuation.state
    g = state.groups
    nv = state.nx // 2
    lower = rates.slopes
    omega_in_reference, v_in_reference = state.axes
    w, v = nu[..., ANGULAR], nu[..., LINEAR]
    W = skew(w)
    position_rate = chart.turned(v[..., None])[..., 0]
    # (4.8)
    f0 = np.concatenate((chart.rate(w), position_rate, nu[..., 6:], rates.c), -1)

    D_theta = _rotation_derivative(actuation, chart, nu, u, rates, W, turning)
    lower[..., g.q_b] = chart.over_q_b(D_theta)

    # Write the rows of attitude and position. If the base is at the reference, do not write the
    # columns of the velocities in these rows: they are the same as at rest (2.1).
    if moving:
        A[..., g.q_b, g.q_b] = A[..., g.r_b, g.r_b] = -W  # (5.2), (5.3)
    else:
        by_q_b = chart.rate_over_q_b(w, W)
        if omega_in_reference:
            # Add N W J. At the reference, N W J is W, because N = E/2 and J = 2 E.
            by_turn = W if chart.at_reference else chart.over_q_b(product(chart.N, W))
            by_q_b += by_turn
        A[..., g.q_b, g.q_b] = by_q_b  # (4.2)
    if not chart.at_reference:
        # Q R^T = Q^T.
        # (4.1)
        A[..., g.q_b, g.omega_b] = chart.N.mT if omega_in_reference else chart.N
        if not v_in_reference:
            A[..., g.r_b, g.v_b] = chart.R

    # Rotate the rows of the accelerations from base axes to the axes of the frame.
    if not chart.at_reference:
        chart.turn_rows(state.in_reference, lower)  # (4.6)
        _turn_columns(state, chart, rates)
        chart.turn_rows(state.in_reference, rates.by_u)  # (4.7)
        chart.turn_rows(actuation.held, rates.by_u.mT)
    if state.falls:
        f0[..., g.v_b] += rates.gravity
    if state.orbit:  # (14.2), (14.5), (14.6)
        _add_orbit(state, chart, turning, A)
        spin = _spin(state, chart, turning)
        f0[..., g.omega_b] += times(W, spin)
        f0[..., g.v_b] -= 2.0 * times(skew(spin), v)
        if state.elliptic:  # (17.1)
            assert turning is not None
            f0[..., g.omega_b] -= turning.spin_change
    if not v_in_reference:
        V = skew(v)
        A[..., g.r_b, g.q_b] = -chart.over_q_b(chart.turned(V))  # (4.3)
        A[..., g.v_b, g.omega_b] += V  # (4.5)
        A[..., g.v_b, g.v_b] -= W
        f0[..., g.v_b] -= times(W, v)  # (3.2)
    if not chart.at_reference:
        chart.turn_rows(state.in_reference, f0[..., nv:, None])
    return f0


def _turn_columns(
    state: StateMap, chart: Chart, rates: AccelerationDerivatives
) -> None:
    """Convert the columns of the base in the accelerations' derivatives to the frame, in place."""
    omega_in_reference, v_in_reference = state.axes
    if omega_in_reference:
        chart.turn_rows((ANGULAR,), rates.by_nu.mT)
    if state.robot.anchored:
        # For other robots, the columns of the base's position and linear velocity are zero.
        chart.turn_rows((LINEAR,), rates.slopes.mT)
        if v_in_reference:
            chart.turn_rows((LINEAR,), rates.by_nu.mT)


def _spin(state: StateMap, chart: Chart, turning: Turning | None) -> Array:
    """Return the angular velocity (.., 3) of the orbital frame in base axes."""
    if state.axes[1] and state.orbit:
        spin: Array = chart.R.mT @ state.orbit[0]
        return spin
    assert turning is not None
    return turning.spin


def _add_orbit(
    state: StateMap, chart: Chart, turning: Turning | None, A: Array
) -> None:
    """Add the terms of an orbit to the blocks of A for the velocities of the base (14.6)."""
    g = state.groups
    assert state.orbit is not None
    spin = _spin(state, chart, turning)
    A[..., g.omega_b, g.omega_b] -= skew(spin)
    if state.axes[1]:
        turn, pull = state.orbit
        A[..., g.v_b, g.r_b] = pull
        A[..., g.v_b, g.v_b] = 0.0 - 2.0 * skew(turn)
        return
    # The rows of the linear acceleration are in base axes. With `moving`, the position is too.
    assert turning is not None
    pull = turning.pull
    if not chart.at_reference:
        pull = product(pull, chart.R.mT)
    A[..., g.v_b, g.r_b] = pull
    A[..., g.v_b, g.v_b] -= 2.0 * skew(spin)


def _rotation_derivative(
    actuation: Actuation,
    chart: Chart,
    nu: Array,
    u: Array,
    rates: AccelerationDerivatives,
    W: Array,
    turning: Turning | None,
) -> Array:
    """Return D_theta (.., 6 + n, 3): the derivative of the accelerations by base rotations (4.4).

    `nu` and `u` are in base axes. The result may be the array `rates.by_turn`, changed in place.
    """
    state = actuation.state
    c = rates.c
    omega_in_reference, v_in_reference = state.axes
    D_theta = rates.by_turn  # zero without an orbit
    anchored = state.robot.anchored
    if omega_in_reference:
        # In orbit, omega is in base axes. So here `rates.by_turn` is zero unless it is anchored.
        turned = product(rates.by_nu[..., ANGULAR], W)
        D_theta = D_theta + turned if anchored else turned
    if v_in_reference and anchored:
        D_theta = D_theta + product(rates.by_nu[..., LINEAR], skew(nu[..., LINEAR]))
    if np.count_nonzero(u):
        # A wrench that is fixed in reference axes turns relative to the base.
        for columns in actuation.held:
            turned = product(rates.by_u[..., columns], skew(u[..., columns]))
            D_theta = D_theta + turned
    # The rows are views: changing them in place changes D_theta. This is faster than
    # `D_theta[rows] -= y`, which also copies the result back.
    angular_rows = D_theta[..., ANGULAR, :]
    linear_rows = D_theta[..., LINEAR, :]
    if omega_in_reference:
        angular_rows -= skew(c[..., ANGULAR])
    if v_in_reference:
        linear_rows -= skew(c[..., LINEAR])
    elif state.falls:
        linear_rows += skew(rates.gravity)
    if state.orbit:  # (14.5)
        spin_cross = skew(_spin(state, chart, turning))
        angular_rows += product(W, spin_cross)
        if state.elliptic:  # (17.1)
            assert turning is not None
            angular_rows -= skew(turning.spin_change)
        if not v_in_reference:
            linear_rows += 2.0 * product(skew(nu[..., LINEAR]), spin_cross)
    return D_theta


def drift(state: StateMap, f0: Array, gravity: Array) -> Array:
    """Return the state derivative (.., nx) of a moving reference (section 5).

    f0 is the state derivative of the robot. Under gravity, the result is f0 without the rotation
    about the vertical, because a rotation about the vertical does not affect the dynamics of a
    robot that is not anchored.
    """
    if not state.falls or state.orbit or state.robot.anchored:
        return f0
    weight = (gravity * gravity).sum(axis=-1, keepdims=True)
    if not np.count_nonzero(weight):
        return f0
    rate: Array = f0.copy()
    turning = rate[..., state.groups.q_b]
    turning -= (turning * gravity).sum(axis=-1, keepdims=True) / weight * gravity
    return rate


def output_equations(
    sensing: Sensing,
    actuation: Actuation,
    data: pin.Data,
    chart: Chart,
    rates: AccelerationDerivatives,
    x0: Array,
    point: Sequence[Array],
    contact: Contact | None = None,
) -> dict[str, Array]:
    """Return C, D and y0 at one point.

    `point` consists of q and v in Pinocchio's order, and of nu (6 + n,) and u (nu,) in base axes.
    `contact` contains the constraint forces, if there are any.
    """
    state = sensing.state
    a = rates.c.copy()
    q, v, nu, u = point
    if sensing.needs_acceleration:
        a[LINEAR] += rates.gravity - skew(nu[ANGULAR]).dot(nu[LINEAR])  # (3.2)
    sensed = sensing.evaluate(data, q, v, state.spread(a))
    g = state.groups
    by_q, by_nu = state.columns(sensed.by_q), state.columns(sensed.by_v)
    turn = by_q[:, ANGULAR].copy()
    by_position = by_q[:, LINEAR].copy()
    by_q_m = by_q[:, 6:]
    D: Array = np.zeros((len(by_q), len(u)))
    if sensing.needs_acceleration:
        by_rate = state.columns(sensed.by_a)
        rate_by_nu = rates.by_nu.copy()
        rate_by_nu[LINEAR, ANGULAR] += skew(nu[LINEAR])  # (4.5)
        rate_by_nu[LINEAR, LINEAR] -= skew(nu[ANGULAR])
        by_nu += by_rate.dot(rate_by_nu)
        by_q_m = by_q_m + by_rate.dot(rates.by_q_m)
        turn += by_rate[:, LINEAR].dot(skew(rates.gravity))
        if state.robot.anchored:
            turn += by_rate.dot(rates.by_turn)
            by_position += by_rate.dot(rates.by_position)
        by_u = by_rate.dot(rates.by_u)
        for rows, components in sensing.forces:
            assert contact is not None
            contact.require_determinate(sensing.names[rows], components)
            by_x = components.dot(contact.forces_by_x)
            sensed.y[rows] = components.dot(contact.forces)
            turn[rows] = by_x[:, ANGULAR]
            by_position[rows] = by_x[:, LINEAR]
            by_q_m[rows] = by_x[:, 6 : len(nu)]
            by_nu[rows] = by_x[:, len(nu) :]
            by_u[rows] = components.dot(contact.forces_by_u)
        for columns in actuation.held:
            turn += by_u[:, columns].dot(skew(u[columns]))
        chart.turn_rows(actuation.held, by_u.mT)
        D[:] = by_u  # (8.3)
    for turned, part in zip(state.axes, (ANGULAR, LINEAR), strict=True):
        if turned:
            turn += by_nu[:, part].dot(skew(nu[part]))

    C = np.zeros((len(by_q), state.nx))
    C[:, g.q_b] = chart.over_q_b(turn)  # (8.2)
    C[:, g.r_b] = by_position.dot(chart.R.T)
    C[:, g.q_m] = by_q_m  # (8.3)
    C[:, -len(nu) :] = state.to_frame(chart, by_nu.T).T
    for row, index in sensing.states:
        C[row, index] = 1.0
        sensed.y[row] = x0[index]
    return {"C": C, "D": D, "y0": sensed.y}
