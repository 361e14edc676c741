"""The optimal loop of a fully actuated second-order system, from half the usual size."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg.lapack import dgeev, dgeqrf, dpotrf, dtrtrs

from fflin.base.validation import Array
from fflin.control.lyapunov import ModalMatrix, Spectrum


class OptimalLoop(NamedTuple):
    """A closed loop by its modes V, and V' (Q + K' R K) V of its gain."""

    modes: ModalMatrix
    cost: Array


def second_order_loop(A: Array, B: Array, Q: Array, R_factor: Array) -> OptimalLoop | None:
    r"""Return a stable loop, optimal but for odd powers; None where the system is another.

    A state (x1, x2) of m entries each with

    .. math:: A = \begin{bmatrix} A_{11} & A_{12} \\ A_{21} & A_{22} \end{bmatrix},\qquad
              B = \begin{bmatrix} 0 \\ L \end{bmatrix},

    :math:`A_{12}` invertible and L of rank m, is :math:`\ddot p = a` behind a feedback. In
    coordinates in which the weight on a is the identity, the cost is
    :math:`|a - F p - H \dot p|^2` and quadratic in :math:`(p, \dot p)` with the blocks
    :math:`Q_{11}, Q_{12}, Q_{22}`, and the closed loop's poles are the stable zeros of

    .. math:: \det(\lambda^4 E - \lambda^2 D + S + \text{odd powers}),\qquad
              D = Q_{22} + H^T H + F + F^T,\quad S = Q_{11} + F^T F.

    The odd powers come from the antisymmetric parts of :math:`Q_{12} + F^T H` and of H. Where
    these are zero, as at rest with diagonal weights, the rest is of second degree in
    :math:`\mu = \lambda^2`: a real eigenproblem of size 2m where the Hamiltonian has 4m,

    .. math:: \begin{bmatrix} 0 & G^T \\ -G & D \end{bmatrix} w = \mu w,\qquad G G^T = S.

    Elsewhere the loop that leaves them out is stable too, and Newton's method starts there.

    Parameters
    ----------
    A : ndarray (2m, 2m)
    B : ndarray (2m, nu)
    Q : ndarray (2m, 2m)
        Symmetric; a cross term is eliminated already.
    R_factor : ndarray (nu, nu)
        Lower Cholesky factor of R.
    """
    nx = len(A)
    m = nx // 2
    if nx != 2 * m or B[:m].any():
        return None
    white = _lower(R_factor, B[m:].T)
    # Of the inverse weight on forces, S = Ls Ls'; squaring it would square its condition.
    Ls: Array = np.triu(dgeqrf(white)[0][:m]).T
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
    C = np.zeros((nx, nx), order="F")
    C[:m, m:], C[m:, :m], C[m:, m:] = G.T, -G, D
    if not np.isfinite(C).all():
        return None
    real, imag, _, W, failed = dgeev(C, compute_vl=0, overwrite_a=1)
    if failed or ((imag == 0.0) & (real <= 0.0)).any():
        return None
    spectrum = Spectrum(real, imag)
    poles = -np.sqrt(spectrum.values)
    # The lower half of w is a = mu p.
    a = W[m:, spectrum.order]
    motion = np.concatenate(
        (spectrum.scale(a, 1.0 / spectrum.values), spectrum.scale(a, 1.0 / poles))
    )
    if not plain:
        a -= F @ motion[:m] + H @ motion[m:]
    cost = motion.T @ weight @ motion + a.T @ a
    return OptimalLoop(ModalMatrix(T @ motion, spectrum, poles, discrete=False), cost)


def _lower(factor: Array, right: Array) -> Array:
    solution: Array = dtrtrs(factor, right, lower=1)[0]
    return solution


def _inverse(A12: Array) -> Array | None:
    diagonal = A12.diagonal()
    if np.count_nonzero(A12) == np.count_nonzero(diagonal):
        return np.diag(1.0 / diagonal) if diagonal.all() else None
    if np.linalg.cond(A12) > 1e8:
        return None
    inverse: Array = np.linalg.inv(A12)
    return inverse
