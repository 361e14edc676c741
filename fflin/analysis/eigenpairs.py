"""Eigenvalues of A that are not zero, with their eigenvectors."""

from __future__ import annotations

from contextlib import suppress
from typing import NamedTuple

import numpy as np

from fflin.analysis.ranks import EPS
from fflin.base.validation import Array, Values
from fflin.linear.model import LinearModel

# With coordinates scaled to unit inertias, a stiffness below this fraction of the largest stiffness
# counts as zero. Modes below 3e-7 of the highest frequency are therefore rigid-body modes.
_NO_STIFFNESS = 1e-13


class Eigenpair(NamedTuple):
    """Nonzero pole of A with its mode shape; a conjugate pair has one entry, with Im > 0."""

    pole: complex
    shape: Values  # (nx,)
    margin: float  # real part as a multiple of its rounding error


class NaturalModes(NamedTuple):
    """Eigenpairs of A, and the counts and residual that `Modes` reports."""

    pairs: list[Eigenpair]
    rigid_body: int
    zeros: int
    residual: float


def natural_modes(lin: LinearModel) -> NaturalModes:
    """Return the natural modes of a continuous model whose states are positions and their rates."""
    nv, inertia = len(lin.M), np.sqrt(lin.M.diagonal())
    # Input forces that cancel each other leave rounding errors in the derivatives. Derivatives of
    # this size are set to zero.
    A = lin.A.copy()
    by_position, rounding = A[nv:, :nv], np.abs(lin.B[nv:]) @ np.abs(lin.u0)
    by_position[np.abs(by_position) <= 1e2 * EPS * rounding[:, None]] = 0.0
    # Scale the states and the time so that the largest entries of A are about 1.
    rates = np.abs(np.tile(inertia, 2)[:, None] * A / np.tile(inertia, 2))
    turning = max(float(rates[nv:, nv:].max()), float(rates[:nv, :nv].max()))
    fastest = max(float(rates[nv:, :nv].max()) ** 0.5, turning) or 1.0
    weight = np.concatenate((fastest * inertia, inertia))
    found, nullity = nonzero_eigenpairs(weight[:, None] * A / weight / fastest, _NO_STIFFNESS)
    pairs, residual = list[Eigenpair](), 0.0
    for scaled_pole, vector, error in found:
        if scaled_pole.imag < 0.0:
            continue
        oscillates = abs(scaled_pole.real) <= error and scaled_pole.imag
        pole = complex(0.0 if oscillates else scaled_pole.real, scaled_pole.imag) * fastest
        shape = vector / weight
        pairs.append(Eigenpair(pole, shape, scaled_pole.real / error))
        left = weight * (A @ shape - pole * shape) / fastest
        residual = max(residual, float(np.linalg.norm(left) / np.linalg.norm(weight * shape)))
    return NaturalModes(pairs, nullity, 2 * nv - len(found), residual)


def nonzero_eigenpairs(
    A: Array, tolerance: float
) -> tuple[list[tuple[complex, Values, float]], int]:
    """Return (pole, eigenvector, rounding error) of each nonzero pole of A, and the nullity of A.

    A is repeatedly replaced by :math:`V_1^T A V_1`, where the columns of :math:`V_1` are
    orthonormal and orthogonal to the null space of A. Each step removes zero eigenvalues only. The
    steps end when A is nonsingular.
    """
    # Rounding moves the k zero eigenvalues of a Jordan block by the k-th root of the rounding
    # error. Zeros are therefore removed before eigenvalues are computed. The caller scales A to
    # comparable entries. Singular values below n times the tolerance count as zero.
    n, whole = len(A), A
    size = float(np.linalg.norm(A))
    nullity = n - int(np.count_nonzero(np.linalg.svd(A, compute_uv=False) > n * tolerance))
    steps: list[Array] = []
    while len(A):
        used = A.any(axis=0)
        if used.all():
            _, singular, transposed = np.linalg.svd(A)
            rank = int(np.count_nonzero(singular > n * tolerance))
            if rank == len(A):
                break
            complement = np.asarray(transposed[:rank].T)
        else:
            # Columns that are exactly zero are removed directly, because a rotation would add
            # rounding errors.
            complement = np.eye(len(A))[:, used]
        steps.append(A @ complement)
        A = complement.T @ steps[-1]
    if not len(A):
        return [], nullity
    values, right = np.linalg.eig(A)
    # The left eigenvectors y are scaled to y x = 1. If A is defective, `right` has no inverse, so
    # the pseudoinverse is used.
    left = np.linalg.pinv(right, rcond=EPS)
    pairs: list[tuple[complex, Values, float]] = []
    for value, y, x in zip(values.tolist(), left, right.T, strict=True):
        error = 1e2 * EPS * size * min(float(np.linalg.norm(y)), 1.0 / EPS)
        if value.imag < 0.0 and pairs and pairs[-1][0] == value.conjugate():
            pairs.append((complex(value), pairs[-1][1].conj(), error))
            continue
        for step in reversed(steps):
            # An eigenvector x of V_1^T A V_1 gives the eigenvector A V_1 x of A, up to a factor.
            x = step @ x  # noqa: PLW2901 - the same vector in a larger space
        x /= np.linalg.norm(x)  # noqa: PLW2901
        # Slow modes lose accuracy in these steps; one inverse iteration restores it.
        if np.linalg.norm(whole @ x - value * x) > 1e2 * EPS * abs(value):
            near = whole - (value + EPS * size) * np.eye(n)
            with suppress(np.linalg.LinAlgError):  # singular if the shift is an eigenvalue
                x = np.linalg.solve(near, x)  # noqa: PLW2901
        pairs.append((complex(value), x / np.linalg.norm(x), error))
    return pairs, nullity
