"""Coordinates of the state: names, units, axes, and the attitude chart."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, Literal, NamedTuple, cast, get_args

import numpy as np

from fflin.base.errors import InputError, listed
from fflin.base.rotation import product, rotation_matrices, rotation_matrix, skew
from fflin.base.validation import Array, Indices
from fflin.robot.inputs import BaseForce, BaseTorque
from fflin.robot.orbit import is_elliptic
from fflin.robot.robot import Robot

Frame = Literal["hybrid", "local", "world", "lvlh", "hill"]

# Frames of an orbit. If a robot is in orbit, one of these frames replaces Pinocchio's world
# frame. The frame "local" in orbit has the world of the first one, with velocities in base axes.
ORBITAL: tuple[Frame, ...] = ("lvlh", "hill")

# For each frame, two flags. The first is true if omega_b and tau_b are in reference axes, and false
# if they are in base axes. The second flag is the same for v_b and F_b.
IN_REFERENCE_AXES: dict[str, tuple[bool, bool]] = {
    "hybrid": (False, True),
    "local": (False, False),
    "world": (True, True),
    **dict.fromkeys(ORBITAL, (False, True)),
}

TURN = 2.0 * np.pi  # [rad]

# Slices of the base's angular and linear parts in velocities and generalised forces (6 + n,) in
# state order.
ANGULAR, LINEAR = slice(0, 3), slice(3, 6)
# Slices of the same two parts in Pinocchio's v and spatial vectors, where the linear part is first.
PIN_LINEAR, PIN_ANGULAR = slice(0, 3), slice(3, 6)


def frame_of(robot: Robot, frame: object) -> Frame:
    """Return the frame, or the default frame of the robot if `frame` is None.

    Raise `InputError` if the frame is unknown. Also raise it if the frame is orbital but the robot
    is not in orbit, or if the robot is in orbit but the frame is neither orbital nor "local".
    """
    if frame is None:
        return ORBITAL[0] if robot.orbit else "hybrid"
    if not isinstance(frame, str) or frame not in get_args(Frame):
        raise InputError(
            f"frame is {frame!r}, expected one of {', '.join(get_args(Frame))}"
        )
    if (frame in ORBITAL) != bool(robot.orbit) and not (
        robot.orbit and frame == "local"
    ):
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
            "orbit with robot.replace(orbit=None) or --orbit none"
        )


def refuse_constraints(robot: Robot, what: str) -> None:
    """Raise `InputError` if a robot has constraints; `what` names the unsupported feature."""
    if getattr(robot, "constraints", None):
        names = listed(item.title for item in robot.constraints)
        raise InputError(
            f"{what} do not support constraints, but '{robot.name}' has the constraints {names}; "
            "remove them with robot.replace(constraints=[]), or on the command line without --weld "
            "and [[constraint]]"
        )


def refuse_elliptic(robot: Robot, what: str, remedy: str = "") -> None:
    """Raise `InputError` if a robot is in an elliptic orbit; `what` is the unsupported feature."""
    if is_elliptic(getattr(robot, "orbit", None)):
        remedy = remedy or "give a circular orbit, fflin.CircularOrbit(altitude)"
        raise InputError(
            f"{what} do not support elliptic orbits, in which the model depends on time, but "
            f"'{robot.name}' is in one; {remedy}"
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

    at_reference: ClassVar[bool] = (
        False  # whether all attitudes are equal to the reference
    )

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
        if self.at_reference:
            return 0.5 * omega
        return times(self.N, omega)

    def turned(self, columns: Array) -> Array:
        """Convert k vectors, the columns of an array (.., 3, k), from base to reference axes."""
        if self.at_reference:
            return columns
        return product(self.R, columns)

    def rate_over_q_b(self, omega: Array, crossed: Array) -> Array:
        """Return the derivative (.., 3, 3) of d q_b/dt with respect to q_b (4.2).

        It is the derivative at constant omega (.., 3) in base axes. `crossed` is [omega]x, which
        callers have already.
        """
        if self.at_reference:
            return -0.5 * crossed
        return -0.5 * (
            crossed + omega[..., :, None] * (self.q_b / self.q0)[..., None, :]
        )

    def over_q_b(self, by_turn: Array) -> Array:
        """Return derivatives (.., k, 3) with respect to q_b.

        `by_turn` (.., k, 3) contains the derivatives with respect to d theta, a small rotation of
        the base in base axes (1.3).
        """
        if self.at_reference:
            return 2.0 * by_turn
        return product(by_turn, self.J)

    def turn_rows(self, parts: tuple[slice, ...], x: Array) -> None:
        """Multiply blocks of three rows of x (.., m, k) by R from the left, in place.

        `parts` has one slice of three rows for each block. To multiply blocks of three columns of a
        matrix by R^T from the right, pass the transpose of this matrix as x.
        """
        if not self.at_reference:
            _turn(self.R, parts, x)

    def to_reference(self, parts: tuple[slice, ...], x: Array) -> Array:
        """Return x (.., m, k) with some rows converted from base axes to reference axes.

        Each slice in `parts` selects three rows of x: the components of k vectors. The given array
        is not changed.
        """
        if self.at_reference or not parts:  # R is the identity, or no rows are selected
            return x
        # Keep the memory layout of x, which may be a transposed view.
        copied = x.copy("K")
        return _turn(self.R, parts, copied)

    def to_base(self, parts: tuple[slice, ...], x: Array) -> Array:
        """Return x (.., m, k) with some rows converted from reference axes to base axes.

        Each slice in `parts` selects three rows of x: the components of k vectors. The given array
        is not changed.
        """
        if self.at_reference or not parts:  # R is the identity, or no rows are selected
            return x
        # Keep the memory layout of x, which may be a transposed view.
        copied = x.copy("K")
        return _turn(self.R.mT, parts, copied)


class ReferenceChart(Chart):
    """Chart at one or many attitudes that are equal to the reference: R = Q = E and J = 2 E."""

    at_reference = True

    def __init__(self, *count: int) -> None:
        super().__init__(np.zeros((*count, 3)), 1.0, _IDENTITY)


def times(matrices: Array, vectors: Array) -> Array:
    """Return matrices (.., 3, 3) times vectors (.., 3)."""
    return (matrices @ vectors[..., None])[..., 0]


def _turn(R: Array, parts: tuple[slice, ...], x: Array) -> Array:
    """Multiply the selected blocks of three rows of x by R from the left, in place; return x."""
    for rows in parts:
        x[..., rows, :] = product(R, x[..., rows, :])
    return x


def unwound(x: Array, joints: Indices, near: Array | float = 0.0) -> Array:
    """Remove full turns of continuous joints from states or state errors x (.., nx), in place.

    `joints` are the indices of their angles. Afterwards, each of these angles is within half a turn
    of the same angle in the state `near` (nx,), or of the number `near`. Return x.
    """
    apart = x[..., joints] - np.broadcast_to(near, x.shape[-1])[joints]
    x[..., joints] -= TURN * np.round(apart / TURN)
    return x
