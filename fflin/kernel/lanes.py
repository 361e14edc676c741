"""The operations and decorators of which the kernel's functions are written.

A function of the kernel is a Python function. Called as it stands, with arrays or lists of one
axis, it computes with one number at a time; the simulation in Python calls it so, and a debugger
works in it. `kernel.lane_code` compiles the same function, also for arrays of two axes with eight
lanes side by side, where each operation has its machine code.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np

F = TypeVar("F", bound=Callable[..., Any])

# How each function of the kernel is compiled.
HOW: dict[Callable[..., Any], str] = {}
# The loop that is compiled in place of an operation of NumPy.
LOOPS: dict[Callable[..., Any], Callable[..., Any]] = {}


def _decorator(how: str) -> Callable[[F], F]:
    def noted(function: F) -> F:
        HOW[function] = how
        return function

    return noted


inlined = _decorator("inlined")
# Called where it is seldom needed: inlined functions take longest to compile.
called = _decorator("called")
# Called from Python; its machine code is kept on disk.
compiled = _decorator("compiled")

floor, whole, root, angle = np.floor, np.rint, np.sqrt, math.atan2


def load(array: Any, index: int) -> Any:
    """Return an entry of an array: one number, or one number per lane."""
    return array[index]


def store(array: Any, index: int, value: Any) -> None:
    """Write a number or lanes at an index."""
    array[index] = value


def splat(array: Any, value: float) -> Any:
    """Return a number as an array holds them, alone or in all lanes."""
    return value


def peek(array: Any, index: int, lane: int) -> Any:
    """Return the number of a lane at an index."""
    return array[index]


def poke(array: Any, index: int, lane: int, value: float) -> None:
    """Write the number of a lane at an index."""
    array[index] = value


def chosen(left: Any, right: Any, less: Any, other: Any) -> Any:
    """Return `less` where left < right, and `other` elsewhere and where one is NaN."""
    return less if left < right else other


def below(value: Any, bound: Any) -> Any:
    """Return whether a number, or every lane, is less than a bound; false for NaN."""
    return value < bound


@inlined
def width(array: Any) -> Any:
    """Return how many lanes an array has; none where it is empty."""
    return array.size // max(len(array), 1)


def row_product(a: Any, first: int, b: Any, second: int, count: int) -> Any:
    """Return the scalar product of `count` entries of two arrays of numbers."""
    return a[first : first + count].dot(b[second : second + count])


def add_row(a: Any, first: int, share: float, b: Any, second: int, count: int) -> None:
    """Add `share` times `count` entries of an array of numbers to entries of another."""
    a[first : first + count] += share * b[second : second + count]


def row_products(a: Any, size: int, b: Any, out: Any) -> None:
    """Write the scalar product of each `size` entries of an array with the first of another."""
    np.dot(a.reshape(len(out), size), b[:size], out)


def remove_components(Q: Any, size: int, count: int, x: Any, found: Any, first: int) -> None:
    """Make x orthogonal to the first `count` rows of Q, and write its components along them."""
    basis = Q[: count * size].reshape(count, size)
    components = basis.dot(x)
    x -= components.dot(basis)
    # Once more: the first time leaves a share of what it removes to rounding.
    rest = basis.dot(x)
    x -= rest.dot(basis)
    np.add(components, rest, found[first : first + count])


def write_scaled(source: Any, lane: int, share: float, target: Any) -> None:
    """Write `share` times the first entries of a lane of an array into an array of numbers."""
    target[:] = share * source[: len(target)]


@called
def _row_product(a: Any, first: int, b: Any, second: int, count: int) -> Any:
    total = 0.0
    for index in range(count):
        total += a[first + index] * b[second + index]
    return total


@called
def _add_row(a: Any, first: int, share: float, b: Any, second: int, count: int) -> None:
    for index in range(count):
        a[first + index] += share * b[second + index]


@called
def _row_products(a: Any, size: int, b: Any, out: Any) -> None:
    for index in range(len(out)):
        out[index] = _row_product(a, index * size, b, 0, size)


@called
def _remove_components(Q: Any, size: int, count: int, x: Any, found: Any, first: int) -> None:
    # One after the other: as exact as Householder's factor, if x is its last column.
    for index in range(count):
        share = _row_product(Q, index * size, x, 0, size)
        _add_row(x, 0, -share, Q, index * size, size)
        found[first + index] = share


@called
def _write_scaled(source: Any, lane: int, share: float, target: Any) -> None:
    for index in range(len(target)):
        target[index] = share * peek(source, index, lane)


LOOPS |= {
    row_product: _row_product,
    row_products: _row_products,
    add_row: _add_row,
    remove_components: _remove_components,
    write_scaled: _write_scaled,
}
