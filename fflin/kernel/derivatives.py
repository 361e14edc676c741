r"""M^-1, accelerations and their derivatives at many points, eight points at a time.

RNEA is differentiated in closed form. Let S be the spatial axis of a joint, and let v and a be the
spatial velocity and acceleration of the joint's parent. Define Psi' = v x S and
Psi'' = a x S + v x Psi'. Let joint j be on the path from the base to joint i. The joint forces tau
then have the following derivatives with respect to joint positions q and velocities q':

.. math::
    \partial\tau_j/\partial q_i &= S_j^T (2 B_i \Psi'_i + I_i \Psi''_i + S_i \times^* f_i) \\
    \partial\tau_j/\partial q'_i &= S_j^T (2 B_i S_i + 2 I_i \Psi'_i) \\
    \partial\tau_i/\partial q_j &= (2 B_i^T S_i)^T \Psi'_j + (I_i S_i)^T \Psi''_j \\
    \partial\tau_i/\partial q'_j &= (2 B_i^T S_i)^T S_j + 2 (I_i S_i)^T \Psi'_j

Here I_i, B_i and f_i are the inertia, the Coriolis matrix and the spatial force of the subtree
beyond joint i. Let p be the linear momentum of the subtree. The stored momentum h is the sum of the
momenta of those wheels in the subtree that have no inertia in the model. The matrix G is the sum of
m v r^T over the mass points of the subtree. Each mass point has the mass m, the velocity v and the
position r from the joint. Let s be a motion vector with the angular part w. The force part of 2 B s
is 2 w x p. The moment part is 2 (tr(G) E - G) w + w x h, with the identity matrix E.

The equations also hold for the angular velocity omega_b of the base, with one change. In general,
2 I Psi' in the second and fourth equation is I (Psi' + dS/dt). A joint axis is fixed in the parent,
so dS/dt = v x S = Psi'. The base has no parent, so Psi' = 0. Its axes e are fixed in the base, so
dS/dt = omega_b x e. Therefore I (Psi' + dS/dt) is the single term I (omega_b x e).

References
----------
S. Singh, R. P. Russell and P. M. Wensing, Efficient analytical derivatives of rigid-body dynamics
using spatial vector algebra, IEEE Robotics and Automation Letters 7(2), 2022.
"""

from collections import namedtuple

import numpy as np

from fflin.base.rotation import skew
from fflin.base.validation import Array, Mask
from fflin.dynamics.coordinates import ANGULAR
from fflin.dynamics.rnea import WARNING_COUPLING
from fflin.dynamics.state import Actuation, StateMap
from fflin.kernel import bodies
from fflin.kernel import vectors as vec
from fflin.kernel.bodies import (
    FORCE,
    MOMENTS,
    MOMENTUM,
    PSI,
    PSI2,
    STORED,
    at_parent,
    joint_axis,
)
from fflin.kernel.bodies import spatial_inertia_times as inertia_times
from fflin.kernel.compiled import kernel
from fflin.kernel.orbit import add_gradient, subtract_gradient_slopes
from fflin.kernel.tree import INERTIA, LANES, LOAD, MOTION, PLACE, Tree, work_space
from fflin.kernel.vectors import load, store


def _coriolis(work, at, w):
    """Return 2 B s (moment, force) for a motion vector s with the angular part w.

    B is the Coriolis matrix of a joint's subtree. 2 B s does not depend on the linear part of s.
    """
    G = vec.get_columns(work, at + MOMENTS)
    trace = G[0][0] + G[1][1] + G[2][2]
    p = vec.get3(work, at + MOMENTUM)
    h = vec.get3(work, at + STORED)
    half = vec.minus(vec.times(w, trace), vec.product(G, w))
    moment = vec.plus(vec.plus(half, half), vec.cross(w, h))
    half_force = vec.cross(w, p)
    return moment, vec.plus(half_force, half_force)


