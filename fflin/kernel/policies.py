"""Policies of the loop: linear controllers, grids of state feedback, and trajectory feedback.

All lanes have the same trajectory and the same gains of trajectory feedback.
"""

from collections import namedtuple

import numpy as np

from fflin.kernel import vectors as vec
from fflin.kernel.allocation import ALLOCATION
from fflin.kernel.bodies import move_bodies
from fflin.kernel.extension import lag_sensors, lagged
from fflin.kernel.forward import COMMON_POINT, joint_position
from fflin.kernel.orbit import flux_at, flux_rate_at, spin_at, write_now
from fflin.kernel.tree import (
    FLAG,
    FLAGS,
    INDICES,
    LANED,
    MOTION,
    PLACE,
    REAL,
    REALS,
    WHOLE,
    Struct,
)
from fflin.kernel.vectors import angle, called, chosen, floor, load, store, whole

# a time nearer to a knot than this fraction of the interval counts as the knot
_NEAR = 1e-9


class Path(
    namedtuple(
        "Path",
        "t q u smooth shift speed hold ahead ends held over last period slack starts K order along "
        "e point",
    )
):
    """A trajectory and its feedback gains, both as piecewise polynomials.

    - `t` (N,) [s]: the times of the knots. `q`, `u`: one row per knot.
    - `shift`, `speed`: coefficients (4, 6 + n) of cubic polynomials for each interval between two
      knots. The cubics of `shift` give the displacement from the interval's first knot. The cubics
      of `speed` give nu. The variable of both cubics is the elapsed fraction of the interval.
    - `hold`: if true, u is constant between knots, else linear. If `smooth` is not empty, u is a
      cubic polynomial instead, with coefficients (4, nu) for each interval. u is evaluated `ahead`
      [s] after the current time.
    - `held`: for each torque or force in world axes, the index of the first of the three inputs.
    - `K`: coefficients (m, `order`, nu, nx) of the gain. The gain is a polynomial in time on each
      of m intervals, which begin at the times `starts` (m,) [s]. The variable of each polynomial is
      the time since the start of the interval. From the time `last` [s] after the start of the
      trajectory, the gain is constant.
    - `ends`: True if the trajectory ends before the run. In this case, `q`, `u`, `speed` and `K`
      have one further row, which applies after the time `over` [s] of the run.
    - `period` [s]: time after which trajectory and gains repeat, or 0. A time less than `slack` [s]
      before the end of a period counts as the start of the next one, for the gain.
    - Work space: `along` (6 + n,) for a displacement, `e` (nx,) for the error, and `point` for the
      followed point.
    """


_OF_PATH = {FLAG: "hold ends", REAL: "ahead over last period slack"}
PATH = Struct(
    Path, REALS, _OF_PATH, held=INDICES, order=WHOLE, e=LANED, point=COMMON_POINT
)


def _cubic(coefficients, k, s, out):
    size = len(out)
    for index in range(size):
        at = 4 * k * size + index
        value = coefficients[at + 2 * size] + s * coefficients[at + 3 * size]
        out[index] = coefficients[at] + s * (coefficients[at + size] + s * value)


def _latest(knots, time):
    """Return the index of the last knot at or before a time, 0 if the time is before all knots."""
    return max(np.searchsorted(knots, time, side="right") - 1, 0)


def _placed(knots, time):
    """Return the index of the knot interval that contains a time, and the elapsed fraction.

    The fraction is 0 at the start of the interval, and 1 at the end.
    """
    last = len(knots) - 2
    k = min(_latest(knots, time), last)
    s = (time - knots[k]) / (knots[k + 1] - knots[k])
    if s > 1.0 - _NEAR and k < last:
        k = k + 1
        s = 0.0
    return k, 0.0 if s < _NEAR else min(s, 1.0)


def _in_period(path, since):
    """Return the time since the start of the trajectory, within a period if there is one."""
    if path.period > 0.0:
        return since - path.period * floor(since / path.period)
    return since


def error(robot, path, point):
    """Write to `path.e` the error (5.1) of `point` relative to the followed point `path.point`.

    The position error is in the axes of the base at the followed point. The velocity error is
    `point.nu` minus `path.point.nu`. The first is in the axes of the base at `point`, the second in
    the axes of the base at the followed point.
    """
    e = path.e
    q = point.q
    followed = path.point
    n = len(robot.index)
    (x, y, z), w = vec.attitude(followed.q)
    vector, scalar = vec.quaternion_times(((-x, -y, -z), w), vec.attitude(q))
    vec.put3(e, 0, vec.times(vector, chosen(scalar, 0.0, -1.0, 1.0)))
    apart = vec.minus(vec.get3(q, 0), vec.get3(followed.q, 0))
    vec.put3(e, 3, vec.across(vec.axes_of(followed.q), apart))
    for joint in range(n):
        at = robot.index[joint]
        if robot.circling[joint]:
            c, s = load(q, at), load(q, at + 1)
            c_0, s_0 = load(followed.q, at), load(followed.q, at + 1)
            store(e, 6 + joint, angle(s * c_0 - c * s_0, c * c_0 + s * s_0))
        else:
            apart_by = load(q, at) - load(followed.q, at)
            store(e, 6 + joint, apart_by / load(robot.scale, joint))
    for index in range(6 + n):
        store(e, 6 + n + index, load(point.nu, index) - load(followed.nu, index))


