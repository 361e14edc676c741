"""Forward dynamics with all that acts on a robot, one configuration or eight at once.

CRBA's M, the bias forces of RNEA and a factor of M. All stands in base axes and the base neither is
anywhere nor moves along, as no acceleration but those of (3.1) depends on either.
"""

from __future__ import annotations

from collections import namedtuple

from fflin.kernel import vectors as vec
from fflin.kernel.crba import inwards, outwards
from fflin.kernel.factor import factorise, solve
from fflin.kernel.lanes import angle, inlined, load, store
from fflin.kernel.places import attitude, axes_of, columns_of, quaternion_times
from fflin.kernel.rnea import at_parent, carried_wrench, collect, load_bodies, move_bodies
from fflin.kernel.tree import PLACE


class Mechanics(
    namedtuple("Mechanics", "tree layout loads gravity index circling springy rest row held origin")
):
    """A robot as the loop reads it; each array of doubles may have a second axis of eight lanes.

    Gravity (3,); of each joint its entry of q (`index`), whether that is the cosine of an angle,
    whether it has a spring or damper, and where the spring is at rest; the coordinate that each
    input drives (`row`), -1 for one that is carried; the first of three inputs each that are a
    vector on the base in reference axes (`held`); and the placement (7,) of the world's origin seen
    from the reference.
    """


class Point(namedtuple("Point", "q nu u pushing")):
    """Where a robot is, q (nq,) and nu (6 + n,) in base axes, and the inputs (nu,) there.

    `u` is as it is commanded, `pushing` in base axes.
    """


@inlined
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
def turn_inputs(robot, point):
    """Write the inputs in base axes."""
    vec.copy(point.u, 0, point.pushing, 0, len(robot.row))
    for index in range(len(robot.held)):
        at = robot.held[index]
        axes = columns_of(seen(robot, point.q))
        vec.put3(point.pushing, at, vec.across(axes, vec.get3(point.u, at)))


@inlined
def accelerate(work, robot, point, rates, to):
    """Write the rates of nu at a point that is configured into `rates` from `to` on.

    Its M is overwritten by its factor.
    """
    tree, layout, loads, nu = robot.tree, robot.layout, robot.loads, point.nu
    move_bodies(work, tree, layout, nu)
    load_bodies(work, tree, layout, loads, point.pushing)
    collect(work, tree, layout)
    force, size = layout.bias, len(tree.row)
    for index in range(size):
        store(work, force + index, -load(work, force + index))
    for index in range(len(robot.row)):
        if robot.row[index] >= 0:
            vec.add(work, force + robot.row[index], load(point.pushing, index))
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


@inlined
def push(work, robot, point):
    """Return the wrench on the robot at its base's origin (moment, force) of all its inputs."""
    tree, loads = robot.tree, robot.loads
    for index in range(6):
        store(work, robot.layout.bias + index, 0.0)
    for index in range(len(robot.row)):
        if 0 <= robot.row[index] < 6:
            vec.add(work, robot.layout.bias + robot.row[index], load(point.pushing, index))
    total = vec.get6(work, robot.layout.bias)
    for index in range(len(loads.body)):
        body, wrench = loads.body[index], carried_wrench(work, tree, loads, index)
        while body > 0:
            wrench = at_parent(work, tree.places + body * PLACE, wrench)
            body = tree.parent[body]
        total = vec.plus6(total, vec.times6(wrench, load(point.pushing, loads.input[index])))
    return total
