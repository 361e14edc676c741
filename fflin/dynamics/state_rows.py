"""The state, read off many points at once, and combinations of it straight off one point."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np
import pinocchio as pin

from fflin.base.rotation import product_matrix
from fflin.base.validation import Array
from fflin.dynamics.state import ANGULAR, LINEAR, StateMap

Readout: TypeAlias = Callable[[Array, Array], Array]

_placement = pin.XYZQUATToSE3


def states_of(state: StateMap, q: Array, v: Array, near: Array | None = None) -> Array:
    """Return the states (N, nx) of a motion, rows of valid q (N, nq) and v (N, nv).

    Continuous joints go on counting turns, from the turn nearest to `near` (nx,). A turn of pi,
    where the chart ends, gives one of its two values.
    """
    robot, g, at = state.robot, state.groups, state.origin
    x = np.empty((len(q), state.nx))
    quaternion = q[:, 3:7] @ product_matrix(pin.SE3ToXYZQUAT(at)[3:]).T
    quaternion *= np.where(quaternion[:, 3:] < 0.0, -1.0, 1.0)
    vectors, scalars = quaternion[:, :3], quaternion[:, 3:]
    x[:, g.q_b] = vectors
    x[:, g.r_b] = at.translation + q[:, :3] @ at.rotation.T
    for k, joint in enumerate(robot.joints):
        if joint.unbounded:
            angles = np.arctan2(q[:, joint.idx_q + 1], q[:, joint.idx_q])
            first = 0.0 if near is None else near[6 + k]
            x[:, 6 + k] = np.unwrap(np.concatenate(((first,), angles)))[1:]
        else:
            x[:, 6 + k] = q[:, joint.idx_q]
    nu = v[:, state.velocities(np.arange(float(robot.nv))).astype(int)]
    for part, turned in zip((ANGULAR, LINEAR), state.axes, strict=True):
        if turned:
            once = np.cross(vectors, nu[:, part]) + scalars * nu[:, part]
            nu[:, part] += 2.0 * np.cross(vectors, once)
    x[:, 6 + robot.n :] = nu
    return x


def readout(state: StateMap, K: Array, offset: Array, near: Array) -> Readout:
    r"""Return f(q, v) = offset - K x(q, v), x being the state of valid q and v.

    The attitude is linear in the quaternion, the place in the base's, and velocities in reference
    axes in R v: one product with all these gives f. That takes a fifth of the time of the state.

    Parameters
    ----------
    state : StateMap
    K : ndarray (m, nx)
    offset : ndarray (m,)
    near : ndarray (nx,)
        A state; the angle of each continuous joint is taken on the turn nearest to it.
    """
    robot, g = state.robot, state.groups
    nq, nv = robot.nq, robot.nv
    joints = robot.joints
    circling = [joint for joint in joints if joint.unbounded]
    cos = np.array([joint.idx_q for joint in circling], dtype=np.intp)
    middle = np.array([near[6 + joints.index(joint)] for joint in circling])
    # Of q, v, the angles of continuous joints, R omega, R v and 1.
    gains = np.zeros((len(K), nq + nv + len(circling) + 7))
    of_q, of_v, of_angles, of_angular, of_linear, constant = np.split(
        gains, np.cumsum((nq, nv, len(circling), 3, 3)), axis=1
    )
    at = state.origin
    of_q[:, :3] = -K[:, g.r_b] @ at.rotation
    turn = product_matrix(pin.SE3ToXYZQUAT(at)[3:])
    of_q[:, 3:7] = -K[:, g.q_b] @ turn[:3]
    constant[:, 0] = offset - K[:, g.r_b] @ at.translation
    for k, joint in enumerate(joints):
        column = -K[:, g.q_m][:, k]
        if joint.unbounded:
            of_angles[:, circling.index(joint)] = column
        else:
            of_q[:, joint.idx_q] = column
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
    z_q, z_v, z_angles, z_angular, z_linear, _ = np.split(
        z, np.cumsum((nq, nv, len(circling), 3, 3))
    )
    z_turn, scalar = z_q[3:7], turn[3]
    turned_angular, turned_linear = state.axes

    def f(q: Array, v: Array) -> Array:
        z_q[:], z_v[:] = q, v
        if scalar.dot(z_turn) < 0.0:
            z_turn[:] = -z_turn
        if circling:
            angles = np.arctan2(q.take(cos + 1), q.take(cos))
            z_angles[:] = angles + _TURN * np.round((middle - angles) / _TURN)
        if turned_linear:
            R = _placement(q[:7]).rotation
            z_linear[:] = R.dot(v[:3])
            if turned_angular:
                z_angular[:] = R.dot(v[3:6])
        result: Array = gains.dot(z)
        return result

    return f


_TURN = 2.0 * np.pi
