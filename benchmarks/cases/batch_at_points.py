"""Many linearisations at operating points in one sweep."""

import numpy as np

import fflin
from benchmarks.peers import WrongResultError, methods
from benchmarks.robots import Array, load, random_point
from benchmarks.tables import Table, figure
from benchmarks.timing import interleaved

NAMES = ("cubesat", "ets_vii", "ur5", "panda", "servicer_7dof", "talos")
COUNT, CHECKED = 2000, 20
SLOW = ("drake", "adam")
ONE = "fflin one by one"


def run() -> Table:
    rows, notes, columns = [], dict[str, None](), [ONE]
    for name in NAMES:
        point = random_point(load(name))
        robot, rng = point.robot, np.random.default_rng(0)
        q = fflin.random_configurations(robot, COUNT, seed=0).rows(0, COUNT)
        v, u = rng.normal(size=(COUNT, robot.nv)), rng.normal(size=(COUNT, 6 + robot.n))
        _check(robot, q, v, u)
        linearizer = fflin.Linearizer(robot)
        found, said = methods("at_point", point, SLOW)
        notes |= dict.fromkeys(line for line in said if "too slow" not in line)
        calls = {method.name: method.call for method in found}

        def batch(
            robot: fflin.Robot = robot, q: Array = q, v: Array = v, u: Array = u
        ) -> None:
            fflin.sweep(robot, q, v, u, threads=1)

        def one(linearizer: fflin.Linearizer = linearizer) -> None:
            linearizer(point.q, point.v, point.u)  # noqa: B023 - called before the next

        times = interleaved({"fflin": batch, ONE: one} | calls)
        own = times.pop("fflin").least / COUNT
        columns += [key for key in times if key not in columns]
        row = {key: figure(each.least / own) for key, each in times.items()}
        rows.append((name, robot.n, figure(own * 1e6), row))
    return Table(
        "Batch at operating points",
        f"A sweep of {COUNT:,} random configurations, velocities and inputs on one thread. The "
        "column fflin shows its time per point. The other columns show the time per call "
        "of each tool divided by the time of fflin per point. The other tools have no batch "
        "function.",
        ("robot", "n", "fflin [us a point]", *columns),
        tuple(
            (name, str(n), time, *(row.get(key, figure(None)) for key in columns))
            for name, n, time, row in rows
        ),
        tuple(notes),
        in_readme=True,
    )


def _check(robot: fflin.Robot, q: Array, v: Array, u: Array) -> None:
    """Hold rows of the sweep against `linearize`."""
    batch = fflin.sweep(robot, q, v, u)
    linearizer = fflin.Linearizer(robot)
    for row in range(0, COUNT, COUNT // CHECKED):
        one = linearizer(q[row], v[row], u[row])
        allowed = 1e-12 * one.certificate.condition
        for found, exact in (
            (batch.A[row], one.A),
            (batch.B_lower[row], one.B[6 + robot.n :]),
        ):
            if not np.abs(found - exact).max() < allowed * np.abs(exact).max():
                raise WrongResultError(f"sweep of {robot.name}: row {row} differs")
