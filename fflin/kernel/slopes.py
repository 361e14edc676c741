r"""The slopes of all joint forces at eight points at once: RNEA differentiated.

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

References
----------
S. Singh, R. P. Russell and P. M. Wensing, Efficient analytical derivatives of rigid-body dynamics
using spatial vector algebra, IEEE Robotics and Automation Letters 7(2), 2022.
"""

from __future__ import annotations

import numba

from fflin.kernel.lanes import splat, store
from fflin.kernel.rnea import (
    FORCE,
    LOAD,
    MOMENTS,
    MOMENTUM,
    MOTION,
    PSI,
    PSI2,
    STORED,
    first_moments,
    joint_axis,
    weighed,
)
from fflin.kernel.tree import INERTIA, LANES, PLACE
from fflin.kernel.vectors import add, add3, cross, dot, get3, minus, plus, times


@numba.njit(forceinline=True)
def _coriolis(work, at, w):
    """Return 2 B w, moment and force, of what a joint carries."""
    x, y, z = first_moments(work, at + MOMENTS)
    trace = x[0] + y[1] + z[2]
    carried = plus(plus(times(x, w[0]), times(y, w[1])), times(z, w[2]))
    moment = minus(times(w, trace), carried)
    moment = plus(plus(moment, moment), cross(w, get3(work, at + STORED)))
    force = cross(w, get3(work, at + MOMENTUM))
    return moment, plus(force, force)


@numba.njit(forceinline=True)
def _coriolis_transposed(work, at, along):
    """Return 2 B^T s of a motion vector s, which is a moment."""
    x, y, z = first_moments(work, at + MOMENTS)
    trace = x[0] + y[1] + z[2]
    w = along[0]
    carried = dot(x, w), dot(y, w), dot(z, w)
    moment = plus(minus(times(w, trace), carried), cross(get3(work, at + MOMENTUM), along[1]))
    return plus(plus(moment, moment), cross(get3(work, at + STORED), w))


@numba.njit(forceinline=True)
def _passive_slopes(work, tree, layout, loads):
    """Write those of springs and dampers, and zeros."""
    size = len(tree.row)
    n, width = size - 6, 2 * size
    zero = splat(0.0)
    for entry in range(size * width):
        store(work, layout.lower + entry * LANES, zero)
    for index in range(n):
        row = layout.lower + (6 + index) * width * LANES
        store(work, row + (6 + index) * LANES, splat(loads.stiffness[index]))
        store(work, row + (12 + n + index) * LANES, splat(loads.damping[index]))


@numba.njit(forceinline=True)
def _add_column(work, at, width, moment, force):
    """Add to the rows of the base in a column."""
    for index in range(3):
        add(work, at + index * width * LANES, moment[index])
        add(work, at + (3 + index) * width * LANES, force[index])


@numba.njit(forceinline=True)
def _joint_slopes(work, tree, layout):
    """Add those over each joint, and those of each joint's force over omega_b."""
    n, width = len(tree.row) - 6, 2 * len(tree.row)
    spin = get3(work, layout.motion)
    for body in range(len(tree.parent) - 1, 0, -1):
        at = layout.load + body * LOAD * LANES
        moving = layout.motion + body * MOTION * LANES
        inertia = tree.inertias + body * INERTIA * LANES
        column = tree.coordinate[body]
        axis = joint_axis(work, tree, body)
        psi = get3(work, moving + PSI), get3(work, moving + PSI + 3 * LANES)
        psi2 = get3(work, moving + PSI2), get3(work, moving + PSI2 + 3 * LANES)
        u, uf = weighed(work, inertia, axis[0], axis[1])
        w = _coriolis_transposed(work, at, axis)
        moment, force = get3(work, at + FORCE), get3(work, at + FORCE + 3 * LANES)
        turning, pushing = _coriolis(work, at, psi[0])
        weight, heft = weighed(work, inertia, psi2[0], psi2[1])
        p = plus(plus(turning, weight), plus(cross(axis[0], moment), cross(axis[1], force)))
        pf = plus(plus(pushing, heft), cross(axis[0], force))
        turning, pushing = _coriolis(work, at, axis[0])
        weight, heft = weighed(work, inertia, psi[0], psi[1])
        v = plus(turning, plus(weight, weight))
        vf = plus(pushing, plus(heft, heft))
        own = layout.lower + column * width * LANES
        by_q, by_v = column * LANES, (column + 6 + n) * LANES
        above = body
        while above > 0:
            other = tree.coordinate[above]
            axis = joint_axis(work, tree, above)
            row = layout.lower + other * width * LANES
            add(work, row + by_q, dot(axis[0], p) + dot(axis[1], pf))
            add(work, row + by_v, dot(axis[0], v) + dot(axis[1], vf))
            if above != body:
                moving = layout.motion + above * MOTION * LANES
                psi = get3(work, moving + PSI), get3(work, moving + PSI + 3 * LANES)
                psi2 = get3(work, moving + PSI2), get3(work, moving + PSI2 + 3 * LANES)
                value = dot(w, psi[0]) + (dot(u, psi2[0]) + dot(uf, psi2[1]))
                add(work, own + other * LANES, value)
                value = dot(u, psi[0]) + dot(uf, psi[1])
                value = dot(w, axis[0]) + (value + value)
                add(work, own + (other + 6 + n) * LANES, value)
            d = get3(work, tree.places + (above * PLACE + 9) * LANES)
            u, p, v = plus(u, cross(d, uf)), plus(p, cross(d, pf)), plus(v, cross(d, vf))
            above = tree.parent[above]
        turning = plus(w, cross(u, spin))
        add3(work, own + (6 + n) * LANES, turning[0], turning[1], turning[2])
        _add_column(work, layout.lower + by_q, width, p, pf)
        _add_column(work, layout.lower + by_v, width, v, vf)


@numba.njit(forceinline=True)
def _base_slopes(work, tree, layout):
    """Write those of the base's force over omega_b."""
    n, width = len(tree.row) - 6, 2 * len(tree.row)
    zero = splat(0.0)
    spin = get3(work, layout.motion)
    one = splat(1.0)
    for index in range(3):
        if index == 0:
            e = one, zero, zero
        elif index == 1:
            e = zero, one, zero
        else:
            e = zero, zero, one
        turning, pushing = _coriolis(work, layout.load, e)
        weight, heft = weighed(work, tree.inertias, cross(spin, e), (zero, zero, zero))
        for axis in range(3):
            row = layout.lower + (axis * width + 6 + n + index) * LANES
            store(work, row, turning[axis] + weight[axis])
            store(work, row + 3 * width * LANES, pushing[axis] + heft[axis])


@numba.njit(forceinline=True)
def differentiate(work, tree, layout, loads):
    """Write the slopes of M c + bias less the forces over the state, rows of 12 + 2 n.

    Those over q_b, r_b and v_b are zero.
    """
    _passive_slopes(work, tree, layout, loads)
    _joint_slopes(work, tree, layout)
    _base_slopes(work, tree, layout)
