"""The region around a trajectory from which the loop that follows it ends inside a goal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
import pinocchio as pin

from fflin.base.errors import InputError, unknown
from fflin.base.intervals import clopper_pearson
from fflin.base.record import Design
from fflin.base.tables import folded, grid
from fflin.base.validation import (
    Array,
    as_double,
    by_name,
    dimension,
    number,
    numbers,
    share,
    vector,
    whole,
)
from fflin.base.writing import as_path
from fflin.batch.dispatch import ChunkResult
from fflin.batch.run import Progress, check_workers
from fflin.batch.workers import OwnWorkers
from fflin.campaign.dispersions import Draws
from fflin.campaign.runs import CampaignJob, done_by
from fflin.campaign.tally import KINDS
from fflin.control.gain_schedule import GainSchedule
from fflin.control.tracking import TrajectoryFeedback, followed
from fflin.dynamics.state import StateMap
from fflin.dynamics.state_rows import moved_by, moving_error, moving_errors
from fflin.linear.trajectory import Trajectory
from fflin.robot.robot import Robot

_OPTIONS = ("dt", "method", "project", "sample", "delay", "limits", "disturbance")
_MOST = 1_000_000

# Starts that are tried at a level to find those worth sampling, and how often it is halved.
_PILOTS, _HALVINGS = 16, 40
# A turn [deg] at which an error leaves its chart, and the widest starts [rad], [m].
_EDGE, _WIDEST_TURN, _WIDEST = 176.0, 170.0, (np.pi, 1e3)
_ROUNDING = 1e-12  # of P, below which a direction has no weight


@dataclass(frozen=True, eq=False, repr=False)
class Funnel(Design):
    """Ellipsoids ``e' P(t) e <= rho`` of errors from a trajectory; prints as a table.

    The errors are those of `linearize_trajectory`, P is the cost to go of the schedule. A direction
    that P gives no weight is not tried. All arrays are of the m knots but for the last seven.

    Attributes
    ----------
    t : ndarray (m,)
        Times [s].
    tried : ndarray (m,)
        The largest level rho at which runs began; they are evenly spread over its root.
    outcomes : ndarray (m, N)
        Of each run, by its level: 0 it ended inside the goal, 1 it was lost, 2 it went beyond
        `within`, 3 it missed the goal.
    rho, inside, inside_rate : ndarray (m,)
        The largest level up to which every run succeeded, how many these are, and the share of
        starts up to there that succeeds at least, with `confidence`.
    rate : ndarray (m, 2)
        Interval (Clopper and Pearson) of the share of all starts up to `tried` that succeeds.
    attitude, position, joints : ndarray (m, 3), (m, 3), (m, n)
        How far the ellipsoids reach: half axes of their projection on the base's attitude [deg]
        and position [m], and in each joint [rad|m].
    goal, within : str
        What a run had to keep to at its end, and on its way.
    confidence : float
    at, P : ndarray (M,), (M, nx, nx)
        Times of the schedule, and its P.
    knots, q, v, u, hold : ndarray, str
        The trajectory, as of `Trajectory`.
    """

    VECTORS: ClassVar = ("t", "tried", "at", "knots")

    robot: Robot
    t: Array
    tried: Array
    outcomes: Array
    goal: str
    within: str
    confidence: float
    at: Array
    P: Array
    knots: Array
    q: Array
    v: Array
    u: Array
    hold: str
    frame: str

    @cached_property
    def inside(self) -> Any:
        """How many runs there are up to `rho`."""
        failed = self.outcomes != 0.0
        return np.where(failed.any(axis=1), failed.argmax(axis=1), failed.shape[1])

    @cached_property
    def rho(self) -> Array:
        """The largest level up to which every run succeeded."""
        levels = (self.inside - 0.5).clip(min=0.0) / self.outcomes.shape[1]
        return self.tried * levels**2

    @property
    def inside_rate(self) -> Array:
        """At least this share of starts up to `rho` succeeds."""
        rate: Array = np.where(
            self.inside > 0, (1.0 - self.confidence) ** (1.0 / self.inside.clip(1)), 0.0
        )
        return rate

    @property
    def rate(self) -> Array:
        """Interval of the share of all starts that succeeds."""
        kept, count = (self.outcomes == 0.0).sum(axis=1).tolist(), self.outcomes.shape[1]
        return np.array([clopper_pearson(x, count, self.confidence)[1:] for x in kept])

    @cached_property
    def attitude(self) -> Array:
        """Half axes in the attitude [deg]."""
        return np.array([_degrees(self._half_axes(t, slice(0, 3))) for t in self.t])

    @cached_property
    def position(self) -> Array:
        """Half axes in the position [m]."""
        return np.array([self._half_axes(t, slice(3, 6)) for t in self.t])

    @cached_property
    def joints(self) -> Array:
        """How far each joint may be off [rad|m]."""
        roots = [self.root(t)[6 : 6 + self.robot.n] for t in self.t]
        return np.array([np.linalg.norm(each, axis=1) for each in roots])

    def _half_axes(self, t: float, part: slice) -> Array:
        return np.linalg.svd(np.hstack((self.root(t)[part], np.zeros((3, 3)))))[1]

    @cached_property
    def trajectory(self) -> Trajectory:
        """What is followed."""
        values: Any = (self.robot, self.knots, self.q, self.v, self.u)
        return Trajectory(*values, hold=self.hold, frame=self.frame)

    def level(self, t: float) -> float:
        """Return rho at a time; between two knots the lesser of theirs."""
        t = number("t", t)
        if not self.t[0] <= t <= self.t[-1]:
            raise InputError(f"t is {t:g} s, expected {self.t[0]:g} to {self.t[-1]:g} s")
        near = [self.t.searchsorted(t, side) - (side == "right") for side in ("right", "left")]
        return float(self.rho[near].min())

    def cost(self, t: float) -> Array:
        """Return P (nx, nx) at a time, linear between the schedule's."""
        k = int(np.clip(self.at.searchsorted(t, "right") - 1, 0, len(self.at) - 2))
        part = float(np.clip((t - self.at[k]) / (self.at[k + 1] - self.at[k]), 0.0, 1.0))
        P: Array = (1.0 - part) * self.P[k] + part * self.P[k + 1]
        return P

    def root(self, t: float, *, smooth: bool = False) -> Array:
        """Return W (nx, r): the ellipsoid at a time is of all W z with z of length 1 or less.

        Smooth ones go over from knot to knot, as they are drawn.
        """
        size = np.interp(t, self.t, np.sqrt(self.rho)) if smooth else np.sqrt(self.level(t))
        return size * _spread(self.cost(t))

    def contains(self, t: float, x: Any = None, *, q: Any = None, v: Any = None) -> bool:
        """Whether a state is inside at a time.

        Parameters
        ----------
        t : float
            [s], within the knots `t`.
        x : array_like (nx,), optional
            State of ``StateMap(robot, frame="local")``.
        q, v : array_like (nq,), (nv,), optional
            Instead of x, in Pinocchio's order; at rest where v is left out.
        """
        from fflin.dynamics.points import point_of

        rho, state = self.level(t), StateMap(self.robot, frame="local")
        if x is None and q is None:
            raise InputError("give x, or q and v")
        q, v = point_of(state, x, q, v, lambda: (q, v))
        e = moving_error(state, *self.trajectory.flow.at(float(t))[:2], q, v)
        return bool(e @ self.cost(t) @ e <= rho)

    def __repr__(self) -> str:
        m, count = self.outcomes.shape
        return f"Funnel('{self.robot.name}', {m} knots of {count} runs, goal '{self.goal}')"

    def __str__(self) -> str:
        count, sure = self.outcomes.shape[1], f"{100.0 * self.confidence:g} %"
        head = f"{self.robot.name}: errors from which every run ends with {self.goal}"
        head += f", {self.within} on its way" * bool(self.within) + f"; {count} runs a knot"
        tail = (
            "base, joint: largest half axes; runs: those inside, all of which succeeded (+: of all "
            "that were tried); sure: at least so many of the starts inside succeed, of all: of "
            f"those up to the largest level that was tried ({sure} confidence)"
        )
        rows = [["t [s]", "rho", "base [deg]", "base [m]", "joint", "runs", "sure", "of all"]]
        wide = (self.attitude, self.position, self.joints)
        for k, (low, high) in enumerate(100.0 * self.rate):
            reach = [f"{each[k].max(initial=0.0):.3g}" for each in wide]
            sure_of = f"{100.0 * self.inside_rate[k]:.1f} %"
            many = f"{self.inside[k]}{' +' if self.inside[k] == count else ''}"
            row = [f"{self.t[k]:.4g}", f"{self.rho[k]:.3g}", *reach, many, sure_of]
            rows.append([*row, f"{low:.0f}-{high:.0f} %"])
        return "\n".join([folded([head]), "", grid(rows, "r"), "", folded([tail])])

    @classmethod
    def load(cls, path: str | Path, robot: Robot) -> Funnel:  # type: ignore[override]
        """Read what `save` wrote, of a robot.

        Raises
        ------
        FileError
            If the file cannot be read, is damaged or is another thing.
        """
        return cls._read(as_path(path), robot=robot)


