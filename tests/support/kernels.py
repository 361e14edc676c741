"""Machine code for all workers of a run of the tests: made once, before they begin."""

import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

# Two processes, for two cores. A function of the kernel that several loops call is translated once
# in a process, so the second loop of a process takes about half of the time of the first one.
_ROBOTS = """
import fflin
free = fflin.load("planar_detumble")
orbit = {"orbit": 700e3}
held = {"constraints": [fflin.Weld("base", "link_1")]}
lags = {"inputs": [fflin.BaseTorque(lag=0.1)]}
changes = [{}, orbit, held, held | orbit, lags, lags | orbit]
robots = [free.replace(**change) for change in changes]
options = {"duration": 0.02, "dt": 0.01, "engine": "compiled"}
"""
_EIGHT_RUNS = """
for robot in robots:
    fflin.monte_carlo(robot, None, {"*.mass": 0.05}, runs=8, **options)
"""
_ONE_RUN = """
for robot in [*robots, free.replace(**held, **lags, **orbit)]:
    fflin.simulate(robot, **options)
for robot in robots[:2]:
    fflin.sweep(robot, [robot.neutral()])
"""


def wanted(selection: str, paths: list[str]) -> bool:
    """Return whether a selection of marks (`-m`) and paths takes the compiled tests in number.

    The tests of a few files compile the loops that they need.
    """
    whole = "tests" in {Path(path).name for path in paths}
    return find_spec("numba") is not None and whole and selection in ("", "compiled")


def prepare() -> None:
    """Compile what is not on disk yet, and wait for it."""
    started = [
        subprocess.Popen([sys.executable, "-W", "ignore", "-c", _ROBOTS + calls])
        for calls in (_EIGHT_RUNS, _ONE_RUN)
    ]
    for process in started:
        assert process.wait() == 0, (
            "the kernels were not compiled; the reason stands above"
        )
