"""The exact solution of a linear model over a sample, its input held."""

import numpy as np

from fflin.base.validation import Array

# Of the commutator-free method of order four (10.3): its Gauss nodes, and how much the one and the
# other count in the first of its two exponentials; in the second it is the other way round.
GAUSS = (0.5 - 3.0**0.5 / 6.0, 0.5 + 3.0**0.5 / 6.0)
HEAVY, LIGHT = 0.5 + 3.0**0.5 / 3.0, 0.5 - 3.0**0.5 / 3.0


def held_exponential(A: Array, driven: Array, h: float) -> tuple[Array, Array]:
    r"""Return :math:`e^{A h}` (n, n) and :math:`\int_0^h e^{A s}\,ds\,B` (n, k) of B = `driven`."""
    n, k = driven.shape
    with np.errstate(over="ignore", invalid="ignore"):
        if not (A @ A).any():
            return np.eye(n) + A * h, driven * h + A @ driven * (h * h / 2.0)
        from scipy.linalg import expm

        block = np.zeros((n + k, n + k))
        block[:n, :n], block[:n, n:] = A, driven
        exponential = expm(block * h)
        return exponential[:n, :n], exponential[:n, n:]
