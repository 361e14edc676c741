"""The joint-space inertia M by composite rigid bodies, its sparse factors, and its inverse.

All vectors are in base axes, so no vector is rotated from joint to joint. Moments are about the
joints. About the base's origin, the inertia of a light tool on a long arm would lose digits. Row i
of the packed M holds the nonzero entries up to the diagonal. Their columns are the coordinates on
the path from the base to i. If a coordinate is on this path, its own path is the beginning of this
path.

References
----------
R. Featherstone, Rigid Body Dynamics Algorithms, Springer, 2008, sections 6.2 and 6.5.
"""

from __future__ import annotations

from fflin.kernel import vectors as vec
from fflin.kernel.lanes import inlined, load, splat, store
from fflin.kernel.tree import INERTIA, LANES, PLACE


@inlined
def _place(work, at, parent, fixed, first, cosine, sine, shift):
    """Write the pose of a body into `work` at `at`; the pose of its parent is at `parent`."""
    axes = vec.get_columns(work, parent)
    x = vec.product(axes, vec.get3(fixed, first))
    y = vec.product(axes, vec.get3(fixed, first + 3))
    z = vec.product(axes, vec.get3(fixed, first + 6))
    origin = vec.product(axes, vec.get3(fixed, first + 9))
    vec.put3(work, at, vec.plus(vec.times(x, cosine), vec.times(y, sine)))
    vec.put3(work, at + 3, vec.minus(vec.times(y, cosine), vec.times(x, sine)))
    vec.put3(work, at + 6, z)
    vec.put3(work, at + 9, vec.plus(origin, vec.times(z, shift)))


@inlined
def _inertia(work, at, place, bodies, first):
    """Write a body's inertia about its joint in base axes: m, m c, and R I R^T."""
    axes = vec.get_columns(work, place)
    store(work, at, load(bodies, first))
    vec.put3(work, at + 1, vec.product(axes, vec.get3(bodies, first + 1)))
    xx, xy, xz = vec.get3(bodies, first + 4)
    yy, yz, zz = vec.get3(bodies, first + 7)
    u = vec.product(axes, (xx, xy, xz))
    v = vec.product(axes, (xy, yy, yz))
    w = vec.product(axes, (xz, yz, zz))
    _, yy, yz = vec.product(axes, (u[1], v[1], w[1]))
    zz = vec.product(axes, (u[2], v[2], w[2]))[2]
    vec.put3(work, at + 4, vec.product(axes, (u[0], v[0], w[0])))
    vec.put3(work, at + 7, (yy, yz, zz))


@inlined
def _carry(work, at, above, place):
    """Add a composite inertia, expressed at the parent's joint, to the parent's inertia."""
    m = load(work, at)
    h = vec.get3(work, at + 1)
    xx, xy, xz = vec.get3(work, at + 4)
    yy, yz, zz = vec.get3(work, at + 7)
    d = vec.get3(work, place + 9)
    e = vec.plus(h, vec.times(d, m))
    px, py, pz = d[0] * (h[0] + e[0]), d[1] * (h[1] + e[1]), d[2] * (h[2] + e[2])
    xy = xy - (d[0] * e[1] + h[0] * d[1])
    xz = xz - (d[0] * e[2] + h[0] * d[2])
    yz = yz - (d[1] * e[2] + h[1] * d[2])
    vec.add(work, above, m)
    vec.add3(work, above + 1, e)
    vec.add3(work, above + 4, (xx + (py + pz), xy, xz))
    vec.add3(work, above + 7, (yy + (px + pz), yz, zz + (px + py)))


@inlined
def spatial_inertia_times(work, at, motion):
    """Return a spatial inertia times a motion vector, as moment and force."""
    m, h = load(work, at), vec.get3(work, at + 1)
    xx, xy, xz = vec.get3(work, at + 4)
    yy, yz, zz = vec.get3(work, at + 7)
    w, v = motion
    turning = vec.dot((xx, xy, xz), w), vec.dot((xy, yy, yz), w), vec.dot((xz, yz, zz), w)
    return vec.plus(turning, vec.cross(h, v)), vec.plus(vec.times(v, m), vec.cross(w, h))


