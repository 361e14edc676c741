"""Kernel arguments: nested named tuples of arrays, stored as one array of 64-bit words.

numba compiles a function for each set of argument types, and passes a named tuple as separate
arrays. Here a call has one argument, an array of words. A `Struct` is a pointer into the array, and
its fields are read when they are needed. So the argument types are always the same, and a call
within compiled code passes one pointer. The words must not change during a call.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from typing import TYPE_CHECKING, Generic, NamedTuple, TypeVar

import numpy as np

from fflin.base.validation import Array
from fflin.kernel.tree import work_space

if TYPE_CHECKING:
    from numpy.typing import NDArray


class Kind(NamedTuple):
    """Type of a field: a number (`axes` = 0) or a C-contiguous array with `axes` axes."""

    dtype: type[np.generic]
    axes: int = 0


WHOLE, REAL, FLAG = Kind(np.intp), Kind(np.float64), Kind(np.bool_)
INDICES, REALS, FLAGS = Kind(np.intp, 1), Kind(np.float64, 1), Kind(np.bool_, 1)
# Array of doubles whose second axis is the lane.
LANED = Kind(np.float64, 2)

_NOTHING = work_space(0)


T_co = TypeVar("T_co", bound=NamedTuple, covariant=True)
T = TypeVar("T", bound=NamedTuple)


class Struct(Generic[T_co]):
    """Type of a named tuple of kernel arguments.

    `others` are the kinds of single fields, and `groups` lists the fields of a kind, separated by
    spaces. All remaining fields are of the kind `rest`.
    """

    def __init__(
        self,
        made: type[T_co],
        rest: Kind = REALS,
        groups: Mapping[Kind, str] | None = None,
        /,
        **others: Kind | Struct[NamedTuple],
    ) -> None:
        for kind, fields in (groups or {}).items():
            others |= dict.fromkeys(fields.split(), kind)
        self.made = made
        self.kinds = {field: others.get(field, rest) for field in made._fields}
        sizes = [k.size if isinstance(k, Struct) else 1 + k.axes for k in self.kinds.values()]
        ends = np.cumsum([0, *sizes]).tolist()
        self.places = dict(zip(self.kinds, ends, strict=False))
        self.size: int = ends[-1]
        self.name = f"Struct({made.__name__})"

    def __call__(self, words: T) -> T:
        """Return the argument: compiled functions take words, and others take the named tuple."""
        return words


@cache
def empty(kind: Struct[T]) -> T:
    """Return a value of a kind with empty arrays and with numbers equal to 0."""
    parts: list[object] = []
    for of in kind.kinds.values():
        if isinstance(of, Struct):
            parts.append(empty(of))
        elif of == LANED:
            parts.append(_NOTHING)
        else:
            parts.append(np.zeros((0,) * of.axes, of.dtype) if of.axes else 0)
    return kind.made._make(parts)


def laid_out(value: T, kind: Struct[T], fresh: Callable[[Array, Array], None] | None = None) -> T:
    """Convert the fields of a named tuple to the kinds of its struct.

    `fresh` is called with each new laned array and with the column of values that fills it.
    """
    if value is empty(kind):
        return value
    parts: list[object] = []
    for part, of in zip(value, kind.kinds.values(), strict=True):
        if isinstance(of, Struct):
            parts.append(laid_out(part, of, fresh))
        elif of == LANED and len(part):
            lanes, column = work_space(len(part)), np.array(part, dtype=float)[:, None]
            lanes[:] = column
            parts.append(lanes)
            if fresh:
                fresh(lanes, column)
        elif of.axes:
            parts.append(_NOTHING if of == LANED else np.require(part, of.dtype, ("C", "W")))
        else:
            parts.append(of.dtype(part).item())
    return value._make(parts)


def words_of(value: T, kind: Struct[T]) -> NDArray[np.int64]:
    """Return the words of a named tuple from `laid_out`; its arrays must outlive the words."""
    words: list[int] = []
    for part, of in zip(value, kind.kinds.values(), strict=True):
        if isinstance(of, Struct):
            words += words_of(part, of).tolist()
        elif of.axes:
            fits = part.dtype == of.dtype and part.ndim == of.axes
            assert part.flags.c_contiguous and (fits or not part.size)
            words += [part.__array_interface__["data"][0], *part.shape]
        else:
            words.append(int(np.float64(part).view(np.int64)) if of == REAL else int(part))
    return np.array(words, dtype=np.int64)
