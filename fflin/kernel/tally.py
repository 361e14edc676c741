"""What is kept of eight runs while they go on, row by row of the compiled loop."""

from __future__ import annotations

from collections import namedtuple

import numpy as np

from fflin.kernel.lanes import angle, chosen, compiled, inlined, load, root, store
from fflin.kernel.laws import read_state
from fflin.kernel.places import attitude, quaternion_times
from fflin.kernel.tracking import error
from fflin.kernel.vectors import copy, dot


class Marks(
    namedtuple(
        "Marks",
        "index circling origin turned near home way speed kind settled there steps point at x e "
        "sizes largest_x largest_u largest outside errors inputs",
    )
):
    """What is compared, as `Mechanics`, `Law` and `Path` name it, and the marks so far.

    Errors are from the state `home` (nx,), which `point` has the attitude of, or from the rows q
    and nu of a `way` and its `speed`. `kind` (nx,) is 0 for a state without a kind of its own and
    -1 for one that has no error either. `settled` is the share of the largest, and `there` (kinds,)
    the sizes, below which an error has settled; at `steps` (times,) errors and inputs are kept.
    `at`, x and e are work space. All from `x` on are in lanes.
    """


@inlined
def _size(value):
    return chosen(value, 0.0, -value, value)


@inlined
def _grow(marks, index, value):
    """Write the larger of a mark and a number."""
    store(marks, index, chosen(load(marks, index), value, value, load(marks, index)))


@inlined
def _compare(marks, step):
    """Write the errors at a step, and the size of each kind."""
    at, there, sizes = marks.at, marks.point, marks.sizes
    if len(marks.way) > 0:
        copy(marks.way, step * len(there.q), there.q, 0, len(there.q))
        copy(marks.speed, step * len(there.nu), there.nu, 0, len(there.nu))
        error(marks, marks, at)
    else:
        read_state(marks, marks, at, 0)
        for index in range(len(marks.e)):
            store(marks.e, index, load(marks.x, index) - load(marks.home, index))
    for kind in range(len(sizes)):
        store(sizes, kind, 0.0)
    for index in range(len(marks.e)):
        value, kind = _size(load(marks.e, index)), marks.kind[index]
        if kind >= 0:
            _grow(marks.largest_x, index, value)
        if kind > 0:
            _grow(sizes, kind, value)
    (x, y, z), w = attitude(there.q)
    vector, scalar = quaternion_times(((-x, -y, -z), w), attitude(at.q))
    half = angle(root(dot(vector, vector)), _size(scalar))
    store(sizes, 0, half * (360.0 / np.pi))


@compiled
def take(marks, rows, first, count):
    """Take so many rows as `loop.advance` writes, the first of which is of a step, into account."""
    at, sizes, kept = marks.at, marks.sizes, 0
    width, inputs = len(at.q) + len(at.nu), len(marks.largest_u)
    while kept < len(marks.steps) and marks.steps[kept] < first:
        kept += 1
    for row in range(count):
        step, begin = first + row, row * (width + inputs + 9)
        copy(rows, begin, at.q, 0, len(at.q))
        copy(rows, begin + len(at.q), at.nu, 0, len(at.nu))
        _compare(marks, step)
        for kind in range(len(sizes)):
            value = load(sizes, kind)
            _grow(marks.largest, kind, value)
            # Where an error has its largest so far it is outside; so what was outside last stays
            # it when a larger one comes.
            bound = marks.settled * load(marks.largest, kind)
            bound = chosen(bound, marks.there[kind], marks.there[kind], bound)
            store(marks.outside, kind, chosen(bound, value, float(step), load(marks.outside, kind)))
        for index in range(inputs):
            _grow(marks.largest_u, index, _size(load(rows, begin + width + index)))
        if kept < len(marks.steps) and marks.steps[kept] == step:
            copy(sizes, 0, marks.errors, kept * len(sizes), len(sizes))
            copy(rows, begin + width, marks.inputs, kept * inputs, inputs)
            kept += 1
    if count > 0:
        read_state(marks, marks, at, 0)