@inlined
def outwards(work, tree, q):
    """Write the poses and the inertias of all bodies, from the base outwards."""
    places, own = tree.places, tree.own
    one, zero = splat(work, 1.0), splat(work, 0.0)
    vec.put3(work, places, (1.0, 0.0, 0.0))
    vec.put3(work, places + 3, (0.0, 1.0, 0.0))
    vec.put3(work, places + 6, (0.0, 0.0, 1.0))
    _inertia(work, own, places, tree.bodies, 0)
    for body in range(1, len(tree.parent)):
        at = places + body * PLACE
        value = load(q, tree.index[body])
        if tree.unbounded[body]:
            cosine, sine = value, load(q, tree.index[body] + 1)
        elif tree.turns[body] != 0.0:
            cosine, sine = vec.cosine_and_sine(tree.turns[body] * value)
        else:
            cosine, sine = one, zero
        above = places + tree.parent[body] * PLACE
        shift = tree.slides[body] * value
        _place(work, at, above, tree.fixed, body * PLACE, cosine, sine, shift)
        _inertia(work, own + body * INERTIA, at, tree.bodies, body * INERTIA)


@inlined
def inwards(work, tree):
    """Write the packed M and the composite inertias, from the tips inwards."""
    bodies = len(tree.parent)
    places, inertias, packed = tree.places, tree.inertias, tree.packed
    zero = splat(work, 0.0)
    for index in range(tree.entries):
        store(work, packed + index, 0.0)
    for index in range(bodies * INERTIA):
        store(work, inertias + index, load(work, tree.own + index))
    pair = 0
    for body in range(bodies - 1, 0, -1):
        at = inertias + body * INERTIA
        place = places + body * PLACE
        z = vec.get3(work, place + 6)
        axis = vec.times(z, tree.turns[body]), vec.times(z, tree.slides[body])
        moment, force = spatial_inertia_times(work, at, axis)
        _carry(work, at, inertias + tree.parent[body] * INERTIA, place)
        above = body
        while above > 0:
            place = places + above * PLACE
            z = vec.get3(work, place + 6)
            value = tree.turns[above] * vec.dot(z, moment)
            value = value + tree.slides[above] * vec.dot(z, force)
            vec.add(work, packed + tree.target[pair], tree.share[pair] * value)
            pair += 1
            # Move the moment to the parent's joint.
            moment = vec.plus(moment, vec.cross(vec.get3(work, place + 9), force))
            above = tree.parent[above]
        start, share = packed + tree.target[pair], tree.share[pair]
        pair += 1
        vec.add3(work, start, vec.times(moment, share))
        vec.add3(work, start + 3, vec.times(force, share))
    # The base's rigid-body block (I, [m c]x, m), packed as rows of a chain of six coordinates.
    m = load(work, inertias)
    hx, hy, hz = vec.get3(work, inertias + 1)
    xx, xy, xz = vec.get3(work, inertias + 4)
    yy, yz, zz = vec.get3(work, inertias + 7)
    vec.put6(work, packed, ((xx, xy, yy), (xz, yz, zz)))
    vec.put6(work, packed + 6, ((zero, hz, -hy), (m, -hz, zero)))
    vec.put3(work, packed + 12, (hx, zero, m))
    vec.put6(work, packed + 15, ((hy, -hx, zero), (zero, zero, m)))
    for index in range(len(tree.row)):
        at = packed + (tree.row[index] + tree.depth[index])
        vec.add(work, at, tree.armature[index])


@inlined
def factorise(work, tree):
    """Factorise M = L^T D L: replace the packed M by the unit L, and write 1 / D at `scaled`."""
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
    """Replace a force f at x by the acceleration M^-1 f; M must be factorised."""
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
    """Copy the diagonal of the packed M, because `factorise` overwrites it."""
    for k in range(len(tree.row)):
        value = load(work, tree.packed + tree.row[k] + tree.depth[k])
        store(work, tree.diagonal + k, value)


@inlined
def invert_factor(work, tree):
    """Replace L by U = L^-1, and write V = L^-1 D^-1."""
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
    """Write M^-1 = U D^-1 U^T, and write the sum of M_ii (M^-1)_ii at `judged`."""
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
    """Copy the rows of eight points into an array (entries, lanes)."""
    for entry in range(len(lanes)):
        for lane in range(LANES):
            lanes[entry, lane] = rows[first + lane, entry]


@inlined
def unpack(work, start, entries, out, first, offset):
    """Copy entries of a laned array to the rows of eight points, from column `offset` on."""
    for entry in range(entries):
        for lane in range(LANES):
            out[first + lane, offset + entry] = work[start + entry, lane]