def _coriolis_transposed(work, at, along):
    """Return the moment part of 2 B^T s for the motion vector s = `along`.

    B is the Coriolis matrix of a joint's subtree. Let w be the angular part and l the linear part
    of s. The moment part is 2 ((tr(G) E - G^T) w + p x l) + h x w. The force part is zero.
    """
    G = vec.get_columns(work, at + MOMENTS)
    trace = G[0][0] + G[1][1] + G[2][2]
    p = vec.get3(work, at + MOMENTUM)
    h = vec.get3(work, at + STORED)
    w = along[0]
    linear = along[1]
    half = vec.minus(vec.times(w, trace), vec.across(G, w))
    half = vec.plus(half, vec.cross(p, linear))
    return vec.plus(vec.plus(half, half), vec.cross(h, w))


def _write_springs(work, tree, width):
    """Write the derivatives of the forces of springs and dampers; all other entries are zero."""
    offsets = tree.offsets
    n = len(tree.row) - 6
    vec.clear(work, offsets.lower, len(tree.row) * width)
    for index in range(n):
        row = offsets.lower + (6 + index) * width
        store(work, row + (6 + index), load(tree.stiffness, index))
        store(work, row + (12 + n + index), load(tree.damping, index))


def differentiate(work, tree):
    """Write the derivatives of M c + b - B_u u - f at constant c.

    b is the bias, and f are the spring and damper forces. The derivatives are a matrix
    (6 + n, 12 + 2 n). Each column is the derivative with respect to one coordinate of a
    displacement of the state, in base axes.
    """
    offsets = tree.offsets
    n = len(tree.row) - 6
    width = 2 * len(tree.row)
    zero = 0.0
    one = 1.0
    omega_b = vec.get3(work, offsets.motion)
    _write_springs(work, tree, width)
    # The path of a joint i is the base, the joints before joint i, and joint i itself. For each
    # joint i, write the derivatives of the forces of its path with respect to the position and rate
    # of joint i. Also write the derivatives of the force of joint i with respect to the positions
    # and rates of the joints before it, and with respect to omega_b.
    for body in range(len(tree.parent) - 1, 0, -1):
        at = offsets.load + body * LOAD
        moving = offsets.motion + body * MOTION
        inertia = offsets.subtree_inertias + body * INERTIA
        column_i = tree.coordinate[body]
        row_i = offsets.lower + column_i * width
        axis_i = joint_axis(work, tree, body)
        psi_i, psi2_i = vec.get6(work, moving + PSI), vec.get6(work, moving + PSI2)
        # I_i S_i, and the moment part of 2 B_i^T S_i, whose force part is zero
        momentum = inertia_times(work, inertia, axis_i)
        coriolis = _coriolis_transposed(work, at, axis_i)
        # by_q = 2 B_i Psi'_i + I_i Psi''_i + S_i x* f_i
        moment, force = vec.get6(work, at + FORCE)
        by_q = vec.plus6(
            _coriolis(work, at, psi_i[0]), inertia_times(work, inertia, psi2_i)
        )
        turned = vec.plus(vec.cross(axis_i[0], moment), vec.cross(axis_i[1], force))
        by_q = vec.plus6(by_q, (turned, vec.cross(axis_i[0], force)))
        # by_v = 2 B_i S_i + 2 I_i Psi'_i
        inertial = inertia_times(work, inertia, psi_i)
        by_v = vec.plus6(_coriolis(work, at, axis_i[0]), vec.plus6(inertial, inertial))
        above = body
        while above > 0:
            place = offsets.places + above * PLACE
            column_j = tree.coordinate[above]
            row_j = offsets.lower + column_j * width
            axis_j = joint_axis(work, tree, above)
            # dtau_j/dq_i
            vec.add(work, row_j + column_i, vec.dot6(axis_j, by_q))
            # dtau_j/dq'_i
            vec.add(work, row_j + (column_i + 6 + n), vec.dot6(axis_j, by_v))
            if above != body:
                moving = offsets.motion + above * MOTION
                psi_j = vec.get6(work, moving + PSI)
                psi2_j = vec.get6(work, moving + PSI2)
                # dtau_i/dq_j
                vec.add(
                    work,
                    row_i + column_j,
                    vec.dot(coriolis, psi_j[0]) + vec.dot6(momentum, psi2_j),
                )
                # dtau_i/dq'_j
                half = vec.dot6(momentum, psi_j)
                value = vec.dot(coriolis, axis_j[0]) + (half + half)
                vec.add(work, row_i + (column_j + 6 + n), value)
            # Move the moments and the momentum from joint j to its parent.
            momentum = at_parent(work, place, momentum)
            by_q, by_v = at_parent(work, place, by_q), at_parent(work, place, by_v)
            above = tree.parent[above]
        # dtau_i/domega_b, with (I_i S_i)^T (omega_b x e) = e^T (I_i S_i x omega_b) for each axis e
        vec.add3(
            work, row_i + (6 + n), vec.plus(coriolis, vec.cross(momentum[0], omega_b))
        )
        # Derivatives of the base's moment and force: dtau_b/dq_i and dtau_b/dq'_i
        bodies.add_column(work, offsets.lower + column_i, width, by_q)
        bodies.add_column(work, offsets.lower + (column_i + 6 + n), width, by_v)
    # dtau_b/domega_b = 2 B e + I (omega_b x e) for each axis e of the base
    axes = (one, zero, zero), (zero, one, zero), (zero, zero, one)
    for index in range(3):
        axis_rate = vec.cross(omega_b, axes[index]), (zero, zero, zero)
        inertial = inertia_times(work, offsets.subtree_inertias, axis_rate)
        total = vec.plus6(_coriolis(work, offsets.load, axes[index]), inertial)
        bodies.add_column(work, offsets.lower + (6 + n + index), width, total)


