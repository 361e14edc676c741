r"""M^-1, accelerations and their derivatives at many points, with eight points per instruction.

RNEA is differentiated in closed form. Let S be the spatial axis of a joint, v and a the velocity
and acceleration of its parent, Psi' = v x S and Psi'' = a x S + v x Psi'. If joint j is on the path
from the base to joint i, the derivatives of the joint forces tau with respect to the positions q
and velocities q' are

.. math::
    \partial\tau_j/\partial q_i &= S_j^T (2 B_i \Psi'_i + I_i \Psi''_i + S_i \times^* f_i) \\
    \partial\tau_j/\partial q'_i &= S_j^T (2 B_i S_i + 2 I_i \Psi'_i) \\
    \partial\tau_i/\partial q_j &= (2 B_i^T S_i)^T \Psi'_j + (I_i S_i)^T \Psi''_j \\
    \partial\tau_i/\partial q'_j &= (2 B_i^T S_i)^T S_j + 2 (I_i S_i)^T \Psi'_j

where I, B and f are inertia, Coriolis matrix and force of the subtree of joint i. For an angular
velocity w, 2 B w is the force 2 w x p and the moment 2 (tr G - G) w + w x h. Here p is the momentum
of the subtree, G = sum m v r^T its first moments of momentum about the joint, and h its stored
momentum.

References
----------
S. Singh, R. P. Russell and P. M. Wensing, Efficient analytical derivatives of rigid-body dynamics
using spatial vector algebra, IEEE Robotics and Automation Letters 7(2), 2022.
"""

from __future__ import annotations

from collections import namedtuple
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from fflin.base.validation import Array
from fflin.dynamics.actuation import Actuation
from fflin.dynamics.rnea import (
    Inertia,
)
from fflin.dynamics.state import StateMap
from fflin.kernel import inertia, rnea
from fflin.kernel import vectors as vec
from fflin.kernel.compiled import kernel
from fflin.kernel.inertia import inwards, outwards, spatial_inertia_times
from fflin.kernel.lanes import compiled, inlined, load, splat, store
from fflin.kernel.rnea import (
    FORCE,
    LOAD,
    MOMENTS,
    MOMENTUM,
    MOTION,
    PSI,
    PSI2,
    STORED,
    at_parent,
    joint_axis,
)
from fflin.kernel.tree import INERTIA, LANES, PLACE, Tree, layout_of, loads_of, work_space


@inlined
def _coriolis(work, at, w):
    """Return the moment and force 2 B w of a joint's subtree."""
    G = vec.get_columns(work, at + MOMENTS)
    trace = G[0][0] + G[1][1] + G[2][2]
    moment = vec.minus(vec.times(w, trace), vec.product(G, w))
    moment = vec.plus(vec.plus(moment, moment), vec.cross(w, vec.get3(work, at + STORED)))
    force = vec.cross(w, vec.get3(work, at + MOMENTUM))
    return moment, vec.plus(force, force)


@inlined
def _coriolis_transposed(work, at, along):
    """Return the moment of 2 B^T s for a motion vector s; the force of 2 B^T s is zero."""
    G = vec.get_columns(work, at + MOMENTS)
    trace = G[0][0] + G[1][1] + G[2][2]
    w = along[0]
    carried = vec.dot(G[0], w), vec.dot(G[1], w), vec.dot(G[2], w)
    moment = vec.plus(
        vec.minus(vec.times(w, trace), carried), vec.cross(vec.get3(work, at + MOMENTUM), along[1])
    )
    return vec.plus(vec.plus(moment, moment), vec.cross(vec.get3(work, at + STORED), w))


@inlined
def _passive_derivatives(work, tree, layout, loads):
    """Write the derivatives of the spring and damper forces, and zeros in all other entries."""
    size = len(tree.row)
    n, width = size - 6, 2 * size
    for entry in range(size * width):
        store(work, layout.lower + entry, 0.0)
    for index in range(n):
        row = layout.lower + (6 + index) * width
        store(work, row + (6 + index), load(loads.stiffness, index))
        store(work, row + (12 + n + index), load(loads.damping, index))


