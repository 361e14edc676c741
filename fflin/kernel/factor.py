"""A sparse factorisation of M and its inverse, and points lane beside lane.

References
----------
R. Featherstone, Rigid Body Dynamics Algorithms, Springer, 2008, section 6.5.
"""

from __future__ import annotations

from fflin.kernel.lanes import inlined, load, splat, store, transpose
from fflin.kernel.tree import LANES


@inlined
def factorise(work, tree):
    """Turn the packed M into L, of unit diagonal, and 1 / D where `scaled` is, M = L^T D L."""
    packed, scaled = tree.packed, tree.scaled
    for k in range(len(tree.row) - 1, -1, -1):
        row, depth = packed + tree.row[k], tree.depth[k]
        inverse = 1.0 / load(work, row + depth)
        store(work, scaled + (tree.row[k] + depth), inverse)
        store(work, row + depth, 1.0)
        for t in range(depth - 1, -1, -1):
            share = load(work, row + t) * inverse
            other = packed + tree.row[tree.path[tree.row[k] + t]]
            for s in range(t + 1):
                at = other + s
                store(work, at, load(work, at) - share * load(work, row + s))
            store(work, row + t, share)


@inlined
def solve(work, tree, x):
    """Turn a force at x into the acceleration M^-1 f, by the factor."""
    packed, size = tree.packed, len(tree.row)
    for k in range(size - 1, -1, -1):
        value, row = load(work, x + k), tree.row[k]
        for t in range(tree.depth[k]):
            at = x + tree.path[row + t]
            store(work, at, load(work, at) - load(work, packed + row + t) * value)
        pivot = load(work, tree.scaled + row + tree.depth[k])
        store(work, x + k, value * pivot)
    for k in range(size):
        value, row = load(work, x + k), tree.row[k]
        for t in range(tree.depth[k]):
            value = value - load(work, packed + row + t) * load(work, x + tree.path[row + t])
        store(work, x + k, value)


@inlined
def keep_diagonal(work, tree):
    """Write the diagonal of the packed M aside, which its factor overwrites."""
    for k in range(len(tree.row)):
        value = load(work, tree.packed + tree.row[k] + tree.depth[k])
        store(work, tree.diagonal + k, value)


@inlined
def invert_factor(work, tree):
    """Turn L into U = L^-1, and write V = L^-1 D^-1."""
    packed, scaled = tree.packed, tree.scaled
    zero = splat(work, 0.0)
    for k in range(len(tree.row)):
        row, depth = packed + tree.row[k], tree.depth[k]
        for t in range(depth):
            total = zero - load(work, row + t)
            for s in range(t + 1, depth):
                other = packed + tree.row[tree.path[tree.row[k] + s]]
                total = total - load(work, row + s) * load(work, other + t)
            store(work, row + t, total)
            above = tree.path[tree.row[k] + t]
            pivot = load(work, scaled + (tree.row[above] + tree.depth[above]))
            store(work, scaled + (tree.row[k] + t), total * pivot)


@inlined
def multiply(work, tree, judged):
    """Write M^-1 = U D^-1 U^T, and at `judged` the sum of M_ii (M^-1)_ii."""
    packed, scaled, square = tree.packed, tree.scaled, tree.square
    size = len(tree.row)
    coupling = splat(work, 0.0)
    for i in range(size):
        left = packed + tree.row[i]
        for j in range(i + 1):
            right = scaled + tree.row[j]
            total = load(work, left) * load(work, right)
            for t in range(1, tree.common[i, j]):
                total = total + load(work, left + t) * load(work, right + t)
            store(work, square + (i * size + j), total)
            store(work, square + (j * size + i), total)
            if i == j:
                coupling = coupling + total * load(work, tree.diagonal + i)
    store(work, judged, coupling)


@inlined
def pack(rows, first, lanes):
    """Write the rows of eight points lane beside lane."""
    for entry in range(len(lanes)):
        for lane in range(LANES):
            lanes[entry, lane] = rows[first + lane, entry]


@inlined
def unpack(work, start, entries, out, first, offset):
    """Write entries that stand lane beside lane to the rows of eight points, from a column on."""
    stride = out.shape[1]
    whole = entries - entries % LANES
    to = first * stride + offset
    for entry in range(0, whole, LANES):
        transpose(work, start + entry, out, to + entry, stride)
    for entry in range(whole, entries):
        for lane in range(LANES):
            out[first + lane, offset + entry] = work[start + entry, lane]
