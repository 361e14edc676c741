"""Compilation of the kernel's functions by numba.

`translated` converts a function of the kernel to a numba function. By default, numba generates
machine code for each function together with all called functions. A function at the end of a chain
of ten calls would be compiled ten times. This module avoids the repetition. A *part* is a function
that only compiled functions call. For a part, numba generates only LLVM code (LLVM's intermediate
representation). For a function that Python calls, numba generates machine code from the LLVM code
of the function and of all needed parts.

The operations of `kernel.vectors` are compiled for one number or for eight numbers. An array with
one axis holds numbers. An array with a second axis of length eight holds lanes: each lane belongs
to one point or run, and one instruction computes all eight. If an operation combines lanes with a
double, the double stands for eight equal numbers. So a function that is written for one number can
be compiled for eight.

LLVM does not vectorise loops over arrays that may overlap. So the eight numbers of an entry are one
value of the vector type `Lanes`, whose operations LLVM compiles to vector instructions. If a
processor's registers hold fewer than eight doubles, LLVM splits the value over several registers.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import cache, partial, wraps
from types import FunctionType, ModuleType
from typing import NamedTuple, Protocol, TypeAlias

import numba
import numpy as np
from llvmlite import ir
from numba import extending
from numba.core import cgutils, config
from numba.core.base import BaseContext
from numba.core.codegen import CodeLibrary, CPUCodeLibrary
from numba.core.compiler import Compiler
from numba.core.compiler_lock import global_compiler_lock
from numba.core.dispatcher import _CompileStats
from numba.core.typeconv import Conversion
from numba.core.typing import BaseContext as TypingContext
from numba.core.typing import Signature, make_concrete_template
from numba.core.typing.templates import AttributeTemplate, infer_global
from numba.np.arrayobj import populate_array
from numba.types import Array, Type, boolean, float64, intp, void

from fflin.kernel import vectors as uncompiled
from fflin.kernel.tree import LANES, Kind, Struct

_DOUBLE, _INT32, _WORD = ir.DoubleType(), ir.IntType(32), ir.IntType(64)
_VECTOR = ir.VectorType(_DOUBLE, LANES)
_BYTES = 8  # alignment of a double

# Function that generates the code of an operation on LLVM values, and returns the LLVM value of the
# operation's result.
Generator: TypeAlias = Callable[..., ir.Value]
# Function that maps the numba types of an operation's arguments to the operation's signature.
Typer: TypeAlias = Callable[..., Signature]


class Lanes(Type):
    """numba type of eight doubles in one vector; numba converts one double to eight equal lanes."""

    def can_convert_from(self, _: TypingContext, other: Type) -> Conversion | None:
        """Return numba's kind of conversion if `other` is a double, and None for other types."""
        return Conversion.promote if other == float64 else None


lanes = Lanes("Lanes")


extending.register_model(Lanes)(
    partial(extending.models.PrimitiveModel, be_type=_VECTOR)
)


@extending.lower_cast(float64, lanes)
def _spread(
    _: BaseContext, builder: ir.IRBuilder, __: Type, ___: Type, value: ir.Value
) -> ir.Value:
    """Copy a double to all lanes."""
    nothing = ir.Constant(_VECTOR, ir.Undefined)
    one = builder.insert_element(nothing, value, _INT32(0))
    return builder.shuffle_vector(
        one, nothing, ir.Constant(ir.VectorType(_INT32, LANES), None)
    )


def _alike(*kinds: Type) -> Signature:
    """Return the signature of an operation: on lanes if any operand has lanes, else on doubles."""
    kind = lanes if lanes in kinds else float64
    operands = [kind] * len(kinds)
    return kind(*operands)


def _arithmetic(
    python: Callable[..., object], generate: Generator, operands: int = 2
) -> None:
    """Define a Python operator, such as `operator.add`, for operands with lanes."""

    def lowered(
        _: BaseContext, builder: ir.IRBuilder, __: Signature, values: Sequence[ir.Value]
    ) -> ir.Value:
        return generate(builder, *values, flags=["contract"])

    kinds = [lanes] * operands
    signature = lanes(*kinds)
    infer_global(python)(make_concrete_template(python.__name__, python, [signature]))
    extending.lower_builtin(python, *signature.args)(lowered)


_arithmetic(operator.add, ir.IRBuilder.fadd)
_arithmetic(operator.sub, ir.IRBuilder.fsub)
_arithmetic(operator.mul, ir.IRBuilder.fmul)
_arithmetic(operator.truediv, ir.IRBuilder.fdiv)
_arithmetic(operator.neg, ir.IRBuilder.fneg, 1)


