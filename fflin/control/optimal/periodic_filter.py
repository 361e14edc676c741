"""Periodic Riccati equation of filters whose outputs are measured at different rates."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fflin.base.validation import Array, Mask, Values
from fflin.control.optimal.periodic_riccati import over_period, periodic_cost

_EPS = float(np.finfo(float).eps)

# The noise of 2^_DOUBLINGS periods is summed at most: they are far longer than any time constant
# that double precision resolves.
_DOUBLINGS = 60
_NEWTON_STEPS = 2


class PeriodicSolution(NamedTuple):
    """Solution of a periodic Riccati equation for the N samples of a period.

    Attributes
    ----------
    P : ndarray (N, n, n)
        Covariance of the prediction error at each sample.
    K : ndarray (N, n, k)
        Gain of the measurement update at each sample; zero for outputs that are not measured.
    poles : ndarray (n,) of complex
        Eigenvalues of the error dynamics over one period.
    residual : float
        Change of P after one more period, relative to its norm.
    """

    P: Array
    K: Array
    poles: Values
    residual: float


def periodic_filter(
    A: Array, C: Array, W: Array, V: Array, used: Mask
) -> PeriodicSolution:
    r"""Return the periodic steady state of a Kalman filter.

    The covariance P of the prediction error follows

    .. math:: K_j = P_j C_j^T (C_j P_j C_j^T + V_j)^{-1},\qquad
              P_{j+1} = A (I - K_j C_j) P_j A^T + W,\qquad P_{j+N} = P_j

    C_j and V_j contain the outputs that are measured at the sample j. The maps of all samples of a
    period are composed to one map, which is then doubled until its covariance is constant
    (structure-preserving doubling). Two Newton steps refine the result.

    Parameters
    ----------
    A : ndarray (n, n)
    C : ndarray (k, n)
    W : ndarray (n, n)
        Covariance of the state noise per sample, positive semidefinite.
    V : ndarray (k, k)
        Covariance of the measurement noise, positive definite.
    used : ndarray (N, k) of bool
        Whether each output is measured at each sample of the period.

    Returns
    -------
    PeriodicSolution

    Raises
    ------
    LinAlgError
        If no stable filter was found.

    References
    ----------
    E. K.-W. Chu, H.-Y. Fan, W.-W. Lin and C.-S. Wang, Structure-preserving algorithms for periodic
    discrete-time algebraic Riccati equations, Int. J. Control 77(8), 2004.
    """
    # The covariance runs forward in time as the cost of the dual regulator runs backward.
    P = periodic_cost(
        over_period(_dual(A, C[row], W, V[np.ix_(row, row)]) for row in used)
    )
    for _ in range(_NEWTON_STEPS):
        P = _newton_step(A, C, W, V, used, P)
    covariances, gains = [], []
    loop = np.eye(len(A))
    start = P
    for row in used:
        K, updated = _update(P, C, V, row)
        covariances.append(P)
        gains.append(K)
        loop = A @ (loop - K @ (C @ loop))
        P = _symmetric(A @ updated @ A.T + W)
    poles = np.linalg.eigvals(loop)
    if not np.abs(poles).max(initial=0.0) < 1.0:
        raise np.linalg.LinAlgError("the error dynamics are not stable")
    residual = float(np.linalg.norm(P - start) / np.linalg.norm(start))
    return PeriodicSolution(np.array(covariances), np.array(gains), poles, residual)


def _symmetric(P: Array) -> Array:
    half: Array = 0.5 * (P + P.T)
    return half


def _dual(A: Array, C: Array, W: Array, V: Array) -> Array:
    """Return the transition (3, n, n) of the dual regulator over a sample: T, G and W."""
    return np.array((A.T, _symmetric(C.T @ np.linalg.solve(V, C)), W))


def _update(P: Array, C: Array, V: Array, row: Mask) -> tuple[Array, Array]:
    """Return the gain (n, k) and the covariance after the measurement of the outputs in `row`."""
    K: Array = np.zeros((len(P), len(C)))
    C_j, V_j = C[row], V[np.ix_(row, row)]
    K_j = np.linalg.solve(C_j @ P @ C_j.T + V_j, C_j @ P).T
    K[:, row] = K_j
    kept = np.eye(len(P)) - K_j @ C_j
    return K, kept @ P @ kept.T + K_j @ V_j @ K_j.T


def _newton_step(A: Array, C: Array, W: Array, V: Array, used: Mask, P: Array) -> Array:
    """Return the covariance at the start of a period under the gains that follow from P."""
    loop = np.eye(len(A))
    noise: Array = np.zeros_like(A)
    for row in used:
        K, updated = _update(P, C, V, row)
        factor = A - A @ K @ C
        through = A @ K
        noise = factor @ noise @ factor.T + through @ V @ through.T + W
        loop = factor @ loop
        P = _symmetric(A @ updated @ A.T + W)
    # Sum of loop^i noise (loop^i)^T over all i, by doubling.
    total = noise
    for _ in range(_DOUBLINGS):
        more = loop @ total @ loop.T
        total = _symmetric(total + more)
        loop = loop @ loop
        if np.abs(more).max() <= _EPS * np.abs(total).max():
            break
    return total