def _push(work, tree, by_u):
    """Write D_u (3.3). Each column contains the accelerations c per unit of one input.

    The column of a body-fixed input is M^-1 times the input's column of B_u. The column of any
    other input is a column of M^-1.
    """
    offsets = tree.offsets
    size, count, carried = len(tree.row), len(tree.driven), len(tree.input)
    for row in range(size):
        for index in range(count):
            if tree.driven[index] >= 0:
                value = load(work, offsets.square + row * size + tree.driven[index])
                store(work, by_u + row * count + index, value)
        for index in range(carried):
            total = 0.0
            for k in range(size):
                column = load(work, offsets.columns + k * carried + index)
                total = total + load(work, offsets.square + row * size + k) * column
            store(work, by_u + row * count + tree.input[index], total)


def _solve(work, tree, slopes, field):
    """Write the derivatives (6 + n, 12 + 2 n) of the accelerations c.

    They are -M^-1 D, where D is the matrix that `differentiate` writes. Six columns are computed at
    a time.
    """
    offsets = tree.offsets
    size = len(tree.row)
    width = 2 * len(tree.row)
    none = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    # The first six columns are for the base's rotation and translation. Without an orbit, these
    # columns are zero.
    groups = (width + 5) // 6
    if field is None:
        groups = (width - 1) // 6
        for row in range(size):
            vec.clear(work, slopes + row * width, 6)
    # The groups of six columns end at the last column. The first group may therefore begin among
    # the zero columns, or contain columns of the second group.
    for group in range(groups):
        column = max(width - 6 * (groups - group), 0)
        # Copy six columns of D next to each other, because each row of M^-1 reads all of them.
        for k in range(size):
            entries = vec.get6(work, offsets.lower + column + k * width)
            vec.put6(work, offsets.block + k * 6, entries)
        for row in range(size):
            total = none
            for k in range(size):
                entry = load(work, offsets.square + (row * size + k))
                entries = vec.get6(work, offsets.block + k * 6)
                total = vec.minus6(total, vec.times6(entries, entry))
            vec.put6(work, slopes + column + row * width, total)


def _pack(rows, first, lanes):
    """Copy rows[first : first + 8] to the eight columns of `lanes` (entries, 8)."""
    for entry in range(len(lanes)):
        for lane in range(LANES):
            lanes[entry, lane] = rows[first + lane, entry]


