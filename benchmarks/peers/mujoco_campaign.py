"""MuJoCo, run after run in Python: its `rollout` on threads takes inputs, but no feedback."""

import mujoco
import numpy as np

from benchmarks.closed_loop import Loop
from benchmarks.contender import Contender
from benchmarks.dispersed import started
from benchmarks.peers.mujoco_loop import MujocoLoop
from benchmarks.robots import BASE, Array

REFUSALS = (ValueError,)


def campaign(loop: Loop, drawn: Array) -> Contender:
    here = MujocoLoop(loop.but(held=True))
    base = here.model.body(BASE)
    mass, inertia = base.mass.copy(), base.inertia.copy()
    ends = np.zeros((len(drawn), len(loop.x0)))

    def call() -> None:
        for row, end in zip(drawn, ends, strict=True):
            base.mass[:], base.inertia[:] = (
                (1.0 + row[3]) * mass,
                (1.0 + row[3]) * inertia,
            )
            mujoco.mj_setConst(here.model, here.data)
            here.start(started(loop, row))
            here.between_steps()
            end[:] = here.end()

    return Contender("MuJoCo, held", here.loop, call, lambda: ends)
