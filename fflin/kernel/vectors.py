"""Operations on numbers, vectors (3), spatial vectors, attitudes and displacements.

All functions of the kernel are written in Python. The Python engine calls some of these functions
directly, with arrays or lists that have one axis. In the Python engine, a function computes one
number at a time, and a debugger can step through the function. `kernel.machine_code` compiles the
same functions, also for arrays with a second axis of eight lanes. In compiled code, other
operations replace `load`, `store`, `chosen`, `below`, `floor`, `whole`, `root` and `angle`.

A spatial vector is a pair of vectors: (angular, linear) velocity, or (moment, force). A
displacement has the order of the state: first the base's rotation and translation in base axes,
then the displacements of the joints.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TypeAlias, TypeVar

import numpy as np

from fflin.base.validation import Array

# Number of terms of a series. For rotations of the base by at most 1.9 rad, the series are exact to
# machine precision. In one step, the base rotates by less than 1 rad about each of its axes.
_TERMS = 10

F = TypeVar("F", bound=Callable[..., object])

# One number; in compiled code, one number or eight lanes.
Number: TypeAlias = float
# Numbers in memory. Lists are allowed, because Python reads an entry of a list faster than an entry
# of an array.
Entries: TypeAlias = Array | list[Number]

# Functions of the kernel that numba does not inline. All other functions are inlined into their
# callers.
CALLED: set[Callable[..., object]] = set()
# {function: function or operation that compiled code calls instead}.
IN_PLACE: dict[Callable[..., object], Callable[..., object]] = {}


def called(function: F) -> F:
    """Mark a rarely called function that numba must not inline, to save compile time."""
    CALLED.add(function)
    return function


def compiled_as(loop: Callable[..., object]) -> Callable[[F], F]:
    """Return a decorator for a NumPy function; compiled code calls `loop` instead of it.

    NumPy is fast in Python, and `loop` is fast after compilation. The decorated function itself is
    unchanged.
    """

    def register(function: F) -> F:
        IN_PLACE[function] = called(loop)
        return function

    return register


floor, whole, root, angle = np.floor, np.rint, np.sqrt, math.atan2


def load(array: Entries, index: int) -> Number:
    """Return an entry of an array: one number, or one number per lane."""
    return array[index]


def store(array: Entries, index: int, value: Number) -> None:
    """Write one number, or one number per lane, at an index."""
    array[index] = value


def chosen(left: Number, right: Number, if_less: Number, otherwise: Number) -> Number:
    """Return `if_less` if left < right, else `otherwise`, lane by lane.

    A comparison with NaN is false.
    """
    return if_less if left < right else otherwise


def below(value: Number, bound: Number) -> bool:
    """Return whether a number is less than a bound, in all lanes; false if a number is NaN."""
    return value < bound


def peek(array: Array, index: int, lane: int) -> float:
    """Return the entry of one lane at an index."""
    value: float = array[index] if array.ndim == 1 else array[index, lane]
    return value


def poke(array: Array, index: int, lane: int, value: float) -> None:
    """Write the entry of one lane at an index."""
    if array.ndim == 1:
        array[index] = value
    else:
        array[index, lane] = value


def lane_count(array: Array) -> int:
    """Return the number of lanes of an array, 0 if the array is empty."""
    return array.size // max(len(array), 1)


def get3(work, at):
    """Read a vector."""
    return load(work, at), load(work, at + 1), load(work, at + 2)


def put3(work, at, a):
    """Write a vector."""
    store(work, at, a[0])
    store(work, at + 1, a[1])
    store(work, at + 2, a[2])


def copy(source, first, target, to, count):
    """Copy `count` entries."""
    for index in range(count):
        store(target, to + index, load(source, first + index))


def clear(target, to, count):
    """Set `count` entries to zero."""
    for index in range(count):
        store(target, to + index, 0.0)


def add(work, at, value):
    """Add a value to an entry."""
    store(work, at, load(work, at) + value)


def add3(work, at, a):
    """Add a vector to three entries."""
    add(work, at, a[0])
    add(work, at + 1, a[1])
    add(work, at + 2, a[2])


def get6(work, at):
    """Read a spatial vector."""
    return get3(work, at), get3(work, at + 3)


def put6(work, at, s):
    """Write a spatial vector."""
    put3(work, at, s[0])
    put3(work, at + 3, s[1])


def add6(work, at, s):
    """Add a spatial vector to six entries."""
    add3(work, at, s[0])
    add3(work, at + 3, s[1])


def get_columns(work, at):
    """Read a matrix of three columns."""
    return get3(work, at), get3(work, at + 3), get3(work, at + 6)


def cross(a, b):
    """Return a x b."""
    return (
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    )


def dot(a, b):
    """Return a . b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def plus(a, b):
    """Return a + b."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def minus(a, b):
    """Return a - b."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def times(a, value):
    """Return a vector times a number."""
    return a[0] * value, a[1] * value, a[2] * value


