"""Drake's Monte Carlo: each run has a plant of its own, since it draws no masses of contexts."""

import pinocchio as pin
from pydrake.common import RandomGenerator
from pydrake.systems.analysis import MonteCarloSimulation, Simulator
from pydrake.systems.framework import Context, System

from benchmarks.closed_loop import Loop
from benchmarks.contender import Contender
from benchmarks.dispersed import started
from benchmarks.peers.drake_loop import DrakeLoop
from benchmarks.peers.drake_peer import free_plant
from benchmarks.robots import BASE, Array, link_urdf, plain_urdf

REFUSALS = (RuntimeError,)


def campaign(loop: Loop, drawn: Array) -> Contender:
    """Return all runs, which start at rest."""
    here = DrakeLoop(loop.but(frame="world", held=True))
    urdf, base = plain_urdf(loop.robot), loop.robot.model.inertias[1]
    nominal, nq = link_urdf(BASE, base), here.here.nq
    ends: list[Array] = []

    def call() -> None:
        rows = iter(drawn)
        ends.clear()

        def make(_: RandomGenerator) -> Simulator:
            row = next(rows)
            factor = 1.0 + row[3]
            other = pin.Inertia(factor * base.mass, base.lever, factor * base.inertia)
            plant = free_plant(urdf.replace(nominal, link_urdf(BASE, other)))
            plant.SetDefaultPositions(here.state(started(loop, row))[:nq])
            return here.closed(plant)[0]

        def output(system: System, context: Context) -> float:
            ends.append(here.seen(context.get_continuous_state_vector().CopyToVector()))
            return 0.0

        MonteCarloSimulation(
            make, output, loop.duration, len(drawn), RandomGenerator(0)
        )

    return Contender("Drake, held", here.loop, call, lambda: ends)
