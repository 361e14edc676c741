"""Velocities, accelerations and forces of all bodies at eight points at once: RNEA in base axes.

All vectors stand in base axes and all moments are about the joints, as in `batch_crba`.

References
----------
R. Featherstone, Rigid Body Dynamics Algorithms, Springer, 2008, chapter 5.
"""

from __future__ import annotations

import numba

from fflin.kernel.lanes import gather, load, splat, store
from fflin.kernel.tree import INERTIA, LANES, PLACE
from fflin.kernel.vectors import add, add3, cross, dot, get3, plus, put3, times, turned

# Of every body, in this order: velocity and Psi' (angular, linear); acceleration that forces and
# motion cause without c, that of c alone; Psi''.
VELOCITY, PSI, BIAS, ADDED, PSI2 = 0, 6 * LANES, 12 * LANES, 18 * LANES, 24 * LANES
MOTION = 30
# Of all that its joint carries: momentum p, columns of G, stored momentum h, moment and force
# without c, and those of c on what is carried.
MOMENTUM, MOMENTS, STORED, FORCE, CARRIED = 0, 3 * LANES, 12 * LANES, 15 * LANES, 21 * LANES
LOAD = 27


@numba.njit(forceinline=True)
def joint_axis(work, tree, body):
    """Return the spatial axis of a joint, angular and linear, for a unit of its coordinate."""
    z = get3(work, tree.places + (body * PLACE + 6) * LANES)
    share = tree.factor[body]
    return times(z, splat(share * tree.turns[body])), times(z, splat(share * tree.slides[body]))


@numba.njit(forceinline=True)
def crossed(angular, linear, along):
    """Return the rate of a motion vector `along` that is carried by a velocity."""
    return (
        cross(angular, along[0]),
        plus(cross(angular, along[1]), cross(linear, along[0])),
    )


@numba.njit(forceinline=True)
def weighed(work, at, angular, linear):
    """Return inertia times a motion vector, moment and force."""
    m, h = load(work, at), get3(work, at + LANES)
    xx, xy, xz = get3(work, at + 4 * LANES)
    yy, yz, zz = get3(work, at + 7 * LANES)
    x, y, z = angular
    turning = xx * x + xy * y + xz * z, xy * x + yy * y + yz * z, xz * x + yz * y + zz * z
    return plus(turning, cross(h, linear)), plus(times(linear, m), cross(angular, h))


@numba.njit(forceinline=True)
def step_motion(work, at, place):
    """Return a motion vector of the carrier at a joint's own origin, angular and linear."""
    w = get3(work, at)
    return w, plus(get3(work, at + 3 * LANES), cross(w, get3(work, place + 9 * LANES)))


@numba.njit(forceinline=True)
def write6(work, at, angular, linear):
    """Write a motion or force vector."""
    put3(work, at, angular[0], angular[1], angular[2])
    put3(work, at + 3 * LANES, linear[0], linear[1], linear[2])


@numba.njit(forceinline=True)
def first_moments(work, at):
    """Return the columns of G."""
    return get3(work, at), get3(work, at + 3 * LANES), get3(work, at + 6 * LANES)


@numba.njit(forceinline=True)
def move(work, tree, layout, nu, first):
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
        w, v = step_motion(work, above + VELOCITY, place)
        psi = crossed(w, v, axis)
        alpha, a = step_motion(work, above + BIAS, place)
        write6(work, at + VELOCITY, plus(w, times(axis[0], rate)), plus(v, times(axis[1], rate)))
        write6(work, at + PSI, *psi)
        write6(work, at + BIAS, plus(alpha, times(psi[0], rate)), plus(a, times(psi[1], rate)))
        write6(work, at + ADDED, none, none)


@numba.njit(forceinline=True)
def _load_bodies(work, tree, layout):
    """Write momenta and forces of the bodies, each alone."""
    zero = splat(0.0)
    half = splat(0.5)
    for body in range(len(tree.parent)):
        at = layout.load + body * LOAD * LANES
        moving = layout.motion + body * MOTION * LANES
        inertia = tree.inertias + body * INERTIA * LANES
        w, v = get3(work, moving), get3(work, moving + 3 * LANES)
        h = get3(work, inertia + LANES)
        turning, p = weighed(work, inertia, w, v)
        for entry in range(LOAD):
            store(work, at + entry * LANES, zero)
        put3(work, at + MOMENTUM, p[0], p[1], p[2])
        # The second moments of mass are half the trace of I, less I.
        xx, xy, xz = get3(work, inertia + 4 * LANES)
        yy, yz, zz = get3(work, inertia + 7 * LANES)
        trace = half * (xx + yy + zz)
        x = plus(times(v, h[0]), cross(w, (trace - xx, zero - xy, zero - xz)))
        y = plus(times(v, h[1]), cross(w, (zero - xy, trace - yy, zero - yz)))
        z = plus(times(v, h[2]), cross(w, (zero - xz, zero - yz, trace - zz)))
        put3(work, at + MOMENTS, x[0], x[1], x[2])
        put3(work, at + MOMENTS + 3 * LANES, y[0], y[1], y[2])
        put3(work, at + MOMENTS + 6 * LANES, z[0], z[1], z[2])
        moment, force = weighed(
            work, inertia, get3(work, moving + BIAS), get3(work, moving + BIAS + 3 * LANES)
        )
        moment = plus(moment, plus(cross(w, turning), cross(v, p)))
        write6(work, at + FORCE, moment, plus(force, cross(w, p)))


