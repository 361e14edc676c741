"""Many runs of a closed loop, each with a start and a mass of its own."""

import fflin
from benchmarks.closed_loop import Loop
from benchmarks.contender import Contender
from benchmarks.robots import Array

# A normal's standard deviation, and the least and largest of a uniform: of the mass, relative, and
# with it the inertia.
SPREADS = {"q_b": 0.05, "base.density": (-0.1, 0.1)}


def draws(loop: Loop, runs: int) -> Array:
    """Return what is added to q_b and to the mass of each run (runs, 4)."""
    brief = loop.but(duration=loop.dt)
    return fflin.monte_carlo(
        brief.robot, brief.policy, SPREADS, runs=runs, **brief.options
    ).drawn


def started(loop: Loop, drawn: Array) -> Array:
    """Return the start (nx,) of a run."""
    x0 = loop.x0.copy()
    x0[:3] += drawn[:3]
    return x0


def fflin_campaign(name: str, loop: Loop, runs: int, **how: int) -> Contender:
    """Return fflin's runs, on one thread but where `how` has threads or workers."""
    kept: dict[str, fflin.Campaign] = {}
    options = {
        "runs": runs,
        "engine": "compiled",
        **(how or {"threads": 1}),
        **loop.options,
    }

    def call() -> None:
        kept["last"] = fflin.monte_carlo(loop.robot, loop.policy, SPREADS, **options)

    return Contender(name, loop, call, lambda: kept["last"].x)
