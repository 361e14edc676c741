"""Vectors of three and spatial vectors in numba code, each entry a number or lanes.

A spatial vector is a pair of vectors: (angular, linear) velocity, or (moment, force).
"""

from __future__ import annotations

from fflin.kernel.lanes import inlined, load, store


@inlined
def get3(work, at):
    """Read a vector."""
    return load(work, at), load(work, at + 1), load(work, at + 2)


@inlined
def put3(work, at, a):
    """Write a vector."""
    store(work, at, a[0])
    store(work, at + 1, a[1])
    store(work, at + 2, a[2])


@inlined
def copy(source, first, target, to, count):
    """Copy entries."""
    for index in range(count):
        store(target, to + index, load(source, first + index))


@inlined
def add(work, at, value):
    """Add to an entry."""
    store(work, at, load(work, at) + value)


@inlined
def add3(work, at, a):
    """Add to a vector."""
    add(work, at, a[0])
    add(work, at + 1, a[1])
    add(work, at + 2, a[2])


@inlined
def get6(work, at):
    """Read a spatial vector."""
    return get3(work, at), get3(work, at + 3)


@inlined
def put6(work, at, s):
    """Write a spatial vector."""
    put3(work, at, s[0])
    put3(work, at + 3, s[1])


@inlined
def add6(work, at, s):
    """Add to a spatial vector."""
    add3(work, at, s[0])
    add3(work, at + 3, s[1])


@inlined
def get_columns(work, at):
    """Read a matrix of three columns."""
    return get3(work, at), get3(work, at + 3), get3(work, at + 6)


@inlined
def cross(a, b):
    """Return a x b."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@inlined
def dot(a, b):
    """Return a . b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inlined
def plus(a, b):
    """Return a + b."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@inlined
def minus(a, b):
    """Return a - b."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@inlined
def times(a, value):
    """Return a vector times a number."""
    return a[0] * value, a[1] * value, a[2] * value


@inlined
def product(columns, a):
    """Return a matrix, given by its columns, times a vector."""
    return plus(plus(times(columns[0], a[0]), times(columns[1], a[1])), times(columns[2], a[2]))


@inlined
def across(columns, a):
    """Return the transpose of a matrix, given by its columns, times a vector."""
    return dot(columns[0], a), dot(columns[1], a), dot(columns[2], a)


@inlined
def dot6(s, t):
    """Return the power of a force along a motion, or the other way round."""
    return dot(s[0], t[0]) + dot(s[1], t[1])


@inlined
def plus6(s, t):
    """Return s + t of spatial vectors."""
    return plus(s[0], t[0]), plus(s[1], t[1])


@inlined
def minus6(s, t):
    """Return s - t of spatial vectors."""
    return minus(s[0], t[0]), minus(s[1], t[1])


@inlined
def times6(s, value):
    """Return a spatial vector times a number."""
    return times(s[0], value), times(s[1], value)
