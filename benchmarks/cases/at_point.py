"""A single linearisation at an operating point: moving, with inputs that are not zero."""

import fflin
from benchmarks.comparison import Call, compare
from benchmarks.robots import NAMES, Point, load, random_point
from benchmarks.tables import Table


def run() -> Table:
    return compare(
        "at_point",
        "One linearisation at an operating point",
        "Random joint positions, velocities and inputs. The column fflin shows its time. The other "
        "columns show the times of the other tools divided by the time of fflin.",
        (random_point(load(name)) for name in NAMES),
        fflin_call,
        in_readme=True,
    )


def fflin_call(point: Point) -> Call:
    linearizer = fflin.Linearizer(point.robot)
    q, v, u = point.q, point.v, point.u

    def call() -> None:
        lin = linearizer(q, v, u)
        lin.A, lin.B  # noqa: B018 - what a caller would take

    return call
