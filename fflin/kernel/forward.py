r"""Forward dynamics with all that acts on a robot, and its first integrals.

Accelerations are by CRBA's M, the bias forces of RNEA and a factor of M. All stands in base axes
and the base neither is anywhere nor moves along, as no acceleration but those of (3.1) depends on
either. Momentum and centre of mass follow from the external impulse,

.. math:: H(t) = H(0) + \int w\,dt, \qquad r_c(t) = r_c(0) + \int p / m\,dt

(11.2) of docs/derivation.md, as `simulation.plant` has it; momentum is linear, then angular
about where the base's origin was at the start, and places are seen from there.
"""

from __future__ import annotations

from collections import namedtuple

import numpy as np

from fflin.kernel import vectors as vec
from fflin.kernel.arguments import FLAGS, INDICES, LANED, REALS, WHOLE, Kind, Struct
from fflin.kernel.inertia import factorise, inwards, outwards, solve, spatial_inertia_times
from fflin.kernel.lanes import angle, called, chosen, inlined, load, store
from fflin.kernel.rnea import collect, load_bodies, move_bodies, stored_momentum, write_columns
from fflin.kernel.tree import Layout, Loads, Tree


class Mechanics(
    namedtuple(
        "Mechanics",
        "tree layout loads gravity index circling scale springy rest row held triads origin faults",
    )
):
    """A robot as the loop reads it; each array of doubles may have a second axis of eight lanes.

    Gravity (3,); of each joint its entry of q (`index`), whether that is the cosine of an angle,
    the entry for a unit of q_m (`scale`, 1 except for modal amplitudes), whether it has a spring or
    damper, and where the spring is at rest; the coordinate that each input drives (`row`), -1 for
    one that is carried; the first of three inputs each that are a vector on the base in reference
    axes (`held`), and in any (`triads`); the placement (7,) of the world's origin seen from the
    reference; and the errors of the inputs.
    """


class ActuatorFaults(namedtuple("ActuatorFaults", "gain bias until turn")):
    """Actuator faults: the input is gain u + bias (nu,) for a command u, and 0 after `until` [s].

    `turn` has the columns (9,) along which the three inputs of each vector on the base act.
    """


class Point(namedtuple("Point", "q nu u pushing wrench")):
    """Point of a robot: q (nq,) and nu (6 + n,) in base axes, and the inputs (nu,).

    `u` is as it is commanded, `pushing` in base axes; `wrench` (6,) is what the inputs of the last
    acceleration are at the base's origin, moment and force.
    """


_OF_BODIES = dict.fromkeys(("parent", "index", "coordinate", "target", "row", "depth", "path"))
_SIZES = "entries places own inertias packed scaled diagonal square size"
TREE = Struct(
    Tree,
    **dict.fromkeys(_OF_BODIES, INDICES),
    **dict.fromkeys(_SIZES.split(), WHOLE),
    **dict.fromkeys(("fixed", "bodies"), LANED),
    unbounded=FLAGS,
    axes=Kind(np.float64, 3),
    common=Kind(np.intp, 2),
)
LAYOUT = Struct(Layout, WHOLE)
LOADS = Struct(Loads, LANED, body=INDICES, input=INDICES, stored_body=INDICES)
ACTUATOR_FAULTS, POINT = Struct(ActuatorFaults, LANED), Struct(Point, LANED)
# One that is the same for all lanes.
COMMON_POINT = Struct(Point, REALS, "CommonPoint")
MECHANICS = Struct(
    Mechanics,
    INDICES,
    tree=TREE,
    layout=LAYOUT,
    loads=LOADS,
    faults=ACTUATOR_FAULTS,
    **dict.fromkeys(("circling", "springy"), FLAGS),
    **dict.fromkeys(("gravity", "scale", "rest", "origin"), REALS),
)


@called
def configure(work, robot, q):
    """Write the places of all bodies and the packed M at a configuration."""
    outwards(work, robot.tree, q)
    inwards(work, robot.tree)


@inlined
def joint_position(robot, q, joint):
    """Return a joint's angle, in (-pi, pi] where it turns without end, length or amplitude."""
    at = robot.index[joint]
    value = load(q, at)
    if robot.circling[joint]:
        value = angle(load(q, at + 1), value)
    return value / load(robot.scale, joint)


@inlined
def seen(robot, q):
    """Return the base's quaternion relative to the reference."""
    return vec.quaternion_times(vec.attitude(robot.origin), vec.attitude(q))


