"""Cost of one step of a simulation, as a ratio to its four calls of Pinocchio's ABA.

Run as ``python benchmarks/simulate.py``. Each ratio is of the least times of interleaved
repetitions in this one process; the result is checked once before it is timed.
"""

import platform
import sys
import time
from collections.abc import Callable

import numpy as np
import pinocchio as pin

import fflin
from fflin.weights import default_weights

ROBOTS = ("ets_vii", "canadarm2", "servicer_7dof", "dual_arm", "talos")
STEPS, DT = 200, 1e-3


def least(*functions: Callable[[], object], repetitions: int = 15) -> list[float]:
    """Least time of each function [us], their repetitions interleaved."""
    times: list[list[float]] = [[] for _ in functions]
    for _ in range(repetitions):
        for samples, function in zip(times, functions, strict=True):
            start = time.perf_counter()
            function()
            samples.append((time.perf_counter() - start) * 1e6)
    return [min(samples) for samples in times]


def bench(name: str) -> tuple[int, float, list[float]]:
    robot = fflin.load(name)
    model, data = robot.model, robot.create_data()
    lin = fflin.linearize(robot)
    feedback = fflin.StateFeedback(lin, fflin.lqr(lin, *default_weights(lin)).K)
    q, v = robot.neutral(), 0.1 * np.random.default_rng(0).normal(size=robot.nv)
    tau = np.zeros(robot.nv)

    def calls() -> None:
        for _ in range(4 * STEPS):
            pin.aba(model, data, q, v, tau)

    def run(steps: int, policy: object = None, **options: object) -> Callable[[], fflin.Motion]:
        options = {"every": steps, "progress": False, "linear": False, **options}
        return lambda: fflin.simulate(robot, policy, v0=v, duration=steps * DT, dt=DT, **options)

    kept = run(STEPS)()
    if kept.momentum_drift.max() > 1e-14 or np.ptp(kept.energy) > 1e-9 * kept.energy[0]:
        sys.exit(f"{name}: wrong result")
    cases = [{"project": False}, {}, {"every": 1}, {"policy": feedback}]
    timed = [run(STEPS, **case) for case in cases]
    # A run of one step is what a run costs before and after its steps.
    around = [run(1, **{**case, "every": 1}) for case in cases]
    floor, *found = least(calls, *timed, *around)
    steps = [a - b for a, b in zip(found[: len(cases)], found[len(cases) :], strict=True)]
    return robot.n, floor / STEPS, [each / (STEPS - 1) for each in steps]


def main() -> None:
    print(
        f"{platform.machine()}; Python {platform.python_version()}, pin {pin.__version__}, "
        f"numpy {np.__version__}"
    )
    print("least times of a step of CF4 [us] and their ratios to four calls of pin.aba: without")
    print(
        "momentum projection; with it; each step recorded; under a feedback asked at each stage\n"
    )
    columns = ("plain", "projected", "recorded", "feedback")
    print(f"{'robot':<15}{'n':>3}{'4 aba':>8}" + "".join(f"{name:>13}" for name in columns))
    for name in ROBOTS:
        n, floor, steps = bench(name)
        shown = "".join(f"{each:>7.1f}{each / floor:>6.2f}" for each in steps)
        print(f"{name:<15}{n:>3}{floor:>8.1f}{shown}")


if __name__ == "__main__":
    main()
