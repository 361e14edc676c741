"""States of a whole motion at once, linear state feedback, and errors from a reference motion."""

from collections.abc import Callable
from itertools import compress
from typing import Any, TypeAlias

import numpy as np
import pinocchio as pin

from fflin.base import rotation as turning
from fflin.base.validation import Array
from fflin.dynamics.names import ANGULAR, IN_REFERENCE_AXES, LINEAR
from fflin.dynamics.state import StateMap

Readout: TypeAlias = Callable[[Array, Array], Array]

_placement = pin.XYZQUATToSE3
_TURN = 2.0 * np.pi


def states_of(state: StateMap, q: Array, nu: Array) -> Array:
    """Return the states (N, nx) of rows of valid q (N, nq) and nu (N, 6 + n) in base axes."""
    return state.compose(state.charts(q), state.positions(q), state.joint_positions(q), nu)


def state_history(
    state: StateMap, q: Array, v: Array, near: Array | None = None, t: Array | None = None
) -> Array:
    """Return the states (N, nx) of a motion; continuous joints count turns, from `near` on."""
    # With the times t (N,) as many turns as the rates make between rows, else less than half of
    # one.
    rates = state.velocities(v)
    x = states_of(state, q, rates)
    q_m = x[:, state.groups.q_m]
    before = np.zeros(q_m.shape[1]) if near is None else near[state.groups.q_m]
    if (k := state.unbounded).size:
        q_m[:, k] = np.unwrap(np.vstack((before, q_m))[:, k], axis=0)[1:]
        if t is not None:
            turned = 0.5 * np.diff(t)[:, None] * (rates[1:, 6 + k] + rates[:-1, 6 + k])
            turns = np.round((turned - np.diff(q_m[:, k], axis=0)) / _TURN)
            q_m[1:, k] += _TURN * turns.cumsum(axis=0)
    return x


def attitude_errors(x: Array, target: Array) -> Array:
    """Return the angles (N,) [deg] between the attitudes of states and of a target, or of rows."""
    at, to = x[:, :3], target[..., :3]
    # By columns, which are long.
    (x, y, z), (a, b, c) = at.T, to.T
    w, d = (np.sqrt(np.maximum(0.0, 1.0 - (i * i + j * j + k * k))) for i, j, k in (at.T, to.T))
    # The vector part of target^-1 at, whose length is that of half the angle's sine.
    p = d * x - w * a - (b * z - c * y)
    q = d * y - w * b - (c * x - a * z)
    r = d * z - w * c - (a * y - b * x)
    sines: Array = np.minimum(1.0, np.sqrt(p * p + q * q + r * r))
    return np.degrees(2.0 * np.arctan2(sines, np.abs(d * w + a * x + b * y + c * z)))


def readout(state: StateMap, K: Array, offset: Array, near: Array) -> Readout:
    """Return f(q, v) = offset - K x(q, v) (m,), with joints on the turn nearest to `near`."""
    # The attitude is linear in the quaternion, the place in the base's, and velocities in reference
    # axes in R v: one product with all these gives f, in a fifth of the time of the state.
    robot, g = state.robot, state.groups
    idx_q = np.array([joint.idx_q for joint in robot.joints], dtype=np.intp)
    circling, cos = state.unbounded, idx_q[state.unbounded]
    middle = near[g.q_m][circling]
    # Of q, v, the angles of continuous joints, R omega, R v and 1.
    ends = np.cumsum((robot.nq, robot.nv, len(circling), 3, 3))
    gains = np.zeros((len(K), ends[-1] + 1))
    of_q, of_v, of_angles, of_angular, of_linear, constant = np.split(gains, ends, axis=1)
    at = state.origin
    of_q[:, :3] = -K[:, g.r_b] @ at.rotation
    turn = turning.product_matrix(state.origin_quaternion)
    of_q[:, 3:7] = -K[:, g.q_b] @ turn[:3]
    constant[:, 0] = offset - K[:, g.r_b] @ at.translation
    of_q_m = -K[:, g.q_m]
    of_q[:, idx_q] = of_q_m
    of_q[:, cos] = 0.0
    of_angles[:] = of_q_m[:, circling]
    of_rates = -K[:, 6 + robot.n :].copy()
    for part, turned, of_part in zip(
        (ANGULAR, LINEAR), state.axes, (of_angular, of_linear), strict=True
    ):
        if turned:
            of_part[:] = of_rates[:, part] @ at.rotation
            of_rates[:, part] = 0.0
    of_v[:] = state.lift(of_rates.T).T

    z = np.zeros(gains.shape[1])
    z[-1] = 1.0
    z_q, z_v, z_angles, z_angular, z_linear, _ = np.split(z, ends)
    z_turn, scalar = z_q[3:7], turn[3]
    turned_angular, turned_linear = state.axes

    def f(q: Array, v: Array) -> Array:
        z_q[:], z_v[:] = q, v
        if scalar.dot(z_turn) < 0.0:
            z_turn[:] = -z_turn
        if cos.size:
            angles = np.arctan2(q.take(cos + 1), q.take(cos))
            z_angles[:] = angles + _TURN * np.round((middle - angles) / _TURN)
        if turned_linear:
            R = _placement(q[:7]).rotation
            z_linear[:] = R.dot(v[:3])
            if turned_angular:
                z_angular[:] = R.dot(v[3:6])
        return gains.dot(z)

    return f


