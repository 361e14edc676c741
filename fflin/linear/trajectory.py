"""The time-varying linear model along a motion."""

import warnings
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from fflin.base.errors import FflinWarning, InputError
from fflin.base.rotation import rotation_matrix
from fflin.base.validation import Array, as_double, number, vector
from fflin.dynamics.aba import Aba
from fflin.dynamics.state import StateMap
from fflin.linear.linearization import Linearizer
from fflin.linear.model import LinearModel
from fflin.robot.robot import Robot

# Error of the trapezoidal rule over an interval, relative to the largest rate of the motion: from
# the first on the knots are called coarse, from the second on they are no motion of the robot.
_COARSE, _NO_MOTION = 1e-2, 0.1

# Round-off of positions, and of accelerations that are sums of terms that may cancel.
_EPS = float(np.finfo(float).eps)
_OF_PLACES, _OF_SUMS = 16.0 * _EPS, 1e3 * _EPS


@dataclass(frozen=True, eq=False, repr=False)
class LinearTrajectory:
    r"""Error dynamics along a motion, ``d(dx)/dt = A(t) dx + B(t) du``.

    The error is taken in the moving base's own axes, see `Linearizer` (``moving=True``).

    Attributes
    ----------
    t : ndarray (N,)
        Times of the knots [s].
    A : ndarray (N, nx, nx)
    B : ndarray (N, nx, nu)
    q : ndarray (N, nq)
    v : ndarray (N, nv)
    u : ndarray (N, nu)
        The motion, configuration and velocity in Pinocchio's order.
    residual : ndarray (N,)
        How far the knots around each are from a motion of the robot, by the trapezoidal rule,
        relative to the largest rates of the motion; of second order in the time step. An
        observer who flies along with the base's mean velocity takes them, so that an orbit hides
        nothing, and each rotor counts for itself, so that a fast wheel does not either.
    state_names, input_names : tuple of str
    robot : Robot
    """

    t: Array
    A: Array
    B: Array
    q: Array
    v: Array
    u: Array
    residual: Array
    state_names: tuple[str, ...]
    input_names: tuple[str, ...]
    robot: Robot

    def __post_init__(self) -> None:
        for array in (self.t, self.A, self.B, self.q, self.v, self.u, self.residual):
            array.setflags(write=False)

    def __repr__(self) -> str:
        return (
            f"LinearTrajectory('{self.robot.name}', {len(self.t)} knots, "
            f"{self.t[0]:g} to {self.t[-1]:g} s, nx={self.A.shape[1]}, nu={self.B.shape[2]})"
        )

    def matrices(self, t: float) -> tuple[Array, Array]:
        """Return A (nx, nx) and B (nx, nu) at a time, linear between the knots."""
        A, B = self._between(t, self.A, self.B)
        return A, B

    def point(self, t: float) -> tuple[Array, Array, Array]:
        """Return (q, v, u) at a time: q along the manifold, v and u linear between the knots."""
        index, share = self._place(t)
        q = pin.interpolate(self.robot.model, self.q[index], self.q[index + 1], share)
        v, u = self._between(t, self.v, self.u)
        return q, v, u

    def _between(self, t: float, *of_knots: Array) -> list[Array]:
        """Return what is linear between the knots at a time."""
        index, share = self._place(t)
        return [(1.0 - share) * knots[index] + share * knots[index + 1] for knots in of_knots]

    def _place(self, t: float) -> tuple[int, float]:
        t = number("t", t)
        if not self.t[0] <= t <= self.t[-1]:
            raise InputError(f"t is {t:g} s, expected {self.t[0]:g} to {self.t[-1]:g} s")
        index = min(int(np.searchsorted(self.t, t, side="right")) - 1, len(self.t) - 2)
        return index, float((t - self.t[index]) / (self.t[index + 1] - self.t[index]))


def linearize_trajectory(
    robot: Robot, t: ArrayLike, q: ArrayLike, v: ArrayLike, u: ArrayLike
) -> LinearTrajectory:
    """Linearise along a motion of the robot.

    Parameters
    ----------
    robot : Robot
    t : array_like (N,)
        Times of the knots [s], increasing.
    q : array_like (N, nq)
        Configurations in Pinocchio's order.
    v : array_like (N, nv)
        Velocities in Pinocchio's order.
    u : array_like (N, nu)
        Inputs over the robot's, those on the base in base axes.

    Returns
    -------
    LinearTrajectory

    Raises
    ------
    InputError
        If a size is wrong, the times do not increase, or the arrays jump or are not a motion of
        the robot under its inputs; the message names the time.

    Warns
    -----
    FflinWarning
        If the knots are so coarse that the motion between them is in doubt.
    """
    times = as_double("t", t)
    times = vector("t", times, times.size, "times of the knots")
    if len(times) < 2 or (np.diff(times) <= 0.0).any():
        raise InputError("t must hold at least two times, each later than the one before")
    linearizer = Linearizer(robot, moving=True)
    knots: dict[str, NDArray[np.floating]] = {}
    for name, value, size in (("q", q, robot.nq), ("v", v, robot.nv)):
        knots[name] = _rows(name, value, len(times), size)
    models = [
        linearizer(*point)
        for point in zip(knots["q"], knots["v"], _rows("u", u, len(times), None), strict=True)
    ]
    inputs = np.array([lin.u0 for lin in models])
    residual = _residual(robot, times, models)
    worst = int(residual.argmax())
    said = f"at t = {times[worst]:g} s they miss it by {residual[worst]:.1%} of its largest rate"
    if residual[worst] > _NO_MOTION:
        raise InputError(
            f"t, q, v, u are not a motion of '{robot.name}': {said}; give those of one motion "
            "under the robot's own inputs, springs and gravity, or closer knots"
        )
    if residual[worst] > _COARSE:
        warnings.warn(f"the knots are coarse for a motion: {said}", FflinWarning, stacklevel=2)
    return LinearTrajectory(
        times.copy(),
        np.array([lin.A for lin in models]),
        np.array([lin.B for lin in models]),
        np.array([lin.q for lin in models]),
        np.array([lin.v for lin in models]),
        inputs,
        residual,
        models[0].state_names,
        models[0].input_names,
        robot,
    )