@inlined
def apply_faults(faults, triads, t, u, given):
    """Write the inputs of faulty actuators for a command u at a time."""
    for index in range(len(faults.gain)):
        value = load(faults.gain, index) * load(u, index) + load(faults.bias, index)
        store(given, index, chosen(t, load(faults.until, index), value, 0.0))
    for index in range(len(triads)):
        at, columns = triads[index], vec.get_columns(faults.turn, 9 * index)
        vec.put3(given, at, vec.product(columns, vec.get3(given, at)))


@inlined
def turn_held(robot, point):
    """Rotate reference-frame inputs to base axes."""
    pushing = point.pushing
    for index in range(len(robot.held)):
        at = robot.held[index]
        axes = vec.columns_of(seen(robot, point.q))
        vec.put3(pushing, at, vec.across(axes, vec.get3(pushing, at)))


@inlined
def push(work, robot, pushing):
    """Write the generalised force of inputs in base axes where c will be."""
    tree, layout, loads = robot.tree, robot.layout, robot.loads
    force, size, count = layout.c, len(tree.row), len(loads.body)
    for index in range(size):
        store(work, force + index, 0.0)
    for index in range(len(robot.row)):
        if robot.row[index] >= 0:
            vec.add(work, force + robot.row[index], load(pushing, index))
    write_columns(work, tree, layout, loads)
    for index in range(count):
        u = load(pushing, loads.input[index])
        for row in range(size):
            vec.add(work, force + row, load(work, layout.columns + row * count + index) * u)


@called
def accelerate(work, robot, point, rates, to):
    """Write the rates of nu at a point that is configured into `rates` from `to` on.

    Its M is overwritten by its factor.
    """
    tree, layout, loads, nu = robot.tree, robot.layout, robot.loads, point.nu
    force, size = layout.c, len(tree.row)
    push(work, robot, point.pushing)
    vec.copy(work, force, point.wrench, 0, 6)
    move_bodies(work, tree, layout, nu)
    load_bodies(work, tree, layout, loads)
    collect(work, tree, layout)
    for index in range(size):
        vec.add(work, force + index, -load(work, layout.bias + index))
    for joint in range(len(robot.index)):
        if robot.springy[joint]:
            stretch = joint_position(robot, point.q, joint) - load(robot.rest, joint)
            pull = load(loads.stiffness, joint) * stretch
            pull = pull + load(loads.damping, joint) * load(nu, 6 + joint)
            vec.add(work, force + 6 + joint, -pull)
    factorise(work, tree)
    solve(work, tree, force)
    vec.copy(work, force, rates, to, size)
    # What falls and what turns takes the base's origin along.
    fall = vec.across(vec.axes_of(point.q), vec.get3(robot.gravity, 0))
    fall = vec.minus(fall, vec.cross(vec.get3(nu, 0), vec.get3(nu, 3)))
    vec.put3(rates, to + 3, vec.plus(vec.get3(rates, to + 3), fall))


# Where these begin in the sums: impulse and shift of the centre of mass, so far and of the step.
IMPULSE, SHIFT, STEP_IMPULSE, STEP_SHIFT = 0, 6, 9, 15
SUMS = 18


class MomentumReference(namedtuple("MomentumReference", "start weight per_mass sums")):
    """Reference of the conserved quantities; arrays of doubles may have a second axis of lanes.

    `start` (12,): momentum, centre of mass, and the point that both are seen from; weight (3,); and
    `sums` (18,): the impulse (6,), and the shift (3,) of the centre of mass beyond the one of its
    initial velocity, so far and of the step.
    """


MOMENTUM_REFERENCE = Struct(MomentumReference, LANED)


@inlined
def begin_step(reference):
    """Write that nothing has pushed yet in a step."""
    for entry in range(STEP_IMPULSE, SUMS):
        store(reference.sums, entry, 0.0)


@inlined
def add_wrench(work, robot, reference, point, weight, moment):
    """Add to the sums of a step what pushed at a stage, which counts by its weight and moment."""
    axes = vec.axes_of(point.q)
    moments, force = vec.get6(point.wrench, 0)
    place = vec.minus(vec.get3(point.q, 0), vec.get3(reference.start, 9))
    lever = vec.product(axes, vec.get3(work, robot.tree.inertias + 1))
    force, falls = vec.product(axes, force), vec.get3(reference.weight, 0)
    # Of the weight m g at the centre of mass c, the lever being m c.
    torque = vec.plus(vec.product(axes, moments), vec.cross(place, vec.plus(force, falls)))
    torque = vec.plus(torque, vec.cross(vec.times(lever, load(reference.per_mass, 0)), falls))
    force = vec.plus(force, falls)
    vec.add3(reference.sums, STEP_IMPULSE, vec.times(force, weight))
    vec.add3(reference.sums, STEP_IMPULSE + 3, vec.times(torque, weight))
    vec.add3(reference.sums, STEP_SHIFT, vec.times(force, moment))


