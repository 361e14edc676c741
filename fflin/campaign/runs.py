"""Computation of the runs of a campaign in chunks, and statistics of each run.

Runs are computed eight at a time in compiled code, or one by one in Python. The statistics of a run
are its final errors, its largest errors, its settling times, and histories at a few times. The size
of the statistics does not depend on the duration of the run.
"""

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from copy import copy
from dataclasses import replace
from functools import cache, partial
from time import perf_counter
from timeit import repeat
from typing import Any, TypeAlias

import numpy as np

from fflin.base.errors import FflinError
from fflin.base.record import content_digest
from fflin.base.rotation import conjugate, quaternion_product
from fflin.base.validation import Array, Indices, Mask, number
from fflin.batch.files import MemoryStore
from fflin.batch.run import Execution, Progress, Rows, run_chunks
from fflin.campaign.dispersions import Dispersions
from fflin.campaign.spreads import placed
from fflin.control.channel import Saturation
from fflin.control.sensor_errors import declared_errors
from fflin.dynamics.coordinates import unwound
from fflin.dynamics.state import StateMap
from fflin.dynamics.state_rows import attitude_errors, moving_errors, states_of
from fflin.kernel import loop
from fflin.kernel.compiled import INSTALL, kernel
from fflin.kernel.tree import LANES, laid_out
from fflin.robot.robot import Robot
from fflin.simulation import lanes
from fflin.simulation.extension import extension_of, is_extended
from fflin.simulation.motion import Motion
from fflin.simulation.plan import Plan, SimulationOptions, law_of
from fflin.simulation.report import SETTLED, THERE, is_late, settled_at
from fflin.simulation.run import Recording, go, stop_conditions, stop_of
from fflin.simulation.simulate import motion_of

# {kind of error: unit}. The attitude error is the rotation angle. Any other error is the largest
# magnitude of the state errors of its kind; wheels and modes do not count as joints.
KINDS = {
    "attitude": "deg",
    "position": "m",
    "joints": "rad|m",
    "omega_b": "rad/s",
    "v_b": "m/s",
    "joint rates": "rad/s|m/s",
}
# Like the wheel speeds, an error that only some robots have. Neither has a settling time.
MODES = "modes"
# Attitude error [deg] above which a run of `validity` or `funnel` counts as having left the chart.
# The chart ends at 180 deg.
EDGE = 176.0
# LOOK is the number of steps between checks of the condition `CampaignJob.over`. If this condition
# is None, one call of the compiled loop computes up to _LONG steps.
LOOK = 64
_LONG = 2**20

_LARGEST_CHUNK = 256
_FEW_STEPS, _SOME_STEPS = 4, 64  # steps timed to estimate the duration of runs

# Function that returns the mask (N,) of runs to end. Its arguments are the initial state errors
# (N, nx) and the present state errors (N, nx).
Over: TypeAlias = Callable[[Array, Array], Mask]

# {former name: kind of error}. Conditions and goals still accept the former names.
_FORMER = {"turning": "omega_b", "moving": "v_b", "rates": "joint rates"}


def kind_named(name: str) -> str:
    """Replace a former name of a kind of error, as in ``worst turning``, by its present name."""
    statistic, _, kind = name.rpartition(" ")
    if statistic in ("", "worst", "settle"):
        kind = _FORMER.get(kind, kind)
    return f"{statistic} {kind}".strip()


# Function that returns {name: result (N, ..)} from the outcomes of N runs; see
# `CampaignJob.outcome`.
Judge: TypeAlias = Callable[[Mapping[str, Array]], dict[str, Array]]


def of_campaign(outcomes: Mapping[str, Array]) -> dict[str, Array]:
    """Return the arrays of `outcomes` that a `Campaign` contains: all except `state_errors`."""
    arrays = dict(outcomes)
    del arrays["state_errors"]
    return arrays


