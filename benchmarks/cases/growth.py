"""A single linearisation at rest, as the robot grows."""

from benchmarks.cases.at_rest import fflin_call
from benchmarks.comparison import compare
from benchmarks.robots import Point, generated, random_point
from benchmarks.tables import Table

SIZES = (10, 30, 100, 300)
BEYOND_30 = ("adam",)
BEYOND_100 = (
    *BEYOND_30,
    "MuJoCo mjd_transitionFD",
    "Drake FirstOrderTaylorApproximation",
)


def run() -> Table:
    return compare(
        "at_rest",
        "Growth with the number of joints",
        "One linearisation at rest of generated robots: chains, and trees with two joints on "
        "every link. The columns of the peers are their times divided by fflin's.",
        (random_point(generated(kind, n)) for kind in ("chain", "tree") for n in SIZES),
        fflin_call,
        too_slow=_too_slow,
    )


def _too_slow(point: Point) -> tuple[str, ...]:
    if point.robot.n > 100:
        return BEYOND_100
    return BEYOND_30 if point.robot.n > 30 else ()
