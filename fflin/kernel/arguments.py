"""Nested named tuples of arrays as one array of words, which numba code reads field by field.

numba compiles a function for each set of argument types, and hands a named tuple over array by
array. Here the argument of a call is one array of 64-bit words, and a `Struct` is a pointer into it
whose fields are read where they are needed: the types are the same whatever the arrays hold, and a
call within the compiled code takes one pointer. The words must not change during a call.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numba
import numpy as np
from llvmlite import ir
from numba.core.typing.templates import AttributeTemplate
from numba.extending import (
    infer_getattr,
    intrinsic,
    lower_getattr_generic,
    models,
    register_model,
)
from numba.np.arrayobj import populate_array
from numpy.typing import NDArray

from fflin.base.validation import Array
from fflin.kernel.accelerations import work_space

REALS, FLAGS, INDICES = (
    numba.types.Array(kind, 1, "C") for kind in (numba.float64, numba.boolean, numba.intp)
)
# Doubles in lanes.
LANED = numba.types.Array(numba.float64, 2, "C")
WHOLE, REAL, FLAG = numba.types.intp, numba.types.float64, numba.types.boolean

_DTYPES = {REAL: np.dtype(float), FLAG: np.dtype(bool), WHOLE: np.dtype(np.intp)}
_NOTHING = work_space(0)

_WORD, _DOUBLE = ir.IntType(64), ir.DoubleType()


class Struct(numba.types.Type):
    """The type of a named tuple's words: each field is of one kind but for others."""

    def __init__(self, made: Any, kind: Any = REALS, /, name: str = "", **others: Any) -> None:
        self.made = made
        self.kinds = {field: others.get(field, kind) for field in made._fields}
        ends = np.cumsum([0, *map(_size, self.kinds.values())]).tolist()
        self.places, self.size = dict(zip(self.kinds, ends, strict=False)), ends[-1]
        super().__init__(name=f"Struct({name or made.__name__})")


def _size(kind: Any) -> int:
    """Return the number of words of a kind."""
    if isinstance(kind, Struct):
        return kind.size
    return 1 + kind.ndim if isinstance(kind, numba.types.Array) else 1


@register_model(Struct)
class _StructModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _WORD.as_pointer())


@infer_getattr
class _Fields(AttributeTemplate):
    key = Struct

    def generic_resolve(self, kind: Any, name: str) -> Any:
        return kind.kinds.get(name)


@lower_getattr_generic(Struct)
def _field(context: Any, builder: Any, kind: Any, words: Any, name: str) -> Any:
    found, first = kind.kinds[name], kind.places[name]

    def at(place: int) -> Any:
        return builder.gep(words, [_WORD(first + place)])

    def word(place: int) -> Any:
        value = builder.load(at(place))
        # No store of a double makes it another, so it need not be read again.
        value.set_metadata("invariant.load", builder.module.add_metadata([]))
        return value

    if isinstance(found, Struct):
        return at(0)
    if found is REAL:
        return builder.bitcast(word(0), _DOUBLE)
    if found is FLAG:
        return builder.trunc(word(0), ir.IntType(1))
    if not isinstance(found, numba.types.Array):
        return word(0)
    array = context.make_array(found)(context, builder)
    shape = [word(1 + axis) for axis in range(found.ndim)]
    size = context.get_constant(
        numba.intp, context.get_abi_sizeof(context.get_data_type(found.dtype))
    )
    strides = [size]
    for length in shape[:0:-1]:
        strides.insert(0, builder.mul(strides[0], length))
    data = builder.inttoptr(word(0), array.data.type)
    populate_array(array, data, shape, strides, size, None)
    return array._getvalue()


def opener(kind: Struct) -> Any:
    """Return the numba function that takes an array of words for a struct."""

    @intrinsic
    def opened(typing: Any, words: Any) -> Any:
        def generate(context: Any, builder: Any, _: Any, arguments: Any) -> Any:
            return context.make_array(words)(context, builder, arguments[0]).data

        return kind(words), generate

    return opened


def laid_out(value: Any, kind: Any, fresh: Callable[[Array, Array], None] | None = None) -> Any:
    """Return a named tuple with arrays and numbers as its struct has them, in lanes where it says.

    `fresh` is called with each array in lanes and a column of its values.
    """
    if isinstance(kind, Struct):
        if value is empty(kind):
            return value
        parts = zip(value, kind.kinds.values(), strict=True)
        return type(value)._make(laid_out(part, of, fresh) for part, of in parts)
    if kind is LANED:
        if not len(value):
            return _NOTHING
        lanes = work_space(len(value))
        lanes[:] = column = np.array(value, dtype=float)[:, None]
        if fresh:
            fresh(lanes, column)
        return lanes
    if isinstance(kind, numba.types.Array):
        return np.require(value, _DTYPES[kind.dtype], ("C", "W"))
    return {REAL: float, FLAG: bool}.get(kind, int)(value)


@cache
def empty(kind: Any) -> Any:
    """Return the value of a kind whose arrays are empty and whose numbers are 0, laid out."""
    if isinstance(kind, Struct):
        return kind.made._make(map(empty, kind.kinds.values()))
    if kind is LANED:
        return _NOTHING
    return (
        np.zeros((0,) * kind.ndim, _DTYPES[kind.dtype])
        if isinstance(kind, numba.types.Array)
        else 0
    )


def words_of(value: Any, kind: Any) -> NDArray[np.int64]:
    """Return the words of a named tuple whose arrays are laid out, and must outlive them."""
    return np.array(_words(value, kind), dtype=np.int64)


def _words(value: Any, kind: Any) -> list[int]:
    if isinstance(kind, Struct):
        parts = zip(value, kind.kinds.values(), strict=True)
        return [word for part, of in parts for word in _words(part, of)]
    if isinstance(kind, numba.types.Array):
        fits = value.dtype == _DTYPES[kind.dtype] and value.ndim == kind.ndim
        assert value.flags.c_contiguous and (fits or not value.size)
        return [value.__array_interface__["data"][0], *value.shape]
    return [int(np.float64(value).view(np.int64)) if kind is REAL else int(value)]
