"""The linear quadratic regulator along a trajectory, over a finite horizon."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from fflin.base.errors import InputError
from fflin.base.names import input_keys
from fflin.base.record import Design
from fflin.base.validation import Array, number
from fflin.control.differential_riccati import NODES, Coefficients, step_back
from fflin.control.weights import Weight, weight
from fflin.dynamics.actuation import Actuation
from fflin.dynamics.state import StateMap

if TYPE_CHECKING:
    from scipy.interpolate import CubicHermiteSpline

    from fflin.linear.linear_trajectory import LinearTrajectory

# Between two knots P is a cubic; knots are added until it is this accurate, relative to P.
_ACCURACY = 1e-7
_KNOTS_LIMIT = 100_000
_TOO_FAST = "P changes too fast at {}; give smaller weights or a larger R"


@dataclass(frozen=True, eq=False, repr=False)
class GainSchedule(Design):
    r"""A time-varying feedback ``u = u*(t) - K(t) e`` of the error e from a trajectory.

    Attributes
    ----------
    t : ndarray (M,)
        Times of the knots [s]: the trajectory's and those that P needs.
    K : ndarray (M, nu, nx)
    P : ndarray (M, nx, nx)
        The cost from t on is e' P(t) e.
    A : ndarray (M, nx, nx)
    B : ndarray (M, nx, nu)
        The model at the knots, linear in between.
    Q, R, Qf : ndarray
    residual : float
        Largest residual of the differential Riccati equation midway between the knots, relative
        to the sum of the norms of its terms.
    state_names, input_names : tuple of str
    robot : str
    """

    VECTORS: ClassVar = ("t",)

    t: Array
    K: Array
    P: Array
    A: Array
    B: Array
    Q: Array
    R: Array
    Qf: Array
    residual: float
    state_names: tuple[str, ...]
    input_names: tuple[str, ...]
    robot: str

    def __repr__(self) -> str:
        return (
            f"GainSchedule('{self.robot}', {len(self.t)} knots, {self.t[0]:g} to "
            f"{self.t[-1]:g} s, nx={self.P.shape[1]}, nu={self.K.shape[1]}, "
            f"residual={self.residual:.1e})"
        )

    def __call__(self, t: float) -> Array:
        """Return K (nu, nx) at a time."""
        return self.gain(t)

    def gain(self, t: float) -> Array:
        """Return K (nu, nx) at a time; InputError where it is not within the knots."""
        P = self.cost_to_go(t)
        i = min(int(np.searchsorted(self.t, t, side="right")) - 1, len(self.t) - 2)
        share = (t - self.t[i]) / (self.t[i + 1] - self.t[i])
        B = (1.0 - share) * self.B[i] + share * self.B[i + 1]
        K: Array = np.linalg.solve(self.R, B.T @ P)
        return K

    def cost_to_go(self, t: float) -> Array:
        """Return P (nx, nx) at a time, a cubic between the knots with their values and slopes."""
        t = number("t", t)
        if not self.t[0] <= t <= self.t[-1]:
            raise InputError(f"t is {t:g} s, expected {self.t[0]:g} to {self.t[-1]:g} s")
        P: Array = self._cubics(t)
        return P

    @cached_property
    def _cubics(self) -> CubicHermiteSpline:
        """P over time."""
        from scipy.interpolate import CubicHermiteSpline

        drift, across = self.P @ self.A, (0, 2, 1)
        spent = self.K.transpose(across) @ self.R @ self.K
        return CubicHermiteSpline(
            self.t, self.P, spent - drift - drift.transpose(across) - self.Q, extrapolate=False
        )


def tvlqr(traj: LinearTrajectory, Q: Weight, R: Weight, Qf: Weight) -> GainSchedule:
    r"""Return the regulator along a trajectory, over its finite horizon.

    From any time t to the end T it minimises

    .. math:: e(T)^T Q_f\,e(T) + \int_t^T e^T Q\,e + \delta u^T R\,\delta u\;d\tau.

    P of the differential Riccati equation :math:`-\dot P = A^T P + P A - P B R^{-1} B^T P + Q`,
    :math:`P(T) = Q_f`, is carried backwards from knot to knot by maps of the form
    :math:`P_0 = W + T^T P_1 (E + G P_1)^{-1} T` with W and G positive semidefinite, each of which
    comes from a short exponential by doubling: P stays positive semidefinite however long the
    horizon. The method is of order four in the trajectory's changes and exact where it does not
    change; knots are added until halving and interpolation agree to 1e-7.

    Parameters
    ----------
    traj : LinearTrajectory
    Q, Qf : array_like (nx, nx) or (nx,), float, or mapping
        Weights on the error and on that at the end, as `lqr` takes them; positive semidefinite.
    R : array_like (nu, nu) or (nu,), float, or mapping
        Positive definite.

    Returns
    -------
    GainSchedule

    Raises
    ------
    InputError
        If a weight is of a wrong size or not positive (semi)definite, or P changes so fast that
        the knots run out.
    UnknownNameError
        If a name does not exist.

    References
    ----------
    W.-W. Lin and E. K.-W. Chu (with others), structure-preserving doubling algorithms, 2018.
    E. Celledoni, A. Marthinsen and B. Owren, Commutator-free Lie group methods, Future Generation
    Computer Systems 19(3), 2003.
    """
    from fflin.linear.linear_trajectory import LinearTrajectory

    if not isinstance(traj, LinearTrajectory):
        raise InputError(
            f"traj is a {type(traj).__name__}, expected a LinearTrajectory; "
            "fflin.linearize_trajectory makes one"
        )
    names = traj.state_names
    Q, Qf = weight("Q", Q, names), weight("Qf", Qf, names)
    R = weight("R", R, input_keys(Actuation(StateMap(traj.robot))), definite=True)
    try:
        # A P that overflows is refused below, so that NumPy need not warn of it.
        with np.errstate(over="ignore", invalid="ignore"):
            t, P = _solve(traj, Q, R, Qf)
    except np.linalg.LinAlgError:
        raise InputError(_TOO_FAST.format("some time")) from None
    A, B = map(np.array, zip(*(traj.matrices(float(x)) for x in t), strict=True))
    K = np.linalg.solve(R, B.transpose(0, 2, 1) @ P)
    schedule = GainSchedule(
        t, K, P, A, B, Q, R, Qf, math.inf, names, traj.input_names, traj.robot.name
    )
    return replace(schedule, residual=_residual(schedule))


def _solve(traj: LinearTrajectory, Q: Array, R: Array, Qf: Array) -> tuple[Array, Array]:
    def at(t: float) -> Coefficients:
        A, B = traj.matrices(t)
        return Coefficients(A, _spread(B, R), Q)

    def back(a: float, b: float, P: Array) -> Array:
        nodes = np.array([_spread(traj.matrices(a + c * (b - a))[1], R) for c in NODES])
        return step_back(at(a), at(b), nodes, P, b - a)

    times, values = [float(traj.t[-1])], [Qf]
    for a in traj.t[-2::-1].tolist():
        # Intervals left to do, the latest last; with P at the start from one step, where known.
        pending: list[tuple[float, float, Array | None]] = [(a, times[-1], None)]
        while pending:
            start, end, single = pending.pop()
            P = values[-1]
            single = back(start, end, P) if single is None else single
            middle = 0.5 * (start + end)
            half = back(middle, end, P)
            double = back(start, middle, half)
            h = end - start
            # The cubic with these values and slopes, midway.
            bend = at(start).rate(double) - at(end).rate(P)
            between = 0.5 * (double + P) + 0.125 * h * bend
            if max(_apart(single, double), _apart(between, half)) <= _ACCURACY:
                times += [middle, start]
                values += [half, double]
            elif len(times) > _KNOTS_LIMIT or h < 1e-12 * abs(traj.t[-1] - traj.t[0]):
                raise InputError(_TOO_FAST.format(f"t = {end:g} s"))
            else:
                pending += [(start, middle, None), (middle, end, half)]
    return np.array(times[::-1]), np.array(values[::-1])


def _spread(B: Array, R: Array) -> Array:
    S = B @ np.linalg.solve(R, B.T)
    half: Array = 0.5 * (S + S.T)
    return half


def _apart(first: Array, second: Array) -> float:
    return float(np.linalg.norm(first - second)) / max(float(np.linalg.norm(second)), 1e-300)


def _residual(schedule: GainSchedule) -> float:
    worst = 0.0
    for i, t in enumerate(0.5 * (schedule.t[1:] + schedule.t[:-1])):
        P, rate = schedule._cubics(t), schedule._cubics(t, 1)
        A, B = (0.5 * (each[i] + each[i + 1]) for each in (schedule.A, schedule.B))
        drift, spent = P @ A, P @ _spread(B, schedule.R) @ P
        terms = np.array((rate, drift, drift.T, -spent, schedule.Q))
        size = float(np.linalg.norm(terms, axis=(1, 2)).sum())
        worst = max(worst, float(np.linalg.norm(terms.sum(axis=0))) / max(size, 1e-300))
    return worst