def kinds_of(state: StateMap, wheels: Collection[str]) -> Indices:
    """Return the kind of error of each state (nx,); `wheels` are the joints flown as wheels.

    - 1 to 5: the error of the state counts as an error of this kind, an index into KINDS.
    - 0: the error of the state counts in `largest_x` only. This is so for the attitude, whose error
      is the rotation angle, and for the modes and the wheel speeds, which have no kind.
    - -1: the error of the state does not count. This is so for the angles of wheels.
    """
    kind = np.zeros(state.nx, dtype=np.intp)
    groups, modes = state.groups, state.robot.modes
    kind[groups.r_b] = 1
    kind[groups.q_m] = 2
    kind[groups.omega_b] = 3
    kind[groups.v_b] = 4
    kind[groups.qdot_m] = 5
    for index, joint in enumerate(state.robot.joints):
        angle, rate = groups.q_m.start + index, groups.qdot_m.start + index
        if joint in modes:
            kind[angle] = 0
            kind[rate] = 0
        elif joint.name in wheels:
            kind[angle] = -1
            kind[rate] = 0
    return kind


class CampaignJob:
    """Job that simulates runs of one plan, each with its own drawn values; see `batch.run.Job`.

    `given` are the dispersions of `monte_carlo`. If `given` is None, the drawn values are the
    deviations (nx,) of the initial state. The function `judge` computes the arrays of the result
    from the outcomes. A run ends early if it satisfies the condition `over`. If `over` is given,
    the target must be fixed. `options` must then contain histories, because the initial errors are
    read from the first entry of the histories.
    """

    def __init__(
        self,
        robot: Robot,
        policy: object,
        given: object,
        seed: int,
        engine: str | None,
        options: Mapping[str, object],
        judge: Judge = of_campaign,
        over: Over | None = None,
    ) -> None:
        again = partial(CampaignJob, robot, policy, given, seed, options=options)
        self._again = partial(again, judge=judge, over=over)
        self.options = options
        settings: dict[str, Any] = dict(options)
        histories = settings.pop("histories", 0)
        unlimited = settings.pop("unlimited", False)
        within_chart = settings.pop("within_chart", False)
        noise = number("noise", settings.pop("noise", 1.0))
        settings |= {
            "robot": robot,
            "policy": policy,
            "linear": False,
            "progress": False,
            "noise": 0.0,
        }
        self.plan = Plan(SimulationOptions(**settings))
        if unlimited:
            most = np.full(len(self.plan.initial), np.inf)
            self.plan = self.plan.replace(limits=Saturation(-most, most))
        self.plan = self.plan.replace(within_chart=within_chart)
        self.judge, self.over = judge, over
        self.plant, times = self.plan.plant, self.plan.times
        self.kinds = kinds_of(self.plant.state, self.plan.flown)
        self.engine = lanes.engine_of(engine, self.plan, many=True)
        state = self.plant.state
        self.threaded = self.engine == "compiled"
        # number of runs that are computed together
        self.lanes = LANES if self.threaded else 1
        self.x0 = state.read(self.plan.q, self.plan.v, near=self.plan.near)
        # Errors are deviations from `target`: a fixed state (nx,) or the states (steps + 1, nx) of
        # a reference motion. `path` contains q and nu of the reference motion, or is empty.
        self.target = self.x0 if self.plan.target is None else self.plan.target
        self.path = []
        if reference := self.plan.reference:
            t = times.dt * np.arange(times.steps + 1)
            q, v, _ = map(np.array, zip(*map(reference, t.tolist()), strict=True))
            nu = state.velocities(v)
            self.target = states_of(state, q, nu)
            self.path = [q.ravel(), nu.ravel()]
        # Errors that the outputs declare are drawn for each run of a campaign.
        declared = None
        if given is not None and noise and self.plan.policy:
            sample = times.sample * times.dt
            declared = declared_errors(self.plan.policy, state, sample)
        if declared is not None:
            declared = declared.scaled(noise)
        given = dict.fromkeys(state.names, 0.0) if given is None else given
        self.given = given
        with placed(given):
            self.dispersions = Dispersions(
                given, self.plant, self.plan.policy, self.x0, seed, times, declared
            )
        # Steps at which the histories have entries.
        self.steps = np.unique(
            np.linspace(0.0, times.steps, histories).round().astype(int)
        )
        # `outcome_shapes` contains the shape of each array of an outcome. `shapes` contains the
        # shape per run of each array that `judge` returns. Both are read from the outcome of a run
        # of zero steps.
        start = self.plan.q[None], self.plan.v[None], self.plan.initial[None]
        none = Recording(
            np.zeros(1), *start, np.zeros((1, 6)), np.zeros((1, 3)), 0, "", "python"
        )
        outcome = self.outcome(none)
        self.outcome_shapes = {key: x.shape for key, x in outcome.items()}
        # `judge` may divide by an initial error of 0
        with np.errstate(invalid="ignore"):
            results = judge({key: x[None] for key, x in outcome.items()})
        self.shapes = {key: x.shape[1:] for key, x in results.items()}

    def __reduce__(self) -> tuple[object, ...]:
        # A worker constructs the job again, because functions that are bound to a robot cannot be
        # pickled.
        return partial(self._again, engine=self.engine), ()

    def rows(self, start: int, stop: int) -> dict[str, Array]:
        """Return the drawn values of runs start to stop - 1; see `RowsOf`."""
        return {"drawn": self.dispersions.drawn(start, stop)}

    def digest(self, first: Array) -> str:
        """Return a digest of the robot, policy, options and the first run's drawn values (1, k).

        With the compiled engine, the digest is computed from the arrays that the loop reads; this
        needs no compilation. With the Python engine, the policy can be any function, whose content
        cannot be hashed. Therefore the digest is computed from the outcome of the first run.
        """
        if self.engine == "python":
            return content_digest(completed(self, first, Execution()))
        plan = self.plan
        arguments = lanes.packed(self.plan, stop_conditions(self.plan))
        entries: dict[str, object] = {
            **self.dispersions.in_lanes(first),
            "target": self.target,
        }
        if plan.noise:
            last = min(plan.times.steps, lanes.SLOTS * plan.times.sample)
            entries["of sensors"] = lanes.noises(plan, len(arguments.law.y), 0, last)[1]
        left: list[object] = [arguments]
        if is_extended(plan):
            left.append(extension_of(plan))
        while left:  # the arrays and numbers in nested tuples
            value = left.pop()
            if isinstance(value, tuple):
                left.extend(value)
            else:
                entries[f"loop.{len(entries)}"] = value
        return content_digest(entries)

    def run(self, rows: Rows, start: int, out: Mapping[str, Array]) -> list[str]:
        """Simulate runs with the given drawn values; see `Job`."""
        drawn = rows["drawn"]
        outcomes = MemoryStore(len(drawn), 1, self.outcome_shapes).arrays
        if self.engine == "compiled":
            runs = self.dispersions.in_lanes(drawn)
            eight_runs = lanes.LaneLoop(self.plan, runs)
            statistics = RunStatistics(self)
            for first in range(0, len(drawn), LANES):
                part = slice(first, first + LANES)
                eight = {key: values[part] for key, values in runs.items()}
                eight_runs.fly(
                    statistics, {key: x[part] for key, x in outcomes.items()}, eight
                )
        else:
            for row, drawn_row in enumerate(drawn):
                outcome = self._one(drawn_row)
                for key, values in outcomes.items():
                    values[row] = outcome[key]
        for key, values in self.judge(outcomes).items():
            out[key][:] = values
        return []

    def errors(self, q: Array, v: Array) -> tuple[Array, Array]:
        """Return the states (N, nx) and the state errors (N, nx) for q and v.

        If the target moves, q and v must be at steps 0 to N - 1.
        """
        state, target = self.plant.state, self.target
        first = target if target.ndim == 1 else target[0]
        joints = 6 + state.unbounded
        x = unwound(states_of(state, q, state.velocities(v)), joints, first)
        if target.ndim == 1:
            return x, x - target
        return x, unwound(moving_errors(state.frame, x, target[: len(x)]), joints)

    def outcome(self, run: Recording) -> dict[str, Array]:
        """Return a run's outcome from its recorded steps: a row of each array of `Campaign`.

        Every step must be recorded. The outcome also contains `state_errors`, the history of the
        state errors. Its entries are NaN after the run was stopped.
        """
        count = len(run.q)
        steps = self.steps
        dt = self.plan.times.dt
        target = self.target[:count] if self.target.ndim == 2 else self.target
        x, signed = self.errors(run.q, run.v)
        e, u = np.where(self.kinds < 0, 0.0, np.abs(signed)), np.abs(run.u)
        sizes = np.empty((count, len(KINDS)))
        sizes[:, 0] = attitude_errors(x, target)
        for kind in range(1, len(KINDS)):
            sizes[:, kind] = e[:, self.kinds == kind].max(axis=1, initial=0.0)
        settled, stop = settled_at(sizes), stop_of(run.stopped)
        late = is_late(settled, count) | (stop > 0)
        kept = steps[steps < count]

        def history(values: Array, after: float) -> Array:
            entries = np.full((len(steps), values.shape[1]), after)
            entries[: len(kept)] = values[kept]
            return entries

        return dict(
            q=run.q[-1],
            v=run.v[-1],
            x=x[-1],
            u=run.u[-1],
            largest_x=e.max(axis=0),
            largest_u=u.max(axis=0),
            errors=sizes[-1],
            largest=sizes.max(axis=0),
            settle=np.where(late, np.inf, settled * dt),
            error_history=history(sizes, np.inf),
            input_history=history(run.u, 0.0),
            stop=np.array(float(stop)),
            end=np.array(run.steps * dt),
            state_errors=history(signed, np.nan),
        )

    def plan_of(self, drawn: Array) -> Plan:
        """Return the plan of the run with the drawn values (k,)."""
        plan, (plant, policy, q, v) = self.plan, self.dispersions.one(drawn)
        law = law_of(policy, plant, plan.limits, plan.times)
        delays = self.dispersions.delays(drawn[None])[0].astype(int).tolist()
        times = plan.times._replace(delays=tuple(delays))
        return plan.replace(plant=plant, q=q, v=v, policy=policy, law=law, times=times)

    @np.errstate(over="ignore", invalid="ignore")  # a run that diverges overflows
    def _one(self, drawn: Array) -> dict[str, Array]:
        """Simulate the run with the drawn values (k,) in Python, and return its outcome."""
        plan = self.plan_of(drawn)
        if over := self.over:
            first = self.errors(plan.q[None], plan.v[None])[1]

            def stops(t: float, q: Array, v: Array) -> float:
                looks = round(t / plan.times.dt) % LOOK == 0
                return float(
                    not (looks and over(first, self.errors(q[None], v[None])[1])[0])
                )

            plan = plan.replace(events=(stops,))
        return self.outcome(_recorded(plan, every=1))

    def seconds(self, first: Array, count: int) -> float:
        """Estimate the time [s] in which one core computes `count` runs, from a few steps.

        `first` (N, k) contains the drawn values of the first runs.
        """
        plan = self.plan
        trial = copy(self)
        drawn = first[: self.lanes]
        out = {
            key: np.empty((len(drawn), *shape)) for key, shape in self.shapes.items()
        }

        def seconds_of(steps: int) -> float:
            """Return the time [s] of one group of parallel runs with the given steps."""
            trial.plan = plan.replace(times=plan.times._replace(steps=steps))
            timed = partial(trial.run, {"drawn": drawn}, 0, out)
            # Other programs can slow down a trial, so the fastest of three trials counts.
            return min(repeat(timed, timer=perf_counter, repeat=3, number=1))

        steps = plan.times.steps
        few = min(_FEW_STEPS, steps)
        more = min(_SOME_STEPS, steps)
        seconds_of(1)  # compiles the loop if needed
        few_seconds = seconds_of(few)
        more_seconds = seconds_of(more)
        per_step = 0.0
        if more > few:
            per_step = max((more_seconds - few_seconds) / (more - few), 0.0)
        per_group = few_seconds + per_step * (steps - few)
        return per_group * math.ceil(count / self.lanes)

    def replay(self, drawn: Array) -> Motion:
        """Repeat the run with the drawn values (k,), by the same engine, and return its motion."""
        plan = self.plan_of(drawn)
        if self.engine == "python":
            run = _recorded(plan, plan.times.every)
        else:
            run = lanes.recorded(self.plan, self.dispersions.in_lanes(drawn[None]))
        return replace(motion_of(plan, run), _nominal=self.plant.robot.urdf_sha256)

    def replays(self, drawn: Array) -> list[Motion]:
        """Repeat at most `lanes` runs with drawn values (N, k), by the same engine.

        The motions of the compiled engine have no notes, and their energy and momentum are NaN.
        """
        if self.engine == "python":
            return [*map(self.replay, drawn)]
        plan = self.plan
        if plan.follows is not None:
            plan = plan.replace(follows=cache(plan.follows))
        values = self.dispersions.in_lanes(drawn)
        recordings = lanes.recorded_runs(plan, values, len(drawn))
        return [motion_of(plan, run) for run in recordings]


