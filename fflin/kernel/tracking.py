"""Feedback along a trajectory, which is the same for all lanes."""

from __future__ import annotations

from collections import namedtuple

from fflin.kernel.arguments import FLAG, INDICES, LANED, REAL, WHOLE, Struct
from fflin.kernel.forward import COMMON_POINT
from fflin.kernel.lanes import angle, chosen, inlined, load, splat, store
from fflin.kernel.places import attitude, axes_of, displace, quaternion_times
from fflin.kernel.vectors import across, copy, get3, minus, put3, times

_NEAR = 1e-9  # a time this near to a knot, relative to the interval, is the knot's


class Path(
    namedtuple(
        "Path", "t q u way speed hold ahead ends held over last starts K order along e point"
    )
):
    """A trajectory and its gains, piece by piece.

    At the knots t (N,) [s] q and u, row by row, and once more, with nu and K, where the run `ends`
    later, which is when t > `over` [s].
    Between them `way` is the cubic (4, 6 + n) in the share of the interval of the displacement from
    its knot, and `speed` that of nu; u is linear or on `hold`, taken `ahead` [s] of the time, and
    the three inputs from each of `held` on stand in the world's axes. K has `order` coefficients in
    the time since each of `starts`, and stays after `last` [s]. `along` (6 + n,), the error e (nx,)
    and the `point` that is followed are work space.
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
    """Write what is followed at a time of the run, u in base axes; return if it is over."""
    point, last, knots = path.point, len(path.t) - 2, path.t
    time, after = knots[0] + max(t, 0.0), path.ends and t > path.over
    k, s = _placed(knots, time)
    at, share = _placed(knots, min(time + path.ahead, knots[last + 1]))
    if after:
        k, at, share = last + 2, last + 2, 0.0
    copy(path.q, k * len(point.q), point.q, 0, len(point.q))
    count = len(point.u)
    for index in range(count):
        value = path.u[at * count + index]
        if share > 0.0 and not path.hold:
            value += share * (path.u[(at + 1) * count + index] - value)
        point.u[index] = value
    if after:
        copy(path.speed, 4 * (last + 1) * len(point.nu), point.nu, 0, len(point.nu))
    else:
        _cubic(path.way, k, s, path.along)
        _cubic(path.speed, k, s, point.nu)
        displace(robot.tree, point.q, path.along, point.q)
    for index in range(len(path.held)):
        at = path.held[index]
        put3(point.u, at, across(axes_of(point.q), get3(point.u, at)))
    return after


@inlined
def error(robot, path, point):
    """Write the error from what is followed, in its axes."""
    e, q, there, n = path.e, point.q, path.point, len(robot.index)
    (x, y, z), w = attitude(there.q)
    vector, scalar = quaternion_times(((-x, -y, -z), w), attitude(q))
    put3(e, 0, times(vector, chosen(scalar, 0.0, -1.0, 1.0)))
    apart = minus(get3(q, 0), get3(there.q, 0))
    put3(e, 3, across(axes_of(there.q), apart))
    for joint in range(n):
        at = robot.index[joint]
        if robot.circling[joint]:
            c, s = load(q, at), load(q, at + 1)
            c_0, s_0 = load(there.q, at), load(there.q, at + 1)
            store(e, 6 + joint, angle(s * c_0 - c * s_0, c * c_0 + s * s_0))
        else:
            store(e, 6 + joint, load(q, at) - load(there.q, at))
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
