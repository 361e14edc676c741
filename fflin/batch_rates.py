r"""M^-1 and the accelerations with their slopes, of eight points at once.

RNEA is differentiated in closed form: with the spatial axis S of a joint, the velocity v and
acceleration a of what carries it, and Psi' = v x S, Psi'' = a x S + v x Psi', the slopes of the
joint forces tau over the positions q and velocities q' are, for a joint j inwards of i,

.. math::
    \partial\tau_j/\partial q_i &= S_j^T (2 B_i \Psi'_i + I_i \Psi''_i + S_i \times^* f_i) \\
    \partial\tau_j/\partial q'_i &= S_j^T (2 B_i S_i + 2 I_i \Psi'_i) \\
    \partial\tau_i/\partial q_j &= (2 B_i^T S_i)^T \Psi'_j + (I_i S_i)^T \Psi''_j \\
    \partial\tau_i/\partial q'_j &= (2 B_i^T S_i)^T S_j + 2 (I_i S_i)^T \Psi'_j

where I, B and f are inertia, Coriolis matrix and force of all that joint i carries. 2 B takes a
turn w to the force 2 w x p and the moment 2 (tr G - G) w + w x h, with the momentum p, the first
moments of momentum G = sum m v r^T about the joint, and stored momentum h.

All vectors stand in base axes and all moments are about the joints, as in `batch_crba`.

References
----------
S. Singh, R. P. Russell and P. M. Wensing, Efficient analytical derivatives of rigid-body dynamics
using spatial vector algebra, IEEE Robotics and Automation Letters 7(2), 2022.
"""

from __future__ import annotations

import numba

from fflin.batch_crba import inwards, outwards
from fflin.batch_kernel import factorise, multiply, unpack
from fflin.batch_tree import INERTIA, LANES, PLACE
from fflin.lane_vectors import add, add3, cross, dot, get3, minus, plus, put3, times, turned
from fflin.lanes import gather, load, splat, store

# Of every body, in this order: velocity and Psi' (angular, linear); acceleration that forces and
# motion cause without c, that of c alone; Psi''.
_VELOCITY, _PSI, _BIAS, _ADDED, _PSI2 = 0, 6 * LANES, 12 * LANES, 18 * LANES, 24 * LANES
MOTION = 30
# Of all that its joint carries: momentum p, columns of G, stored momentum h, moment and force
# without c, and those of c on what is carried.
_P, _G, _H, _FORCE, _CARRIED = 0, 3 * LANES, 12 * LANES, 15 * LANES, 21 * LANES
LOAD = 27


@numba.njit(forceinline=True)
def _axis(work, tree, body):
    """Return the spatial axis of a joint, angular and linear, for a unit of its coordinate."""
    z = get3(work, tree.places + (body * PLACE + 6) * LANES)
    share = tree.factor[body]
    return times(z, splat(share * tree.turns[body])), times(z, splat(share * tree.slides[body]))


@numba.njit(forceinline=True)
def _crossed(angular, linear, along):
    """Return the rate of a motion vector `along` that is carried by a velocity."""
    return (
        cross(angular, along[0]),
        plus(cross(angular, along[1]), cross(linear, along[0])),
    )


@numba.njit(forceinline=True)
def _weighed(work, at, angular, linear):
    """Return inertia times a motion vector, moment and force."""
    m, h = load(work, at), get3(work, at + LANES)
    xx, xy, xz = get3(work, at + 4 * LANES)
    yy, yz, zz = get3(work, at + 7 * LANES)
    x, y, z = angular
    turning = xx * x + xy * y + xz * z, xy * x + yy * y + yz * z, xz * x + yz * y + zz * z
    return plus(turning, cross(h, linear)), plus(times(linear, m), cross(angular, h))


@numba.njit(forceinline=True)
def _first_moments(work, at):
    """Return the columns of G."""
    return get3(work, at), get3(work, at + 3 * LANES), get3(work, at + 6 * LANES)


