"""A quadratic cost over the stages of a linear motion, with bounds on every variable."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fflin.base.validation import Array

# What may be left of the motion's equations, relative to their terms, and where rounding may end
# it; what keeps the Hessian regular where bounds leave nothing free, relative to its diagonal.
_EXACT, _ROUNDED, _REGULAR = 1e-12, 1e-8, 1e-12

_MOST_STEPS, _MOST_CUTS = 60, 30


class Rows(NamedTuple):
    """Variables (N + 1, k), each with a cost of weight (x - middle)^2 / 2 and bounds."""

    weights: Array
    middle: Array
    low: Array
    high: Array

    def cost(self, x: Array) -> float:
        """Return the cost of variables."""
        return float((self.weights * np.square(x - self.middle)).sum()) / 2.0

    def least(self, slopes: Array) -> tuple[Array, Array]:
        """Return what is least with a cost of -slopes x besides, and its slopes over these."""
        wanted = self.middle + slopes / self.weights
        free = (wanted > self.low) & (wanted < self.high)
        return np.clip(wanted, self.low, self.high), free / self.weights


class Stages(NamedTuple):
    """The motion z[k + 1] = A[k] z[k] + B[k] u[k] + D[k] u[k + 1] + c[k] of N stages, z[0] = 0."""

    A: Array
    B: Array
    D: Array
    c: Array

    def least(self, of_u: Rows, of_z: Rows, y: Array) -> tuple[Array, Array, Array]:
        """Return u and z (N + 1, k) of the least cost, and the multipliers y (N, nx).

        By Newton's method on the dual from y on, whose Hessian is block tridiagonal.

        References
        ----------
        J. V. Frasch, S. Sager and M. Diehl, A parallel quadratic programming method for dynamic
        optimization problems, Mathematical Programming Computation 7, 2015.
        """
        before = np.inf
        for _ in range(_MOST_STEPS):
            u, z, slope, rows = self._at(of_u, of_z, y)
            left, size = float(np.abs(slope).max()), float(np.abs(z).max() + np.abs(self.c).max())
            if left <= _EXACT * size or (left <= _ROUNDED * size and left > 0.5 * before):
                break
            before = left
            step = self._step(*rows, slope)
            # The dual is convex along the step: halve where its slope has changed sign.
            least, most, share, down = 0.0, 1.0, 1.0, float((slope * step).sum())
            for _ in range(_MOST_CUTS):
                along = float((self._at(of_u, of_z, y + share * step)[2] * step).sum())
                if abs(along) <= 0.5 * abs(down):
                    break
                least, most = (share, most) if along < 0.0 else (least, share)
                share = 0.5 * (least + most)
            y = y + share * step
        return u, z, y

    def _at(
        self, of_u: Rows, of_z: Rows, y: Array
    ) -> tuple[Array, Array, Array, tuple[Array, Array]]:
        """Return u, z, what is left of the equations, and the slopes of u and z."""
        on_u, on_z = np.zeros_like(of_u.middle), np.zeros_like(of_z.middle)
        on_u[:-1] = _times(y, self.B)
        on_u[1:] += _times(y, self.D)
        on_z[:-1] = _times(y, self.A)
        on_z[1:] -= y
        (u, free_u), (z, free_z) = of_u.least(on_u), of_z.least(on_z)
        left = self.c + _of(self.A, z[:-1]) + _of(self.B, u[:-1]) + _of(self.D, u[1:]) - z[1:]
        return u, z, left, (free_u, free_z)

    def _step(self, free_u: Array, free_z: Array, slope: Array) -> Array:
        """Return Newton's step -H^-1 slope, by the block Cholesky factors of H."""
        A, B, D = self.A, self.B, self.D
        own = _square(A, free_z[:-1]) + _square(B, free_u[:-1]) + _square(D, free_u[1:])
        at = np.arange(A.shape[1])
        own[:, at, at] += free_z[1:]
        own[:, at, at] += _REGULAR * own[:, at, at].max()
        off = (B[1:] * free_u[1:-1, None]) @ D[:-1].transpose(0, 2, 1) - A[1:] * free_z[1:-1, None]
        reached, factors = [slope[0]], [np.linalg.inv(own[0])]
        for k in range(1, len(A)):
            back = off[k - 1] @ factors[-1]
            reached.append(slope[k] - back @ reached[-1])
            factors.append(np.linalg.inv(own[k] - back @ off[k - 1].T))
        step = [factors[-1] @ reached[-1]]
        for k in range(len(A) - 2, -1, -1):
            step.append(factors[k] @ (reached[k] - off[k].T @ step[-1]))
        return -np.array(step[::-1])


def _of(matrices: Array, rows: Array) -> Array:
    product: Array = (matrices @ rows[..., None])[..., 0]
    return product


def _times(rows: Array, matrices: Array) -> Array:
    product: Array = (rows[:, None] @ matrices)[:, 0]
    return product


def _square(matrices: Array, weights: Array) -> Array:
    product: Array = (matrices * weights[:, None]) @ matrices.transpose(0, 2, 1)
    return product
