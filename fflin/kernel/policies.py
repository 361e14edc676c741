"""Policies of the loop: state feedback, output feedback by a filter, trajectory feedback.

The trajectory and its gains are the same for all lanes.
"""

from __future__ import annotations

from collections import namedtuple

import numpy as np

from fflin.kernel import vectors as vec
from fflin.kernel.allocation import ALLOCATION
from fflin.kernel.arguments import FLAG, FLAGS, INDICES, LANED, REAL, WHOLE, Struct
from fflin.kernel.forward import COMMON_POINT, joint_position
from fflin.kernel.lanes import (
    angle,
    called,
    chosen,
    inlined,
    load,
    peek,
    poke,
    splat,
    store,
    whole,
    width,
)
from fflin.kernel.rnea import move_bodies
from fflin.kernel.tree import MOTION, PLACE

_NEAR = 1e-9  # a time this near to a knot, relative to the interval, is the knot's


class Path(
    namedtuple(
        "Path", "t q u shift speed hold ahead ends held over last starts K order along e point"
    )
):
    """A trajectory and its gains, piece by piece.

    At the knots t (N,) [s] q and u, row by row, and once more, with nu and K, where the run `ends`
    later, which is when t > `over` [s].
    Between knots, `shift` is a cubic (4, 6 + n) in the elapsed fraction of the interval. It gives
    the displacement from the knot, and `speed` is the same of nu; u is linear or on `hold`, taken
    `ahead` [s] of the time, and the three inputs from each of `held` on are in world axes. K has
    `order` coefficients in the time since each of `starts`, and stays after `last` [s]. `along`
    (6 + n,), the error e (nx,) and the `point` that is followed are work space.
    """


PATH = Struct(
    Path,
    **dict.fromkeys(("hold", "ends"), FLAG),
    **dict.fromkeys(("ahead", "over", "last"), REAL),
    held=INDICES,
    order=WHOLE,
    e=LANED,
    point=COMMON_POINT,
)


@inlined
def _cubic(coefficients, k, s, out):
    size = len(out)
    for index in range(size):
        at = 4 * k * size + index
        value = coefficients[at + 2 * size] + s * coefficients[at + 3 * size]
        out[index] = coefficients[at] + s * (coefficients[at + size] + s * value)


@inlined
def _latest(knots, time):
    """Return the last knot that is not after a time; the first where all are."""
    low, high = 0, len(knots)
    while high - low > 1:
        middle = (low + high) // 2
        if knots[middle] <= time:
            low = middle
        else:
            high = middle
    return low


@inlined
def _placed(knots, time):
    """Return which interval a time is in, and the share of it that is over."""
    last = len(knots) - 2
    k = min(_latest(knots, time), last)
    s = (time - knots[k]) / (knots[k + 1] - knots[k])
    if s > 1.0 - _NEAR and k < last:
        k, s = k + 1, 0.0
    return k, 0.0 if s < _NEAR else min(s, 1.0)


@inlined
def _follow(robot, path, t):
    """Write the followed trajectory at a time, u in base axes; return whether it has ended."""
    point, last, knots = path.point, len(path.t) - 2, path.t
    time, after = knots[0] + max(t, 0.0), path.ends and t > path.over
    k, s = _placed(knots, time)
    at, share = _placed(knots, min(time + path.ahead, knots[last + 1]))
    if after:
        k, at, share = last + 2, last + 2, 0.0
    vec.copy(path.q, k * len(point.q), point.q, 0, len(point.q))
    count = len(point.u)
    for index in range(count):
        value = path.u[at * count + index]
        if share > 0.0 and not path.hold:
            value += share * (path.u[(at + 1) * count + index] - value)
        point.u[index] = value
    if after:
        vec.copy(path.speed, 4 * (last + 1) * len(point.nu), point.nu, 0, len(point.nu))
    else:
        _cubic(path.shift, k, s, path.along)
        _cubic(path.speed, k, s, point.nu)
        vec.displace(robot.tree, point.q, path.along, point.q)
    for index in range(len(path.held)):
        at = path.held[index]
        vec.put3(point.u, at, vec.across(vec.axes_of(point.q), vec.get3(point.u, at)))
    return after


@inlined
def error(robot, path, point):
    """Write the error relative to the followed trajectory, in its axes."""
    e, q, there, n = path.e, point.q, path.point, len(robot.index)
    (x, y, z), w = vec.attitude(there.q)
    vector, scalar = vec.quaternion_times(((-x, -y, -z), w), vec.attitude(q))
    vec.put3(e, 0, vec.times(vector, chosen(scalar, 0.0, -1.0, 1.0)))
    apart = vec.minus(vec.get3(q, 0), vec.get3(there.q, 0))
    vec.put3(e, 3, vec.across(vec.axes_of(there.q), apart))
    for joint in range(n):
        at = robot.index[joint]
        if robot.circling[joint]:
            c, s = load(q, at), load(q, at + 1)
            c_0, s_0 = load(there.q, at), load(there.q, at + 1)
            store(e, 6 + joint, angle(s * c_0 - c * s_0, c * c_0 + s * s_0))
        else:
            apart_by = load(q, at) - load(there.q, at)
            store(e, 6 + joint, apart_by / load(robot.scale, joint))
    for index in range(6 + n):
        store(e, 6 + n + index, load(point.nu, index) - load(there.nu, index))


