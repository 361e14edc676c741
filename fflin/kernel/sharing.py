"""What is asked for by one set of inputs, shared out to another: least squares within bounds.

An active set method, from the inputs that push alone at zero: the problem is strictly convex, so
that the order in which inputs meet their bounds does not matter.

References
----------
C. L. Lawson and R. J. Hanson, Solving Least Squares Problems, SIAM, 1995, chapter 23.
"""

from __future__ import annotations

from collections import namedtuple

import numpy as np

from fflin.kernel.arguments import INDICES, LANED, Struct
from fflin.kernel.factor import factorise
from fflin.kernel.forward import MECHANICS, POINT, configure, push, seen, turn_held
from fflin.kernel.lanes import called, inlined, load, peek, poke, root, store, width
from fflin.kernel.places import columns_of
from fflin.kernel.rnea import write_columns
from fflin.kernel.vectors import copy, put3

LEAST = 1e-7  # of the rows that choose the least of what does the same
_LOW, _HIGH, _FREE, _TRIED = 0, 1, 2, 4


class Sharing(
    namedtuple(
        "Sharing", "asking giving point least most work columns Q R b wanted x s low high state"
    )
):
    """Whose inputs ask, and whose give, (k,) within `least` and `most`.

    The `point` has q and the inputs of either; `work` and what follows are work space. There is
    nothing to share out where k is 0.
    """


SHARING = Struct(
    Sharing,
    asking=MECHANICS,
    giving=MECHANICS,
    point=POINT,
    work=LANED,
    columns=LANED,
    state=INDICES,
)


@inlined
def half_solve(work, tree, x, first):
    """Turn a force at x into D^-1/2 L^-T f, whose square is that of its accelerations by M."""
    for k in range(len(tree.row) - 1, -1, -1):
        value, row = load(x, first + k), tree.row[k]
        for t in range(tree.depth[k]):
            at = first + tree.path[row + t]
            store(x, at, load(x, at) - load(work, tree.packed + row + t) * value)
        store(x, first + k, value * root(load(work, tree.scaled + row + tree.depth[k])))


@inlined
def share_out(sharing, point, asked):
    """Write what is asked for, or shared out where there is a way to."""
    if len(sharing.least) == 0:
        copy(asked, 0, point.u, 0, len(point.u))
    else:
        share(sharing, point, asked)


@called
def share(sharing, point, asked):
    """Write the inputs that come nearest to what is asked for."""
    work, columns, asking, giving = sharing.work, sharing.columns, sharing.asking, sharing.giving
    own, tree = sharing.point, asking.tree
    size, count = len(tree.row), len(sharing.least)
    copy(point.q, 0, own.q, 0, len(own.q))
    configure(work, asking, own.q)
    factorise(work, tree)
    copy(asked, 0, own.pushing, 0, len(asked))
    turn_held(asking, own)
    push(work, asking, own.pushing)
    copy(work, asking.layout.c, columns, count * size, size)
    _write_all(work, giving, own, columns)
    for column in range(count + 1):
        half_solve(work, tree, columns, column * size)
    for lane in range(width(point.u)):
        _nearest(sharing, size, lane)
        for index in range(count):
            poke(point.u, index, lane, sharing.x[index])


@inlined
def _write_all(work, giving, own, columns):
    """Write the generalised force of a unit of each input, one after the other."""
    tree, layout, loads = giving.tree, giving.layout, giving.loads
    size, carried = len(tree.row), len(loads.body)
    for entry in range(len(giving.row) * size):
        store(columns, entry, 0.0)
    for index in range(len(giving.row)):
        if giving.row[index] >= 0:
            store(columns, index * size + giving.row[index], 1.0)
    for index in range(len(giving.held)):
        at, axes = giving.held[index], columns_of(seen(giving, own.q))
        for axis in range(3):
            turned = axes[0][axis], axes[1][axis], axes[2][axis]
            put3(columns, (at + axis) * size + giving.row[at], turned)
    write_columns(work, tree, layout, loads)
    for index in range(carried):
        first = loads.input[index] * size
        for row in range(size):
            store(columns, first + row, load(work, layout.columns + row * carried + index))


@called
def _nearest(sharing, size, lane):
    """Write the solution of a lane into x."""
    x, low, high, state, wanted = (
        sharing.x,
        sharing.low,
        sharing.high,
        sharing.state,
        sharing.wanted,
    )
    least, most, columns = sharing.least, sharing.most, sharing.columns
    count, unit, force = len(least), 0.0, 0.0
    for entry in range(count * size):
        unit += peek(columns, entry, lane) ** 2
    for row in range(size):
        force += peek(columns, count * size + row, lane) ** 2
    unit, force = np.sqrt(unit), np.sqrt(force)
    nothing = not (unit > 0.0 and force > 0.0)
    scale = 1.0 if nothing else unit / force
    for j in range(count):
        low[j], high[j] = least[j] * scale, max(most[j] * scale, least[j] * scale + 1e-15)
        x[j] = min(max(0.0, low[j]), high[j])
        state[j] = _LOW if least[j] == 0.0 else _FREE
    for row in range(size):
        wanted[row] = peek(columns, count * size + row, lane) / force
    # The rounding of what cannot be given would drown the rows of the least: it goes.
    for _ in range(0 if nothing else 2):
        _solve(sharing, size, lane, unit)
        for row in range(size):
            wanted[row] = 0.0
            for j in range(count):
                wanted[row] += peek(columns, j * size + row, lane) / unit * x[j]
    for j in range(count):
        # What is no number stays none.
        x[j] = min(max(x[j] / scale, least[j]), most[j]) + 0.0 * force


