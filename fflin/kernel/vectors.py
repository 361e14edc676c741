"""Vectors of three in numba code, each entry eight doubles side by side."""

from __future__ import annotations

import numba

from fflin.kernel.lanes import load, splat, store
from fflin.kernel.tree import LANES


@numba.njit(forceinline=True)
def put3(work, at, x, y, z):
    """Write a vector."""
    store(work, at, x)
    store(work, at + LANES, y)
    store(work, at + 2 * LANES, z)


@numba.njit(forceinline=True)
def get3(work, at):
    """Read a vector."""
    return load(work, at), load(work, at + LANES), load(work, at + 2 * LANES)


@numba.njit(forceinline=True)
def add(work, at, value):
    """Add to an entry."""
    store(work, at, load(work, at) + value)


@numba.njit(forceinline=True)
def add3(work, at, x, y, z):
    """Add to a vector."""
    add(work, at, x)
    add(work, at + LANES, y)
    add(work, at + 2 * LANES, z)


@numba.njit(forceinline=True)
def cross(a, b):
    """Return a x b."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@numba.njit(forceinline=True)
def dot(a, b):
    """Return a . b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@numba.njit(forceinline=True)
def plus(a, b):
    """Return a + b."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@numba.njit(forceinline=True)
def minus(a, b):
    """Return a - b."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@numba.njit(forceinline=True)
def times(a, value):
    """Return a vector times eight numbers."""
    return a[0] * value, a[1] * value, a[2] * value


@numba.njit(forceinline=True)
def turned(work, place, x, y, z):
    """Return constants x, y, z in the axes of a place as a vector in base axes."""
    return plus(
        plus(times(get3(work, place), splat(x)), times(get3(work, place + 3 * LANES), splat(y))),
        times(get3(work, place + 6 * LANES), splat(z)),
    )
