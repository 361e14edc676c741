"""Magnetic flux density at the origin of the orbital frame, in the axes of this frame."""

import math

import numpy as np

from fflin.base.errors import InputError
from fflin.base.validation import Array, vector
from fflin.robot.orbit import DIPOLES, CircularOrbit

# [s] step of the central difference that differentiates a field that is a function. Over this time,
# the field changes by about 1e-3 of its size, so the error of the difference is about 1e-7 of it.
_STEP = 1.0


class MagneticField:
    """Magnetic field of an orbit as a function of time.

    `axes` (3, 3) has three unit vectors as columns: away from the central body, along the orbit,
    and along the orbit normal. In these axes, the flux density of a dipole is

        (-2 a sin i sin u, a sin i cos u, a cos i),    a = moment / radius^3,

    with the inclination i and the argument of latitude u. `amplitudes` (3,) are -2 a sin i, a sin i
    and a cos i; None if the field is a function.
    """

    def __init__(self, orbit: CircularOrbit, axes: Array) -> None:
        self._orbit = orbit
        self._axes = axes
        self._function = orbit.field if callable(orbit.field) else None
        self._sine = math.sin(orbit.inclination)
        self._cosine = math.cos(orbit.inclination)
        self.amplitudes: Array | None = None
        if self._function is None:
            a = DIPOLES[orbit.body] / orbit.radius**3
            self.amplitudes = a * np.array(
                [-2.0 * self._sine, self._sine, self._cosine]
            )

    def at(self, t: float) -> Array:
        """Return the flux density (3,) [T] at time t [s], in the axes of the orbital frame."""
        u = self._orbit.argument_of_latitude + self._orbit.mean_motion * t
        if self.amplitudes is None:
            return self._from_function(t, u)
        waves = np.array([math.sin(u), math.cos(u), 1.0])
        flux: Array = self._axes @ (self.amplitudes * waves)
        return flux

    def rate(self, t: float) -> Array:
        """Return the derivative (3,) [T/s] of `at` with respect to time, in the same axes."""
        if self.amplitudes is None:
            change: Array = (self.at(t + _STEP) - self.at(t - _STEP)) / (2.0 * _STEP)
            return change
        n = self._orbit.mean_motion
        u = self._orbit.argument_of_latitude + n * t
        waves = n * np.array([math.cos(u), -math.sin(u), 0.0])
        rate: Array = self._axes @ (self.amplitudes * waves)
        return rate

    def _from_function(self, t: float, u: float) -> Array:
        """Return the flux density of a field that is a function."""
        assert self._function is not None
        i_sine, i_cosine = self._sine, self._cosine
        u_sine, u_cosine = math.sin(u), math.cos(u)
        outwards = np.array([u_cosine, u_sine * i_cosine, u_sine * i_sine])
        along = np.array([-u_sine, u_cosine * i_cosine, u_cosine * i_sine])
        normal = np.array([0.0, -i_sine, i_cosine])
        given = self._function(t, self._orbit.radius * outwards)
        flux = vector(f"field({t:g}, position)", given, 3, "the flux density [T]")
        if not np.isfinite(flux).all():
            raise InputError(
                f"field({t:g}, position) is not finite; give the flux in T"
            )
        in_axes: Array = self._axes @ np.array([outwards, along, normal]) @ flux
        return in_axes
