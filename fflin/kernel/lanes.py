"""The operations and decorators with which the kernel's functions are written.

A function of the kernel is a Python function. Called directly, with arrays or lists of one axis, it
computes one number at a time. The Python engine calls it like this, and a debugger can step through
it. `kernel.machine_code` compiles the same function, also for arrays with a second axis of eight
lanes. In compiled code, other operations of `kernel.machine_code` replace the operations below.
"""

import math
from collections.abc import Callable
from typing import TypeAlias, TypeVar

import numpy as np

from fflin.base.validation import Array

F = TypeVar("F", bound=Callable[..., object])

# One number; in compiled code also eight lanes.
Number: TypeAlias = float
# Numbers in memory. The entries of a list are read faster than the entries of an array.
Entries: TypeAlias = Array | list[Number]

# {function of the kernel: how it is compiled}. All other functions are inlined in their callers.
HOW: dict[Callable[..., object], str] = {}
# {function that uses NumPy: loop that is compiled in its place}.
LOOPS: dict[Callable[..., object], Callable[..., object]] = {}


def _decorator(how: str) -> Callable[[F], F]:
    def noted(function: F) -> F:
        HOW[function] = how
        return function

    return noted


# For functions that are rarely called: inlining saves little there, and takes long to compile.
called = _decorator("called")
# For functions called from Python; their machine code is stored on disk.
compiled = _decorator("compiled")

floor, whole, root, angle = np.floor, np.rint, np.sqrt, math.atan2


def load(array: Entries, index: int) -> Number:
    """Return an entry of an array: one number, or one number per lane."""
    return array[index]


def store(array: Entries, index: int, value: Number) -> None:
    """Write a number or lanes at an index."""
    array[index] = value


def splat(array: Entries, value: float) -> Number:
    """Convert a number to the entry type of an array: one number, or the number in all lanes."""
    return value


def chosen(left: Number, right: Number, less: Number, other: Number) -> Number:
    """Return `less` if left < right, else `other`, lane by lane; a comparison with NaN is false."""
    return less if left < right else other


def below(value: Number, bound: Number) -> bool:
    """Return whether a number, or every lane, is less than a bound; false for NaN."""
    return value < bound


def peek(array: Array, index: int, lane: int) -> float:
    """Return the value of a lane at an index."""
    value: float = array[index] if array.ndim == 1 else array[index, lane]
    return value


def poke(array: Array, index: int, lane: int, value: float) -> None:
    """Write the value of a lane at an index."""
    if array.ndim == 1:
        array[index] = value
    else:
        array[index, lane] = value


def width(array: Array) -> int:
    """Return the number of lanes of an array, 0 if the array is empty."""
    return array.size // max(len(array), 1)


def row_product(a: Array, first: int, b: Array, second: int, count: int) -> float:
    """Return the scalar product of `count` entries of two arrays of numbers."""
    return a[first : first + count].dot(b[second : second + count])


def add_row(a: Array, first: int, factor: float, b: Array, second: int, count: int) -> None:
    """Add `factor` times `count` entries of b, from `second` on, to entries of a."""
    a[first : first + count] += factor * b[second : second + count]


def row_products(a: Array, size: int, b: Array, out: Array) -> None:
    """Write the scalar product of each row of `size` entries of a with the first entries of b."""
    np.dot(a.reshape(len(out), size), b[:size], out)


def remove_components(Q: Array, size: int, count: int, x: Array, found: Array, first: int) -> None:
    """Make x orthogonal to the first `count` rows of Q, and write its components along them."""
    basis = Q[: count * size].reshape(count, size)
    components = basis.dot(x)
    x -= components.dot(basis)
    # Orthogonalise twice, because rounding errors leave part of the components after the first
    # pass.
    rest = basis.dot(x)
    x -= rest.dot(basis)
    np.add(components, rest, found[first : first + count])


def write_scaled(source: Array, lane: int, factor: float, target: Array) -> None:
    """Write `factor` times the first entries of one lane of `source` into `target`."""
    target[:] = factor * source[: len(target)]


@called
def _row_product(a: Array, first: int, b: Array, second: int, count: int) -> float:
    total = 0.0
    for index in range(count):
        total += a[first + index] * b[second + index]
    return total


@called
def _add_row(a: Array, first: int, share: float, b: Array, second: int, count: int) -> None:
    for index in range(count):
        a[first + index] += share * b[second + index]


@called
def _row_products(a: Array, size: int, b: Array, out: Array) -> None:
    for index in range(len(out)):
        out[index] = _row_product(a, index * size, b, 0, size)


@called
def _remove_components(Q: Array, size: int, count: int, x: Array, found: Array, first: int) -> None:
    # Modified Gram-Schmidt. If the right-hand side is treated as the last column of the matrix,
    # the least squares solution is as accurate as with Householder's method.
    for index in range(count):
        share = _row_product(Q, index * size, x, 0, size)
        _add_row(x, 0, -share, Q, index * size, size)
        found[first + index] = share


@called
def _write_scaled(source: Array, lane: int, share: float, target: Array) -> None:
    for index in range(len(target)):
        target[index] = share * peek(source, index, lane)


LOOPS |= {
    row_product: _row_product,
    row_products: _row_products,
    add_row: _add_row,
    remove_components: _remove_components,
    write_scaled: _write_scaled,
}