@inlined
def _solve(sharing, size, lane, unit):
    """Write the solution of what is wanted into x, from what is there and its state on."""
    x, s, low, high, state = sharing.x, sharing.s, sharing.low, sharing.high, sharing.state
    count, newest = len(x), -1
    for _ in range(20 * count):
        _fit(sharing, size, lane, unit)
        hit, step = -1, 1.0
        for j in range(count):
            if state[j] == _FREE and not low[j] <= s[j] <= high[j]:
                bound = low[j] if s[j] < low[j] else high[j]
                way = (bound - x[j]) / (s[j] - x[j])
                if hit < 0 or way < step:
                    hit, step = j, way
        if hit >= 0:
            for j in range(count):
                if state[j] == _FREE:
                    x[j] += step * (s[j] - x[j])
            x[hit] = low[hit] if s[hit] < low[hit] else high[hit]
            state[hit] = _LOW if s[hit] < low[hit] else _HIGH
            if hit != newest or step > 0.0:
                newest = -1
                continue
            # It goes the wrong way by rounding alone: another is tried.
            state[hit] += _TRIED
            _fit(sharing, size, lane, unit)
        for j in range(count):
            if state[j] == _FREE:
                x[j] = s[j]
            elif hit < 0:
                state[j] %= _TRIED
        newest = _steepest(sharing, size, lane, unit)
        if newest < 0:
            break
        state[newest] = _FREE


@called
def _fit(sharing, size, lane, unit):
    """Write the least squares of what is free into s, and what is left of the force into b.

    By modified Gram and Schmidt, the force being the last column: as exact as Householder's.
    """
    s, R, state, count = sharing.s, sharing.R, sharing.state, len(sharing.least)
    _leave(sharing, size, lane, unit)
    for j in range(count):
        if state[j] == _FREE:
            _orthogonalise(sharing, size, lane, unit, j)
    for j in range(count - 1, -1, -1):
        if state[j] == _FREE:
            for i in range(j + 1, count):
                if state[i] == _FREE:
                    s[j] -= R[j * count + i] * s[i]
            s[j] /= R[j * count + j]


@inlined
def _leave(sharing, size, lane, unit):
    """Write what is wanted, less what is given at bounds, into b."""
    x, b, state, count = sharing.x, sharing.b, sharing.state, len(sharing.least)
    for row in range(size):
        b[row] = sharing.wanted[row]
    for j in range(count):
        b[size + j] = 0.0
        if state[j] != _FREE:
            b[size + j] = -LEAST * x[j]
            for row in range(size):
                b[row] -= x[j] * peek(sharing.columns, j * size + row, lane) / unit


@inlined
def _orthogonalise(sharing, size, lane, unit, j):
    """Write the part of a column that is across those before, and take its share of b into s."""
    b, Q, R, count = sharing.b, sharing.Q, sharing.R, len(sharing.least)
    rows = size + count
    first = j * rows
    for row in range(size):
        Q[first + row] = peek(sharing.columns, j * size + row, lane) / unit
    for row in range(count):
        Q[first + size + row] = LEAST if row == j else 0.0
    for i in range(j):
        if sharing.state[i] == _FREE:
            total = 0.0
            for row in range(rows):
                total += Q[i * rows + row] * Q[first + row]
            for row in range(rows):
                Q[first + row] -= total * Q[i * rows + row]
            R[i * count + j] = total
    total = 0.0
    for row in range(rows):
        total += Q[first + row] ** 2
    total = np.sqrt(total)
    R[j * count + j] = total
    share = 0.0
    for row in range(rows):
        Q[first + row] /= total
        share += Q[first + row] * b[row]
    for row in range(rows):
        b[row] -= share * Q[first + row]
    sharing.s[j] = share


@called
def _steepest(sharing, size, lane, unit):
    """Return what is at a bound, untried, and best leaves it; -1 where nothing does."""
    best, found, columns, b = 0.0, -1, sharing.columns, sharing.b
    for j in range(len(sharing.least)):
        state = sharing.state[j]
        if state in (_LOW, _HIGH):
            slope = LEAST * b[size + j]
            for row in range(size):
                slope += peek(columns, j * size + row, lane) / unit * b[row]
            if state == _HIGH:
                slope = -slope
            if slope > best:
                best, found = slope, j
    return found
