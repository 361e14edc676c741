"""Machine code of the operations of `kernel.lanes`, for one number or for eight at once.

An array with one axis holds numbers. An array with a second axis of eight holds lanes: one robot
per lane, and one instruction for all eight. A single double stands for eight equal numbers. So a
function that is written for one number can be compiled for eight.

LLVM does not vectorise loops over arrays that may overlap. So eight numbers are one value of the
vector type `Lanes`, whose operations LLVM compiles to vector instructions. If the registers of a
machine are narrower, LLVM splits the eight numbers over several registers.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

import numba
from llvmlite import ir
from numba.core import cgutils
from numba.extending import (
    intrinsic,
    lower_builtin,
    models,
    register_model,
    type_callable,
)

from fflin.kernel import lanes as uncompiled
from fflin.kernel.tree import LANES

_DOUBLE, _INT32 = ir.DoubleType(), ir.IntType(32)
_VECTOR = ir.VectorType(_DOUBLE, LANES)
_BYTES = 8  # alignment of a double


class Lanes(numba.types.Type):
    """numba type of eight doubles in one vector."""

    def __init__(self) -> None:
        super().__init__(name="Lanes")


lanes = Lanes()
double = numba.types.float64
_NUMBERS = (lanes, double)


@register_model(Lanes)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _VECTOR)


def _spread(builder: Any, value: Any) -> Any:
    """Copy a double to all lanes; return lanes unchanged."""
    if value.type == _VECTOR:
        return value
    nothing = ir.Constant(_VECTOR, ir.Undefined)
    one = builder.insert_element(nothing, value, _INT32(0))
    return builder.shuffle_vector(one, nothing, ir.Constant(ir.VectorType(_INT32, LANES), None))


def _alike(builder: Any, values: Any) -> list[Any]:
    """Convert all values to lanes if one of them has lanes."""
    if any(value.type == _VECTOR for value in values):
        return [_spread(builder, value) for value in values]
    return list(values)


def _together(*kinds: Any) -> Any:
    """Return the common type of numbers, or None if one of them is not a number."""
    if any(kind not in _NUMBERS for kind in kinds):
        return None
    return lanes if lanes in kinds else double


def _arithmetic(python: Callable[..., Any], instruction: str) -> None:
    @type_callable(python)
    def typed(_: Any) -> Any:
        def typer(left: Any, right: Any) -> Any:
            return lanes if _together(left, right) == lanes else None

        return typer

    def lowered(_: Any, builder: Any, __: Any, arguments: Any) -> Any:
        return getattr(builder, instruction)(*_alike(builder, arguments), flags=["contract"])

    for pair in ((Lanes, Lanes), (Lanes, numba.types.Float), (numba.types.Float, Lanes)):
        lower_builtin(python, *pair)(lowered)


for _python, _instruction in (
    (operator.add, "fadd"),
    (operator.sub, "fsub"),
    (operator.mul, "fmul"),
    (operator.truediv, "fdiv"),
):
    _arithmetic(_python, _instruction)


@type_callable(operator.neg)
def _typed_negative(_: Any) -> Any:
    return lambda value: lanes if value == lanes else None


@lower_builtin(operator.neg, Lanes)
def _negative(_: Any, builder: Any, __: Any, arguments: Any) -> Any:
    return builder.fneg(arguments[0])


def _held(array: Any) -> Any:
    """Return the type of an array's entries."""
    return lanes if array.ndim == 2 else double


def _flat_place(context: Any, builder: Any, kind: Any, array: Any, index: Any) -> Any:
    """Return the address of a double at an index of a flattened contiguous array."""
    return builder.gep(context.make_array(kind)(context, builder, array).data, [index])


def _place(context: Any, builder: Any, kind: Any, array: Any, index: Any) -> Any:
    if _held(kind) == double:
        return _flat_place(context, builder, kind, array, index)
    index = builder.mul(index, ir.Constant(index.type, LANES))
    return builder.bitcast(_flat_place(context, builder, kind, array, index), _VECTOR.as_pointer())


def _write(builder: Any, value: Any, place: Any) -> None:
    builder.store(value, place).align = _BYTES


@intrinsic
def load(typing: Any, array: Any, index: Any) -> Any:
    """Read an entry of a contiguous array: one number, or one number per lane."""

    def generate(context: Any, builder: Any, _: Any, arguments: Any) -> Any:
        value = builder.load(_place(context, builder, array, *arguments))
        value.align = _BYTES
        return value

    return _held(array)(array, numba.types.intp), generate


