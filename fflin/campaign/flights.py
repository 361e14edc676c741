"""Starts flown through a plan, eight at a time compiled or one by one in Python, each judged."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import Executor
from dataclasses import replace
from functools import cached_property, lru_cache
from typing import Any, NamedTuple, Protocol, TypeAlias

import numpy as np

from fflin.base.errors import FflinError
from fflin.base.validation import Array
from fflin.batch.dispatch import ChunkResult, Job, Rows
from fflin.batch.run import Progress, run_chunks
from fflin.batch.store import MemoryStore
from fflin.campaign.tally import stop_of
from fflin.kernel.compiled import available_cores
from fflin.kernel.tree import LANES
from fflin.simulation.compiled import engine_of
from fflin.simulation.conservation import Conserved
from fflin.simulation.plan import Plan
from fflin.simulation.plant import Plant
from fflin.simulation.run import go

_ROWS = 32  # that the loop in Python hands over at a time


class Judge(Protocol):
    """What watches some runs that go on together, such as `Tally`."""

    over: Any  # (count,), which need not go on

    def add(self, first: int, q: Array, nu: Array, u: Array) -> Judge:
        """Take rows (steps, count, ..) from a step on into account."""

    def copy(self) -> Judge:
        """Return one that goes its own way from here on."""

    def outcome(self, done: int, stop: Array) -> Any:
        """Return a named tuple of arrays, how the runs ended, by which of STOPS."""


Make: TypeAlias = Callable[[], tuple[Plan, Plant]]


class Starts(NamedTuple):
    """Where runs begin."""

    q: Array  # (N, nq)
    v: Array  # (N, nv)


class Flights:
    """Runs of the plan that `make` makes, judged by what ``judge(plan, plant, count)`` makes.

    See `Job`. Both must be functions that can be sent.
    """

    def __init__(
        self,
        make: Make,
        judge: Callable[[Plan, Plant, int], Judge],
        shapes: Mapping[str, tuple[int, ...]],
        engine: str,
    ) -> None:
        self._make, self._judge, self.shapes, self.engine = make, judge, shapes, engine

    @cached_property
    def _plan(self) -> tuple[Plan, Plant]:
        return self._make()

    def __reduce__(self) -> tuple[Any, ...]:
        return Flights, (self._make, self._judge, self.shapes, self.engine)

    def run(
        self, rows: Starts, start: int = 0, out: Mapping[str, Array] | None = None
    ) -> ChunkResult:
        """Do some runs."""
        if out is None:
            out = {key: np.empty((len(rows.q), *shape)) for key, shape in self.shapes.items()}
        if self.engine == "python":
            plan, plant = self._make()  # of its own: threads share a job
            for row, (q, v) in enumerate(zip(*rows, strict=True)):
                done = _alone(replace(plan, q=q, v=v), plant, self._judge(plan, plant, 1))
                for key in out:
                    out[key][row] = getattr(done, key)[0]
            return ChunkResult(dict(out), [])
        from fflin.campaign.lanes import Lanes

        plan, plant = self._plan
        lanes, nu = Lanes(plan, plant), plant.state.velocities(rows.v)
        for at in range(0, len(nu), LANES):
            some = slice(at, at + LANES)
            eight, own = (
                {"q": rows.q[some], "nu": nu[some]},
                {key: x[some] for key, x in out.items()},
            )
            lanes.fly(eight, self._judge(plan, plant, LANES), own)
        return ChunkResult(dict(out), [])


@np.errstate(over="ignore", invalid="ignore")  # of what diverges
def _alone(plan: Plan, plant: Plant, judge: Judge) -> Any:
    """Return the outcome of a run by the loop in Python, which goes on until it is judged."""
    rows, seen = [(plan.q, plant.state.velocities(plan.v))], 0

    def hand_over() -> None:
        nonlocal seen
        q, nu = (np.array(each)[:, None] for each in zip(*rows, strict=True))
        judge.add(seen, q, nu, np.zeros((len(q), 1, len(plan.initial))))
        seen += len(rows)
        rows.clear()

    def look(_: float, q: Array, v: Array) -> float:
        rows.append((q, plant.state.velocities(v)))
        if len(rows) >= _ROWS:
            hand_over()
        return 1.0 - bool(judge.over[0])

    times = plan.times._replace(every=plan.times.steps)
    run = go(replace(plan, events=(look,), times=times), plant, Conserved(plant.robot, plan.q))
    if run.stopped.startswith("interrupted"):
        raise KeyboardInterrupt
    if rows:
        hand_over()
    ended = "" if run.stopped.startswith(look.__name__) else run.stopped
    return judge.outcome(run.steps, np.array([float(stop_of(ended))]))


class Crew(NamedTuple):
    """Who does the chunks of a job: an executor, or so many threads of this process."""

    executor: Executor | None
    workers: int
    threads: int | None
    engine: str | None

    def engine_for(self, make: Make, runs: int) -> str:
        """Return which loop does so many runs of a plan, of a third of its steps on average."""
        return engine_of(self.engine, *make(), max(1, runs // 3))

    def do(
        self, job: Job, rows: Rows, count: int, compiled: bool, chunk: int, told: Progress | None
    ) -> dict[str, Array]:
        """Return the arrays of all rows."""
        threads = (self.threads or available_cores()) if compiled else 1
        share = -(-count // (4 * (self.workers or threads) * chunk))
        store = MemoryStore(count, chunk * min(max(share, 1), 32), job.shapes)
        failed = run_chunks(
            job,
            lru_cache(64)(rows),
            store,
            executor=self.executor,
            threads=threads,
            progress=told,
        )
        if failed:
            died = "a process that did the runs died: " if self.executor else ""
            raise FflinError(f"{died}{failed[0].reason}")
        return store.arrays
