"""M^-1 and the accelerations with their slopes, of eight points at once."""

from __future__ import annotations

import numba

from fflin.kernel.crba import inwards, outwards
from fflin.kernel.factor import factorise, multiply, unpack
from fflin.kernel.lanes import gather, load, splat, store
from fflin.kernel.rnea import accelerate_bodies, collect, load_bodies, move_bodies
from fflin.kernel.slopes import differentiate
from fflin.kernel.tree import LANES
from fflin.kernel.vectors import get6, minus6, put6, times6


@numba.njit(forceinline=True)
def solve_accelerations(work, tree, layout, forces, first):
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
def solve_slopes(work, tree, layout):
    """Turn the slopes, rows of the lower half of A, into -M^-1 slopes, six columns at a time."""
    size = len(tree.row)
    width = 2 * size
    zero = splat(0.0)
    none = (zero, zero, zero), (zero, zero, zero)
    # The first six columns, of q_b and r_b, are zeros that need no product.
    for column in range(width % 6 or 6, width, 6):
        slopes = layout.lower + column * LANES
        for k in range(size):
            put6(work, layout.held + k * 6 * LANES, get6(work, slopes + k * width * LANES))
        for row in range(size):
            total = none
            for k in range(size):
                entry = load(work, tree.square + (row * size + k) * LANES)
                held = get6(work, layout.held + k * 6 * LANES)
                total = minus6(total, times6(held, entry))
            put6(work, slopes + row * width * LANES, total)


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
        # The last block begins early enough to fill the lanes; some points are done twice.
        first = min(block, count - LANES)
        outwards(work, tree, flat, first * stride, stride)
        move_bodies(work, tree, layout, nu, first)
        load_bodies(work, tree, layout, loads, u, first)
        inwards(work, tree)
        collect(work, tree, layout)
        factorise(work, tree)
        multiply(work, tree, couplings, first)
        solve_accelerations(work, tree, layout, forces, first)
        accelerate_bodies(work, tree, layout)
        differentiate(work, tree, layout, loads)
        solve_slopes(work, tree, layout)
        unpack(work, tree.square, size * size, inverse, first, 0)
        unpack(work, layout.c, size, c, first, 0)
        unpack(work, layout.lower, lower, A, first, A.shape[1] - lower)
        unpack(work, layout.columns, columns.shape[1], columns, first, 0)
