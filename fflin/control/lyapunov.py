"""A matrix by its modes in real arithmetic, and the Lyapunov equations that they solve."""

from __future__ import annotations

from typing import Any

import numpy as np

from fflin.base.validation import Array


def real_columns(modes: Any, alone: int) -> Array:
    """Return modes (m, k), one of each complex pair after `alone` real ones, as real (m, n).

    A pair takes two columns: the real parts of all pairs stand before their imaginary parts.
    """
    return np.hstack((modes.real, modes.imag[:, alone:]))


def one_of_each(values: Any, vectors: Any) -> tuple[Any, Any]:
    """Return the eigenpairs with an imaginary part of zero, and then the positive ones."""
    order = np.concatenate((np.flatnonzero(values.imag == 0.0), np.flatnonzero(values.imag > 0.0)))
    return values[order], vectors[:, order]


class ModalMatrix:
    """A real matrix F (n, n) by its modes.

    SciPy's Lyapunov solver takes a Schur form for each right side; here the eigenvectors serve
    many right sides, and give the poles of matrices near by.

    Parameters
    ----------
    poles : ndarray (k,) of complex
        Eigenvalues of F: the real ones, and then one of each complex pair.
    V : ndarray (n, n)
        Eigenvectors, as `real_columns`.
    discrete : bool

    Attributes
    ----------
    values : ndarray (n,) of complex
        All eigenvalues: `poles`, and then the conjugates of the pairs.

    Raises
    ------
    numpy.linalg.LinAlgError
        If the eigenvectors are not independent.
    """

    def __init__(self, poles: Any, V: Array, discrete: bool) -> None:
        alone = (poles.imag == 0.0).sum()
        self.V, self.inverse = V, np.linalg.inv(V)
        self._pairs = slice(alone, len(poles)), slice(len(poles), None)
        left = self.values = np.concatenate((poles, poles[alone:].conj()))
        self._factors = -1.0 / (left[:, None] * left - 1.0 if discrete else left[:, None] + left)

    @classmethod
    def of(cls, F: Array, discrete: bool) -> ModalMatrix:
        """Compute the modes of a matrix."""
        poles, modes = one_of_each(*np.linalg.eig(F))
        return cls(poles, real_columns(modes, (poles.imag == 0.0).sum()), discrete)

    def lyapunov(self, r: Array) -> Array:
        """Solve F' D + D F = -r, or where discrete F' D F - D = -r, for a symmetric r (n, n)."""
        return self.lyapunov_modal(self.V.T @ r @ self.V)

    def lyapunov_modal(self, r: Array) -> Array:
        """Solve the same where V' r V is given."""
        # In the basis of the complex eigenvectors a + ib and a - ib each entry is a division.
        z = self._complex(self._complex(r).T) * self._factors
        first, second = self._pairs
        for _ in range(2):  # back to a and b, in the columns and in the rows
            total, apart = z[:, first] + z[:, second], z[:, first] - z[:, second]
            z[:, first], z[:, second] = 0.5 * total, -0.5j * apart
            z = z.T
        D: Array = self.inverse.T @ z.real @ self.inverse
        return 0.5 * (D + D.T)

    def poles(self, F: Array) -> Any:
        """Return the eigenvalues of a matrix near to that of these modes.

        Where it is so near that they decouple to seven digits they are read off, else computed.
        """
        z = self._complex(self.inverse @ F @ self.V)
        first, second = self._pairs
        turned = 1j * z[second]
        z[first], z[second] = 0.5 * (z[first] - turned), 0.5 * (z[first] + turned)
        values = z.diagonal().copy()
        z.flat[:: len(z) + 1] = 0.0
        # Eigenvalues of a normal matrix times E + X differ relatively by at most the norm of X.
        if np.linalg.norm(z / np.abs(values)) <= 1e-7:
            return values
        return np.linalg.eigvals(F).astype(complex)

    def _complex(self, r: Any) -> Any:
        """Return r with columns of a pair, for a and b, as those of a + ib and a - ib."""
        first, second = self._pairs
        z, turned = r.astype(complex), 1j * r[:, second]
        z[:, first], z[:, second] = r[:, first] + turned, r[:, first] - turned
        return z
