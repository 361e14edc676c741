"""Velocities, accelerations and forces of all bodies at eight points at once: RNEA in base axes.

All vectors stand in base axes and all moments are about the joints, as in `kernel.crba`.

References
----------
R. Featherstone, Rigid Body Dynamics Algorithms, Springer, 2008, chapter 5.
"""

from __future__ import annotations

import numba

from fflin.kernel.crba import inertia_times
from fflin.kernel.lanes import gather, load, splat, store
from fflin.kernel.tree import INERTIA, LANES, PLACE
from fflin.kernel.vectors import (
    add,
    add3,
    add6,
    cross,
    dot6,
    get3,
    get6,
    get_columns,
    plus,
    plus6,
    put3,
    put6,
    times,
    times6,
    turned,
)

# Where the motion vectors of every body begin: velocity, Psi', acceleration without c, that of c
# alone, and Psi''.
VELOCITY, PSI, BIAS, ADDED, PSI2 = 0, 6 * LANES, 12 * LANES, 18 * LANES, 24 * LANES
MOTION = 30
# Where these begin, of all that its joint carries: momentum p, columns of G, stored momentum h,
# moment and force without c, and those of c on what is carried.
MOMENTUM, MOMENTS, STORED, FORCE, CARRIED = 0, 3 * LANES, 12 * LANES, 15 * LANES, 21 * LANES
LOAD = 27


@numba.njit(forceinline=True)
def joint_axis(work, tree, body):
    """Return the spatial axis of a joint, angular and linear, for a unit of its coordinate."""
    z = get3(work, tree.places + (body * PLACE + 6) * LANES)
    share = tree.factor[body]
    return times(z, splat(share * tree.turns[body])), times(z, splat(share * tree.slides[body]))


@numba.njit(forceinline=True)
def motion_cross(velocity, along):
    """Return the rate of a motion vector `along` that is carried by a velocity."""
    w, v = velocity
    return cross(w, along[0]), plus(cross(w, along[1]), cross(v, along[0]))


@numba.njit(forceinline=True)
def spatial_inertia_times(work, at, motion):
    """Return inertia times a motion vector, moment and force."""
    m, h = load(work, at), get3(work, at + LANES)
    w, v = motion
    moment = plus(inertia_times(work, at, w), cross(h, v))
    return moment, plus(times(v, m), cross(w, h))


@numba.njit(forceinline=True)
def at_joint(work, at, place):
    """Return a motion vector of the carrier at a joint's own origin."""
    w, v = get6(work, at)
    return w, plus(v, cross(w, get3(work, place + 9 * LANES)))


@numba.njit(forceinline=True)
def at_parent(work, place, force):
    """Return a force at a joint's origin as one at its parent's."""
    return plus(force[0], cross(get3(work, place + 9 * LANES), force[1])), force[1]


@numba.njit(forceinline=True)
def move_bodies(work, tree, layout, nu, first):
    """Write the velocities, and the accelerations without c, outwards; the base does not slide."""
    stride = nu.shape[1]
    flat = nu.reshape(-1)
    zero = splat(0.0)
    none = zero, zero, zero
    for entry in range(MOTION):
        store(work, layout.motion + entry * LANES, zero)
    start = first * stride
    for axis in range(3):
        store(work, layout.motion + axis * LANES, gather(flat, start + axis, stride))
    for body in range(1, len(tree.parent)):
        at = layout.motion + body * MOTION * LANES
        above = layout.motion + tree.parent[body] * MOTION * LANES
        place = tree.places + body * PLACE * LANES
        rate = gather(flat, start + tree.coordinate[body], stride)
        axis = joint_axis(work, tree, body)
        velocity = at_joint(work, above + VELOCITY, place)
        psi = motion_cross(velocity, axis)
        bias = at_joint(work, above + BIAS, place)
        put6(work, at + VELOCITY, plus6(velocity, times6(axis, rate)))
        put6(work, at + PSI, psi)
        put6(work, at + BIAS, plus6(bias, times6(psi, rate)))
        put6(work, at + ADDED, (none, none))


@numba.njit(forceinline=True)
def _load_bodies(work, tree, layout):
    """Write momenta and forces of the bodies, each alone."""
    zero = splat(0.0)
    half = splat(0.5)
    for body in range(len(tree.parent)):
        at = layout.load + body * LOAD * LANES
        moving = layout.motion + body * MOTION * LANES
        inertia = tree.inertias + body * INERTIA * LANES
        w, v = get6(work, moving + VELOCITY)
        h = get3(work, inertia + LANES)
        turning, p = spatial_inertia_times(work, inertia, (w, v))
        for entry in range(LOAD):
            store(work, at + entry * LANES, zero)
        put3(work, at + MOMENTUM, p)
        # The second moments of mass are half the trace of I, less I.
        xx, xy, xz = get3(work, inertia + 4 * LANES)
        yy, yz, zz = get3(work, inertia + 7 * LANES)
        trace = half * (xx + yy + zz)
        x = trace - xx, zero - xy, zero - xz
        y = zero - xy, trace - yy, zero - yz
        z = zero - xz, zero - yz, trace - zz
        put3(work, at + MOMENTS, plus(times(v, h[0]), cross(w, x)))
        put3(work, at + MOMENTS + 3 * LANES, plus(times(v, h[1]), cross(w, y)))
        put3(work, at + MOMENTS + 6 * LANES, plus(times(v, h[2]), cross(w, z)))
        moment, force = spatial_inertia_times(work, inertia, get6(work, moving + BIAS))
        moment = plus(moment, plus(cross(w, turning), cross(v, p)))
        put6(work, at + FORCE, (moment, plus(force, cross(w, p))))


