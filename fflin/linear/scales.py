"""Scales and rounding errors of reference matrices, with which `check` compares a linear model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from fflin.base.validation import Array, Indices

EPS = float(np.finfo(float).eps)

# Largest expected ratio of a rounding error to the largest of a few sampled rounding errors.
_SAFETY = 20.0

Blocks = Mapping[str, slice | Sequence[int] | Indices]


class Row(NamedTuple):
    """One error of a check, and the tolerance of the error."""

    test: str
    block: str
    error: float
    tolerance: float

    @property
    def ok(self) -> bool:
        """Whether the error is at most the tolerance; False if the error is NaN."""
        return self.error <= self.tolerance


class Reference(NamedTuple):
    """An independent matrix, the scale of each entry, and a bound of its rounding errors.

    The scale of an entry is the size to which its error is relative. It does not depend on the
    units of the rows and columns.
    """

    value: Array
    scale: Array
    rounding: Array

    def row(
        self, test: str, block: str, given: Array, where: tuple[Array, ...], least: float
    ) -> Row:
        """Compare a block of a given matrix; return the row of its worst entry.

        `where` selects the block, as `np.ix_` returns it. `least` is the tolerance without rounding
        errors.
        """
        scale = np.maximum(self.scale[where], self.rounding[where] / least)
        error = np.abs(given[where] - self.value[where]) / scale
        return Row(test, block, float(np.max(error, initial=0.0)), least)


def spread_over(rows: Blocks, x: Array, row_units: Array) -> Array:
    """Return, for each entry of x, the largest magnitude of the column in the same block of rows.

    `row_units` (k,) are the units in which the entries of a row are compared with other rows.
    """
    found = np.zeros_like(x)
    for at in rows.values():
        unit = row_units[at][:, None]
        found[at] = unit * (np.abs(x[at]) / unit).max(axis=0, initial=0.0)
    return found


def scales(
    rows: Blocks, columns: Blocks, x: Array, terms: Array, row_units: Array, column_units: Array
) -> Array:
    """Return the scale of each entry of a reference matrix x, whose terms have these magnitudes.

    The scale is the larger of the terms of the entry and of the largest entry of its column in the
    same block. If both are zero, it is the largest entry of the block. If the block is zero, the
    scale is one unit.
    """
    by_column = np.maximum(spread_over(rows, x, row_units), terms)
    by_block = block_scales(rows, columns, x, terms, row_units, column_units)
    return np.where(by_column > 0.0, by_column, by_block)


def block_scales(
    rows: Blocks, columns: Blocks, x: Array, terms: Array, row_units: Array, column_units: Array
) -> Array:
    """Return a common scale for all entries of each block, in the units of its rows and columns.

    The scale is the largest entry and the largest term of the block, or one unit if the block is
    zero.
    """
    units = np.outer(row_units, 1.0 / column_units)
    sizes = np.maximum(np.abs(x), terms) / units
    scale = np.ones_like(sizes)
    for row in rows.values():
        for column in columns.values():
            where = np.ix_(np.arange(len(x))[row], np.arange(x.shape[1])[column])
            scale[where] = float(sizes[where].max(initial=0.0)) or 1.0
    return scale * units


def sampled(rows: Blocks, value: Array, others: Sequence[Array], row_units: Array) -> Array:
    """Bound the rounding errors of a matrix that was computed several times."""
    apart = np.max([np.abs(other - value) for other in others], axis=0)
    return _SAFETY * spread_over(rows, apart, row_units)