@numba.njit(forceinline=True)
def _coriolis(work, at, w):
    """Return 2 B w, moment and force, of what a joint carries."""
    x, y, z = _first_moments(work, at + _G)
    trace = x[0] + y[1] + z[2]
    carried = plus(plus(times(x, w[0]), times(y, w[1])), times(z, w[2]))
    moment = minus(times(w, trace), carried)
    moment = plus(plus(moment, moment), cross(w, get3(work, at + _H)))
    force = cross(w, get3(work, at + _P))
    return moment, plus(force, force)


@numba.njit(forceinline=True)
def _coriolis_transposed(work, at, along):
    """Return 2 B^T s of a motion vector s, which is a moment."""
    x, y, z = _first_moments(work, at + _G)
    trace = x[0] + y[1] + z[2]
    w = along[0]
    carried = dot(x, w), dot(y, w), dot(z, w)
    moment = plus(minus(times(w, trace), carried), cross(get3(work, at + _P), along[1]))
    return plus(plus(moment, moment), cross(get3(work, at + _H), w))


@numba.njit(forceinline=True)
def _step(work, at, place):
    """Return a motion vector of the carrier at a joint's own origin, angular and linear."""
    w = get3(work, at)
    return w, plus(get3(work, at + 3 * LANES), cross(w, get3(work, place + 9 * LANES)))


@numba.njit(forceinline=True)
def _write(work, at, angular, linear):
    put3(work, at, angular[0], angular[1], angular[2])
    put3(work, at + 3 * LANES, linear[0], linear[1], linear[2])


@numba.njit(forceinline=True)
def _move(work, tree, layout, nu, first):
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
        axis = _axis(work, tree, body)
        w, v = _step(work, above + _VELOCITY, place)
        psi = _crossed(w, v, axis)
        alpha, a = _step(work, above + _BIAS, place)
        _write(work, at + _VELOCITY, plus(w, times(axis[0], rate)), plus(v, times(axis[1], rate)))
        _write(work, at + _PSI, *psi)
        _write(work, at + _BIAS, plus(alpha, times(psi[0], rate)), plus(a, times(psi[1], rate)))
        _write(work, at + _ADDED, none, none)