@inlined
def _add_column(work, at, width, force):
    """Add a moment and a force to the first six rows of a column, the rows of the base."""
    for index in range(3):
        vec.add(work, at + index * width, force[0][index])
        vec.add(work, at + (3 + index) * width, force[1][index])


@inlined
def _joint_derivatives(work, tree, layout):
    """Add the derivatives of all forces over each joint, and of each joint's force over omega_b."""
    n, width = len(tree.row) - 6, 2 * len(tree.row)
    spin = vec.get3(work, layout.motion)
    for body in range(len(tree.parent) - 1, 0, -1):
        at = layout.load + body * LOAD
        moving = layout.motion + body * MOTION
        inertia = tree.inertias + body * INERTIA
        column = tree.coordinate[body]
        axis = joint_axis(work, tree, body)
        psi, psi2 = vec.get6(work, moving + PSI), vec.get6(work, moving + PSI2)
        momentum = spatial_inertia_times(work, inertia, axis)
        coriolis = _coriolis_transposed(work, at, axis)
        moment, force = vec.get6(work, at + FORCE)
        by_q = vec.plus6(_coriolis(work, at, psi[0]), spatial_inertia_times(work, inertia, psi2))
        turned = (
            vec.plus(vec.cross(axis[0], moment), vec.cross(axis[1], force)),
            vec.cross(axis[0], force),
        )
        by_q = vec.plus6(by_q, turned)
        weight = spatial_inertia_times(work, inertia, psi)
        by_v = vec.plus6(_coriolis(work, at, axis[0]), vec.plus6(weight, weight))
        own = layout.lower + column * width
        q, v = column, (column + 6 + n)
        above = body
        while above > 0:
            place = tree.places + above * PLACE
            other = tree.coordinate[above]
            axis = joint_axis(work, tree, above)
            row = layout.lower + other * width
            vec.add(work, row + q, vec.dot6(axis, by_q))
            vec.add(work, row + v, vec.dot6(axis, by_v))
            if above != body:
                moving = layout.motion + above * MOTION
                psi, psi2 = vec.get6(work, moving + PSI), vec.get6(work, moving + PSI2)
                value = vec.dot(coriolis, psi[0]) + vec.dot6(momentum, psi2)
                vec.add(work, own + other, value)
                value = vec.dot6(momentum, psi)
                value = vec.dot(coriolis, axis[0]) + (value + value)
                vec.add(work, own + (other + 6 + n), value)
            momentum = at_parent(work, place, momentum)
            by_q, by_v = at_parent(work, place, by_q), at_parent(work, place, by_v)
            above = tree.parent[above]
        vec.add3(work, own + (6 + n), vec.plus(coriolis, vec.cross(momentum[0], spin)))
        _add_column(work, layout.lower + q, width, by_q)
        _add_column(work, layout.lower + v, width, by_v)


@inlined
def _base_derivatives(work, tree, layout):
    """Write the derivatives of the base's force over omega_b."""
    n, width = len(tree.row) - 6, 2 * len(tree.row)
    zero, one = 0.0, 1.0
    spin = vec.get3(work, layout.motion)
    axes = (one, zero, zero), (zero, one, zero), (zero, zero, one)
    for index in range(3):
        e = axes[index]
        weight = spatial_inertia_times(
            work, tree.inertias, (vec.cross(spin, e), (zero, zero, zero))
        )
        moment, force = vec.plus6(_coriolis(work, layout.load, e), weight)
        for axis in range(3):
            row = layout.lower + (axis * width + 6 + n + index)
            store(work, row, moment[axis])
            store(work, row + 3 * width, force[axis])


