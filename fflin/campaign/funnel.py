"""Funnel: the region around a trajectory from which the tracking loop reaches its goal."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path

import numpy as np
import pinocchio as pin

from fflin.base import validation
from fflin.base.errors import InputError, require_known
from fflin.base.intervals import until_failure
from fflin.base.record import Design
from fflin.base.tables import folded, grid
from fflin.base.validation import Array, ArrayLike, Vector
from fflin.base.writing import as_path
from fflin.batch.run import Execution, Progress
from fflin.campaign.runs import (
    EDGE,
    KINDS,
    CampaignJob,
    Judge,
    completed,
    kind_named,
    notes_on_engine,
    of_campaign,
)
from fflin.control.tracking import TrajectoryFeedback, prepared
from fflin.control.tvlqr import GainSchedule
from fflin.dynamics.coordinates import refuse_constraints
from fflin.dynamics.points import point_of, start_of
from fflin.dynamics.state import StateMap
from fflin.dynamics.state_rows import moved_by, moving_error
from fflin.linear.trajectory import Trajectory, refuse_periodic
from fflin.robot.robot import Robot

_OPTIONS = ("dt", "method", "project", "sample", "delay", "limits", "disturbance")
# eigenvalues of the scaled P up to this fraction of the largest count as zero
_ROUNDING = 1e-12

# The search for the largest level simulates _PILOTS runs at each trial level, and halves the square
# root of the level at most _HALVINGS times.
_PILOTS, _HALVINGS = 16, 40
# Largest initial error of the attitude [deg], of a revolute joint [rad], and of the position or a
# prismatic joint [m].
_LARGEST_ATTITUDE = 170.0
_LARGEST_ANGLE = np.pi
_LARGEST_LENGTH = 1e3


def ellipsoid_axes(P: Array) -> Array:
    """Return W (nx, nx) such that W W' is a generalised inverse of P.

    Because the states have different units, P is first scaled to S P S by a diagonal matrix S. The
    diagonal of S P S contains ones, and zeros where the diagonal of P is zero. Then W = S R, where
    R is the symmetric square root of the pseudoinverse of S P S. This root is unique. Eigenvectors
    are not unique, so errors drawn along them would depend on rounding.
    """
    scale = np.sqrt(P.diagonal().clip(min=0.0))
    unit = np.divide(1.0, scale, out=np.zeros_like(scale), where=scale > 0.0)
    values, axes = np.linalg.eigh(unit[:, None] * P * unit)
    kept = values > _ROUNDING * values.max()
    root = axes[:, kept] / np.sqrt(values[kept]) @ axes[:, kept].T
    W: Array = unit[:, None] * root
    return W


@dataclass(frozen=True, eq=False, repr=False)
class Funnel(Design):
    """Ellipsoids ``e' P(t) e <= rho`` of errors around a trajectory; ``print`` shows a table.

    The error e relative to the trajectory is defined in `linearize_trajectory`. P(t) is the
    cost-to-go matrix of the gain schedule, and ``e' P e`` is the level of an error. Errors in the
    null space of P are not tested, because they do not change the level.

    Attributes
    ----------
    t : ndarray (m,)
        Times [s] of the knots.
    tried : ndarray (m,)
        Largest level of the tested initial errors. The square roots of the tested levels are evenly
        spaced.
    outcomes : ndarray (m, N)
        Outcome of each run, in ascending order of the level of the initial error: 0 if the goal was
        reached, 1 if the run was stopped early or its attitude error exceeded 176 deg, 2 if the
        bounds `within` were exceeded, 3 if the goal was missed.
    rho : ndarray (m,)
        Level up to which every run reached the goal; the size of the ellipsoid at the knot.
    inside : ndarray (m,)
        Number of runs that start at or below the level `rho`.
    inside_rate : ndarray (m,)
        Lower bound, at confidence level `confidence`, on the success rate of runs that start at or
        below the level `rho`.
    rate : ndarray (m, 2)
        Clopper-Pearson interval of the success rate of all runs, which start at or below the level
        `tried`.
    attitude, position, joints : ndarray (m, 3), (m, 3), (m, n)
        Half-axes of the ellipsoids in base attitude [deg], base position [m] and each joint
        [rad|m].
    goal, within : str
        Bounds on the final errors of a run (`goal`) and on its errors at any time (`within`).
    confidence : float
        Confidence level of the intervals.
    at, P : ndarray (M,), (M, nx, nx)
        Times [s] and cost to go of the schedule.
    notes : tuple of str
        Why the runs were simulated in Python although no engine was given.
    knots, q, v, u, hold, frame
        The followed trajectory, see `trajectory`.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> v0 = fflin.velocity(robot, {"joint_1": 0.1})
    >>> motion = fflin.simulate(robot, v0=v0, duration=2.0, every=20)
    >>> along = fflin.linearize_trajectory(robot, motion.trajectory())
    >>> reach = fflin.funnel(robot, fflin.tvlqr(along), {"attitude": 5.0}, samples=4, knots=2)
    >>> bool(reach.contains(0.0, q=motion.q[0], v=motion.v[0]))
    True
    """

    robot: Robot
    t: Vector
    tried: Vector
    outcomes: Array
    goal: str
    within: str
    confidence: float
    at: Vector
    P: Array
    knots: Vector
    q: Array
    v: Array
    u: Array
    hold: str
    frame: str
    notes: tuple[str, ...] = ()

    @cached_property
    def _counts(self) -> list[tuple[int, float, tuple[float, float]]]:
        return [until_failure(row != 0.0, self.confidence) for row in self.outcomes]

    @property
    def inside(self) -> Array:
        """Number of runs (m,) that start at or below the level `rho`."""
        return np.array([inside for inside, _, _ in self._counts])

    @property
    def inside_rate(self) -> Array:
        """Lower bound (m,) on the success rate of runs that start at or below the level `rho`."""
        return np.array([bound for _, bound, _ in self._counts])

    @property
    def rate(self) -> Array:
        """Clopper-Pearson interval (m, 2) of the success rate of all runs."""
        return np.array([interval for _, _, interval in self._counts])

    @cached_property
    def rho(self) -> Array:
        """Largest level (m,) up to which every run reached the goal."""
        count = self.outcomes.shape[1]
        level: Array = self.tried * ((self.inside - 0.5).clip(min=0.0) / count) ** 2
        return level

    @cached_property
    def attitude(self) -> Array:
        """Half-axes (m, 3) of the ellipsoids in base attitude [deg]."""
        sines = np.linalg.svd(self._roots[:, :3], compute_uv=False)
        angles: Array = np.degrees(2.0 * np.arcsin(np.minimum(sines, 1.0)))
        return angles

    @cached_property
    def position(self) -> Array:
        """Half-axes (m, 3) of the ellipsoids in base position [m]."""
        half: Array = np.linalg.svd(self._roots[:, 3:6], compute_uv=False)
        return half

    @cached_property
    def joints(self) -> Array:
        """Half-axes (m, n) of the ellipsoids in each joint [rad|m]."""
        half: Array = np.linalg.norm(self._roots[:, 6 : 6 + self.robot.n], axis=2)
        return half

    @cached_property
    def _roots(self) -> Array:
        return np.array([self.root(t) for t in self.t.tolist()])

    @cached_property
    def trajectory(self) -> Trajectory:
        """The followed trajectory."""
        return Trajectory(
            self.robot,
            self.knots,
            self.q,
            self.v,
            self.u,
            hold=self.hold,
            frame=self.frame,
        )

    def level(self, t: float) -> float:
        """Return rho at time t; between two knots, the smaller of their two levels."""
        t = validation.number("t", t)
        if not self.t[0] <= t <= self.t[-1]:
            raise InputError(
                f"t is {t:g} s, expected {self.t[0]:g} to {self.t[-1]:g} s"
            )
        near = [
            self.t.searchsorted(t, side) - (side == "right")
            for side in ("right", "left")
        ]
        return float(self.rho[near].min())

    def cost(self, t: float) -> Array:
        """Return P (nx, nx) at time t by linear interpolation of the schedule."""
        k = int(np.clip(self.at.searchsorted(t, "right") - 1, 0, len(self.at) - 2))
        part = float(np.interp(t, self.at[k : k + 2], [0.0, 1.0]))
        P: Array = (1.0 - part) * self.P[k] + part * self.P[k + 1]
        return P

    def root(self, t: float) -> Array:
        """Return W (nx, nx), which maps norm(z) <= 1 to the ellipsoid e = W z at time t."""
        size: float = np.sqrt(self.level(t))
        return size * ellipsoid_axes(self.cost(t))

    def contains(
        self,
        t: float,
        x: ArrayLike | None = None,
        *,
        q: ArrayLike | None = None,
        v: ArrayLike | None = None,
    ) -> bool:
        """Return whether a state is inside the funnel at time t.

        Parameters
        ----------
        t : float
            Time [s], from the first to the last knot.
        x : array_like (nx,), optional
            State of ``StateMap(robot, frame="local")``.
        q, v : array_like (nq,), (nv,), optional
            Configuration and velocity in Pinocchio's order, instead of x. If v is omitted, the
            robot is at rest.
        """
        rho, state = self.level(t), StateMap(self.robot, frame="local")
        if x is None and q is None:
            raise InputError("no state is given; give x, or q and v")
        q, v = point_of(state, x, q, v, partial(start_of, self.robot))
        e = moving_error(state, *self.trajectory.point(t)[:2], q, v)
        return bool(e @ self.cost(t) @ e <= rho)

    def __repr__(self) -> str:
        m, count = self.outcomes.shape
        return f"Funnel('{self.robot.name}', {m} knots of {count} runs, goal '{self.goal}')"

    def _report(self) -> str:
        count = self.outcomes.shape[1]
        sure = f"{100.0 * self.confidence:g} %"
        head = f"{self.robot.name}: initial errors from which every run ends with {self.goal}"
        if self.within:
            head += f", and with {self.within} at all times"
        head += f"; {count} runs per knot"
        tail = [
            "base, joint: largest half-axes of the ellipsoid of initial errors",
            "runs: number of runs that start inside the ellipsoid, all of which succeeded (+: "
            "all runs start inside)",
            f"inside: lower bound of the success rate of runs that start inside ({sure} "
            "confidence)",
            "tried: confidence interval of the success rate of runs that start up to the largest "
            "level tried",
        ]
        rows = [
            [
                "t [s]",
                "rho",
                "base [deg]",
                "base [m]",
                "joint",
                "runs",
                "inside",
                "tried",
            ]
        ]
        wide = (self.attitude, self.position, self.joints)
        for k, (low, high) in enumerate(100.0 * self.rate):
            reach = [f"{half_axes[k].max(initial=0.0):.3g}" for half_axes in wide]
            many = f"{self.inside[k]}"
            if self.inside[k] == count:
                many += " +"
            shares = [f"{100.0 * self.inside_rate[k]:.1f} %", f"{low:.0f}-{high:.0f} %"]
            rows.append(
                [f"{self.t[k]:.4g}", f"{self.rho[k]:.3g}", *reach, many, *shares]
            )
        lines = [folded([head, *self.notes]), "", grid(rows, "r"), "", folded(tail)]
        return "\n".join(lines)

    @classmethod
    def load(cls, path: str | Path, robot: Robot) -> Funnel:  # type: ignore[override]
        """Read a funnel of a robot from a file that `save` wrote; see `Gain.load` for errors."""
        return cls._read(as_path(path), robot=robot)


def funnel(
    robot: Robot,
    schedule: GainSchedule | TrajectoryFeedback,
    goal: Mapping[str, float] | float,
    *,
    within: Mapping[str, float] | None = None,
    knots: int | Sequence[float] = 10,
    samples: int = 100,
    seed: int = 0,
    confidence: float = 0.95,
    executor: Executor | None = None,
    workers: int | None = None,
    threads: int | None = None,
    progress: Progress | None = None,
    engine: str | None = None,
    **options: object,
) -> Funnel:
    r"""Estimate the initial errors from which a trajectory tracking loop reaches a goal.

    At each knot, initial errors e are drawn from an ellipsoid :math:`e^T P(t)\,e \le \rho`, where P
    is the cost-to-go matrix of the schedule. The directions of the errors are uniformly
    distributed. The square roots of their levels :math:`e^T P e` are evenly spaced. The nonlinear
    robot is simulated from each error to the end of the trajectory. The largest level tested is
    either the level at which about one run in sixteen fails, or the level at which the attitude
    error reaches 170 deg, whichever is smaller. The result is a statistical estimate, not a proof.

    Parameters
    ----------
    robot : Robot
    schedule : GainSchedule or TrajectoryFeedback
        Schedule designed by `tvlqr`, continuous or sampled.
    goal : mapping or float
        Bounds on the final errors, {"attitude" [deg], "position" [m], "joints" [rad|m],
        "omega_b" [rad/s], "v_b" [m/s], "joint rates" [rad/s|m/s]: largest final error}, with the
        kinds of error of `Campaign`. If `goal` is a number, it bounds the final value of
        ``e' P e``.
    within : mapping, optional
        Largest errors allowed at any time of a run, as a mapping with the same keys as `goal`.
    knots : int or sequence of float
        Number of knots to test, or a list of times [s]. For each time, the nearest knot is tested.
    samples : int
        Number of runs from each knot.
    seed : int
        Random seed. The same seed gives the same result for any executor or number of workers.
    confidence : float
        Confidence level of the intervals.
    executor, workers, threads, engine : optional
        As in `monte_carlo`.
    progress : callable, optional
        Function ``progress(done, total)``, called with the number of finished knots and the number
        of all knots.
    **options
        Options of `simulate`: dt, method, project, sample, delay, limits, disturbance.

    Returns
    -------
    Funnel
        Ellipsoids of errors at the knots, with success rates and their intervals.

    Raises
    ------
    InputError
        If a size or value is wrong, or the schedule and the trajectory have no knot in common.
    UnknownNameError
        If a kind of error or an option is unknown.
    FflinError
        If a worker process dies.

    References
    ----------
    P. Reist, P. V. Preiswerk and R. Tedrake, Feedback-motion-planning with simulation-based
    LQR-trees, The International Journal of Robotics Research 35(11), 2016.

    L. Shala, S. Vyas, M. K. Ben-Larbi, S. Kumar and E. Stoll, Region of attraction estimation for
    free-floating systems under time-varying LQR control, arXiv:2405.06726, 2024.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> v0 = fflin.velocity(robot, {"joint_1": 0.1})
    >>> motion = fflin.simulate(robot, v0=v0, duration=2.0, every=20)
    >>> along = fflin.linearize_trajectory(robot, motion.trajectory())
    >>> schedule = fflin.tvlqr(along, sample=0.1)
    >>> reach = fflin.funnel(robot, schedule, {"attitude": 5.0}, samples=4, knots=2)
    >>> len(reach.rho)
    2
    """
    validation.instance("robot", robot, Robot, "a fflin.Robot")
    refuse_constraints(robot, "funnels")
    expected = "a GainSchedule or a TrajectoryFeedback"
    validation.instance(
        "schedule", schedule, (GainSchedule, TrajectoryFeedback), expected
    )
    feedback = prepared(schedule, robot)
    assert isinstance(feedback, TrajectoryFeedback)
    refuse_periodic(feedback.trajectory, "a funnel")
    require_known("option of funnel", options, _OPTIONS)
    samples = validation.count("samples", samples)
    seed = validation.whole("seed", seed, 0)
    confidence = validation.share("confidence", confidence)
    if isinstance(goal, Mapping):
        final = _bounds("goal", goal, KINDS)
        shown_goal = _shown(final)
    else:
        final = _bounds("goal", {"level": goal}, ["level"])
        shown_goal = f"e' P e up to {final['level']:g}"
    within = {} if within is None else within
    limits = _bounds("within", within, KINDS)
    how = Execution(executor, workers, threads, None, progress)
    motion, gains = feedback.trajectory, feedback.schedule
    reached = partial(_outcomes, final, limits, gains.P[-1])
    indices = _indices(motion, gains, knots)
    jobs = [
        runs_from(robot, feedback, pair, engine, options, reached) for pair in indices
    ]
    tried, outcomes = np.empty(len(jobs)), np.empty((len(jobs), samples))
    with how:
        for knot, (job, (_, first)) in enumerate(zip(jobs, indices, strict=True)):
            rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(knot,)))
            tried[knot], outcomes[knot] = _tested(
                job, gains.P[first], samples, rng, how
            )
            if how.progress:
                how.progress(knot + 1, len(jobs))
    return Funnel._of(
        motion,
        robot=robot,
        t=np.array([motion.t[k] for k, _ in indices]),
        tried=tried,
        outcomes=outcomes,
        goal=shown_goal,
        within=_shown(limits),
        confidence=confidence,
        at=gains.t - gains.t[0] + motion.t[0],
        P=gains.P,
        knots=motion.t,
        notes=notes_on_engine(jobs[0], engine),
    )


def _outcomes(
    final: Mapping[str, float],
    within: Mapping[str, float],
    P: Array,
    runs: Mapping[str, Array],
) -> dict[str, Array]:
    """Return {"outcome": codes (N,)} of runs; `Funnel` lists the codes.

    `final` is {kind: bound on the final error}, and `within` is {kind: bound on the error at any
    time}. The kind "level" is e' P e, where e (nx,) is the final state error.
    """
    e = runs["state_errors"][:, -1]
    largest, last = (
        dict(zip(KINDS, runs[key].T, strict=True)) for key in ("largest", "errors")
    )
    last["level"] = ((e @ P) * e).sum(axis=1)
    stopped = (runs["stop"] != 0.0) | (largest["attitude"] > EDGE)
    failures = [stopped]
    for sizes, bounds in ((largest, within), (last, final)):
        failures.append(
            ~np.all([sizes[key] <= bound for key, bound in bounds.items()], axis=0)
        )
    return {"outcome": np.select(failures, [1.0, 2.0, 3.0])}


def _tested(
    job: CampaignJob, P: Array, samples: int, rng: np.random.Generator, how: Execution
) -> tuple[float, Array]:
    """Return the largest level tested at a knot, and the outcomes (samples,) of the runs.

    The level of an initial error e is e' P e. The runs start at levels between zero and the largest
    level. The largest level is the smallest trial level at which at least one of 16 trial runs
    fails. If no trial run fails, or if even the run without an initial error fails, the largest
    level is the level whose ellipsoid reaches a bound of the initial errors (_LARGEST_ATTITUDE,
    _LARGEST_ANGLE or _LARGEST_LENGTH).
    """
    W = ellipsoid_axes(P)
    joints = job.plant.robot.joints

    def simulate(roots: Array) -> Array:
        """Simulate runs from random errors e with sqrt(e' P e) = `roots`; return the outcomes."""
        e = rng.normal(size=(len(roots), len(P))) @ W.T
        # Scale the errors by their levels and not by the norms of the random vectors, because
        # components in the null space of P do not contribute to the level.
        e *= (roots / np.sqrt(((e @ P) * e).sum(axis=1)))[:, None]
        starts = moved_by("local", np.tile(job.x0, (len(e), 1)), e) - job.x0
        return completed(job, starts, how)["outcome"]

    largest = [
        _LARGEST_LENGTH if joint.prismatic else _LARGEST_ANGLE for joint in joints
    ]
    reach = [
        np.linalg.norm(W[:3], 2) / np.sin(np.radians(_LARGEST_ATTITUDE / 2.0)),
        np.linalg.norm(W[3:6], 2) / _LARGEST_LENGTH,
        *np.linalg.norm(W[6 : 6 + len(joints)], axis=1) / np.array(largest),
    ]
    # `root` is the square root of a level. `widest` is the square root of the level whose ellipsoid
    # reaches a bound of the initial errors.
    root = widest = float(1.0 / max(reach))
    # If even the run without an initial error fails, the search is skipped.
    if not simulate(np.zeros(1)).any():
        for _ in range(_HALVINGS):
            if not simulate(np.full(_PILOTS, root)).any():
                break
            root /= 2.0
        further = root < widest and not simulate(np.full(_PILOTS, 1.4 * root)).any()
        growth = 2.0 if further else 1.4
        root = min(root * growth, widest)
    return root**2, simulate(root * (np.arange(samples) + 0.5) / samples)


def runs_from(
    robot: Robot,
    feedback: TrajectoryFeedback,
    knot: tuple[int, int],
    engine: str | None,
    options: Mapping[str, object],
    judge: Judge = of_campaign,
) -> CampaignJob:
    """Return a job for runs that start at a knot.

    `knot` contains the indices of the knot in the trajectory and in the schedule.
    """
    motion, schedule, (k, first) = feedback.trajectory, feedback.schedule, knot
    rest = {name: getattr(motion, name)[k:] for name in ("t", "q", "v", "u")}
    later = {
        name: getattr(schedule, name)[first:] for name in ("t", "K", "P", "A", "B")
    }
    policy = replace(
        feedback,
        trajectory=replace(motion, **rest),
        schedule=replace(schedule, **later),
    )
    # The attitude at the knot can be any rotation, so the chart is centred at this attitude.
    # The histories have two entries: at the start and at the end of a run.
    options = {
        "reference": pin.XYZQUATToSE3(motion.q[k][:7]),
        "histories": 2,
        **options,
    }
    return CampaignJob(robot, policy, None, 0, engine, options, judge)


def _bounds(name: str, given: object, kinds: Collection[str]) -> dict[str, float]:
    """Return the checked bounds {kind: largest error}, or raise `InputError`."""
    given = {
        kind_named(str(key)): x
        for key, x in validation.by_name(name, given, "kind").items()
    }
    require_known(f"kind of error in {name}", given, kinds)
    if name == "goal" and not given:
        raise InputError(
            "goal is empty; give the largest final error of at least one kind, such as "
            "{'attitude': 1.0} in deg"
        )
    return {
        key: validation.positive(f"{name} '{key}'", value)
        for key, value in given.items()
    }


def _shown(bounds: Mapping[str, float]) -> str:
    return ", ".join(
        f"{key} up to {bound:g} {KINDS[key]}" for key, bound in bounds.items()
    )


def _indices(
    motion: Trajectory, schedule: GainSchedule, knots: int | Sequence[float]
) -> list[tuple[int, int]]:
    """Return (index in the trajectory, index in the schedule) of each chosen knot."""
    t, schedule_times = motion.t - motion.t[0], schedule.t - schedule.t[0]
    at = schedule_times.searchsorted(t - 1e-6 * (schedule.dt or t[-1])).clip(
        max=len(schedule_times) - 1
    )
    both = np.flatnonzero(
        np.abs(schedule_times[at] - t) <= 1e-6 * (schedule.dt or t[-1])
    )
    both = both[both < len(t) - 1]
    if not len(both):
        raise InputError(
            "no time of the schedule is a knot of the trajectory; design the schedule on this "
            "trajectory"
        )
    if validation.dimension("knots", knots) == 0:
        # More knots than the schedule has are all of its knots.
        wanted = min(validation.whole("knots", knots, 1), len(both))
        chosen = both[np.linspace(0, len(both) - 1, wanted).round().astype(int)]
    else:
        times = validation.as_double("knots", knots).ravel()
        times = validation.vector("knots", times, times.size, "times of knots")
        chosen = both[np.abs(motion.t[both] - times[:, None]).argmin(axis=1)]
    if not len(chosen):
        raise InputError(
            "knots is empty; give the number of knots, or a list of times [s]"
        )
    return [(k, int(at[k])) for k in sorted({*chosen.tolist()})]
