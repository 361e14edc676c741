"""The policies of the loop: feedback of the state, of outputs by a filter, and on a path."""

from __future__ import annotations

from collections import namedtuple

import numpy as np

from fflin.kernel.arguments import FLAGS, INDICES, LANED, WHOLE, Struct
from fflin.kernel.forward import joint_position
from fflin.kernel.lanes import called, chosen, inlined, load, peek, poke, splat, store, whole, width
from fflin.kernel.places import columns_of, quaternion_times
from fflin.kernel.rnea import MOTION, move_bodies
from fflin.kernel.sharing import SHARING
from fflin.kernel.tracking import PATH, track
from fflin.kernel.tree import PLACE
from fflin.kernel.vectors import across, copy, get3, get_columns, plus, product, put3, times

NOTHING, LINEAR, TRACK = range(3)


class Law(
    namedtuple(
        "Law",
        "kind turned origin near grid filter measured gyros x y added u path sharing",
    )
):
    """A policy; each array of doubles may have a second axis of eight lanes.

    By its kind NOTHING, LINEAR: u by a `filter` of y, or by the gains of a `grid` that has joints,
    or TRACK: u = u* - K e along `path`. y (ny,) is what is `measured` of the state and the
    gyroscopes after it, x, and of rows (slots, ny) what is `added` to it, sample by sample and
    round.
    `turned` says whether omega_b and v_b of the state stand in reference axes; row by row, sample
    by sample and the last to the end, `origin` (7,) is the world's origin seen from where x is 0
    and `near` (n,) which turn is taken of joints that go round. `u` is what is commanded, to be
    shared out by `sharing` where that has any inputs.
    """


class Grid(namedtuple("Grid", "joint first values stride K offset at")):
    """Joints (k,) between whose `values` from `first` (k + 1,) on u = offset - K y is interpolated.

    A step along each of them goes on by `stride` of the gains. `at` (k,) is work space.
    """


class Gyros(namedtuple("Gyros", "body axes")):
    """Bodies with a gyroscope (k,), and the columns (9 k,) of its axes in the body's."""


class Filter(namedtuple("Filter", "A B C D u0 y0 jump z rates")):
    """Row by row as `Law.origin`: u = u0 + C z + D dy, then A z + B dy of dy = y - y0.

    z (nz,) is the state, which has jumped before. That is the next one, with `rates` (nz,) as work
    space; or its rate, of the stages (1 + s, nz) that stand there behind z as the step began.
    """


_PLACES = dict.fromkeys(("joint", "first", "stride"), INDICES)
GRID = Struct(Grid, at=LANED, **_PLACES)
GYROS = Struct(Gyros, body=INDICES)
FILTER = Struct(Filter, z=LANED, rates=LANED)
LAW = Struct(
    Law,
    kind=WHOLE,
    turned=FLAGS,
    grid=GRID,
    filter=FILTER,
    measured=INDICES,
    gyros=GYROS,
    **dict.fromkeys(("x", "y", "added", "u"), LANED),
    path=PATH,
    sharing=SHARING,
)


@called
def read_state(robot, law, point, row):
    """Write the state in the chart."""
    x, q, nu, n = law.x, point.q, point.nu, len(robot.index)
    place, turn = get3(law.origin, 7 * row), get3(law.origin, 7 * row + 3)
    turn = turn, load(law.origin, 7 * row + 6)
    vector, scalar = quaternion_times(turn, (get3(q, 3), load(q, 6)))
    sign = chosen(scalar, 0.0, -1.0, 1.0)
    put3(x, 0, times(vector, sign))
    put3(x, 3, plus(place, product(columns_of(turn), get3(q, 0))))
    for joint in range(n):
        value = joint_position(robot, q, joint)
        if robot.circling[joint]:
            turns = whole((load(law.near, row * n + joint) - value) * (0.5 / np.pi))
            value = value + 2.0 * np.pi * turns
        store(x, 6 + joint, value)
    axes = columns_of((vector, scalar))
    for part in range(2):
        rate = get3(nu, 3 * part)
        if law.turned[part]:
            rate = product(axes, rate)
        put3(x, 6 + n + 3 * part, rate)
    copy(nu, 6, x, 12 + n, n)


