"""Forward dynamics with all that acts on a robot, one configuration or eight at once.

CRBA's M, the bias forces of RNEA and a factor of M. All stands in base axes and the base neither is
anywhere nor moves along, as no acceleration but those of (3.1) depends on either.
"""

from __future__ import annotations

from collections import namedtuple

import numba

from fflin.kernel import vectors as vec
from fflin.kernel.accelerations import Layout, Loads
from fflin.kernel.arguments import FLAGS, INDICES, LANED, REALS, WHOLE, Struct
from fflin.kernel.crba import inwards, outwards
from fflin.kernel.factor import factorise, solve
from fflin.kernel.lanes import angle, called, chosen, inlined, load, store
from fflin.kernel.places import attitude, axes_of, columns_of, quaternion_times
from fflin.kernel.rnea import collect, load_bodies, move_bodies, write_columns
from fflin.kernel.tree import Tree


class Mechanics(
    namedtuple(
        "Mechanics",
        "tree layout loads gravity index circling springy rest row held triads origin drives",
    )
):
    """A robot as the loop reads it; each array of doubles may have a second axis of eight lanes.

    Gravity (3,); of each joint its entry of q (`index`), whether that is the cosine of an angle,
    whether it has a spring or damper, and where the spring is at rest; the coordinate that each
    input drives (`row`), -1 for one that is carried; the first of three inputs each that are a
    vector on the base in reference axes (`held`), and in any (`triads`); the placement (7,) of
    the world's origin seen from the reference; and the errors of the inputs.
    """


class Drives(namedtuple("Drives", "gain bias until turn")):
    """What inputs (nu,) give of what is commanded: gain u + bias, and nothing from `until` [s].

    Of each triad the columns (9,) say along what its three act.
    """


class Point(namedtuple("Point", "q nu u pushing wrench")):
    """Where a robot is, q (nq,) and nu (6 + n,) in base axes, and the inputs (nu,) there.

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
    axes=numba.types.Array(numba.float64, 3, "C"),
    common=numba.types.Array(numba.intp, 2, "C"),
)
LAYOUT = Struct(Layout, WHOLE)
LOADS = Struct(Loads, LANED, body=INDICES, input=INDICES, stored_body=INDICES)
DRIVES, POINT = Struct(Drives, LANED), Struct(Point, LANED)
# One that is the same for all lanes.
COMMON_POINT = Struct(Point, name="CommonPoint")
MECHANICS = Struct(
    Mechanics,
    INDICES,
    tree=TREE,
    layout=LAYOUT,
    loads=LOADS,
    drives=DRIVES,
    **dict.fromkeys(("circling", "springy"), FLAGS),
    **dict.fromkeys(("gravity", "rest", "origin"), REALS),
)


@called
def configure(work, robot, q):
    """Write the places of all bodies and the packed M at a configuration."""
    outwards(work, robot.tree, q)
    inwards(work, robot.tree)


@inlined
def joint_position(robot, q, joint):
    """Return a joint's angle, in (-pi, pi] where it turns without end, or length."""
    at = robot.index[joint]
    value = load(q, at)
    if robot.circling[joint]:
        value = angle(load(q, at + 1), value)
    return value


@inlined
def seen(robot, q):
    """Return the base's quaternion seen from the reference."""
    return quaternion_times(attitude(robot.origin), attitude(q))


@inlined
def turn_inputs(robot, point, t):
    """Write the inputs as they act at a time, in base axes."""
    drives, pushing = robot.drives, point.pushing
    for index in range(len(robot.row)):
        given = load(drives.gain, index) * load(point.u, index) + load(drives.bias, index)
        store(pushing, index, chosen(t, load(drives.until, index), given, 0.0))
    for index in range(len(robot.triads)):
        at, columns = robot.triads[index], vec.get_columns(drives.turn, 9 * index)
        vec.put3(pushing, at, vec.product(columns, vec.get3(pushing, at)))
    turn_held(robot, point)


@inlined
def turn_held(robot, point):
    """Turn inputs that are held in reference axes to base axes."""
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
