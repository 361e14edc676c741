"""A, B and f0 of the accelerations and their slopes, of one point or eight at once.

What `linear.state_equations` has in NumPy; numbers of equations are those of docs/derivation.md.
"""

from __future__ import annotations

from collections import namedtuple

from fflin.kernel import vectors as vec
from fflin.kernel.forward import joint_position, seen
from fflin.kernel.lanes import chosen, inlined, load, splat, store
from fflin.kernel.places import axes_of, columns_of


class Equations(
    namedtuple(
        "Equations",
        "tree layout loads places order index circling rest row held gravity origin bounds "
        "limits turned own moving",
    )
):
    """A robot as `Mechanics` has it, the `order` of v, and which axes are `turned`."""


class Places(namedtuple("Places", "A by_u B f0 x0 sums judged size")):
    """Where A, by_u (6 + n, nu) in base axes, the lower half of B, ... begin; the size of all."""


class Point(namedtuple("Point", "q v u nu pushing forces")):
    """A point as Pinocchio has it, and its velocity, inputs and forces in base axes."""


_ZERO = (0.0, 0.0, 0.0)
_AXES = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
JUDGED = 3


@inlined
def _chart(work, robot, q):
    """Return the quaternion of the base seen from the reference, q0 not negative."""
    zero, one = splat(work, 0.0), splat(work, 1.0)
    vector, scalar = (zero, zero, zero), one
    if robot.own == 0:
        vector, scalar = seen(robot, q)
        sign = chosen(scalar, 0.0, splat(work, -1.0), one)
        vector, scalar = vec.times(vector, sign), scalar * sign
    return vector, scalar


@inlined
def _kinematics(quaternion):
    """Return the columns of N (1.2) and of J (1.3)."""
    vector, scalar = quaternion
    share = vec.times(vector, 1.0 / scalar)
    (x, y, z), (a, b, c) = vector, share
    N = (
        (0.5 * scalar, 0.5 * z, -0.5 * y),
        (-0.5 * z, 0.5 * scalar, 0.5 * x),
        (0.5 * y, -0.5 * x, 0.5 * scalar),
    )
    J = (
        (2.0 * (scalar + x * a), 2.0 * (y * a - z), 2.0 * (z * a + y)),
        (2.0 * (x * b + z), 2.0 * (scalar + y * b), 2.0 * (z * b - x)),
        (2.0 * (x * c - y), 2.0 * (y * c + x), 2.0 * (scalar + z * c)),
    )
    return N, J


@inlined
def _put_column(work, at, width, a):
    """Write a vector down three rows."""
    store(work, at, a[0])
    store(work, at + width, a[1])
    store(work, at + 2 * width, a[2])


@inlined
def _turn_rows(work, at, width, columns, R):
    """Turn three rows by R."""
    for column in range(columns):
        x = load(work, at + column), load(work, at + width + column)
        y = vec.product(R, (x[0], x[1], load(work, at + 2 * width + column)))
        _put_column(work, at + column, width, y)


@inlined
def enter(work, robot, point):
    """Write the point's velocity, inputs and forces in base axes, and x0."""
    n, x0, loads = len(robot.index), robot.places.x0, robot.loads
    quaternion = _chart(work, robot, point.q)
    R = columns_of(quaternion)
    for row in range(6 + n):
        store(point.nu, row, load(point.v, robot.order[row]))
        store(point.forces, row, 0.0)
        store(work, x0 + 6 + n + row, load(point.nu, row))
    for index in range(len(robot.row)):
        store(point.pushing, index, load(point.u, index))
    if robot.own == 0:
        for index in range(len(robot.held)):
            at = robot.held[index]
            vec.put3(point.pushing, at, vec.across(R, vec.get3(point.u, at)))
        for part in range(2):
            if robot.turned[part]:
                turned = vec.product(R, vec.get3(point.nu, 3 * part))
                vec.put3(work, x0 + 6 + n + 3 * part, turned)
        home = columns_of((vec.get3(robot.origin, 3), load(robot.origin, 6)))
        away = vec.product(home, vec.get3(point.q, 0))
        vec.put3(work, x0 + 3, vec.plus(away, vec.get3(robot.origin, 0)))
    else:
        vec.put3(work, x0 + 3, _ZERO)
    vec.put3(work, x0, quaternion[0])
    for index in range(len(robot.row)):
        if robot.row[index] >= 0:
            vec.add(point.forces, robot.row[index], load(point.pushing, index))
    for joint in range(n):
        angle = joint_position(robot, point.q, joint)
        store(work, x0 + 6 + joint, angle)
        pull = load(loads.stiffness, joint) * (angle - load(robot.rest, joint))
        pull = pull + load(loads.damping, joint) * load(point.nu, 6 + joint)
        vec.add(point.forces, 6 + joint, -pull)


