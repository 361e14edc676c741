"""A matrix by its modes in real arithmetic, and the Lyapunov equations that they solve."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.linalg.lapack import dgeev, dgetrf, dgetri

from fflin.base.validation import Array


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


class ModalMatrix:
    """The modes V (n, n) of a real matrix F, and their inverse.

    Raises
    ------
    numpy.linalg.LinAlgError
        If they are not independent.
    """

    def __init__(self, V: Array, spectrum: Spectrum, poles: Any, discrete: bool) -> None:
        factors, pivots, _ = dgetrf(V)
        inverse, failed = dgetri(factors, pivots, overwrite_lu=1)
        if failed:
            raise np.linalg.LinAlgError("the modes are not independent")
        self.V, self.inverse, self.spectrum = V, inverse, spectrum
        # Of the real modes with each other and with the pairs, and of the pairs with each other
        # and with their conjugates; the rest is conjugate or transposed.
        alone, pairs = poles[: spectrum.first.start], poles[spectrum.first]
        self._factors = [
            _factors(left, right, discrete)
            for left, right in (
                (alone.real, alone.real),
                (alone.real, pairs),
                (pairs, pairs),
                (pairs, pairs.conj()),
            )
        ]

    @classmethod
    def of(cls, F: Array, discrete: bool) -> ModalMatrix:
        """Compute the modes of a matrix."""
        if not np.isfinite(F).all():
            raise np.linalg.LinAlgError("the matrix is not finite")
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
        alone = slice(0, first.start)
        of_alone, of_mixed, of_pairs, of_conjugates = self._factors
        # In the complex modes a + ib and a - ib the equation is a division.
        z = np.empty_like(r)
        if first.start:
            z[alone, alone] = r[alone, alone] * of_alone
            mixed = (r[alone, first] + 1j * r[alone, second]) * of_mixed
            z[alone, first], z[alone, second] = mixed.real, mixed.imag
            z[first, alone], z[second, alone] = mixed.real.T, mixed.imag.T
        aa, ab, ba, bb = r[first, first], r[first, second], r[second, first], r[second, second]
        pairs = (aa - bb + 1j * (ab + ba)) * of_pairs
        conjugates = (aa + bb + 1j * (ba - ab)) * of_conjugates
        z[first, first] = 0.5 * (conjugates.real + pairs.real)
        z[first, second] = 0.5 * (pairs.imag - conjugates.imag)
        z[second, first] = 0.5 * (pairs.imag + conjugates.imag)
        z[second, second] = 0.5 * (conjugates.real - pairs.real)
        D: Array = self.inverse.T @ z @ self.inverse
        D += D.T.copy()
        D *= 0.5
        return D

    def poles(self, F: Array) -> Any:
        """Return the eigenvalues of a matrix near to that of these modes.

        Where it is so near that they decouple to seven digits they are read off, else computed.
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
        if np.linalg.norm(M / np.abs(values)) <= 1e-7:
            return values
        return eigenvalues(F)


def _factors(left: Any, right: Any, discrete: bool) -> Any:
    return -1.0 / (left[:, None] * right - 1.0 if discrete else left[:, None] + right)


def eigenvalues(F: Array) -> Any:
    """Return the eigenvalues of a real matrix."""
    if not np.isfinite(F).all():
        raise np.linalg.LinAlgError("the matrix is not finite")
    real, imag, _, _, failed = dgeev(F, compute_vl=0, compute_vr=0)
    if failed:
        raise np.linalg.LinAlgError("the eigenvalues did not converge")
    return real + 1j * imag
