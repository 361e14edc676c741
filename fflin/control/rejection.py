"""Regulator equations, which cancel the steady effect of a disturbance."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fflin.base.validation import Array, Values

# A singular value below this fraction of the largest one counts as zero. The matrices are scaled to
# entries of comparable size.
_RANK = 1e-9

# A state is displaced if its steady amplitude exceeds this fraction of the scaled solution.
_DISPLACED = 1e-7


class Rejection(NamedTuple):
    """Steady state x = Pi w and inputs u = Gamma w under a disturbance w.

    `displaced` has one mask of the held states for each state of w: true if no inputs can keep the
    held state at zero.
    """

    Pi: Array
    Gamma: Array
    displaced: Array


def rejection(
    A: Array,
    B: Array,
    disturbance: tuple[Array, Array],
    held: Array,
    cost: tuple[Array, Array],
    dt: float,
) -> Rejection:
    r"""Solve the regulator equations (10.9) of a model with a disturbance.

    .. math:: A \Pi + B \Gamma + B_d = \Pi A_w,\qquad H \Pi = 0

    In continuous time, the left side is the rate of the state, and for a sampled model, it is the
    next state. The disturbance is constant or a sinusoid, so each pole p of A_w gives one system of
    linear equations ``(A - p I) x + B u = -b`` with complex amplitudes. If H Pi = 0 is impossible,
    H Pi is minimised. If several solutions exist, the solution with the least cost
    ``x* Q x + u* R u`` is returned.

    Parameters
    ----------
    A, B : ndarray (nx, nx), (nx, nu)
        Model of the regulated states.
    disturbance : tuple of ndarray (nx, nw), (nw, nw)
        B_d and A_w.
    held : ndarray (k, nx)
        Matrix H of the states that the disturbance must not displace.
    cost : tuple of ndarray (nx, nx), (nu, nu)
        Weights Q and R.
    dt : float
        Sample time [s]; 0 for continuous time.
    """
    acting, A_w = disturbance
    nx, nw = acting.shape
    Pi, Gamma = np.zeros((nx, nw)), np.zeros((B.shape[1], nw))
    displaced = np.zeros((len(held), nw), dtype=bool)
    at = 0
    while at < nw:
        size = 1 + bool(at + 1 < nw and A_w[at, at + 1])
        states = slice(at, at + size)
        # (1, j) is the eigenvector of the pole of a sinusoid.
        vector = np.array([1.0, 1j])[:size]
        pole = A_w[at, states] @ vector
        b = acting[:, states] @ vector
        x, u, moved = _steady(A, B, complex(pole), b, held, cost, dt)
        Pi[:, states] = np.column_stack((x.real, x.imag))[:, :size]
        Gamma[:, states] = np.column_stack((u.real, u.imag))[:, :size]
        displaced[:, states] = moved[:, None]
        at += size
    return Rejection(Pi, Gamma, displaced)


def _steady(
    A: Array,
    B: Array,
    pole: complex,
    b: Values,
    held: Array,
    cost: tuple[Array, Array],
    dt: float,
) -> tuple[Values, Values, Array]:
    """Return the amplitudes x (nx,) and u (nu,), and which held states (k,) are displaced."""
    if not b.any():
        return np.zeros(len(A)), np.zeros(B.shape[1]), np.zeros(len(held), dtype=bool)
    shift = pole if pole.imag else pole.real
    unit = dt or 1.0
    motion = np.hstack((A - shift * np.eye(len(A)), B)) / unit
    rows, columns = _scales(motion)
    Q, R = cost
    weights = np.zeros((len(motion.T), len(motion.T)))
    weights[: len(A), : len(A)], weights[len(A) :, len(A) :] = Q, R
    none = np.zeros((len(held), B.shape[1]))
    # Each row of H is scaled to length 1.
    kept = np.hstack((held, none)) * columns
    kept /= np.linalg.norm(kept, axis=1, keepdims=True)
    root = _root(weights * np.outer(columns, columns))
    y = lexicographic(
        [
            (rows[:, None] * motion * columns, -rows * b / unit),
            (kept, np.zeros(len(kept))),
            (root, np.zeros(len(root))),
        ]
    )
    displaced = np.abs(kept @ y) > _DISPLACED * np.linalg.norm(y)
    solution = columns * y
    return solution[: len(A)], solution[len(A) :], displaced


def lexicographic(levels: Sequence[tuple[Values, Values]]) -> Values:
    """Return the least-squares solution y of each (M, c), M y = c, in the order of importance.

    A level uses only the freedom that the levels before it leave. Of the remaining solutions, the
    one with the least norm is returned.
    """
    size = levels[0][0].shape[1]
    y: Values = np.zeros(size)
    free: Values = np.eye(size)
    for M, c in levels:
        if not len(M) or not free.shape[1]:
            continue
        U, values, V = np.linalg.svd(M @ free)
        # The size of M decides which values are zero, because M @ free may be rounding errors.
        rank = int((values > _RANK * np.linalg.norm(M, 2)).sum())
        step = (U[:, :rank].conj().T @ (c - M @ y)) / values[:rank]
        y = y + free @ (V[:rank].conj().T @ step)
        free = free @ V[rank:].conj().T
    return y


def _scales(matrix: Values) -> tuple[Array, Array]:
    """Return factors of the rows and columns that give a matrix entries of comparable size."""
    rows, columns = np.ones(len(matrix)), np.ones(matrix.shape[1])
    scaled = matrix
    for _ in range(4):
        largest = np.sqrt(np.abs(scaled).max(axis=1))
        rows /= np.where(largest > 0.0, largest, 1.0)
        largest = np.sqrt(np.abs(scaled).max(axis=0))
        columns /= np.where(largest > 0.0, largest, 1.0)
        scaled = rows[:, None] * matrix * columns
    return rows, columns


def _root(W: Array) -> Array:
    """Return L with L' L = W, for a positive semidefinite W."""
    values, vectors = np.linalg.eigh(W)
    root: Array = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T
    return root
