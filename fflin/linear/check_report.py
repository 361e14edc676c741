"""Report of a check, as tables."""

import textwrap
from typing import NamedTuple

from fflin.base.tables import grid, width


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
    """Return the report of a check: a table for each computation, single errors, the verdict."""
    states = ("q_b", "r_b", "q_m", "omega_b", "v_b", "qdot_m")
    blocks = [row.block for row in every]
    inputs = dict.fromkeys(b[:-1].split(", ")[1] for b in blocks if b.startswith("B["))
    parts = [f"check of {title}\na dot means an error of exactly zero"]
    for test in ("ABA derivatives", "differences"):
        rows = {row.block: row for row in every if row.test == test}
        tolerance = next(iter(rows.values())).tolerance
        title = f"A and B against {test}: "
        if not any(row.error for row in rows.values()):
            parts.append(f"{title}all {len(rows)} blocks are equal")
            continue
        body = [
            [
                state,
                *(_error(rows[f"A[{state}, {column}]"]) for column in states),
                *(_error(rows[f"B[{state}, {column}]"]) for column in inputs),
            ]
            for state in states
        ]
        parts.append(f"{title}relative error of each block, at most {tolerance:.1e}")
        parts.append(grid([["", *states, *inputs], *body]))
    single = [r for r in every if r.test not in ("ABA derivatives", "differences")]
    rest = [[f"{r.test}: {r.block}", _error(r), f"at most {r.tolerance:.1e}"] for r in single]
    parts.append(grid(rest, "lrl"))
    failures = [row for row in every if not row.ok]
    if not failures:
        largest = max(row.error for row in every)
        verdict = f"OK: all {len(every)} errors are within tolerance; the largest is {largest:.1e}"
    else:
        names = [f"{row.block} ({row.test})" for row in failures[:6]]
        names += ["..."] * (len(failures) > 6)
        verdict = (
            f"FAILED: {len(failures)} of {len(every)} errors exceed their tolerance: "
            f"{', '.join(names)}"
        )
    parts.append(textwrap.fill(verdict, width()))
    return "\n\n".join(parts)


def _error(row: Row) -> str:
    text = "." if row.error == 0.0 else f"{row.error:.0e}"
    return text if row.ok else f"{text}!"
