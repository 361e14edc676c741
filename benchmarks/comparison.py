"""One linearisation by fflin and by every peer, timed side by side."""

from collections.abc import Callable, Iterable

from benchmarks.peers import methods
from benchmarks.peers.pinocchio_peer import FLOOR
from benchmarks.robots import Point
from benchmarks.tables import Table, figure
from benchmarks.timing import interleaved

FFLIN = "fflin"
Call = Callable[[], object]


def compare(
    what: str,
    title: str,
    about: str,
    points: Iterable[Point],
    fflin_call: Callable[[Point], Call],
    *,
    too_slow: Callable[[Point], tuple[str, ...]] = lambda point: (),
    in_readme: bool = False,
) -> Table:
    """Make a table: fflin's time [us], and every peer's as a multiple of it.

    Parameters
    ----------
    what : {"at_rest", "at_point"}
        Which of the peers' functions.
    points : iterable of Point
        One row each.
    fflin_call : callable
        Makes what is timed of fflin.
    too_slow : callable
        Names of the methods or peers to leave out at a point.
    """
    rows: list[dict[str, str]] = []
    notes: dict[str, None] = {}
    columns = ["robot", "n", f"{FFLIN} [us]"]
    for point in points:
        found, said = methods(what, point, too_slow(point))
        notes |= dict.fromkeys(said)
        calls = {FFLIN: fflin_call(point)} | {
            method.name: method.call for method in found
        }
        times = interleaved(calls)
        own = times.pop(FFLIN)
        row = {"robot": point.robot.name, "n": str(point.robot.n)}
        row[f"{FFLIN} [us]"] = figure(own.least * 1e6)
        if FLOOR in times:
            row[f"{FFLIN} / ({FLOOR})"] = figure(own.ratio(times.pop(FLOOR)))
        row |= {name: figure(each.ratio(own)) for name, each in times.items()}
        columns += [name for name in row if name not in columns]
        rows.append(row)
    cells = tuple(
        tuple(row.get(name, figure(None)) for name in columns) for row in rows
    )
    return Table(title, about, tuple(columns), cells, tuple(notes), in_readme)
