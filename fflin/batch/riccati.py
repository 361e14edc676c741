"""Batch solver for Riccati equations of models at rest, at half the Hamiltonian's size."""

import numpy as np

from fflin.base.validation import Array

# Newton steps that refine P, in the coordinates of the closed loop's motions.
_REFINEMENTS = 2

# Relative size of the odd coefficients, up to which they are rounding errors of zero.
_ODD = 1e-12


def gains_at_rest(rates: Array, L: Array, Q: Array, R: Array) -> tuple[Array, Array, Array]:
    """Return K, residuals and margins of a block; what it cannot do has a NaN residual."""
    count, m, nu = L.shape
    nothing = np.full((count, nu, 2 * m), np.nan), *np.full((2, count), np.nan)
    factor = np.linalg.cholesky(R)
    white = np.linalg.solve(factor, np.swapaxes(L, 1, 2))
    # L R^-1 L' = Ls Ls', without squaring its condition; R^-1 L' Ls^-T takes p'' to u.
    unit, upper = np.linalg.qr(white)
    Ls = np.swapaxes(upper, 1, 2)
    drive = np.linalg.solve(factor.T, unit)
    T = np.zeros((count, 2 * m, 2 * m))
    T[:, :m, :m], T[:, m:, m:] = rates[:, None] * Ls, Ls
    cost = np.swapaxes(T, 1, 2) @ Q @ T
    S, D, mixed = cost[:, :m, :m], cost[:, m:, m:], cost[:, :m, m:]
    odd = np.abs(mixed - np.swapaxes(mixed, 1, 2)).max(axis=(1, 2))
    try:
        G = np.linalg.cholesky(S)
        C = np.zeros((count, 2 * m, 2 * m))
        C[:, :m, m:], C[:, m:, :m], C[:, m:, m:] = np.swapaxes(G, 1, 2), -G, D
        squares, motions = np.linalg.eig(C)
        poles = -np.sqrt(squares.astype(complex))
        a = motions[:, m:] * np.ones(1, dtype=complex)
        motions = T @ np.concatenate((a / squares[:, None], a / poles[:, None]), axis=1)
        inverse = np.linalg.inv(motions)
    except np.linalg.LinAlgError:
        return nothing
    # K x = -u of the motions.
    P = _cost_to_go(rates, L, Q, R, -(drive @ (a @ inverse).real))
    for _ in range(_REFINEMENTS):
        left, _ = _riccati(rates, L, Q, R, P)
        turned = np.swapaxes(motions, 1, 2) @ left @ motions
        turned /= -(poles[:, :, None] + poles[:, None])
        P = P + (np.swapaxes(inverse, 1, 2) @ turned @ inverse).real
    left, scale = _riccati(rates, L, Q, R, P)
    residual = np.linalg.norm(left, axis=(1, 2)) / scale
    residual[odd > _ODD * np.abs(cost).max(axis=(1, 2))] = np.nan
    K = np.linalg.solve(R, np.swapaxes(L, 1, 2) @ P[:, m:])
    # The squares of the poles that K was made from lose the digits of slow ones beside fast ones.
    moved = np.concatenate((rates[:, None] * motions[:, m:], -L @ (K @ motions)), axis=1)
    poles = np.einsum("nij,nji->ni", inverse, moved)
    return K, residual, -poles.real.max(axis=1)


def _cost_to_go(rates: Array, L: Array, Q: Array, R: Array, K: Array) -> Array:
    """Return the P (count, nx, nx) of optimal gains."""
    m = len(rates)
    lower = np.linalg.pinv(np.swapaxes(L, 1, 2)) @ (R @ K)
    spent = np.swapaxes(K, 1, 2) @ R @ K
    upper = (spent[:, :m, m:] - Q[:m, m:]) / rates
    across = np.swapaxes(lower[:, :, :m], 1, 2)
    P: Array = np.concatenate((np.concatenate((upper, across), axis=2), lower), axis=1)
    return 0.5 * (P + np.swapaxes(P, 1, 2))


def _riccati(rates: Array, L: Array, Q: Array, R: Array, P: Array) -> tuple[Array, Array]:
    """Return ``Q + A'P + P A - P B R^-1 B'P`` and the sum of the norms of its terms."""
    m = len(rates)
    PA = np.zeros_like(P)
    PA[:, :, m:] = P[:, :, :m] * rates
    BP = np.swapaxes(L, 1, 2) @ P[:, m:]
    spent = np.swapaxes(BP, 1, 2) @ np.linalg.solve(R, BP)
    scale = np.linalg.norm(Q) + sum(np.linalg.norm(term, axis=(1, 2)) for term in (PA, PA, spent))
    return Q + PA + np.swapaxes(PA, 1, 2) - spent, scale
