"""Minimum-norm and least-squares solutions with inputs that can only push."""

from __future__ import annotations

from typing import Any

import numpy as np

from fflin.base.validation import Array

_EPS = float(np.finfo(float).eps)

# Largest share of what is to be balanced that may be left over.
TOLERANCE = 1e-9


def least_norm(C: Array, d: Array, one_sided: Any) -> tuple[Array, Array]:
    """Return the least u with ``C u = d``, ``u[one_sided] >= 0``, and ``C u - d``."""
    u = _pseudo_solve(C, d)
    if (u[one_sided] < 0.0).any():
        u = _least_distance(C, u, one_sided)
        # Exactly the least on the face that was found: those that do not push stay out.
        pushing = ~one_sided | (u > TOLERANCE * float(np.abs(u).max(initial=0.0)))
        polished: Array = np.zeros(len(u))
        polished[pushing] = _pseudo_solve(C[:, pushing], d)
        left = C @ polished - d
        most = TOLERANCE * np.linalg.norm(d)
        if (polished[one_sided] < 0.0).any() or np.linalg.norm(left) > most:
            from scipy.optimize import lsq_linear

            bounds = np.where(one_sided, 0.0, -np.inf), np.inf
            polished = lsq_linear(C, d, bounds, method="bvls").x
        u = polished
    return u, C @ u - d


def _pseudo_solve(C: Array, d: Array) -> Array:
    """Return the u of least norm among those with the least ``|C u - d|``."""
    u: Array = np.linalg.lstsq(C, d, rcond=None)[0]
    u += np.linalg.lstsq(C, d - C @ u, rcond=None)[0]
    # An input below the rounding of the largest one is noise: it counts as zero.
    u[np.abs(u) <= 16.0 * _EPS * float(np.abs(u).max(initial=0.0))] = 0.0
    return u


def _least_distance(C: Array, start: Array, one_sided: Any) -> Array:
    """Return the least u = start + Z z with u[one_sided] >= 0, where C Z = 0."""
    from scipy.linalg import null_space
    from scipy.optimize import nnls

    # min |z| subject to G z >= h is solved by the residual r = E y - e of min |E y - e|, y >= 0,
    # with E = [G^T; h^T] and e = (0, ..., 0, 1): z = -r_z / r_e.
    Z = null_space(C)
    size = float(np.linalg.norm(start))
    E = np.vstack((Z[one_sided].T, -start[one_sided] / size))
    e = np.zeros(len(E))
    e[-1] = 1.0
    y = nnls(E, e, maxiter=100 * max(E.shape))[0]
    r = E @ y - e
    # r_e = -|r|^2, and zero where the inequalities contradict each other.
    z = -r[:-1] / r[-1] if r[-1] < -TOLERANCE else np.zeros(Z.shape[1])
    u: Array = start + Z @ (size * z)
    return np.where(one_sided, np.maximum(u, 0.0), u)
