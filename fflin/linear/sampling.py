"""Exact solution of a linear model over a sample, with its input held constant."""

import math

import numpy as np

from fflin.base.validation import Array

# Of the commutator-free method of order four (10.3): its Gauss nodes, and how much the one and the
# other count in the first of its two exponentials; in the second it is the other way round.
GAUSS = (0.5 - 3.0**0.5 / 6.0, 0.5 + 3.0**0.5 / 6.0)
HEAVY, LIGHT = 0.5 + 3.0**0.5 / 3.0, 0.5 - 3.0**0.5 / 3.0


def held_exponential(A: Array, driven: Array, h: float | Array) -> tuple[Array, Array]:
    r"""Return :math:`e^{A h}` (n, n) and :math:`\int_0^h e^{A s}\,ds\,B` (n, k) of B = `driven`.

    Rows of matrices (.., n, n) and (.., n, k) may be given, with the times h (..) of each.
    """
    n, k = driven.shape[-2:]
    h = np.asarray(h)[..., None, None]
    with np.errstate(over="ignore", invalid="ignore"):
        if not (A @ A).any():
            return np.eye(n) + A * h, driven * h + A @ driven * (h * h / 2.0)
        from scipy.linalg import expm

        block = np.zeros((*A.shape[:-2], n + k, n + k))
        block[..., :n, :n], block[..., :n, n:] = A, driven
        exponential = expm(block * h)
        return exponential[..., :n, :n], exponential[..., :n, n:]


def held_derivatives(
    A: Array, driven: Array, h: float, dA: Array, d_driven: Array
) -> tuple[Array, ...]:
    """Return the derivatives of `held_exponential` along (dA, d_driven)."""
    n = len(A)
    if not dA.any() and not (A @ A).any():
        return np.zeros_like(A), d_driven * h + A @ d_driven * (h * h / 2.0)
    from scipy.linalg import expm_frechet

    block, along = np.zeros((2, n + driven.shape[1], n + driven.shape[1]))
    block[:n], along[:n] = np.hstack((A, driven)) * h, np.hstack((dA, d_driven)) * h
    derivative = expm_frechet(block, along, compute_expm=False)
    return derivative[:n, :n], derivative[:n, n:]


def held_cost(F: Array, W: Array, h: float | Array) -> Array:
    """Return the integral of e^(F' t) W e^(F t) over [0, h]; of rows (.., n, n) for times (..)."""
    # The exponential rounds relative to its largest block, so that W is scaled to the size of F.
    square, h, n = F @ F, np.asarray(h)[..., None, None], F.shape[-1]
    if not (square @ F).any():
        total = np.zeros(F.shape)
        terms = (np.eye(n), F, 0.5 * square)
        with np.errstate(over="ignore", invalid="ignore"):
            for i, left in enumerate(terms):
                for j, right in enumerate(terms):
                    total += left.mT @ W @ right * (h ** (i + j + 1) / (i + j + 1))
            return 0.5 * (total + total.mT)
    from scipy.linalg import expm

    rate, weight = (float(np.abs(X).sum(axis=-2).max()) for X in (F, W))
    doublings = math.ceil(math.log2(max(2.0 * float(h.max()) * rate, 1.0)))
    block = np.zeros((*F.shape[:-2], 2 * n, 2 * n))
    size = weight / rate or 1.0
    block[..., :n, :n], block[..., :n, n:], block[..., n:, n:] = -F.mT, W / size, F
    with np.errstate(over="ignore", invalid="ignore"):
        exponential = expm(block * (h / 2**doublings))
        step = exponential[..., n:, n:]
        total = step.mT @ exponential[..., :n, n:]
        for _ in range(doublings):
            total = total + step.mT @ total @ step
            step = step @ step
        return 0.5 * size * (total + total.mT)