@inlined
def track(robot, path, point, u, t):
    """Write the inputs u* - K e at a time of the run."""
    after = _follow(robot, path, t)
    error(robot, path, point)
    starts, count, width = path.starts, len(path.point.u), len(path.e)
    since = path.starts[0] + min(max(t, 0.0), path.last)
    k = _latest(starts, since)
    since = 0.0 if after else since - starts[k]
    k = len(starts) if after else k
    first, size = k * path.order * count * width, count * width
    for row in range(count):
        total = splat(u, path.point.u[row])
        for column in range(width):
            at, gain = first + row * width + column, 0.0
            for power in range(path.order - 1, -1, -1):
                gain = gain * since + path.K[at + power * size]
            total = total - gain * load(path.e, column)
        store(u, row, total)


NOTHING, LINEAR, TRACK = range(3)


class Law(
    namedtuple(
        "Law",
        "kind turned origin near grid filter measured gyros x y added u path allocation",
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
    shared out by `allocation` where that has any inputs.
    """


class Grid(namedtuple("Grid", "joint first values stride K offset at")):
    """Grid of feedback laws u = offset - K y, interpolated over the positions of k joints.

    The grid values of joint i are ``values[first[i]:first[i + 1]]``. The gain at the next value of
    joint i is ``stride[i]`` gains further in `K`. `at` (k,) is work space.
    """


class Gyros(namedtuple("Gyros", "body axes")):
    """Bodies with a gyroscope (k,), and the columns (9 k,) of its axes in the body's."""


class Filter(namedtuple("Filter", "A B C D u0 y0 jump z rates")):
    """Row by row as `Law.origin`: u = u0 + C z + D dy, then A z + B dy of dy = y - y0.

    z (nz,) is the state, which has jumped before. That is the next one, with `rates` (nz,) as work
    space; or its rate, of the stages (1 + s, nz) that stand there behind z as the step began.
    """


GRID = Struct(Grid, at=LANED, **dict.fromkeys(("joint", "first", "stride"), INDICES))
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
    allocation=ALLOCATION,
)


@called
def read_state(robot, law, point, row):
    """Write the state in the chart."""
    x, q, nu, n = law.x, point.q, point.nu, len(robot.index)
    place, turn = vec.get3(law.origin, 7 * row), vec.get3(law.origin, 7 * row + 3)
    turn = turn, load(law.origin, 7 * row + 6)
    vector, scalar = vec.quaternion_times(turn, (vec.get3(q, 3), load(q, 6)))
    sign = chosen(scalar, 0.0, -1.0, 1.0)
    vec.put3(x, 0, vec.times(vector, sign))
    vec.put3(x, 3, vec.plus(place, vec.product(vec.columns_of(turn), vec.get3(q, 0))))
    for joint in range(n):
        value = joint_position(robot, q, joint)
        if robot.circling[joint]:
            turns = whole((load(law.near, row * n + joint) - value) * (0.5 / np.pi))
            value = value + 2.0 * np.pi * turns
        store(x, 6 + joint, value)
    axes = vec.columns_of((vector, scalar))
    for part in range(2):
        rate = vec.get3(nu, 3 * part)
        if law.turned[part]:
            rate = vec.product(axes, rate)
        vec.put3(x, 6 + n + 3 * part, rate)
    vec.copy(nu, 6, x, 12 + n, n)


@inlined
def _turn_gyros(work, robot, gyros, nu, x, first):
    """Write the gyroscope outputs, starting at an entry."""
    move_bodies(work, robot.tree, robot.layout, nu)
    for index in range(len(gyros.body)):
        body = gyros.body[index]
        rate = vec.get3(work, robot.layout.motion + body * MOTION)
        rate = vec.across(vec.get_columns(work, robot.tree.places + body * PLACE), rate)
        vec.put3(x, first + 3 * index, vec.across(vec.get_columns(gyros.axes, 9 * index), rate))


@inlined
def _measure(work, robot, law, point, count):
    """Write the outputs, with the noise of a sample added."""
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
    """Write the commands of a policy at a sample of that number or at a stage of a step."""
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
    """Write the commands of gains interpolated on a grid, lane by lane."""
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
    """Write the commands of a linear law, and its next state or state derivative."""
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
        vec.copy(by.z, 0, by.rates, 0, size)
    for index in range(size):
        at = row * size + index
        store(by.rates, first + index, _times(by.A, at, by.z) + _times(by.B, at, y))
    if not along:
        vec.copy(by.rates, 0, by.z, 0, size)
