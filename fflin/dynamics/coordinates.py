"""Coordinates of the state: names, units, axes, the attitude chart, and state errors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from itertools import compress
from operator import attrgetter
from typing import TYPE_CHECKING, ClassVar, Literal, NamedTuple, cast, get_args

import numpy as np
import pinocchio as pin

from fflin.base import rotation as turning
from fflin.base.errors import InputError
from fflin.base.rotation import product, rotation_matrices, rotation_matrix, skew
from fflin.base.validation import Array, Indices
from fflin.robot.inputs import BaseForce, BaseTorque
from fflin.robot.robot import Robot

if TYPE_CHECKING:
    from fflin.dynamics.state import StateMap

Frame = Literal["hybrid", "local", "world", "lvlh", "hill"]

# Frames of a circular orbit. If a robot is in orbit, one of these frames replaces Pinocchio's world
# frame.
ORBITAL: tuple[Frame, ...] = ("lvlh", "hill")

# For each frame, two flags. The first is true if omega_b and tau_b are in reference axes, and false
# if they are in base axes. The second flag is the same for v_b and F_b.
IN_REFERENCE_AXES: dict[str, tuple[bool, bool]] = {
    "hybrid": (False, True),
    "local": (False, False),
    "world": (True, True),
    **dict.fromkeys(ORBITAL, (False, True)),
}

# Slices of the base's angular and linear parts in velocities and generalised forces (6 + n,) in
# state order.
ANGULAR, LINEAR = slice(0, 3), slice(3, 6)
# Slices of the same two parts in Pinocchio's v and spatial vectors, where the linear part is first.
PIN_LINEAR, PIN_ANGULAR = slice(0, 3), slice(3, 6)


def frame_of(robot: Robot, frame: object) -> Frame:
    """Return the frame, or the default frame of the robot if `frame` is None.

    Raise `InputError` if the frame is unknown. Also raise it if the frame is orbital but the robot
    is not in orbit, or if the robot is in orbit but the frame is not orbital.
    """
    if frame is None:
        return ORBITAL[0] if robot.orbit else "hybrid"
    if not isinstance(frame, str) or frame not in get_args(Frame):
        raise InputError(
            f"frame is {frame!r}, expected one of {', '.join(get_args(Frame))}"
        )
    if (frame in ORBITAL) != bool(robot.orbit):
        where = "in no orbit"
        remedy = (
            "use hybrid, local or world, or give the robot an orbit (orbit=, --orbit)"
        )
        if robot.orbit:
            where = "in an orbit"
            remedy = f"use {' or '.join(ORBITAL)}"
        raise InputError(f"frame is '{frame}', but '{robot.name}' is {where}; {remedy}")
    return cast("Frame", frame)


def refuse_orbit(robot: Robot, what: str) -> None:
    """Raise `InputError` if a robot is in orbit; `what` names the feature that is unsupported."""
    if getattr(robot, "orbit", None):
        raise InputError(
            f"{what} are defined only without an orbit, but '{robot.name}' is in orbit; remove the "
            "orbit with robot.replace(orbit=None)"
        )


class Groups(NamedTuple):
    """Slices of the state (1.1), one for each of its six vectors."""

    q_b: slice
    r_b: slice
    q_m: slice
    omega_b: slice
    v_b: slice
    qdot_m: slice


def _axes_of(**units: str) -> dict[str, str]:
    """Return {component: unit} of all x, y and z components, from `units` {vector: unit}."""
    return {f"{name}.{axis}": unit for name, unit in units.items() for axis in "xyz"}


_POSE, _TWIST = _axes_of(q_b="1", r_b="m"), _axes_of(omega_b="rad/s", v_b="m/s")


def state_units(robot: Robot) -> dict[str, str]:
    """Return {name: unit} of the 12 + 2n states, in state order."""
    q_m, qdot_m = dict[str, str](), dict[str, str]()
    for joint in robot.joints:
        unit = joint.unit
        q_m[f"q_m.{joint.name}"] = unit
        qdot_m[f"qdot_m.{joint.name}"] = f"{unit}/s"
    return _POSE | q_m | _TWIST | qdot_m


def forces_of(robot: Robot) -> dict[str, str]:
    """Return {name: unit} of the 6 + n generalised forces, in state order."""
    tau_m = {f"tau_m.{joint.name}": joint.force_unit for joint in robot.joints}
    return _axes_of(tau_b=BaseTorque.UNIT, F_b=BaseForce.UNIT) | tau_m


# If q0 is below the square root of the machine epsilon, q0 = sqrt(1 - |q_b|^2) has no correct digit
# because of cancellation.
SMALLEST_Q0 = float(np.sqrt(np.finfo(float).eps))

_IDENTITY = np.eye(3)


@dataclass(frozen=True)
class Chart:
    """Attitude chart (section 1 of docs/derivation.md) at one or many attitudes of the base.

    The attitudes are relative to the reference. refMb is the placement of the base relative to the
    reference.
    """

    standing: ClassVar[bool] = False  # whether all attitudes are equal to the reference

    q_b: Array  # vector part (.., 3) of the quaternion of refMb
    q0: float | Array  # scalar part (.., 1) of this quaternion, at least 0
    R: Array  # refMb.rotation (.., 3, 3)

    @classmethod
    def of(cls, quaternion: Array) -> Chart:
        """Return the chart at unit quaternions (.., 4) of refMb, each of arbitrary sign."""
        if quaternion.ndim == 1:
            if quaternion[3] < 0.0:
                quaternion = -quaternion
            return cls(
                quaternion[:3], float(quaternion[3]), rotation_matrix(quaternion)
            )
        quaternion = quaternion * np.where(quaternion[..., 3:] < 0.0, -1.0, 1.0)
        return cls(
            quaternion[..., :3], quaternion[..., 3:], rotation_matrices(quaternion)
        )

    @cached_property
    def N(self) -> Array:
        """Matrix N = Q / 2 (.., 3, 3) of d q_b/dt = N omega, with omega in base axes (1.2)."""
        return 0.5 * (np.asarray(self.q0)[..., None] * _IDENTITY + skew(self.q_b))

    @cached_property
    def J(self) -> Array:
        """Matrix J (.., 3, 3) of ``d theta = J d q_b``, with d theta in base axes (1.3)."""
        # Q^-1 = Q^T + q_b q_b^T / q0.
        return 2.0 * (
            2.0 * self.N.mT
            + self.q_b[..., :, None] * (self.q_b / self.q0)[..., None, :]
        )

    def rate(self, omega: Array) -> Array:
        """Return d q_b/dt (.., 3) for the angular velocity omega (.., 3) in base axes (1.2)."""
        if self.standing:
            return 0.5 * omega
        return times(self.N, omega)

    def turned(self, columns: Array) -> Array:
        """Convert k vectors, the columns of an array (.., 3, k), from base to reference axes."""
        if self.standing:
            return columns
        return product(self.R, columns)

    def rate_over_q_b(self, omega: Array, crossed: Array) -> Array:
        """Return the derivative (.., 3, 3) of d q_b/dt with respect to q_b (4.2).

        omega is constant in base axes, and `crossed` is [omega]x.
        """
        if self.standing:
            return -0.5 * crossed
        return -0.5 * (
            crossed + omega[..., :, None] * (self.q_b / self.q0)[..., None, :]
        )

    def over_q_b(self, by_turn: Array) -> Array:
        """Return derivatives (.., k, 3) with respect to q_b.

        `by_turn` (.., k, 3) contains the derivatives with respect to d theta, a small rotation of
        the base in base axes (1.3).
        """
        if self.standing:
            return 2.0 * by_turn
        return product(by_turn, self.J)

    def turn_rows(self, parts: tuple[slice, ...], x: Array) -> None:
        """Multiply blocks of three rows of x (.., m, k) by R from the left, in place.

        `parts` has one slice of three rows for each block. To multiply blocks of three columns of a
        matrix by R^T from the right, pass the transpose of this matrix as x.
        """
        if not self.standing:
            _turn(self.R, parts, x)

    def to_reference(self, parts: tuple[slice, ...], x: Array) -> Array:
        """Return x (.., m, k) with some rows converted from base axes to reference axes.

        Each slice in `parts` selects three rows of x: the components of k vectors. The given array
        is not changed.
        """
        if self.standing or not parts:
            return x
        return _turn(self.R, parts, x.copy("K"))

    def to_base(self, parts: tuple[slice, ...], x: Array) -> Array:
        """Return x (.., m, k) with some rows converted from reference axes to base axes.

        Each slice in `parts` selects three rows of x: the components of k vectors. The given array
        is not changed.
        """
        if self.standing or not parts:
            return x
        return _turn(self.R.mT, parts, x.copy("K"))


class Standing(Chart):
    """Chart at one or many attitudes that are equal to the reference: R = Q = E and J = 2 E."""

    standing = True

    def __init__(self, *count: int) -> None:
        super().__init__(np.zeros((*count, 3)), 1.0, _IDENTITY)


def times(matrices: Array, vectors: Array) -> Array:
    """Return matrices (.., 3, 3) times vectors (.., 3)."""
    return (matrices @ vectors[..., None])[..., 0]


def _turn(R: Array, parts: tuple[slice, ...], x: Array) -> Array:
    for rows in parts:
        x[..., rows, :] = product(R, x[..., rows, :])
    return x


_TURN = 2.0 * np.pi


def states_of(state: StateMap, q: Array, nu: Array) -> Array:
    """Return the states (.., nx) at configurations q (.., nq) and velocities nu (.., 6 + n).

    nu is in base axes. The arguments are not checked.
    """
    return state.compose(
        state.charts(q), state.positions(q), state.joint_positions(q), nu
    )


def unwound(state: StateMap, x: Array, near: Array | float = 0.0) -> Array:
    """Remove full turns of continuous joints from states or state errors x (.., nx), in place.

    Afterwards, the angle of each continuous joint is within half a turn of the angle of this joint
    in the state `near` (nx,). If `near` is a number, it is this angle for all joints. Return x.
    """
    joints = 6 + state.unbounded
    apart = x[..., joints] - np.broadcast_to(near, state.nx)[joints]
    x[..., joints] -= _TURN * np.round(apart / _TURN)
    return x


def readout(
    state: StateMap, K: Array, offset: Array, near: Array
) -> Callable[[float, Array, Array], Array]:
    """Return the law u(t, q, v) = offset - K x(q, v), which a policy evaluates at each sample.

    In the state x, the angles of continuous joints are within half a turn of `near` (nx,).
    """
    # The state x is linear in the vector z below. So u is one matrix-vector product, which takes a
    # fifth of the time of computing x.
    robot, g = state.robot, state.groups
    idx_q = np.array([*map(attrgetter("idx_q"), robot.joints)], dtype=np.intp)
    scales = np.array([*map(attrgetter("scale"), robot.joints)])
    circling = state.unbounded
    cos = idx_q[state.unbounded]
    middle = near[g.q_m][circling]
    # x = S z, where z stacks q, v, the angles of continuous joints, omega_b and v_b in world axes,
    # and 1.
    ends = np.cumsum((robot.nq, robot.nv, len(circling), 3, 3))
    S = np.zeros((state.nx, ends[-1] + 1))
    of_q, of_v, of_angles, of_angular, of_linear, constant = np.split(S, ends, axis=1)
    at = state.origin
    turn = turning.product_matrix(state.origin_quaternion)
    of_q[g.q_b, 3:7] = turn[:3]
    of_q[g.r_b, :3] = at.rotation
    constant[g.r_b, 0] = at.translation
    of_q[g.q_m][np.arange(robot.n), idx_q] = 1.0 / scales
    of_q[:, cos] = 0.0
    of_angles[6 + circling] = np.eye(len(circling))
    of_v[6 + robot.n :] = state.velocities(np.eye(robot.nv)).T
    for group, of_part in compress(
        ((g.omega_b, of_angular), (g.v_b, of_linear)), state.axes
    ):
        of_v[group] = 0.0
        of_part[group] = at.rotation
    gains = -K @ S
    gains[:, -1] += offset

    z = np.zeros(gains.shape[1])
    z[-1] = 1.0
    z_q, z_v, z_angles, z_angular, z_linear, _ = np.split(z, ends)
    z_turn, scalar = z_q[3:7], turn[3]
    turned_angular, turned_linear = state.axes

    def law(_: float, q: Array, v: Array) -> Array:
        z_q[:], z_v[:] = q, v
        if scalar.dot(z_turn) < 0.0:
            z_turn[:] = -z_turn
        if cos.size:
            angles = np.arctan2(q.take(cos + 1), q.take(cos))
            z_angles[:] = angles + _TURN * np.round((middle - angles) / _TURN)
        if turned_linear:
            R = pin.XYZQUATToSE3(q[:7]).rotation
            z_linear[:] = R.dot(v[:3])
            if turned_angular:
                z_angular[:] = R.dot(v[3:6])
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
            turns = np.round((turned - np.diff(q_m[:, k], axis=0)) / _TURN)
            q_m[1:, k] += _TURN * turns.cumsum(axis=0)
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
    """Return the rotation vectors (N, 3) [rad] from the attitudes of targets to those of states.

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
    e, (_, R), (_, R_target) = x - target, _turned(x), _turned(target)
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
    x, (turn_target, R_target), (turn, R) = target + e, _turned(target), _turned(e)
    q_e, q_target = e[:, :3], target[:, :3]
    x[:, :3] = turn_target * q_e + turn * q_target + np.cross(q_target, q_e)
    scalar = turn * turn_target - (q_e * q_target).sum(axis=1, keepdims=True)
    x[:, :3] *= np.where(scalar < 0.0, -1.0, 1.0)
    x[:, 3:6] = target[:, 3:6] + (R_target @ e[:, 3:6, None])[..., 0]
    R = R_target @ R
    for rows in _in_reference(frame, x.shape[1]):
        in_base_axes = (target[:, None, rows] @ R_target)[:, 0] + e[:, rows]
        x[:, rows] = (R @ in_base_axes[..., None])[..., 0]
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
