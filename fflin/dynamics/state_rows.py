"""States of motions with one row per time, errors of states, and laws of the state."""

from __future__ import annotations

from collections.abc import Callable
from itertools import compress

import numpy as np
import pinocchio as pin

from fflin.base import rotation as turning
from fflin.base.rotation import rotation_matrices, rotation_matrix
from fflin.base.validation import Array, Indices
from fflin.dynamics.coordinates import ANGULAR, IN_REFERENCE_AXES, LINEAR, TURN
from fflin.dynamics.state import StateMap


def states_of(state: StateMap, q: Array, nu: Array) -> Array:
    """Return the states (.., nx) at configurations q (.., nq) and velocities nu (.., 6 + n).

    nu is in base axes. The arguments are not checked.
    """
    return state.compose(
        state.charts(q), state.positions(q), state.joint_positions(q), nu
    )


def readout(
    state: StateMap, K: Array, offset: Array, near: Array
) -> Callable[[float, Array, Array], Array]:
    """Return the law u(t, q, v) = offset - K x(q, v), which a policy evaluates at each sample.

    In the state x, the angles of continuous joints are within half a turn of `near` (nx,).
    """
    # The state is x = S z. The vector z consists of q, v, the angles of continuous joints, omega_b
    # and v_b in world axes, and 1. So u = offset - K S z is one matrix-vector product, which takes
    # a fifth of the time of computing x.
    robot = state.robot
    g = state.groups
    idx_q = np.array([joint.idx_q for joint in robot.joints], dtype=np.intp)
    scales = np.array([joint.scale for joint in robot.joints])
    continuous = state.unbounded
    cosines = idx_q[continuous]  # indices in q; the sines follow their cosines
    sines = cosines + 1
    middle = near[g.q_m][continuous]
    omega_in_reference, v_in_reference = state.axes
    origin = state.origin
    quaternion_map = turning.product_matrix(state.origin_quaternion)

    # Views of the columns of S for each part of z.
    ends = np.cumsum((robot.nq, robot.nv, len(continuous), 3, 3))
    S = np.zeros((state.nx, ends[-1] + 1))
    S_q, S_v, S_angles, S_omega, S_linear, S_one = np.split(S, ends, axis=1)
    S_q[g.q_b, 3:7] = quaternion_map[:3]
    S_q[g.r_b, :3] = origin.rotation
    S_one[g.r_b, 0] = origin.translation
    S_q[g.q_m][np.arange(robot.n), idx_q] = 1.0 / scales
    S_q[:, cosines] = 0.0
    S_angles[6 + continuous] = np.eye(len(continuous))
    S_v[6 + robot.n :] = state.velocities(np.eye(robot.nv)).T
    if omega_in_reference:
        S_v[g.omega_b] = 0.0
        S_omega[g.omega_b] = origin.rotation
    if v_in_reference:
        S_v[g.v_b] = 0.0
        S_linear[g.v_b] = origin.rotation
    gains = -K @ S
    gains[:, -1] += offset

    # Views of the parts of z, into which the law writes.
    z = np.zeros(gains.shape[1])
    z[-1] = 1.0
    z_q, z_v, z_angles, z_omega, z_linear, _ = np.split(z, ends)
    z_quaternion = z_q[3:7]
    q0_map = quaternion_map[3]

    def law(_: float, q: Array, v: Array) -> Array:
        z_q[:] = q
        z_v[:] = v
        # Both signs of a quaternion are the same attitude. The chart needs q0 >= 0.
        if q0_map.dot(z_quaternion) < 0.0:
            z_quaternion[:] = -z_quaternion
        if cosines.size:
            angles = np.arctan2(q.take(sines), q.take(cosines))
            z_angles[:] = angles + TURN * np.round((middle - angles) / TURN)
        if v_in_reference:
            R = pin.XYZQUATToSE3(q[:7]).rotation
            z_linear[:] = R.dot(v[:3])
            if omega_in_reference:  # never without v_in_reference
                z_omega[:] = R.dot(v[3:6])
        u: Array = gains.dot(z)
        return u

    return law


def state_history(
    state: StateMap,
    q: Array,
    v: Array,
    near: Array | None = None,
    t: Array | None = None,
) -> Array:
    """Return the states (N, nx) of a motion, with the angles of continuous joints unwrapped.

    The first angles are within half a turn of `near` (nx,), or of 0 if `near` is None.
    """
    # If the times t (N,) are given, the joint rates determine how many turns a joint makes from one
    # row to the next. Without times, each angle is assumed to change by less than half a turn.
    rates = state.velocities(v)
    x = states_of(state, q, rates)
    q_m = x[:, state.groups.q_m]
    before = np.zeros(q_m.shape[1]) if near is None else near[state.groups.q_m]
    if (k := state.unbounded).size:
        q_m[:, k] = np.unwrap(np.vstack((before, q_m))[:, k], axis=0)[1:]
        if t is not None:
            turned = 0.5 * np.diff(t)[:, None] * (rates[1:, 6 + k] + rates[:-1, 6 + k])
            turns = np.round((turned - np.diff(q_m[:, k], axis=0)) / TURN)
            q_m[1:, k] += TURN * turns.cumsum(axis=0)
    return x


