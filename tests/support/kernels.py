"""Machine code for all workers of a run of the tests: made once, before they begin."""

import subprocess
import sys
from importlib.util import find_spec

# Two processes, for two cores. Each loads a robot and calls what its kernels serve. The second
# process also calls what the kernels for orbits serve.
_CALLS = (
    """
law = fflin.StateFeedback(lin, fflin.lqr(lin).K)
fflin.monte_carlo(robot, law, spread, runs=8, duration=0.02, dt=0.01, engine="compiled")
""",
    """
fflin.sweep(robot, [robot.neutral()])
robot = robot.replace(orbit=700e3)
fflin.sweep(robot, [robot.neutral()])
fflin.monte_carlo(robot, None, spread, runs=8, duration=0.02, dt=0.01, engine="compiled")
""",
)
_BEFORE = (
    "import fflin; robot = fflin.load('planar_detumble'); lin = fflin.linearize(robot); "
    "spread = {'*.mass': 0.05, 'q_b': 0.02}"
)


def wanted(selection: str) -> bool:
    """Return whether a selection of marks (`-m`) takes the compiled tests in number."""
    return find_spec("numba") is not None and selection in ("", "compiled")


def prepare() -> None:
    """Compile what is not on disk yet, and wait for it."""
    started = [
        subprocess.Popen([sys.executable, "-c", _BEFORE + calls]) for calls in _CALLS
    ]
    for process in started:
        assert process.wait() == 0, (
            "the kernels were not compiled; the reason stands above"
        )