@inlined
def _turn_gyros(work, robot, gyros, nu, x, first):
    """Write what gyroscopes measure from an entry on."""
    move_bodies(work, robot.tree, robot.layout, nu)
    for index in range(len(gyros.body)):
        body = gyros.body[index]
        rate = get3(work, robot.layout.motion + body * MOTION)
        rate = across(get_columns(work, robot.tree.places + body * PLACE), rate)
        put3(x, first + 3 * index, across(get_columns(gyros.axes, 9 * index), rate))


@inlined
def _measure(work, robot, law, point, count):
    """Write the outputs, with what is added to those of a sample."""
    outputs = len(law.measured)
    if len(law.gyros.body) > 0:
        _turn_gyros(work, robot, law.gyros, point.nu, law.x, 2 * len(point.nu))
    added = count % max(len(law.added) // max(outputs, 1), 1) * outputs
    for index in range(outputs):
        store(law.y, index, load(law.x, law.measured[index]) + load(law.added, added + index))


@inlined
def _times(matrix, row, x):
    """Return a row of a matrix times a vector."""
    total, width = splat(x, 0.0), len(x)
    for index in range(width):
        total = total + load(matrix, row * width + index) * load(x, index)
    return total


@inlined
def command(work, robot, law, point, t, count, stage):
    """Write the inputs that a policy asks for, at a sample of that count or a stage of a step."""
    if law.kind == TRACK:
        track(robot, law.path, point, law.u, t)
        return
    row = min(count, len(law.origin) // 7 - 1)
    read_state(robot, law, point, row)
    _measure(work, robot, law, point, count)
    if len(law.grid.joint) > 0:
        _feed_back_between(robot, law, point)
    else:
        _filter(law.filter, law.y, law.u, row, stage)


@inlined
def _feed_back_between(robot, law, point):
    """Write what the gains between the points of a grid make of the state, lane by lane."""
    grid, y, u = law.grid, law.y, law.u
    inputs, size = len(u), len(y)
    for axis in range(len(grid.joint)):
        store(grid.at, axis, joint_position(robot, point.q, grid.joint[axis]))
    for index in range(inputs):
        store(u, index, 0.0)
    for lane in range(width(u)):
        for corner in range(1 << len(grid.joint)):
            share, cell = _corner(grid, corner, lane)
            for row in range(inputs if share > 0.0 else 0):
                at = cell * inputs + row
                total = peek(grid.offset, at, lane)
                for column in range(size):
                    total -= peek(grid.K, at * size + column, lane) * peek(y, column, lane)
                poke(u, row, lane, peek(u, row, lane) + share * total)


@inlined
def _corner(grid, corner, lane):
    """Return the share of a corner of the cell that a lane is in, and which gain is there."""
    share, cell = 1.0, 0
    for axis in range(len(grid.joint)):
        first, last = grid.first[axis], grid.first[axis + 1] - 1
        value = min(max(peek(grid.at, axis, lane), grid.values[first]), grid.values[last])
        k = first
        while k < last - 1 and value >= grid.values[k + 1]:
            k += 1
        over = (value - grid.values[k]) / (grid.values[k + 1] - grid.values[k])
        beyond = corner >> axis & 1
        share *= over if beyond else 1.0 - over
        cell += (k - first + beyond) * grid.stride[axis]
    return share, cell


@called
def _filter(by, y, u, row, stage):
    """Write what a linear law asks for, and bring it up to the next sample or write its rate."""
    size, outputs, inputs = len(by.z), len(y), len(u)
    along = len(by.rates) > size
    first = (1 + stage) * size if along else 0
    for index in range(size):
        store(by.z, index, load(by.z, index) + load(by.jump, row * size + index))
    for index in range(outputs):
        store(y, index, load(y, index) - load(by.y0, row * outputs + index))
    for index in range(inputs):
        at = row * inputs + index
        store(u, index, load(by.u0, at) + _times(by.C, at, by.z) + _times(by.D, at, y))
    if first == size:
        copy(by.z, 0, by.rates, 0, size)
    for index in range(size):
        at = row * size + index
        store(by.rates, first + index, _times(by.A, at, by.z) + _times(by.B, at, y))
    if not along:
        copy(by.rates, 0, by.z, 0, size)
