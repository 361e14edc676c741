"""Funnel: the region around a trajectory from which the tracking loop reaches its goal."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import nullcontext
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pinocchio as pin

from fflin.base.errors import InputError, unknown
from fflin.base.validation import (
    Array,
    as_double,
    by_name,
    dimension,
    numbers,
    share,
    vector,
    whole,
)
from fflin.batch.dispatch import ChunkResult
from fflin.batch.run import Progress, check_workers
from fflin.batch.workers import OwnWorkers
from fflin.campaign.dispersions import Draws
from fflin.campaign.reach import Funnel, spread
from fflin.campaign.runs import CampaignJob, done_by
from fflin.campaign.tally import KINDS
from fflin.control.gain_schedule import GainSchedule
from fflin.control.tracking import TrajectoryFeedback, followed
from fflin.dynamics.state import StateMap
from fflin.dynamics.state_rows import moved_by, moving_errors
from fflin.linear.trajectory import Trajectory
from fflin.robot.robot import Robot

_OPTIONS = ("dt", "method", "project", "sample", "delay", "limits", "disturbance")
_MOST = 1_000_000

# Starts that are tried at a level to find those worth sampling, and how often it is halved.
_PILOTS, _HALVINGS = 16, 40
# A turn [deg] at which an error leaves its chart, and the widest starts [rad], [m].
_EDGE, _WIDEST_TURN, _WIDEST = 176.0, 170.0, (np.pi, 1e3)


@dataclass
class FunnelJob:
    """The knots of a funnel, by their numbers in `Draws.run`, each with all its runs; see `Job`."""

    robot: Robot
    feedback: TrajectoryFeedback
    goal: Any  # level, or bounds of kinds
    within: dict[str, float]
    places: list[tuple[int, int]]  # of knots in the trajectory and in the schedule
    samples: int
    seed: int
    options: dict[str, Any]
    engine: str = ""

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Shape of each array of a knot."""
        return {"tried": (), "outcomes": (self.samples,)}

    def campaign(self, knot: int) -> CampaignJob:
        """Return what flies from a knot to the end."""
        k, first = self.places[knot]
        motion, schedule = self.feedback.trajectory, self.feedback.schedule
        kept: Any = {name: getattr(motion, name) for name in ("hold", "frame", "verified")}
        rest: Any = [getattr(motion, name)[k:] for name in ("t", "q", "v", "u")]
        cut = {name: getattr(schedule, name)[first:] for name in ("t", "K", "P", "A", "B")}
        policy = replace(
            self.feedback,
            trajectory=Trajectory(motion.robot, *rest, **kept),
            schedule=replace(schedule, **cut),
        )
        none = dict.fromkeys(StateMap(self.robot).names, 0.0)
        # A chart about where it begins, which may be turned by any angle itself.
        options = {"reference": pin.XYZQUATToSE3(motion.q[k][:7]), **self.options}
        return CampaignJob(self.robot, policy, none, 0, self.engine, options)

    def run(self, rows: Draws, start: int = 0, _: Any = None) -> ChunkResult:
        """Do some knots."""
        tried, outcomes = zip(*map(self._sampled, rows.run.astype(int).tolist()), strict=True)
        return ChunkResult({"tried": np.array(tried), "outcomes": np.array(outcomes)}, [])

    def _sampled(self, knot: int) -> tuple[float, Array]:
        """Return the largest level tried at a knot, and how the runs from up to there ended."""
        job, W = self.campaign(knot), spread(self.feedback.schedule.P[self.places[knot][1]])
        rng = np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(knot,)))

        def flown(sizes: Array) -> Array:
            z = rng.normal(size=(len(sizes), W.shape[1]))
            e = (sizes / np.linalg.norm(z, axis=1))[:, None] * z @ W.T
            x = moved_by("local", np.tile(job.x0, (len(e), 1)), e)
            return self._judged(job, job.run(Draws(x - job.x0, np.zeros(len(e))), 0).arrays)

        widest = _widest(W, self.robot)
        size, count = widest, self.samples
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
        kinds, goal = list(KINDS), self.goal

        def beyond(sizes: Array, bounds: Mapping[str, float]) -> Any:
            of = [~(sizes[:, kinds.index(key)] <= bound) for key, bound in bounds.items()]
            return np.any([np.zeros(len(sizes), dtype=bool), *of], axis=0)

        if isinstance(goal, float):
            e = moving_errors("local", ended["x"], job.home[-1:])
            turns = 6 + job.plant.state.unbounded
            e[:, turns] -= 2.0 * np.pi * np.round(e[:, turns] / (2.0 * np.pi))
            missed = ~((e @ self.feedback.schedule.P[-1] * e).sum(axis=1) <= goal)
        else:
            missed = beyond(ended["errors"], goal)
        lost = (ended["stop"] != 0.0) | beyond(ended["largest"], {"attitude": _EDGE})
        return np.select([lost, beyond(ended["largest"], self.within), missed], [1.0, 2.0, 3.0])


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
    r"""Estimate the initial errors from which a trajectory tracking loop reaches a goal.

    At each knot, errors are drawn from an ellipsoid :math:`e^T P(t)\,e \le \rho` of the schedule's
    cost to go. Their directions are uniformly distributed, and the square roots of their levels are
    evenly spread. The nonlinear robot is simulated from each error to the end of the trajectory.
    The largest level tried is the level at which about one run in sixteen fails, or at which the
    attitude error reaches 170 deg. The result is a statistical estimate, not a proof.

    Parameters
    ----------
    robot : Robot
    schedule : GainSchedule or TrajectoryFeedback
        Schedule designed by `tvlqr`, continuous or sampled.
    goal : mapping or float
        {"attitude" [deg], "position" [m], "joints" [rad|m], "turning" [rad/s], "moving" [m/s],
        "rates" [rad/s|m/s]: largest final error}, with the kinds of `Campaign`; or the largest
        final value of ``e' P e``.
    within : mapping, optional
        Largest errors allowed at any time of a run, with the kinds of `goal`.
    knots : int or sequence of float
        Number of knots to test, or times [s]. The knot nearest to each time is tested.
    samples : int
        Number of runs from each knot.
    seed : int
        Random seed. The same seed gives the same result for any executor or number of workers.
    confidence : float
        Confidence level of the intervals.
    executor, workers, threads, engine : optional
        As in `monte_carlo`; each task is one knot.
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
        If a size or value is wrong, or no time of the schedule is a knot of the trajectory.
    UnknownNameError
        If a kind of error or an option is unknown.
    FflinError
        If a worker process died.

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
    aim: Any = _bounds("goal", *(({"level": goal}, ["level"]) if level else (goal,)))
    aim = aim["level"] if level else aim
    bounds = _bounds("within", {} if within is None else within)
    check_workers(executor, workers, threads, None, progress)
    motion, by = feedback.trajectory, feedback.schedule
    places = _places(motion, by, knots)
    job = FunnelJob(robot, feedback, aim, bounds, places, samples, seed, options)
    first = job.campaign(0)
    first.choose(engine)
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


def _rows(start: int, stop: int) -> Draws:
    return Draws(np.zeros((stop - start, 0)), np.arange(start, stop, dtype=float))


def _bounds(name: str, given: Any, kinds: Iterable[str] = KINDS) -> dict[str, float]:
    """Return {kind: largest error}, checked."""
    for key in by_name(name, given, "kind"):
        if key not in kinds:
            raise unknown(f"kind of error in {name}", str(key), list(kinds))
    if name == "goal" and not given:
        raise InputError("goal is empty; give at least one, such as {'attitude': 1.0}")
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
        raise InputError(
            "no time of the schedule is a knot of the trajectory; design it on this trajectory"
        )
    if dimension("knots", knots) == 0:
        chosen = both[np.linspace(0, len(both) - 1, whole("knots", knots, 1)).round().astype(int)]
    else:
        times = as_double("knots", knots).ravel()
        times = vector("knots", times, times.size, "times of knots")
        chosen = both[np.abs(motion.t[both] - times[:, None]).argmin(axis=1)]
    if not len(chosen):
        raise InputError("knots is empty; give a number of knots, or times [s]")
    return [(k, int(at[k])) for k in sorted({*chosen.tolist()})]


def _widest(W: Array, robot: Robot) -> float:
    """Return the root of the level at which errors are as large as errors may be."""
    most = np.array([_WIDEST[joint.prismatic] for joint in robot.joints])
    reach = [
        np.linalg.norm(W[:3], 2) / np.sin(np.radians(_WIDEST_TURN / 2.0)),
        np.linalg.norm(W[3:6], 2) / _WIDEST[1],
        *np.linalg.norm(W[6 : 6 + robot.n], axis=1) / most,
    ]
    return float(1.0 / max(reach))
