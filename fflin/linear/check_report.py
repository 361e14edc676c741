"""Report of a check, as tables."""

from typing import NamedTuple

from fflin.base.tables import folded, grid, width


class Row(NamedTuple):
    """One error of a check, with its tolerance."""

    test: str
    block: str
    error: float
    tolerance: float

    @property
    def ok(self) -> bool:
        """Whether the error is within the tolerance; False if the error is NaN."""
        return self.error <= self.tolerance


def check_report(every: tuple[Row, ...], title: str) -> str:
    """Show the verdict of a check, a table of blocks, and the single figures."""
    states = ("q_b", "r_b", "q_m", "omega_b", "v_b", "qdot_m")
    blocks = [row.block for row in every]
    inputs = dict.fromkeys(b[:-1].split(", ")[1] for b in blocks if b.startswith("B["))
    parts = [_verdict(every), folded([f"{title}, {len(every)} figures"])]
    columns = {f"A[{{}}, {each}]": each for each in states}
    columns |= {f"B[{{}}, {each}]": each for each in inputs}
    found: dict[str, dict[str, Row]] = {
        route: {row.block: row for row in every if row.test == test}
        for test, route in _ROUTES.items()
    }
    allowed = [
        f"{route}: {test} (allowed {_allowed(found[route])})" for test, route in _ROUTES.items()
    ]
    body = [
        [route, state, *(_error(rows[key.format(state)]) for key in columns)]
        for route, rows in found.items()
        for state in states
        if any(rows[key.format(state)].error for key in columns)
    ]
    if not body:
        said = f"A and B compared with {' and '.join(_ROUTES)}: no difference in any of "
        parts.append(folded([f"{said}{len(states) * len(columns)} blocks"]))
    else:
        heads = [["", "", *columns.values()], *body]
        said = f"relative errors of the blocks of A and B compared with {', '.join(allowed)}; "
        said += "a dot is an error of exactly zero"
        parts.append(f"{folded([said])}\n\n{_fitted(heads, 2 + len(states))}")
    single = [row for row in every if row.test not in _ROUTES]
    rest = [["figure", "error", "allowed"]]
    rest += [[f"{r.test}: {r.block}", _error(r), f"{r.tolerance:.1e}"] for r in single if r.error]
    if rest[1:]:
        parts.append(grid(rest, "l"))
    exact: dict[str, list[str]] = {}
    for row in single:
        if not row.error:
            exact.setdefault(row.test, []).append(row.block)
    if exact:
        said = "; ".join(f"{test} {', '.join(each)}" for test, each in exact.items())
        parts.append(folded([f"without any error: {said}"]))
    return "\n\n".join(parts)


# The independent computations that A and B are compared with, and the rows of each.
_ROUTES = {"ABA derivatives": "ABA", "differences": "diff"}


def _verdict(every: tuple[Row, ...]) -> str:
    failures = [row for row in every if not row.ok]
    if not failures:
        largest = max(every, key=lambda row: row.error)
        said = f"largest error {largest.error:.1e} (allowed {largest.tolerance:.1e})"
        return folded([f"A and B hold: {said}"])
    names = [f"{row.block} ({row.test})" for row in failures[:6]]
    names += ["..."] * (len(failures) > 6)
    said = f"{len(failures)} of {len(every)} figures FAILED"
    return folded([f"A and B do not hold: {said}: {', '.join(names)}"])


def _allowed(rows: dict[str, Row]) -> str:
    return f"{next(iter(rows.values())).tolerance:.1e}"


def _fitted(rows: list[list[str]], split: int) -> str:
    """Show a table, or its columns from `split` on below where it is too wide."""
    table = grid(rows, "ll")
    if max(map(len, table.splitlines())) <= width():
        return table
    halves = [row[:split] for row in rows], [[*row[:2], *row[split:]] for row in rows]
    return "\n\n".join(grid([each[0], *filter(_told, each[1:])], "ll") for each in halves)


def _told(row: list[str]) -> bool:
    return any(cell != "." for cell in row[2:])


def _error(row: Row) -> str:
    text = "." if row.error == 0.0 else f"{row.error:.0e}"
    return text if row.ok else f"{text}!"
