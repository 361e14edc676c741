"""Vectors of three and spatial vectors in numba code, each entry eight doubles side by side.

A spatial vector is a pair of vectors: (angular, linear) velocity, or (moment, force).
"""

from __future__ import annotations

import numba

from fflin.kernel.lanes import load, splat, store
from fflin.kernel.tree import LANES


@numba.njit(forceinline=True)
def get3(work, at):
    """Read a vector."""
    return load(work, at), load(work, at + LANES), load(work, at + 2 * LANES)


@numba.njit(forceinline=True)
def put3(work, at, a):
    """Write a vector."""
    store(work, at, a[0])
    store(work, at + LANES, a[1])
    store(work, at + 2 * LANES, a[2])


@numba.njit(forceinline=True)
def add(work, at, value):
    """Add to an entry."""
    store(work, at, load(work, at) + value)


@numba.njit(forceinline=True)
def add3(work, at, a):
    """Add to a vector."""
    add(work, at, a[0])
    add(work, at + LANES, a[1])
    add(work, at + 2 * LANES, a[2])


@numba.njit(forceinline=True)
def get6(work, at):
    """Read a spatial vector."""
    return get3(work, at), get3(work, at + 3 * LANES)


@numba.njit(forceinline=True)
def put6(work, at, s):
    """Write a spatial vector."""
    put3(work, at, s[0])
    put3(work, at + 3 * LANES, s[1])


@numba.njit(forceinline=True)
def add6(work, at, s):
    """Add to a spatial vector."""
    add3(work, at, s[0])
    add3(work, at + 3 * LANES, s[1])


@numba.njit(forceinline=True)
def get_columns(work, at):
    """Read a matrix of three columns."""
    return get3(work, at), get3(work, at + 3 * LANES), get3(work, at + 6 * LANES)


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
def product(columns, a):
    """Return a matrix, given by its columns, times a vector."""
    return plus(plus(times(columns[0], a[0]), times(columns[1], a[1])), times(columns[2], a[2]))


@numba.njit(forceinline=True)
def turned(axes, x, y, z):
    """Return a rotation, given by its columns, times the constants x, y, z."""
    return product(axes, (splat(x), splat(y), splat(z)))


@numba.njit(forceinline=True)
def dot6(s, t):
    """Return the power of a force along a motion, or the other way round."""
    return dot(s[0], t[0]) + dot(s[1], t[1])


@numba.njit(forceinline=True)
def plus6(s, t):
    """Return s + t of spatial vectors."""
    return plus(s[0], t[0]), plus(s[1], t[1])


@numba.njit(forceinline=True)
def minus6(s, t):
    """Return s - t of spatial vectors."""
    return minus(s[0], t[0]), minus(s[1], t[1])


@numba.njit(forceinline=True)
def times6(s, value):
    """Return a spatial vector times eight numbers."""
    return times(s[0], value), times(s[1], value)