def _operation(
    replaced: Callable[..., object], typed: Typer
) -> Callable[[Generator], Callable[..., object]]:
    """Return a decorator for code generators.

    In compiled code, the code of the decorated generator replaces the function `replaced` of
    `vectors`. If the first argument of this function is an array, the generator receives the
    address of the array's first entry. The entry is a double or a vector of eight doubles.
    """

    def decorated(generate: Generator) -> Callable[..., object]:
        @extending.intrinsic
        # numba reads the number of arguments from the signature of `generate`
        @wraps(generate)
        def operation(_: TypingContext, *kinds: Type) -> tuple[Signature, Generator]:
            def generated(
                context: BaseContext,
                builder: ir.IRBuilder,
                _: Signature,
                values: Sequence[ir.Value],
            ) -> ir.Value:
                arguments = list(values)
                first_kind = kinds[0]
                if isinstance(first_kind, Array):
                    # An array is a struct in LLVM code. Pass the address of its data instead.
                    make_struct = context.make_array(first_kind)
                    address = make_struct(context, builder, values[0]).data
                    if first_kind.ndim == 2:
                        address = builder.bitcast(address, _VECTOR.as_pointer())
                    arguments[0] = address
                result = generate(builder, *arguments)
                if result is None:
                    return context.get_dummy_value()
                return result

            return typed(*kinds), generated

        uncompiled.IN_PLACE[replaced] = operation
        return generate

    return decorated


def _held(array: Array) -> Type:
    """Return the type of an array's entries: lanes if the array has two axes, else doubles."""
    return lanes if array.ndim == 2 else float64


@_operation(uncompiled.load, lambda array, index: _held(array)(array, intp))
def _load(builder: ir.IRBuilder, array: ir.Value, index: ir.Value) -> ir.Value:
    value = builder.load(builder.gep(array, [index]))
    value.align = _BYTES
    return value


@_operation(uncompiled.store, lambda array, index, _: void(array, intp, _held(array)))
def _store(
    builder: ir.IRBuilder, array: ir.Value, index: ir.Value, value: ir.Value
) -> None:
    builder.store(value, builder.gep(array, [index])).align = _BYTES


def _rounding(replaced: Callable[..., object], name: str) -> None:
    def generate(builder: ir.IRBuilder, value: ir.Value) -> ir.Value:
        type_name = f"v{LANES}f64" if value.type == _VECTOR else "f64"
        function = cgutils.get_or_insert_function(
            builder.module,
            ir.FunctionType(value.type, [value.type]),
            f"llvm.{name}.{type_name}",
        )
        return builder.call(function, [value])

    _operation(replaced, lambda value: value(value))(generate)


_rounding(uncompiled.floor, "floor")
_rounding(uncompiled.whole, "rint")
_rounding(uncompiled.root, "sqrt")


@_operation(uncompiled.chosen, _alike)
def _chosen(
    builder: ir.IRBuilder,
    left: ir.Value,
    right: ir.Value,
    if_less: ir.Value,
    otherwise: ir.Value,
) -> ir.Value:
    """Generate the code of `vectors.chosen`; an ordered comparison with NaN is false."""
    is_less = builder.fcmp_ordered("<", left, right)
    return builder.select(is_less, if_less, otherwise)


@_operation(uncompiled.below, lambda *kinds: boolean(*_alike(*kinds).args))
def _below(builder: ir.IRBuilder, value: ir.Value, bound: ir.Value) -> ir.Value:
    """Generate the code of `vectors.below`, which is true if all lanes are below the bound."""
    is_less = builder.fcmp_ordered("<", value, bound)
    if value.type != _VECTOR:
        return is_less
    # The comparison returns one bit per lane. As an integer, -1 has all bits set.
    bits = ir.IntType(LANES)
    lanes_as_bits = builder.bitcast(is_less, bits)
    return builder.icmp_signed("==", lanes_as_bits, ir.Constant(bits, -1))


@_operation(uncompiled.angle, _alike)
def _angle(builder: ir.IRBuilder, sine: ir.Value, cosine: ir.Value) -> ir.Value:
    kind = ir.FunctionType(_DOUBLE, [_DOUBLE, _DOUBLE])
    atan2 = cgutils.get_or_insert_function(builder.module, kind, "atan2")
    if sine.type == _DOUBLE:
        return builder.call(atan2, [sine, cosine])
    result = ir.Constant(_VECTOR, ir.Undefined)
    for lane in map(_INT32, range(LANES)):
        pair = (
            builder.extract_element(sine, lane),
            builder.extract_element(cosine, lane),
        )
        one = builder.call(atan2, pair)
        result = builder.insert_element(result, one, lane)
    return result


