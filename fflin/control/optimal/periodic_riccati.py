"""Periodic Riccati equation of filters whose outputs are measured at different rates."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fflin.base.validation import Array, Mask, Values

_EPS = float(np.finfo(float).eps)

# 2^_DOUBLINGS periods are far longer than any time constant that double precision resolves.
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


class _Maps(NamedTuple):
    """Map P -> H + A P (I + G P)^-1 A^T of the covariance over some samples."""

    A: Array
    G: Array
    H: Array

    def before(self, after: _Maps) -> _Maps:
        """Return the map that applies this map first, and then the map `after`."""
        both = np.eye(len(self.A)) + self.H @ after.G
        mixed = np.linalg.solve(both, np.hstack((self.A, self.H)))
        A, H = np.hsplit(mixed, 2)
        G = self.G + self.A.T @ after.G @ A
        H = after.H + after.A @ H @ after.A.T
        return _Maps(after.A @ A, 0.5 * (G + G.T), 0.5 * (H + H.T))


# The maps of a system without a stable filter overflow, so NumPy's warnings are not needed.
@np.errstate(over="ignore", invalid="ignore")
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
    whole: _Maps | None = None
    for row in used:
        C_j = C[row]
        G = C_j.T @ np.linalg.solve(V[np.ix_(row, row)], C_j)
        step = _Maps(A, 0.5 * (G + G.T), W)
        whole = step if whole is None else whole.before(step)
    assert whole is not None
    P = _fixed_point(whole)
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


def _fixed_point(maps: _Maps) -> Array:
    """Return the covariance after very many applications of a map, starting with zero."""
    for _ in range(_DOUBLINGS):
        before = maps.H
        maps = maps.before(maps)
        if not np.isfinite(maps.H).all():
            break
        if np.abs(maps.H - before).max() <= 4.0 * _EPS * np.abs(maps.H).max():
            return maps.H
    raise np.linalg.LinAlgError("the covariance does not become periodic")


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
