"""What is kept of eight runs while they go on, row by row of the compiled loop."""

from __future__ import annotations

from collections import namedtuple

import numpy as np

from fflin.kernel.arguments import INDICES, LANED, REAL, Opener, Struct
from fflin.kernel.displacements import attitude, quaternion_times
from fflin.kernel.forward import MECHANICS, POINT
from fflin.kernel.lanes import angle, chosen, compiled, inlined, listed, load, root, store
from fflin.kernel.policies import LAW, PATH, error, read_state
from fflin.kernel.vectors import copy, dot


class RunStatistics(
    namedtuple(
        "RunStatistics",
        "robot law path home way speed kind settled there steps at "
        "sizes largest_x largest_u largest outside errors inputs",
    )
):
    """What is compared, and the marks so far.

    States are read as the `law` says and errors as the `path` does: from the state `home` (nx,),
    which the path's point has the attitude of, or from the rows q and nu of a `way` and its
    `speed`. `kind` (nx,) is 0 for a state without a kind of its own and
    -1 for one that has no error either. `settled` is the share of the largest, and `there` (kinds,)
    the sizes, below which an error has settled; at `steps` (times,) errors and inputs are kept.
    `at` is work space. All from there on are in lanes.
    """


_IN_LANES = "sizes largest_x largest_u largest outside errors inputs"
RUN_STATISTICS = Struct(
    RunStatistics,
    robot=MECHANICS,
    law=LAW,
    path=PATH,
    settled=REAL,
    at=POINT,
    **dict.fromkeys(("kind", "steps"), INDICES),
    **dict.fromkeys(_IN_LANES.split(), LANED),
)
_opened = Opener(RUN_STATISTICS)


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
    at, there, sizes, e = marks.at, marks.path.point, marks.sizes, marks.path.e
    if len(marks.way) > 0:
        copy(marks.way, step * len(there.q), there.q, 0, len(there.q))
        copy(marks.speed, step * len(there.nu), there.nu, 0, len(there.nu))
        error(marks.robot, marks.path, at)
    else:
        read_state(marks.robot, marks.law, at, 0)
        for index in range(len(e)):
            store(e, index, load(marks.law.x, index) - load(marks.home, index))
    for kind in range(len(sizes)):
        store(sizes, kind, 0.0)
    for index in range(len(e)):
        value, kind = _size(load(e, index)), marks.kind[index]
        if kind >= 0:
            _grow(marks.largest_x, index, value)
        if kind > 0:
            _grow(sizes, kind, value)
    (x, y, z), w = attitude(there.q)
    vector, scalar = quaternion_times(((-x, -y, -z), w), attitude(at.q))
    half = angle(root(dot(vector, vector)), _size(scalar))
    store(sizes, 0, half * (360.0 / np.pi))


@listed
def note(marks, rows, first, count):
    """Do as `take`, of marks that are opened."""
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
        read_state(marks.robot, marks.law, at, 0)


@compiled
def take(words, rows, first, count):
    """Take so many rows as `loop.advance` writes, the first of which is of a step, into account.

    `words` are of `RunStatistics`.
    """
    note(_opened(words), rows, first, count)