def attitude_errors(x: Array, target: Array) -> Array:
    """Return the angles (N,) [deg] between the attitudes of states x (N, nx) and of targets.

    `target` is one state (nx,) for all rows of x, or one state for each row (N, nx).
    """
    turned, scalar = _apart(x, target)
    angles: Array = 2.0 * np.arctan2(
        np.linalg.norm(turned, axis=1), np.abs(scalar[:, 0])
    )
    return np.degrees(angles)


def attitude_rotations(x: Array, target: Array) -> Array:
    """Return the rotation vectors (N, 3) [rad] from attitudes of targets to attitudes of states.

    The vectors are in target axes. `target` is one state (nx,), or one for each row of x (N, nx).
    """
    turned, scalar = _apart(x, target)
    turned = turned * np.where(scalar < 0.0, -1.0, 1.0)
    half = np.linalg.norm(turned, axis=1, keepdims=True)
    angle = 2.0 * np.arctan2(half, np.abs(scalar))
    rotations: Array = turned * np.divide(
        angle, half, out=np.full_like(half, 2.0), where=half > 0.0
    )
    return rotations


def _apart(x: Array, target: Array) -> tuple[Array, Array]:
    """Return the rotation from the target attitude to the attitude of each state in x (N, nx).

    The rotations are unit quaternions, with vector parts (N, 3) and scalar parts (N, 1).
    """
    at, to = x[:, :3], target[..., :3]
    w, d = (
        np.sqrt(np.maximum(0.0, 1.0 - (q_b * q_b).sum(axis=-1, keepdims=True)))
        for q_b in (at, to)
    )
    return d * at - w * to - np.cross(to, at), w * d + (at * to).sum(
        axis=-1, keepdims=True
    )


def moving_errors(frame: str, x: Array, target: Array) -> Array:
    """Return the errors (N, nx) of states x (N, nx) from moving targets (5.1).

    Each target (nx,) is a state, and its base axes are the target axes. Attitude and position
    errors are in target axes. The error of a base velocity is the velocity of the state in the base
    axes of this state, minus the velocity of the target in target axes.
    """
    _, R = _turned(x)
    _, R_target = _turned(target)
    e = x - target
    turned, scalar = _apart(x, target)
    e[:, :3] = turned * np.where(scalar < 0.0, -1.0, 1.0)
    e[:, 3:6] = (e[:, None, 3:6] @ R_target)[:, 0]
    for rows in _in_reference(frame, x.shape[1]):
        e[:, rows] = (x[:, None, rows] @ R - target[:, None, rows] @ R_target)[:, 0]
    return e


def moved_by(frame: str, target: Array, e: Array) -> Array:
    """Return the states (N, nx) whose errors from targets (N, nx) are e (N, nx).

    This function is the inverse of `moving_errors`. If an error has |q_b| > 1, the returned state
    has the attitude NaN, and its base velocities in reference axes are NaN too.
    """
    scalar_target, R_target = _turned(target)
    scalar_e, R_e = _turned(e)
    q_e, q_target = e[:, :3], target[:, :3]
    # product of the quaternions of target and error, with a scalar that is not negative
    vector = scalar_target * q_e + scalar_e * q_target + np.cross(q_target, q_e)
    scalar = scalar_e * scalar_target - (q_e * q_target).sum(axis=1, keepdims=True)
    x = target + e
    x[:, :3] = vector * np.where(scalar < 0.0, -1.0, 1.0)
    offset = R_target @ e[:, 3:6, None]
    x[:, 3:6] = target[:, 3:6] + offset[..., 0]
    R = R_target @ R_e
    for rows in _in_reference(frame, x.shape[1]):
        target_velocity = (target[:, None, rows] @ R_target)[:, 0]
        velocity = target_velocity + e[:, rows]
        x[:, rows] = (R @ velocity[..., None])[..., 0]
    return x


def _turned(x: Array) -> tuple[Array, Array]:
    """Return the quaternion scalar q0 >= 0 (N, 1) and the rotation matrix (N, 3, 3) of states."""
    scalar = np.sqrt(1.0 - (x[:, :3] ** 2).sum(axis=1, keepdims=True))
    return scalar, rotation_matrices(np.hstack((x[:, :3], scalar)))


def _in_reference(frame: str, nx: int) -> list[Indices]:
    """Return the state indices (3,) of each base velocity that is in reference axes.

    The frame named `frame` determines the axes of omega_b and v_b.
    """
    velocities = np.arange(nx)[nx // 2 :]
    return [
        velocities[part]
        for part in compress((ANGULAR, LINEAR), IN_REFERENCE_AXES[frame])
    ]


def moving_error(
    state: StateMap, q_star: Array, v_star: Array, q: Array, v: Array
) -> Array:
    """Return the error (nx,) of (q, v) from a moving reference (q_star, v_star), as in (5.1).

    Attitude and position errors are in the axes of the reference. The velocity error is v - v_star
    in state order, where v is in base axes and v_star is in the axes of the reference.
    """
    g = state.groups
    e = np.empty(state.nx)
    turned = turning.quaternion_product(turning.conjugate(q_star[3:7]), q[3:7])
    if turned[3] < 0.0:
        turned = -turned
    e[g.q_b] = turned[:3]
    e[g.r_b] = rotation_matrix(q_star[3:7]).T @ (q[:3] - q_star[:3])
    e[g.q_m] = state.joints_apart(q_star, q)
    e[-6 - state.robot.n :] = state.velocities(v - v_star)
    return e
