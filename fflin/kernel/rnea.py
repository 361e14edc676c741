"""Velocities, accelerations and forces of all bodies: RNEA in base axes.

All vectors are in base axes, and all moments are about the joints, as in `kernel.inertia`.

References
----------
R. Featherstone, Rigid Body Dynamics Algorithms, Springer, 2008, chapter 5.
"""

from __future__ import annotations

from fflin.kernel import vectors as vec
from fflin.kernel.inertia import spatial_inertia_times
from fflin.kernel.lanes import inlined, load, splat, store
from fflin.kernel.tree import INERTIA, LOAD, MOTION, PLACE

# Offsets of the motion vectors of each body: velocity, Psi', acceleration without c, acceleration
# by c alone, and Psi''.
VELOCITY, PSI, BIAS, ADDED, PSI2 = 0, 6, 12, 18, 24
# Offsets of the quantities of each joint's subtree: momentum p, columns of G, stored momentum h,
# moment and force without c, and moment and force by c alone.
MOMENTUM, MOMENTS, STORED, FORCE, CARRIED = 0, 3, 12, 15, 21

_NONE = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)


@inlined
def joint_axis(work, tree, body):
    """Return the spatial axis of a joint, angular and linear, per unit of its coordinate."""
    z = vec.get3(work, tree.places + (body * PLACE + 6))
    share = tree.factor[body]
    return vec.times(z, share * tree.turns[body]), vec.times(z, share * tree.slides[body])


@inlined
def motion_cross(velocity, along):
    """Return `velocity` x `along`: the rate of a motion vector that is fixed in a body."""
    w, v = velocity
    return vec.cross(w, along[0]), vec.plus(vec.cross(w, along[1]), vec.cross(v, along[0]))


@inlined
def at_joint(work, at, place):
    """Shift the parent's motion vector at `at` to the origin of a joint."""
    w, v = vec.get6(work, at)
    return w, vec.plus(v, vec.cross(w, vec.get3(work, place + 9)))


@inlined
def at_parent(work, place, force):
    """Shift a spatial force from a joint's origin to the origin of its parent."""
    return vec.plus(force[0], vec.cross(vec.get3(work, place + 9), force[1])), force[1]


@inlined
def move_bodies(work, tree, layout, nu):
    """Write velocities and accelerations without c, from the base outwards, for v_b = 0."""
    for entry in range(MOTION):
        store(work, layout.motion + entry, 0.0)
    vec.put3(work, layout.motion, vec.get3(nu, 0))
    for body in range(1, len(tree.parent)):
        at = layout.motion + body * MOTION
        above = layout.motion + tree.parent[body] * MOTION
        place = tree.places + body * PLACE
        rate = load(nu, tree.coordinate[body])
        axis = joint_axis(work, tree, body)
        velocity = at_joint(work, above + VELOCITY, place)
        psi = motion_cross(velocity, axis)
        bias = at_joint(work, above + BIAS, place)
        vec.put6(work, at + VELOCITY, vec.plus6(velocity, vec.times6(axis, rate)))
        vec.put6(work, at + PSI, psi)
        vec.put6(work, at + BIAS, vec.plus6(bias, vec.times6(psi, rate)))


@inlined
def load_bodies(work, tree, layout, loads):
    """Write the inertial force of each single body, including its gyroscopic torque."""
    for body in range(len(tree.parent)):
        at = layout.load + body * LOAD + FORCE
        moving = layout.motion + body * MOTION
        own = tree.own + body * INERTIA
        w, v = vec.get6(work, moving + VELOCITY)
        turning, p = spatial_inertia_times(work, own, (w, v))
        moment, force = spatial_inertia_times(work, own, vec.get6(work, moving + BIAS))
        moment = vec.plus(moment, vec.plus(vec.cross(w, turning), vec.cross(v, p)))
        vec.put6(work, at, (moment, vec.plus(force, vec.cross(w, p))))
    for index in range(len(loads.stored_body)):
        body = loads.stored_body[index]
        turning = vec.cross(
            vec.get3(work, layout.motion + body * MOTION), stored_momentum(work, tree, loads, index)
        )
        vec.add3(work, layout.load + body * LOAD + FORCE, turning)


@inlined
def load_carried(work, tree, layout, loads, u):
    """Subtract the body-fixed wrenches of inputs from the forces of the bodies."""
    for index in range(len(loads.body)):
        pushed = vec.minus6(_NONE, carried_wrench(work, tree, loads, index))
        at = layout.load + loads.body[index] * LOAD + FORCE
        vec.add6(work, at, vec.times6(pushed, load(u, loads.input[index])))


@inlined
def load_momenta(work, tree, layout, loads):
    """Write the momentum, the moments G and the stored momentum of each single body."""
    zero = splat(work, 0.0)
    for body in range(len(tree.parent)):
        at = layout.load + body * LOAD
        own = tree.own + body * INERTIA
        w, v = vec.get6(work, layout.motion + body * MOTION + VELOCITY)
        h = vec.get3(work, own + 1)
        vec.put3(work, at + MOMENTUM, spatial_inertia_times(work, own, (w, v))[1])
        # The matrix of second moments of mass is tr(I) / 2 times the identity, minus I.
        xx, xy, xz = vec.get3(work, own + 4)
        yy, yz, zz = vec.get3(work, own + 7)
        trace = 0.5 * (xx + yy + zz)
        x = trace - xx, -xy, -xz
        y = -xy, trace - yy, -yz
        z = -xz, -yz, trace - zz
        vec.put3(work, at + MOMENTS, vec.plus(vec.times(v, h[0]), vec.cross(w, x)))
        vec.put3(work, at + MOMENTS + 3, vec.plus(vec.times(v, h[1]), vec.cross(w, y)))
        vec.put3(work, at + MOMENTS + 6, vec.plus(vec.times(v, h[2]), vec.cross(w, z)))
        vec.put3(work, at + STORED, (zero, zero, zero))
        vec.put6(work, at + CARRIED, ((zero, zero, zero), (zero, zero, zero)))
    for index in range(len(loads.stored_body)):
        at = layout.load + loads.stored_body[index] * LOAD + STORED
        vec.add3(work, at, stored_momentum(work, tree, loads, index))


