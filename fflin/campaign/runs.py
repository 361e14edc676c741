"""Computation of runs in chunks: eight at a time in compiled code, or one by one in Python."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from time import perf_counter
from timeit import repeat
from typing import Any

import numpy as np

from fflin.base.errors import FflinError
from fflin.base.record import content_digest
from fflin.base.validation import Array
from fflin.batch.files import MemoryStore
from fflin.batch.run import ChunkResult, Progress, run_chunks, worker_count
from fflin.campaign.dispersions import Dispersions, Draws
from fflin.campaign.spreads import placed
from fflin.campaign.statistics import (
    KINDS,
    LOOK,
    Judge,
    Over,
    RunStatistics,
    errors_of,
    outcome_of,
)
from fflin.control.channel import Saturation
from fflin.dynamics.coordinates import states_of
from fflin.kernel.compiled import available_cores
from fflin.kernel.tree import LANES, batch_tree
from fflin.robot.robot import Robot
from fflin.simulation.lanes import LaneLoop, Runs, engine_of, noises, recorded
from fflin.simulation.motion import Motion
from fflin.simulation.packing import SLOTS, noise_of, packed
from fflin.simulation.plan import Event, Plan, SimulationOptions, law_of
from fflin.simulation.run import Recording, go
from fflin.simulation.simulate import motion_of

_LARGEST_CHUNK = 256
_FEW_STEPS, _SOME_STEPS = 4, 64  # steps timed to estimate the duration of runs


class CampaignJob:
    """Runs of one plan, each with its own drawn values; see `batch.run.Job`.

    Without dispersions, the drawn values are the deviations of the initial state. A `judge` may end
    runs early, and its results replace the record of a campaign.
    """

    def __init__(
        self,
        robot: Robot,
        policy: Any,
        given: Any,
        seed: int,
        engine: str,
        options: Any,
        judge: Judge | None = None,
    ) -> None:
        self._arguments: tuple[object, ...] = (robot, policy, given, seed, engine, options, judge)
        self.judge, options = judge, dict(options)
        # A judge compares errors with the errors at the start, so the histories contain the start.
        histories = options.pop("histories", 0 if judge is None else 1)
        unlimited = options.pop("unlimited", False)
        options = SimulationOptions(
            robot=robot, policy=policy, linear=False, progress=False, **options
        )
        self.plan = Plan(options)
        self.plant = self.plan.plant
        if unlimited:
            most = np.full(len(self.plan.initial), np.inf)
            self.plan = self.plan.replace(limits=Saturation(-most, most))
        self.engine, state, times = engine, self.plant.state, self.plan.times
        self.x0 = state.read(self.plan.q, self.plan.v, near=self.plan.near)
        # Errors are deviations from a fixed state (nx,) or a moving state (steps + 1, nx).
        self.target, self._path = self.x0 if self.plan.target is None else self.plan.target, []
        if reference := self.plan.reference:
            t = times.dt * np.arange(times.steps + 1)
            q, v, _ = map(np.array, zip(*map(reference, t.tolist()), strict=True))
            nu = state.velocities(v)
            self.target, self._path = states_of(state, q, nu), [q.ravel(), nu.ravel()]
        given = dict.fromkeys(state.names, 0.0) if given is None else given
        with placed(given):
            self.dispersions = Dispersions(
                given, self.plant, self.plan.policy, self.x0, seed, times
            )
        # Steps at which the histories have entries.
        self.steps = np.unique(np.linspace(0.0, times.steps, histories).round().astype(int))

    def __reduce__(self) -> tuple[Any, ...]:
        # A worker constructs the job again, because functions that are bound to a robot cannot be
        # pickled.
        return _remade, (self._arguments, self.engine)

    @property
    def lanes(self) -> int:
        """Number of runs that are computed together."""
        return LANES if self.engine == "compiled" else 1

    def threads(self, asked: int | None) -> int:
        """Return the number of threads that compute runs in this process."""
        return (asked or available_cores()) if self.engine == "compiled" else 1

    def choose(self, engine: object) -> None:
        """Set the engine of the runs to the requested or the fastest one that supports the plan."""
        self.engine = engine_of(engine, self.plan, many=True)

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Shape per run of each array of the result."""
        if self.judge:
            return dict.fromkeys(self.judge.fields, ())
        return {key: x for key, x in self.outcome_shapes.items() if key != "state_errors"}

    @property
    def outcome_shapes(self) -> dict[str, tuple[int, ...]]:
        """Shape per run of each array of an outcome: those of `Campaign`, and the state errors.

        The state errors at the times of the histories are NaN after a run was stopped.
        """
        robot, nx, nu = self.plant.robot, self.plant.state.nx, len(self.plan.initial)
        sizes = {"q": robot.nq, "v": robot.nv, "x": nx, "u": nu, "largest_x": nx, "largest_u": nu}
        sizes |= dict.fromkeys(("errors", "largest", "settle"), len(KINDS))
        histories = {"error_history": len(KINDS), "input_history": nu, "state_errors": nx}
        return {
            **{key: (size,) for key, size in sizes.items()},
            **{key: (len(self.steps), size) for key, size in histories.items()},
            **{"stop": (), "end": ()},
        }

    def digest(self, first: Draws) -> str:
        """Return a digest of the robot, the policy, the options and the first run.

        For the compiled engine, the arrays that its loop reads contain all of these, so nothing is
        compiled. For the Python engine, a policy may be any function, whose content cannot be
        hashed. Then the digest contains the outcome of the first run instead.
        """
        if self.engine == "python":
            return content_digest(self.run(first, 0).arrays)
        runs = self._in_lanes(first.drawn)
        return content_digest({**_loop_arrays(self.plan), **runs, "target": self.target})

    def run(self, rows: Draws, start: int, out: Mapping[str, Array] | None = None) -> ChunkResult:
        """Simulate runs with the given drawn values."""
        drawn, shapes = np.asarray(rows.drawn), self.outcome_shapes if self.judge else self.shapes
        found: dict[str, Array] = {
            key: np.empty((len(drawn), *shape)) for key, shape in shapes.items()
        }
        if self.engine == "compiled":
            self._fly(drawn, found)
        else:
            for row, own in enumerate(drawn):
                outcome = self._one(own)
                for key, values in found.items():
                    values[row] = outcome[key]
        return ChunkResult(found if self.judge is None else self.judge.figures(found), [])

    def _fly(self, drawn: Array, out: Mapping[str, Array]) -> None:
        """Simulate runs (N, k) in compiled code, eight at a time."""
        runs = self._in_lanes(drawn)
        loop = LaneLoop(self.plan, runs)
        state, path = self.plant.state, self._path
        over = self.judge.over if self.judge else None
        statistics = RunStatistics(self.plan, state, self.target, self.steps, path, over)
        for first in range(0, len(drawn), LANES):
            eight, their_out = (
                {key: each[first : first + LANES] for key, each in arrays.items()}
                for arrays in (runs, out)
            )
            loop.fly(statistics, their_out, eight)

    def _in_lanes(self, drawn: Array) -> Runs:
        tree = batch_tree(self.plant.robot)
        assert tree is not None
        return self.dispersions.in_lanes(drawn, tree)

    def plan_of(self, drawn: Array) -> Plan:
        """Return the plan of a run (k,)."""
        plan, (plant, policy, q, v) = self.plan, self.dispersions.one(drawn)
        law = law_of(policy, plant, plan.limits, plan.times)
        times = plan.times._replace(delay=int(self.dispersions.delays(drawn[None])[0]))
        return plan.replace(plant=plant, q=q, v=v, policy=policy, law=law, times=times)

    @np.errstate(over="ignore", invalid="ignore")  # a run that diverges overflows
    def _one(self, drawn: Array) -> dict[str, Array]:
        plan = self.plan_of(drawn)
        if over := self.judge and self.judge.over:
            plan = plan.replace(events=(self._event(over, plan),))
        run = _recorded(plan, every=1)
        return outcome_of(plan, self.plant.state, self.target, self.steps, run)

    def _event(self, over: Over, plan: Plan) -> Event:
        """Return the stop condition as an event of a run in Python."""

        def errors(q: Array, v: Array) -> Array:
            return errors_of(self.plant.state, self.target, q[None], v[None])[1]

        first = errors(plan.q, plan.v)

        def stops(t: float, q: Array, v: Array) -> float:
            looks = round(t / plan.times.dt) % LOOK == 0
            return float(not (looks and over(first, errors(q, v))[0]))

        return stops

    def seconds(self, first: Draws, count: int) -> float:
        """Estimate the time [s] of runs on one core from a few steps of the first runs."""
        few, plan = _remade(self._arguments, self.engine), self.plan
        drawn, steps = first.part(0, self.lanes), plan.times.steps

        def measured(steps: int) -> float:
            few.plan = plan.replace(times=plan.times._replace(steps=steps))
            # Other programs may slow down one of the trials.
            return min(repeat(lambda: few.run(drawn, 0), timer=perf_counter, repeat=3, number=1))

        short, long = (min(each, steps) for each in (_FEW_STEPS, _SOME_STEPS))
        measured(1)  # compiles the loop if needed
        begin = measured(short)
        step = (measured(long) - begin) / (long - short) if long > short else 0.0
        return (begin + max(step, 0.0) * (steps - short)) * math.ceil(count / self.lanes)

    def replay(self, drawn: Array) -> Motion:
        """Repeat a run (k,) with the same arithmetic, and return its motion."""
        plan = self.plan_of(drawn)
        if self.engine == "python":
            run = _recorded(plan, plan.times.every)
        else:
            run = recorded(self.plan, self._in_lanes(drawn[None]))
        motion = motion_of(plan, run)
        return replace(motion, _nominal=self.plant.robot.urdf_sha256)


