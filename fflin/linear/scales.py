"""Scales and rounding errors of reference matrices, with which `check` compares a linear model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from fflin.base.validation import Array, Indices

EPS = float(np.finfo(float).eps)

# Relative tolerances of comparisons with ABA derivatives and with finite differences.
ROUTE_TOLERANCE, DIFFERENCE_TOLERANCE = 1e-9, 1e-8

# Assumed rounding error [ulp] of a sum, relative to the sum of the magnitudes of its terms. The
# first value is for accelerations, and the second one for kinematics, which are shorter sums.
ULPS, FEW_ULPS = 64.0, 8.0

# Largest expected ratio of a rounding error to the largest of a few sampled rounding errors. The
# second value is for columns that are only rounding errors, in which no digit is correct. A
# ratio of 25 was observed in such a column.
_SAFETY, _SAFETY_OF_ZERO = 20.0, 200.0

# The square of a rounding error may remain in place of a zero, for example in a velocity that is
# converted from a state. Up to this size, in units, an entry counts as zero.
_NOTHING = 1e-30

# {block: its rows or columns}
Blocks = Mapping[Any, slice | Sequence[int] | Indices]


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
    """Matrix of an independent computation, with a scale and a rounding error for each entry.

    The scale of an entry is the size of the entries and terms to which its error is relative. It is
    in the units of the entry, so the relative error does not depend on the units of the model.
    """

    value: Array
    scale: Array
    rounding: Array

    def scales(self, tolerance: float) -> Array:
        """Return the scale of each entry for errors with this tolerance.

        If the rounding error of an entry exceeds the tolerance, the scale is the rounding error
        divided by the tolerance. So rounding errors alone do not exceed the tolerance.
        """
        scales: Array = np.maximum(self.scale, self.rounding / tolerance)
        return scales

    def errors(self, given: Array, tolerance: float) -> Array:
        """Return the error of each entry of a given matrix, divided by its scale."""
        errors: Array = np.abs(given - self.value) / self.scales(tolerance)
        return errors


def spread_over(rows: Blocks, x: Array, row_units: Array) -> Array:
    """Replace each entry of x by the largest magnitude of its column in the same block of rows.

    Rows of a block may have different units. Magnitudes are therefore divided by `row_units` (k,)
    before they are compared, and the result is converted to the unit of each row.
    """
    largest = np.zeros_like(x)
    for block in rows.values():
        unit = row_units[block][:, None]
        ratios = np.abs(x[block]) / unit
        largest[block] = unit * ratios.max(axis=0, initial=0.0)
    return largest


def block_sizes(
    rows: Blocks, columns: Blocks, x: Array, row_units: Array, column_units: Array
) -> Array:
    """Return, for each entry of x, the largest magnitude in its block.

    The magnitude is converted to the units of the row and the column of the entry.
    """
    units = np.outer(row_units, 1.0 / column_units)
    sizes = np.abs(x) / units
    for row in rows.values():
        for column in columns.values():
            where = np.ix_(np.arange(len(x))[row], np.arange(x.shape[1])[column])
            sizes[where] = sizes[where].max(initial=0.0)
    return sizes * units


def scales(
    rows: Blocks, columns: Blocks, sizes: Array, row_units: Array, column_units: Array
) -> Array:
    """Return the scale of each entry of a matrix from its size.

    The scale is the size. If the size is zero, the scale is the largest size in the block. If the
    block is zero, the scale is one unit. Sizes up to _NOTHING units count as zero.
    """
    largest = block_sizes(rows, columns, sizes, row_units, column_units)
    unit = np.outer(row_units, 1.0 / column_units)
    least = _NOTHING * unit
    return np.where(sizes > least, sizes, np.where(largest > least, largest, unit))


def sampled(
    rows: Blocks, value: Array, others: Sequence[Array], row_units: Array
) -> Array:
    """Bound the rounding errors of a matrix that was computed several times.

    The bound of an entry is a multiple of the largest difference between the computations in the
    same column and in the same block of rows.
    """
    apart = np.max([np.abs(other - value) for other in others], axis=0)
    largest = spread_over(rows, apart, row_units)
    is_zero = spread_over(rows, value, row_units) <= _SAFETY * largest
    return np.where(is_zero, _SAFETY_OF_ZERO, _SAFETY) * largest


def worst(test: str, block: str, errors: Array, tolerance: float) -> Row:
    """Return the row of a comparison with these errors; the error is NaN if an entry is NaN."""
    return Row(test, block, float(errors.max(initial=0.0)), tolerance)
