"""Choice of the engine; the compiled loop, which simulates eight runs of a plan at once.

Each run has a lane. If there is only one run, all lanes compute it.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping
from typing import TypeAlias

import numpy as np

from fflin.base.errors import InputError
from fflin.base.process import LONG_RUN, Progress
from fflin.base.validation import Array, Indices, Mask, vector
from fflin.control.linear_controller import LinearController, OutputFeedback
from fflin.control.policies import Allocation, Gridded, StateFeedback, decider, measured_at
from fflin.control.tracking import TrajectoryFeedback, TrajectoryOutputFeedback
from fflin.kernel import loop
from fflin.kernel.compiled import checked_engine, is_kept, kernel, numba_is_there
from fflin.kernel.tree import LANES, batch_tree, laid_out, words_of, work_space
from fflin.robot.joints import ROOT
from fflin.simulation.packing import SLOTS, packed
from fflin.simulation.plan import Plan, Times
from fflin.simulation.run import STOPS, Recording, ending_of, go, stop_conditions, stop_of

_OF_OUTPUTS = OutputFeedback, LinearController, TrajectoryOutputFeedback
_KNOWN = StateFeedback, TrajectoryFeedback, *_OF_OUTPUTS
# Number of steps above which a single run uses the compiled loop, if its machine code is stored.
LONG = 20_000
# After a run in Python of more than LONG_RUN seconds, a message recommends the compiled loop. The
# compiled loop takes about _FRACTION of the time. Compiling it takes about _COMPILING seconds,
# once.
_FRACTION, _COMPILING = 0.1, 30.0

_log = logging.getLogger("fflin")

_MEMORY = 2**22  # [bytes] memory for recorded rows

# {name of an array of the loop: values of N runs (N, size)}; see `Dispersions.in_lanes`.
Runs: TypeAlias = Mapping[str, Array]


def noise_generator(seed: float) -> np.random.Generator:
    """Return the random generator for the noise of a run."""
    return np.random.Generator(np.random.Philox(np.random.SeedSequence(int(seed))))


def noises(plan: Plan, size: int, step: int, last: int) -> tuple[Indices, Array]:
    """Return the samples (k,) between two steps, and the policy's noise (k, size) at them."""
    times = plan.times
    at = np.arange(-(-step // times.sample), -(-last // times.sample))
    rows = np.zeros((len(at), size))
    for row, t in zip(rows, (at * times.sample * times.dt).tolist(), strict=True):
        if plan.noise:
            row[:] = vector("noise(t)", plan.noise(t), size, "one value for each output")
    return at, rows


class Statistics:
    """Statistics of eight parallel runs, updated after each slice of steps; here, none."""

    every = 1  # steps from one row to the next
    span = 4096  # steps between checks of `over`, and for Ctrl-C

    def over(self, q: Array, v: Array) -> Mask:
        """Return the mask (LANES,) of the runs that end early at these q and v (LANES, ..)."""
        return np.zeros(len(q), dtype=bool)

    def reset(self) -> None:
        """Prepare for eight new runs."""

    def add(self, first: int, rows: Array) -> None:
        """Add rows (count, width, LANES) of q, nu, u, momentum and centre of mass.

        The first row is at step `first`. The same row may be added twice.
        """

    def outcome(self, done: int, stop: Array) -> dict[str, Array]:
        """Return the outcomes of the runs after `done` steps; `stop` are indices into STOPS."""
        return {}


class LaneLoop:
    """The compiled loop over a plan. Threads cannot share it, because it has its own work space.

    `parts` are the laned arguments of the loop. A row consists of q, nu, u, momentum and centre of
    mass, which end at the columns `ends`.
    """

    def __init__(self, plan: Plan, runs: Runs | None = None) -> None:
        runs = runs or {}
        if "delay" in runs:  # provide space for the largest delay
            plan = plan.replace(times=plan.times._replace(delay=int(runs["delay"].max())))
        stop = stop_conditions(plan)
        if runs:  # all runs are given with a quaternion for which the sign is positive
            stop = stop._replace(sign=[abs(stop.sign[0])])
        parts = packed(plan, stop, noisy="seed" in runs)
        self._plan, self._state = plan, plan.plant.state
        self._ending, self._noisy = ending_of(plan, stop), len(parts.law.added) > len(parts.law.y)
        # Laned arrays, each with the column of its initial values.
        self._fresh: list[tuple[Array, Array]] = []
        self.parts = laid_out(parts, loop.ARGUMENTS, lambda *pair: self._fresh.append(pair))
        self._words = words_of(self.parts, loop.ARGUMENTS)
        self._work = work_space(self.parts.robot.tree.size)
        self._advance = kernel("loop", "advance", "the loop that simulates eight runs at a time")
        robot, point = self.parts.robot, self.parts.point
        self.ends = np.cumsum([len(point.q), len(point.nu), len(point.u), 6, 3])
        self.width, self.done = int(self.ends[-1]), 0
        self._of_run = {
            **{"q": point.q, "nu": point.nu, "delay": self.parts.channel.delay},
            **robot.tree._asdict(),
            **robot.faults._asdict(),
        }

    # A diverging motion overflows before it is stopped, so NumPy need not warn.
    @np.errstate(over="ignore", invalid="ignore")
    def fly(self, statistics: Statistics, out: Runs, runs: Runs | None = None) -> list[str]:
        """Simulate up to eight runs, the plan's own by default, and return why each was stopped.

        The outcomes of the statistics are written into the rows of `out`.
        """
        times, every, point = self._plan.times, statistics.every, self.parts.point
        steps, count = times.steps, len(next(iter(out.values()))) if out else 1
        of_lane = np.minimum(np.arange(LANES), count - 1)
        sense = self._begin(runs or {}, of_lane)
        statistics.reset()
        most = max(1, min(-(-steps // every), _MEMORY // (8 * LANES * self.width)))
        space = work_space(most * self.width)
        # A slice of count * every steps contains count recorded steps, wherever it begins.
        span = min(most * every, statistics.span)
        if self._noisy:
            span = min(span, SLOTS * times.sample)
        clock, messages = np.zeros(1, dtype=np.intp), [""] * count
        going, bar = np.ones(count, dtype=bool), Progress(self._plan.options.progress)
        try:
            while self.done < steps and going.any():
                first = self.done
                last = min(steps, (first // span + 1) * span)
                sense(first, last)
                self._advance(self._words, clock, last, every, space, self._work)
                self.done = done = int(clock[0])
                if kept := -(-done // every) - -(-first // every):
                    rows = space[: kept * self.width].reshape(kept, self.width, LANES)
                    statistics.add(first, rows)
                bar(done, steps)
                v = self._state.spread(point.nu.T)
                for lane in going.nonzero()[0]:
                    messages[lane] = self._ending(done * times.dt, point.q[:, lane], v[lane])
                stop = np.array([float(stop_of(each)) for each in messages])
                if done % statistics.span == 0:
                    over = statistics.over(point.q.T, v)[:count] & (stop == 0.0)
                    stop[over] = STOPS.index("stopped")
                ending = going & ((stop > 0.0) | (done == steps))
                if not ending.any():
                    continue
                self._end(statistics, ending, stop[of_lane], out)
                going &= ~ending
                # A finished run would stop all lanes, so its lane continues as a copy of another.
                if going.any():
                    over = ~going[of_lane]
                    for array, _ in self._fresh:
                        array[:, over] = array[:, [going.argmax()]]
        finally:
            bar.close()
        return messages

    def _begin(self, runs: Runs, of_lane: Indices) -> Callable[[int, int], None]:
        """Write the initial values of runs, and return a function that writes sensor errors."""
        for array, initial in self._fresh:
            array[:] = initial
        for name, values in runs.items():
            if name in self._of_run:
                self._of_run[name][:] = values[of_lane].T
        robot, kept = self.parts.robot, self.parts.reference
        mass = robot.tree.bodies[::10].sum(axis=0)
        kept.per_mass[0], kept.weight[:] = 1.0 / mass, mass * robot.gravity[:, None]
        kept.start[9:], self.done = self.parts.point.q[:3], 0
        law, size = self.parts.law, len(self.parts.law.y)
        rows = law.added.reshape(len(law.added) // max(size, 1), size, LANES)
        nothing = np.zeros((LANES, size))
        bias, deviation = (runs.get(key, nothing)[of_lane].T for key in ("sensed", "noise"))
        rows[:] = bias
        draws = [noise_generator(seed) for seed in runs["seed"][of_lane]] if "seed" in runs else []
        drawn = 0

        def sense(step: int, last: int) -> None:
            nonlocal drawn
            if not self._noisy or drawn == last:  # the end of a run interrupted the slice
                return
            drawn = last
            k, values = noises(self._plan, size, step, last)
            rows[k % SLOTS] = values[..., None] + bias
            for lane, normal in enumerate(draws):
                random = normal.standard_normal(values.shape)
                rows[k % SLOTS, :, lane] += deviation[:, lane] * random

        return sense

    def _end(self, statistics: Statistics, ending: Mask, stop: Array, out: Runs) -> None:
        """Write into `out` the outcomes of the runs that end at the current step."""
        point, kept, count = self.parts.point, self.parts.reference, len(ending)
        conserved = kept.start[:9] + kept.sums[:9]
        conserved[6:] += self.done * self._plan.times.dt * kept.per_mass * kept.start[:3]
        last = np.vstack((point.q, point.nu, self.parts.stages.u, conserved))
        diverged = (stop == STOPS.index("diverged"))[:count]
        for chosen, finite in ((ending & diverged, False), (ending & ~diverged, True)):
            if finite:  # the last state of a diverged run may not be finite, so it is not added
                statistics.add(self.done, last[None])
            found = statistics.outcome(self.done, stop)
            for name, rows in out.items():
                rows[chosen] = found[name][:count][chosen]


class LaneRows(Statistics):
    """Recorded rows of a single run, one for each `every` steps, with the columns of the loop."""

    def __init__(self, times: Times, width: int) -> None:
        self.every, self.kept = times.every, np.empty((times.rows, width))

    def add(self, first: int, rows: Array) -> None:
        """Store rows; see `Statistics`."""
        begin = -(-first // self.every)
        self.kept[begin : begin + len(rows)] = rows[..., 0]


def recorded(plan: Plan, runs: Runs | None = None) -> Recording:
    """Simulate a plan, or a single dispersed run of it (`runs`), with the compiled loop."""
    every, dt, loop = plan.times.every, plan.times.dt, LaneLoop(plan, runs)
    rows = LaneRows(plan.times, loop.width)
    try:
        [stopped] = loop.fly(rows, {}, runs)
    except KeyboardInterrupt:
        if not loop.done:
            raise
        stopped = f"interrupted at t = {loop.done * dt:g} s"
    if runs is None and not np.isfinite(loop.parts.stages.u).all():
        return go(plan)  # raises an error that names the command
    count = -(-loop.done // every)
    t = np.append(every * np.arange(count) * dt, loop.done * dt)
    count += not stopped.startswith(("diverged", "interrupted"))
    q, nu, u, momentum, center, _ = np.split(rows.kept[:count], loop.ends, axis=1)
    v = plan.plant.state.spread(nu)
    return Recording(t[:count], q, v, u, momentum, center, loop.done, stopped, "compiled")


def engine_of(engine: object, plan: Plan, *, many: bool = False) -> str:
    """Return the requested engine for a plan, or choose an engine.

    Many runs use the compiled loop if it supports the plan. A single run uses it only if the run is
    long and the machine code is stored already.
    """
    if checked_engine(engine) == "python":
        return "python"
    reason = _reason(plan)
    if engine == "compiled" and reason:
        raise InputError(f"engine='compiled' is not possible, because {reason}; leave engine out")
    wanted = engine or many or (plan.times.steps > LONG and is_kept("loop", "advance"))
    return "compiled" if wanted and not reason else "python"


def _reason(plan: Plan) -> str:
    """Return why the compiled loop cannot run a plan, or an empty text if it can."""
    plant, policy, robots = plan.plant, decider(plan.policy), [plan.plant.robot]
    if not numba_is_there():
        return "numba is not installed (pip install 'fflin[fast]')"
    if plan.events or plan.options.callback or plant.disturbance or plant.field:
        return "events, callbacks, disturbances and the field of an orbit are computed in Python"
    if isinstance(plan.policy, Allocation):
        robots.append(plan.policy.design)
    known = type(policy) in _KNOWN or isinstance(policy, Gridded)
    if policy is not None and not known:
        return f"a {type(policy).__name__} is computed in Python"
    for robot in robots:
        at_home = robot.model.jointPlacements[ROOT].isIdentity(0.0)
        if batch_tree(robot) is None or not at_home:
            return f"a joint of '{robot.name}' does not move along a screw with a fixed axis"
    return _unmeasured(plan, policy) if isinstance(policy, _OF_OUTPUTS) else ""


def _unmeasured(plan: Plan, policy: LinearController | TrajectoryOutputFeedback) -> str:
    """Return why the compiled loop cannot evaluate a plan's compensator, or an empty text."""
    dt = policy.dt if isinstance(policy, LinearController) else policy.filter.dt
    if abs(plan.times.sample * plan.times.dt - dt) > 1e-6 * dt and dt:
        return "its sample time differs from the compensator's"
    if policy.noise is not None and not plan.times.sample:
        return "noise is evaluated at every stage of every step"
    try:
        measured_at(plan.plant.state)
    except InputError as error:
        return str(error)
    return ""


def carried_out(plan: Plan, engine: str) -> Recording:
    """Simulate a plan with an engine."""
    if engine == "compiled":
        return recorded(plan)
    began, slower = time.perf_counter(), not _reason(plan)
    run = go(plan, "(faster: --engine compiled) " if slower else "")
    spent = time.perf_counter() - began
    if spent > LONG_RUN and slower:
        once = "" if is_kept("loop", "advance") else f", and {_COMPILING:g} s once to compile"
        said = "the simulation took %.0f s in Python; engine='compiled' (--engine compiled) would"
        _log.warning(f"fflin: {said} take about %.0f s%s", spent, _FRACTION * spent, once)
    return run
