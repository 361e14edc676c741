r"""Momentum and centre of mass as the impulse from outside takes them, and their keeping.

.. math:: H(t) = H(0) + \int w\,dt, \qquad r_c(t) = r_c(0) + \int p / m\,dt

(11.2) of docs/derivation.md, as `simulation.conservation` has it; momentum is linear, then angular
about the base's origin at the start, in reference axes, and places are seen from there.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from fflin.kernel.forward import push
from fflin.kernel.lanes import inlined, load, store
from fflin.kernel.places import attitude, columns_of
from fflin.kernel.rnea import stored_momentum
from fflin.kernel.vectors import (
    across,
    add,
    add3,
    cross,
    dot,
    get3,
    minus,
    plus,
    product,
    put3,
    times,
)

# Where these begin in the sums: impulse and way so far, and of the step.
IMPULSE, WAY, STEP_IMPULSE, STEP_WAY = 0, 6, 9, 15
SUMS = 18


class Course(NamedTuple):
    """What is kept; each array of doubles may have a second axis of eight lanes.

    Attributes
    ----------
    start : ndarray (12,)
        Momentum and centre of mass at the start, and the point that both are seen from.
    weight : ndarray (3,)
    per_mass : ndarray (1,)
    sums : ndarray (18,)
        Impulse (6,) and way besides that of the initial velocity (3,), so far and of the step.
    """

    start: Any
    weight: Any
    per_mass: Any
    sums: Any


@inlined
def begin_step(course):
    """Write that nothing has pushed yet in a step."""
    for entry in range(STEP_IMPULSE, SUMS):
        store(course.sums, entry, 0.0)


@inlined
def add_wrench(work, robot, course, point, weight, moment):
    """Add to the sums of a step what pushes at a stage, which counts by its weight and moment."""
    axes = columns_of(attitude(point.q))
    moments, force = push(work, robot, point)
    place = minus(get3(point.q, 0), get3(course.start, 9))
    lever, falls = product(axes, get3(work, robot.tree.inertias + 1)), get3(course.weight, 0)
    force = product(axes, force)
    # Of the weight m g at the centre of mass c, the lever being m c.
    torque = plus(product(axes, moments), cross(place, plus(force, falls)))
    torque = plus(torque, cross(times(lever, load(course.per_mass, 0)), falls))
    force = plus(force, falls)
    add3(course.sums, STEP_IMPULSE, times(force, weight))
    add3(course.sums, STEP_IMPULSE + 3, times(torque, weight))
    add3(course.sums, STEP_WAY, times(force, moment))


@inlined
def end_step(course, h):
    """Go on by a step of h [s]."""
    per_mass = load(course.per_mass, 0)
    way = times(get3(course.sums, IMPULSE), h)
    add3(course.sums, WAY, times(plus(way, get3(course.sums, STEP_WAY)), per_mass))
    for entry in range(6):
        add(course.sums, IMPULSE + entry, load(course.sums, STEP_IMPULSE + entry))


@inlined
def momentum_of(course):
    """Return the momentum, linear and angular."""
    linear = plus(get3(course.start, 0), get3(course.sums, IMPULSE))
    return linear, plus(get3(course.start, 3), get3(course.sums, IMPULSE + 3))


@inlined
def center_of(course, t):
    """Return where the centre of mass is."""
    flown = times(get3(course.start, 0), t * load(course.per_mass, 0))
    return plus(plus(get3(course.start, 6), get3(course.sums, WAY)), flown)


@inlined
def impose(work, robot, course, point, t):
    """Shift the base and set its velocity so that both are kept; M must be the point's.

    The velocity is corrected by what the momentum lacks, so that rounding is of second order.
    """
    tree, q, nu = robot.tree, point.q, point.nu
    axes = columns_of(attitude(q))
    m, lever = load(work, tree.inertias), get3(work, tree.inertias + 1)
    per_mass = 1.0 / m
    place = minus(center_of(course, t), times(product(axes, lever), per_mass))
    put3(q, 0, plus(place, get3(course.start, 9)))
    linear, angular = momentum_of(course)
    angular = across(axes, minus(angular, cross(place, linear)))
    linear = across(axes, linear)
    # The base's rows of M nu: its block of a rigid body, and the first six entries of each row.
    w, v = get3(nu, 0), get3(nu, 3)
    xx, xy, xz = get3(work, tree.inertias + 4)
    yy, yz, zz = get3(work, tree.inertias + 7)
    turning = dot((xx, xy, xz), w), dot((xy, yy, yz), w), dot((xz, yz, zz), w)
    angular = minus(angular, plus(turning, cross(lever, v)))
    linear = minus(linear, plus(times(v, m), cross(w, lever)))
    for index in range(6, len(tree.row)):
        row, rate = tree.packed + tree.row[index], load(nu, index)
        angular = minus(angular, times(get3(work, row), rate))
        linear = minus(linear, times(get3(work, row + 3), rate))
    for index in range(len(robot.loads.stored_body)):
        angular = minus(angular, stored_momentum(work, tree, robot.loads, index))
    # The same block solved, by the inertia about the centre of mass.
    d = times(lever, per_mass)
    about = minus(angular, cross(d, linear))
    a, b, c = (
        xx - (lever[1] * d[1] + lever[2] * d[2]),
        yy - (lever[0] * d[0] + lever[2] * d[2]),
        zz - (lever[0] * d[0] + lever[1] * d[1]),
    )
    f, g, h = xy + lever[0] * d[1], xz + lever[0] * d[2], yz + lever[1] * d[2]
    x, y, z = b * c - h * h, g * h - f * c, f * h - g * b
    inverse = 1.0 / (a * x + f * y + g * z)
    by = (x, y, z), (y, a * c - g * g, f * g - a * h), (z, f * g - a * h, a * b - f * f)
    w = times(product(by, about), inverse)
    add3(nu, 0, w)
    add3(nu, 3, plus(times(linear, per_mass), cross(d, w)))
