"""Time-varying gains of feedback and filters along a trajectory."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import ClassVar

import numpy as np

from fflin.base.errors import InputError
from fflin.base.record import NOT_VERIFIED, Design
from fflin.base.tables import folded
from fflin.base.validation import Array, number
from fflin.control.gain import titled
from fflin.control.optimal.differential_riccati import Coefficients, imbalance
from fflin.dynamics.state import Actuation, StateMap
from fflin.linear.fit import require_same
from fflin.linear.trajectory import Trajectory, cubic
from fflin.robot.robot import Robot

_nothing = partial(np.zeros, 0)


@dataclass(frozen=True, eq=False, repr=False)
class Schedule(Design):
    """Gain as a function of time, given at the knots or samples of a trajectory."""

    t: Array

    def gain(self, t: float) -> Array:
        """Return the gain at time t, or raise `InputError` if t is outside the knots.

        Between knots, the gain is computed from the interpolated model and P. A sampled schedule
        returns the gain of the most recent sample.
        """
        return self.interpolant.gain(self._within(t))

    def _within(self, t: float) -> float:
        t, over_time = number("t", t), self.interpolant
        if not over_time.first <= t <= over_time.last:
            raise InputError(f"t is {t:g} s, expected {over_time.first:g} to {over_time.last:g} s")
        return t

    @cached_property
    def interpolant(self) -> Interpolant:
        """Gain and matrix P over time."""
        raise NotImplementedError


@dataclass(frozen=True, eq=False, repr=False)
class GainSchedule(Schedule):
    r"""Time-varying feedback ``u = u*(t) - K(t) e`` of the error e relative to a trajectory.

    Attributes
    ----------
    t : ndarray (M,)
        Times [s] of the knots. A continuous schedule has the knots of the trajectory and further
        knots for the interpolation of P. The knots of a sampled schedule are the sample times.
    K : ndarray (M, nu, nx)
        Gains. In a sampled schedule, the last two gains are equal.
    P : ndarray (M, nx, nx)
        Cost matrix: the optimal cost from time t to the end is e' P(t) e.
    A : ndarray (M, nx, nx)
    B : ndarray (M, nx, nu)
        Linear model at the knots. A sampled schedule has M - 1 matrices A and B; each pair
        describes the transition from one sample to the next.
    Q, R, Qf : ndarray
        Weights of the continuous cost.
    residual : float
        Largest residual of the differential Riccati equation midway between the knots, relative to
        the sum of the norms of its terms. A sampled schedule has the residual of the Riccati
        difference equation instead.
    state_names, input_names : tuple of str
    robot : str
    dt : float
        Sampling time [s], over which u is held; 0 for continuous time.
    weights : str
        Description of the rule that set the weights.
    knots, q, v, u, hold, frame
        Data of the trajectory, which `trajectory` returns as a `Trajectory`.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> v0 = fflin.velocity(robot, {"joint_1": 0.1})
    >>> motion = fflin.simulate(robot, v0=v0, duration=2.0, every=20)
    >>> along = fflin.linearize_trajectory(robot, motion.trajectory())
    >>> schedule = fflin.tvlqr(along)
    >>> schedule.gain(0.5).shape, schedule.residual < 1e-3
    ((9, 18), True)
    >>> flight = fflin.simulate(robot, schedule, q0=robot.neutral(), duration=1.0)
    """

    VECTORS: ClassVar = ("t", "knots")

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
    dt: float = field(default_factory=float)
    weights: str = field(default_factory=str)
    knots: Array = field(default_factory=_nothing)
    q: Array = field(default_factory=_nothing)
    v: Array = field(default_factory=_nothing)
    u: Array = field(default_factory=_nothing)
    hold: str = field(default_factory=str)
    frame: str = field(default_factory=str)

    def __repr__(self) -> str:
        return titled(self, knots=len(self.t), nx=self.K.shape[2], nu=self.K.shape[1])

    def __str__(self) -> str:
        """Return the report: the sizes, the residual and the rule of the weights."""
        verdict = [] if self.verified else [NOT_VERIFIED]
        said = [repr(self), f"weights: {self.weights or 'as given'}", *verdict]
        return "\n".join(folded([each]) for each in said)

    def trajectory(self, robot: Robot) -> Trajectory:
        """Return the trajectory that the gains were designed for."""
        if not self.knots.size:
            raise InputError(
                "the file of gains contains no trajectory; load the trajectory with "
                "fflin.Trajectory.load and use TrajectoryFeedback"
            )
        state, made = StateMap(robot), f"the gain schedule was made for '{self.robot}'"
        inputs = Actuation(state).names
        require_same(made, robot, "state", (self.state_names,) * 2, (state.names,) * 2)
        require_same(made, robot, "input", (self.input_names,) * 2, (inputs,) * 2)
        parts = self.knots, self.q, self.v, self.u
        return Trajectory(robot, *parts, hold=self.hold, frame=self.frame)

    def cost_to_go(self, t: float) -> Array:
        """Return P (nx, nx) at time t: interpolated, or of the latest sample if sampled."""
        return self.interpolant.cost(self._within(t))

    @cached_property
    def interpolant(self) -> Interpolant:
        """Gain and cost matrix over time."""
        model = (self.A, self.B, self.Q, self.R)
        return Interpolant(self.t, self.P, self.K, model, self.dt)


@dataclass(frozen=True, eq=False, repr=False)
class FilterSchedule(Schedule):
    r"""Time-varying Kalman filter for the error e relative to a trajectory.

    Let :math:`y^*(t)` be the outputs along the trajectory, and
    :math:`\nu = y - y^*(t) - C \hat e - D\,\delta u` the innovation at a sample. The estimate for
    the next sample is

    .. math:: \hat e^+ = A\,\hat e + B\,\delta u + L\,\nu.

    Attributes
    ----------
    t : ndarray (M,)
        Times [s] of the samples.
    L : ndarray (M, nx, ny)
        Filter gains. The last two gains are equal.
    P : ndarray (M, nx, nx)
        Covariance of the estimation error before the measurement update.
    A, B, W : ndarray (M - 1, nx, nx), (M - 1, nx, nu), (M - 1, nx, nx)
        Transition matrices from one sample to the next, and the covariance of the disturbance
        over one sample.
    C, D, y : ndarray (M, ny, nx), (M, ny, nu), (M, ny)
        Output matrices, and the outputs along the trajectory.
    V : ndarray (ny, ny)
        Covariance of the measurement noise at a sample.
    residual : float
        Residual of the Riccati difference equation for P, relative to its terms as in
        `GainSchedule`.
    state_names, input_names, output_names : tuple of str
    robot : str
    dt : float
        Sampling time [s].

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> v0 = fflin.velocity(robot, {"joint_1": 0.1})
    >>> motion = fflin.simulate(robot, v0=v0, duration=2.0, every=20)
    >>> along = fflin.linearize_trajectory(robot, motion.trajectory())
    >>> filtered = fflin.tvkalman(along, 1e-3, 1e-4, sample=0.1)
    >>> filtered.dt, filtered.P.shape[1:]
    (0.1, (18, 18))
    """

    VECTORS: ClassVar = ("t",)

    L: Array
    P: Array
    A: Array
    B: Array
    C: Array
    D: Array
    y: Array
    W: Array
    V: Array
    residual: float
    state_names: tuple[str, ...]
    input_names: tuple[str, ...]
    output_names: tuple[str, ...]
    robot: str
    dt: float = field(default_factory=float)

    def __repr__(self) -> str:
        return titled(self, knots=len(self.t), nx=self.L.shape[1], ny=self.L.shape[2])

    def covariance(self, t: float) -> Array:
        """Return P (nx, nx) of the most recent sample at time t."""
        return self.interpolant.cost(self._within(t))

    @cached_property
    def interpolant(self) -> Interpolant:
        """Filter gain and error covariance over time."""
        return Interpolant(self.t, self.P, self.L, (), self.dt)


class Interpolant:
    """Cost P (nx, nx) and gain K = R^-1 B' P as functions of time."""

    # Between knots, P is a cubic and B is a spline. A sampled schedule keeps the values of the
    # last sample.

    def __init__(self, t: Array, P: Array, K: Array, model: tuple[Array, ...], dt: float) -> None:
        self.first, self.last = float(t[0]), float(t[-1])
        self._t, self._P, self.K, self._dt = t, P, K, dt
        if dt:
            # A sample starts slightly before its nominal time, because times are rounded.
            self.starts = [self.first, *(t[1:] - 1e-9 * dt).tolist()]
            return
        self.starts = t[:-1].tolist()
        A, self._B, Q, self._R = model
        drift, spent = P @ A, K.mT @ self._R @ K
        rate = spent - drift - drift.mT - Q
        h = np.diff(t)[:, None, None]
        # Coefficients for powers of the elapsed fraction of an interval.
        self._cubics = cubic(P[:-1], P[1:], h * rate[:-1], h * rate[1:])

    @cached_property
    def pieces(self) -> Array:
        """Coefficients (M - 1, 7, nu nx) of K, for powers of the time since the last knot."""
        from scipy.interpolate import CubicSpline

        powers = self._cubics / np.diff(self._t)[:, None, None, None] ** np.arange(4)[:, None, None]
        of_B = CubicSpline(self._t, self._B).c[::-1]
        pieces = np.zeros((7, *of_B[0].mT.shape))
        for power, reach in enumerate(np.linalg.solve(self._R, of_B.mT)):
            pieces[power : power + 4] += reach @ powers.swapaxes(0, 1)
        return pieces.swapaxes(0, 1).reshape(len(self._t) - 1, 7, -1)

    def gain(self, t: float) -> Array:
        """Return K = R^-1 B' P (nu, nx) at a time within the knots."""
        k = bisect_right(self.starts, t) - 1
        if self._dt:
            return self.K[k]
        x = t - self.starts[k]
        square = x * x
        fourth = square * square
        powers = np.array((1.0, x, square, square * x, fourth, fourth * x, fourth * square))
        return powers.dot(self.pieces[k]).reshape(self.K.shape[1:])

    def cost(self, t: float) -> Array:
        """Return P (nx, nx) at a time within the knots."""
        k = bisect_right(self.starts, t) - 1
        if self._dt:
            return self._P[k]
        s = (t - self._t[k]) / (self._t[k + 1] - self._t[k])
        P: Array = np.tensordot(s ** np.arange(4), self._cubics[k], 1)
        return P

    def residual(self, at: Callable[[Array], Coefficients]) -> float:
        """Return the largest relative residual of the differential equation between knots."""
        h, (first, second, third, fourth) = np.diff(self._t), self._cubics.swapaxes(0, 1)
        P = first + 0.5 * second + 0.25 * third + 0.125 * fourth
        rate = (second + third + 0.75 * fourth) / h[:, None, None]
        A, S, Q = at(self._t[:-1] + 0.5 * h)
        drift = P @ A
        return imbalance(np.array((drift, drift.mT, -P @ S @ P, Q, rate)))
