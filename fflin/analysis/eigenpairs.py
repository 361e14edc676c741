"""Eigenpairs of a linear model: from its stiffness at rest, or from A without its zeros."""

from __future__ import annotations

import math
from contextlib import suppress
from typing import NamedTuple

import numpy as np

from fflin.analysis.mechanics import floating_inertia, warn_of_stiffness
from fflin.analysis.ranks import EPS, Values
from fflin.base.validation import Array
from fflin.linear.model import LinearModel

# A stiffness less than this part of the largest, both scaled to unit inertias, counts as zero:
# modes below 3e-7 of the highest frequency are rigid.
_NO_STIFFNESS = 1e-13


class Eigenpair(NamedTuple):
    """A pole of A that is not zero, with a positive imaginary part if it is one of a pair."""

    pole: complex
    shape: Values  # (nx,)
    margin: float  # real part as a multiple of its rounding error


class NaturalModes(NamedTuple):
    """Eigenpairs of A, with the numbers of `Modes`."""

    pairs: list[Eigenpair]
    rigid_body: int
    zeros: int
    residual: float = 0.0


def natural_modes(lin: LinearModel) -> NaturalModes:
    """Find the natural modes of a continuous model of positions and their rates."""
    warn_of_stiffness(lin)
    nv, inertia = len(lin.M), np.sqrt(lin.M.diagonal())
    # Derivatives that are rounding errors of inputs that cancel each other are zero.
    A = lin.A.copy()
    by_position, rounding = A[nv:, :nv], np.abs(lin.B[nv:]) @ np.abs(lin.u0)
    by_position[np.abs(by_position) <= 1e2 * EPS * rounding[:, None]] = 0.0
    # With these weights of the states, A has entries of the size of the fastest rate.
    rates = np.abs(np.tile(inertia, 2)[:, None] * A / np.tile(inertia, 2))
    turning = max(float(rates[nv:, nv:].max()), float(rates[:nv, :nv].max()))
    fastest = max(float(rates[nv:, :nv].max()) ** 0.5, turning) or 1.0
    weight = np.concatenate((fastest * inertia, inertia))
    found = _free_free(A, lin.M, inertia) or _general(A, weight, fastest)
    residual = 0.0
    for pole, shape, _ in found.pairs:
        left = weight * (A @ shape - pole * shape) / fastest
        residual = max(residual, float(np.linalg.norm(left) / np.linalg.norm(weight * shape)))
    return found._replace(residual=residual)