@numba.njit(forceinline=True)
def _load(work, tree, layout, loads, u, first):
    """Write momenta and forces of the bodies alone, and what a unit of each carried input is."""
    zero = splat(0.0)
    half = splat(0.5)
    for body in range(len(tree.parent)):
        at = layout.load + body * LOAD * LANES
        moving = layout.motion + body * MOTION * LANES
        inertia = tree.inertias + body * INERTIA * LANES
        w, v = get3(work, moving), get3(work, moving + 3 * LANES)
        h = get3(work, inertia + LANES)
        turning, p = _weighed(work, inertia, w, v)
        for entry in range(LOAD):
            store(work, at + entry * LANES, zero)
        put3(work, at + _P, p[0], p[1], p[2])
        # The second moments of mass are half the trace of I, less I.
        xx, xy, xz = get3(work, inertia + 4 * LANES)
        yy, yz, zz = get3(work, inertia + 7 * LANES)
        trace = half * (xx + yy + zz)
        x = plus(times(v, h[0]), cross(w, (trace - xx, zero - xy, zero - xz)))
        y = plus(times(v, h[1]), cross(w, (zero - xy, trace - yy, zero - yz)))
        z = plus(times(v, h[2]), cross(w, (zero - xz, zero - yz, trace - zz)))
        put3(work, at + _G, x[0], x[1], x[2])
        put3(work, at + _G + 3 * LANES, y[0], y[1], y[2])
        put3(work, at + _G + 6 * LANES, z[0], z[1], z[2])
        moment, force = _weighed(
            work, inertia, get3(work, moving + _BIAS), get3(work, moving + _BIAS + 3 * LANES)
        )
        moment = plus(moment, plus(cross(w, turning), cross(v, p)))
        _write(work, at + _FORCE, moment, plus(force, cross(w, p)))
    for index in range(len(loads.stored_body)):
        body = loads.stored_body[index]
        at = layout.load + body * LOAD * LANES
        vector = loads.stored[index]
        place = tree.places + body * PLACE * LANES
        h = turned(work, place, vector[0], vector[1], vector[2])
        add3(work, at + _H, h[0], h[1], h[2])
        moment = cross(get3(work, layout.motion + body * MOTION * LANES), h)
        add3(work, at + _FORCE, moment[0], moment[1], moment[2])
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
        at = layout.load + body * LOAD * LANES + _FORCE
        add3(work, at, *times(moment, pushed))
        add3(work, at + 3 * LANES, *times(force, pushed))
        while body > 0:
            axis = _axis(work, tree, body)
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
def _gather_loads(work, tree, layout):
    """Add the momenta and forces of what is carried, inwards, and write the bias forces."""
    for index in range(len(tree.row)):
        store(work, layout.bias + index * LANES, splat(0.0))
    for body in range(len(tree.parent) - 1, 0, -1):
        at = layout.load + body * LOAD * LANES
        above = layout.load + tree.parent[body] * LOAD * LANES
        d = get3(work, tree.places + (body * PLACE + 9) * LANES)
        moment, force = get3(work, at + _FORCE), get3(work, at + _FORCE + 3 * LANES)
        axis = _axis(work, tree, body)
        value = dot(axis[0], moment) + dot(axis[1], force)
        add(work, layout.bias + tree.coordinate[body] * LANES, value)
        p, h = get3(work, at + _P), get3(work, at + _H)
        add3(work, above + _P, p[0], p[1], p[2])
        add3(work, above + _H, h[0], h[1], h[2])
        columns = _first_moments(work, at + _G)
        for index in range(3):
            column = plus(columns[index], times(p, d[index]))
            add3(work, above + _G + 3 * index * LANES, column[0], column[1], column[2])
        moment = plus(moment, cross(d, force))
        add3(work, above + _FORCE, moment[0], moment[1], moment[2])
        add3(work, above + _FORCE + 3 * LANES, force[0], force[1], force[2])
    at = layout.load + _FORCE
    for index in range(6):
        add(work, layout.bias + index * LANES, load(work, at + index * LANES))


@numba.njit(forceinline=True)
def _accelerate(work, tree, layout, forces, first):
    """Write c = M^-1 (forces - bias)."""
    size = len(tree.row)
    flat, start = forces.reshape(-1), first * size
    for index in range(size):
        at = layout.bias + index * LANES
        store(work, at, gather(flat, start + index, size) - load(work, at))
    for row in range(size):
        total = load(work, tree.square + row * size * LANES) * load(work, layout.bias)
        for index in range(1, size):
            entry = load(work, tree.square + (row * size + index) * LANES)
            total = total + entry * load(work, layout.bias + index * LANES)
        store(work, layout.c + row * LANES, total)


@numba.njit(forceinline=True)
def _move_on(work, tree, layout):
    """Complete the accelerations with c: write Psi'' outwards, and the forces of c inwards."""
    for index in range(6):
        value = load(work, layout.c + index * LANES)
        store(work, layout.motion + _ADDED + index * LANES, value)
    for body in range(1, len(tree.parent)):
        at = layout.motion + body * MOTION * LANES
        above = layout.motion + tree.parent[body] * MOTION * LANES
        place = tree.places + body * PLACE * LANES
        rate = load(work, layout.c + tree.coordinate[body] * LANES)
        axis = _axis(work, tree, body)
        alpha, a = _step(work, above + _ADDED, place)
        bias = _step(work, above + _BIAS, place)
        w, v = _step(work, above + _VELOCITY, place)
        psi = get3(work, at + _PSI), get3(work, at + _PSI + 3 * LANES)
        first = _crossed(plus(alpha, bias[0]), plus(a, bias[1]), axis)
        second = _crossed(w, v, psi)
        _write(work, at + _PSI2, plus(first[0], second[0]), plus(first[1], second[1]))
        _write(work, at + _ADDED, plus(alpha, times(axis[0], rate)), plus(a, times(axis[1], rate)))
    for body in range(len(tree.parent) - 1, 0, -1):
        at = layout.load + body * LOAD * LANES
        inertia = tree.inertias + body * INERTIA * LANES
        place = tree.places + body * PLACE * LANES
        above = layout.motion + tree.parent[body] * MOTION * LANES
        axis = _axis(work, tree, body)
        rate = load(work, layout.c + tree.coordinate[body] * LANES)
        own = _weighed(work, inertia, times(axis[0], rate), times(axis[1], rate))
        moment = plus(get3(work, at + _CARRIED), own[0])
        force = plus(get3(work, at + _CARRIED + 3 * LANES), own[1])
        alpha, a = _step(work, above + _ADDED, place)
        shared = _weighed(work, inertia, alpha, a)
        whole = plus(moment, shared[0]), plus(force, shared[1])
        add3(work, at + _FORCE, whole[0][0], whole[0][1], whole[0][2])
        add3(work, at + _FORCE + 3 * LANES, whole[1][0], whole[1][1], whole[1][2])
        if tree.parent[body] > 0:
            to = layout.load + tree.parent[body] * LOAD * LANES + _CARRIED
            moment = plus(moment, cross(get3(work, place + 9 * LANES), force))
            add3(work, to, moment[0], moment[1], moment[2])
            add3(work, to + 3 * LANES, force[0], force[1], force[2])


