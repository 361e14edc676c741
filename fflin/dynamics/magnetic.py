"""Magnetic flux density at the origin of the orbital frame, in the axes of this frame."""

import math
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from fflin.base.errors import InputError
from fflin.base.rotation import skew
from fflin.base.validation import Array, Values, vector
from fflin.robot.orbit import (
    DIPOLES,
    MAGNETIC_POLES,
    TILTED_DIPOLE,
    CircularOrbit,
    EllipticOrbit,
    MagneticPole,
)

# [s] step of the central difference that differentiates a field that is a function. Over this time,
# the field changes by about 1e-3 of its size, so the error of the difference is about 1e-7 of it.
_STEP = 1.0

_NORTH = np.array([0.0, 0.0, 1.0])


class _Position(NamedTuple):
    """Position on an orbit at one time."""

    latitude: float  # argument of latitude u [rad]
    rate: float  # du/dt [rad/s]
    radius: float  # r [m]
    climb: float  # (dr/dt) / r [1/s]


class MagneticField:
    """Magnetic field of an orbit as a function of time.

    `axes` (3, 3) has three unit vectors as columns: away from the central body, along the orbit,
    and along the orbit normal. In these axes, a dipole whose north pole is in the direction p has
    the flux density

        a (-2 p_1, p_2, p_3),    a = moment / radius^3.

    Attributes
    ----------
    moment : float
        Moment [T m^3] of the dipole; 0 if the field is a function.
    pole : MagneticPole
        Pole p of the dipole. Its longitude [rad] at t = 0 is relative to the ascending node. A
        dipole along the rotation axis has the colatitude 0.
    """

    def __init__(self, orbit: CircularOrbit | EllipticOrbit, axes: Array) -> None:
        self._orbit = orbit
        self._axes = axes
        self._function = orbit.field if callable(orbit.field) else None
        self._sine = math.sin(orbit.inclination)
        self._cosine = math.cos(orbit.inclination)
        self.moment = 0.0
        if self._function is None:
            self.moment = DIPOLES[orbit.body]
        self.pole = MagneticPole(0.0, 0.0, 0.0)
        if orbit.field == TILTED_DIPOLE:
            colatitude, longitude, rate = MAGNETIC_POLES[orbit.body]
            self.pole = MagneticPole(colatitude, longitude - orbit.node_longitude, rate)

    @property
    def rotates(self) -> bool:
        """Whether the field rotates with the central body."""
        return self.pole.rate != 0.0

    def at(self, t: float) -> Array:
        """Return the flux density (3,) [T] at time t [s], in the axes of the orbital frame."""
        now = self._position(t)
        directions = self._directions(now.latitude)
        if self._function is not None:
            return self._from_function(t, now.radius * directions[0], directions)
        pole = directions @ self._pole(t)
        flux: Array = self._axes @ self._dipole(now, pole)
        return flux

    def rate(self, t: float) -> Array:
        """Return the derivative (3,) [T/s] of `at` with respect to time, in the same axes."""
        if self._function is not None:
            change: Array = (self.at(t + _STEP) - self.at(t - _STEP)) / (2.0 * _STEP)
            return change
        now = self._position(t)
        directions = self._directions(now.latitude)
        pole = directions @ self._pole(t)
        # The pole moves with the central body, and the axes rotate about the orbit normal.
        pole_rate = directions @ (self.pole.rate * skew(_NORTH) @ self._pole(t))
        pole_rate += now.rate * np.array([pole[1], -pole[0], 0.0])
        flux = self._dipole(now, pole)
        flux_rate = self._dipole(now, pole_rate) - 3.0 * now.climb * flux
        rate: Array = self._axes @ flux_rate
        return rate

    def phasors(self) -> dict[float, Values] | None:
        """Return the flux density as {rate [rad/s]: complex amplitude (3,) [T]}.

        The flux density is the sum of the real parts of amplitude times exp(j rate t). Return None
        unless the field is a dipole along the rotation axis, and the orbit is circular.
        """
        orbit = self._orbit
        if not isinstance(orbit, CircularOrbit) or self._function is not None:
            return None
        if self.rotates:
            return None
        a = self.moment / orbit.radius**3
        wave = a * self._sine * np.exp(1j * orbit.argument_of_latitude)
        constant = np.array([0.0, 0.0, a * self._cosine + 0j])
        periodic = np.array([2j * wave, wave, 0.0])
        return {0.0: self._axes @ constant, orbit.mean_motion: self._axes @ periodic}

    def _position(self, t: float) -> _Position:
        """Return the position on the orbit at time t [s]."""
        orbit = self._orbit
        if isinstance(orbit, CircularOrbit):
            n = orbit.mean_motion
            u = orbit.argument_of_latitude + n * t
            return _Position(u, n, orbit.radius, 0.0)
        now = orbit.at(t)
        u = orbit.argument_of_perigee + now.angle
        # The gradient is mu / r^3.
        climb = -now.gradient_change / now.gradient / 3.0
        return _Position(u, now.rate, now.radius, climb)

    def _directions(self, u: float) -> Array:
        """Return three unit vectors as rows (3, 3), in inertial axes, at the latitude u [rad].

        They point away from the central body, along the orbit and along the orbit normal.
        """
        i_sine, i_cosine = self._sine, self._cosine
        u_sine, u_cosine = math.sin(u), math.cos(u)
        outwards = [u_cosine, u_sine * i_cosine, u_sine * i_sine]
        along = [-u_sine, u_cosine * i_cosine, u_cosine * i_sine]
        normal = [0.0, -i_sine, i_cosine]
        return np.array([outwards, along, normal])

    def _pole(self, t: float) -> Array:
        """Return the unit vector (3,) to the north pole of the dipole, in inertial axes."""
        longitude = self.pole.longitude + self.pole.rate * t
        size = math.sin(self.pole.colatitude)
        x = size * math.cos(longitude)
        y = size * math.sin(longitude)
        return np.array([x, y, math.cos(self.pole.colatitude)])

    def _dipole(self, now: _Position, pole: Array) -> Array:
        """Return the flux density (3,) of a dipole along `pole` (3,)."""
        a = self.moment / now.radius**3
        flux: Array = a * np.array([-2.0 * pole[0], pole[1], pole[2]])
        return flux

    def _from_function(self, t: float, position: Array, directions: Array) -> Array:
        """Return the flux density (3,) of a field that is a function."""
        assert self._function is not None
        given = self._function(t, position)
        flux = vector(f"field({t:g}, position)", given, 3, "the flux density [T]")
        if not np.isfinite(flux).all():
            raise InputError(
                f"field({t:g}, position) is not finite; give the flux in T"
            )
        in_axes: Array = self._axes @ directions @ flux
        return in_axes


class DistortedField:
    """Magnetic field that differs from the field of the orbit.

    The matrix `distortion` (3, 3), in the axes of the orbital frame, multiplies the flux density of
    `field`.
    """

    def __init__(self, field: MagneticField, distortion: Array) -> None:
        self._field = field
        self._distortion = distortion

    def at(self, t: float) -> Array:
        """Return the flux density (3,) [T] at time t [s]."""
        flux: Array = self._distortion @ self._field.at(t)
        return flux

    def rate(self, t: float) -> Array:
        """Return the derivative (3,) [T/s] of `at` with respect to time."""
        change: Array = self._distortion @ self._field.rate(t)
        return change


def distortion_of(axes: Array, scale: float, rotation: Array) -> Array:
    """Return the matrix (3, 3) that rotates and scales a magnetic field.

    The columns of `axes` (3, 3) are as in `MagneticField`. The vector `rotation` (3,) [rad] is in
    the axes `lvlh`, and the field is multiplied by 1 + `scale`.
    """
    outwards, along, normal = axes.T
    lvlh = np.column_stack((along, -normal, -outwards))
    matrix: Array = (1.0 + scale) * pin.exp3(lvlh @ rotation)
    return matrix
