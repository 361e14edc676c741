"""Time-varying regulator along a trajectory, and gain schedules of regulators and filters."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import block_diag

from fflin.analysis.reduction import regulated_part
from fflin.base.errors import InputError, StabilizabilityError
from fflin.base.process import in_one_thread
from fflin.base.tables import folded
from fflin.base.validation import Array, Mask, Vector, instance, number
from fflin.control.default_weights import pace_along
from fflin.control.gain import ModelDesign
from fflin.control.mean_field import mean_model, mean_rule
from fflin.control.optimal import differential_riccati as riccati
from fflin.control.optimal import periodic_riccati
from fflin.control.trajectory_end import steady_end, steady_regulator
from fflin.control.weights import (
    Rule,
    Weight,
    cost_weights,
    rule_weights,
    warn_of_integral,
    weight,
)
from fflin.dynamics.integrators import held_cost
from fflin.dynamics.state import StateMap
from fflin.linear.fit import require_same
from fflin.linear.floquet import multiplier_text
from fflin.linear.floquet import multipliers as multipliers_of
from fflin.linear.linear_trajectory import LinearTrajectory, transitions
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
    orbit: str = field(
        default_factory=str, kw_only=True
    )  # of a periodic motion, as JSON text

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
        return folded(lines)

    def trajectory(self, robot: Robot) -> Trajectory:
        """Return the trajectory that the gains were designed for."""
        state = StateMap(robot)
        made = f"the gain schedule was made for '{self.robot}'"
        reduced = bool(robot.constraints)
        require_same(made, state, "state", self.state_names, None, part=reduced)
        require_same(made, state, "input", self.input_names, None)
        if self.period and self.orbit != orbit_text(robot):
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
        P: Array = self.P[k] if self.dt else self._cubics(self._in_period(t))
        return P

    @cached_property
    def _cubics(self) -> CubicHermiteSpline:
        """P (nx, nx) as a function of time, by cubics that match P and dP/dt at the knots."""
        from scipy.interpolate import CubicHermiteSpline

        drift = self.P @ self.A
        spent = self.K.mT @ self.R @ self.K
        slopes = spent - drift - drift.mT - self.Q
        if not np.isfinite(slopes).all():
            raise np.linalg.LinAlgError("P changes too fast")
        return CubicHermiteSpline(self.t, self.P, slopes)

    @cached_property
    def pieces(self) -> Array:
        """Coefficients (M - 1, 7, nu nx) of K, for powers of the time since the last knot."""
        from scipy.interpolate import CubicSpline

        # Between knots, P and B are cubics of time, so K = R^-1 B' P has degree 6.
        of_B = CubicSpline(self.t, self.B).c[::-1]
        pieces = np.zeros((7, *of_B[0].mT.shape))
        for power, reach in enumerate(np.linalg.solve(self.R, of_B.mT)):
            pieces[power : power + 4] += reach @ self._cubics.c[::-1]
        return pieces.swapaxes(0, 1).reshape(len(self.t) - 1, 7, -1)

    def defect(self, at: Callable[[Array], Array]) -> float:
        """Return the largest relative residual of the differential equation between knots."""
        middle = 0.5 * (self.t[:-1] + self.t[1:])
        P, rate = self._cubics(middle), self._cubics(middle, 1)
        A, S, Q = at(middle)
        drift = P @ A
        return riccati.imbalance(np.array((drift, drift.mT, -P @ S @ P, Q, rate)))


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
    cost :math:`P_0` at the previous knot. W and G are positive semidefinite. Each map is computed
    from a short matrix exponential by doubling, so P stays positive semidefinite over any horizon.
    The method has order four in general, and is exact if A and B are constant. Knots are added
    until the estimated errors of the steps and of the interpolation of P are below 1e-7.

    With `sample`, the regulator is sampled: e is measured at the samples, and :math:`\delta u` is
    held between samples. The cost is still the integral over continuous time, evaluated by (10.1)
    and (10.3) of docs/derivation.md along the motion.

    Parameters
    ----------
    traj : LinearTrajectory
    Q : array_like (nx, nx) or (nx,), float, or mapping, optional
        Weight on the error, positive semidefinite, as in `lqr`.
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
    dt, steady = sample_time(traj, sample), asks_steady(Qf)
    periodic = asks_periodic(Qf, traj)
    names = traj.state_names
    if Q is None and R is None:
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
        Qf = np.zeros_like(Q)  # replaced by the periodic solution
    elif steady:
        Qf = steady_regulator(steady_end(traj), Q, R, sample)[0]
    else:
        Qf = weight("Qf", Qf, names)

    def at(times: Array) -> Array:
        A, B = traj.matrices_at(times)
        return np.array((A, B @ np.linalg.solve(R, B.mT), np.broadcast_to(Q, A.shape)))

    residual = 0.0
    remedy = "smaller weights or a larger R"
    multipliers: Array = np.zeros(0)
    with riccati.bounded_by(remedy):
        if sample is not None:
            stages = list(held_stages(traj, dt, Q, R))
            if periodic:
                Qf = periodic_end(traj, stages[::-1])
            gains, costs, residual = riccati.samples_back(reversed(stages), Qf)
            t = traj.samples(dt)
            P = costs[::-1]
            K = np.concatenate((gains[::-1], gains[:1]))
            A, B = np.split(np.array([whole for _, whole in stages]), [len(Q)], axis=2)
            if periodic:
                multipliers = loop_multipliers(A - B @ K[:-1], regulated)
        elif periodic:
            t, P, maps = _periodic_back(traj, at)
            Qf = P[-1]
            multipliers = loop_multipliers(
                periodic_riccati.loop_factors(maps, P), regulated
            )
            A, B = traj.matrices_at(t)
            K = np.linalg.solve(R, B.transpose(0, 2, 1) @ P)
        else:
            t, P = riccati.solve_back(at, traj.t, Qf)
            A, B = traj.matrices_at(t)
            K = np.linalg.solve(R, B.transpose(0, 2, 1) @ P)
    schedule = GainSchedule._of(
        traj,
        t=t,
        K=K,
        P=P,
        A=A,
        B=B,
        Q=Q,
        R=R,
        Qf=Qf,
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
    Q, R, _, rule = rule_weights(lin, weights, pace)
    if periodic:
        rule += mean_rule(traj)
    return Q, R, rule


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


def _of_regulated(traj: LinearTrajectory, Q: Array) -> tuple[Array, Mask, str]:
    """Return Q with zero weight for states that are not regulated.

    Further results are the mask (nx,) of the regulated states, and a text that names the others.
    """
    lin = traj[0]
    kept = regulated_part(lin, None).state_names
    left_out = [name for name in lin.state_names if name not in kept]
    rows = [lin.state_names.index(name) for name in left_out]
    Q = Q.copy()
    Q[rows] = 0.0
    Q[:, rows] = 0.0
    regulated = np.array([name in kept for name in lin.state_names])
    text = f"; not regulated: {', '.join(left_out)}" if left_out else ""
    return Q, regulated, text


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
        return periodic_riccati.repeated(
            lambda end: riccati.samples_back(stages, end)[1][-1], P, _UNSTABLE
        )


# Largest multiplier of a loop that counts as stable. States that are not regulated may have the
# multiplier 1, with rounding errors.
_LARGEST_MULTIPLIER = 1.001

# Entries of transition matrices below this fraction of the largest one are rounding errors.
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
    traj: LinearTrajectory, at: Callable[[Array], Array]
) -> tuple[Array, Array, Array]:
    """Return times, P at these times, and T, G and W between them, for the periodic solution."""
    with stabilised(traj):
        coarse = periodic_riccati.interval_maps(at, traj.t)
        P = periodic_riccati.periodic_cost(
            periodic_riccati.over_period(iter(coarse[::-1]))
        )
        # This sweep finds the times at which the solution is accurate. The doubling is repeated
        # with the maps between these times, so that it agrees with a sweep to machine precision.
        times, _ = riccati.solve_back(at, traj.t, P)
        maps = periodic_riccati.interval_maps(at, times)
        P = periodic_riccati.periodic_cost(
            periodic_riccati.over_period(iter(maps[::-1]))
        )

        def sweep(end: Array) -> Array:
            start: Array = _swept(maps, end)[0]
            return start

        P = periodic_riccati.repeated(sweep, P, _UNSTABLE)
        return times, _swept(maps, P), maps


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
    traj: LinearTrajectory, dt: float, Q: Array, R: Array
) -> Iterator[tuple[Array, Array]]:
    """Yield the cost matrix and the transition matrix of each sample, first sample first."""
    nx, W = len(Q), block_diag(Q, R)
    for steps, whole in transitions(traj, dt):
        total, transition = np.zeros_like(W), np.eye(len(W))
        for cost, step in zip(held_cost(steps.F, W, steps.h), steps.maps, strict=True):
            total += transition.T @ cost @ transition
            transition[:nx] = step @ transition
        yield total, whole


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