@inlined
def push(work, robot):
    """Write the slopes over the inputs in base axes, columns of M^-1 or sums of them."""
    size, count, carried = len(robot.order), len(robot.row), len(robot.loads.input)
    square, by_u = robot.tree.square, robot.places.by_u
    for row in range(size):
        for index in range(count):
            if robot.row[index] >= 0:
                value = load(work, square + row * size + robot.row[index])
                store(work, by_u + row * count + index, value)
        for index in range(carried):
            total = splat(work, 0.0)
            for k in range(size):
                column = load(work, robot.layout.columns + k * carried + index)
                total = total + load(work, square + row * size + k) * column
            store(work, by_u + row * count + robot.loads.input[index], total)


@inlined
def _over_turns(work, robot, point, gravity, J):
    """Write the columns of the accelerations over q_b (4.4), (4.6), before they are turned."""
    size, count, places = len(robot.order), len(robot.row), robot.places
    c = robot.layout.c
    w = vec.get3(point.nu, 0)
    for row in range(size):
        at = places.A + (size + row) * 2 * size
        turn = vec.times(w, 0.0)
        for index in range(len(robot.held)):
            column = robot.held[index]
            slope = vec.get3(work, places.by_u + row * count + column)
            turn = vec.plus(turn, vec.cross(slope, vec.get3(point.pushing, column)))
        if robot.turned[0]:
            turn = vec.plus(turn, vec.cross(vec.get3(work, at + size), w))
            if row < 3:
                turn = vec.minus(turn, vec.cross(_AXES[row], vec.get3(work, c)))
        if 3 <= row < 6:
            along = vec.times(gravity, -1.0)
            if robot.turned[1]:
                along = vec.get3(work, c + 3)
            turn = vec.minus(turn, vec.cross(_AXES[row - 3], along))
        vec.put3(work, at, vec.across(J, turn))


@inlined
def _to_frame(work, robot, R):
    """Turn accelerations, velocities and inputs that are held in reference axes there."""
    size, count, places = len(robot.order), len(robot.row), robot.places
    width, lower = 2 * size, places.A + 2 * size * size
    for part in range(2):
        if robot.turned[part]:
            first = 3 * part
            _turn_rows(work, lower + first * width, width, width, R)
            _turn_rows(work, places.B + first * count, count, count, R)
            acceleration = places.f0 + size + first
            vec.put3(work, acceleration, vec.product(R, vec.get3(work, acceleration)))
            for row in range(size):
                at = lower + row * width + size + first
                vec.put3(work, at, vec.product(R, vec.get3(work, at)))
    for index in range(len(robot.held)):
        for row in range(size):
            at = places.B + row * count + robot.held[index]
            vec.put3(work, at, vec.product(R, vec.get3(work, at)))