def track(robot, path, point, u, t):
    """Write the command u* - K e at the time t of the run, where u* are the trajectory's inputs.

    Torques and forces of the trajectory in world axes are rotated to the axes of the base at the
    followed point.
    """
    # Evaluate the trajectory at the time t.
    followed = path.point
    last = len(path.t) - 2
    knots = path.t
    count = len(path.point.u)
    time = knots[0] + _in_period(path, max(t, 0.0))
    after = path.ends and t > path.over
    k, s = _placed(knots, time)
    middle = knots[0] + _in_period(path, max(t, 0.0) + path.ahead)
    at, share = _placed(knots, min(middle, knots[last + 1]))
    if after:
        k = last + 2
        at = last + 2
        share = 0.0
    vec.copy(path.q, k * len(followed.q), followed.q, 0, len(followed.q))
    for index in range(count):
        value = path.u[at * count + index]
        if share > 0.0 and not path.hold:
            value += share * (path.u[(at + 1) * count + index] - value)
        followed.u[index] = value
    if len(path.smooth) > 0:
        _cubic(path.smooth, at, share, followed.u)
    if after:
        vec.copy(
            path.speed,
            4 * (last + 1) * len(followed.nu),
            followed.nu,
            0,
            len(followed.nu),
        )
    else:
        _cubic(path.shift, k, s, path.along)
        _cubic(path.speed, k, s, followed.nu)
        vec.displace(robot.tree, followed.q, path.along, followed.q)
    for index in range(len(path.held)):
        at = path.held[index]
        vec.put3(
            followed.u,
            at,
            vec.across(vec.axes_of(followed.q), vec.get3(followed.u, at)),
        )
    # Compute the error of the robot and evaluate the gain.
    error(robot, path, point)
    starts = path.starts
    width = len(path.e)
    since = _in_period(path, max(t, 0.0))
    if path.period > 0.0 and path.period - since <= path.slack:
        since = 0.0
    since = path.starts[0] + min(since, path.last)
    k = _latest(starts, since)
    since = 0.0 if after else since - starts[k]
    k = len(starts) if after else k
    first, size = k * path.order * count * width, count * width
    for row in range(count):
        total = followed.u[row]
        for column in range(width):
            at = first + row * width + column
            gain = 0.0
            for power in range(path.order - 1, -1, -1):
                gain = gain * since + path.K[at + power * size]
            total = total - gain * load(path.e, column)
        store(u, row, total)


NOTHING, LINEAR, TRACK, B_DOT, DAMPING = range(5)


class Law(
    namedtuple(
        "Law",
        "kind turned origin near period grid filter measured gyros gyro_axes x y added u path "
        "allocation",
    )
):
    """A policy. In compiled code, `x`, `y`, `added` and `u` have one column per lane.

    - `kind`: NOTHING, LINEAR, TRACK, B_DOT or DAMPING. B_DOT and DAMPING are for robots in orbit,
      and compute u from a vector in base axes, with the gain `filter.D` (nu, 3). For B_DOT, the
      vector is the derivative of the magnetic flux density b. For DAMPING, it is b x w / |b|^2 with
      the inertial angular velocity w.
      NOTHING computes no command. LINEAR computes u from y, with
      `grid` if the grid has joints, otherwise with `filter`. TRACK computes u = u* - K e along
      `path`.
    - `x`: the state (nx,), followed by the three outputs of each gyroscope.
    - `gyros` (k,): the index of the body that carries each gyroscope. `gyro_axes` (9 k,): the three
      axes of each gyroscope, in the axes of that body.
    - `y` (ny,): the outputs, which are the entries `measured` of x plus noise. The noise of each
      sample is one row of `added` (slots, ny). After the last row, the first row is used again.
    - `turned` (2,): one entry for omega_b and one for v_b. True: the state contains the velocity in
      reference axes. False: the state contains the velocity in base axes.
    - `origin` (rows, 7): pose of the world frame relative to the reference. The reference is the
      pose of the base at which q_b and r_b are 0.
    - `near` (rows, n): joint positions for unwrapping. The unwrapped angle of a continuous joint
      differs from the position of the joint in `near` by at most pi.
    - `origin` and `near` have one row per sample. The last `period` rows repeat. If `period` is 1,
      the last row also applies to all later samples.
    - `u`: the command. If `allocation.problem` has inputs, `allocate` distributes the command to
      the inputs of `allocation.giving`.
    """


