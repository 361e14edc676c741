"""How the cost of each task grows with the number of joints.

Run as ``python -m benchmarks.scaling [--sizes 10 30 60 100 200] [--kind chain]``. Each cell is the
CPU time of one call in milliseconds, the shortest of a few calls. The last two columns are the
exponents e of a cost proportional to n^e: by least squares over all sizes, and between the last
two. The rows of SciPy are the costs of its general solvers for the Riccati equation of the row
above. They are nan if SciPy finds no solution, as for long chains that are sampled.
"""

import argparse
import os
import time
import warnings
from collections.abc import Callable

os.environ |= {
    f"{name}_NUM_THREADS": "1" for name in ("OMP", "OPENBLAS", "MKL", "NUMBA")
}

import numpy as np
from scipy.linalg import solve_continuous_are, solve_discrete_are

import fflin
from benchmarks.robots import generated

SIZES = (10, 20, 40, 60, 80, 100, 140, 200)
STIFFNESS = 100.0  # [N m/rad] of every joint, for the modes
STEPS = 20  # of a simulation, at rest with a rotating base
SAMPLE = 0.01  # [s], of the sampled regulator
POINTS = 8  # of a sweep, which are computed together
SECONDS = 1.0  # a call that takes longer is not repeated

Tasks = dict[str, Callable[[], object]]


def tasks(kind: str, n: int) -> Tasks:
    """Return the tasks on a robot of n revolute joints, each a call without arguments."""
    robot = generated(kind, n)
    springs = dict.fromkeys(robot.joint_names, STIFFNESS)
    lin, sprung = (
        fflin.linearize(robot),
        fflin.linearize(robot.replace(stiffness=springs)),
    )
    Q, R = np.eye(len(lin.A)), np.eye(lin.B.shape[1])
    q = np.tile(robot.neutral(), (POINTS, 1))
    q[:, 7] = np.linspace(-0.5, 0.5, POINTS)
    v = np.zeros(robot.nv)
    v[3:6] = 0.05, -0.02, 0.03

    def motion() -> object:
        options = {
            "duration": 1e-3 * STEPS,
            "dt": 1e-3,
            "engine": "python",
            "linear": False,
        }
        return fflin.simulate(robot, v0=v, **options)

    def riccati() -> object:
        return solve_continuous_are(lin.A, lin.B, Q, R)

    sampled, cost = lin.discretize(SAMPLE), fflin.sampled_cost(lin, SAMPLE, Q, R)

    def sampled_riccati() -> object:
        return solve_discrete_are(sampled.A, sampled.B, cost.Q, cost.R, s=cost.N)

    return {
        "linearize": lambda: fflin.linearize(robot),
        "linearize, rotating": lambda: fflin.linearize(robot, v=v),
        "check": lambda: fflin.check(robot, lin),
        "controllability": lambda: fflin.controllability(lin),
        "lqr": lambda: fflin.lqr(lin, Q, R),
        "SciPy's Riccati solver": riccati,
        "lqr, sampled": lambda: fflin.lqr(sampled, *cost),
        "SciPy's, sampled": sampled_riccati,
        "lqr, margins printed": lambda: str(fflin.lqr(lin, Q, R)),
        "modes": lambda: fflin.modes(sprung),
        f"simulate, {STEPS} steps": motion,
        f"sweep, {POINTS} points": lambda: fflin.sweep(robot, q, engine="python"),
    }


def shortest(call: Callable[[], object], repetitions: int = 3) -> float:
    """Return the shortest CPU time of a call [s], or nan if SciPy finds no solution."""
    times: list[float] = []
    for _ in range(repetitions):
        start = time.process_time()
        try:
            call()
        except (ValueError, np.linalg.LinAlgError):
            return np.nan
        times.append(time.process_time() - start)
        if times[-1] > SECONDS:
            break
    return min(times)


def exponent(sizes: list[int], seconds: list[float]) -> float:
    """Return e of the power law n^e that fits the times, or nan if a time is nan."""
    if not np.isfinite(seconds).all():
        return np.nan
    return float(np.polyfit(np.log(sizes), np.log(np.maximum(seconds, 1e-6)), 1)[0])


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.scaling", description=__doc__
    )
    parser.add_argument("--sizes", type=int, nargs="+", default=SIZES)
    parser.add_argument("--kind", choices=("chain", "tree"), default="chain")
    arguments = parser.parse_args()
    # long chains are ill-conditioned, which is the subject here
    warnings.simplefilter("ignore")
    for call in tasks(arguments.kind, 5).values():
        call()  # imports and compiles what is needed
    times: dict[str, list[float]] = {}
    sizes = sorted(arguments.sizes)
    for n in sizes:
        for name, call in tasks(arguments.kind, n).items():
            times.setdefault(name, []).append(shortest(call))
    print(
        f"{arguments.kind} of n revolute joints: CPU time [ms], one thread, exponent of n\n"
    )
    heads = [f"{n:>9}" for n in sizes]
    print(f"{'n':<24}{''.join(heads)}{'all':>8}{'last':>8}")
    for name, seconds in times.items():
        cells = [f"{1e3 * each:>9.3g}" for each in seconds]
        fits = [exponent(sizes, seconds), exponent(sizes[-2:], seconds[-2:])]
        print(f"{name:<24}{''.join(cells)}{''.join(f'{each:>8.1f}' for each in fits)}")
    for theirs, name in (
        ("SciPy's Riccati solver", "lqr"),
        ("SciPy's, sampled", "lqr, sampled"),
    ):
        ratios = np.divide(times[theirs], times[name])
        title = f"SciPy / {name}"
        print(f"{title:<24}{''.join(f'{each:>9.2f}' for each in ratios)}")


if __name__ == "__main__":
    main()
