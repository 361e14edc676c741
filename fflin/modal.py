"""A matrix by its modes in real arithmetic, and the Lyapunov equations that they solve."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.linalg.lapack import dgeev, dgetrf, dgetri

from fflin.validation import Array


class Spectrum:
    """Eigenvalues in the order: real ones, one of each complex pair, their conjugates.

    Modes stand as real columns in the same order: eigenvectors of the real eigenvalues, then the
    real and then the imaginary parts of those of the pairs.

    Parameters
    ----------
    real, imag : ndarray (n,)
        As LAPACK returns them, pairs together.

    Attributes
    ----------
    order : ndarray (n,)
        Takes LAPACK's columns to this order.
    values : ndarray (n,) of complex
    first, second : slice
        Of the pairs and of their conjugates.
    """

    def __init__(self, real: Array, imag: Array) -> None:
        pairs = np.flatnonzero(imag)[::2]
        alone = np.flatnonzero(imag == 0.0)
        self.order = np.concatenate((alone, pairs, pairs + 1))
        self.values: Any = (real + 1j * imag)[self.order]
        self.first = slice(len(alone), len(alone) + len(pairs))
        self.second = slice(self.first.stop, None)

    def scale(self, columns: Array, factors: Any) -> Array:
        """Multiply modes (m, n) by numbers (n,) that are conjugate in the pairs."""
        first, second = self.first, self.second
        product: Array = columns * factors.real
        product[:, first] -= columns[:, second] * factors.imag[first]
        product[:, second] += columns[:, first] * factors.imag[first]
        return product


class Modes:
    """The modes V (n, n) of a real matrix F, and their inverse.

    Raises
    ------
    numpy.linalg.LinAlgError
        If they are not independent.
    """

    def __init__(self, V: Array, spectrum: Spectrum, poles: Any, discrete: bool) -> None:
        factors, pivots, _ = dgetrf(V)
        inverse, failed = dgetri(factors, pivots, overwrite_lu=1)
        outer = poles[:, None] * poles - 1.0 if discrete else poles[:, None] + poles
        if failed or not outer.all():
            raise np.linalg.LinAlgError("the modes are not independent")
        self.V, self.inverse, self.spectrum = V, inverse, spectrum
        self._factors = -1.0 / outer

    @classmethod
    def of(cls, F: Array, discrete: bool) -> Modes:
        """Compute the modes of a matrix."""
        real, imag, _, V, failed = dgeev(F, compute_vl=0)
        if failed:
            raise np.linalg.LinAlgError("the eigenvalues did not converge")
        spectrum = Spectrum(real, imag)
        return cls(V[:, spectrum.order], spectrum, spectrum.values, discrete)

    def lyapunov(self, r: Array) -> Array:
        """Solve F' D + D F = -r, or where discrete F' D F - D = -r, for a symmetric r (n, n)."""
        return self.lyapunov_modal(self.V.T @ r @ self.V)

    def lyapunov_modal(self, r: Array) -> Array:
        """Solve the same where V' r V is given."""
        first, second = self.spectrum.first, self.spectrum.second
        # To the complex modes a + ib and a - ib from either side; there the equation is a
        # division; and back.
        z = r.astype(complex)
        for side in (z, z.T):
            a, b = side[first].copy(), 1j * side[second]
            side[first] += b
            np.subtract(a, b, out=side[second])
        z *= self._factors
        for side in (z, z.T):
            a, b = side[first].copy(), side[second].copy()
            side[first] = 0.5 * (a + b)
            side[second] = -0.5j * (a - b)
        D: Array = self.inverse.T @ z.real @ self.inverse
        D += D.T.copy()
        D *= 0.5
        return D

    def poles(self, F: Array) -> Any:
        """Return the eigenvalues of a matrix near to that of these modes.

        Where it is so near that they decouple to eight digits they are read off, else computed.
        """
        first, second = self.spectrum.first, self.spectrum.second
        M = self.inverse @ F @ self.V
        values = M.diagonal().astype(complex)
        pairs = 0.5 * (values[first] + values[second])
        pairs += 0.5j * (M[first, second].diagonal() - M[second, first].diagonal())
        values[first], values[second] = pairs, pairs.conj()
        M.flat[:: len(M) + 1] -= values.real
        blocks = M[first, second], M[second, first]
        for block, sign in zip(blocks, (-1.0, 1.0), strict=True):
            block.flat[:: block.shape[1] + 1] += sign * pairs.imag
        # Those of a normal matrix times E + X move by the norm of X at most, relatively.
        if np.linalg.norm(M / np.abs(values)) <= 1e-8:
            return values
        return eigenvalues(F)


def eigenvalues(F: Array) -> Any:
    """Return the eigenvalues of a real matrix."""
    real, imag, _, _, failed = dgeev(F, compute_vl=0, compute_vr=0)
    if failed:
        raise np.linalg.LinAlgError("the eigenvalues did not converge")
    return real + 1j * imag
