"""The joint-space inertia M of eight configurations at once, by composite rigid bodies.

All vectors stand in base axes, so that none is turned from joint to joint; moments are about the
joints, since about the base origin those of a light tool at the end of a long arm would lose their
digits. Row i of the packed M holds what is not zero left of the diagonal: the coordinates on the
path from the base to i, of which those of any coordinate on the path are the beginning.

References
----------
R. Featherstone, Rigid Body Dynamics Algorithms, Springer, 2008, sections 6.2 and 6.5.
"""

from __future__ import annotations

import numba
import numpy as np

from fflin.kernel.lanes import floor, gather, load, splat, store
from fflin.kernel.tree import INERTIA, LANES, PLACE
from fflin.kernel.vectors import (
    add,
    add3,
    cross,
    dot,
    get3,
    get_columns,
    minus,
    plus,
    product,
    put3,
    times,
    turned,
)


@numba.njit(forceinline=True)
def _cosine_and_sine(x):
    """Return both of |x| < 1e6: taken to one octant in three steps, and there by polynomials.

    The numbers are those of fdlibm (Sun Microsystems, 1993), exact to a unit in the last place.
    """
    turns = floor(x * splat(2.0 / np.pi) + splat(0.5))
    x = x - turns * splat(1.57079632673412561417e00)
    x = x - turns * splat(6.07710050630396597660e-11)
    x = x - turns * splat(2.02226624879595063154e-21)
    z = x * x
    p = splat(-2.50507602534068634195e-08) + z * splat(1.58969099521155010221e-10)
    p = splat(2.75573137070700676789e-06) + z * p
    p = splat(-1.98412698298579493134e-04) + z * p
    p = splat(8.33333333332248946124e-03) + z * p
    p = splat(-1.66666666666666324348e-01) + z * p
    sine = x + x * z * p
    p = splat(2.08757232129817482790e-09) + z * splat(-1.13596475577881948265e-11)
    p = splat(-2.75573143513906633035e-07) + z * p
    p = splat(2.48015872894767294178e-05) + z * p
    p = splat(-1.38888888888741095749e-03) + z * p
    p = splat(4.16666666666666019037e-02) + z * p
    one = splat(1.0)
    cosine = (one - splat(0.5) * z) + z * z * p
    # Add the quarter turns again, whose cosine and sine are (1, 0), (0, 1), (-1, 0) or (0, -1).
    half = floor(turns * splat(0.5))
    odd = turns - half - half
    sign = one - splat(2.0) * (half - splat(2.0) * floor(half * splat(0.5)))
    even, odd = sign * (one - odd), sign * odd
    return even * cosine - odd * sine, odd * cosine + even * sine


@numba.njit(forceinline=True)
def _place(work, at, parent, fixed, cosine, sine, shift):
    """Write the place of a body into `work` at `at`, that of its parent being at `parent`."""
    axes = get_columns(work, parent)
    x = turned(axes, fixed[0], fixed[3], fixed[6])
    y = turned(axes, fixed[1], fixed[4], fixed[7])
    z = turned(axes, fixed[2], fixed[5], fixed[8])
    origin = turned(axes, fixed[9], fixed[10], fixed[11])
    put3(work, at, plus(times(x, cosine), times(y, sine)))
    put3(work, at + 3 * LANES, minus(times(y, cosine), times(x, sine)))
    put3(work, at + 6 * LANES, z)
    put3(work, at + 9 * LANES, plus(origin, times(z, shift)))


@numba.njit(forceinline=True)
def _inertia(work, at, place, body):
    """Write a body's inertia about its joint: m, m c, and R I R^T by way of the columns of R I."""
    axes = get_columns(work, place)
    store(work, at, splat(body[0]))
    put3(work, at + LANES, turned(axes, body[1], body[2], body[3]))
    u = turned(axes, body[4], body[5], body[6])
    v = turned(axes, body[5], body[7], body[8])
    w = turned(axes, body[6], body[8], body[9])
    _, yy, yz = product(axes, (u[1], v[1], w[1]))
    zz = product(axes, (u[2], v[2], w[2]))[2]
    put3(work, at + 4 * LANES, product(axes, (u[0], v[0], w[0])))
    put3(work, at + 7 * LANES, (yy, yz, zz))


@numba.njit(forceinline=True)
def _carry(work, at, above, place):
    """Add a composite inertia, seen from the parent's joint, to the parent's."""
    m = load(work, at)
    h = get3(work, at + LANES)
    xx, xy, xz = get3(work, at + 4 * LANES)
    yy, yz, zz = get3(work, at + 7 * LANES)
    d = get3(work, place + 9 * LANES)
    e = plus(h, times(d, m))
    px, py, pz = d[0] * (h[0] + e[0]), d[1] * (h[1] + e[1]), d[2] * (h[2] + e[2])
    xy = xy - (d[0] * e[1] + h[0] * d[1])
    xz = xz - (d[0] * e[2] + h[0] * d[2])
    yz = yz - (d[1] * e[2] + h[1] * d[2])
    add(work, above, m)
    add3(work, above + LANES, e)
    add3(work, above + 4 * LANES, (xx + (py + pz), xy, xz))
    add3(work, above + 7 * LANES, (yy + (px + pz), yz, zz + (px + py)))


