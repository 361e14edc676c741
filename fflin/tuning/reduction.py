"""Controllers of lower order by balanced truncation of their states in the closed loop.

See P. M. R. Wortelboer, Frequency-weighted balanced reduction of closed-loop mechanical servo
systems, PhD thesis, TU Delft, 1994.
"""

from __future__ import annotations

import numpy as np

from fflin.base.validation import Array

System = tuple[Array, Array, Array, Array]

# States of the balanced controller whose relative size is smaller are left out.
_NEGLIGIBLE = 1e-12


def truncations(law: System, loop: System) -> list[System]:
    """Return the controllers of all lower orders, the lowest first.

    The last states of the stable closed loop `loop` are the states of the controller. Its Gramians
    in the loop are balanced, so that the states that affect the outputs of the loop least are left
    out first. The controller itself may be unstable.
    """
    from scipy.linalg import solve_continuous_lyapunov

    A, B, C, D = law
    n = len(A)
    last = slice(len(loop[0]) - n, None)
    P = solve_continuous_lyapunov(loop[0], -loop[1] @ loop[1].T)[last, last]
    Q = solve_continuous_lyapunov(loop[0].T, -loop[2].T @ loop[2])[last, last]
    left, right = _factor(Q), _factor(P)
    U, sizes, Vt = np.linalg.svd(left.T @ right)
    kept = int((sizes > _NEGLIGIBLE * sizes.max(initial=0.0)).sum())
    results = []
    for order in range(min(kept, n - 1) + 1):
        scales = 1.0 / np.sqrt(sizes[:order])
        to_states = right @ Vt[:order].T * scales
        from_states = (left @ U[:, :order] * scales).T
        results.append((from_states @ A @ to_states, from_states @ B, C @ to_states, D))
    return results


def _factor(gramian: Array) -> Array:
    """Return L with L L' equal to a positive semidefinite matrix."""
    sizes, vectors = np.linalg.eigh(0.5 * (gramian + gramian.T))
    factor: Array = vectors * np.sqrt(np.maximum(sizes, 0.0))
    return factor
