"""Eigenvalues at zero, which come in Jordan blocks, split off before the others are computed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from fflin.validation import Array

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Vector = NDArray[np.complexfloating[Any]]

_EPS = float(np.finfo(float).eps)


def nonzero_eigenpairs(
    A: Array, tolerance: float
) -> tuple[list[tuple[complex, Vector, float]], list[int]]:
    r"""Return the eigenpairs of A that are not zero, and how its zero eigenvalues are chained.

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
    dimensions : list of int
        How many Jordan blocks at zero have size 1 or more, 2 or more, ...
    """
    from scipy.linalg import eig

    n = len(A)
    size = float(np.linalg.norm(A))
    steps: list[Array] = []
    dimensions: list[int] = []
    while len(A):
        _, singular, transposed = np.linalg.svd(A)
        rank = int(np.count_nonzero(singular > n * tolerance))
        if rank == len(A):
            break
        dimensions.append(len(A) - rank)
        complement = transposed[:rank].T
        steps.append(A @ complement)
        A = complement.T @ steps[-1]
    if not len(A):
        return [], dimensions
    values, left, right = eig(A, left=True, right=True)
    pairs = []
    for value, y, x in zip(values.tolist(), left.T, right.T, strict=True):
        error = 1e2 * _EPS * size / max(abs(np.vdot(y, x)), _EPS)
        for step in reversed(steps):
            # A (V_0 a + V_1 x) = value (V_0 a + V_1 x), and A V_0 = 0.
            x = step @ x / value  # noqa: PLW2901 - the same vector in a larger space
        pairs.append((complex(value), x, error))
    return pairs, dimensions
