"""The policies of the loop: feedback of the state, of outputs by a filter, and on a path."""

from __future__ import annotations

from collections import namedtuple

import numpy as np

from fflin.kernel.forward import joint_position, seen
from fflin.kernel.lanes import chosen, inlined, load, splat, store, whole
from fflin.kernel.places import axes_of, columns_of
from fflin.kernel.tracking import track
from fflin.kernel.vectors import copy, get3, plus, product, put3, times

NOTHING, STATE, OUTPUT, TRACK = range(4)


class Law(namedtuple("Law", "kind turned near K offset A B C y0 measured x z next path")):
    """A policy; each array of doubles may have a second axis of eight lanes.

    By its kind NOTHING, STATE: u = offset - K x, OUTPUT: u = offset + C z and z' = A z + B (y - y0)
    with y the states that are `measured`, or TRACK: u = u* - K e along `path`. `turned` says
    whether omega_b and v_b of the state stand in reference axes, `near` (n,) which turn is taken
    of joints that go round. x (nx,) and `next` (nz,) are work space, z (nz,) is the filter's state.
    """


@inlined
def read_state(robot, law, point):
    """Write the state in the chart."""
    x, q, nu, n = law.x, point.q, point.nu, len(robot.index)
    vector, scalar = seen(robot, q)
    sign = chosen(scalar, 0.0, -1.0, 1.0)
    put3(x, 0, times(vector, sign))
    put3(x, 3, plus(get3(robot.origin, 0), product(axes_of(robot.origin), get3(q, 0))))
    for joint in range(n):
        value = joint_position(robot, q, joint)
        if robot.circling[joint]:
            turns = whole((load(law.near, joint) - value) * (0.5 / np.pi))
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
def _times(matrix, row, x):
    """Return a row of a matrix times a vector."""
    total, width = load(matrix, row * len(x)) * load(x, 0), len(x)
    for index in range(1, width):
        total = total + load(matrix, row * width + index) * load(x, index)
    return total


@inlined
def command(robot, law, point, t):
    """Write the inputs that a policy asks for."""
    if law.kind == TRACK:
        track(robot, law.path, point, t)
        return
    read_state(robot, law, point)
    if law.kind == STATE:
        for index in range(len(law.offset)):
            store(point.u, index, load(law.offset, index) - _times(law.K, index, law.x))
    else:
        _filter(law, point.u)


@inlined
def _filter(law, u):
    """Write what the estimate asks for, and bring it up to the next sample."""
    for index in range(len(law.offset)):
        store(u, index, load(law.offset, index) + _times(law.C, index, law.z))
    outputs = len(law.measured)
    for row in range(len(law.z)):
        total = splat(law.z, 0.0) + _times(law.A, row, law.z)
        for index in range(outputs):
            y = load(law.x, law.measured[index]) - load(law.y0, index)
            total = total + load(law.B, row * outputs + index) * y
        store(law.next, row, total)
    copy(law.next, 0, law.z, 0, len(law.z))
