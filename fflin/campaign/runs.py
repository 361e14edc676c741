"""Computation of runs in chunks: eight at a time in compiled code, or one by one in Python."""

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import replace
from functools import partial
from time import perf_counter
from timeit import repeat
from typing import Any

import numpy as np

from fflin.base.errors import FflinError
from fflin.base.record import content_digest
from fflin.base.validation import Array
from fflin.batch.files import MemoryStore
from fflin.batch.run import Execution, Progress, Rows, run_chunks
from fflin.campaign.dispersions import Dispersions
from fflin.campaign.spreads import placed
from fflin.campaign.statistics import LOOK, Judge, RunStatistics, errors_of, outcome_of
from fflin.control.channel import Saturation
from fflin.dynamics.coordinates import states_of
from fflin.kernel.tree import LANES
from fflin.robot.robot import Robot
from fflin.simulation.lanes import SLOTS, LaneLoop, engine_of, noises, packed, recorded
from fflin.simulation.motion import Motion
from fflin.simulation.plan import Plan, SimulationOptions, law_of
from fflin.simulation.run import Recording, go, stop_conditions
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
        policy: object,
        given: object,
        seed: int,
        engine: str | None,
        options: Mapping[str, object],
        judge: Judge | None = None,
    ) -> None:
        self._again = partial(CampaignJob, robot, policy, given, seed, options=options, judge=judge)
        settings: dict[str, Any] = dict(options)
        # A judge compares errors with the errors at the start, so the histories contain the start.
        histories = settings.pop("histories", 0 if judge is None else 1)
        unlimited = settings.pop("unlimited", False)
        settings |= {"robot": robot, "policy": policy, "linear": False, "progress": False}
        self.plan = Plan(SimulationOptions(**settings))
        if unlimited:
            most = np.full(len(self.plan.initial), np.inf)
            self.plan = self.plan.replace(limits=Saturation(-most, most))
        self.judge, self.plant, times = judge, self.plan.plant, self.plan.times
        self.engine, state = engine_of(engine, self.plan, many=True), self.plant.state
        self.threaded = self.engine == "compiled"
        self.lanes = LANES if self.threaded else 1  # number of runs that are computed together
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
        # Shapes per run: of each array of `Campaign`, with the state errors, which are NaN after a
        # run was stopped; and of each array of the result. They follow from a run without steps.
        start = self.plan.q[None], self.plan.v[None], self.plan.initial[None]
        none = Recording(np.zeros(1), *start, np.zeros((1, 6)), np.zeros((1, 3)), 0, "", "python")
        outcome = outcome_of(self.plan, self.target, self.steps, none)
        self.outcome_shapes = {key: values.shape for key, values in outcome.items()}
        self.shapes: dict[str, tuple[int, ...]] = dict.fromkeys(judge.fields if judge else (), ())
        if judge is None:
            self.shapes |= self.outcome_shapes
            del self.shapes["state_errors"]

    def __reduce__(self) -> tuple[object, ...]:
        # A worker constructs the job again, because functions that are bound to a robot cannot be
        # pickled.
        return _remade, (self._again, self.engine)

    def rows(self, start: int, stop: int) -> dict[str, Array]:
        """Return the drawn values of runs start to stop - 1; see `RowsOf`."""
        return {"drawn": self.dispersions.drawn(start, stop)}

    def digest(self, first: Array) -> str:
        """Return a digest of the robot, the policy, the options and the first run (1, k).

        For the compiled engine, the arrays that its loop reads contain all of these, so nothing is
        compiled. For the Python engine, a policy may be any function, whose content cannot be
        hashed. Then the digest contains the outcome of the first run instead.
        """
        if self.engine == "python":
            return content_digest(completed(self, first, Execution()))
        plan, loop = self.plan, packed(self.plan, stop_conditions(self.plan))
        found: dict[str, object] = {**self.dispersions.in_lanes(first), "target": self.target}
        if plan.noise:
            last = min(plan.times.steps, SLOTS * plan.times.sample)
            found["of sensors"] = noises(plan, len(loop.law.y), 0, last)[1]
        left: list[object] = [loop]
        while left:  # the arrays and numbers in nested tuples
            value = left.pop()
            if isinstance(value, tuple):
                left.extend(value)
            else:
                found[f"loop.{len(found)}"] = value
        return content_digest(found)

    def run(self, rows: Rows, start: int, out: Mapping[str, Array]) -> list[str]:
        """Simulate runs with the given drawn values; see `Job`."""
        drawn, found, judge = np.asarray(rows["drawn"]), out, self.judge
        if judge:
            found = {k: np.empty((len(drawn), *x)) for k, x in self.outcome_shapes.items()}
        if self.engine == "compiled":
            runs = self.dispersions.in_lanes(drawn)
            loop, over = LaneLoop(self.plan, runs), judge and judge.over
            statistics = RunStatistics(self.plan, self.target, self.steps, self._path, over)
            for first in range(0, len(drawn), LANES):
                eight, their_out = (
                    {key: each[first : first + LANES] for key, each in arrays.items()}
                    for arrays in (runs, found)
                )
                loop.fly(statistics, their_out, eight)
        else:
            for row, own in enumerate(drawn):
                outcome = self._one(own)
                for key, values in found.items():
                    values[row] = outcome[key]
        if judge:
            for key, values in judge.figures(found).items():
                out[key][:] = values
        return []

    def plan_of(self, drawn: Array) -> Plan:
        """Return the plan of a run (k,)."""
        plan, (plant, policy, q, v) = self.plan, self.dispersions.one(drawn)
        law = law_of(policy, plant, plan.limits, plan.times)
        times = plan.times._replace(delay=int(self.dispersions.delays(drawn[None])[0]))
        return plan.replace(plant=plant, q=q, v=v, policy=policy, law=law, times=times)

    @np.errstate(over="ignore", invalid="ignore")  # a run that diverges overflows
    def _one(self, drawn: Array) -> dict[str, Array]:
        """Return the outcome of a run (k,) in Python."""
        plan, state = self.plan_of(drawn), self.plant.state
        if over := self.judge and self.judge.over:

            def errors(q: Array, v: Array) -> Array:
                return errors_of(state, self.target, q[None], v[None])[1]

            first = errors(plan.q, plan.v)

            def stops(t: float, q: Array, v: Array) -> float:
                looks = round(t / plan.times.dt) % LOOK == 0
                return float(not (looks and over(first, errors(q, v))[0]))

            plan = plan.replace(events=(stops,))
        return outcome_of(plan, self.target, self.steps, _recorded(plan, every=1))

    def seconds(self, first: Array, count: int) -> float:
        """Estimate the time [s] of runs on one core from a few steps of the first runs."""
        few, plan, drawn = copy(self), self.plan, first[: self.lanes]
        steps = plan.times.steps
        out = {key: np.empty((len(drawn), *shape)) for key, shape in self.shapes.items()}

        def measured(steps: int) -> float:
            few.plan = plan.replace(times=plan.times._replace(steps=steps))
            # Other programs may slow down one of the trials.
            timed = partial(few.run, {"drawn": drawn}, 0, out)
            return min(repeat(timed, timer=perf_counter, repeat=3, number=1))

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
            run = recorded(self.plan, self.dispersions.in_lanes(drawn[None]))
        return replace(motion_of(plan, run), _nominal=self.plant.robot.urdf_sha256)