class RunStatistics(lanes.Statistics):
    """Statistics of eight parallel runs of a job in compiled code.

    They are the `loop.RunStatistics` of the kernel. Errors are deviations from the target of the
    job. They are computed with a law that controls nothing: it computes the states and the errors,
    and its path contains the reference.
    """

    def __init__(self, job: CampaignJob) -> None:
        self._job = job
        self._state = state = job.plant.state
        # number of steps after which `over` is checked
        self.span = _LONG if job.over is None else LOOK
        target = job.target
        first = target if target.ndim == 1 else target[0]
        initial = job.plan.initial
        kinds = len(KINDS)
        times = len(job.steps)
        law = lanes.no_law(state, initial)
        law.path.point.q[3:7] = _attitude_of(state, first)
        q_ref, nu_ref = job.path or (np.zeros(0), np.zeros(0))
        marks = loop.RunStatistics(
            robot=lanes.mechanics_of(job.plant),
            law=law._replace(near=first[state.groups.q_m]),
            path=law.path,
            x_ref=first,
            q_ref=q_ref,
            nu_ref=nu_ref,
            kind=job.kinds,
            settled=SETTLED,
            tolerance=np.full(kinds, THERE),
            steps=job.steps,
            at=law.path.point,
            sizes=np.zeros(kinds),
            largest_x=np.zeros(state.nx),
            largest_u=np.zeros(len(initial)),
            largest=np.zeros(kinds),
            outside=np.full(kinds, -1.0),
            errors=np.full(times * kinds, np.inf),
            inputs=np.zeros(times * len(initial)),
            states=np.full(times * state.nx, np.nan),
        )
        self._marks, self._words, self._fresh = laid_out(marks, loop.RUN_STATISTICS)

    def reset(self) -> None:
        """Prepare for eight new runs."""
        for values, initial in self._fresh:
            values[:] = initial

    def over(self, q: Array, v: Array) -> Mask:
        """Return a mask (LANES,) of the runs that `CampaignJob.over` ends, judged by q and v."""
        over = self._job.over
        first = _by_run(self._marks.states[: self._state.nx])
        if not over:
            return np.zeros(LANES, dtype=bool)
        return over(first, self._job.errors(q, v)[1])

    def add(self, first: int, rows: Array) -> None:
        """Add consecutive steps to the statistics; the first of them has the index `first`.

        `rows` (steps, width, LANES) contains q, nu and u, in this order, and further values.
        """
        take = kernel("loop", "take")
        take(self._words, rows.reshape(-1, LANES), first, len(rows))
        sizes = map(len, (self._marks.at.q, self._marks.at.nu, self._marks.largest_u))
        self._last = np.split(rows[-1].T, np.cumsum(list(sizes)), axis=1)[:3]

    def outcome(self, done: int, stop: Array) -> dict[str, Array]:
        """Return the outcomes of eight runs after `done` steps.

        `stop` (LANES,) contains the indices into `STOPS` of the reasons why the runs ended.
        """
        (q, nu, u), marks, times = self._last, self._marks, len(self._job.steps)
        settled = _by_run(marks.outside) + 1.0
        late = (stop != 0.0)[:, None] | is_late(settled, done + 1)
        return dict(
            q=q,
            v=self._state.spread(nu),
            x=_by_run(marks.law.x),
            u=u,
            largest_x=_by_run(marks.largest_x),
            largest_u=_by_run(marks.largest_u),
            errors=_by_run(marks.sizes),
            largest=_by_run(marks.largest),
            settle=np.where(late, np.inf, settled * self._job.plan.times.dt),
            error_history=_by_run(marks.errors, times, len(KINDS)),
            input_history=_by_run(marks.inputs, times, u.shape[1]),
            stop=stop,
            end=np.full(LANES, done * self._job.plan.times.dt),
            state_errors=_by_run(marks.states, times, self._state.nx),
        )


