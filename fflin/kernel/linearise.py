"""M^-1 and the accelerations with their slopes, of eight points at once."""

from __future__ import annotations

from fflin.kernel.crba import inwards, outwards
from fflin.kernel.factor import (
    factorise,
    invert_factor,
    keep_diagonal,
    multiply,
    pack,
    solve,
    unpack,
)
from fflin.kernel.lanes import compiled, inlined, load, splat, store
from fflin.kernel.rnea import (
    accelerate_bodies,
    collect,
    collect_momenta,
    load_bodies,
    load_carried,
    load_momenta,
    move_bodies,
    write_columns,
)
from fflin.kernel.slopes import differentiate
from fflin.kernel.tree import LANES
from fflin.kernel.vectors import get6, minus6, put6, times6


@inlined
def _accelerations(work, tree, layout, forces):
    """Write c = M^-1 (forces - bias), by the factor of M."""
    for index in range(len(tree.row)):
        value = load(forces, index) - load(work, layout.bias + index)
        store(work, layout.c + index, value)
    solve(work, tree, layout.c)


@inlined
def _solve_slopes(work, tree, layout):
    """Turn the slopes, rows of the lower half of A, into -M^-1 slopes, six columns at a time."""
    size = len(tree.row)
    width = 2 * size
    zero = splat(work, 0.0)
    none = (zero, zero, zero), (zero, zero, zero)
    # The first six columns, of q_b and r_b, are zeros that need no product.
    for column in range(width % 6 or 6, width, 6):
        slopes = layout.lower + column
        for k in range(size):
            put6(work, layout.held + k * 6, get6(work, slopes + k * width))
        for row in range(size):
            total = none
            for k in range(size):
                entry = load(work, tree.square + (row * size + k))
                held = get6(work, layout.held + k * 6)
                total = minus6(total, times6(held, entry))
            put6(work, slopes + row * width, total)


@compiled
def linearise(tree, layout, loads, points, out, lanes, work):
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
    lanes : tuple of ndarray
        Work space for a row of each array of `points`, (entries, 8).
    work : ndarray (size, 8)
    """
    q, nu, forces, u = points
    inverse, c, A, columns, couplings = out
    count, size = len(q), len(tree.row)
    q_of, nu_of, forces_of, u_of = lanes
    lower = 2 * size * size
    for block in range(0, count, LANES):
        # The last block begins early enough to fill the lanes; some points are done twice.
        first = min(block, count - LANES)
        pack(q, first, q_of)
        pack(nu, first, nu_of)
        pack(forces, first, forces_of)
        pack(u, first, u_of)
        outwards(work, tree, q_of)
        move_bodies(work, tree, layout, nu_of)
        load_bodies(work, tree, layout, loads)
        load_carried(work, tree, layout, loads, u_of)
        load_momenta(work, tree, layout, loads)
        write_columns(work, tree, layout, loads)
        inwards(work, tree)
        collect(work, tree, layout)
        collect_momenta(work, tree, layout)
        keep_diagonal(work, tree)
        factorise(work, tree)
        _accelerations(work, tree, layout, forces_of)
        invert_factor(work, tree)
        multiply(work, tree, couplings, first)
        accelerate_bodies(work, tree, layout)
        differentiate(work, tree, layout, loads)
        _solve_slopes(work, tree, layout)
        unpack(work, tree.square, size * size, inverse, first, 0)
        unpack(work, layout.c, size, c, first, 0)
        unpack(work, layout.lower, lower, A, first, A.shape[1] - lower)
        unpack(work, layout.columns, columns.shape[1], columns, first, 0)
