"""Eight doubles side by side in numba code: one configuration a lane, one instruction for all.

LLVM does not vectorise loops over several arrays that may overlap. A type of its own leaves it no
choice, and the code reads as for one number. Where a machine has narrower registers, LLVM splits
the eight over several.
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

from fflin.kernel.tree import LANES

_DOUBLE, _INT32 = ir.DoubleType(), ir.IntType(32)
_VECTOR = ir.VectorType(_DOUBLE, LANES)
_BYTES = 8  # alignment of a double


class Lanes(numba.types.Type):
    """The type of eight doubles side by side."""

    def __init__(self) -> None:
        super().__init__(name="Lanes")


lanes = Lanes()


@register_model(Lanes)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _VECTOR)


def _arithmetic(python: Callable[..., Any], instruction: str) -> None:
    @type_callable(python)
    def typed(_: Any) -> Any:
        def typer(left: Any, right: Any) -> Any:
            return lanes if left == right == lanes else None

        return typer

    @lower_builtin(python, Lanes, Lanes)
    def lowered(_: Any, builder: Any, __: Any, arguments: Any) -> Any:
        # A product and a sum may become one fused instruction, which rounds once.
        return getattr(builder, instruction)(*arguments, flags=["contract"])


for _python, _instruction in (
    (operator.add, "fadd"),
    (operator.sub, "fsub"),
    (operator.mul, "fmul"),
    (operator.truediv, "fdiv"),
):
    _arithmetic(_python, _instruction)


def _pointer(context: Any, builder: Any, kind: Any, array: Any, index: Any) -> Any:
    data = context.make_array(kind)(context, builder, array).data
    return builder.gep(data, [index])


def _read(builder: Any, place: Any) -> Any:
    value = builder.load(builder.bitcast(place, _VECTOR.as_pointer()))
    value.align = _BYTES
    return value


def _write(builder: Any, value: Any, place: Any) -> None:
    written = builder.store(value, builder.bitcast(place, _VECTOR.as_pointer()))
    written.align = _BYTES


def _stepped(builder: Any, first: Any, step: Any, times: int) -> Any:
    return builder.add(first, builder.mul(step, ir.Constant(step.type, times)))


@intrinsic
def load(typing: Any, array: Any, index: Any) -> Any:
    """Read eight doubles of a contiguous array from an index on."""

    def generate(context: Any, builder: Any, _: Any, arguments: Any) -> Any:
        return _read(builder, _pointer(context, builder, array, *arguments))

    return lanes(array, numba.types.intp), generate


@intrinsic
def store(typing: Any, array: Any, index: Any, value: Any) -> Any:
    """Write eight doubles to a contiguous array from an index on."""

    def generate(context: Any, builder: Any, _: Any, arguments: Any) -> Any:
        _write(builder, arguments[2], _pointer(context, builder, array, *arguments[:2]))
        return context.get_dummy_value()

    return numba.types.void(array, numba.types.intp, lanes), generate


@intrinsic
def splat(typing: Any, value: Any) -> Any:
    """Put one double in all lanes."""

    def generate(_: Any, builder: Any, __: Any, arguments: Any) -> Any:
        one = builder.insert_element(ir.Constant(_VECTOR, ir.Undefined), arguments[0], _INT32(0))
        return builder.shuffle_vector(
            one, ir.Constant(_VECTOR, ir.Undefined), ir.Constant(ir.VectorType(_INT32, LANES), None)
        )

    return lanes(numba.types.float64), generate


@intrinsic
def gather(typing: Any, array: Any, index: Any, stride: Any) -> Any:
    """Read eight doubles of a contiguous array that stand `stride` apart, from an index on."""

    def generate(context: Any, builder: Any, _: Any, arguments: Any) -> Any:
        values, first, step = arguments
        result = ir.Constant(_VECTOR, ir.Undefined)
        for lane in range(LANES):
            index = _stepped(builder, first, step, lane)
            place = _pointer(context, builder, array, values, index)
            result = builder.insert_element(result, builder.load(place), _INT32(lane))
        return result

    return lanes(array, numba.types.intp, numba.types.intp), generate


@intrinsic
def scatter(typing: Any, array: Any, index: Any, stride: Any, value: Any) -> Any:
    """Write eight doubles to a contiguous array, `stride` apart, from an index on."""

    def generate(context: Any, builder: Any, _: Any, arguments: Any) -> Any:
        values, first, step, eight = arguments
        for lane in range(LANES):
            index = _stepped(builder, first, step, lane)
            place = _pointer(context, builder, array, values, index)
            builder.store(builder.extract_element(eight, _INT32(lane)), place)
        return context.get_dummy_value()

    index_type = numba.types.intp
    return numba.types.void(array, index_type, index_type, lanes), generate


@intrinsic
def floor(typing: Any, value: Any) -> Any:
    """Round every lane down to a whole number."""

    def generate(_: Any, builder: Any, __: Any, arguments: Any) -> Any:
        kind = ir.FunctionType(_VECTOR, [_VECTOR])
        name = f"llvm.floor.v{LANES}f64"
        function = cgutils.get_or_insert_function(builder.module, kind, name)
        return builder.call(function, arguments)

    return lanes(lanes), generate


@intrinsic
def transpose(typing: Any, source: Any, index: Any, target: Any, start: Any, stride: Any) -> Any:
    """Write eight vectors that stand one after the other lane by lane.

    Lane k goes to the eight doubles of `target` from ``start + k stride`` on.
    """

    def generate(context: Any, builder: Any, _: Any, arguments: Any) -> Any:
        values, first, out, begin, step = arguments
        rows = []
        for row in range(LANES):
            at = builder.add(first, ir.Constant(first.type, row * LANES))
            rows.append(_read(builder, _pointer(context, builder, source, values, at)))
        # Swap blocks of 1, 2 and 4 lanes between rows that lie as far apart.
        for size in (1, 2, 4):
            low = [lane if not lane & size else lane - size + LANES for lane in range(LANES)]
            high = [lane + size if not lane & size else lane + LANES for lane in range(LANES)]
            masks = [
                ir.Constant(ir.VectorType(_INT32, LANES), [_INT32(i) for i in picks])
                for picks in (low, high)
            ]
            for row in range(LANES):
                if not row & size:
                    pair = rows[row], rows[row + size]
                    rows[row], rows[row + size] = (
                        builder.shuffle_vector(*pair, mask) for mask in masks
                    )
        for row, value in enumerate(rows):
            index = _stepped(builder, begin, step, row)
            _write(builder, value, _pointer(context, builder, target, out, index))
        return context.get_dummy_value()

    index_type = numba.types.intp
    signature = numba.types.void(source, index_type, target, index_type, index_type)
    return signature, generate
