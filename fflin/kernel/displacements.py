"""Attitudes, and displacements of a configuration along its tangent.

A displacement has the order of the state: the base's rotation and translation in base axes, then
the joints.
"""

from __future__ import annotations

from fractions import Fraction
from math import factorial

from fflin.kernel.inertia import cosine_and_sine
from fflin.kernel.lanes import inlined, load, store
from fflin.kernel.rnea import motion_cross
from fflin.kernel.vectors import (
    copy,
    cross,
    dot,
    get3,
    get6,
    plus,
    plus6,
    product,
    put3,
    put6,
    times,
    times6,
)

_TERMS = 10  # exact to rounding up to half a turn, and the turn of a step is less than a radian


def _polynomial(shares):
    """Return the function sum_k shares_k x^k."""
    last, rest = shares[-1], tuple(shares[-2::-1])

    @inlined
    def polynomial(x):
        total = rest[0] + x * last
        for share in rest[1:]:
            total = share + x * total
        return total

    return polynomial


def _series(first):
    """Return the function sum_k (-x)^k first! / (first + 2 k)!."""
    return _polynomial(
        [(-1) ** k * factorial(first) / factorial(first + 2 * k) for k in range(_TERMS)]
    )


def _signed_bernoulli():
    """Return (-1)^k B_2k / (2k)! of Bernoulli's numbers."""
    ratios = [Fraction(1)]
    for m in range(1, 2 * _TERMS + 3):
        ratios.append(-sum(ratios[j] / factorial(m + 1 - j) for j in range(m)))
    return [float((-1) ** k * ratio) for k, ratio in enumerate(ratios[::2])]


_cosine, _sine, _sixth = _series(0), _series(1), _series(3)
_second = _polynomial([(k - 2) * b for k, b in enumerate(_signed_bernoulli())][1:])
_fourth = _polynomial([(k - 1) * b for k, b in enumerate(_signed_bernoulli())][2:])


@inlined
def quaternion_times(a, b):
    """Return the product of quaternions (x, y, z, w) that are pairs of a vector and a scalar."""
    v, w = a
    other, scalar = b
    vector = plus(cross(v, other), plus(times(v, scalar), times(other, w)))
    return vector, w * scalar - dot(v, other)


@inlined
def columns_of(quaternion):
    """Return the columns of a unit quaternion's rotation."""
    (x, y, z), w = quaternion
    xx, yy, zz = 2.0 * x * x, 2.0 * y * y, 2.0 * z * z
    xy, xz, yz = 2.0 * x * y, 2.0 * x * z, 2.0 * y * z
    wx, wy, wz = 2.0 * w * x, 2.0 * w * y, 2.0 * w * z
    return (
        (1.0 - yy - zz, xy + wz, xz - wy),
        (xy - wz, 1.0 - xx - zz, yz + wx),
        (xz + wy, yz - wx, 1.0 - xx - yy),
    )


@inlined
def attitude(q):
    """Return the base's quaternion in a configuration."""
    return get3(q, 3), load(q, 6)


@inlined
def axes_of(q):
    """Return the base's axes in the world."""
    return columns_of(attitude(q))


@inlined
def turn_back(along, nu):
    """Turn the base's velocity at a displacement into the rate of that displacement.

    The inverse of dexp, sum_k B_2k / (2k)! ad^2k + ad / 2, whose series ends by
    (ad^2 + |w|^2)^2 ad = 0.
    """
    x, y = get6(along, 0), get6(nu, 0)
    square = dot(x[0], x[0])
    once = motion_cross(x, y)
    twice = motion_cross(x, once)
    fourth = motion_cross(x, motion_cross(x, twice))
    total = plus6(y, times6(once, 0.5))
    total = plus6(total, times6(twice, _second(square)))
    put6(along, 0, plus6(total, times6(fourth, _fourth(square))))
    copy(nu, 6, along, 6, len(along) - 6)


@inlined
def displace(tree, q, along, out):
    """Write q displaced along a tangent vector, the base by its exponential."""
    w, v = get3(along, 0), get3(along, 3)
    square = dot(w, w)
    quarter = 0.25 * square
    sine, cosine = _sine(quarter), _cosine(quarter)  # sin(a/2) / (a/2), cos(a/2)
    shift = plus(times(v, sine * cosine), times(cross(w, v), 0.5 * sine * sine))
    shift = plus(shift, times(w, dot(w, v) * _sixth(square) * (1.0 / 6.0)))
    quaternion = attitude(q)
    put3(out, 0, plus(get3(q, 0), product(axes_of(q), shift)))
    vector, scalar = quaternion_times(quaternion, (times(w, 0.5 * sine), cosine))
    short = 1.5 - 0.5 * (dot(vector, vector) + scalar * scalar)
    put3(out, 3, times(vector, short))
    store(out, 6, scalar * short)
    for body in range(1, len(tree.parent)):
        at, value = tree.index[body], tree.factor[body] * load(along, tree.coordinate[body])
        if tree.unbounded[body]:
            c, s = load(q, at), load(q, at + 1)
            cosine, sine = cosine_and_sine(value)
            c, s = c * cosine - s * sine, s * cosine + c * sine
            short = 1.5 - 0.5 * (c * c + s * s)
            store(out, at, c * short)
            store(out, at + 1, s * short)
        else:
            store(out, at, load(q, at) + value)
