"""Eight parallel runs in the compiled loop: their robots, initial states and statistics."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar, Protocol

import numpy as np

from fflin.base.validation import Array
from fflin.campaign.dispersions import noise_generator
from fflin.campaign.statistics import STOPS, stop_of
from fflin.kernel.tree import LANES, batch_tree
from fflin.simulation.conservation import Conserved
from fflin.simulation.packing import (
    SLOTS,
    CompiledLoop,
    kept_at,
    noise_of,
    noises,
    packed,
)
from fflin.simulation.plan import Plan
from fflin.simulation.plant import Plant
from fflin.simulation.run import ending_of, stop_conditions

_DIVERGED = float(STOPS.index("diverged"))

# Called with the first step of a slice and its rows (steps, LANES, ..) of q, nu, u, momentum and
# centre of mass.
Watcher = Callable[[int, list[Array]], None]


class Statistics(Protocol):
    """What is kept of eight parallel runs, slice by slice."""

    FIELDS: ClassVar[tuple[str, ...]]
    span: int  # steps between checks of `over`

    @property
    def over(self) -> Any:
        """Which runs (LANES,) may end before their time."""

    def reset(self) -> None:
        """Begin with eight other runs."""

    def add(self, first: int, rows: Sequence[Array], raw: Array | None = None) -> None:
        """Add the rows (steps, LANES, ..) of q, nu, u, .. from step `first` on, also as `raw`.

        A row may be added again.
        """

    def outcome(self, done: int, stop: Array) -> dict[str, Array]:
        """Return the outcomes of the runs after so many steps; `stop` are indices into STOPS."""


def loop_arrays(plan: Plan, plant: Plant) -> dict[str, Any]:
    """Return the arrays and numbers by which the compiled loop knows a plan, without compiling it.

    Two plans with the same arrays have the same runs.
    """
    tree = batch_tree(plant.robot)
    assert tree is not None
    parts = packed(plan, plant, Conserved(plant.robot, plan.q), tree)
    last = min(plan.times.steps, SLOTS * plan.times.sample)
    noise = noise_of(plan)
    samples = noises(noise, plan.times, len(parts.law.y), 0, last)[1] if noise else np.zeros(0)
    found: dict[str, Any] = {"noise": samples}

    def collect(name: str, value: Any) -> None:
        if isinstance(value, tuple):
            for index, each in enumerate(value):
                collect(f"{name}.{index}", each)
        else:
            found[name] = value

    collect("loop", parts)
    return found


class Lanes:
    """The compiled loop over a plan, with arrays of its own: not to be shared by threads."""

    def __init__(
        self, plan: Plan, plant: Plant, runs: Mapping[str, Array], statistics: Statistics
    ) -> None:
        tree = batch_tree(plant.robot)
        assert tree is not None
        if "delay" in runs:  # so that there is room for the latest
            latest = int(runs["delay"].max())
            plan = replace(plan, times=plan.times._replace(delay=latest))
        parts = packed(plan, plant, Conserved(plant.robot, plan.q), tree)
        law = parts.law
        if "seed" in runs and len(law.added) == len(law.y):
            law = law._replace(added=np.zeros(SLOTS * len(law.y)))
        # All starts are given with the base on the side of the chart where this is positive.
        stop = stop_conditions(plan)
        stop = stop._replace(sign=[abs(stop.sign[0])])
        self._ending = ending_of(plan, stop)
        self._plan, self._state, self._statistics = plan, plant.state, statistics
        self._loop = CompiledLoop(parts._replace(law=law, stop=parts.stop._replace(sign=stop.sign)))
        robot, point = self._loop.parts.robot, self._loop.parts.point
        # Noise has room for so many samples alone.
        self._rows = self._loop.rows(SLOTS if len(law.added) > len(law.y) else plan.times.steps)
        self._most = len(self._rows) // self._loop.width
        self._of = {
            **{"q": point.q, "nu": point.nu, "delay": self._loop.parts.channel.delay},
            **{key: getattr(robot.tree, key) for key in ("bodies", "fixed")},
            **{key: getattr(robot.loads, key) for key in robot.loads._fields},
            **robot.faults._asdict(),
        }

    # A motion that diverges overflows before it is stopped: that is no reason to warn.
    @np.errstate(over="ignore", invalid="ignore")
    def fly(
        self,
        runs: Mapping[str, Array],
        out: Mapping[str, Array],
        watcher: Watcher | None = None,
    ) -> list[str]:
        """Simulate up to eight runs into `out`, and return why each was stopped."""
        plan, steps, count = self._plan, self._plan.times.steps, len(runs["q"])
        loop, rows, width = self._loop, self._rows, self._loop.width
        robot, kept, point = loop.parts.robot, loop.parts.reference, loop.parts.point
        for array, initial in loop.fresh:
            array[:] = initial
        statistics = self._statistics
        statistics.reset()
        of_lane = slice(None) if count == LANES else np.minimum(np.arange(LANES), count - 1)
        for name, values in runs.items():
            if name in self._of:
                self._of[name][:] = values[of_lane].T
        sense = self._sensors(runs, of_lane)
        mass = robot.tree.bodies[::10].sum(axis=0)
        kept.per_mass[0], kept.weight[:] = 1.0 / mass, mass * robot.gravity[:, None]
        kept.start[9:] = point.q[:3]
        span = min(self._most, statistics.span)
        clock, going, told = np.zeros(1, dtype=np.intp), np.ones(count, dtype=bool), [""] * count
        while clock[0] < steps and going.any():
            first = int(clock[0])
            last = min(steps, (first // span + 1) * span)
            sense(first, last)
            loop.advance(clock, last, 1, rows)
            done = int(clock[0])
            taken = rows[: (done - first) * width]
            seen = loop.split(taken)
            statistics.add(first, seen, taken)
            if watcher:
                watcher(first, seen)
            v = self._state.spread(point.nu.T)
            for lane in going.nonzero()[0]:
                told[lane] = self._ending(done * plan.times.dt, point.q[:, lane], v[lane])
            stop = np.array([float(stop_of(each)) if each else 0.0 for each in told])
            ending = going & ((stop > 0.0) | (done == steps) | statistics.over[:count])
            if not ending.any():
                continue
            self._end(ending, done, stop[of_lane], out)
            going &= ~ending
            # What has ended would stop the others: it goes on as one of them.
            if going.any():
                over = ~going[of_lane]
                for array, _ in loop.fresh:
                    array[:, over] = array[:, [going.argmax()]]
        return told

    def _end(self, ending: Any, done: int, stop: Array, out: Mapping[str, Array]) -> None:
        """Write the outcomes of the runs that end after so many steps."""
        parts, statistics, count = self._loop.parts, self._statistics, len(ending)
        diverged = (stop == _DIVERGED)[:count]

        def write(chosen: Any) -> None:
            for name, values in statistics.outcome(done, stop).items():
                out[name][chosen] = values[:count][chosen]

        if (ending & diverged).any():
            write(ending & diverged)
        if (ending & ~diverged).any():
            # The last state is added, except if it diverged and is not finite.
            point = parts.point
            last = np.vstack((point.q, point.nu, parts.stages.u, parts.reference.sums[:9]))
            statistics.add(done, self._loop.split(last), last)
            write(ending & ~diverged)

    def _sensors(self, runs: Mapping[str, Array], of_lane: Any) -> Callable[[int, int], None]:
        """Return what writes the errors of all that is sensed from a step up to another."""
        law, times, noise = self._loop.parts.law, self._plan.times, noise_of(self._plan)
        size = len(law.y)
        rows = law.added.reshape(len(law.added) // max(size, 1), size, LANES)
        nothing = np.zeros((LANES, size))
        bias, deviation = (runs.get(key, nothing)[of_lane].T for key in ("sensed", "noise"))
        rows[:] = bias
        draws = [noise_generator(seed) for seed in runs["seed"][of_lane]] if "seed" in runs else []

        drawn = 0

        def sense(step: int, last: int) -> None:
            nonlocal drawn
            if drawn == last:  # some of the others ended on the way
                return
            drawn = last
            k, values = noises(noise, times, size, step, last)
            rows[k % SLOTS] = values[..., None] + bias
            for lane, normal in enumerate(draws):
                random = normal.standard_normal(values.shape)
                rows[k % SLOTS, :, lane] += deviation[:, lane] * random

        return sense if len(rows) == SLOTS else lambda *_: None

    def conserved(self, t: float) -> tuple[Array, Array]:
        """Return the momentum (6,) and centre of mass (3,) that the first run conserves."""
        momentum, center = kept_at(self._loop.parts, t)
        return momentum, center
