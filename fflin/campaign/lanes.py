"""Eight parallel runs in the compiled loop, each with its own robot and start."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from fflin.base.rotation import product_matrix
from fflin.base.validation import Array
from fflin.campaign.sensing import normals
from fflin.campaign.tally import STOPS, stop_of
from fflin.kernel.accelerations import work_space
from fflin.kernel.compiled import kernel
from fflin.kernel.tree import LANES, batch_tree
from fflin.simulation.conservation import Conserved
from fflin.simulation.packing import SLOTS, noise_of, noises, packed
from fflin.simulation.plan import Plan
from fflin.simulation.plant import Plant
from fflin.simulation.run import ending_of

_MEMORY = 2**22  # [bytes] of rows that are there at a time
_DIVERGED = float(STOPS.index("diverged"))

# Takes the first step of some, and their rows (steps, LANES, ..) of q, nu, u, momentum and centre.
Watcher = Callable[[int, list[Array]], None]


class Lanes:
    """The compiled loop over a plan, with arrays of its own: not to be shared by threads."""

    def __init__(self, plan: Plan, plant: Plant, runs: Mapping[str, Array]) -> None:
        tree = batch_tree(plant.robot)
        assert tree is not None
        if "delay" in runs:  # so that there is room for the latest
            latest = int(runs["delay"].max())
            plan = replace(plan, times=plan.times._replace(delay=latest))
        parts = packed(plan, plant, Conserved(plant.robot, plan.q), tree)
        self._plan, self._state = plan, plant.state
        mechanics, method, law, channel, (kept, *flags), watch, point, stages = parts
        self._fresh: list[tuple[Array, Array]] = []
        mechanics = mechanics._replace(
            tree=self._wide(mechanics.tree, "bodies", "fixed"),
            loads=self._wide(mechanics.loads, "wrench", "stored", "stiffness", "damping"),
            drives=self._wide(mechanics.drives, *mechanics.drives._fields),
        )
        if "seed" in runs and len(law.added) == len(law.y):
            law = law._replace(added=np.zeros(SLOTS * len(law.y)))
        law = self._wide(law, "x", "y", "added", "u")._replace(
            path=self._wide(law.path, "e"),
            grid=self._wide(law.grid, "at"),
            filter=self._wide(law.filter, "z", "rates"),
        )
        if law.sharing:
            own = self._wide(law.sharing.point, "q", "pushing")
            wide = self._wide(law.sharing, "work", "columns")._replace(point=own)
            law = law._replace(sharing=wide)
        pulses = self._wide(channel.pulses, "left", "level", "end")
        channel = self._wide(channel, "held", "pending", "delay", "fresh")._replace(pulses=pulses)
        kept, point, stages = (self._wide(x, *x._fields) for x in (kept, point, stages))
        # All starts are given with the base on the side of the chart where this is positive.
        watch = watch._replace(sign=np.abs(watch.sign))
        self._parts = mechanics, method, law, channel, (kept, *flags), watch, point, stages
        self._work = work_space(mechanics.layout.size)
        self._sizes = [len(each) for each in (point.q, point.nu, point.u)] + [6, 3]
        ends = np.cumsum(self._sizes).tolist()
        self._columns = [
            slice(end - size, end) for end, size in zip(ends, self._sizes, strict=True)
        ]
        # Noise has room for so many samples alone.
        most = SLOTS if len(law.added) > len(law.y) else plan.times.steps
        self._most = max(1, min(most, _MEMORY // (8 * LANES * ends[-1])))
        self._rows = work_space(self._most * ends[-1])
        self._begin = kernel("loop", "begin", "the start of eight runs")
        self._advance = kernel("loop", "advance_eight", "the loop of eight runs at a time")
        self._of = {
            **{"q": point.q, "nu": point.nu, "delay": channel.delay},
            **{key: getattr(mechanics.tree, key) for key in ("bodies", "fixed")},
            **{key: getattr(mechanics.loads, key) for key in mechanics.loads._fields},
            **mechanics.drives._asdict(),
        }
        self._turn = product_matrix(plant.state.origin_quaternion)[3]

    def _wide(self, part: Any, *names: str) -> Any:
        """Return a part with arrays in lanes, which are remembered as they were."""
        wide = {}
        for name in names:
            array = getattr(part, name)
            wide[name] = work_space(len(array))
            self._fresh.append((wide[name], array[:, None].copy()))
        return part._replace(**wide)

    # A motion that diverges overflows before it is stopped: that is no reason to warn.
    @np.errstate(over="ignore", invalid="ignore")
    def fly(
        self,
        runs: Mapping[str, Array],
        tally: Any,
        out: Mapping[str, Array],
        watcher: Watcher | None = None,
    ) -> list[str]:
        """Do up to eight, whose rows differ from the plan, into `out`; say why each was stopped."""
        plan, steps, count = self._plan, self._plan.times.steps, len(runs["q"])
        parts, rows, width = self._parts, self._rows, sum(self._sizes)
        mechanics, *_, (kept, *_), watch, point, _ = parts
        for array, fresh in self._fresh:
            array[:] = fresh
        of_lane = slice(None) if count == LANES else np.minimum(np.arange(LANES), count - 1)
        for name, values in runs.items():
            if name in self._of:
                self._of[name][:] = values[of_lane].T
        sense = self._sensors(runs, of_lane)
        mass = mechanics.tree.bodies[::10].sum(axis=0)
        kept.per_mass[0], kept.weight[:] = 1.0 / mass, mass * mechanics.gravity[:, None]
        kept.start[9:] = point.q[:3]
        self._begin(mechanics, kept, point, self._work)
        span = min(self._most, tally.span)
        clock, going, told = np.zeros(1, dtype=np.intp), np.ones(count, dtype=bool), [""] * count
        while clock[0] < steps and going.any():
            first = int(clock[0])
            last = min(steps, (first // span + 1) * span)
            sense(first, last)
            self._advance(*parts, clock, last, 1, rows, self._work)
            done = int(clock[0])
            taken = rows[: (done - first) * width]
            seen = self._split(taken)
            tally.add(first, seen, taken)
            if watcher:
                watcher(first, seen)
            lost = ~(point.nu**2 < watch.squares[:, None]).all(axis=0)
            if plan.chart:
                lost |= self._turn @ point.q[3:7] < 0.0
            for lane in (lost[:count] & going).nonzero()[0]:
                told[lane] = self._said(runs["q"][lane], lane, done)
            stop = np.array([float(stop_of(each)) if each else 0.0 for each in told])
            ending = going & ((stop > 0.0) | (done == steps) | tally.over[:count])
            if not ending.any():
                continue
            self._end(tally, ending, bool((ending == going).all()), done, stop[of_lane], out)
            going &= ~ending
            # What has ended would stop the others: it goes on as one of them.
            if going.any():
                over = ~going[of_lane]
                for array, _ in self._fresh:
                    array[:, over] = array[:, [going.argmax()]]
        return told

    def _end(self, tally: Any, ending: Any, last: bool, done: int, stop: Array, out: Any) -> None:
        """Write how some of the runs ended, which may be the last."""
        *_, (kept, *_), _, point, stages = self._parts
        rows = np.vstack((point.q, point.nu, stages.u, kept.sums[:9]))
        away, count = (stop == _DIVERGED)[: len(ending)], len(ending)
        # Of what diverged the end is no number.
        for some, whole in ((ending & away, False), (ending & ~away, True)):
            if not some.any():
                continue
            if whole:
                tally = (tally if last else tally.copy()).add(done, self._split(rows), rows)
            where = slice(None) if some.all() else some
            for name, values in tally.outcome(done, stop)._asdict().items():
                out[name][where] = values[:count][where]

    def _sensors(self, runs: Mapping[str, Array], of_lane: Any) -> Callable[[int, int], None]:
        """Return what writes the errors of all that is sensed from a step up to another."""
        law, times, noise = self._parts[2], self._plan.times, noise_of(self._plan)
        size = len(law.y)
        rows = law.added.reshape(len(law.added) // max(size, 1), size, LANES)
        nothing = np.zeros((LANES, size))
        bias, deviation = (runs.get(key, nothing)[of_lane].T for key in ("sensed", "noise"))
        rows[:] = bias
        draws = [normals(seed) for seed in runs["seed"][of_lane]] if "seed" in runs else []

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

    def kept(self, t: float) -> tuple[Array, Array]:
        """Return the momentum (6,) and the centre of mass (3,) that the first is to have."""
        kept = self._parts[4][0]
        start, sums = kept.start[:, 0], kept.sums[:, 0]
        momentum, center = np.split(start[:9] + sums[:9], [6])
        return momentum, center + t * kept.per_mass[0, 0] * start[:3]

    def _said(self, q: Array, lane: int, done: int) -> str:
        """Say why a run ends where it is, or nothing."""
        point = self._parts[-2]
        ending = ending_of(replace(self._plan, q=q))
        v = self._state.spread(point.nu[:, lane])
        return ending(done * self._plan.times.dt, point.q[:, lane].copy(), v)

    def _split(self, rows: Array) -> list[Array]:
        """Return what rows hold, each (steps, LANES, size)."""
        by_step = rows.reshape(-1, sum(self._sizes), LANES).transpose(0, 2, 1)
        return [by_step[..., part] for part in self._columns]