def _recorded(plan: Plan, every: int) -> Recording:
    """Simulate a run in Python, and record a row every `every` steps."""
    run = go(plan.replace(times=plan.times._replace(every=every)))
    if run.stopped.startswith("interrupted"):
        raise KeyboardInterrupt
    return run


def expect(
    progress: Progress | None, work: Sequence[tuple[CampaignJob, Array, int]], how: Execution
) -> None:
    """Report the estimated time of jobs to a progress bar.

    Each entry of `work` is a job, the draws of its first runs, and its number of runs. Only the
    progress bar of the command line has the method `expect`; other progress functions do not
    receive the estimate.
    """
    tell = getattr(progress, "expect", None)
    if tell is None:
        return
    most = max(math.ceil(count / job.lanes) for job, _, count in work)
    cores = min(max(how.count(job) for job, *_ in work), most)
    try:
        seconds = sum(job.seconds(first, count) for job, first, count in work)
    except FflinError:
        return  # the run itself reports this error
    tell(seconds / cores, cores)


def _remade(again: Callable[..., CampaignJob], engine: str) -> CampaignJob:
    """Create a job in a worker, without repeating its warnings."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return again(engine=engine)


def chunk_size(count: int, workers: int, least: int = LANES) -> int:
    """Return the number of runs per chunk that gives each worker several chunks."""
    size = _LARGEST_CHUNK
    while size > least and 4 * workers * size > count:
        size //= 2
    return size


def completed(
    job: CampaignJob, drawn: Array, how: Execution, progress: Progress | None = None
) -> dict[str, Array]:
    """Run a job with drawn values (N, k), and return its arrays."""
    count = len(drawn)
    store = MemoryStore(count, chunk_size(count, how.count(job), job.lanes), job.shapes)
    run_chunks(job, lambda start, stop: {"drawn": drawn[start:stop]}, store, how, progress)
    return store.arrays
