"""Rotation rates of a satellite relative to inertial space, and their means over an orbit."""

from __future__ import annotations

import math

import numpy as np

from fflin.base.rotation import rotation_matrices
from fflin.base.validation import Array, Vector
from fflin.dynamics.coordinates import PIN_ANGULAR
from fflin.dynamics.orbital import normal_of
from fflin.robot.orbit import CircularOrbit, EllipticOrbit

# A satellite has detumbled if its mean rate over an orbit is below this multiple of the orbital
# rate. Under B-dot, the mean rate approaches about twice the orbital rate.
SLOW = 4.0

# A time counts as a whole period after the start if the rest is at most this fraction of a period.
_ROUNDING = 1e-9


class RotationRates:
    """Rotation rates of the base in a motion in orbit.

    `rates` (N,) are the magnitudes [rad/s] of the angular velocity relative to inertial space at
    the times t (N,) [s].
    """

    def __init__(
        self,
        t: Vector,
        q: Array,
        v: Array,
        frame: str,
        orbit: CircularOrbit | EllipticOrbit,
    ) -> None:
        self.t = t
        self.orbit = orbit
        frame_rates = np.full(len(t), orbit.mean_motion)
        if isinstance(orbit, EllipticOrbit):
            frame_rates = np.array([orbit.at(time).rate for time in t.tolist()])
        normals = normal_of(frame) @ rotation_matrices(q[:, 3:7])
        inertial = v[:, PIN_ANGULAR] + frame_rates[:, None] * normals
        self.rates: Array = np.linalg.norm(inertial, axis=1)

    @property
    def is_short(self) -> bool:
        """Whether the motion is shorter than one orbit."""
        return bool(self.t[-1] < self._first)

    @property
    def _first(self) -> float:
        """First time [s] with a mean over a period."""
        return float(self.t[0]) + (1.0 - _ROUNDING) * self.orbit.period

    @property
    def bound(self) -> float:
        """Rate [rad/s] below which a satellite has detumbled."""
        return SLOW * self.orbit.mean_motion

    def means(self) -> Array:
        """Return the means (N,) [rad/s] over the period that ends at each time.

        The means of the first period are not a number.
        """
        period = self.orbit.period
        steps = 0.5 * (self.rates[1:] + self.rates[:-1]) * np.diff(self.t)
        angle = np.append(0.0, np.cumsum(steps))
        start = self.t - period
        means: Array = (angle - np.interp(start, self.t, angle)) / period
        means[self.t < self._first] = math.nan
        return means

    def slow_after(self, bound: float) -> float:
        """Return the first time [s] at which the mean is below a bound [rad/s], or infinity."""
        slow = self.means() < bound
        if not slow.any():
            return math.inf
        return float(self.t[slow.argmax()])

    def summary(self) -> str:
        """Return a sentence that says when the satellite has detumbled."""
        bound = f"{self.bound:.3g} rad/s, four times the orbital rate"
        if self.is_short:
            return (
                f"not detumbled: the run is shorter than one orbit ({self.orbit.period:.5g} s), "
                f"whose mean rate must be below {bound}"
            )
        time = self.slow_after(self.bound)
        if not math.isfinite(time):
            return f"not detumbled: the mean rate over one orbit is not below {bound}"
        return f"detumbled after {time:.5g} s: the mean rate over one orbit is below {bound}"

    def parts(self) -> list[str]:
        """Return the parts of a heading: the first and the last rate, and the detumbling time."""
        first = float(self.rates[0])
        last = float(self.rates[-1])
        meaning = ""
        ending = "shorter than one orbit"
        if not self.is_short:
            last = float(self.means()[-1])
            meaning = " (mean of the last orbit)"
            ending = "not detumbled"
        time = self.slow_after(self.bound)
        if math.isfinite(time):
            ending = f"detumbled after {time:.4g} s"
        first, last = np.degrees((first, last)).tolist()
        return [f"rate {first:.3g} deg/s to {last:.2g} deg/s{meaning}", ending]