def product(columns, a):
    """Return M a for the matrix M with the given columns."""
    return plus(
        plus(times(columns[0], a[0]), times(columns[1], a[1])), times(columns[2], a[2])
    )


def across(columns, a):
    """Return M^T a for the matrix M with the given columns."""
    return dot(columns[0], a), dot(columns[1], a), dot(columns[2], a)


def dot6(s, t):
    """Return the scalar product of a motion vector and a force vector, in either order."""
    return dot(s[0], t[0]) + dot(s[1], t[1])


def plus6(s, t):
    """Return s + t of spatial vectors."""
    return plus(s[0], t[0]), plus(s[1], t[1])


def minus6(s, t):
    """Return s - t of spatial vectors."""
    return minus(s[0], t[0]), minus(s[1], t[1])


def times6(s, value):
    """Return a spatial vector times a number."""
    return times(s[0], value), times(s[1], value)


def cosine_and_sine(x):
    """Return the cosine and sine of x, accurate to one unit in the last place for |x| < 1e6.

    A multiple of pi/2 is subtracted from x, so that |x| <= pi/4 (Cody-Waite reduction). For
    accuracy, pi/2 is the sum of three numbers. For |x| <= pi/4, polynomials approximate the cosine
    and the sine. All coefficients are from fdlibm (Sun Microsystems, 1993).
    """
    quarters = floor(x * (2.0 / np.pi) + 0.5)  # multiple of pi/2
    x = x - quarters * 1.57079632673412561417e00
    x = x - quarters * 6.07710050630396597660e-11
    x = x - quarters * 2.02226624879595063154e-21
    z = x * x
    p = -2.50507602534068634195e-08 + z * 1.58969099521155010221e-10
    p = 2.75573137070700676789e-06 + z * p
    p = -1.98412698298579493134e-04 + z * p
    p = 8.33333333332248946124e-03 + z * p
    p = -1.66666666666666324348e-01 + z * p
    sine = x + x * z * p
    p = 2.08757232129817482790e-09 + z * -1.13596475577881948265e-11
    p = -2.75573143513906633035e-07 + z * p
    p = 2.48015872894767294178e-05 + z * p
    p = -1.38888888888741095749e-03 + z * p
    p = 4.16666666666666019037e-02 + z * p
    cosine = (1.0 - 0.5 * z) + z * z * p
    # Add the multiple of pi/2 again, by the angle sum formulas. Its cosine c and sine s are (1, 0),
    # (0, 1), (-1, 0) or (0, -1). They are computed without branches, because lanes may differ:
    # `is_odd` and `half_is_odd` are 0 or 1, and `sign` is negative after an odd number of half
    # turns.
    halves = floor(quarters * 0.5)
    is_odd = quarters - halves - halves
    half_is_odd = halves - 2.0 * floor(halves * 0.5)
    sign = 1.0 - 2.0 * half_is_odd
    c = sign * (1.0 - is_odd)
    s = sign * is_odd
    return c * cosine - s * sine, s * cosine + c * sine