def _free_free(A: Array, M: Array, inertia: Array) -> NaturalModes | None:
    """Return the modes of a body at rest with symmetric stiffness; None for any other model."""
    nv = len(M)
    N, slope = A[:nv, nv:], A[nv:, :nv] @ A[:nv, nv:]
    if A[:nv, :nv].any() or A[nv:, nv:].any():
        return None
    # In quasi-coordinates s, with p = N s and ds/dt = nu, scaled to a unit diagonal of M.
    unit = M / np.outer(inertia, inertia)
    by_s = slope * inertia[:, None] / inertia
    K = -unit @ by_s
    size = float(np.abs(K).max(initial=0.0))
    rounding = 1e2 * EPS * float(np.linalg.cond(unit))
    if not np.abs(K - K.T).max(initial=0.0) <= rounding * size:
        return None
    felt = np.flatnonzero(by_s.any(axis=0))
    if not felt.size:
        return NaturalModes([], nv, 2 * nv)
    M_star = floating_inertia(unit, felt, np.setdiff1d(np.arange(nv), felt))
    K = -M_star @ by_s[np.ix_(felt, felt)]
    # Of the pencil K - omega^2 M*, by M* = L L^T.
    inverse = np.linalg.inv(np.linalg.cholesky((M_star + M_star.T) / 2.0))
    squares, vectors = np.linalg.eigh(inverse @ (K + K.T) / 2.0 @ inverse.T)
    vectors = inverse.T @ vectors
    # The Schur complement rounds by the condition of M, while A is exact to the last digits: one
    # Newton step to the eigenpairs of A itself. Vectors of equal frequencies are not mixed, since
    # any combination of them is a mode.
    defect = -np.linalg.solve(vectors, by_s[np.ix_(felt, felt)] @ vectors) - np.diag(squares)
    gaps = squares - squares[:, None]
    apart = np.abs(defect) < 1e-3 * np.abs(gaps)
    mixed = np.divide(defect, gaps, out=np.zeros_like(defect), where=apart)
    squares, vectors = squares + defect.diagonal(), vectors + vectors @ mixed
    found: list[Eigenpair] = []
    for square, vector in zip(squares.tolist(), vectors.T, strict=True):
        if abs(square) <= _NO_STIFFNESS * len(felt) * float(np.abs(squares).max()):
            continue
        # The coordinates without stiffness follow from -omega^2 s = (d nudot/ds) s.
        s = by_s[:, felt] @ vector / inertia
        root = abs(square) ** 0.5
        for pole in [1j * root] if square > 0.0 else [complex(root), complex(-root)]:
            shape = np.concatenate((N @ s, pole * s))
            margin = math.copysign(math.inf, pole.real) if pole.real else 0.0
            found.append(Eigenpair(pole, shape, margin))
    counted = sum(2 if pair.pole.imag else 1 for pair in found)
    return NaturalModes(found, nv - counted // 2, 2 * nv - counted)


def _general(A: Array, weight: Array, fastest: float) -> NaturalModes:
    """Return the modes of any model, by the eigenvalues of A."""
    scaled = weight[:, None] * A / weight / fastest
    found, nullity = nonzero_eigenpairs(scaled, _NO_STIFFNESS)
    pairs: list[Eigenpair] = []
    for pole, vector, error in found:
        if pole.imag < 0.0:
            continue
        real = 0.0 if abs(pole.real) <= error and pole.imag else pole.real
        value = complex(real, pole.imag) * fastest
        pairs.append(Eigenpair(value, vector / weight, pole.real / error))
    return NaturalModes(pairs, nullity, len(weight) - len(found))


def nonzero_eigenpairs(
    A: Array, tolerance: float
) -> tuple[list[tuple[complex, Values, float]], int]:
    """Return the eigenpairs of A that are not zero, each with its rounding, and the nullity.

    With :math:`V_0, V_1` a basis of the null space and of its complement, A is replaced by
    :math:`V_1^T A V_1`, which has the other eigenvalues, until no zeros are left.
    """
    # A Jordan block of k zeros turns round-off into eigenvalues of its k-th root. A is scaled so
    # that its entries are comparable; singular values below n times the tolerance are zero.
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
            # Columns that are exactly zero are dropped as they stand: a rotation would round.
            complement = np.eye(len(A))[:, used]
        steps.append(A @ complement)
        A = complement.T @ steps[-1]
    if not len(A):
        return [], nullity
    values, right = np.linalg.eig(A)
    # y x = 1 for the left eigenvectors y; the inverse is not asked of a defective A.
    left = np.linalg.pinv(right, rcond=EPS)
    pairs: list[tuple[complex, Values, float]] = []
    for value, y, x in zip(values.tolist(), left, right.T, strict=True):
        error = 1e2 * EPS * size * min(float(np.linalg.norm(y)), 1.0 / EPS)
        if value.imag < 0.0 and pairs and pairs[-1][0] == value.conjugate():
            pairs.append((complex(value), pairs[-1][1].conj(), error))
            continue
        for step in reversed(steps):
            # As A V_0 = 0, an eigenvector V_0 a + V_1 x is A V_1 x, up to a factor.
            x = step @ x  # noqa: PLW2901 - the same vector in a larger space
        # Slow modes lost digits on the way; one inverse iteration restores them.
        near = whole - (value + EPS * size) * np.eye(n)
        with suppress(np.linalg.LinAlgError):  # the shift is an eigenvalue exactly
            x = np.linalg.solve(near, x / np.linalg.norm(x))  # noqa: PLW2901
        pairs.append((complex(value), x / np.linalg.norm(x), error))
    return pairs, nullity