@inlined
def end_step(reference, h):
    """Go on by a step of h [s]."""
    per_mass = load(reference.per_mass, 0)
    shift = vec.times(vec.get3(reference.sums, IMPULSE), h)
    vec.add3(
        reference.sums,
        SHIFT,
        vec.times(vec.plus(shift, vec.get3(reference.sums, STEP_SHIFT)), per_mass),
    )
    vec.add6(reference.sums, IMPULSE, vec.get6(reference.sums, STEP_IMPULSE))


@inlined
def kept_at(reference, t):
    """Return the momentum, linear and angular, and where the centre of mass is."""
    momentum = vec.plus6(vec.get6(reference.start, 0), vec.get6(reference.sums, IMPULSE))
    flown = vec.times(vec.get3(reference.start, 0), t * load(reference.per_mass, 0))
    shift = vec.plus(vec.get3(reference.start, 6), vec.get3(reference.sums, SHIFT))
    return momentum, vec.plus(shift, flown)


@inlined
def start_at(work, robot, reference, point):
    """Write the conserved quantities at a point whose M is already computed."""
    axes, tree = vec.axes_of(point.q), robot.tree
    lever = vec.get3(work, tree.inertias + 1)
    nothing = vec.minus(lever, lever)
    angular, linear = _lack(work, robot, point.nu, (nothing, nothing))
    place = vec.minus(vec.get3(point.q, 0), vec.get3(reference.start, 9))
    linear = vec.times(vec.product(axes, linear), -1.0)
    angular = vec.minus(vec.cross(place, linear), vec.product(axes, angular))
    vec.put3(reference.start, 0, linear)
    vec.put3(reference.start, 3, angular)
    lever = vec.times(vec.product(axes, lever), load(reference.per_mass, 0))
    vec.put3(reference.start, 6, vec.plus(place, lever))


@inlined
def _lack(work, robot, nu, momentum):
    """Return what a momentum in base axes, angular and linear, is more than that of a velocity."""
    tree = robot.tree
    # The base's rows of M nu: its block of a rigid body, and the first six entries of each row.
    lack = vec.minus6(momentum, spatial_inertia_times(work, tree.inertias, vec.get6(nu, 0)))
    for index in range(6, len(tree.row)):
        row = vec.get6(work, tree.packed + tree.row[index])
        lack = vec.minus6(lack, vec.times6(row, load(nu, index)))
    angular, linear = lack
    for index in range(len(robot.loads.stored_body)):
        angular = vec.minus(angular, stored_momentum(work, tree, robot.loads, index))
    return angular, linear


@inlined
def impose(work, robot, reference, point, t):
    """Shift the base and set its velocity so that both are kept; M must be the point's.

    The velocity is corrected by what the momentum lacks, so that rounding is of second order.
    """
    tree, nu = robot.tree, point.nu
    axes = vec.axes_of(point.q)
    m, lever = load(work, tree.inertias), vec.get3(work, tree.inertias + 1)
    per_mass = 1.0 / m
    (linear, angular), center = kept_at(reference, t)
    place = vec.minus(center, vec.times(vec.product(axes, lever), per_mass))
    vec.put3(point.q, 0, vec.plus(place, vec.get3(reference.start, 9)))
    angular = vec.across(axes, vec.minus(angular, vec.cross(place, linear)))
    linear = vec.across(axes, linear)
    angular, linear = _lack(work, robot, nu, (angular, linear))
    # The same block solved, by the inertia about the centre of mass.
    xx, xy, xz = vec.get3(work, tree.inertias + 4)
    yy, yz, zz = vec.get3(work, tree.inertias + 7)
    d = vec.times(lever, per_mass)
    about = vec.minus(angular, vec.cross(d, linear))
    p, q, r = lever[0] * d[0], lever[1] * d[1], lever[2] * d[2]
    a, b, c = xx - (q + r), yy - (p + r), zz - (p + q)
    f, g, h = xy + lever[0] * d[1], xz + lever[0] * d[2], yz + lever[1] * d[2]
    x, y, z = b * c - h * h, g * h - f * c, f * h - g * b
    inverse = 1.0 / (a * x + f * y + g * z)
    by = (x, y, z), (y, a * c - g * g, f * g - a * h), (z, f * g - a * h, a * b - f * f)
    w = vec.times(vec.product(by, about), inverse)
    vec.add3(nu, 0, w)
    vec.add3(nu, 3, vec.plus(vec.times(linear, per_mass), vec.cross(d, w)))
