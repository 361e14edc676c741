"""Attitude chart: the vector part of the base quaternion, its kinematics, and the rotation R."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from fflin.base.rotation import skew
from fflin.base.validation import Array

# Where q0 is below the square root of the rounding unit, sqrt(1 - |q_b|^2) has no correct digit.
SMALLEST_Q0 = float(np.sqrt(np.finfo(float).eps))


@dataclass(frozen=True)
class Chart:
    """Attitude chart at one or many base attitudes relative to the reference."""

    q_b: Array  # vector part (.., 3) of the quaternion of refMb
    q0: float | Array  # its scalar part (.., 1), positive
    R: Array  # refMb.rotation (.., 3, 3)

    @cached_property
    def Q(self) -> Array:
        """Q (.., 3, 3) of the quaternion kinematics (1.2): d q_b/dt = Q omega / 2."""
        return self._scalar + skew(self.q_b)

    @cached_property
    def N(self) -> Array:
        """N = Q / 2 (.., 3, 3)."""
        return 0.5 * self.Q

    @cached_property
    def J(self) -> Array:
        """J = 2 Q^-1 (.., 3, 3) with ``d theta = J d q_b``, d theta in base axes (1.3)."""
        return 2.0 * (self._scalar - skew(self.q_b) + self._over_q0(self.q_b))

    @property
    def _scalar(self) -> Array:
        return np.asarray(self.q0)[..., None] * np.eye(3)

    def rate(self, omega: Array) -> Array:
        """Return d q_b/dt = N omega (.., 3), omega in base axes (1.2)."""
        return times(self.N, omega)

    def rotated(self, vectors: Array) -> Array:
        """Return vectors (.., 3) in base axes in reference axes."""
        return times(self.R, vectors)

    def rate_over_q_b(self, omega: Array, crossed: Array) -> Array:
        """Return the derivative (.., 3, 3) of `rate` over q_b (4.2); `crossed` is [omega]x."""
        return -0.5 * (crossed + self._over_q0(omega))

    def _over_q0(self, omega: Array) -> Array:
        return omega[..., :, None] * (self.q_b / self.q0)[..., None, :]

    def over_q_b(self, by_turn: Array) -> Array:
        """Return derivatives (.., k, 3) over base rotations as derivatives over q_b (1.3)."""
        return by_turn @ self.J

    def to_reference(
        self, parts: tuple[slice, ...], x: Array, *, out: Array | None = None
    ) -> Array:
        """Return x (.., m, k), or write to `out`, with parts of three rows turned by R."""
        return _turned(self.R, parts, x, out)

    def to_base(self, parts: tuple[slice, ...], x: Array) -> Array:
        """Return x (.., m, k) with some parts, three rows each, turned to base axes by R^T."""
        return _turned(self.R.mT, parts, x, None)


class Standing(Chart):
    """Chart of one or many bases at the reference: R = Q = E and J = 2 E cost nothing."""

    N = 0.5 * np.eye(3)

    def __init__(self, *count: int) -> None:
        super().__init__(np.zeros((*count, 3)), 1.0, np.eye(3))

    def rate(self, omega: Array) -> Array:
        """Return omega / 2."""
        return 0.5 * omega

    def rotated(self, vectors: Array) -> Array:
        """Return the vectors themselves."""
        return vectors

    def rate_over_q_b(self, omega: Array, crossed: Array) -> Array:
        """Return -[omega]x / 2."""
        return -0.5 * crossed

    def over_q_b(self, by_turn: Array) -> Array:
        """Return twice the derivatives."""
        return 2.0 * by_turn

    def to_reference(
        self, parts: tuple[slice, ...], x: Array, *, out: Array | None = None
    ) -> Array:
        """Return x itself, or write it to `out`."""
        return _turned(self.R, (), x, out)

    def to_base(self, parts: tuple[slice, ...], x: Array) -> Array:
        """Return x itself."""
        return x


def times(matrices: Array, vectors: Array) -> Array:
    """Return matrices (.., 3, 3) times vectors (.., 3)."""
    return (matrices @ vectors[..., None])[..., 0]


def _turned(R: Array, parts: tuple[slice, ...], x: Array, out: Array | None) -> Array:
    if out is None:
        out = x.copy("K") if parts else x
    else:
        out[...] = x
    for rows in parts:
        out[..., rows, :] = R @ x[..., rows, :]
    return out
