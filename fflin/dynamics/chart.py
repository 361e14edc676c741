"""The attitude chart: the vector part of the base's quaternion."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from fflin.base.rotation import skew
from fflin.base.validation import Array

# Where q0 is below the square root of the rounding unit, sqrt(1 - |q_b|^2) has no correct digit.
SMALLEST_Q0 = float(np.sqrt(np.finfo(float).eps))


@dataclass(frozen=True)
class Chart:
    """The attitude chart at one base attitude, relative to the reference, or at many.

    Attributes
    ----------
    q_b : ndarray (.., 3)
        Vector part of the quaternion of refMb.
    q0 : float or ndarray (.., 1)
        Its scalar part, positive.
    R : ndarray (.., 3, 3)
        refMb.rotation.
    """

    q_b: Array
    q0: float | Array
    R: Array

    @cached_property
    def Q(self) -> Array:
        """Q (.., 3, 3) with ``d q_b/dt = Q omega / 2``, omega in base axes."""
        return self._scalar + skew(self.q_b)

    @cached_property
    def J(self) -> Array:
        """J = 2 Q^-1 (.., 3, 3) with ``d theta = J d q_b``, d theta in base axes."""
        outer = self.q_b[..., :, None] * (self.q_b / self.q0)[..., None, :]
        return 2.0 * (self._scalar - skew(self.q_b) + outer)

    @property
    def _scalar(self) -> Array:
        return np.asarray(self.q0)[..., None] * np.eye(3)
