"""Text tables with aligned columns, wrapped to the width of the terminal."""

from __future__ import annotations

import shutil
import sys
import textwrap
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

from fflin.base.errors import MissingPackageError
from fflin.base.paragraphs import PARAGRAPH, first_paragraph

if TYPE_CHECKING:
    from pandas import DataFrame

    from fflin.base.validation import Array

MOST_ROWS, _SPARE = 20, 2  # rows of a cut table; up to _SPARE more are not cut

_GAP = "  "
_EPS = sys.float_info.epsilon


def width() -> int:
    """Return the number of columns of the terminal, or 80 if the output is not a terminal."""
    if not _on_terminal():
        return 80
    return shutil.get_terminal_size((80, 24)).columns


def folded(lines: Iterable[str]) -> str:
    """Wrap lines to the terminal's width, but not at no-break spaces; indent continuation lines."""
    wrap = textwrap.TextWrapper(width(), subsequent_indent="  ", break_on_hyphens=False)
    return "\n".join(map(wrap.fill, lines)).replace("\u00a0", " ")


def headed(command: str, report: str) -> str:
    """Put the name of a command before its report, and wrap the first paragraph again."""
    _, *rest = PARAGRAPH.split(report, maxsplit=1)
    return "\n".join([folded([f"{command}: {first_paragraph(report)}"]), *rest])


def cut(rows: Sequence[Sequence[str]], rest: str = "see -o") -> list[Sequence[str]]:
    """Cut a long table to its header and first rows; `rest` says where the other rows are."""
    left = len(rows) - 1 - MOST_ROWS
    if left <= _SPARE:
        return list(rows)
    empty_cells = [""] * (len(rows[0]) - 1)
    last = [f"... and {left} more, {rest}", *empty_cells]
    return [*rows[: 1 + MOST_ROWS], last]


def _on_terminal() -> bool:
    return sys.stdout is not None and sys.stdout.isatty()


def grid(rows: Sequence[Sequence[str]], align: str = "l") -> str:
    """Return rows of cells as text with aligned columns.

    The letters of `align`, "l" or "r", align the first columns left or right. All further columns
    are aligned right.
    """
    sizes = [max(map(len, column)) for column in zip(*rows, strict=True)]
    align = align.ljust(len(sizes), "r")
    lines = []
    for row in rows:
        cells = []
        for cell, size, side in zip(row, sizes, align, strict=True):
            padded = cell.ljust(size) if side == "l" else cell.rjust(size)
            cells.append(padded)
        cells[-1] = cells[-1].rstrip()
        lines.append(_GAP.join(cells).rstrip())
    return "\n".join(lines)


def matrix(
    values: Array, rows: Sequence[str], columns: Sequence[str], rest: str | None = None
) -> str:
    """Format a matrix with names of rows and columns; leave out rows and columns of zeros.

    "~0" stands for an entry that is only a rounding error. Columns that do not fit into the
    terminal's width follow below. If `rest` is given, they are left out, and `rest` says where they
    are.
    """
    text = [
        [_number(x, below) for x, below in zip(row, limits, strict=True)]
        for row, limits in zip(values.tolist(), rounding(values).tolist(), strict=True)
    ]
    # The columns in blocks that fit into the terminal's width. A block omits rows of zeros.
    label = max(map(len, rows))
    used = 0
    folds: list[list[int]] = []
    for j, name in enumerate(columns):
        if not values[:, j].any():
            continue
        size = len(_GAP) + max([len(name)] + [len(row[j]) for row in text])
        if not folds or used + size > width():
            folds.append([])
            used = label
        folds[-1].append(j)
        used += size
    left = sum(map(len, folds[1:]))
    blocks = []
    for fold in folds[:1] if rest else folds:
        shown = [i for i in range(len(rows)) if values[i, fold].any()]
        body = [[rows[i], *(text[i][j] for j in fold)] for i in shown]
        blocks.append(grid(cut([["", *(columns[j] for j in fold)], *body])))
    if rest and left:
        blocks.append(f"... and {counted(left, 'more column')}, {rest}")
    return "\n\n".join(blocks)


def rounding(values: Array) -> Array:
    """Estimate the rounding error of each entry of a matrix.

    The estimate is eps times the largest entry in the row or in the column, whichever is smaller.
    """
    sizes = abs(values)
    by_row: Array = _EPS * sizes.max(axis=1, initial=0.0)[:, None]
    return by_row.clip(max=_EPS * sizes.max(axis=0, initial=0.0))


def _number(x: float, below: float) -> str:
    if x == 0.0:
        return "."
    if abs(x) < below:
        return "~0"
    return f"{x:.5g}"


def counted(number: int, thing: str) -> str:
    """Return a number with its noun, in the plural if needed."""
    plural = "" if number == 1 else "s"
    return f"{number} {thing}{plural}"


def signals(
    title: str, values: Array, names: Sequence[str], units: Sequence[str]
) -> str:
    """Format the nonzero entries of a state, an input or a force, with their units."""
    # Lines may break between entries, but not at the spaces within an entry.
    entries = []
    for name, value, unit in zip(names, values.tolist(), units, strict=True):
        if not value:
            continue
        entry = f"{name}\xa0=\xa0{value:.6g}"
        if unit != "1":
            entry += f"\xa0{unit}"
        entries.append(entry)
    below = " " * (len(title) + 2)
    text = textwrap.fill(
        f"{title}: {', '.join(entries)}", width(), subsequent_indent=below
    )
    return text.replace("\xa0", " ")


def data_frame(columns: Sequence[str], rows: Array, index: str) -> DataFrame:
    """Return rows as a pandas data frame whose index is the column named `index`."""
    try:
        import pandas
    except ImportError:
        raise MissingPackageError(
            "to_pandas needs pandas; install it with: pip install pandas"
        ) from None
    table = pandas.DataFrame(rows, columns=list(columns))
    framed: DataFrame = table.set_index(index)
    return framed