def _rows(name: str, value: ArrayLike, count: int, size: int | None) -> NDArray[np.floating]:
    array = as_double(name, value)
    if array.ndim != 2 or len(array) != count or (size is not None and array.shape[1] != size):
        expected = f"({count}, {'nu' if size is None else size})"
        raise InputError(f"{name} has shape {array.shape}, expected {expected}")
    return array


def _residual(robot: Robot, t: Array, models: list[LinearModel]) -> Array:
    """Return (N,): the trapezoidal rule's error of q and v in the intervals around each knot."""
    state = StateMap(robot, frame="local")
    q, v, u = (np.array([getattr(lin, name) for lin in models]) for name in ("q", "v", "u0"))
    q, v, of_q = _seen_flying_along(t, q, v)
    aba = Aba(state)
    a = np.array([aba.acceleration(*point) for point in zip(q, v, u, strict=True)])
    h = np.diff(t)[:, None]
    moved = np.array([pin.difference(robot.model, *pair) for pair in pairwise(q)])
    for column in (joint.idx_v for joint in robot.joints if joint.unbounded):
        # The knots have a fast wheel's angle only within a turn; its speed says how many turns.
        by_rate = 0.5 * h[:, 0] * (v[1:, column] + v[:-1, column])
        turns = np.round((by_rate - moved[:, column]) / (2.0 * np.pi))
        moved[:, column] += 2.0 * np.pi * turns
    of_a = _OF_SUMS * np.max([np.abs(state.spread(_terms(lin))) for lin in models], axis=0)
    rotors = [f"q_m.{name}" in models[0].ignorable for name in robot.joint_names]
    errors = []
    for given, rate, digits in (
        (moved / h, v, of_q / h),
        (np.diff(v, axis=0) / h, a, of_a + of_q / h),
    ):
        miss = np.abs(given - 0.5 * (rate[1:] + rate[:-1]))
        miss = np.maximum(miss - digits, 0.0)
        for part in _measured_together(robot, rotors):
            scale = np.abs(rate[:, part]).max() or 1.0
            errors.append(miss[:, part].max(axis=1) / scale)
    interval = np.max(errors, axis=0)
    return np.maximum(np.append(interval, 0.0), np.append(0.0, interval))


def _seen_flying_along(t: Array, q: Array, v: Array) -> tuple[Array, Array, Array]:
    """Return q and v seen by an observer with the base's mean velocity, and their rounding (nv,).

    The dynamics are the same for all such observers (Galilei).
    """
    rotations = [rotation_matrix(quaternion) for quaternion in q[:, 3:7]]
    velocities = np.array([R @ linear for R, linear in zip(rotations, v[:, :3], strict=True)])
    mean = velocities.mean(axis=0)
    q, v, flown = q.copy(), v.copy(), np.outer(t - t[0], mean)
    digits = np.full(v.shape[1], _OF_PLACES * max(1.0, float(np.abs(q[:, 7:]).max(initial=0.0))))
    digits[:3] = _OF_PLACES * max(float(np.abs(x).max()) for x in (q[:, :3], flown, velocities))
    q[:, :3] -= q[0, :3] + flown
    v[:, :3] -= [R.T @ mean for R in rotations]
    return q, v, digits


def _terms(lin: LinearModel) -> Array:
    """Return the size (6 + n,) of the terms that make up the accelerations at a point."""
    rows = slice(len(lin.x0) // 2, None)
    return np.abs(lin.A[rows]) @ np.abs(lin.x0) + np.abs(lin.B[rows]) @ np.abs(lin.u0)


def _measured_together(robot: Robot, rotors: list[bool]) -> list[list[int]]:
    """Return groups of columns of v: the base's, each rotor's, and all other joints'."""
    alone = [[joint.idx_v] for joint, rotor in zip(robot.joints, rotors, strict=True) if rotor]
    others = sorted(set(range(6, robot.nv)) - {column for group in alone for column in group})
    return [[0, 1, 2], [3, 4, 5], *alone, *([others] if others else [])]