@numba.njit(forceinline=True)
def _load_stored(work, tree, layout, loads):
    """Add the momentum that bodies store, and the moments that turn it along."""
    for index in range(len(loads.stored_body)):
        body = loads.stored_body[index]
        at = layout.load + body * LOAD * LANES
        stored = loads.stored[index]
        axes = get_columns(work, tree.places + body * PLACE * LANES)
        h = turned(axes, stored[0], stored[1], stored[2])
        add3(work, at + STORED, h)
        add3(work, at + FORCE, cross(get3(work, layout.motion + body * MOTION * LANES), h))


@numba.njit(forceinline=True)
def _load_carried(work, tree, layout, loads, u, first):
    """Add the forces of the carried inputs, and write their generalised force for a unit."""
    zero = splat(0.0)
    for entry in range(len(tree.row) * len(loads.body)):
        store(work, layout.columns + entry * LANES, zero)
    stride = u.shape[1]
    flat = u.reshape(-1)
    for index in range(len(loads.body)):
        body, unit = loads.body[index], loads.wrench[index]
        axes = get_columns(work, tree.places + body * PLACE * LANES)
        wrench = turned(axes, unit[0], unit[1], unit[2]), turned(axes, unit[3], unit[4], unit[5])
        pushed = zero - gather(flat, first * stride + loads.input[index], stride)
        add6(work, layout.load + body * LOAD * LANES + FORCE, times6(wrench, pushed))
        while body > 0:
            entry = tree.coordinate[body] * len(loads.body) + index
            value = dot6(joint_axis(work, tree, body), wrench)
            add(work, layout.columns + entry * LANES, value)
            wrench = at_parent(work, tree.places + body * PLACE * LANES, wrench)
            body = tree.parent[body]
        for axis in range(3):
            entry = axis * len(loads.body) + index
            store(work, layout.columns + entry * LANES, wrench[0][axis])
            entry += 3 * len(loads.body)
            store(work, layout.columns + entry * LANES, wrench[1][axis])


@numba.njit(forceinline=True)
def load_bodies(work, tree, layout, loads, u, first):
    """Write momenta and forces of the bodies alone, and what a unit of each carried input is."""
    _load_bodies(work, tree, layout)
    _load_stored(work, tree, layout, loads)
    _load_carried(work, tree, layout, loads, u, first)


@numba.njit(forceinline=True)
def collect(work, tree, layout):
    """Add the momenta and forces of what is carried, inwards, and write the bias forces."""
    for index in range(len(tree.row)):
        store(work, layout.bias + index * LANES, splat(0.0))
    for body in range(len(tree.parent) - 1, 0, -1):
        at = layout.load + body * LOAD * LANES
        above = layout.load + tree.parent[body] * LOAD * LANES
        place = tree.places + body * PLACE * LANES
        d = get3(work, place + 9 * LANES)
        force = get6(work, at + FORCE)
        value = dot6(joint_axis(work, tree, body), force)
        add(work, layout.bias + tree.coordinate[body] * LANES, value)
        p = get3(work, at + MOMENTUM)
        add3(work, above + MOMENTUM, p)
        add3(work, above + STORED, get3(work, at + STORED))
        columns = get_columns(work, at + MOMENTS)
        for index in range(3):
            column = plus(columns[index], times(p, d[index]))
            add3(work, above + MOMENTS + 3 * index * LANES, column)
        add6(work, above + FORCE, at_parent(work, place, force))
    at = layout.load + FORCE
    for index in range(6):
        add(work, layout.bias + index * LANES, load(work, at + index * LANES))


@numba.njit(forceinline=True)
def accelerate_bodies(work, tree, layout):
    """Complete the accelerations with c: write Psi'' outwards, and the forces of c inwards."""
    for index in range(6):
        value = load(work, layout.c + index * LANES)
        store(work, layout.motion + ADDED + index * LANES, value)
    for body in range(1, len(tree.parent)):
        at = layout.motion + body * MOTION * LANES
        above = layout.motion + tree.parent[body] * MOTION * LANES
        place = tree.places + body * PLACE * LANES
        rate = load(work, layout.c + tree.coordinate[body] * LANES)
        axis = joint_axis(work, tree, body)
        added = at_joint(work, above + ADDED, place)
        acceleration = plus6(added, at_joint(work, above + BIAS, place))
        velocity = at_joint(work, above + VELOCITY, place)
        psi = get6(work, at + PSI)
        put6(work, at + PSI2, plus6(motion_cross(acceleration, axis), motion_cross(velocity, psi)))
        put6(work, at + ADDED, plus6(added, times6(axis, rate)))
    for body in range(len(tree.parent) - 1, 0, -1):
        at = layout.load + body * LOAD * LANES
        inertia = tree.inertias + body * INERTIA * LANES
        place = tree.places + body * PLACE * LANES
        above = layout.motion + tree.parent[body] * MOTION * LANES
        rate = load(work, layout.c + tree.coordinate[body] * LANES)
        own = spatial_inertia_times(work, inertia, times6(joint_axis(work, tree, body), rate))
        carried = plus6(get6(work, at + CARRIED), own)
        shared = spatial_inertia_times(work, inertia, at_joint(work, above + ADDED, place))
        add6(work, at + FORCE, plus6(carried, shared))
        if tree.parent[body] > 0:
            to = layout.load + tree.parent[body] * LOAD * LANES + CARRIED
            add6(work, to, at_parent(work, place, carried))
