"""Nested named tuples of arrays as one array of words, which numba code opens again.

numba takes a call's arrays out of their Python objects one by one, which costs more than a small
robot's dynamics; what does not change from call to call is handed over as one array.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from llvmlite import ir
from numba.extending import intrinsic
from numba.np.arrayobj import populate_array
from numpy.typing import NDArray

REALS, FLAGS = (numba.types.Array(kind, 1, "C") for kind in (numba.float64, numba.boolean))
INDICES, TABLE = (numba.types.Array(numba.intp, axes, "C") for axes in (1, 2))
WHOLE = numba.intp


def kind_of(made: type, kind: Any = REALS, **others: Any) -> Any:
    """Return the type of a named tuple whose fields are all of one kind but for others."""
    fields = made._fields  # type: ignore[attr-defined]
    return numba.types.NamedTuple([others.get(name, kind) for name in fields], made)


def words_of(value: Any) -> NDArray[np.int64]:
    """Return the addresses, shapes and numbers of a value, which must outlive them."""
    return np.array(_words(value), dtype=np.int64)


def _words(value: Any) -> list[int]:
    if isinstance(value, tuple):
        return [word for each in value for word in _words(each)]
    if isinstance(value, np.ndarray):
        return [value.__array_interface__["data"][0], *value.shape]
    return [int(value)]


def opener(kind: Any) -> Any:
    """Return the numba function that makes a value of a type of its words again."""

    @intrinsic
    def opened(typing: Any, words: Any) -> Any:
        def generate(context: Any, builder: Any, _: Any, arguments: Any) -> Any:
            data = context.make_array(words)(context, builder, arguments[0]).data
            at = iter(range(2**20))

            def word() -> Any:
                return builder.load(builder.gep(data, [ir.IntType(64)(next(at))]))

            def made(kind: Any) -> Any:
                if isinstance(kind, numba.types.BaseTuple):
                    return context.make_tuple(builder, kind, [made(each) for each in kind.types])
                if not isinstance(kind, numba.types.Array):
                    return word()
                array = context.make_array(kind)(context, builder)
                address = builder.inttoptr(word(), array.data.type)
                shape = [word() for _ in range(kind.ndim)]
                size = context.get_constant(
                    numba.intp, context.get_abi_sizeof(context.get_data_type(kind.dtype))
                )
                strides = [size]
                for length in shape[:0:-1]:
                    strides.insert(0, builder.mul(strides[0], length))
                populate_array(array, address, shape, strides, size, None)
                return array._getvalue()

            return made(kind)

        return kind(words), generate

    return opened
