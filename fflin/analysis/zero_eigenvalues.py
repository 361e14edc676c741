"""Eigenvalues at zero, which come in Jordan blocks, split off before the others are computed."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING, Any

import numpy as np

from fflin.base.validation import Array

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Vector = NDArray[np.complexfloating[Any]]

_EPS = float(np.finfo(float).eps)


def nonzero_eigenpairs(
    A: Array, tolerance: float
) -> tuple[list[tuple[complex, Vector, float]], int]:
    r"""Return the eigenpairs of A that are not zero, and the dimension of its null space.

    A Jordan block of k zeros turns round-off into eigenvalues of :math:`\epsilon^{1/k}`. So, with
    :math:`V_0, V_1` a basis of the null space and of its complement, A is replaced by
    :math:`V_1^T A V_1`, which has the other eigenvalues, until nothing is left to split off.

    Parameters
    ----------
    A : ndarray (n, n)
        Scaled so that its entries are comparable and of the order of 1.
    tolerance : float
        Singular values below n times this are taken for zero.

    Returns
    -------
    pairs : list of (eigenvalue, eigenvector (n,), error)
        `error` bounds what rounding does to the eigenvalue: by its condition number.
    nullity : int
    """
    from scipy.linalg import eig

    n, whole = len(A), A
    size = float(np.linalg.norm(A))
    nullity = n - int(np.count_nonzero(np.linalg.svd(A, compute_uv=False) > n * tolerance))
    steps: list[Array] = []
    while len(A):
        complement = _complement(A, n * tolerance)
        if complement is None:
            break
        steps.append(A @ complement)
        A = complement.T @ steps[-1]
    if not len(A):
        return [], nullity
    values, left, right = eig(A, left=True, right=True)
    pairs = []
    for value, y, x in zip(values.tolist(), left.T, right.T, strict=True):
        error = 1e2 * _EPS * size / max(abs(np.vdot(y, x)), _EPS)
        for step in reversed(steps):
            # value (V_0 a + V_1 x) = A (V_0 a + V_1 x), and A V_0 = 0; of any size.
            x = step @ x  # noqa: PLW2901 - the same vector in a larger space
        # What slow modes lost on the way, one inverse iteration brings back.
        near = whole - (value + _EPS * size) * np.eye(n)
        with suppress(np.linalg.LinAlgError):  # singular to the last bit
            x = np.linalg.solve(near, x / np.linalg.norm(x))  # noqa: PLW2901
        pairs.append((complex(value), x / np.linalg.norm(x), error))
    return pairs, nullity


def _complement(A: Array, tolerance: float) -> Array | None:
    """Return a basis of what is orthogonal to the null space of A; None where that is empty."""
    used = A.any(axis=0)
    if not used.all():
        # Of columns that are zero exactly: without the rounding of any rotation.
        return np.eye(len(A))[:, used]
    _, singular, transposed = np.linalg.svd(A)
    rank = int(np.count_nonzero(singular > tolerance))
    return None if rank == len(A) else np.asarray(transposed[:rank].T)