class Grid(namedtuple("Grid", "joint first values stride K offset at")):
    """Grid of feedback laws u = offset - K y, interpolated over the positions of k joints.

    The grid values of joint i are ``values[first[i]:first[i + 1]]``. From one grid value of joint i
    to the next, the index of the gain in `K` grows by ``stride[i]``. `at` (k,) is work space.
    """


class Filter(namedtuple("Filter", "A B C D u0 y0 jump E z rates")):
    """Linear controller u = u0 + C z + D dy with dy = y - y0.

    z (nz,) is the controller state. Before each evaluation, `jump` is added to z. After each
    evaluation, E (applied - commanded) is added to the next z or to dz/dt, unless E is empty. All
    arrays except `z` and `rates` have one vector or matrix per sample, like `Law.origin`.

    - In discrete time, A z + B dy is the next z, and `rates` (nz,) is work space.
    - In continuous time, A z + B dy is dz/dt. `rates` (1 + s, nz) stores z at the beginning of the
      step, and then dz/dt at each of the s stages.
    """


GRID = Struct(Grid, REALS, {INDICES: "joint first stride"}, at=LANED)
FILTER = Struct(Filter, z=LANED, rates=LANED)
_OF_LAW = {
    WHOLE: "kind period",
    FLAGS: "turned",
    INDICES: "measured gyros",
    LANED: "x y added u",
}
LAW = Struct(
    Law, REALS, _OF_LAW, grid=GRID, filter=FILTER, path=PATH, allocation=ALLOCATION
)


@called
def read_state(robot, law, point, row):
    """Write the state of a point into `law.x`.

    `row` is the index of the row to be used from `law.origin` and from `law.near`.
    """
    x = law.x
    q = point.q
    nu = point.nu
    n = len(robot.index)
    position, turn = vec.get3(law.origin, 7 * row), vec.attitude(law.origin, 7 * row)
    vector, scalar = vec.quaternion_times(turn, vec.attitude(q))
    sign = chosen(scalar, 0.0, -1.0, 1.0)
    vec.put3(x, 0, vec.times(vector, sign))
    vec.put3(
        x, 3, vec.plus(position, vec.product(vec.columns_of(turn), vec.get3(q, 0)))
    )
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


def row_at(law, count):
    """Return the row of the arrays with one row per sample at the sample `count`."""
    rows = len(law.origin) // 7
    if count < rows:
        return count
    return rows - law.period + (count - rows) % law.period


def _times(matrix, row, x):
    """Return the scalar product of a row of a matrix and a vector."""
    total = 0.0
    width = len(x)
    for index in range(width):
        total = total + load(matrix, row * width + index) * load(x, index)
    return total


def measure(work, robot, law, point, row):
    """Write the state and the rates of the gyroscopes into `law.x`.

    `row` is the argument of `read_state`. The motion of the bodies must be in `work`.
    """
    read_state(robot, law, point, row)
    gyros = law.gyros
    offsets = robot.tree.offsets
    for index in range(len(gyros)):
        rate = vec.get3(work, offsets.motion + gyros[index] * MOTION)
        axes = vec.get_columns(work, offsets.places + gyros[index] * PLACE)
        rate = vec.across(
            vec.get_columns(law.gyro_axes, 9 * index), vec.across(axes, rate)
        )
        vec.put3(law.x, 2 * len(point.nu) + 3 * index, rate)


def observe(work, robot, law, lag, speed, point, count, stage):
    """Advance the sensors with a lag by a stage; see `extension.lag_sensors`.

    `count` and `stage` are the arguments of `command`. The motion of the bodies must be in `work`.
    """
    if len(lag.values) > 0:
        measure(work, robot, law, point, row_at(law, count))
        lag_sensors(lag, speed, law.x, law.measured, stage)