def _recorded(plan: Plan, every: int) -> Recording:
    """Simulate a run in Python, and record a row every `every` steps."""
    run = go(plan.replace(times=plan.times._replace(every=every)))
    if run.stopped.startswith("interrupted"):
        raise KeyboardInterrupt
    return run


def _loop_arrays(plan: Plan) -> dict[str, object]:
    """Return all arrays and numbers that the compiled loop reads for a plan, without compiling it.

    Two plans with equal arrays have equal runs.
    """
    parts = packed(plan)
    last = min(plan.times.steps, SLOTS * plan.times.sample)
    samples = noises(plan, len(parts.law.y), 0, last)[1] if noise_of(plan) else np.zeros(0)
    found: dict[str, object] = {"noise": samples}

    def collect(name: str, value: object) -> None:
        if isinstance(value, tuple):
            for index, each in enumerate(value):
                collect(f"{name}.{index}", each)
        else:
            found[name] = value

    collect("loop", parts)
    return found


def expect(
    progress: Progress | None,
    work: Sequence[tuple[CampaignJob, Draws, int]],
    executor: Executor | None,
    threads: int | None,
) -> None:
    """Report the estimated time of jobs to a progress bar.

    Each entry of `work` is a job, the draws of its first runs, and its number of runs. Only the
    progress bar of the command line has the method `expect`; other progress functions do not
    receive the estimate.
    """
    tell = getattr(progress, "expect", None)
    if tell is None:
        return
    here = max(job.threads(threads) for job, *_ in work)
    most = max(math.ceil(count / job.lanes) for job, _, count in work)
    cores = min(worker_count(executor) if executor else here, most)
    try:
        seconds = sum(job.seconds(first, count) for job, first, count in work)
    except FflinError:
        return  # the run itself reports this error
    tell(seconds / cores, cores)


def _remade(arguments: tuple[Any, ...], engine: str) -> CampaignJob:
    """Create a job in a worker, without repeating its warnings."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        job = CampaignJob(*arguments)
    job.engine = engine
    return job


def chunk_size(count: int, workers: int, least: int = LANES) -> int:
    """Return the number of runs per chunk that gives each worker several chunks."""
    size = _LARGEST_CHUNK
    while size > least and 4 * workers * size > count:
        size //= 2
    return size


def completed(
    job: CampaignJob,
    rows: Callable[[int, int], Draws],
    count: int,
    executor: Executor | None = None,
    workers: int | None = None,
    threads: int | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Run a job on all its rows, and return its arrays."""
    threads = job.threads(threads)
    store = MemoryStore(count, chunk_size(count, workers or threads, job.lanes), job.shapes)
    how: Any = {"executor": executor, "threads": threads, "progress": progress}
    if failed := run_chunks(job, rows, store, all_needed=True, **how):
        raise FflinError(failed[0].reason)
    return dict(store.arrays)
