"""Statistics of eight parallel runs, updated with each row of the compiled loop."""

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
        "robot law path x_ref q_ref nu_ref kind settled tolerance steps at "
        "sizes largest_x largest_u largest outside errors inputs",
    )
):
    """Reference of the errors of eight runs, and their statistics so far.

    The `law` reads states. Errors are from the state `x_ref` (nx,), whose attitude the point of
    `path` has, or from the rows `q_ref` and `nu_ref` of a moving reference. `kind` (nx,) is 0 for a
    state without a kind, and -1 for a state whose error is not kept. An error has settled if it is
    below the fraction `settled` of its largest value, or below `tolerance` (kinds,). At `steps`
    (times,) errors and inputs are kept. `at` is work space. The fields after it are in lanes.
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
def _grow(stats, index, value):
    """Write the larger of an entry and a number."""
    store(stats, index, chosen(load(stats, index), value, value, load(stats, index)))


@inlined
def _compare(stats, step):
    """Write the errors at a step, and the size of each kind."""
    at, there, sizes, e = stats.at, stats.path.point, stats.sizes, stats.path.e
    if len(stats.q_ref) > 0:
        copy(stats.q_ref, step * len(there.q), there.q, 0, len(there.q))
        copy(stats.nu_ref, step * len(there.nu), there.nu, 0, len(there.nu))
        error(stats.robot, stats.path, at)
    else:
        read_state(stats.robot, stats.law, at, 0)
        for index in range(len(e)):
            store(e, index, load(stats.law.x, index) - load(stats.x_ref, index))
    for kind in range(len(sizes)):
        store(sizes, kind, 0.0)
    for index in range(len(e)):
        value, kind = _size(load(e, index)), stats.kind[index]
        if kind >= 0:
            _grow(stats.largest_x, index, value)
        if kind > 0:
            _grow(sizes, kind, value)
    (x, y, z), w = attitude(there.q)
    vector, scalar = quaternion_times(((-x, -y, -z), w), attitude(at.q))
    half = angle(root(dot(vector, vector)), _size(scalar))
    store(sizes, 0, half * (360.0 / np.pi))


@listed
def note(stats, rows, first, count):
    """Record the statistics of `take`, on opened arguments."""
    at, sizes, kept = stats.at, stats.sizes, 0
    width, inputs = len(at.q) + len(at.nu), len(stats.largest_u)
    while kept < len(stats.steps) and stats.steps[kept] < first:
        kept += 1
    for row in range(count):
        step, begin = first + row, row * (width + inputs + 9)
        copy(rows, begin, at.q, 0, len(at.q))
        copy(rows, begin + len(at.q), at.nu, 0, len(at.nu))
        _compare(stats, step)
        for kind in range(len(sizes)):
            value = load(sizes, kind)
            _grow(stats.largest, kind, value)
            # A new maximum is never within the bound, so it resets the settling time.
            bound = stats.settled * load(stats.largest, kind)
            bound = chosen(bound, stats.tolerance[kind], stats.tolerance[kind], bound)
            store(stats.outside, kind, chosen(bound, value, float(step), load(stats.outside, kind)))
        for index in range(inputs):
            _grow(stats.largest_u, index, _size(load(rows, begin + width + index)))
        if kept < len(stats.steps) and stats.steps[kept] == step:
            copy(sizes, 0, stats.errors, kept * len(sizes), len(sizes))
            copy(rows, begin + width, stats.inputs, kept * inputs, inputs)
            kept += 1
    if count > 0:
        read_state(stats.robot, stats.law, at, 0)


@compiled
def take(words, rows, first, count):
    """Update the statistics with `count` rows of `loop.advance`, the first one of step `first`.

    `words` are of `RunStatistics`.
    """
    note(_opened(words), rows, first, count)
