"""Compilation of the kernel's functions by numba, with the functions that they call.

`translated` converts a function of the kernel to a numba function. By default, numba generates
machine code for each function together with all functions that it calls. A function at the end of a
chain of ten calls would be compiled ten times. Here a part (a function called only by compiled
functions) remains LLVM code. It becomes machine code only once, as a piece of the function that
Python calls.
"""

from __future__ import annotations

from functools import cache
from types import FunctionType, ModuleType
from typing import Any

import numba
import numpy as np
from llvmlite import ir
from numba.core.codegen import CPUCodeLibrary
from numba.core.compiler import Compiler
from numba.core.typing.templates import AttributeTemplate
from numba.extending import (
    infer_getattr,
    intrinsic,
    lower_getattr_generic,
    models,
    register_model,
)
from numba.np.arrayobj import populate_array

from fflin.kernel.arguments import Opener, Struct
from fflin.kernel.lane_code import OPERATIONS
from fflin.kernel.lanes import HOW, LOOPS

_WORD, _DOUBLE = ir.IntType(64), ir.DoubleType()


class _NoEnvironments:
    """numba code generator that sets no environment: a part has no machine code to refer to it."""

    def __init__(self, codegen: Any) -> None:
        self._codegen = codegen

    def __getattr__(self, name: str) -> Any:
        return getattr(self._codegen, name)

    def set_env(self, *_: Any) -> None:
        """Ignore the environment."""


class PartLibrary(CPUCodeLibrary):
    """LLVM code of a part, and the other parts that it calls."""

    def __init__(self, codegen: Any, name: str) -> None:
        super().__init__(codegen, name)
        self._whole: Any = None

    @property
    def codegen(self) -> Any:
        """Compiler of this part."""
        return _NoEnvironments(self._codegen)

    def finalize(self) -> None:
        """Mark the library as complete without optimising its code."""
        self._raise_if_finalized()
        self._finalized = True

    def add_linking_library(self, library: Any) -> None:
        """Record a library whose functions this part calls."""
        super().add_linking_library(library)
        self._reload_init.update(library._reload_init)

    def get_pointer_to_function(self, name: str) -> int:
        """Return 0, because a part has no machine code."""
        self._ensure_finalized()
        return 0

    def _called(self, found: dict[Any, None]) -> None:
        for library in self._linking_libraries:
            if library not in found:
                found[library] = None
                if isinstance(library, PartLibrary):
                    library._called(found)

    def _own_module(self) -> Any:
        """Return the LLVM code without the code of called functions."""
        return super()._get_module_for_linking()

    def _get_module_for_linking(self) -> Any:
        """Return the LLVM code with one copy of each called part."""
        if self._whole is None:
            found: dict[Any, None] = {self: None}
            self._called(found)
            self._whole = self._own_module().clone()
            for library in list(found)[1:]:
                part = isinstance(library, PartLibrary)
                module = library._own_module() if part else library._get_module_for_linking()
                self._whole.link_in(module, preserve=True)
        return self._whole


class PartCompiler(Compiler):
    """numba's compiler pipeline for a part."""

    def __init__(self, typingctx: Any, targetctx: Any, library: Any, *rest: Any) -> None:
        super().__init__(typingctx, targetctx, library, *rest)
        if library is None:
            self.state.library = PartLibrary(self.state.targetctx.codegen(), "part")


class _StructType(numba.types.Type):
    """The numba type of a struct: a pointer to its words."""

    def __init__(self, struct: Struct) -> None:
        self.struct = struct
        super().__init__(name=struct.name)


def _numba_type(kind: Any) -> Any:
    """Return the numba type of a kind."""
    if isinstance(kind, Struct):
        return _StructType(kind)
    number = numba.from_dtype(np.dtype(kind.dtype))
    return numba.types.Array(number, kind.axes, "C") if kind.axes else number


@register_model(_StructType)
class _StructModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _WORD.as_pointer())


@infer_getattr
class _Fields(AttributeTemplate):
    key = _StructType

    def generic_resolve(self, kind: Any, name: str) -> Any:
        found = kind.struct.kinds.get(name)
        return None if found is None else _numba_type(found)


@lower_getattr_generic(_StructType)
def _field(context: Any, builder: Any, kind: Any, words: Any, name: str) -> Any:
    found, first = _numba_type(kind.struct.kinds[name]), kind.struct.places[name]

    def at(place: int) -> Any:
        return builder.gep(words, [_WORD(first + place)])

    def word(place: int) -> Any:
        value = builder.load(at(place))
        # The words are constant during a call, so LLVM may reuse a value that it has read.
        value.set_metadata("invariant.load", builder.module.add_metadata([]))
        return value

    if isinstance(found, _StructType):
        return at(0)
    if found == numba.types.float64:
        return builder.bitcast(word(0), _DOUBLE)
    if found == numba.types.boolean:
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
    """Return the numba function that interprets an array of words as a struct."""

    @intrinsic
    def opened(typing: Any, words: Any) -> Any:
        def generate(context: Any, builder: Any, _: Any, arguments: Any) -> Any:
            return context.make_array(words)(context, builder, arguments[0]).data

        return _StructType(kind)(words), generate

    return opened


# A product and a sum may become one fused instruction, which rounds once. A division by zero gives
# infinity. Reference counting of arrays is off, because it would take three quarters of the
# running time. So kernel functions cannot allocate arrays.
_OPTIONS: dict[str, Any] = {"fastmath": {"contract"}, "error_model": "numpy", "_nrt": False}
_PART: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
_PART |= {"pipeline_class": PartCompiler, **_OPTIONS}
_DECORATORS = {
    "inlined": numba.njit(forceinline=True, **_PART),
    "called": numba.njit(**_PART),
    "compiled": numba.njit(nogil=True, cache=True, boundscheck=False, **_OPTIONS),
}


@cache
def translated(function: Any) -> Any:
    """Convert a function of the kernel, and the functions that it calls, to numba functions."""
    names = {"__name__": function.__module__, **function.__globals__}
    for name in function.__code__.co_names:
        if name in names:
            names[name] = _counterpart(names[name])
    twin = FunctionType(
        function.__code__, names, function.__name__, function.__defaults__, function.__closure__
    )
    return _DECORATORS[HOW[function]](twin)


def _counterpart(value: Any) -> Any:
    """Return the value that compiled code uses in place of a global of a kernel module."""
    if isinstance(value, Opener):
        return opener(value.kind)
    if isinstance(value, ModuleType) and value.__name__.startswith("fflin.kernel."):
        return _translated_module(value)
    if isinstance(value, FunctionType) and LOOPS.get(value, value) in HOW:
        return translated(LOOPS.get(value, value))
    return OPERATIONS.get(value, value) if callable(value) else value


@cache
def _translated_module(module: ModuleType) -> ModuleType:
    twin = ModuleType(module.__name__)
    for name, value in vars(module).items():
        if not isinstance(value, ModuleType):
            setattr(twin, name, _counterpart(value))
    return twin
