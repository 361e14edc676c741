"""A matrix by its modes in real arithmetic, and the Lyapunov equations that they solve."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.linalg.lapack import dgeev

from fflin.base.validation import Array


def modes_of(F: Array) -> tuple[Any, Array]:
    """Return the poles (k,) of a real matrix and its modes (n, n) as real columns.

    Of each complex pair one pole stands after the real ones, and two columns: the real parts of
    the eigenvectors of all pairs stand before their imaginary parts.
    """
    if not np.isfinite(F).all():
        raise np.linalg.LinAlgError("the matrix is not finite")
    real, imag, _, V, failed = dgeev(F, compute_vl=0)
    if failed:
        raise np.linalg.LinAlgError("the eigenvalues did not converge")
    alone, pairs = np.flatnonzero(imag == 0.0), np.flatnonzero(imag > 0.0)
    first = np.concatenate((alone, pairs))
    return real[first] + 1j * imag[first], V[:, np.concatenate((first, pairs + 1))]


def scaled(modes: Array, factors: Any) -> Array:
    """Multiply modes (m, n) by a number (k,) for each pole."""
    k = len(factors)
    alone = 2 * k - modes.shape[1]
    pairs = (modes[:, alone:k] + 1j * modes[:, k:]) * factors[alone:]
    return np.hstack((modes[:, :alone] * factors[:alone].real, pairs.real, pairs.imag))


class ModalMatrix:
    """A real matrix F (n, n) by its modes.

    SciPy's Lyapunov solver takes a Schur form for each right side; here the eigenvectors serve
    many right sides, and give the poles of matrices near by.

    Parameters
    ----------
    poles : ndarray (k,) of complex
        Eigenvalues of F: the real ones, and then one of each complex pair.
    V : ndarray (n, n)
        Modes as real columns, as `modes_of` returns them.
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
        alone = 2 * len(poles) - len(V)
        self.V, self.inverse = V, np.linalg.inv(V)
        self._pairs = slice(alone, len(poles)), slice(len(poles), None)
        left = self.values = np.concatenate((poles, poles[alone:].conj()))
        self._factors = -1.0 / (left[:, None] * left - 1.0 if discrete else left[:, None] + left)

    @classmethod
    def of(cls, F: Array, discrete: bool) -> ModalMatrix:
        """Compute the modes of a matrix."""
        return cls(*modes_of(F), discrete)

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