def command(work, robot, orbit, law, extension, point, t, count, stage):
    """Write the command of a policy into `law.u`.

    t [s] is the time of the run, and `stage` the index of the stage in the step. `count` is the
    index of the sample, or the index of the step if commands are continuous. `orbit` is None
    without an orbit, and `extension` is an `Extension` with lags of sensors, or None.
    """
    if law.kind == TRACK:
        track(robot, law.path, point, law.u, t)
        return
    if orbit is not None and law.kind >= B_DOT:
        write_now(orbit, t)
        measured = flux_rate_at(orbit, point.q, point.nu)
        if law.kind == DAMPING:
            b = flux_at(orbit, point.q)
            rate = vec.plus(vec.get3(point.nu, 0), spin_at(orbit, point.q))
            measured = vec.times(vec.cross(b, rate), 1.0 / vec.dot(b, b))
        for index in range(len(law.u)):
            gain = vec.get3(law.filter.D, 3 * index)
            store(law.u, index, vec.dot(gain, measured))
        return
    row = row_at(law, count)
    # Compute the outputs y, with the noise of the sample.
    outputs = len(law.measured)
    tree = robot.tree
    if len(law.gyros) > 0:
        omega_b = vec.get3(point.nu, 0)
        if orbit is not None:
            write_now(orbit, t)
            omega_b = vec.plus(omega_b, spin_at(orbit, point.q))
        move_bodies(work, tree, point.nu, omega_b)
    measure(work, robot, law, point, row)
    added = count % max(len(law.added) // max(outputs, 1), 1) * outputs
    for index in range(outputs):
        value = load(law.x, law.measured[index])
        if extension is not None:
            value = lagged(extension.sensors, index, value)
        store(law.y, index, value + load(law.added, added + index))
    if len(law.grid.joint) > 0:
        _feed_back_between(robot, law, point)
    else:
        _filter(law.filter, law.y, law.u, row, stage)


def _feed_back_between(robot, law, point):
    """Write the command of a grid of feedback laws, interpolated separately for each lane."""
    grid, y, u = law.grid, law.y, law.u
    inputs, size = len(u), len(y)
    for axis in range(len(grid.joint)):
        store(grid.at, axis, joint_position(robot, point.q, grid.joint[axis]))
    vec.clear(u, 0, inputs)
    for lane in range(vec.lane_count(u)):
        for corner in range(1 << len(grid.joint)):
            weight, cell = _corner(grid, corner, lane)
            for row in range(inputs if weight > 0.0 else 0):
                at = cell * inputs + row
                total = vec.peek(grid.offset, at, lane)
                for column in range(size):
                    total -= vec.peek(grid.K, at * size + column, lane) * vec.peek(
                        y, column, lane
                    )
                vec.poke(u, row, lane, vec.peek(u, row, lane) + weight * total)


def _corner(grid, corner, lane):
    """Return a grid corner's weight in the interpolation, and the corner's index in `grid.K`.

    The corner belongs to the grid cell that contains the joint positions of the lane. Bit i of
    `corner` is 1 if the corner is at the upper grid value of joint i, and 0 if it is at the lower
    grid value.
    """
    weight, cell = 1.0, 0
    for axis in range(len(grid.joint)):
        first = grid.first[axis]
        last = grid.first[axis + 1] - 1
        value = min(
            max(vec.peek(grid.at, axis, lane), grid.values[first]), grid.values[last]
        )
        k = first
        while k < last - 1 and value >= grid.values[k + 1]:
            k += 1
        over = (value - grid.values[k]) / (grid.values[k + 1] - grid.values[k])
        beyond = corner >> axis & 1
        weight *= over if beyond else 1.0 - over
        cell += (k - first + beyond) * grid.stride[axis]
    return weight, cell


@called
def _filter(controller, y, u, row, stage):
    """Write the command u of a linear controller, and the controller's next z or dz/dt.

    `controller` is a `Filter`. The outputs y are replaced by dy = y - y0.
    """
    size, outputs, inputs = len(controller.z), len(y), len(u)
    along = len(controller.rates) > size
    first = (1 + stage) * size if along else 0
    for index in range(size):
        store(
            controller.z,
            index,
            load(controller.z, index) + load(controller.jump, row * size + index),
        )
    for index in range(outputs):
        store(y, index, load(y, index) - load(controller.y0, row * outputs + index))
    for index in range(inputs):
        at = row * inputs + index
        store(
            u,
            index,
            load(controller.u0, at)
            + _times(controller.C, at, controller.z)
            + _times(controller.D, at, y),
        )
    if first == size:
        vec.copy(controller.z, 0, controller.rates, 0, size)
    for index in range(size):
        at = row * size + index
        store(
            controller.rates,
            first + index,
            _times(controller.A, at, controller.z) + _times(controller.B, at, y),
        )
    if not along:
        vec.copy(controller.rates, 0, controller.z, 0, size)


@called
def correct(law, count, stage):
    """Add E du to a controller's next z or dz/dt (anti-windup); `law.u` contains du.

    du is the difference of the limited and the commanded inputs. `count` and `stage` are the
    arguments of `command`.
    """
    controller = law.filter
    size = len(controller.z)
    row = row_at(law, count)
    along = len(controller.rates) > size
    for index in range(size):
        change = _times(controller.E, row * size + index, law.u)
        if along:
            at = (1 + stage) * size + index
            store(controller.rates, at, load(controller.rates, at) + change)
        else:
            store(controller.z, index, load(controller.z, index) + change)
