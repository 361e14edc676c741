"""The optimal loop of a fully actuated second-order system, from half the usual size."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy.linalg.lapack import dpotrf, dtrtrs

from fflin.base.validation import Array
from fflin.control.lyapunov import ModalMatrix


class OptimalLoop(NamedTuple):
    """A closed loop by its modes V, and V^H (Q + K' R K) V of its gain."""

    modes: ModalMatrix
    cost: Any


def second_order_loop(A: Array, B: Array, Q: Array, R_factor: Array) -> OptimalLoop | None:
    """Return a stable loop, optimal but for odd powers (10.5); None where the system is another."""
    nx = len(A)
    m = nx // 2
    if nx != 2 * m or B[:m].any():
        return None
    white = _lower(R_factor, B[m:].T)
    # Of the inverse weight on forces, S = Ls Ls'; squaring it would square its condition.
    triangle: Any = np.linalg.qr(white, mode="r")
    Ls = triangle.T
    sizes = np.abs(Ls.diagonal())
    singular = len(white) < m or sizes.min() <= 1e-14 * sizes.max()
    A11, A12 = A[:m, :m], A[:m, m:]
    inverse = _inverse(A12)
    if singular or inverse is None:
        return None
    # x = T (p, dp/dt)
    T = np.zeros((nx, nx))
    T[:m, :m], T[m:, m:] = A12 @ Ls, Ls
    plain = not (A11.any() or A[m:].any())
    if not plain:
        T[m:, :m] = -inverse @ A11 @ T[:m, :m]
    weight = T.T @ Q @ T
    S, D = weight[:m, :m], weight[m:, m:]
    if not plain:
        F = _lower(Ls, A[m:] @ T[:, :m])
        H = _lower(Ls, inverse @ A11 @ T[:m, :m] + A[m:, m:] @ Ls)
        S, D = S + F.T @ F, D + H.T @ H + F + F.T
    G, indefinite = dpotrf(S, lower=1)
    if indefinite:
        return None
    squares, W = np.linalg.eig(np.block([[np.zeros((m, m)), G.T], [-G, D]]))
    if ((squares.imag == 0.0) & (squares.real <= 0.0)).any():
        return None
    poles = -np.sqrt(squares)
    # The lower half of w is a = mu p.
    a = W[m:]
    motion = np.concatenate((a / squares, a / poles))
    if not plain:
        a = a - F @ motion[:m] - H @ motion[m:]
    cost = motion.conj().T @ weight @ motion + a.conj().T @ a
    return OptimalLoop(ModalMatrix(T @ motion, poles, discrete=False), cost)


def _lower(factor: Array, right: Array) -> Array:
    return dtrtrs(factor, right, lower=1)[0]


def _inverse(A12: Array) -> Array | None:
    diagonal = A12.diagonal()
    if np.count_nonzero(A12) == np.count_nonzero(diagonal):
        return np.diag(1.0 / diagonal) if diagonal.all() else None
    if np.linalg.cond(A12) > 1e8:
        return None
    return np.linalg.inv(A12)
