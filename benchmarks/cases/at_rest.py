"""A single linearisation at rest."""

import fflin
from benchmarks.comparison import Call, compare
from benchmarks.robots import NAMES, Point, load, random_point
from benchmarks.tables import Table


def run() -> Table:
    return compare(
        "at_rest",
        "One linearisation at rest",
        "The columns show the time of fflin, the ratio of this time to a lower bound (crba, dpotrf "
        "and dpotri called by hand), and the times of the other tools divided by the time of "
        "fflin. If such a ratio is above 1, fflin is faster. The column 'MuJoCo by hand' is a "
        "sequence of MuJoCo functions for kinematics, inertia, factorisation, solution and B, "
        "without checks, names or units.",
        (random_point(load(name)) for name in NAMES),
        fflin_call,
        in_readme=True,
    )


def fflin_call(point: Point) -> Call:
    linearizer, q = fflin.Linearizer(point.robot), point.q

    def call() -> None:
        lin = linearizer(q)
        lin.A, lin.B  # noqa: B018 - what a caller would take

    return call