@inlined
def differentiate(work, tree, layout, loads):
    """Write the derivatives of M c + bias - forces over the state, in rows of 12 + 2 n."""
    _passive_derivatives(work, tree, layout, loads)
    _joint_derivatives(work, tree, layout)
    _base_derivatives(work, tree, layout)


@inlined
def _invert(work, robot):
    """Write M^-1, and the sum of couplings that measures its accuracy."""
    inertia.invert_factor(work, robot.tree)
    inertia.multiply(work, robot.tree, robot.judged)


@inlined
def _push(work, robot):
    """Write the derivatives over the inputs: columns of M^-1, or linear combinations of them."""
    size, count, carried = len(robot.tree.row), len(robot.row), len(robot.loads.input)
    square, by_u = robot.tree.square, robot.by_u
    for row in range(size):
        for index in range(count):
            if robot.row[index] >= 0:
                value = load(work, square + row * size + robot.row[index])
                store(work, by_u + row * count + index, value)
        for index in range(carried):
            total = splat(work, 0.0)
            for k in range(size):
                column = load(work, robot.layout.columns + k * carried + index)
                total = total + load(work, square + row * size + k) * column
            store(work, by_u + row * count + robot.loads.input[index], total)


@inlined
def _solve(work, robot):
    """Write -M^-1 times the derivatives of the forces, six columns at a time."""
    tree, layout, size = robot.tree, robot.layout, len(robot.tree.row)
    width = 2 * size
    zero = splat(work, 0.0)
    none = (zero, zero, zero), (zero, zero, zero)
    # The first six columns, over the base's rotation and translation, are zero.
    for row in range(size):
        vec.put6(work, robot.slopes + row * width, none)
    for column in range(width % 6 or 6, width, 6):
        slopes = layout.lower + column
        for k in range(size):
            vec.put6(work, layout.held + k * 6, vec.get6(work, slopes + k * width))
        for row in range(size):
            total = none
            for k in range(size):
                entry = load(work, tree.square + (row * size + k))
                held = vec.get6(work, layout.held + k * 6)
                total = vec.minus6(total, vec.times6(held, entry))
            vec.put6(work, robot.slopes + column + row * width, total)


@compiled
def derive(robot, points, out, lanes, work, moves):
    """Write the results of `RowAccelerations` at eight or more points."""
    q, nu, force, u = points
    c, A, by_u, judged = out
    tree, layout, loads, size = robot.tree, robot.layout, robot.loads, len(robot.tree.row)
    for block in range(0, len(q), LANES):
        # If the last block has fewer than eight points, it overlaps the block before and fills all
        # lanes.
        first = min(block, len(q) - LANES)
        inertia.pack(q, first, lanes.q)
        outwards(work, tree, lanes.q)
        if moves:
            inertia.pack(nu, first, lanes.nu)
            inertia.pack(force, first, lanes.force)
            inertia.pack(u, first, lanes.u)
            rnea.move_bodies(work, tree, layout, lanes.nu)
            rnea.load_bodies(work, tree, layout, loads)
            rnea.load_carried(work, tree, layout, loads, lanes.u)
            rnea.load_momenta(work, tree, layout, loads)
        rnea.write_columns(work, tree, layout, loads)
        inwards(work, tree)
        inertia.keep_diagonal(work, tree)
        inertia.factorise(work, tree)
        if moves:
            rnea.collect(work, tree, layout)
            rnea.collect_momenta(work, tree, layout)
            for index in range(size):
                value = load(lanes.force, index) - load(work, layout.bias + index)
                store(work, layout.c + index, value)
            inertia.solve(work, tree, layout.c)
        _invert(work, robot)
        _push(work, robot)
        inertia.unpack(work, robot.by_u, by_u.shape[1], by_u, first, 0)
        inertia.unpack(work, robot.judged, judged.shape[1], judged, first, 0)
        if moves:
            rnea.accelerate_bodies(work, tree, layout)
            differentiate(work, tree, layout, loads)
            _solve(work, robot)
            inertia.unpack(work, layout.c, size, c, first, 0)
            lower = size * 2 * size
            inertia.unpack(work, robot.slopes, lower, A, first, A.shape[1] - lower)


