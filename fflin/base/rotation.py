"""Cross-product matrices, and rotations as Hamilton quaternions in the order x, y, z, w."""

import math
from typing import TypeVar

import numpy as np

from fflin.base.validation import Array

T = TypeVar("T", float, Array)

# Row 3 i + j maps a vector a to the entry (i, j) of its cross-product matrix [a]x.
_CROSS = np.zeros((9, 3))
_CROSS[[7, 2, 3], [0, 1, 2]] = 1.0
_CROSS[[5, 6, 1], [0, 1, 2]] = -1.0


def skew(a: Array) -> Array:
    """Return the cross-product matrices [a]x (..., 3, 3) of vectors, with ``[a]x b = a x b``."""
    if a.ndim == 1:
        matrix: Array = _CROSS.dot(a).reshape(3, 3)
        return matrix
    return (a @ _CROSS.T).reshape(*a.shape, 3)


def product(a: Array, b: Array) -> Array:
    """Return the matrix product ``a b`` for shapes (..., i, j) and (..., j, k)."""
    # `dot` takes half the time of `@` for two small matrices.
    return a.dot(b) if a.ndim == b.ndim == 2 else a @ b


def row_products(rows: Array, matrix: Array) -> Array:
    """Return ``rows @ matrix`` (N, k), where each row is rounded as if it were the only one.

    BLAS rounds the product of a single row differently from the product of several rows. If a run
    is computed alone and among others, its values must be equal bit for bit.
    """
    total: Array = rows[:, :1] * matrix[0]
    for index in range(1, len(matrix)):
        total = total + rows[:, index : index + 1] * matrix[index]
    return total


def quaternion_product(a: Array, b: Array) -> Array:
    """Return the Hamilton product ``a b`` (4,) of two quaternions, scaled to unit length."""
    ax, ay, az, aw = a.tolist()
    bx, by, bz, bw = b.tolist()
    x = aw * bx + ax * bw + ay * bz - az * by
    y = aw * by - ax * bz + ay * bw + az * bx
    z = aw * bz + ax * by - ay * bx + az * bw
    w = aw * bw - ax * bx - ay * by - az * bz
    norm = math.sqrt(x * x + y * y + z * z + w * w)
    return np.array((x / norm, y / norm, z / norm, w / norm))


def product_matrix(a: Array) -> Array:
    """Return the matrix (4, 4) that maps a quaternion b to the product ``a b``."""
    x, y, z, w = a.tolist()
    return np.array(((w, -z, y, x), (z, w, -x, y), (-y, x, w, z), (-x, -y, -z, w)))


def conjugate(a: Array) -> Array:
    """Return the inverse of a unit quaternion."""
    x, y, z, w = a.tolist()
    return np.array((-x, -y, -z, w))


def rotation_vectors(vector_parts: Array) -> Array:
    """Return the rotation vectors (N, 3) [rad] of unit quaternions with scalar parts >= 0.

    `vector_parts` (N, 3) are their vector parts. A linear prediction can exceed length 1, which no
    rotation has. Its angle is then pi times the length.
    """
    sines = np.minimum(1.0, np.linalg.norm(vector_parts, axis=1, keepdims=True))
    rotations: Array = vector_parts * (2.0 / np.sinc(np.arcsin(sines) / np.pi))
    return rotations


def rotation_matrix(a: Array) -> Array:
    """Return the rotation (3, 3) of a unit quaternion."""
    return np.array(rotation_rows(*a.tolist()))


def rotation_matrices(a: Array) -> Array:
    """Return the rotations (N, 3, 3) of unit quaternions (N, 4)."""
    return np.ascontiguousarray(np.array(rotation_rows(*a.T)).transpose(2, 0, 1))


def rotation_rows(x: T, y: T, z: T, w: T) -> tuple[tuple[T, T, T], ...]:
    """Return the rows of the rotation of a unit quaternion, from numbers or from arrays (N,)."""
    return (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
        (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
    )
