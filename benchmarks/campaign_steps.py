"""CPU time of a campaign step: with constraints, and in orbit, beside the robot without them.

``python -m benchmarks.campaign_steps`` prints ratios of the shortest CPU times of one thread. The
campaigns take turns, so that other load on the machine acts on all of them alike.
"""

import time
from collections.abc import Callable

import numpy as np
import pinocchio as pin

import fflin

RUNS, ROUNDS, DT = 64, 15, 0.1
DURATIONS = 5.0, 25.0  # [s] the difference is the time of the steps alone
BENT = {"left_1": 0.4, "left_2": 0.6, "right_1": -0.4, "right_2": -0.6}

Array = np.ndarray
Campaign = Callable[[float], object]


def constrained() -> dict[str, Campaign]:
    """Return campaigns of two arms, free and with a weld of six rows between their tools."""
    free = fflin.load("dual_arm")
    held = free.replace(constraints=[fflin.Weld("tool_right", "tool_left")])
    start = fflin.closed(held, fflin.configuration(free, BENT))
    rng = np.random.default_rng(0)
    q, v = fflin.closed(held, start, 0.02 * rng.normal(size=free.nv))
    return {"free": _campaign(free, q, v), "six rows": _campaign(held, q, v)}


def in_orbit() -> dict[str, Campaign]:
    """Return campaigns of one robot without an orbit, in a circular and in an elliptic orbit."""
    robot = fflin.load("ets_vii")
    orbits = {
        "no orbit": None,
        "circular": fflin.CircularOrbit(altitude=400e3),
        "elliptic": fflin.EllipticOrbit(perigee=400e3, apogee=2000e3),
    }
    return {
        name: _campaign(robot.replace(orbit=orbit)) for name, orbit in orbits.items()
    }


def _campaign(
    robot: fflin.Robot, q: Array | None = None, v: Array | None = None
) -> Campaign:
    def run(duration: float) -> object:
        return fflin.monte_carlo(
            robot,
            None,
            {"omega_b": 0.01},
            q0=q,
            v0=v,
            runs=RUNS,
            duration=duration,
            dt=DT,
            engine="compiled",
            threads=1,
        )

    return run


def step_times(campaigns: dict[str, Campaign]) -> dict[str, float]:
    """Return the CPU time [us] of one step of one run of each campaign."""
    best: dict[tuple[str, float], float] = {}
    for round_ in range(ROUNDS + 1):
        for name, run in campaigns.items():
            for duration in DURATIONS:
                begun = time.thread_time()
                run(duration)
                taken = time.thread_time() - begun
                if round_:  # the first round compiles
                    key = name, duration
                    best[key] = min(best.get(key, taken), taken)
    short, long = DURATIONS
    steps = RUNS * round((long - short) / DT)
    return {
        name: 1e6 * (best[name, long] - best[name, short]) / steps for name in campaigns
    }


def four_accelerations(robot: fflin.Robot) -> float:
    """Return the CPU time [us] of four calls of pin.aba from Python."""
    model, data = robot.model, robot.create_data()
    q, v = robot.neutral(), np.ones(robot.nv)
    calls, best = 1000, np.inf
    for _ in range(ROUNDS):
        begun = time.thread_time()
        for _ in range(4 * calls):
            pin.aba(model, data, q, v, v)
        best = min(best, time.thread_time() - begun)
    return 1e6 * float(best) / calls


def main() -> None:
    """Print the times and ratios."""
    for robot, campaigns in (("dual_arm", constrained()), ("ets_vii", in_orbit())):
        times = step_times(campaigns)
        accelerations = four_accelerations(fflin.load(robot))
        first = next(iter(times.values()))
        for name, each in times.items():
            print(
                f"{robot}, {name:<10}{each:7.2f} us, {each / first:5.2f} of the first, "
                f"{each / accelerations:5.2f} of four pin.aba"
            )


if __name__ == "__main__":
    main()
