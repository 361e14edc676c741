"""Cost of a Riccati equation and of a whole regulator, as ratios to SciPy's general solver.

Run as ``OPENBLAS_NUM_THREADS=1 python benchmarks/lqr.py``. Each ratio is of the shortest of
interleaved repetitions in this one process, which what else the machine does disturbs least; both
residuals are measured the same way and shown.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import platform
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import scipy
from scipy.linalg import solve_continuous_are

import fflin
from fflin.control.optimal.riccati import Riccati, solve

sys.path.insert(0, str(Path(__file__).parents[1]))
from tests.support.robots import BUNDLED, random_tree


def shortest(*functions: Callable[[], object], repetitions: int = 60) -> list[float]:
    """Shortest time of each function [ms], their repetitions interleaved."""
    times: list[list[float]] = [[] for _ in functions]
    for _ in range(repetitions):
        for samples, function in zip(times, functions, strict=True):
            function()  # so that each finds its own data in the cache
            start = time.perf_counter()
            function()
            samples.append((time.perf_counter() - start) * 1e3)
    return [min(samples) for samples in times]


def bench(robot: fflin.Robot) -> None:
    rng = np.random.default_rng(0)
    lin = fflin.linearize(robot)
    nx, nu = lin.B.shape
    inertia = lin.M.diagonal()
    weights = {
        "identity": (np.eye(nx), np.eye(nu)),
        "Bryson": (np.diag(rng.uniform(0.05, 0.2, nx) ** -2), np.diag(inertia**-2)),
        "random": (
            np.diag(10 ** rng.uniform(-1, 1, nx)),
            np.diag(10 ** rng.uniform(-1, 1, nu)),
        ),
    }
    for label, (Q, R) in weights.items():
        found = solve(lin.A, lin.B, Q, R)
        P = solve_continuous_are(lin.A, lin.B, Q, R)
        theirs = Riccati(lin.A, lin.B, Q, R, None, 0.0).trial(0.5 * (P + P.T)).residual
        if found.method != "structured" or found.residual > theirs:
            sys.exit(f"{robot.name}: {label}: the general solver's residual is lower")
        general, own, whole = shortest(
            lambda: solve_continuous_are(lin.A, lin.B, Q, R),  # noqa: B023
            lambda: solve(lin.A, lin.B, Q, R),  # noqa: B023
            lambda: fflin.lqr(lin, Q, R),  # noqa: B023
        )
        print(
            f"{robot.name:<16}{robot.n:>3}  {label:<9}{general:>8.2f}{own:>8.3f}"
            f"{general / own:>7.1f}{general / whole:>7.1f}{theirs:>10.0e}{found.residual:>9.0e}"
        )


def main() -> None:
    warnings.simplefilter("ignore")
    cpu = platform.processor() or platform.machine()
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            cpu = next(
                line.split(":")[1].strip() for line in file if "model name" in line
            )
    except (OSError, StopIteration):
        pass
    print(f"{cpu}; Python {platform.python_version()}, ", end="")
    print(f"numpy {np.__version__}, scipy {scipy.__version__}, one thread")
    print(
        "general: scipy.linalg.solve_continuous_are; half: fflin's Riccati solver with poles,"
    )
    print(
        "residual and refinement; shortest times [ms]; ratios of the solver and of fflin.lqr\n"
    )
    print(
        f"{'robot':<16}{'n':>3}  {'weights':<9}{'general':>8}{'half':>8}{'ratio':>7}{'lqr':>7}"
        f"{'residual':>10}{'half':>9}"
    )
    for name in BUNDLED:
        bench(fflin.load(name))
    rng = np.random.default_rng(1)
    for n in (7, 15, 32):
        bench(random_tree(rng, n))


if __name__ == "__main__":
    main()