@numba.njit(forceinline=True)
def _load_stored(work, tree, layout, loads):
    """Add the momentum that bodies store, and the moments that turn it along."""
    for index in range(len(loads.stored_body)):
        body = loads.stored_body[index]
        at = layout.load + body * LOAD * LANES
        vector = loads.stored[index]
        place = tree.places + body * PLACE * LANES
        h = turned(work, place, vector[0], vector[1], vector[2])
        add3(work, at + STORED, h[0], h[1], h[2])
        moment = cross(get3(work, layout.motion + body * MOTION * LANES), h)
        add3(work, at + FORCE, moment[0], moment[1], moment[2])


@numba.njit(forceinline=True)
def _load_carried(work, tree, layout, loads, u, first):
    """Add the forces of the carried inputs, and write their generalised force for a unit."""
    zero = splat(0.0)
    for entry in range(len(tree.row) * len(loads.body)):
        store(work, layout.columns + entry * LANES, zero)
    stride = u.shape[1]
    flat = u.reshape(-1)
    for index in range(len(loads.body)):
        body, vector = loads.body[index], loads.wrench[index]
        place = tree.places + body * PLACE * LANES
        moment = turned(work, place, vector[0], vector[1], vector[2])
        force = turned(work, place, vector[3], vector[4], vector[5])
        pushed = zero - gather(flat, first * stride + loads.input[index], stride)
        at = layout.load + body * LOAD * LANES + FORCE
        add3(work, at, *times(moment, pushed))
        add3(work, at + 3 * LANES, *times(force, pushed))
        while body > 0:
            axis = joint_axis(work, tree, body)
            entry = tree.coordinate[body] * len(loads.body) + index
            value = dot(axis[0], moment) + dot(axis[1], force)
            add(work, layout.columns + entry * LANES, value)
            place = tree.places + body * PLACE * LANES
            moment = plus(moment, cross(get3(work, place + 9 * LANES), force))
            body = tree.parent[body]
        for axis in range(3):
            entry = axis * len(loads.body) + index
            store(work, layout.columns + entry * LANES, moment[axis])
            entry += 3 * len(loads.body)
            store(work, layout.columns + entry * LANES, force[axis])


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
        d = get3(work, tree.places + (body * PLACE + 9) * LANES)
        moment, force = get3(work, at + FORCE), get3(work, at + FORCE + 3 * LANES)
        axis = joint_axis(work, tree, body)
        value = dot(axis[0], moment) + dot(axis[1], force)
        add(work, layout.bias + tree.coordinate[body] * LANES, value)
        p, h = get3(work, at + MOMENTUM), get3(work, at + STORED)
        add3(work, above + MOMENTUM, p[0], p[1], p[2])
        add3(work, above + STORED, h[0], h[1], h[2])
        columns = first_moments(work, at + MOMENTS)
        for index in range(3):
            column = plus(columns[index], times(p, d[index]))
            add3(work, above + MOMENTS + 3 * index * LANES, column[0], column[1], column[2])
        moment = plus(moment, cross(d, force))
        add3(work, above + FORCE, moment[0], moment[1], moment[2])
        add3(work, above + FORCE + 3 * LANES, force[0], force[1], force[2])
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
        alpha, a = step_motion(work, above + ADDED, place)
        bias = step_motion(work, above + BIAS, place)
        w, v = step_motion(work, above + VELOCITY, place)
        psi = get3(work, at + PSI), get3(work, at + PSI + 3 * LANES)
        first = crossed(plus(alpha, bias[0]), plus(a, bias[1]), axis)
        second = crossed(w, v, psi)
        write6(work, at + PSI2, plus(first[0], second[0]), plus(first[1], second[1]))
        write6(work, at + ADDED, plus(alpha, times(axis[0], rate)), plus(a, times(axis[1], rate)))
    for body in range(len(tree.parent) - 1, 0, -1):
        at = layout.load + body * LOAD * LANES
        inertia = tree.inertias + body * INERTIA * LANES
        place = tree.places + body * PLACE * LANES
        above = layout.motion + tree.parent[body] * MOTION * LANES
        axis = joint_axis(work, tree, body)
        rate = load(work, layout.c + tree.coordinate[body] * LANES)
        own = weighed(work, inertia, times(axis[0], rate), times(axis[1], rate))
        moment = plus(get3(work, at + CARRIED), own[0])
        force = plus(get3(work, at + CARRIED + 3 * LANES), own[1])
        alpha, a = step_motion(work, above + ADDED, place)
        shared = weighed(work, inertia, alpha, a)
        whole = plus(moment, shared[0]), plus(force, shared[1])
        add3(work, at + FORCE, whole[0][0], whole[0][1], whole[0][2])
        add3(work, at + FORCE + 3 * LANES, whole[1][0], whole[1][1], whole[1][2])
        if tree.parent[body] > 0:
            to = layout.load + tree.parent[body] * LOAD * LANES + CARRIED
            moment = plus(moment, cross(get3(work, place + 9 * LANES), force))
            add3(work, to, moment[0], moment[1], moment[2])
            add3(work, to + 3 * LANES, force[0], force[1], force[2])