@numba.njit(forceinline=True)
def _slopes(work, tree, layout, loads):
    """Write the slopes of what M c + bias less the forces is, over q_m, omega_b and q'_m."""
    size = len(tree.row)
    n = size - 6
    width = 3 + 2 * n
    zero = splat(0.0)
    for entry in range(size * width):
        store(work, layout.slopes + entry * LANES, zero)
    for index in range(n):
        row = layout.slopes + (6 + index) * width * LANES
        store(work, row + index * LANES, splat(loads.stiffness[index]))
        store(work, row + (n + 3 + index) * LANES, splat(loads.damping[index]))
    spin = get3(work, layout.motion)
    for body in range(len(tree.parent) - 1, 0, -1):
        at = layout.load + body * LOAD * LANES
        moving = layout.motion + body * MOTION * LANES
        inertia = tree.inertias + body * INERTIA * LANES
        column = tree.coordinate[body]
        axis = _axis(work, tree, body)
        psi = get3(work, moving + _PSI), get3(work, moving + _PSI + 3 * LANES)
        psi2 = get3(work, moving + _PSI2), get3(work, moving + _PSI2 + 3 * LANES)
        u, uf = _weighed(work, inertia, axis[0], axis[1])
        w = _coriolis_transposed(work, at, axis)
        moment, force = get3(work, at + _FORCE), get3(work, at + _FORCE + 3 * LANES)
        turning, pushing = _coriolis(work, at, psi[0])
        weight, heft = _weighed(work, inertia, psi2[0], psi2[1])
        p = plus(plus(turning, weight), plus(cross(axis[0], moment), cross(axis[1], force)))
        pf = plus(plus(pushing, heft), cross(axis[0], force))
        turning, pushing = _coriolis(work, at, axis[0])
        weight, heft = _weighed(work, inertia, psi[0], psi[1])
        v = plus(turning, plus(weight, weight))
        vf = plus(pushing, plus(heft, heft))
        own = layout.slopes + column * width * LANES
        by_q, by_v = (column - 6) * LANES, (column - 3 + n) * LANES
        above = body
        while above > 0:
            other = tree.coordinate[above]
            axis = _axis(work, tree, above)
            row = layout.slopes + other * width * LANES
            add(work, row + by_q, dot(axis[0], p) + dot(axis[1], pf))
            add(work, row + by_v, dot(axis[0], v) + dot(axis[1], vf))
            if above != body:
                moving = layout.motion + above * MOTION * LANES
                psi = get3(work, moving + _PSI), get3(work, moving + _PSI + 3 * LANES)
                psi2 = get3(work, moving + _PSI2), get3(work, moving + _PSI2 + 3 * LANES)
                value = dot(w, psi[0]) + (dot(u, psi2[0]) + dot(uf, psi2[1]))
                add(work, own + (other - 6) * LANES, value)
                value = dot(u, psi[0]) + dot(uf, psi[1])
                value = dot(w, axis[0]) + (value + value)
                add(work, own + (other - 3 + n) * LANES, value)
            d = get3(work, tree.places + (above * PLACE + 9) * LANES)
            u, p, v = plus(u, cross(d, uf)), plus(p, cross(d, pf)), plus(v, cross(d, vf))
            above = tree.parent[above]
        turning = plus(w, cross(u, spin))
        add3(work, own + n * LANES, turning[0], turning[1], turning[2])
        for index in range(3):
            row = layout.slopes + index * width * LANES
            add(work, row + by_q, p[index])
            add(work, row + by_v, v[index])
            row += 3 * width * LANES
            add(work, row + by_q, pf[index])
            add(work, row + by_v, vf[index])
    one = splat(1.0)
    for index in range(3):
        if index == 0:
            e = one, zero, zero
        elif index == 1:
            e = zero, one, zero
        else:
            e = zero, zero, one
        turning, pushing = _coriolis(work, layout.load, e)
        weight, heft = _weighed(work, tree.inertias, cross(spin, e), (zero, zero, zero))
        for axis in range(3):
            row = layout.slopes + (axis * width + n + index) * LANES
            store(work, row, turning[axis] + weight[axis])
            store(work, row + 3 * width * LANES, pushing[axis] + heft[axis])


