"""Ten thousand linearisations at rest in one sweep."""

import tracemalloc

import numpy as np
import pinocchio as pin

import fflin
from benchmarks.peers import WrongResultError
from benchmarks.robots import load
from benchmarks.tables import Table, figure
from benchmarks.timing import interleaved

NAMES = ("cubesat", "ur5", "panda", "servicer_7dof", "talos")
COUNT, CHECKED = 10_000, 200


def run() -> Table:
    rows = []
    for name in NAMES:
        robot = load(name)
        model, data = robot.model, robot.create_data()
        q = fflin.random_configurations(robot, COUNT, seed=0).rows(0, COUNT)
        points = list(q)
        size = _checked(robot, q)
        tracemalloc.start()
        fflin.sweep(robot, q, threads=1)
        memory = tracemalloc.get_traced_memory()[1] / size
        tracemalloc.stop()

        def one(robot: fflin.Robot = robot, q: np.ndarray = q) -> None:
            fflin.sweep(robot, q, threads=1)

        def two(robot: fflin.Robot = robot, q: np.ndarray = q) -> None:
            fflin.sweep(robot, q, threads=2)

        def bare(
            model: pin.Model = model,
            data: pin.Data = data,
            points: list[np.ndarray] = points,
        ) -> None:
            for point in points:
                pin.computeMinverse(model, data, point)

        times = interleaved({"one": one, "two": two, "bare": bare})
        own = times["one"]
        rows.append(
            (
                name,
                str(robot.n),
                figure(own.least / COUNT * 1e6),
                figure(own.ratio(times["bare"])),
                figure(own.ratio(times["two"])),
                figure(memory),
            )
        )
    return Table(
        "Batch",
        f"A sweep of {COUNT:,} random configurations at rest on one thread. The columns are the "
        "time per point, its ratio to pin.computeMinverse called for one point after the other "
        "without checks or reordering, the speed-up by two threads, and the peak memory divided "
        "by the size of the result.",
        (
            *("robot", "n", "fflin [us a point]", "fflin / computeMinverse"),
            *("two threads", "memory / result"),
        ),
        tuple(rows),
    )


def _checked(robot: fflin.Robot, q: np.ndarray) -> int:
    """Hold rows of the sweep against `linearize`, by the mobilities; return its bytes."""
    batch = fflin.sweep(robot, q)
    linearizer = fflin.Linearizer(robot)
    for row in range(0, COUNT, COUNT // CHECKED):
        exact = linearizer(q[row])
        lower, sizes = exact.B[6 + robot.n :], np.sqrt(exact.M.diagonal())
        mobility = np.sqrt(lower.diagonal())
        error = np.abs(
            (batch.B_lower[row] - lower) / np.outer(mobility, mobility)
        ).max()
        if not error < 1e-12 * np.linalg.cond(exact.M / np.outer(sizes, sizes)):
            raise WrongResultError(
                f"sweep of {robot.name}: row {row} differs by {error:.1e}"
            )
    return int(batch.B_lower.nbytes)
