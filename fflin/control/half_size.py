"""Modal Lyapunov solver, and optimal loops from an eigenproblem of half the usual size."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy.linalg.lapack import dpotrf, dtrtrs

from fflin.base.validation import Array


class ModalMatrix:
    """Modes V (n, n) of a real matrix F, with complex pairs side by side."""

    def __init__(self, V: Any, poles: Any, discrete: bool) -> None:
        self.V, self.inverse, self.values = V, np.linalg.inv(V), poles
        across = poles.conj()[:, None]
        self._factors = -1.0 / (across * poles - 1.0 if discrete else across + poles)

    @classmethod
    def of(cls, F: Array, discrete: bool) -> ModalMatrix:
        """Compute the modes of a matrix."""
        poles, V = np.linalg.eig(F)
        return cls(V, poles, discrete)

    def lyapunov(self, r: Array) -> Array:
        """Solve F' D + D F = -r, or where discrete F' D F - D = -r, for a symmetric r (n, n)."""
        return self.lyapunov_modal(self.V.conj().T @ r @ self.V)

    def lyapunov_modal(self, r: Any) -> Array:
        """Solve the same where V^H r V is given."""
        # In the modes the equation is a division.
        D: Array = (self.inverse.conj().T @ (r * self._factors) @ self.inverse).real
        return 0.5 * (D + D.T)

    def poles(self, F: Array) -> Any:
        """Return the eigenvalues of a matrix, read off where these modes decouple it."""
        M = self.inverse @ F @ self.V
        values = M.diagonal().astype(complex)
        M.flat[:: len(M) + 1] = 0.0
        # Those of a normal matrix times E + X move by the norm of X at most, relatively.
        if np.linalg.norm(M / np.abs(values)) > 1e-7:
            return np.linalg.eigvals(F)
        real, first = self.values.imag == 0.0, np.flatnonzero(self.values.imag)[::2]
        values[real] = values[real].real
        values[first + 1] = values[first].conj()
        return values


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
