"""Time-varying regulator along a trajectory, and gain schedules of regulators and filters."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import block_diag

from fflin.analysis.reduction import regulated_part
from fflin.base.errors import InputError, StabilizabilityError
from fflin.base.process import in_one_thread
from fflin.base.tables import folded
from fflin.base.validation import Array, Indices, Mask, Vector, instance, number
from fflin.control.default_weights import pace_along
from fflin.control.gain import ModelDesign
from fflin.control.mean_field import mean_model, mean_rule
from fflin.control.optimal import differential_riccati as riccati
from fflin.control.optimal import periodic_riccati
from fflin.control.optimal.periodic_loops import monodromy
from fflin.control.trajectory_end import steady_end, steady_regulator
from fflin.control.weights import (
    Rule,
    Weight,
    cost_weights,
    rule_weights,
    warn_of_integral,
    weight,
)
from fflin.dynamics.integrators import HEAVY, LIGHT, held_cost
from fflin.dynamics.state import StateMap
from fflin.linear.fit import require_same
from fflin.linear.floquet import multiplier_text
from fflin.linear.floquet import multipliers as multipliers_of
from fflin.linear.linear_trajectory import LinearTrajectory, Steps, transitions
from fflin.linear.partition import Partition
from fflin.linear.trajectory import Trajectory
from fflin.robot.robot import Robot

if TYPE_CHECKING:
    from scipy.interpolate import CubicHermiteSpline

    from fflin.linear.tool_trajectory import ToolSchedule


@dataclass(frozen=True, eq=False, repr=False)
class Schedule(ModelDesign):
    """Gain as a function of time along a trajectory, given at knots or at samples."""

    t: Vector
    P: Array
    residual: float
    period: float = field(default=0.0, kw_only=True)
    switches: Vector = field(default_factory=partial(np.zeros, 0), kw_only=True)
    switched_names: tuple[str, ...] = field(default=(), kw_only=True)
    orbit: str = field(
        default_factory=str, kw_only=True
    )  # of the robot, as JSON text; empty without an orbit

    @property
    def partition(self) -> Partition:
        """Parts of the trajectory with the same independent coordinates."""
        return Partition.of(self.switches, self.state_names, self.switched_names)

    @cached_property
    def parts(self) -> Indices:
        """Index (M,) of the part of the trajectory to which each knot or sample belongs."""
        if self.dt:
            return self.partition.parts_at(self.t, float(self.t[-1] - self.t[0]))
        # A continuous schedule has two knots at each switch: before and after it.
        return np.append(0, np.cumsum(np.diff(self.t) == 0.0))

    def part(self, t: float) -> int:
        """Return the index of the part of the trajectory at the time t [s] of the schedule."""
        return int(self.parts[self.interval(t)])

    @cached_property
    def starts(self) -> list[float]:
        """Start times of the intervals between knots, or of the samples of a sampled schedule."""
        times = self.t[:-1]
        if self.dt:
            # A sample starts slightly before its nominal time, so that a rounded time finds its
            # sample.
            times = np.append(self.t[0], self.t[1:] - 1e-9 * self.dt)
        starts: list[float] = times.tolist()
        return starts

    def _in_period(self, t: float) -> float:
        """Return the time t of a periodic schedule, moved into the period of its knots."""
        if not self.period:
            return t
        first = float(self.t[0])
        moved = first + (t - first) % self.period
        # A time slightly before the start of a sample counts as its start.
        if self.dt and first + self.period - moved <= 1e-9 * self.dt:
            return first
        return moved

    def interval(self, t: float) -> int:
        """Return the index of the interval or sample at t; if there is none, raise `InputError`."""
        t = self._in_period(number("t", t))
        first = self.starts[0]
        last = float(self.t[-1])
        if not first <= t <= last:
            raise InputError(f"t is {t:g} s, expected {first:g} to {last:g} s")
        return bisect_right(self.starts, t) - 1


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
    robot, urdf_sha256 : str
        Name of the robot, and SHA-256 of its URDF.
    dt : float
        Sampling time [s], over which u is held; 0 for continuous time.
    weights : str
        Description of the rule that set the weights.
    period : float
        Time [s] after which the gains repeat; 0 if they do not repeat.
    loop_multipliers : ndarray (k,)
        Magnitudes of the characteristic multipliers of the closed loop over one period, the largest
        first; empty if the gains do not repeat. States that are not regulated are left out, unless
        the regulated states depend on them.
    switches, switched_names
        Times [s] at which the independent coordinates of a robot with constraints change, and the
        names of the states after each change, as in `LinearTrajectory`. K, P, A and B are in the
        coordinates of their time. A continuous schedule has two knots at each switch, before and
        after it. Q (M, nx, nx) is then given at the knots, and Qf in the last coordinates.
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

    _SHAPES = "t:t K:tux P:txx state_names:x input_names:u knots:k q:kq v:kv"

    K: Array
    Q: Array
    R: Array
    Qf: Array
    weights: str
    knots: Vector
    q: Array
    v: Array
    u: Array
    hold: str
    frame: str
    loop_multipliers: Vector = field(default_factory=partial(np.zeros, 0), kw_only=True)

    def _report(self) -> str:
        """Return the report, which contains the sizes, the residual and the rule of the weights."""
        lines = [repr(self), f"weights: {self.weights or 'as given'}"]
        if self.period:
            lines.append(f"repeats after {self.period:.6g} s")
            if self.loop_multipliers.size:
                loop = "closed loop"
                if len(self.loop_multipliers) < len(self.state_names):
                    loop = "closed loop of the regulated states"
                lines[-1] += f"; {loop}: {multiplier_text(self.loop_multipliers)}"
        lines += self.partition.remarks()
        return folded(lines)

    def trajectory(self, robot: Robot) -> Trajectory:
        """Return the trajectory that the gains were designed for."""
        state = StateMap(robot)
        made = f"the gain schedule was made for '{self.robot}'"
        reduced = bool(robot.constraints)
        for names in self.partition.names:
            require_same(made, state, "state", names, None, part=reduced)
        require_same(made, state, "input", self.input_names, None)
        if self.orbit != orbit_text(robot):
            raise InputError(
                f"{made} in another orbit than that of '{robot.name}'; use the same orbit for both"
            )
        parts = self.knots, self.q, self.v, self.u
        return Trajectory(
            robot, *parts, hold=self.hold, frame=self.frame, period=self.period
        )

    def to(self, tool: str, robot: Robot) -> ToolSchedule:
        """Return the gains and the trajectory in the coordinates of Pinocchio or Crocoddyl.

        Parameters
        ----------
        tool : {"pinocchio", "crocoddyl"}
        robot : Robot
            The robot of the trajectory.

        Raises
        ------
        InputError
            If the tool has other axes, or the robot has other states or inputs.
        UnknownNameError
            If the tool is unknown.
        """
        from fflin.linear.tool_trajectory import tool_schedule

        return tool_schedule(self, tool, robot)

    def gain(self, t: float) -> Array:
        """Return the gain at time t, or raise `InputError` if t is outside the knots.

        Between knots, the gain is computed from the interpolated model and P. A sampled schedule
        returns the gain of the most recent sample.
        """
        k = self.interval(t)
        if self.dt:
            K: Array = self.K[k]
            return K
        x = self._in_period(t) - self.starts[k]
        square = x * x
        fourth = square * square
        powers = np.array(
            (1.0, x, square, square * x, fourth, fourth * x, fourth * square)
        )
        K = powers.dot(self.pieces[k]).reshape(self.K.shape[1:])
        return K

    def cost_to_go(self, t: float) -> Array:
        """Return P (nx, nx) at time t: interpolated, or of the latest sample if sampled."""
        k = self.interval(t)
        if self.dt:
            P: Array = self.P[k]
            return P
        cubic = self._cubics[self.parts[k]]
        interpolated: Array = cubic(self._in_period(t))
        return interpolated

    @cached_property
    def _knots_of_parts(self) -> list[slice]:
        """Indices of the knots of each part of a continuous schedule."""
        ends = np.cumsum(np.bincount(self.parts)).tolist()
        return [slice(*pair) for pair in pairwise((0, *ends))]

    @cached_property
    def _cubics(self) -> list[CubicHermiteSpline]:
        """P (nx, nx) as a function of time, by cubics that match P and dP/dt at the knots.

        There is one function for each part of the trajectory.
        """
        from scipy.interpolate import CubicHermiteSpline

        drift = self.P @ self.A
        spent = self.K.mT @ self.R @ self.K
        slopes = spent - drift - drift.mT - self.Q
        if not np.isfinite(slopes).all():
            raise np.linalg.LinAlgError("P changes too fast")
        return [
            CubicHermiteSpline(self.t[knots], self.P[knots], slopes[knots])
            for knots in self._knots_of_parts
        ]

    @cached_property
    def pieces(self) -> Array:
        """Coefficients (M - 1, 7, nu nx) of K, for powers of the time since the last knot.

        The interval between the two knots of a switch has no duration; its coefficients are zero.
        """
        from scipy.interpolate import CubicSpline

        # Between knots, P and B are cubics of time, so K = R^-1 B' P has degree 6.
        pieces = np.zeros((7, len(self.t) - 1, *self.K.shape[1:]))
        for knots, cubics in zip(self._knots_of_parts, self._cubics, strict=True):
            of_B = CubicSpline(self.t[knots], self.B[knots]).c[::-1]
            intervals = slice(knots.start, knots.stop - 1)
            for power, reach in enumerate(np.linalg.solve(self.R, of_B.mT)):
                pieces[power : power + 4, intervals] += reach @ cubics.c[::-1]
        return pieces.swapaxes(0, 1).reshape(len(self.t) - 1, 7, -1)

    def defect(self, at: Callable[[Array, int], Array]) -> float:
        """Return the largest relative residual of the differential equation between knots.

        `at` returns the coefficients A, S and Q at times (k,), in the coordinates of a part.
        """
        worst = 0.0
        for part, knots in enumerate(self._knots_of_parts):
            t = self.t[knots]
            middle = 0.5 * (t[:-1] + t[1:])
            P, rate = self._cubics[part](middle), self._cubics[part](middle, 1)
            A, S, Q = at(middle, part)
            drift = P @ A
            terms = np.array((drift, drift.mT, -P @ S @ P, Q, rate))
            worst = max(worst, riccati.imbalance(terms))
        return worst


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
    robot, urdf_sha256 : str
        Name of the robot, and SHA-256 of its URDF.
    dt : float
        Sampling time [s].
    period : float
        Time [s] after which the filter repeats; 0 if it does not repeat.

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

    L: Array
    C: Array
    D: Array
    y: Array
    W: Array
    V: Array
    output_names: tuple[str, ...]

    def gain(self, t: float) -> Array:
        """Return L (nx, ny) of the most recent sample at time t."""
        L: Array = self.L[self.interval(t)]
        return L

    def covariance(self, t: float) -> Array:
        """Return P (nx, nx) of the most recent sample at time t."""
        P: Array = self.P[self.interval(t)]
        return P


@in_one_thread
def tvlqr(
    traj: LinearTrajectory,
    Q: Weight | None = None,
    R: Weight | None = None,
    Qf: Weight | str = "steady",
    sample: float | None = None,
    *,
    weights: Rule | None = None,
    rule: str = "as given",
) -> GainSchedule:
    r"""Return the time-varying linear quadratic regulator along a trajectory.

    From any time t to the end T, the regulator minimises the finite-horizon cost

    .. math:: e(T)^T Q_f\,e(T) + \int_t^T e^T Q\,e + \delta u^T R\,\delta u\;d\tau.

    The differential Riccati equation is :math:`-\dot P = A^T P + P A - P B R^{-1} B^T P + Q`, with
    :math:`P(T) = Q_f`. The Riccati equation is solved backwards from knot to knot, by maps
    :math:`P_0 = W + \Phi^T P_1 (I + G P_1)^{-1} \Phi` from the cost :math:`P_1` at a knot to the
    cost :math:`P_0` at the previous knot. Each map is computed from a short matrix exponential by
    doubling. In short steps, W and G are positive semidefinite, and then P stays positive
    semidefinite over any horizon. In long steps over which B or Q changes, they may be indefinite.
    The code does not check this, but it adds knots until the estimated errors of the steps and of
    the interpolation of P are below 1e-7. The method has order four in general, and is exact if A
    and B are constant.

    With `sample`, the regulator is sampled: e is measured at the samples, and :math:`\delta u` is
    held between samples. The cost is still the integral over continuous time, evaluated by (10.1)
    and (10.3) of docs/derivation.md along the motion.

    Parameters
    ----------
    traj : LinearTrajectory
    Q : array_like (nx, nx) or (nx,), float, or mapping, optional
        Weight on the error, positive semidefinite, as in `lqr`. If the independent coordinates of a
        robot with constraints change, Q and Qf refer to the coordinates at the first knot. The cost
        of an error does not change at a switch, and neither does the law.
    R : array_like (nu, nu) or (nu,), float, or mapping, optional
        Weight on the inputs, positive definite.
    Qf : "steady", "periodic", or as Q
        Weight on the error at the end. "steady" is the infinite-horizon cost of `lqr` about the end
        point. The end point is the last configuration, in its final motion if this motion is
        steady, otherwise at rest. A robot that falls freely at the end, such as a legged robot in
        a jump, is at rest there relative to axes that fall with it (5.4). States that the inputs
        stabilise have zero weight in Qf, see `momentum_reduction`. "periodic" is the cost over
        infinitely many periods of a periodic trajectory, such as `linearize_orbit` returns: the
        schedule then repeats. It is the stabilising solution of the periodic Riccati equation.
        States of the base that no input pushes have zero weight, as in `lqr`.
    sample : float, optional
        Sampling time [s], which must divide the duration.
    weights : {"urdf", "identity"} or mapping, optional
        Rule for the weights if Q and R are omitted, in the same forms as in `lqr`. The rule is
        applied to the linear model at the last point of the trajectory, with two changes: the
        limits are checked for displacements a tenth as large, and errors decay within the duration
        of the trajectory.
    rule : str
        Description of the rule that set Q and R.

    Returns
    -------
    GainSchedule

    Raises
    ------
    InputError
        If a weight has a wrong size or is not positive (semi)definite, if P changes so fast that
        too many knots are needed, or if the sampling time does not divide the duration.
    UnknownNameError
        If a name does not exist.
    EquilibriumError, StabilizabilityError
        If Qf is "steady", no inputs can hold the robot at the end point, and the robot does not
        fall freely there. If Qf is "periodic", the inputs cannot stabilise the motion, or Q does
        not weight an unstable motion.

    References
    ----------
    W.-W. Lin and E. K.-W. Chu (with others), structure-preserving doubling algorithms, 2018.
    E. Celledoni, A. Marthinsen and B. Owren, Commutator-free Lie group methods, Future Generation
    Computer Systems 19(3), 2003.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> v0 = fflin.velocity(robot, {"joint_1": 0.1})
    >>> motion = fflin.simulate(robot, v0=v0, duration=2.0, every=20)
    >>> along = fflin.linearize_trajectory(robot, motion.trajectory())
    >>> fflin.tvlqr(along, sample=0.1).K.shape
    (21, 9, 18)
    """
    dt = sample_time(traj, sample)
    asks_steady(Qf)  # raises an error for an unknown string
    periodic = asks_periodic(Qf, traj)
    about = 0
    if Q is None and R is None:
        about = traj.last_part
        warn_of_integral(traj[0], (Q, R), weights, "a law along a trajectory")
        Q, R, rule = _default_weights(traj, weights, dt, periodic=periodic)
    elif weights is not None or Q is None or R is None:
        raise InputError(
            "give either both Q and R, or only weights='urdf' or 'identity'"
        )
    Q, R, _ = cost_weights(traj, Q, R, None)
    if periodic:
        Q, regulated, left_out = _of_regulated(traj, Q)
        rule += left_out
    cost = StateCost(traj, Q, about)
    at_end: Array = np.zeros_like(Q)  # replaced by the periodic solution
    if not periodic:
        at_end = _end_weight(traj, Qf, cost, R, sample)

    def at(times: Array, part: int) -> Array:
        A, B = traj.matrices_at(times, part)
        return np.array((A, B @ np.linalg.solve(R, B.mT), cost.at(times, part)))

    residual = 0.0
    remedy = "smaller weights or a larger R"
    multipliers: Array = np.zeros(0)
    with riccati.bounded_by(remedy):
        if sample is not None:
            stages = list(held_stages(traj, dt, cost, R))
            A, B = np.split(np.array([whole for _, whole in stages]), [len(Q)], axis=2)
            if periodic:
                K, P, residual = _periodic_samples(traj, stages, regulated)
                at_end = P[-1]
                multipliers = loop_multipliers(A - B @ K[:-1], regulated)
            else:
                K, P, residual = _samples_back(stages, at_end)
            t = traj.samples(dt)
        else:
            if periodic:
                t, P, factors = _periodic_back(
                    traj, lambda times: at(times, 0), regulated
                )
                at_end = P[-1]
                multipliers = loop_multipliers(factors, regulated)
                A, B = traj.matrices_at(t)
            else:
                t, P, A, B = _solved_back(traj, at, at_end)
            K = np.linalg.solve(R, B.transpose(0, 2, 1) @ P)
    schedule = GainSchedule._of(
        traj,
        t=t,
        K=K,
        P=P,
        A=A,
        B=B,
        Q=cost.along(t, continuous=not dt),
        R=R,
        Qf=at_end,
        residual=residual,
        robot=traj.robot.name,
        urdf_sha256=traj.robot.urdf_sha256,
        dt=dt,
        weights=rule,
        knots=traj.t,
        loop_multipliers=_require_stable(traj, multipliers),
        orbit=orbit_text(traj.robot),
    )
    if dt:
        return schedule
    with riccati.bounded_by(remedy):
        return replace(schedule, residual=schedule.defect(at))


def _default_weights(
    traj: LinearTrajectory, weights: Rule | None, dt: float, *, periodic: bool
) -> tuple[Array, Array, str]:
    """Return Q, R and the rule of the default weights along a trajectory."""
    pace = pace_along(float(traj.t[-1] - traj.t[0]), dt)
    lin = mean_model(traj) if periodic else steady_end(traj).model
    Q, R, _, rule = rule_weights(lin, weights, pace, _wheel_speeds(traj))
    if periodic:
        rule += mean_rule(traj)
    return Q, R, rule


class StateCost:
    """Cost e' Q e of the error along a trajectory, in the coordinates of any of its parts.

    The given Q (nx, nx) refers to the coordinates of the part `about`.
    """

    def __init__(self, traj: LinearTrajectory, Q: Array, about: int) -> None:
        self._traj = traj
        self._Q = Q
        self._about = about

    def at(self, times: Array, part: int) -> Array:
        """Return Q (k, nx, nx) at times (k,) in the coordinates of a part."""
        if part == self._about:
            return np.broadcast_to(self._Q, (len(times), *self._Q.shape))
        maps = self._traj.error_maps(times, part, self._about)
        cost: Array = maps.mT @ self._Q @ maps
        return cost

    def along(self, t: Array, *, continuous: bool) -> Array:
        """Return Q at the knots t of a schedule; (nx, nx) if the coordinates do not change."""
        traj = self._traj
        if not traj.last_part:
            return self._Q
        if continuous:
            parts = np.append(0, np.cumsum(np.diff(t) == 0.0))
        else:
            parts = traj.partition.parts_at(t, float(t[-1] - t[0]))
        return np.concatenate(
            [self.at(t[parts == part], part) for part in range(1 + traj.last_part)]
        )

    def in_steps(self, steps: Steps) -> Array:
        """Return Q (m, nx, nx) of the integration steps of a sample, or (nx, nx) if constant."""
        traj = self._traj
        if not traj.last_part:
            return self._Q
        costs = np.zeros((len(steps.h), *self._Q.shape))
        duration = float(traj.t[-1] - traj.t[0])
        for early, late, cost in zip(*steps.nodes.T, costs, strict=True):
            times = np.array((early, late))
            part = int(traj.partition.parts_at(times, duration)[0])
            first, second = self.at(times, part)
            cost[:] = HEAVY * first + LIGHT * second
        return costs


def _solved_back(
    traj: LinearTrajectory, at: Callable[[Array, int], Array], P: Array
) -> tuple[Array, Array, Array, Array]:
    """Return times, P, A and B at these times, from P at the end of a trajectory.

    If the coordinates change, the time of the change occurs twice, before and after it.
    """
    columns = list[tuple[Array, Array, Array, Array]]()
    for part in range(traj.last_part, -1, -1):
        coefficients = partial(_in_part, at, part)
        t, values = riccati.solve_back(coefficients, traj.knots_of(part), P)
        columns.append((t, values, *traj.matrices_at(t, part)))
        if part:
            change = traj.switch_maps[part - 1]
            P = change.T @ values[0] @ change
            P = 0.5 * (P + P.T)
    times, costs, A, B = (
        np.concatenate(arrays) for arrays in zip(*columns[::-1], strict=True)
    )
    return times, costs, A, B


def _in_part(at: Callable[[Array, int], Array], part: int, times: Array) -> Array:
    return at(times, part)


def _end_weight(
    traj: LinearTrajectory,
    Qf: Weight | str,
    cost: StateCost,
    R: Array,
    sample: float | None,
) -> Array:
    """Return the weight on the error at the end, in the coordinates of the last part."""
    end = traj.t[-1:], traj.last_part
    if isinstance(Qf, str):
        return steady_regulator(steady_end(traj), cost.at(*end)[0], R, sample)[0]
    given = StateCost(traj, weight("Qf", Qf, traj.state_names), 0)
    at_end: Array = given.at(*end)[0]
    return at_end


def orbit_text(robot: Robot) -> str:
    """Return the orbit of a robot as JSON text; empty without an orbit."""
    return robot.orbit.to_json() if robot.orbit else ""


def asks_steady(value: object, name: str = "Qf", kind: str = "a weight") -> bool:
    """Return whether `value` is "steady"; raise `InputError` if `value` is an unknown string."""
    if isinstance(value, str) and value not in ("steady", "periodic"):
        raise InputError(
            f"{name} is {value!r}, expected 'steady', 'periodic' or {kind}"
        )
    return isinstance(value, str) and value == "steady"


def asks_periodic(value: object, traj: LinearTrajectory, name: str = "Qf") -> bool:
    """Return whether `value` is "periodic"; raise `InputError` if the trajectory does not fit."""
    periodic = isinstance(value, str) and value == "periodic"
    if periodic and not traj.period:
        raise InputError(
            f"{name} is 'periodic', but the trajectory has no period; fflin.linearize_orbit "
            "returns a periodic trajectory"
        )
    if traj.period and not periodic:
        raise InputError(
            f"the trajectory is periodic and has no end; give {name}='periodic'"
        )
    return periodic


def _wheel_speeds(traj: LinearTrajectory) -> bool | None:
    """Return `wheel_speeds` of `lqr` for a regulator along a trajectory.

    Over an orbit, the gravity gradient changes the momentum of the wheels. The periodic regulator
    uses it to control their speeds.
    """
    return True if traj.robot.orbit else None


def _of_regulated(traj: LinearTrajectory, Q: Array) -> tuple[Array, Mask, str]:
    """Return Q with zero weight for states that are not regulated.

    Further results are the mask (nx,) of the regulated states, and a text that names the others.
    """
    lin = traj[0]
    kept = regulated_part(lin, _wheel_speeds(traj)).state_names
    left_out = [name for name in lin.state_names if name not in kept]
    rows = [lin.state_names.index(name) for name in left_out]
    Q = Q.copy()
    Q[rows] = 0.0
    Q[:, rows] = 0.0
    regulated = np.array([name in kept for name in lin.state_names])
    text = f"; not regulated: {', '.join(left_out)}" if left_out else ""
    return Q, regulated, text


def _solved_states(traj: LinearTrajectory, regulated: Mask) -> Mask:
    """Return the mask (nx,) of the states for which the periodic Riccati equation is solved.

    It marks the regulated states, and the states that affect one of them at any knot. The other
    states have no cost. Some of them do not decay, such as the base position and wheel angles, and
    the errors of the doubling would grow with them.
    """
    solved = regulated.copy()
    largest = np.abs(traj.A).max(axis=0)
    while True:
        inside = largest[solved]
        affects = inside.max(axis=0) > _UNCOUPLED * inside[:, solved].max(initial=0.0)
        if not (affects & ~solved).any():
            return solved
        solved |= affects


def _part_of(matrices: Array, kept: Mask) -> Array:
    """Return the rows and columns of the kept states of matrices (.., nx, nx)."""
    part: Array = matrices[..., kept, :][..., kept]
    return part


def _stage_of(stage: tuple[Array, Array], kept: Mask) -> tuple[Array, Array]:
    """Return the cost matrix and the transition matrix of a sample for the kept states."""
    weights, whole = stage
    inputs = np.ones(len(weights) - len(kept), dtype=bool)
    columns = np.concatenate((kept, inputs))
    return _part_of(weights, columns), whole[kept][:, columns]


def _periodic_samples(
    traj: LinearTrajectory, stages: Sequence[tuple[Array, Array]], regulated: Mask
) -> tuple[Array, Array, float]:
    """Return K and P at all samples of a period, and the largest relative residual."""
    solved = _solved_states(traj, regulated)
    parts = [_stage_of(stage, solved) for stage in stages]
    K, P, residual = _samples_back(parts, periodic_end(traj, parts[::-1]))
    selection = np.eye(len(solved))[solved]
    return K @ selection, selection.T @ P @ selection, residual


def _samples_back(
    stages: Sequence[tuple[Array, Array]], at_end: Array
) -> tuple[Array, Array, float]:
    """Return K and P at all samples, the first sample first, and the largest relative residual."""
    gains, costs, residual = riccati.samples_back(reversed(stages), at_end)
    return np.concatenate((gains[::-1], gains[:1])), costs[::-1], residual


def periodic_end(
    traj: LinearTrajectory, stages: Sequence[tuple[Array, Array]]
) -> Array:
    """Return P at the end of the period of a sampled regulator, or at the start for a filter.

    `stages` are the cost matrix and the transition matrix of each sample, in the order in which
    the Riccati difference equation passes them.
    """
    with stabilised(traj):
        maps = [periodic_riccati.sample_transition(*stage) for stage in stages]
        P = periodic_riccati.periodic_cost(periodic_riccati.over_period(maps))
        transitions = np.array([whole for _, whole in stages])
        A, B = np.split(transitions, [len(P)], axis=2)

        def sweep(end: Array) -> tuple[Array, Array]:
            gains, costs, _ = riccati.samples_back(stages, end)
            return costs[-1], monodromy((A - B @ np.array(gains))[::-1])

        return periodic_riccati.repeated(sweep, P, _UNSTABLE)


# Largest multiplier of a loop that counts as stable. States that are not regulated may have the
# multiplier 1, with rounding errors.
_LARGEST_MULTIPLIER = 1.001

# For a rough periodic solution, the intervals between knots are halved until their number is at
# least this. A loop of magnetorquers that is 80 times as fast as the orbit needs 512 intervals.
_INTERVALS = 1024

# Entries of A and of transition matrices below this fraction of the largest one are rounding
# errors.
_UNCOUPLED = 1e-12

_UNSTABLE = "give other inputs, or zero weights for states that the inputs cannot hold"


def _require_stable(traj: LinearTrajectory, multipliers: Array) -> Array:
    """Return the multipliers of a loop.

    Raise `StabilizabilityError` if the weights leave an unstable motion in a periodic loop.
    """
    largest = float(np.abs(multipliers).max(initial=0.0))
    if largest > _LARGEST_MULTIPLIER:
        raise StabilizabilityError(
            f"the periodic regulator does not stabilise '{traj.robot.name}': the largest "
            f"multiplier of the closed loop is {largest:.6g}, because Q does not weight an "
            "unstable motion; give weights to all states"
        )
    return multipliers


@contextmanager
def stabilised(traj: LinearTrajectory) -> Iterator[None]:
    """Replace a `LinAlgError` of the doubling by a `StabilizabilityError`."""
    try:
        yield
    except np.linalg.LinAlgError:
        largest = float(np.abs(traj.multipliers).max())
        raise StabilizabilityError(
            f"no periodic solution of the Riccati equation exists for '{traj.robot.name}', whose "
            f"largest multiplier is {largest:.6g}: the cost grows from period to period; "
            f"{_UNSTABLE}"
        ) from None


def _periodic_back(
    traj: LinearTrajectory, at: Callable[[Array], Array], regulated: Mask
) -> tuple[Array, Array, Array]:
    """Return times, P at these times, and the closed-loop transition matrices between them.

    The results contain all states. Those for which the Riccati equation is not solved have no cost,
    and the transition matrices contain zeros for them.
    """
    solved = _solved_states(traj, regulated)

    def coefficients(times: Array) -> Array:
        return _part_of(at(times), solved)

    with stabilised(traj):
        P = _rough_cost(traj.t, coefficients)
        # This sweep finds the times between which the maps are accurate. The doubling is repeated
        # with these maps, so that it agrees with a sweep to machine precision.
        times, maps = riccati.accurate_maps(coefficients, traj.t, P)
        P = periodic_riccati.periodic_cost(
            periodic_riccati.over_period(iter(maps[::-1]))
        )

        def sweep(end: Array) -> tuple[Array, Array]:
            costs = _swept(maps, end)
            factors = periodic_riccati.loop_factors(maps, costs)
            return costs[0], monodromy(factors)

        P = periodic_riccati.repeated(sweep, P, _UNSTABLE)
        costs = _swept(maps, P)
    factors = periodic_riccati.loop_factors(maps, costs)
    selection = np.eye(len(solved))[solved]
    return (
        times,
        selection.T @ costs @ selection,
        selection.T @ factors @ selection,
    )


def _rough_cost(times: Array, at: Callable[[Array], Array]) -> Array:
    """Return an estimate of the periodic solution P (nx, nx) at the end of the period.

    The maps between the knots `times` (k,) [s] are not accurate if the cost changes fast. Then the
    doubling may fail, and is repeated with more knots. Raise `LinAlgError` if it fails always.
    """
    while True:
        maps = periodic_riccati.interval_maps(at, times)
        try:
            return periodic_riccati.periodic_cost(
                periodic_riccati.over_period(iter(maps[::-1]))
            )
        except np.linalg.LinAlgError:
            if len(maps) >= _INTERVALS:
                raise
        middle = 0.5 * (times[1:] + times[:-1])
        times = np.sort(np.concatenate((times, middle)))


def _swept(maps: Array, P: Array) -> Array:
    """Return P (k + 1, nx, nx) at all times for P at the last one."""
    values = [P]
    for one in maps[::-1]:
        values.append(riccati.stepped_back(one, values[-1]))
    return np.array(values[::-1])


def loop_multipliers(factors: Array, regulated: Mask) -> Array:
    """Return the magnitudes (k,) of the multipliers of a closed loop, the largest first.

    `factors` (N, nx, nx) are transition matrices, and `regulated` (nx,) marks the regulated states.
    If these do not depend on the other states, the multipliers of the other states are left out.
    """
    inside = factors[:, regulated][:, :, regulated]
    coupling = np.abs(factors[:, regulated][:, :, ~regulated]).max(initial=0.0)
    if coupling <= _UNCOUPLED * np.abs(inside).max(initial=0.0):
        factors = inside
    size: Array = np.sort(np.abs(multipliers_of(factors)))[::-1]
    return size


def held_stages(
    traj: LinearTrajectory, dt: float, Q: Array | StateCost, R: Array
) -> Iterator[tuple[Array, Array]]:
    """Yield the cost matrix and the transition matrix of each sample, first sample first."""
    state_cost = Q if isinstance(Q, StateCost) else StateCost(traj, Q, 0)
    nx = len(traj.state_names)
    n = nx + len(R)
    for steps, whole in transitions(traj, dt):
        total, transition = np.zeros((n, n)), np.eye(n)
        costs = _held_costs(steps, state_cost.in_steps(steps), R)
        for cost, step in zip(costs, steps.maps, strict=True):
            total += transition.T @ cost @ transition
            transition[:nx] = step @ transition
        yield total, whole


def _held_costs(steps: Steps, Q: Array, R: Array) -> Array:
    """Return the cost matrices (m, nx + nu, nx + nu) of the integration steps of a sample."""
    if Q.ndim == 2:
        return held_cost(steps.F, block_diag(Q, R), steps.h)
    return np.array(
        [
            held_cost(F, block_diag(weight_of_step, R), h)
            for F, weight_of_step, h in zip(steps.F, Q, steps.h, strict=True)
        ]
    )


def sample_time(traj: LinearTrajectory, sample: float | None) -> float:
    """Return the sampling time `sample` [s], or 0 if it is None.

    Raise `InputError` if `traj` is already sampled.
    """
    expected = "a LinearTrajectory; fflin.linearize_trajectory returns one"
    if instance("traj", traj, LinearTrajectory, expected).dt:
        raise InputError("traj is sampled; give the continuous trajectory and sample=")
    if sample is None:
        return 0.0
    return number("sample", sample)