Mask: TypeAlias = NDArray[np.bool_]

_FARTHEST = 1e6  # [rad] largest angle for which `vectors.cosine_and_sine` is accurate


class Packed(namedtuple("Packed", "q nu force u")):
    """Arrays of eight points; their second axis is the lane."""


class Derived(namedtuple("Derived", "tree layout loads row slopes by_u judged size")):
    """Arguments of `derive`: a robot, the offsets of its results in the work space, and its size.

    `row` is the coordinate that each input drives, -1 for a body-fixed wrench.
    """


class RowAccelerations:
    """Accelerations at rows of points, their derivatives and M^-1, by the compiled kernel.

    The sum of the couplings M_ii (M^-1)_ii (`judged`) measures the accuracy at each point; see
    `Inertia`.
    """

    def __init__(self, state: StateMap, actuation: Actuation, tree: Tree) -> None:
        robot, nv, fixed = state.robot, state.nx // 2, actuation.fixed
        loads = loads_of(robot, actuation, tree)
        layout, nu = layout_of(tree, len(loads.input)), fixed.shape[1]
        ends = np.cumsum((layout.size, nv * state.nx, nv * nu, 1))
        self._robot = Derived(
            *(tree, layout, loads),
            np.where(fixed.any(axis=0), np.abs(fixed).argmax(axis=0), -1).astype(np.intp),
            *map(int, ends),
        )
        self.state, self._actuation = state, actuation
        self._sizes = robot.nq, nv, nv, nu
        self._least_coupling = 0.999 * nv

    def write_inverse(self, q: Array, by_u: Array) -> Array:
        """Write the derivatives over u (N, 6 + n, nu); return the sums of couplings (N,)."""
        none = np.empty((0, 0))
        return self._derive((q, none, none, none), none, none, by_u, moves=False)

    def write(
        self, q: Array, nu: Array, q_m: Array, u: Array, A: Array, by_u: Array
    ) -> tuple[Array, Array]:
        """Write the derivatives of accelerations; return c (N, 6 + n) and sums of couplings (N,).

        The lower half of each A (N, nx, nx) gets the derivatives over the state. A and by_u are
        C-contiguous; nu and u are in base axes.
        """
        force = u @ self._actuation.fixed.T
        force[:, 6:] += self.state.robot.springs.force(q_m, nu[:, 6:])
        c = np.empty(nu.shape)
        flat = A.reshape(len(q), -1)
        return c, self._derive((q, nu, force, u), c, flat, by_u, moves=True)

    def sound(self, q: Array, judged: Array) -> Mask:
        """Return whether (N,) M is well-conditioned and all angles are below 1e6 rad."""
        # A zero pivot gives NaN, and comparisons with NaN are false.
        q_m = q[:, 7:]
        good = (self._least_coupling < judged) & (judged < Inertia.warning_coupling)
        if q_m.max(initial=0.0) < _FARTHEST and q_m.min(initial=0.0) > -_FARTHEST:
            return good
        return good & (np.abs(q_m) < _FARTHEST).all(axis=1)

    def _derive(
        self, points: tuple[Array, ...], c: Array, A: Array, by_u: Array, *, moves: bool
    ) -> Array:
        count, judged = len(points[0]), np.empty((len(points[0]), 1))
        kernel("derivatives", "derive")(
            self._robot,
            tuple(map(_writable, points)),
            (c, A, by_u.reshape(count, -1), judged),
            Packed(*map(work_space, self._sizes)),
            work_space(self._robot.size),
            moves,
        )
        return judged[:, 0]


def _writable(rows: Array) -> Array:
    """Return rows as a writable array, copied if necessary.

    numba would compile a second function for read-only arrays.
    """
    return np.require(rows, np.float64, ("C", "W"))
