"""Minimum-norm solution of linear equations with one-sided unknowns."""

import numpy as np

from fflin.base.validation import Array, Indices

EPS = float(np.finfo(float).eps)

# Largest magnitude that counts as zero. It is relative for residual forces, stiffnesses and
# thrusts, and absolute for the rates of q_b [1/s] and r_b [m/s].
TOLERANCE = 1e-9


def least_norm(
    C: Array, d: Array, one_sided: Indices | list[int]
) -> tuple[Array, Array]:
    """Return the minimum-norm u that minimises ``|C u - d|``, and the residual ``C u - d``.

    The constraint is ``u[one_sided] >= 0``.
    """
    u = _pseudo_solve(C, d)
    if (u[one_sided] < 0.0).any():
        from fflin.kernel.allocation import nearest

        least, most = np.full((2, len(u)), [[-np.inf], [np.inf]])
        least[one_sided] = 0.0
        bounded = nearest(C, d, least, most)
        # Solve again without bounds, and without the one-sided inputs that are zero. The second
        # solution has smaller rounding errors than the bounded solution.
        pushing = (least < 0.0) | (
            bounded > TOLERANCE * np.abs(bounded).max(initial=0.0)
        )
        u = np.zeros(len(u))
        u[pushing] = _pseudo_solve(C[:, pushing], d)
        if (u[one_sided] < 0.0).any():
            u = bounded
    return u, C @ u - d


def _pseudo_solve(C: Array, d: Array) -> Array:
    """Return the minimum-norm u that minimises ``|C u - d|``."""
    u: Array = np.linalg.lstsq(C, d, rcond=None)[0]
    u += np.linalg.lstsq(C, d - C @ u, rcond=None)[0]
    # Set inputs below the rounding error of the largest input to zero, because they are only noise.
    u[np.abs(u) <= 16.0 * EPS * float(np.abs(u).max(initial=0.0))] = 0.0
    return u