def _series(first):
    """Return the function of x that computes sum_k (-x)^k first! / (first + 2 k)!."""
    shares = [
        (-1) ** k * math.factorial(first) / math.factorial(first + 2 * k)
        for k in range(_TERMS)
    ]
    last = shares[-1]
    rest = tuple(shares[-2::-1])

    def series(x):
        total = rest[0] + x * last
        for share in rest[1:]:
            total = share + x * total
        return total

    return series


_cosine, _sine, _sixth = _series(0), _series(1), _series(3)


def quaternion_times(a, b):
    """Return the product of quaternions, each given as ((x, y, z), w)."""
    v, w = a
    other, scalar = b
    vector = plus(cross(v, other), plus(times(v, scalar), times(other, w)))
    return vector, w * scalar - dot(v, other)


def columns_of(quaternion):
    """Return the columns of a unit quaternion's rotation matrix."""
    (x, y, z), w = quaternion
    xx, yy, zz = 2.0 * x * x, 2.0 * y * y, 2.0 * z * z
    xy, xz, yz = 2.0 * x * y, 2.0 * x * z, 2.0 * y * z
    wx, wy, wz = 2.0 * w * x, 2.0 * w * y, 2.0 * w * z
    return (
        (1.0 - yy - zz, xy + wz, xz - wy),
        (xy - wz, 1.0 - xx - zz, yz + wx),
        (xz + wy, yz - wx, 1.0 - xx - yy),
    )


def attitude(q, at=0):
    """Return the base's quaternion from the configuration q that begins at the index `at`."""
    return get3(q, at + 3), load(q, at + 6)


def axes_of(q):
    """Return the columns of the base's rotation matrix: the base's axes in world coordinates."""
    return columns_of(attitude(q))


def combine(shares, row, rates, out):
    """Write the sum of the rows of `rates`, with the weights in a row of `shares`.

    The first row of `rates` is the value of nu, or of the state z of a filter, at the start of the
    step. The other rows are the time derivatives of nu, or of z, at the stages.
    """
    size = len(out)
    count = len(rates) // size
    for index in range(size):
        total = load(shares, row * count) * load(rates, index)
        for stage in range(1, count):
            part = load(rates, stage * size + index)
            total = total + load(shares, row * count + stage) * part
        store(out, index, total)


def displace(tree, q, along, out):
    """Displace q by the tangent vector `along`, and write the result into `out`.

    The base moves by the exponential map.
    """
    w, v = get3(along, 0), get3(along, 3)
    square = dot(w, w)
    quarter = 0.25 * square
    # sin(a/2) / (a/2) and cos(a/2), with a = |w|
    sine, cosine = _sine(quarter), _cosine(quarter)
    shift = plus(times(v, sine * cosine), times(cross(w, v), 0.5 * sine * sine))
    shift = plus(shift, times(w, dot(w, v) * _sixth(square) * (1.0 / 6.0)))
    quaternion = attitude(q)
    put3(out, 0, plus(get3(q, 0), product(axes_of(q), shift)))
    vector, scalar = quaternion_times(quaternion, (times(w, 0.5 * sine), cosine))
    short = 1.5 - 0.5 * (dot(vector, vector) + scalar * scalar)
    put3(out, 3, times(vector, short))
    store(out, 6, scalar * short)
    for body in range(1, len(tree.parent)):
        at = tree.index[body]
        value = tree.factor[body] * load(along, tree.coordinate[body])
        if tree.unbounded[body]:
            c, s = load(q, at), load(q, at + 1)
            cosine, sine = cosine_and_sine(value)
            c, s = c * cosine - s * sine, s * cosine + c * sine
            short = 1.5 - 0.5 * (c * c + s * s)
            store(out, at, c * short)
            store(out, at + 1, s * short)
        else:
            store(out, at, load(q, at) + value)