@inlined
def _write_upper(work, robot, point, quaternion, R, N, J):
    """Write what differs from point to point of attitude and position: (4.1) to (4.3)."""
    size, places = len(robot.order), robot.places
    width, r_b = 2 * size, places.A + 6 * size
    w, v = vec.get3(point.nu, 0), vec.get3(point.nu, 3)
    share = vec.times(quaternion[0], 1.0 / quaternion[1])
    for j in range(3):
        crossed = vec.cross(w, _AXES[j])
        N_j = N[j]
        if robot.turned[0]:
            N_j = N[0][j], N[1][j], N[2][j]  # Q R^T = Q^T
        _put_column(work, places.A + size + j, width, N_j)
        by_q_b = vec.times(vec.plus(crossed, vec.times(w, share[j])), -0.5)
        if robot.turned[0]:
            by_q_b = vec.plus(by_q_b, vec.product(N, vec.cross(w, J[j])))
        if robot.moving:
            by_q_b = vec.times(crossed, -1.0)  # (5.2)
            _put_column(work, r_b + 3 + j, width, by_q_b)  # (5.3)
        _put_column(work, places.A + j, width, by_q_b)
        if not robot.turned[1]:
            moved = vec.product(R, vec.cross(v, J[j]))
            _put_column(work, r_b + j, width, vec.times(moved, -1.0))
            _put_column(work, r_b + size + 3 + j, width, R[j])


@inlined
def assemble(work, robot, point):
    """Write A, B and f0 of c and its slopes, whose lower half of A stands in base axes."""
    size, count, places = len(robot.order), len(robot.row), robot.places
    width, f0 = 2 * size, places.f0
    w, v = vec.get3(point.nu, 0), vec.get3(point.nu, 3)
    quaternion = _chart(work, robot, point.q)
    R = columns_of(quaternion)
    N, J = _kinematics(quaternion)
    gravity = vec.across(axes_of(point.q), vec.get3(robot.gravity, 0))
    vec.copy(work, places.by_u, work, places.B, size * count)
    vec.put3(work, f0, vec.product(N, w))
    vec.put3(work, f0 + 3, vec.product(R, v))
    vec.copy(point.nu, 6, work, f0 + 6, size - 6)
    vec.copy(work, robot.layout.c, work, f0 + size, size)
    vec.add3(work, f0 + size + 3, gravity)
    _over_turns(work, robot, point, gravity, J)
    _write_upper(work, robot, point, quaternion, R, N, J)
    if robot.own == 0:
        _to_frame(work, robot, R)
    if not robot.turned[1]:
        vec.add3(work, f0 + size + 3, vec.cross(v, w))  # (3.2)
        at = places.A + (size + 3) * width + size
        for j in range(3):
            along, around = vec.cross(v, _AXES[j]), vec.cross(_AXES[j], w)
            for row in range(3):  # (4.5)
                vec.add(work, at + row * width + j, along[row])
                vec.add(work, at + row * width + 3 + j, around[row])
    falls = vec.dot(vec.get3(robot.gravity, 0), vec.get3(robot.gravity, 0))
    if robot.moving and falls > 0.0:
        # Turns about gravity change nothing.
        share = vec.dot(vec.get3(work, f0), gravity) * (1.0 / falls)
        vec.put3(work, f0, vec.minus(vec.get3(work, f0), vec.times(gravity, share)))
    store(work, places.judged + 2, quaternion[1])


@inlined
def judge(work, robot):
    """Write the sum of the squares of accelerations and slopes."""
    size, count, places = len(robot.order), len(robot.row), robot.places
    width = 2 * size
    # Column by column, so that no sum waits for the one before.
    for column in range(width + count):
        store(work, places.sums + column, 0.0)
    for row in range(size):
        at = places.A + (size + row) * width
        for column in range(width):
            value = load(work, at + column)
            vec.add(work, places.sums + column, value * value)
        for column in range(count):
            value = load(work, places.B + row * count + column)
            vec.add(work, places.sums + width + column, value * value)
    total = splat(work, 0.0)
    for column in range(width + count):
        total = total + load(work, places.sums + column)
    for row in range(width):
        value = load(work, places.f0 + row)
        total = total + value * value
    store(work, places.judged + 1, total)
