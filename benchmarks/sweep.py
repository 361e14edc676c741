"""Cost of a sweep at rest, as a ratio to Pinocchio's computeMinverse one after the other.

Run as ``OMP_NUM_THREADS=1 python benchmarks/sweep.py [N] [ROBOT ...]``. All figures are the least
of interleaved repetitions in this one process; 200 rows are held against `linearize` before.
"""

import os
import platform
import sys
import time
import tracemalloc
import warnings
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version

import numpy as np
import pinocchio as pin

import fflin

ROBOTS = ("cubesat", "ur5", "panda", "servicer_7dof", "talos")


def least(*functions: Callable[[], object], repetitions: int = 15) -> list[float]:
    """Least time of each function [s], their repetitions interleaved."""
    times: list[list[float]] = [[] for _ in functions]
    for _ in range(repetitions):
        for samples, function in zip(times, functions, strict=True):
            start = time.perf_counter()
            function()
            samples.append(time.perf_counter() - start)
    return [min(samples) for samples in times]


def checked(robot: fflin.Robot, q: np.ndarray) -> fflin.LinearBatch:
    """Return a sweep that was held against `linearize`, relative to each coordinate's mobility."""
    batch = fflin.sweep(robot, q)
    linearizer = fflin.Linearizer(robot)
    for row in range(0, len(q), max(1, len(q) // 200)):
        exact = linearizer(q[row])
        lower = exact.B[6 + robot.n :]
        mobility = np.sqrt(lower.diagonal())
        error = np.abs((batch.B_lower[row] - lower) / np.outer(mobility, mobility)).max()
        scaled = exact.M / np.sqrt(np.outer(exact.M.diagonal(), exact.M.diagonal()))
        if error > 1e-12 * np.linalg.cond(scaled):
            sys.exit(f"{robot.name}: wrong result at row {row}: {error:.1e}")
    return batch


def bench(name: str, count: int) -> str:
    robot = fflin.load(name)
    model, data = robot.model, robot.create_data()
    q = fflin.random_configurations(robot, count, seed=0).rows(0, count)
    rows = list(q)
    batch = checked(robot, q)
    size = batch.B_lower.nbytes
    del batch
    tracemalloc.start()
    fflin.sweep(robot, q)
    memory = tracemalloc.get_traced_memory()[1] / size
    tracemalloc.stop()

    def loop() -> None:
        for row in rows:
            pin.computeMinverse(model, data, row)

    one, two, reference = least(
        lambda: fflin.sweep(robot, q, threads=1), lambda: fflin.sweep(robot, q, threads=2), loop
    )
    scale = 1e6 / count
    return (
        f"{name:<15}{robot.n:>4}{one * scale:>9.2f}{two * scale:>9.2f}{reference * scale:>9.2f}"
        f"{one / reference:>8.2f}{one / two:>8.2f}{memory:>8.2f}"
    )


def main() -> None:
    warnings.simplefilter("ignore", fflin.FflinWarning)
    arguments = sys.argv[1:]
    count = int(arguments.pop(0)) if arguments and arguments[0].isdigit() else 10_000
    try:
        numba = f"numba {version('numba')}"
    except PackageNotFoundError:
        numba = "no numba: the loop"
    print(
        f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores; Python "
        f"{platform.python_version()}, pin {pin.__version__}, numpy {np.__version__}, {numba}"
    )
    print(
        f"a whole sweep of {count} points [us a point] on one thread and on two, and\n"
        "pin.computeMinverse one after the other; ratio of the first to the last, of the first to\n"
        "the second, and peak memory to the result\n"
    )
    print(
        f"{'robot':<15}{'n':>4}{'one':>9}{'two':>9}{'pin':>9}{'ratio':>8}{'speedup':>8}{'memory':>8}"
    )
    for name in arguments or ROBOTS:
        print(bench(name, count), flush=True)


if __name__ == "__main__":
    main()