def _attitude_of(state: StateMap, x: Array) -> Array:
    """Return the base attitude of a state x (nx,) as a quaternion (x, y, z, w) in q."""
    # q_b is the vector part of the attitude quaternion relative to the origin of the state.
    a, b, c = x[:3].tolist()
    scalar = math.sqrt(max(0.0, 1.0 - a * a - b * b - c * c))
    attitude = np.array((a, b, c, scalar))
    return quaternion_product(conjugate(state.origin_quaternion), attitude)


def _by_run(values: Array, *shape: int) -> Array:
    """Convert values (.., LANES), with one run per column, to rows (LANES, *shape)."""
    shape = shape or (len(values),)
    return np.moveaxis(np.reshape(values, (*shape, LANES)), -1, 0)


def _recorded(plan: Plan, every: int) -> Recording:
    """Simulate a run in Python, and record one row per `every` steps."""
    run = go(plan.replace(times=plan.times._replace(every=every)))
    if run.stopped.startswith("interrupted"):
        raise KeyboardInterrupt
    return run


def expect(
    progress: Progress | None,
    work: Sequence[tuple[CampaignJob, Array, int]],
    how: Execution,
) -> None:
    """Report the estimated time of jobs to a progress bar.

    Each entry of `work` is (job, drawn values of its first runs, number of runs). Only
    fflin's progress bar has the method `expect`; other progress functions do not
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
    faster = ""
    if lanes.only_numba_is_missing(work[0][0].plan):
        faster = f"faster: {INSTALL}"
    tell(seconds / cores, cores, faster=faster)


def chunk_size(count: int, workers: int, least: int = LANES) -> int:
    """Return a chunk size, at least `least`; if possible, each worker computes several chunks."""
    size = _LARGEST_CHUNK
    while size > least and 4 * workers * size > count:
        size //= 2
    return size


def notes_on_engine(job: CampaignJob, engine: str | None) -> tuple[str, ...]:
    """Return why the runs of a job are simulated in Python although `engine` is None."""
    if engine is not None or job.engine != "python":
        return ()
    return (f"simulated in Python, because {lanes.not_compilable(job.plan)}",)


def completed(
    job: CampaignJob, drawn: Array, how: Execution, progress: Progress | None = None
) -> dict[str, Array]:
    """Run a job with drawn values (N, k), and return its arrays."""
    count = len(drawn)
    store = MemoryStore(count, chunk_size(count, how.count(job), job.lanes), job.shapes)
    run_chunks(
        job, lambda start, stop: {"drawn": drawn[start:stop]}, store, how, progress
    )
    return store.arrays