def _unpack(work, start, entries, out, first, offset):
    """Copy `entries` rows of `work` (.., 8), transposed, to eight rows of `out`.

    The first copied row is row `start` of `work`. It is copied to column `offset` of `out`, from
    row `first` on.
    """
    for entry in range(entries):
        for lane in range(LANES):
            out[first + lane, offset + entry] = work[start + entry, lane]


def derive(tree, points, out, lanes, work):
    """Linearise at N points without an orbit; see `_derive`."""
    _derive(tree, points, None, out, lanes, work)


def derive_in_orbit(tree, points, field, out, lanes, work):
    """Linearise at N points in orbit; see `_derive`."""
    _derive(tree, points, field, out, lanes, work)


def _derive(tree, points, field, out, lanes, work):
    """Write the accelerations c, their derivatives and the sums of the couplings at N points.

    N must be at least 8. All arrays in `points` and `out` have one row per point.

    - `points`: q, nu, force and u. `force` contains the generalised forces of springs, dampers and
      all inputs that are not body-fixed. For points at rest, nu, force and u are empty. In orbit,
      nu contains the inertial angular velocity of the base.
    - `field`: None without an orbit. In orbit, a row consists of the unit vector (3,) away from the
      central body in base axes, and of k [1/s^2]; see `kernel.orbit`.
    - `out`: c, A, by_u and judged. A row of A is a flattened matrix (nx, nx). The lower half of
      this matrix receives the derivatives of c with respect to displacements of the state. For
      points at rest, c and A are not written. `by_u` receives D_u (3.3), flattened. `judged` (N, 1)
      receives the sum of the couplings M_ii (M^-1)_ii.
    - `lanes`, which is a `Packed`, and `work` are work space.
    """
    offsets = tree.offsets
    q, nu, force, u = points
    c, A, by_u, judged = out
    size = len(tree.row)
    slopes = offsets.size
    moves = len(nu) > 0
    inputs = slopes + size * 2 * size
    coupling = inputs + size * len(tree.driven)
    for block in range(0, len(q), LANES):
        # If fewer than eight points are left, the last block begins at an earlier point, so that
        # the block has eight points. Some points of the previous block are then computed twice.
        first = min(block, len(q) - LANES)
        _pack(q, first, lanes.q)
        bodies.outwards(work, tree, lanes.q)
        if moves:
            _pack(nu, first, lanes.nu)
            _pack(force, first, lanes.force)
            _pack(u, first, lanes.u)
            bodies.move_bodies(work, tree, lanes.nu, vec.get3(lanes.nu, 0))
            bodies.load_bodies(work, tree)
            bodies.load_carried(work, tree, lanes.u)
        bodies.write_columns(work, tree, None)
        bodies.inwards(work, tree)
        bodies.factorise(work, tree)
        if moves:
            bodies.collect(work, tree)
            bodies.collect_momenta(work, tree)
            for index in range(size):
                value = load(lanes.force, index) - load(work, offsets.bias + index)
                store(work, offsets.c + index, value)
            if field is not None:
                _pack(field, first, lanes.field)
                r, k = vec.get3(lanes.field, 0), load(lanes.field, 3)
                add_gradient(work, tree, r, k)
            bodies.solve(work, tree, offsets.c)
        bodies.invert_factor(work, tree)
        bodies.multiply(work, tree, coupling)
        _push(work, tree, inputs)
        _unpack(work, inputs, by_u.shape[1], by_u, first, 0)
        _unpack(work, coupling, judged.shape[1], judged, first, 0)
        if moves:
            bodies.accelerate_bodies(work, tree)
            differentiate(work, tree)
            if field is not None:
                r, k = vec.get3(lanes.field, 0), load(lanes.field, 3)
                subtract_gradient_slopes(work, tree, r, k)
            _solve(work, tree, slopes, field)
            _unpack(work, offsets.c, size, c, first, 0)
            lower = size * 2 * size
            _unpack(work, slopes, lower, A, first, A.shape[1] - lower)


# [rad] `vectors.cosine_and_sine` is accurate for angles of smaller magnitude
_FARTHEST = 1e6


class Packed(namedtuple("Packed", "q nu force u field")):
    """Arrays (entries, 8) at eight points, one column for each point; see `_derive`."""


