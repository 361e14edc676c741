"""The runs of a campaign, chunk by chunk: eight at a time compiled, or one by one in Python."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from fflin.base.validation import Array
from fflin.batch.dispatch import ChunkResult
from fflin.campaign.dispersions import Dispersions, Draws
from fflin.campaign.tally import KINDS, Outcome, Tally, stop_of
from fflin.dynamics.state_rows import states_of
from fflin.kernel.tree import LANES, batch_tree
from fflin.robot.robot import Robot
from fflin.simulation.compiled import engine_of
from fflin.simulation.conservation import Conserved
from fflin.simulation.motion import Motion
from fflin.simulation.plan import Plan, law_of
from fflin.simulation.plant import Plant
from fflin.simulation.run import Recording, go
from fflin.simulation.simulate import motion_of, planned

ARRAYS = Outcome._fields


class CampaignJob:
    """Runs of a plan with what is drawn; see `Job`."""

    def __init__(
        self, robot: Robot, policy: Any, given: Any, seed: int, engine: str, options: Any
    ) -> None:
        self._again = partial(_made, robot, policy, given, seed, options=options)
        self.plan, self.plant = planned(robot, policy, linear=False, progress=False, **options)
        self.engine, state = engine, self.plant.state
        self.x0 = state.read(self.plan.q, self.plan.v, near=self.plan.near)
        self.home = self.x0 if self.plan.target is None else self.plan.target
        if follows := self.plan.reference:
            t = self.plan.times.dt * np.arange(self.plan.times.steps + 1)
            q, v, _ = map(np.array, zip(*map(follows, t.tolist()), strict=True))
            self.home = states_of(state, q, state.velocities(v))
        self.dispersions = Dispersions(
            given, self.plant, self.plan.policy, self.x0, seed, self.plan.times
        )

    def __reduce__(self) -> tuple[Any, ...]:
        # What is bound to the robot is made anew by a worker.
        return partial(self._again, engine=self.engine), ()

    def choose(self, engine: Any, runs: int) -> None:
        """Settle which loop does so many runs."""
        self.engine = engine_of(engine, self.plan, self.plant, runs)

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Shape of each array of a run's outcome."""
        robot, nx, nu = self.plant.robot, self.plant.state.nx, len(self.plan.initial)
        sizes = (robot.nq, robot.nv, nx, nu, nx, nu, *[len(KINDS)] * 3)
        return {
            **{key: (size,) for key, size in zip(ARRAYS, sizes, strict=False)},
            **{key: () for key in ARRAYS[len(sizes) :]},
        }

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
        lanes = Lanes(self.plan, self.plant, runs)
        for first in range(0, len(drawn), LANES):
            eight, own = (
                {key: each[first : first + LANES] for key, each in of.items()} for of in (runs, out)
            )
            lanes.fly(eight, self._tally(LANES), own)

    def _tally(self, count: int) -> Tally:
        return Tally(self.plan, self.plant.state, self.home, count)

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
        tally = self._tally(1).add(0, *(each[:, None] for each in (run.q, nu, run.u)))
        stop = np.array([float(stop_of(run.stopped))])
        return tally.outcome(run.steps, stop)

    def _gone(self, plan: Plan, plant: Plant) -> Recording:
        run = go(plan, plant, Conserved(plant.robot, plan.q))
        if run.stopped.startswith("interrupted"):
            raise KeyboardInterrupt
        return run

    def replay(self, drawn: Array) -> Motion:
        """Return the motion of a run, by the same instructions."""
        plan, plant = self.plan_of(drawn)
        if self.engine == "python":
            return motion_of(plan, plant, "python", self._gone(plan, plant))
        return motion_of(plan, plant, "compiled", self._recorded(drawn, plan, plant))

    def _recorded(self, drawn: Array, plan: Plan, plant: Plant) -> Recording:
        """Return the recording of a run that goes in all lanes."""
        from fflin.campaign.lanes import Lanes

        tree, every, kept = batch_tree(self.plant.robot), plan.times.every, list[list[Array]]()
        assert tree is not None
        runs = self.dispersions.in_lanes(np.tile(drawn, (LANES, 1)), tree)
        lanes = Lanes(self.plan, self.plant, runs)

        def watch(first: int, rows: list[Array]) -> None:
            kept.append([each[-first % every :: every, 0].copy() for each in rows])

        out = {key: np.empty((LANES, *shape)) for key, shape in self.shapes.items()}
        said = lanes.fly(runs, self._tally(LANES), out, watch)[0]
        t = every * plan.times.dt * np.arange(sum(len(each[0]) for each in kept))
        state, end = plant.state, float(out["end"][0])
        if not said.startswith("diverged"):
            nu = state.velocities(out["v"][0])
            kept.append([x[None] for x in (out["q"][0], nu, out["u"][0], *lanes.kept(end))])
            t = np.append(t, end)
        q, nu, u, momentum, center = map(np.concatenate, zip(*kept, strict=True))
        parts = (t, q, state.spread(nu), u, momentum, center, round(end / plan.times.dt), said)
        return Recording(*parts, "compiled")


def _made(*arguments: Any, **more: Any) -> CampaignJob:
    """Make a job in a worker, which has nobody to warn."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return CampaignJob(*arguments, **more)