def moving_errors(frame: str, x: Array, target: Array) -> Array:
    """Return the errors (N, nx) of states from a moving reference, in its axes (9.5)."""
    e, (turn, R), (turn_target, R_target) = x - target, _turned(x), _turned(target)
    # The vector part of target^-1 x, on the side that is nearer.
    q_b, q_target, scalar = x[:, :3], target[:, :3], (turn * turn_target)
    scalar = scalar + (q_b * q_target).sum(axis=1, keepdims=True)
    e[:, :3] = turn_target * q_b - turn * q_target - np.cross(q_target, q_b)
    e[:, :3] *= np.where(scalar < 0.0, -1.0, 1.0)
    e[:, 3:6] = (e[:, None, 3:6] @ R_target)[:, 0]
    for rows in _in_reference(frame, x.shape[1]):
        e[:, rows] = (x[:, None, rows] @ R - target[:, None, rows] @ R_target)[:, 0]
    return e


def moved_by(frame: str, target: Array, e: Array) -> Array:
    """Return the states (N, nx) whose `moving_errors` are e; not finite if |q_b| exceeds 1."""
    x, (turn_target, R_target), (turn, R) = target + e, _turned(target), _turned(e)
    q_e, q_target = e[:, :3], target[:, :3]
    x[:, :3] = turn_target * q_e + turn * q_target + np.cross(q_target, q_e)
    scalar = turn * turn_target - (q_e * q_target).sum(axis=1, keepdims=True)
    x[:, :3] *= np.where(scalar < 0.0, -1.0, 1.0)
    x[:, 3:6] = target[:, 3:6] + (R_target @ e[:, 3:6, None])[..., 0]
    R = R_target @ R
    for rows in _in_reference(frame, x.shape[1]):
        own = (target[:, None, rows] @ R_target)[:, 0] + e[:, rows]
        x[:, rows] = (R @ own[..., None])[..., 0]
    return x


def _turned(x: Array) -> tuple[Array, Array]:
    """Return the scalar part (N, 1) of the attitude of states, not negative, and the rotation."""
    scalar = np.sqrt(1.0 - (x[:, :3] ** 2).sum(axis=1, keepdims=True))
    return scalar, turning.rotation_matrices(np.hstack((x[:, :3], scalar)))


def _in_reference(frame: str, nx: int) -> list[Any]:
    """Return the rows of the base velocities in reference axes."""
    velocities = np.arange(nx)[nx // 2 :]
    return [velocities[part] for part in compress((ANGULAR, LINEAR), IN_REFERENCE_AXES[frame])]


def moving_error(state: StateMap, q_star: Array, v_star: Array, q: Array, v: Array) -> Array:
    """Return the error (nx,) from a moving reference, in its axes."""
    g = state.groups
    e = np.empty(state.nx)
    turned = turning.quaternion_product(turning.conjugate(q_star[3:7]), q[3:7])
    e[g.q_b] = turned[:3] if turned[3] >= 0.0 else -turned[:3]
    e[g.r_b] = turning.rotation_matrix(q_star[3:7]).T @ (q[:3] - q_star[:3])
    e[g.q_m] = state.joints_apart(q_star, q)
    e[-6 - state.robot.n :] = state.velocities(v - v_star)
    return e