class RowAccelerations:
    """Accelerations c and their derivatives at N points, computed by the compiled kernel.

    N must be at least 8. Both `write` and `write_inverse` return a mask (N,) that is true at points
    with accurate results. At these points, M is well-conditioned, and the joint entries of q are
    below 1e6 in magnitude. The sum of the couplings M_ii (M^-1)_ii shows whether M is
    well-conditioned; see `dynamics.rnea`.
    """

    def __init__(self, state: StateMap, actuation: Actuation, tree: Tree) -> None:
        nv = state.nx // 2
        nu = len(actuation.names)
        self.state, self._actuation, self._tree = state, actuation, tree
        self._sizes = state.robot.nq, nv, nv, nu, 4
        self._work = tree.offsets.size + nv * state.nx + nv * nu + 1
        self._least_coupling = 0.999 * nv

    def write_inverse(self, q: Array, by_u: Array) -> Mask:
        """Write D_u of (3.3) to `by_u` (N, 6 + n, nu); return the mask."""
        none = np.empty((0, 0))
        return self._derive((q, none, none, none), none, none, by_u)

    def write(
        self, q: Array, nu: Array, q_m: Array, u: Array, A: Array, by_u: Array
    ) -> tuple[Array, Mask]:
        """Write the derivatives of the accelerations c; return c (N, 6 + n) and the mask.

        The lower half of each matrix in A (N, nx, nx) receives the derivatives with respect to
        displacements of the state. `by_u` receives D_u. A and `by_u` must be C-contiguous. nu and u
        are in base axes.
        """
        force = u @ self._actuation.fixed.T
        force[:, 6:] += self.state.robot.springs.force(q_m, nu[:, 6:])
        c = np.empty(nu.shape)
        rows = A.reshape(len(q), -1)
        field = self.state.field
        if field is None:
            return c, self._derive((q, nu, force, u), c, rows, by_u)
        # In orbit, the equations hold for the inertial angular velocity of the base. A rotation of
        # the base changes this velocity in base axes.
        R = field.attitudes(q)
        spin = field.rate @ R
        nu = nu.copy()
        nu[:, ANGULAR] += spin
        radial = np.column_stack(
            (field.axes[:, 0] @ R, np.full(len(q), field.gradient))
        )
        accurate = self._derive((q, nu, force, u), c, rows, by_u, radial)
        slopes = A[:, A.shape[1] // 2 :]
        by_omega = slopes[:, :, nu.shape[1] :][:, :, ANGULAR]
        slopes[:, :, ANGULAR] += by_omega @ skew(spin)
        return c, accurate & field.is_near(q)

    def _derive(
        self,
        points: tuple[Array, ...],
        c: Array,
        A: Array,
        by_u: Array,
        field: Array | None = None,
    ) -> Mask:
        """Call the kernel, which writes to c, A and by_u; return the mask of `write`.

        `field` is the argument of `_derive`.
        """
        couplings = np.empty((len(by_u), 1))
        # Copy read-only arrays, because numba would compile a second function for such arrays.
        points = tuple(np.require(rows, np.float64, ("C", "W")) for rows in points)
        name = "derive"
        given: tuple[object, ...] = (self._tree, points)
        if field is not None:
            name = "derive_in_orbit"
            given = (self._tree, points, field)
        kernel("derivatives", name)(
            *given,
            (c, A, by_u.reshape(len(by_u), -1), couplings),
            Packed(*map(work_space, self._sizes)),
            work_space(self._work),
        )
        # If a pivot of M is zero, the sum of the couplings is NaN, and both comparisons are false.
        total = couplings[:, 0]
        accurate = (self._least_coupling < total) & (total < WARNING_COUPLING)
        # The sine and cosine of very large angles are inaccurate. Such angles are rare, so compare
        # single numbers first, which is faster than a comparison of all entries.
        q_m = points[0][:, 7:]
        if q_m.max(initial=0.0) < _FARTHEST and q_m.min(initial=0.0) > -_FARTHEST:
            return accurate
        return accurate & (np.abs(q_m) < _FARTHEST).all(axis=1)
