"""M^-1 of many configurations at once: CRBA and a sparse factorisation, eight to an instruction.

References
----------
R. Featherstone, Rigid Body Dynamics Algorithms, Springer, 2008, section 6.5.
"""

from __future__ import annotations

import numba

from fflin.kernel.crba import inwards, outwards
from fflin.kernel.lanes import load, scatter, splat, store, transpose
from fflin.kernel.tree import LANES


@numba.njit(forceinline=True)
def factorise(work, tree):
    """Turn the packed M into U = L^-1 and V = L^-1 D^-1 with M = L^T D L, L of unit diagonal.

    The sparse factorisation of Featherstone, from the tips to the base, which makes no entry that
    was zero.
    """
    packed, scaled, diagonal = tree.packed, tree.scaled, tree.diagonal
    one = splat(1.0)
    size = len(tree.row)
    for k in range(size):
        store(
            work, diagonal + k * LANES, load(work, packed + (tree.row[k] + tree.depth[k]) * LANES)
        )
    for k in range(size - 1, -1, -1):
        row, depth = packed + tree.row[k] * LANES, tree.depth[k]
        inverse = one / load(work, row + depth * LANES)
        store(work, scaled + (tree.row[k] + depth) * LANES, inverse)
        store(work, row + depth * LANES, one)
        for t in range(depth - 1, -1, -1):
            share = load(work, row + t * LANES) * inverse
            other = packed + tree.row[tree.path[tree.row[k] + t]] * LANES
            for s in range(t + 1):
                at = other + s * LANES
                store(work, at, load(work, at) - share * load(work, row + s * LANES))
            store(work, row + t * LANES, share)
    zero = splat(0.0)
    for k in range(size):
        row, depth = packed + tree.row[k] * LANES, tree.depth[k]
        for t in range(depth):
            total = zero - load(work, row + t * LANES)
            for s in range(t + 1, depth):
                other = packed + tree.row[tree.path[tree.row[k] + s]] * LANES
                total = total - load(work, row + s * LANES) * load(work, other + t * LANES)
            store(work, row + t * LANES, total)
            above = tree.path[tree.row[k] + t]
            pivot = load(work, scaled + (tree.row[above] + tree.depth[above]) * LANES)
            store(work, scaled + (tree.row[k] + t) * LANES, total * pivot)


@numba.njit(forceinline=True)
def multiply(work, tree, couplings, first):
    """Write M^-1 = U D^-1 U^T lane beside lane, and sum M_ii (M^-1)_ii."""
    packed, scaled, square = tree.packed, tree.scaled, tree.square
    size = len(tree.row)
    coupling = splat(0.0)
    for i in range(size):
        left = packed + tree.row[i] * LANES
        for j in range(i + 1):
            right = scaled + tree.row[j] * LANES
            total = load(work, left) * load(work, right)
            for t in range(LANES, tree.common[i, j] * LANES, LANES):
                total = total + load(work, left + t) * load(work, right + t)
            store(work, square + (i * size + j) * LANES, total)
            store(work, square + (j * size + i) * LANES, total)
            if i == j:
                coupling = coupling + total * load(work, tree.diagonal + i * LANES)
    store(couplings, first, coupling)


@numba.njit(forceinline=True)
def unpack(work, start, entries, out, first, offset):
    """Write entries that stand lane beside lane to the rows of eight points, from a column on."""
    flat, stride = out.reshape(-1), out.shape[1]
    whole = entries - entries % LANES
    to = first * stride + offset
    for entry in range(0, whole, LANES):
        transpose(work, start + entry * LANES, flat, to + entry, stride)
    for entry in range(whole, entries):
        scatter(flat, to + entry, stride, load(work, start + entry * LANES))


@numba.njit(nogil=True, cache=True, boundscheck=False)
def invert(tree, q, out, couplings, work):
    """Write M^-1 of each configuration.

    Parameters
    ----------
    tree : Tree
    q : ndarray (count, nq)
        Configurations, as many as there are lanes at least.
    out : ndarray (count, size * size)
        Results.
    couplings : ndarray (count,)
        The sums of M_ii (M^-1)_ii, which tell how singular M is.
    work : ndarray
        Work space.
    """
    count, entries = out.shape
    stride = q.shape[1]
    configurations = q.reshape(-1)
    for block in range(0, count, LANES):
        # The last block begins early enough to fill the lanes; some points are done twice.
        first = min(block, count - LANES)
        outwards(work, tree, configurations, first * stride, stride)
        inwards(work, tree)
        factorise(work, tree)
        multiply(work, tree, couplings, first)
        unpack(work, tree.square, entries, out, first, 0)