@inlined
def stored_momentum(work, tree, loads, index):
    """Return a stored momentum in base axes."""
    axes = vec.get_columns(work, tree.places + loads.stored_body[index] * PLACE)
    return vec.product(axes, vec.get3(loads.stored, 3 * index))


@inlined
def carried_wrench(work, tree, loads, index):
    """Return the wrench of a unit body-fixed input about its body's joint, in base axes."""
    axes = vec.get_columns(work, tree.places + loads.body[index] * PLACE)
    moment, force = vec.get6(loads.wrench, 6 * index)
    return vec.product(axes, moment), vec.product(axes, force)


@inlined
def write_columns(work, tree, layout, loads):
    """Write the generalised force per unit of each body-fixed input."""
    count = len(loads.body)
    for entry in range(len(tree.row) * count):
        store(work, layout.columns + entry, 0.0)
    for index in range(count):
        body, wrench = loads.body[index], carried_wrench(work, tree, loads, index)
        while body > 0:
            value = vec.dot6(joint_axis(work, tree, body), wrench)
            vec.add(work, layout.columns + tree.coordinate[body] * count + index, value)
            wrench = at_parent(work, tree.places + body * PLACE, wrench)
            body = tree.parent[body]
        for axis in range(3):
            entry = layout.columns + axis * count + index
            store(work, entry, wrench[0][axis])
            store(work, entry + 3 * count, wrench[1][axis])


@inlined
def collect(work, tree, layout):
    """Sum the bodies' forces over subtrees, from the tips inwards, and write the bias forces."""
    for index in range(len(tree.row)):
        store(work, layout.bias + index, 0.0)
    for body in range(len(tree.parent) - 1, 0, -1):
        force = vec.get6(work, layout.load + body * LOAD + FORCE)
        value = vec.dot6(joint_axis(work, tree, body), force)
        vec.add(work, layout.bias + tree.coordinate[body], value)
        to = layout.load + tree.parent[body] * LOAD + FORCE
        vec.add6(work, to, at_parent(work, tree.places + body * PLACE, force))
    vec.add6(work, layout.bias, vec.get6(work, layout.load + FORCE))


@inlined
def collect_momenta(work, tree, layout):
    """Sum the bodies' momenta over subtrees, from the tips inwards."""
    for body in range(len(tree.parent) - 1, 0, -1):
        at = layout.load + body * LOAD
        above = layout.load + tree.parent[body] * LOAD
        d = vec.get3(work, tree.places + body * PLACE + 9)
        p = vec.get3(work, at + MOMENTUM)
        vec.add3(work, above + MOMENTUM, p)
        vec.add3(work, above + STORED, vec.get3(work, at + STORED))
        columns = vec.get_columns(work, at + MOMENTS)
        for index in range(3):
            column = vec.plus(columns[index], vec.times(p, d[index]))
            vec.add3(work, above + MOMENTS + 3 * index, column)


@inlined
def accelerate_bodies(work, tree, layout):
    """Add what c contributes to accelerations and Psi'' (outwards), then to forces (inwards)."""
    vec.put6(work, layout.motion + ADDED, vec.get6(work, layout.c))
    for body in range(1, len(tree.parent)):
        at = layout.motion + body * MOTION
        above = layout.motion + tree.parent[body] * MOTION
        place = tree.places + body * PLACE
        rate = load(work, layout.c + tree.coordinate[body])
        axis = joint_axis(work, tree, body)
        added = at_joint(work, above + ADDED, place)
        acceleration = vec.plus6(added, at_joint(work, above + BIAS, place))
        velocity = at_joint(work, above + VELOCITY, place)
        psi = vec.get6(work, at + PSI)
        vec.put6(
            work,
            at + PSI2,
            vec.plus6(motion_cross(acceleration, axis), motion_cross(velocity, psi)),
        )
        vec.put6(work, at + ADDED, vec.plus6(added, vec.times6(axis, rate)))
    for body in range(len(tree.parent) - 1, 0, -1):
        at = layout.load + body * LOAD
        inertia = tree.inertias + body * INERTIA
        place = tree.places + body * PLACE
        above = layout.motion + tree.parent[body] * MOTION
        rate = load(work, layout.c + tree.coordinate[body])
        own = spatial_inertia_times(work, inertia, vec.times6(joint_axis(work, tree, body), rate))
        carried = vec.plus6(vec.get6(work, at + CARRIED), own)
        shared = spatial_inertia_times(work, inertia, at_joint(work, above + ADDED, place))
        vec.add6(work, at + FORCE, vec.plus6(carried, shared))
        if tree.parent[body] > 0:
            to = layout.load + tree.parent[body] * LOAD + CARRIED
            vec.add6(work, to, at_parent(work, place, carried))