class _NoEnvironments:
    """numba code generator for parts, which does not set the environment of a function.

    An environment is the run-time data of a numba function. numba would store the address of the
    environment in the function's machine code, but a part has no machine code.
    """

    def __init__(self, codegen: object) -> None:
        self._codegen = codegen

    def __getattr__(self, name: str) -> object:
        return getattr(self._codegen, name)

    def set_env(self, *_: object) -> None:
        """Ignore the environment."""


class PartLibrary(CPUCodeLibrary):
    """numba library with the LLVM code of a part, and references to all called parts."""

    _whole: ir.Module | None = None

    @property
    def codegen(self) -> _NoEnvironments:
        """Code generator of this part."""
        return _NoEnvironments(self._codegen)

    def finalize(self) -> None:
        """Mark the library as complete, but do not optimise the LLVM code."""
        self._raise_if_finalized()
        self._finalized = True

    def add_linking_library(self, library: CodeLibrary) -> None:
        """Record a library with functions that this part calls."""
        super().add_linking_library(library)
        self._reload_init.update(library._reload_init)

    def get_pointer_to_function(self, name: str) -> int:
        """Return 0, because a part has no machine code."""
        self._ensure_finalized()
        return 0

    def _called(self, seen: set[CodeLibrary], order: list[CodeLibrary]) -> None:
        """Append to `order` all functions that this part calls, each after its own callees.

        Indirectly called functions are included. `seen` is the set of functions that need not be
        appended, because they have already been.
        """
        for library in self._linking_libraries:
            if library not in seen:
                seen.add(library)
                if isinstance(library, PartLibrary):
                    library._called(seen, order)
                order.append(library)

    def _get_module_for_linking(self) -> ir.Module:
        """Return the LLVM code of this part together with one copy of each called function."""
        if self._whole is None:
            self._whole = super()._get_module_for_linking().clone()
            order: list[CodeLibrary] = []
            self._called({self}, order)
            # LLVM drops a function that no code linked so far calls. So callers must be linked
            # before callees. A branch that is never taken may leave a function without callers.
            for library in reversed(order):
                part = isinstance(library, PartLibrary)
                get = CPUCodeLibrary if part else type(library)
                module = get._get_module_for_linking(library)
                self._whole.link_in(module, preserve=True)
        return self._whole


class PartCompiler(Compiler):
    """numba's compiler pipeline, with the result in a `PartLibrary`."""

    def __init__(
        self,
        typing: TypingContext,
        target: BaseContext,
        library: CodeLibrary,
        *rest: object,
    ) -> None:
        super().__init__(typing, target, library, *rest)
        if library is None:
            self.state.library = PartLibrary(self.state.targetctx.codegen(), "part")


class _StructType(Type):
    """numba type of a struct: a pointer to the 64-bit words of the struct; see `kernel.tree`."""

    def __init__(self, struct: Struct[NamedTuple]) -> None:
        self.struct = struct
        super().__init__(name=struct.name)


def _numba_type(kind: Kind | Struct[NamedTuple]) -> Type:
    """Return the numba type of a field of the given kind."""
    if isinstance(kind, Struct):
        return _StructType(kind)
    number = numba.from_dtype(np.dtype(kind.dtype))
    return Array(number, kind.axes, "C") if kind.axes else number


_struct_model = partial(extending.models.PrimitiveModel, be_type=_WORD.as_pointer())
extending.register_model(_StructType)(_struct_model)


@extending.infer_getattr
class _Fields(AttributeTemplate):
    key = _StructType

    def generic_resolve(self, kind: _StructType, name: str) -> Type | None:
        field_kind = kind.struct.kinds.get(name)
        return None if field_kind is None else _numba_type(field_kind)


@extending.lower_getattr_generic(_StructType)
def _field(
    context: BaseContext,
    builder: ir.IRBuilder,
    kind: _StructType,
    words: ir.Value,
    name: str,
) -> ir.Value:
    """Generate the LLVM code that reads the field `name` of a struct from its words.

    A number is one word. An array is a word with its address, and one word with the length of each
    axis. A field that is itself a struct takes all words of this struct, from its place on.
    """
    field_kind = _numba_type(kind.struct.kinds[name])
    first = kind.struct.places[name]

    def pointer(index: int) -> ir.Value:
        """Return the pointer to a word of the field."""
        return builder.gep(words, [_WORD(first + index)])

    def word(index: int) -> ir.Value:
        """Load a word of the field, a 64-bit integer."""
        value = builder.load(pointer(index))
        # The words are constant during a call, so LLVM may reuse a word that was read before.
        value.set_metadata("invariant.load", builder.module.add_metadata([]))
        return value

    if isinstance(field_kind, _StructType):
        return pointer(0)
    if field_kind == float64:
        # The word contains the bits of the double.
        return builder.bitcast(word(0), _DOUBLE)
    if field_kind == boolean:
        return builder.trunc(word(0), ir.IntType(1))
    if not isinstance(field_kind, Array):
        return word(0)
    array = context.make_array(field_kind)(context, builder)
    shape = [word(1 + axis) for axis in range(field_kind.ndim)]
    entry_type = context.get_data_type(field_kind.dtype)
    entry_size = context.get_constant(intp, context.get_abi_sizeof(entry_type))
    # The array is C-contiguous. The stride of an axis is the stride of the next axis times the
    # length of the next axis.
    strides = [entry_size]
    for length in reversed(shape[1:]):
        strides.insert(0, builder.mul(strides[0], length))
    data = builder.inttoptr(word(0), array.data.type)
    populate_array(array, data, shape, strides, entry_size, None)
    return array._getvalue()