@numba.njit(forceinline=True)
def inertia_times(work, at, w):
    """Return I w of the inertia at `at`."""
    xx, xy, xz = get3(work, at + 4 * LANES)
    yy, yz, zz = get3(work, at + 7 * LANES)
    return dot((xx, xy, xz), w), dot((xy, yy, yz), w), dot((xz, yz, zz), w)


@numba.njit(forceinline=True)
def _momentum(work, at, axis, turns, slides):
    """Return the momentum (angular, linear) about its joint of an inertia that the joint moves."""
    m, turns, slides = load(work, at), splat(turns), splat(slides)
    lever = cross(get3(work, at + LANES), axis)
    return (
        plus(times(inertia_times(work, at, axis), turns), times(lever, slides)),
        minus(times(times(axis, m), slides), times(lever, turns)),
    )


@numba.njit(forceinline=True)
def outwards(work, tree, q, first, stride):
    """Write the places of all bodies and their own inertias, outwards."""
    bodies = len(tree.parent)
    places, inertias = tree.places, tree.inertias
    one, zero = splat(1.0), splat(0.0)
    put3(work, places, (one, zero, zero))
    put3(work, places + 3 * LANES, (zero, one, zero))
    put3(work, places + 6 * LANES, (zero, zero, one))
    _inertia(work, inertias, places, tree.bodies[0])
    for body in range(1, bodies):
        at = places + body * PLACE * LANES
        start = first + tree.index[body]
        value = gather(q, start, stride)
        if tree.unbounded[body]:
            cosine, sine = value, gather(q, start + 1, stride)
        elif tree.turns[body] != 0.0:
            cosine, sine = _cosine_and_sine(splat(tree.turns[body]) * value)
        else:
            cosine, sine = one, zero
        shift = splat(tree.slides[body]) * value
        above = places + tree.parent[body] * PLACE * LANES
        _place(work, at, above, tree.fixed[body], cosine, sine, shift)
        _inertia(work, inertias + body * INERTIA * LANES, at, tree.bodies[body])


@numba.njit(forceinline=True)
def inwards(work, tree):
    """Write the packed M, and turn the inertias into composite ones, inwards."""
    bodies = len(tree.parent)
    places, inertias, packed = tree.places, tree.inertias, tree.packed
    zero = splat(0.0)
    for index in range(tree.entries):
        store(work, packed + index * LANES, zero)
    pair = 0
    for body in range(bodies - 1, 0, -1):
        at = inertias + body * INERTIA * LANES
        place = places + body * PLACE * LANES
        z = get3(work, place + 6 * LANES)
        moment, force = _momentum(work, at, z, tree.turns[body], tree.slides[body])
        _carry(work, at, inertias + tree.parent[body] * INERTIA * LANES, place)
        above = body
        while above > 0:
            place = places + above * PLACE * LANES
            z = get3(work, place + 6 * LANES)
            value = splat(tree.turns[above]) * dot(z, moment)
            value = value + splat(tree.slides[above]) * dot(z, force)
            add(work, packed + tree.target[pair] * LANES, splat(tree.share[pair]) * value)
            pair += 1
            # The moment about the parent's joint.
            moment = plus(moment, cross(get3(work, place + 9 * LANES), force))
            above = tree.parent[above]
        start, share = packed + tree.target[pair] * LANES, splat(tree.share[pair])
        pair += 1
        add3(work, start, times(moment, share))
        add3(work, start + 3 * LANES, times(force, share))
    # The base's block (I, [m c]x, m), packed as the rows of a chain of six coordinates.
    m = load(work, inertias)
    hx, hy, hz = get3(work, inertias + LANES)
    xx, xy, xz = get3(work, inertias + 4 * LANES)
    yy, yz, zz = get3(work, inertias + 7 * LANES)
    own = (xx, xy, yy, xz, yz, zz)
    for index in range(6):
        store(work, packed + index * LANES, own[index])
    linear = (
        zero,
        hz,
        zero - hy,
        m,
        zero - hz,
        zero,
        hx,
        zero,
        m,
        hy,
        zero - hx,
        zero,
        zero,
        zero,
        m,
    )
    for index in range(15):
        store(work, packed + (6 + index) * LANES, linear[index])
    for index in range(len(tree.row)):
        at = packed + (tree.row[index] + tree.depth[index]) * LANES
        add(work, at, splat(tree.armature[index]))
