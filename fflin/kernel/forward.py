"""Forward dynamics with all that acts on a robot, one configuration or eight at once.

CRBA's M, the bias forces of RNEA and a factor of M. All stands in base axes and the base neither is
anywhere nor moves along, as no acceleration but those of (3.1) depends on either.
"""

from __future__ import annotations

from collections import namedtuple

import numpy as np

from fflin.kernel import vectors as vec
from fflin.kernel.arguments import FLAGS, INDICES, LANED, REALS, WHOLE, Kind, Struct
from fflin.kernel.displacements import attitude, axes_of, columns_of, quaternion_times
from fflin.kernel.inertia import factorise, inwards, outwards, solve
from fflin.kernel.lanes import angle, called, chosen, inlined, load, store
from fflin.kernel.rnea import collect, load_bodies, move_bodies, write_columns
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
    return quaternion_times(attitude(robot.origin), attitude(q))


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
        axes = columns_of(seen(robot, point.q))
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
    fall = vec.across(axes_of(point.q), vec.get3(robot.gravity, 0))
    fall = vec.minus(fall, vec.cross(vec.get3(nu, 0), vec.get3(nu, 3)))
    vec.put3(rates, to + 3, vec.plus(vec.get3(rates, to + 3), fall))