@intrinsic
def store(typing: Any, array: Any, index: Any, value: Any) -> Any:
    """Write a number or lanes at an index of a contiguous array."""

    def generate(context: Any, builder: Any, _: Any, arguments: Any) -> Any:
        written = arguments[2]
        if _held(array) == lanes:
            written = _spread(builder, written)
        _write(builder, written, _place(context, builder, array, *arguments[:2]))
        return context.get_dummy_value()

    given = value if _held(array) == lanes and value == lanes else double
    return numba.types.void(array, numba.types.intp, given), generate


@intrinsic
def splat(typing: Any, array: Any, value: Any) -> Any:
    """Convert a number to the entry type of an array: one number, or the number in all lanes."""

    def generate(_: Any, builder: Any, __: Any, arguments: Any) -> Any:
        return _spread(builder, arguments[1]) if _held(array) == lanes else arguments[1]

    return _held(array)(array, double), generate


def _rounding(name: str) -> Any:
    @intrinsic
    def rounded(typing: Any, value: Any) -> Any:
        def generate(_: Any, builder: Any, __: Any, arguments: Any) -> Any:
            kind = arguments[0].type
            of = f"v{LANES}f64" if kind == _VECTOR else "f64"
            function = cgutils.get_or_insert_function(
                builder.module, ir.FunctionType(kind, [kind]), f"llvm.{name}.{of}"
            )
            return builder.call(function, arguments)

        return value(value), generate

    return rounded


floor, whole, root = _rounding("floor"), _rounding("rint"), _rounding("sqrt")


def _one(builder: Any, kind: Any, index: Any, lane: Any) -> Any:
    """Return the flat index of an entry's lane; without lanes, it is the index of the entry."""
    if _held(kind) == double:
        return index
    return builder.add(builder.mul(index, ir.Constant(index.type, LANES)), lane)


@intrinsic
def peek(typing: Any, array: Any, index: Any, lane: Any) -> Any:
    """Read a lane at an index of a contiguous array."""

    def generate(context: Any, builder: Any, _: Any, arguments: Any) -> Any:
        values, *at = arguments
        place = _flat_place(context, builder, array, values, _one(builder, array, *at))
        return builder.load(place)

    return double(array, numba.types.intp, numba.types.intp), generate


@intrinsic
def poke(typing: Any, array: Any, index: Any, lane: Any, value: Any) -> Any:
    """Write a double to a lane at an index of a contiguous array."""

    def generate(context: Any, builder: Any, _: Any, arguments: Any) -> Any:
        values, *at, written = arguments
        place = _flat_place(context, builder, array, values, _one(builder, array, *at))
        builder.store(written, place)
        return context.get_dummy_value()

    return numba.types.void(array, numba.types.intp, numba.types.intp, double), generate


@intrinsic
def chosen(typing: Any, left: Any, right: Any, less: Any, other: Any) -> Any:
    """Return `less` if left < right, else `other`, lane by lane; a comparison with NaN is false."""

    def generate(_: Any, builder: Any, __: Any, arguments: Any) -> Any:
        left, right, less, other = _alike(builder, arguments)
        return builder.select(builder.fcmp_ordered("<", left, right), less, other)

    return _together(left, right, less, other)(left, right, less, other), generate


@intrinsic
def below(typing: Any, value: Any, bound: Any) -> Any:
    """Return whether a number, or every lane, is less than a bound; false for NaN."""

    def generate(_: Any, builder: Any, __: Any, arguments: Any) -> Any:
        value, bound = _alike(builder, arguments)
        less = builder.fcmp_ordered("<", value, bound)
        if value.type != _VECTOR:
            return less
        return builder.icmp_signed(
            "==", builder.bitcast(less, ir.IntType(LANES)), ir.Constant(ir.IntType(LANES), -1)
        )

    return numba.types.boolean(value, bound), generate


@intrinsic
def angle(typing: Any, sine: Any, cosine: Any) -> Any:
    """Return the angle in (-pi, pi] from its sine and cosine."""

    def generate(_: Any, builder: Any, __: Any, arguments: Any) -> Any:
        kind = ir.FunctionType(_DOUBLE, [_DOUBLE, _DOUBLE])
        atan2 = cgutils.get_or_insert_function(builder.module, kind, "atan2")
        pair = _alike(builder, arguments)
        if pair[0].type == _DOUBLE:
            return builder.call(atan2, pair)
        result = ir.Constant(_VECTOR, ir.Undefined)
        for lane in map(_INT32, range(LANES)):
            one = builder.call(atan2, [builder.extract_element(each, lane) for each in pair])
            result = builder.insert_element(result, one, lane)
        return result

    return _together(sine, cosine)(sine, cosine), generate


# {function of `kernel.lanes`: operation that replaces it in compiled code}.
OPERATIONS = {
    getattr(uncompiled, operation): globals()[operation]
    for operation in (
        *("load", "store", "splat", "floor", "whole", "root", "peek", "poke"),
        *("chosen", "below", "angle"),
    )
}