def opener(kind: Struct[NamedTuple]) -> Callable[..., object]:
    """Return the numba function that interprets an array of words as a struct.

    In compiled code, a struct is the address of its first word.
    """

    def opened(_: TypingContext, words_type: Array) -> tuple[Signature, Generator]:
        """Return the signature of the function, and the generator of its LLVM code."""

        def generate(
            context: BaseContext,
            builder: ir.IRBuilder,
            _: Signature,
            arguments: Sequence[ir.Value],
        ) -> ir.Value:
            open_array = context.make_array(words_type)
            words = open_array(context, builder, arguments[0])
            return words.data  # address of the first word

        signature = _StructType(kind)(words_type)
        return signature, generate

    return extending.intrinsic(opened)


# Options of numba. "contract": a product and a sum may become one fused instruction, which rounds
# once. "numpy": a division by zero gives infinity or NaN, and no error. "_nrt": reference counting
# of arrays would take three quarters of the running time, so it is off. Without reference counting,
# kernel functions cannot allocate arrays.
_OPTIONS: dict[str, object] = {
    "fastmath": {"contract"},
    "error_model": "numpy",
    "_nrt": False,
}
_PART: dict[str, object] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
_PART |= {"pipeline_class": PartCompiler, **_OPTIONS}
_DECORATORS = {
    "inlined": numba.njit(forceinline=True, **_PART),
    "called": numba.njit(**_PART),
    "compiled": numba.njit(nogil=True, boundscheck=False, **_OPTIONS),
}


# LLVM's optimisation level. At level 3, numba's default, the loops take up to twice as long to
# compile and run as fast.
_LEVEL = 2


class Compiled(Protocol):
    """Function that numba compiles for each set of argument types."""

    compile: Callable[[object], object]
    stats: _CompileStats

    def __call__(self, *arguments: object) -> None:
        """Run the machine code."""


@contextmanager
def optimisation_level() -> Iterator[None]:
    """Let LLVM optimise at `_LEVEL` at most, until the context ends.

    The level belongs to the process, so other threads must not compile meanwhile.
    """
    with global_compiler_lock:
        level = config.OPT
        config.OPT = min(level, type(level)(_LEVEL))
        try:
            yield
        finally:
            config.OPT = level


@cache
def translated(function: FunctionType, how: str = "") -> Compiled:
    """Return a function of the kernel as a numba function that calls only numba functions.

    By default, the function becomes a part. For a function that Python calls, `how` must be
    "compiled", and numba stores the machine code on disk if any of its folders is writable.
    """
    names = {"__name__": function.__module__, **function.__globals__}
    for name in function.__code__.co_names:
        if name in names:
            names[name] = _counterpart(names[name])
    twin = FunctionType(
        function.__code__,
        names,
        function.__name__,
        function.__defaults__,
        function.__closure__,
    )
    usual = "called" if function in uncompiled.CALLED else "inlined"
    made = _DECORATORS[how or usual](twin)
    if how == "compiled":
        # numba raises RuntimeError if neither the folder of the source nor the cache folder of
        # the user is writable.
        with suppress(RuntimeError):
            made.enable_caching()
    return made


def _counterpart(value: object) -> object:
    """Return the value that replaces a global variable of a kernel module in compiled code."""
    if isinstance(value, Struct):
        return opener(value)
    if isinstance(value, ModuleType) and value.__name__.startswith("fflin.kernel."):
        return _translated_module(value)
    if callable(value):
        value = uncompiled.IN_PLACE.get(value, value)
    return translated(value) if isinstance(value, FunctionType) else value


@cache
def _translated_module(module: ModuleType) -> ModuleType:
    twin = ModuleType(module.__name__)
    for name, value in vars(module).items():
        if not isinstance(value, ModuleType):
            setattr(twin, name, _counterpart(value))
    return twin
