"""Kernel arguments: nested named tuples of arrays, stored as one array of 64-bit words.

numba compiles a function for each set of argument types, and passes a named tuple as separate
arrays. Here a call has one argument, an array of words. A `Struct` is a pointer into the array, and
its fields are read when they are needed. So the argument types are always the same, and a call
within compiled code passes one pointer. The words must not change during a call.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fflin.base.validation import Array
from fflin.kernel.tree import work_space


class Kind(NamedTuple):
    """Type of a field: a number (`axes` = 0) or a C-contiguous array with `axes` axes."""

    dtype: Any
    axes: int = 0


WHOLE, REAL, FLAG = Kind(np.intp), Kind(np.float64), Kind(np.bool_)
INDICES, REALS, FLAGS = Kind(np.intp, 1), Kind(np.float64, 1), Kind(np.bool_, 1)
# Array of doubles whose second axis is the lane.
LANED = Kind(np.float64, 2)

_NOTHING = work_space(0)


class Struct:
    """Type of a named tuple of kernel arguments: `kind` for all fields except `others`."""

    def __init__(self, made: Any, kind: Any = REALS, name: str = "", /, **others: Any) -> None:
        self.made = made
        self.kinds = {field: others.get(field, kind) for field in made._fields}
        ends = np.cumsum([0, *map(_size, self.kinds.values())]).tolist()
        self.places, self.size = dict(zip(self.kinds, ends, strict=False)), ends[-1]
        self.name = f"Struct({name or made.__name__})"


def _size(kind: Any) -> int:
    """Return the number of words of a kind."""
    if isinstance(kind, Struct):
        return kind.size
    size: int = 1 + kind.axes
    return size


class Opener(NamedTuple):
    """Function by which compiled code interprets an array of words as a struct."""

    kind: Struct

    def __call__(self, words: Any) -> Any:
        """Return the argument unchanged: uncompiled functions take the named tuple itself."""
        return words


def laid_out(value: Any, kind: Any, fresh: Callable[[Array, Array], None] | None = None) -> Any:
    """Convert the fields of a named tuple to the kinds of its struct.

    `fresh` is called with each new laned array and with the column of values that fills it.
    """
    if isinstance(kind, Struct):
        if value is empty(kind):
            return value
        parts = zip(value, kind.kinds.values(), strict=True)
        return type(value)._make(laid_out(part, of, fresh) for part, of in parts)
    if kind == LANED:
        if not len(value):
            return _NOTHING
        lanes = work_space(len(value))
        lanes[:] = column = np.array(value, dtype=float)[:, None]
        if fresh:
            fresh(lanes, column)
        return lanes
    if kind.axes:
        return np.require(value, kind.dtype, ("C", "W"))
    return kind.dtype(value).item()


@cache
def empty(kind: Any) -> Any:
    """Return a value of a kind with empty arrays and with numbers equal to 0."""
    if isinstance(kind, Struct):
        return kind.made._make(map(empty, kind.kinds.values()))
    if kind == LANED:
        return _NOTHING
    return np.zeros((0,) * kind.axes, kind.dtype) if kind.axes else 0


def words_of(value: Any, kind: Any) -> NDArray[np.int64]:
    """Return the words of a named tuple from `laid_out`; its arrays must outlive the words."""
    return np.array(_words(value, kind), dtype=np.int64)


def _words(value: Any, kind: Any) -> list[int]:
    if isinstance(kind, Struct):
        parts = zip(value, kind.kinds.values(), strict=True)
        return [word for part, of in parts for word in _words(part, of)]
    if kind.axes:
        fits = value.dtype == kind.dtype and value.ndim == kind.axes
        assert value.flags.c_contiguous and (fits or not value.size)
        return [value.__array_interface__["data"][0], *value.shape]
    return [int(np.float64(value).view(np.int64)) if kind == REAL else int(value)]
