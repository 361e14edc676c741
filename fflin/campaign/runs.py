"""Computation of the runs in chunks: eight at a time compiled, or one by one in Python."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from concurrent.futures import Executor
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from fflin.base.errors import FflinError
from fflin.base.validation import Array
from fflin.batch.dispatch import ChunkResult, Rows
from fflin.batch.run import Progress, run_chunks
from fflin.batch.store import MemoryStore
from fflin.campaign.dispersion_files import placed
from fflin.campaign.dispersions import Dispersions, Draws
from fflin.campaign.tally import KINDS, Outcome, Tally, stop_of
from fflin.dynamics.state_rows import states_of
from fflin.kernel.compiled import available_cores
from fflin.kernel.tree import LANES, batch_tree
from fflin.robot.robot import Robot
from fflin.simulation.compiled import engine_of
from fflin.simulation.jacobi import conserved_by
from fflin.simulation.motion import Motion
from fflin.simulation.plan import Plan, law_of, planned
from fflin.simulation.plant import Plant
from fflin.simulation.run import Recording, go
from fflin.simulation.simulate import motion_of

ARRAYS = Outcome._fields


class CampaignJob:
    """Runs of a plan with what is drawn; see `Job`."""

    def __init__(
        self, robot: Robot, policy: Any, given: Any, seed: int, engine: str, options: Any
    ) -> None:
        self._again: Any = partial(_made, robot, policy, given, seed, options=options)
        histories = (options := dict(options)).pop("histories", 0)
        self.plan, self.plant = planned(robot, policy, linear=False, progress=False, **options)
        self.engine, state = engine, self.plant.state
        self.x0 = state.read(self.plan.q, self.plan.v, near=self.plan.near)
        self.home, self._way = self.x0 if self.plan.target is None else self.plan.target, []
        if follows := self.plan.reference:
            t = self.plan.times.dt * np.arange(self.plan.times.steps + 1)
            q, v, _ = map(np.array, zip(*map(follows, t.tolist()), strict=True))
            self.home = states_of(state, q, nu := state.velocities(v))
            self._way = [q.ravel(), nu.ravel()]
        with placed(given):
            self.dispersions = Dispersions(
                given, self.plant, self.plan.policy, self.x0, seed, self.plan.times
            )
        spread = np.linspace(0.0, self.plan.times.steps, histories)
        self.steps = np.unique(spread.round().astype(int))

    def __reduce__(self) -> tuple[Any, ...]:
        # What is bound to the robot is made anew by a worker.
        return partial(self._again, engine=self.engine), ()

    def choose(self, engine: Any) -> None:
        """Settle which loop does the runs."""
        self.engine = engine_of(engine, self.plan, self.plant, many=True)

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Shape of each array of a run's outcome."""
        robot, nx, nu = self.plant.robot, self.plant.state.nx, len(self.plan.initial)
        sizes = [(size,) for size in (robot.nq, robot.nv, nx, nu, nx, nu, *[len(KINDS)] * 3)]
        histories = [(len(self.steps), size) for size in (len(KINDS), nu)]
        return dict(zip(ARRAYS, [*sizes, *histories, (), ()], strict=True))

    def run(self, rows: Draws, start: int, out: Mapping[str, Array] | None = None) -> ChunkResult:
        """Do some runs."""
        drawn, count = np.asarray(rows.drawn), len(rows.drawn)
        if out is None:
            out = {key: np.empty((count, *shape)) for key, shape in self.shapes.items()}
        if self.engine == "compiled":
            self._compiled(drawn, out)
        else:
            for row in range(count):
                for key, values in self._one(drawn[row])._asdict().items():
                    out[key][row] = values[0]
        return ChunkResult(dict(out), [])

    def _compiled(self, drawn: Array, out: Mapping[str, Array]) -> None:
        from fflin.campaign.lanes import Lanes

        tree = batch_tree(self.plant.robot)
        assert tree is not None
        runs = self.dispersions.in_lanes(drawn, tree)
        lanes, tally = Lanes(self.plan, self.plant, runs), self._tally(LANES)
        for first in range(0, len(drawn), LANES):
            eight, own = (
                {key: each[first : first + LANES] for key, each in of.items()} for of in (runs, out)
            )
            lanes.fly(eight, tally.copy(), own)

    def _tally(self, count: int) -> Any:
        if count == LANES:
            from fflin.campaign.lane_tally import LaneTally

            return LaneTally(self.plan, self.plant, self.home, self.steps, self._way)
        return Tally(self.plan, self.plant.state, self.home, count, self.steps)

    def plan_of(self, drawn: Array) -> tuple[Plan, Plant]:
        """Return the plan of a run (k,), and its robot."""
        plan, (plant, policy, q, v) = self.plan, self.dispersions.one(drawn)
        law = law_of(policy, plant, plan.limits, plan.times)
        times = plan.times._replace(delay=int(self.dispersions.delays(drawn[None])[0]))
        return replace(plan, q=q, v=v, policy=policy, law=law, times=times), plant

    @np.errstate(over="ignore", invalid="ignore")  # of what diverges
    def _one(self, drawn: Array) -> Outcome:
        plan, plant = self.plan_of(drawn)
        run = self._gone(replace(plan, times=plan.times._replace(every=1)), plant)
        nu = plant.state.velocities(run.v)
        tally = self._tally(1).add(0, [each[:, None] for each in (run.q, nu, run.u)])
        stop = np.array([float(stop_of(run.stopped))])
        return tally.outcome(run.steps, stop)

    def _gone(self, plan: Plan, plant: Plant) -> Recording:
        run = go(plan, plant, conserved_by(plant.robot, plan.q, plant.field))
        if run.stopped.startswith("interrupted"):
            raise KeyboardInterrupt
        return run

    def replay(self, drawn: Array) -> Motion:
        """Return the motion of a run, by the same instructions."""
        plan, plant = self.plan_of(drawn)
        if self.engine == "python":
            return motion_of(plan, plant, "python", self._gone(plan, plant))
        return motion_of(plan, plant, "compiled", self._recorded(drawn, plan, plant))

    def courses(self, drawn: Array, most: int) -> list[Array]:
        """Return some configurations (rows, nq) on the way of runs (N, k), and the last of each."""
        times, found = self.plan.times, list[Array]()
        every = -(-times.steps // most)
        if self.engine == "python":
            for plan, plant in map(self.plan_of, drawn):
                rare = replace(plan, times=times._replace(every=every))
                found.append(self._gone(rare, plant).q)
            return found
        for first in range(0, len(drawn), LANES):
            (q, *_), out, *_ = self._watched(drawn[first : first + LANES], every)
            counts = -(-(out["end"] / times.dt).round().astype(int) // every)
            ends = zip(counts, out["q"], strict=True)
            found += [np.vstack((q[:count, lane], end)) for lane, (count, end) in enumerate(ends)]
        return found

    def _watched(self, drawn: Array, every: int) -> tuple[Any, Any, str, Any]:
        """Return rows (steps, lanes, ..) of up to eight runs, and how and why these ended."""
        from fflin.campaign.lanes import Lanes

        tree, kept = batch_tree(self.plant.robot), list[list[Array]]()
        assert tree is not None
        runs = self.dispersions.in_lanes(drawn, tree)
        lanes = Lanes(self.plan, self.plant, runs)

        def watch(first: int, rows: list[Array]) -> None:
            kept.append([each[-first % every :: every].copy() for each in rows])

        out = {key: np.empty((len(drawn), *shape)) for key, shape in self.shapes.items()}
        said = lanes.fly(runs, self._tally(LANES), out, watch)
        return list(map(np.concatenate, zip(*kept, strict=True))), out, said[0], lanes

    def _recorded(self, drawn: Array, plan: Plan, plant: Plant) -> Recording:
        """Return the recording of a run that goes in all lanes."""
        every, state = plan.times.every, plant.state
        rows, out, said, lanes = self._watched(np.tile(drawn, (LANES, 1)), every)
        rows, end = [each[:, 0] for each in rows], float(out["end"][0])
        t = every * plan.times.dt * np.arange(len(rows[0]))
        if not said.startswith("diverged"):
            last = out["q"][0], state.velocities(out["v"][0]), out["u"][0], *lanes.kept(end)
            rows, t = [np.vstack(x) for x in zip(rows, last, strict=True)], np.append(t, end)
        q, nu, u, momentum, center = rows
        parts = (t, q, state.spread(nu), u, momentum, center, round(end / plan.times.dt), said)
        return Recording(*parts, "compiled")


def _made(*arguments: Any, **more: Any) -> CampaignJob:
    """Make a job in a worker, which has nobody to warn."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return CampaignJob(*arguments, **more)


def done_by(
    job: Any,
    rows: Rows,
    count: int,
    executor: Executor | None = None,
    workers: int | None = None,
    threads: int | None = None,
    progress: Progress | None = None,
    least: int = LANES,
) -> dict[str, Any]:
    """Return the arrays of all rows of a job, in chunks of `least` or some more."""
    threads = (threads or available_cores()) if job.engine == "compiled" else 1
    share = -(-count // (4 * (workers or threads) * least))
    store = MemoryStore(count, least * min(max(share, 1), 32), job.shapes)
    failed = run_chunks(job, rows, store, executor=executor, threads=threads, progress=progress)
    if failed:
        died = "a worker process died: " if executor else ""
        raise FflinError(f"{died}{failed[0].reason}")
    return dict(store.arrays)
