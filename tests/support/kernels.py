"""Machine code for all workers of a run of the tests: made once, before they begin."""

import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

from fflin.kernel.compiled import available_cores

_START = """
import fflin
free = fflin.load("planar_detumble")
orbit = {"orbit": 700e3}
lags = {"inputs": [fflin.BaseTorque(lag=0.1)]}
options = {"duration": 0.02, "dt": 0.01, "engine": "compiled"}

def eight_runs(**changes):
    robot = free.replace(**changes)
    fflin.monte_carlo(robot, None, {"*.mass": 0.05}, runs=8, **options)

def one_run(**changes):
    fflin.simulate(free.replace(**changes), linear=False, **options)

def points(**changes):
    robot = free.replace(**changes)
    fflin.sweep(robot, [robot.neutral()])

"""
_CHANGES = ("", "**orbit", "**lags", "**lags, **orbit")
# Each call compiles one loop. Two processes have all loops of eight runs and all loops of one run,
# which call the same functions.
_CALLS = [
    f"{loop}({changes})" for changes in _CHANGES for loop in ("eight_runs", "one_run")
]
_CALLS += ["points()", "points(**orbit)"]


def wanted(selection: str, paths: list[str]) -> bool:
    """Return whether a selection of marks (`-m`) and paths takes the compiled tests in number.

    The tests of a few files compile the loops that they need.
    """
    whole = "tests" in {Path(path).name for path in paths}
    words = selection.split()
    taken = not words or ("compiled" in words and "not" not in words)
    return find_spec("numba") is not None and whole and taken


def prepare() -> None:
    """Compile what is not on disk yet, and wait for it."""
    count = min(available_cores(), len(_CALLS))
    programs = [_START + "\n".join(_CALLS[first::count]) for first in range(count)]
    started = [
        subprocess.Popen([sys.executable, "-W", "ignore", "-c", program])
        for program in programs
    ]
    for process in started:
        assert process.wait() == 0, (
            "the kernels were not compiled; the reason stands above"
        )
