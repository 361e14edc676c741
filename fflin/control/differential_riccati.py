"""The differential Riccati equation backwards in time, by maps that keep P positive."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve, expm

from fflin.base.validation import Array
from fflin.linear.sampling import HEAVY, LIGHT


class Coefficients(NamedTuple):
    """A, S = B R^-1 B' and Q of -dP/dt = A' P + P A - P S P + Q."""

    A: Array
    S: Array
    Q: Array

    def rate(self, P: Array) -> Array:
        """Return dP/dt."""
        drift = P @ self.A
        return P @ self.S @ P - drift - drift.T - self.Q


class _Passage(NamedTuple):
    r"""An interval: x1 = T x0 - G l1 and l0 = W x0 + T' l1, with G and W positive semidefinite."""

    T: Array
    G: Array
    W: Array

    def doubled(self) -> _Passage:
        """Return the passage through two such intervals."""
        T, G, W = self
        inner = np.linalg.solve(np.eye(len(T)) + G @ W, np.hstack((T, G @ T.T)))
        forward, back = inner[:, : len(T)], inner[:, len(T) :]
        return _Passage(T @ forward, _symmetric(G + T @ back), _symmetric(W + T.T @ W @ forward))

    def back(self, P: Array) -> Array:
        """Return W + T' P (E + G P)^-1 T, a sum of squares, for a P that is positive."""
        values, directions = np.linalg.eigh(P)
        root = directions * np.sqrt(values.clip(min=0.0))
        middle = np.eye(len(P)) + root.T @ self.G @ root
        seen = root.T @ self.T
        return _symmetric(self.W + seen.T @ cho_solve(cho_factor(_symmetric(middle)), seen))


def _passage(coefficients: Coefficients, h: float) -> _Passage:
    """Return an interval of constant coefficients: a short exponential, doubled."""
    A, S, Q = coefficients
    n = len(A)
    # The costate is scaled so that Q and S are of the same size.
    unit = math.sqrt(max(_size(Q), 1e-300) / max(_size(S), 1e-300))
    H = np.block([[A, -S * unit], [-Q / unit, -A.T]])
    doublings = max(0, math.ceil(math.log2(max(4.0 * h * _size(H), 1.0))))
    theta = expm(H * (h / 2**doublings))
    inverse = np.linalg.inv(theta[n:, n:])
    passage = _Passage(
        inverse.T,
        _symmetric(-theta[:n, n:] @ inverse) / unit,
        _symmetric(-inverse @ theta[n:, :n]) * unit,
    )
    for _ in range(doublings):
        passage = passage.doubled()
    return passage


def step_back(early: Coefficients, late: Coefficients, P: Array, h: float) -> Array:
    """Return P at the start of an interval of its value at the end, of order four.

    Parameters
    ----------
    early, late : Coefficients
        At the two Gauss nodes.
    P : ndarray (nx, nx)
    h : float
    """
    if np.array_equal(early.A, late.A) and np.array_equal(early.S, late.S):
        return _passage(late, h).back(P)
    for first, second in ((late, early), (early, late)):
        mixed = Coefficients(*(HEAVY * a + LIGHT * b for a, b in zip(first, second, strict=True)))
        P = _passage(mixed, 0.5 * h).back(P)
    return P


def _symmetric(matrix: Array) -> Array:
    half: Array = 0.5 * (matrix + matrix.T)
    return half


def _size(matrix: Array) -> float:
    return float(np.abs(matrix).sum(axis=0).max())