@numba.njit(forceinline=True)
def _solve(work, tree, layout):
    """Write the lower half of A, (6 + n, 12 + 2 n): -M^-1 slopes, and zeros between."""
    size = len(tree.row)
    n = size - 6
    width = 3 + 2 * n
    zero = splat(0.0)
    for row in range(size):
        out = layout.lower + row * 2 * size * LANES
        for index in range(2 * size):
            store(work, out + index * LANES, zero)
        for index in range(width):
            total = zero
            for k in range(size):
                entry = load(work, tree.square + (row * size + k) * LANES)
                total = total - entry * load(work, layout.slopes + (k * width + index) * LANES)
            # After q_b and r_b; beyond omega_b after v_b too.
            place = 6 + index if index < n + 3 else 9 + index
            store(work, out + place * LANES, total)


@numba.njit(nogil=True, cache=True, boundscheck=False)
def linearise(tree, layout, loads, points, out, work):
    """Write M^-1, c, the lower half of A, and the columns of the carried inputs, of each point.

    Parameters
    ----------
    tree : Tree
    layout : Layout
    loads : Loads
    points : tuple of ndarray
        q (count, nq), nu (count, 6 + n), forces (count, 6 + n), u (count, nu); the forces are
        those of the inputs that are not carried, and of springs and dampers. As many as there are
        lanes at least.
    out : tuple of ndarray
        M^-1 (count, size * size), c (count, size), lower half of A (count, stride) of which the
        last size * 2 size entries, columns (count, size * carried), and couplings (count,), the
        sums of M_ii (M^-1)_ii.
    work : ndarray
    """
    q, nu, forces, u = points
    inverse, c, A, columns, couplings = out
    count, stride = q.shape
    flat = q.reshape(-1)
    size = len(tree.row)
    lower = 2 * size * size
    for block in range(0, count, LANES):
        # The last are the last there are, some of them for the second time.
        first = min(block, count - LANES)
        outwards(work, tree, flat, first * stride, stride)
        _move(work, tree, layout, nu, first)
        _load(work, tree, layout, loads, u, first)
        inwards(work, tree)
        _gather_loads(work, tree, layout)
        factorise(work, tree)
        multiply(work, tree, couplings, first)
        _accelerate(work, tree, layout, forces, first)
        _move_on(work, tree, layout)
        _slopes(work, tree, layout, loads)
        _solve(work, tree, layout)
        unpack(work, tree.square, size * size, inverse, first, 0)
        unpack(work, layout.c, size, c, first, 0)
        unpack(work, layout.lower, lower, A, first, A.shape[1] - lower)
        unpack(work, layout.columns, columns.shape[1], columns, first, 0)