class Knots(NamedTuple):
    """Which knots are to be done."""

    knot: Array


class FunnelJob:
    """The knots of a funnel, all runs of one together; see `Job`."""

    def __init__(
        self,
        robot: Robot,
        feedback: TrajectoryFeedback,
        ends: tuple[Any, dict[str, float]],
        places: list[tuple[int, int]],
        samples: int,
        seed: int,
        options: Any,
        engine: str = "",
    ) -> None:
        self._robot, self._feedback, (self._goal, self._within) = robot, feedback, ends
        self._places, self._seed, self._options = places, seed, options
        self.engine, self.shapes = engine, {"tried": (), "outcomes": (samples,)}

    def campaign(self, knot: int) -> CampaignJob:
        """Return what flies from a knot to the end."""
        k, first = self._places[knot]
        motion, schedule = self._feedback.trajectory, self._feedback.schedule
        kept: Any = {name: getattr(motion, name) for name in ("hold", "frame", "verified")}
        rest: Any = [getattr(motion, name)[k:] for name in ("t", "q", "v", "u")]
        cut = {name: getattr(schedule, name)[first:] for name in ("t", "K", "P", "A", "B")}
        policy = replace(
            self._feedback,
            trajectory=Trajectory(motion.robot, *rest, **kept),
            schedule=replace(schedule, **cut),
        )
        none = dict.fromkeys(StateMap(self._robot).names, 0.0)
        # A chart about where it begins, which may be turned by any angle itself.
        options = {"reference": pin.XYZQUATToSE3(motion.q[k][:7]), **self._options}
        return CampaignJob(self._robot, policy, none, 0, self.engine, options)

    def run(self, rows: Knots, start: int = 0, out: Any = None) -> ChunkResult:
        """Do some knots."""
        if out is None:
            out = {key: np.empty((len(rows.knot), *of)) for key, of in self.shapes.items()}
        for row, knot in enumerate(rows.knot.astype(int).tolist()):
            out["tried"][row], out["outcomes"][row] = self._sampled(knot)
        return ChunkResult(dict(out), [])

    def _sampled(self, knot: int) -> tuple[float, Array]:
        """Return the largest level tried at a knot, and how the runs from up to there ended."""
        job, spread = self.campaign(knot), _spread(self._feedback.schedule.P[self._places[knot][1]])
        rng = np.random.default_rng(np.random.SeedSequence(self._seed, spawn_key=(knot,)))

        def flown(sizes: Array) -> Array:
            z = rng.normal(size=(len(sizes), spread.shape[1]))
            e = (sizes / np.linalg.norm(z, axis=1))[:, None] * z @ spread.T
            x = moved_by("local", np.tile(job.x0, (len(e), 1)), e)
            return self._judged(job, job.run(Draws(x - job.x0, np.zeros(len(e))), 0).arrays)

        widest = _widest(spread, self._robot)
        size, count = widest, self.shapes["outcomes"][0]
        if not flown(np.zeros(1)).any():
            for _ in range(_HALVINGS):
                if not flown(np.full(_PILOTS, size)).any():
                    break
                size /= 2.0
            size *= 2.0 if size < widest and not flown(np.full(_PILOTS, 1.4 * size)).any() else 1.4
        size = min(size, widest)
        return size**2, flown(size * (np.arange(count) + 0.5) / count)

    def _judged(self, job: CampaignJob, ended: Mapping[str, Array]) -> Array:
        """Return how runs ended, as `Funnel.outcomes` says it."""
        kinds, goal = list(KINDS), self._goal

        def beyond(sizes: Array, bounds: Mapping[str, float]) -> Any:
            of = [~(sizes[:, kinds.index(key)] <= bound) for key, bound in bounds.items()]
            return np.any([np.zeros(len(sizes), dtype=bool), *of], axis=0)

        if isinstance(goal, float):
            e = moving_errors("local", ended["x"], job.home[-1:])
            turns = 6 + job.plant.state.unbounded
            e[:, turns] -= 2.0 * np.pi * np.round(e[:, turns] / (2.0 * np.pi))
            missed = ~((e @ self._feedback.schedule.P[-1] * e).sum(axis=1) <= goal)
        else:
            missed = beyond(ended["errors"], goal)
        lost = (ended["stop"] != 0.0) | beyond(ended["largest"], {"attitude": _EDGE})
        return np.select([lost, beyond(ended["largest"], self._within), missed], [1.0, 2.0, 3.0])


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
    **options: Any,
) -> Funnel:
    r"""Measure from which errors the loop along a trajectory ends inside a goal.

    At each knot errors are drawn from an ellipsoid :math:`e^T P(t)\,e \le \rho` of the schedule's
    cost to go, uniform in direction and evenly spread over the root of the level, and the nonlinear
    robot is flown from there to the trajectory's end. The largest level that is tried is where one
    in about sixteen starts fails, or where the attitude is 170 deg off. What is found is counted,
    not proved.

    Parameters
    ----------
    robot : Robot
    schedule : GainSchedule or TrajectoryFeedback
        Of `tvlqr`, continuous or sampled.
    goal : mapping or float
        {"attitude" [deg], "position" [m], "joints" [rad|m], "turning" [rad/s], "moving" [m/s],
        "rates" [rad/s|m/s]: largest error at the end}, each as of `Campaign`; or the level of
        ``e' P e`` there.
    within : mapping, optional
        Largest errors on the way, as of `goal`.
    knots : int or sequence of float
        How many of the trajectory's knots, or times [s], to which the nearest are taken.
    samples : int
        Runs from each knot.
    seed : int
        The same seed gives the same result whoever does the runs.
    confidence : float
        Of the intervals.
    executor, workers, threads, engine : optional
        As of `monte_carlo`; each does a knot at a time.
    progress : callable, optional
        ``progress(done, total)`` is called with the number of knots.
    **options
        Of `simulate`: dt, method, project, sample, delay, limits, disturbance.

    Returns
    -------
    Funnel

    Raises
    ------
    InputError
        If a size or value is wrong, or the schedule has no knot of the trajectory.
    UnknownNameError
        If there is no such kind of error or option.
    FflinError
        If a process of the executor died.

    References
    ----------
    P. Reist, P. V. Preiswerk and R. Tedrake, Feedback-motion-planning with simulation-based
    LQR-trees, The International Journal of Robotics Research 35(11), 2016.

    L. Shala, S. Vyas, M. K. Ben-Larbi, S. Kumar and E. Stoll, Region of attraction estimation for
    free-floating systems under time-varying LQR control, arXiv:2405.06726, 2024.
    """
    if not isinstance(robot, Robot):
        raise InputError(f"robot is a {type(robot).__name__}, expected a fflin.Robot")
    feedback = followed(schedule, robot)
    if not isinstance(feedback, TrajectoryFeedback):
        raise InputError(
            f"schedule is a {type(schedule).__name__}, expected a GainSchedule or a "
            "TrajectoryFeedback"
        )
    for name in options:
        if name not in _OPTIONS:
            raise unknown("option of funnel", name, list(_OPTIONS))
    samples, seed = whole("samples", samples, 1, _MOST), whole("seed", seed, 0)
    confidence, level = share("confidence", confidence), not isinstance(goal, Mapping)
    aim: Any = _positive("goal", {"level": goal})["level"] if level else _bounds("goal", goal)
    bounds = _bounds("within", {} if within is None else within)
    check_workers(executor, workers, threads, None, progress)
    motion, by = feedback.trajectory, feedback.schedule
    places = _places(motion, by, knots)
    job = FunnelJob(robot, feedback, (aim, bounds), places, samples, seed, options)
    first = job.campaign(0)
    first.choose(engine, max(1, len(places) * samples // 2))
    job.engine = first.engine
    with OwnWorkers(workers) if workers else nullcontext(executor) as others:
        how: dict[str, Any] = {"executor": others, "workers": workers, "threads": threads}
        arrays = done_by(job, _rows, len(places), progress=progress, least=1, **how)
    return Funnel(
        robot=robot,
        t=np.array([motion.t[k] for k, _ in places]),
        **arrays,
        goal=f"e' P e up to {aim:g}" if level else _said(aim),
        within=_said(bounds),
        confidence=confidence,
        at=by.t - by.t[0] + motion.t[0],
        P=by.P,
        knots=motion.t,
        **{name: getattr(motion, name) for name in ("q", "v", "u", "hold", "frame", "verified")},
    )


def _rows(start: int, stop: int) -> Knots:
    return Knots(np.arange(start, stop, dtype=float))


def _bounds(name: str, given: Any) -> dict[str, float]:
    """Return {kind: largest error}, checked."""
    for key in by_name(name, given, "kind"):
        if key not in KINDS:
            raise unknown(f"kind of error in {name}", str(key), list(KINDS))
    if name == "goal" and not given:
        raise InputError("goal is empty; give at least one, such as {'attitude': 1.0}")
    return _positive(name, given)


def _positive(name: str, given: Any) -> dict[str, float]:
    found = numbers(name, given, "kind", name)
    for key, value in found.items():
        if not value > 0.0:
            raise InputError(f"{name} '{key}' is {value:g}, expected more than 0")
    return found


def _said(bounds: Mapping[str, float]) -> str:
    return ", ".join(f"{key} up to {bound:g} {KINDS[key]}" for key, bound in bounds.items())


def _places(motion: Trajectory, by: GainSchedule, knots: Any) -> list[tuple[int, int]]:
    """Return where some knots stand in the trajectory and in the schedule."""
    t, own = motion.t - motion.t[0], by.t - by.t[0]
    at = own.searchsorted(t - 1e-6 * (by.dt or t[-1])).clip(max=len(own) - 1)
    both = np.flatnonzero(np.abs(own[at] - t) <= 1e-6 * (by.dt or t[-1]))
    both = both[both < len(t) - 1]
    if not len(both):
        raise InputError("the schedule is of other times than the trajectory")
    if dimension("knots", knots) == 0:
        chosen = both[np.linspace(0, len(both) - 1, whole("knots", knots, 1)).round().astype(int)]
    else:
        times = as_double("knots", knots).ravel()
        times = vector("knots", times, times.size, "times of knots")
        chosen = both[np.abs(motion.t[both] - times[:, None]).argmin(axis=1)]
    if not len(chosen):
        raise InputError("knots is empty; give how many, or times [s]")
    return [(k, int(at[k])) for k in sorted({*chosen.tolist()})]


def _spread(P: Array) -> Array:
    """Return W (nx, r) whose W W' is the pseudoinverse of P, at its own scales."""
    scale = np.sqrt(P.diagonal().clip(min=0.0))
    unit = np.divide(1.0, scale, out=np.zeros_like(scale), where=scale > 0.0)
    values, axes = np.linalg.eigh(unit[:, None] * P * unit)
    kept = values > _ROUNDING * values.max()
    found: Array = unit[:, None] * axes[:, kept] / np.sqrt(values[kept])
    return found


def _widest(spread: Array, robot: Robot) -> float:
    """Return the root of the level at which errors are as large as errors may be."""
    most = np.array([_WIDEST[joint.prismatic] for joint in robot.joints])
    reach = [
        np.linalg.norm(spread[:3], 2) / np.sin(np.radians(_WIDEST_TURN / 2.0)),
        np.linalg.norm(spread[3:6], 2) / _WIDEST[1],
        *np.linalg.norm(spread[6 : 6 + robot.n], axis=1) / most,
    ]
    return float(1.0 / max(reach))


def _degrees(sines: Array) -> Array:
    return np.degrees(2.0 * np.arcsin(np.minimum(sines, 1.0)))
