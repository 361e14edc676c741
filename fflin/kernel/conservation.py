r"""Momentum and centre of mass from the external impulse, and their projection.

.. math:: H(t) = H(0) + \int w\,dt, \qquad r_c(t) = r_c(0) + \int p / m\,dt

(11.2) of docs/derivation.md, as `simulation.conservation` has it; momentum is linear, then angular
about where the base's origin was at the start, and places are seen from there.
"""

from __future__ import annotations

from collections import namedtuple

from fflin.kernel import vectors as vec
from fflin.kernel.arguments import LANED, Struct
from fflin.kernel.displacements import axes_of
from fflin.kernel.inertia import spatial_inertia_times
from fflin.kernel.lanes import inlined, load, store
from fflin.kernel.rnea import stored_momentum

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
    axes = axes_of(point.q)
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
    axes, tree = axes_of(point.q), robot.tree
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
    axes = axes_of(point.q)
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
