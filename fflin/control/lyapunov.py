"""A matrix by its modes, and the Lyapunov equations that they solve."""

from __future__ import annotations

from typing import Any

import numpy as np

from fflin.base.validation import Array


class ModalMatrix:
    """The modes V (n, n) of a real matrix F, those of complex pairs side by side."""

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
