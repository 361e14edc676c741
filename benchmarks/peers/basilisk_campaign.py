"""Basilisk's Monte Carlo by its Controller, in one process, with draws of its own.

No data are retained: it waits a second for those of each run. What is kept of a run is its end.
"""

import numpy as np
from Basilisk.utilities.MonteCarlo.Controller import Controller
from Basilisk.utilities.MonteCarlo.Dispersions import (
    NormalVectorCartDispersion,
    UniformDispersion,
)
from Basilisk.utilities.SimulationBaseClass import SimBaseClass

from benchmarks.closed_loop import Loop
from benchmarks.contender import Contender
from benchmarks.dispersed import SPREADS
from benchmarks.peers.basilisk_loop import BasiliskLoop, mrp_law
from benchmarks.robots import Array

REFUSALS = (ValueError,)
_HUB = "TaskList[0].TaskModels[1].hub"  # of the spacecraft, the second in the task


def campaign(loop: Loop, drawn: Array) -> Contender:
    """Return as many runs as there are draws."""
    loop = mrp_law(loop)
    ends: list[Array] = []
    hub = BasiliskLoop(loop).craft.hub
    attitude, mass = np.ravel(hub.sigma_BNInit).tolist(), hub.mHub
    least, largest = (mass * (1.0 + each) for each in SPREADS["base.density"])

    def make() -> SimBaseClass:
        here = BasiliskLoop(loop)
        here.simulation.owner = here
        return here.simulation

    def fly(simulation: SimBaseClass) -> None:
        simulation.owner.run()
        ends.append(simulation.owner.end())

    def call() -> None:
        ends.clear()
        controller = Controller()
        controller.setSimulationFunction(make)
        controller.setExecutionFunction(fly)
        controller.setExecutionCount(len(drawn))
        controller.setThreadCount(1)
        spread = [SPREADS["q_b"] / 2.0] * 3  # a parameter is half of q_b
        controller.addDispersion(
            NormalVectorCartDispersion(f"{_HUB}.sigma_BNInit", attitude, spread)
        )
        controller.addDispersion(UniformDispersion(f"{_HUB}.mHub", (least, largest)))
        if controller.executeSimulations():
            raise RuntimeError("runs of Basilisk's Controller failed")

    return Contender("Basilisk, held", loop, call, lambda: ends)
