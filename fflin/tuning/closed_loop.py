r"""Closed loop of a plant and a law, and the derivative of a response with respect to the law.

The states of the law are part of the plant, so that the law is a static gain K. With
``y = C x + D u`` and ``u = K y``, the gain from C x to u is ``(I - K D)^-1 K``. A change dK of the
gain changes a response, with left and right vectors a and b, by ``Re(a^H dK b)``.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np

from fflin.base.validation import Array, Values
from fflin.tuning.channels import Channel
from fflin.tuning.law import Law
from fflin.tuning.plant import Plant

# Eigenvectors with a larger condition number are not used for responses.
_CONDITION = 1e7

# Real parts below this fraction of the largest pole are rounding errors, as in `margins`.
_ROUNDING = 1e-9

# An algebraic loop with a smaller singular value is singular.
_SINGULAR = 1e-12


class ClosedLoop:
    """Closed loop of a plant and a law."""

    def __init__(self, plant: Plant, law: Law) -> None:
        self.plant = plant
        self.changes = law.gain_derivatives
        nx, nu, ny, nz = len(plant.A), plant.B.shape[1], plant.ny, len(law.A)
        unit = np.eye(nz)

        def with_states(matrix: Array, corner: Array) -> Array:
            rows, columns = matrix.shape
            return np.block(
                [
                    [matrix, np.zeros((rows, len(corner.T)))],
                    [np.zeros((len(corner), columns)), corner],
                ]
            )

        none = np.zeros((nz, nz))
        A = with_states(plant.A, none)
        self.B2 = with_states(plant.B, unit)
        self.C2 = with_states(plant.C[:ny], unit)
        D22 = with_states(plant.D[:ny], none)
        K = law.gain
        self.well_posed = True
        self.left: Array = np.eye(nu + nz)
        self.right: Array = np.eye(ny + nz)
        if D22.any():
            loop = self.left - K @ D22
            if np.linalg.svd(loop, compute_uv=False)[-1] < _SINGULAR:
                self.well_posed = False
                return
            self.left = np.linalg.inv(loop)
            self.right = np.linalg.inv(self.right - D22 @ K)
        self.K = self.left @ K
        self.A = A + self.B2 @ self.K @ self.C2
        self.nx, self.nu, self.ny, self.nz = nx, nu, ny, nz

    @cached_property
    def _modes(self) -> tuple[Values, Values, Values | None]:
        """Poles, eigenvectors and their inverse; None if the eigenvectors are nearly dependent."""
        poles, vectors = np.linalg.eig(self.A)
        poles = poles.astype(complex)
        with np.errstate(all="ignore"):
            condition = np.linalg.cond(vectors)
        if not condition < _CONDITION:
            return poles, vectors, None
        return poles, vectors, np.linalg.inv(vectors)

    @property
    def poles(self) -> Values:
        """Poles of the closed loop."""
        return self._modes[0]

    @cached_property
    def is_stable(self) -> bool:
        """Whether all poles have negative real parts, by more than rounding errors."""
        if not self.well_posed or not np.isfinite(self.A).all():
            return False
        largest = np.abs(self.poles).max(initial=0.0)
        return bool(self.poles.real.max(initial=-np.inf) < -_ROUNDING * largest)

    def system(self, channel: Channel) -> tuple[Array, Array, Array, Array]:
        """Return A, B, C and D of a channel in the closed loop."""
        nz = self.nz
        D12 = np.hstack((channel.D12, np.zeros((len(channel.D12), nz))))
        D21 = np.vstack((channel.D21, np.zeros((nz, channel.D21.shape[1]))))
        B1 = np.vstack((channel.B1, np.zeros((nz, channel.B1.shape[1]))))
        C1 = np.hstack((channel.C1, np.zeros((len(channel.C1), nz))))
        B = B1 + self.B2 @ self.K @ D21
        C = C1 + D12 @ self.K @ self.C2
        D = channel.D11 + D12 @ self.K @ D21
        return self.A, B, C, D

    def pole_gradient(self, index: int) -> Values:
        """Return the derivatives (p,) of a pole."""
        _, vectors, inverse = self._modes
        if inverse is None:
            inverse = np.linalg.pinv(vectors)
        row = inverse[index]
        a = row @ self.B2 @ self.left
        b = self.right @ self.C2 @ vectors[:, index]
        derivatives: Values = np.einsum("i,pij,j->p", a, self.changes, b)
        return derivatives

    def gradient(self, sensitivity: Array) -> Array:
        """Return the derivatives (p,) of a quantity from its derivatives with respect to K.

        `sensitivity` contains the derivatives with respect to the gain from C x to u.
        """
        of_gain = self.left.T @ sensitivity @ self.right.T
        derivatives: Array = np.tensordot(self.changes, of_gain, 2)
        return derivatives

    def responses(
        self, system: tuple[Array, Array, Array, Array], frequencies: Array
    ) -> Values:
        """Return the responses (n, nz, nw) of a channel at frequencies [rad/s], maybe infinite."""
        A, B, C, D = system
        finite = np.isfinite(frequencies)
        w = np.where(finite, frequencies, 0.0)
        poles, vectors, inverse = self._modes
        with np.errstate(all="ignore"):
            if inverse is None:
                inner = 1j * w[:, None, None] * np.eye(len(A)) - A
                dynamic = C @ np.linalg.solve(inner, B.astype(complex))
            else:
                factors = 1.0 / (1j * w[:, None] - poles)
                dynamic = (factors[:, None, :] * (C @ vectors)) @ (inverse @ B)
        dynamic[~finite] = 0.0
        result: Values = D + dynamic
        return result

    def response_vectors(
        self, channel: Channel, frequency: float
    ) -> tuple[Values, Values, Values]:
        """Return the response T, and the matrices L and R of its change ``L dK R``.

        dK is here a change of the gain from C x to u.
        """
        A, B, C, D = self.system(channel)
        nz = self.nz
        L = np.hstack((channel.D12, np.zeros((len(channel.D12), nz)))).astype(complex)
        R = np.vstack((channel.D21, np.zeros((nz, channel.D21.shape[1])))).astype(
            complex
        )
        T = D.astype(complex)
        if np.isfinite(frequency):
            inner = 1j * frequency * np.eye(len(A)) - A
            states = np.linalg.solve(inner, np.hstack((B, self.B2)).astype(complex))
            k = B.shape[1]
            T = T + C @ states[:, :k]
            R = R + self.C2 @ states[:, :k]
            L = L + C @ states[:, k:]
        return T, L, R
