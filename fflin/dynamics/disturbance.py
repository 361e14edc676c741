"""Torque and force that the disturbances of a robot exert on its base."""

import math
from typing import NamedTuple

import numpy as np

from fflin.base.rotation import rotation_matrix
from fflin.base.validation import Array, Values
from fflin.dynamics.coordinates import PIN_ANGULAR, PIN_LINEAR
from fflin.dynamics.magnetic import DistortedField, MagneticField, distortion_of
from fflin.dynamics.orbital import OrbitField
from fflin.robot.disturbance import (
    BASE,
    FIELD_ROTATION,
    FIELD_SCALE,
    INERTIAL,
    ORBITAL,
    RESIDUAL_DIPOLE,
    magnetic_values,
    plates_of,
    terms_of,
)
from fflin.robot.flat_plate import FlatPlate
from fflin.robot.inputs import BaseForce, BaseTorque
from fflin.robot.joints import ROOT
from fflin.robot.robot import Robot

# Times in an orbit at which the wrench of flat plates is computed, and the largest harmonic of the
# orbit in their periodic part. The coefficients decay with the square of the harmonic.
_TIMES = 2048
_HARMONICS = 128
# Coefficients below this fraction of the largest one are rounding errors.
_ROUNDING = 1e-12

_ROWS = {BaseTorque.GROUP: PIN_ANGULAR, BaseForce.GROUP: PIN_LINEAR}

# A constant is a wave of frequency 0 at this phase [rad], because sin(pi / 2) = 1.
QUARTER = 0.5 * math.pi


class Wave(NamedTuple):
    """Torque or force on the base: vector times sin(rate t + phase)."""

    name: str  # "tau_b" or "F_b"
    axes: str  # "base", "inertial" or "orbital"
    vector: tuple[float, float, float]  # [N m | N]
    rate: float = 0.0  # [rad/s]
    phase: float = QUARTER  # [rad]


def waves_of(robot: Robot) -> list[Wave]:
    """Return the disturbances of a robot as waves; a constant is a wave of frequency 0."""
    waves = list[Wave]()
    for name, term in terms_of(robot.disturbance):
        axes = term.axes_in(name, orbit=robot.orbit is not None)
        if any(term.constant):
            waves.append(Wave(name, axes, term.constant))
        if term.periodic:
            rate = 2.0 * math.pi * term.frequency
            waves.append(Wave(name, axes, term.amplitude, rate, term.phase))
    return waves


class Phasor(NamedTuple):
    """Torque or force on the base: real part of vector times exp(j rate t)."""

    name: str  # "tau_b" or "F_b"
    axes: str  # "base" or "orbital"; without an orbit, "inertial" in place of "orbital"
    vector: Values  # (3,) of complex [N m | N]
    rate: float  # [rad/s], at least 0


def phasors_of(robot: Robot, field: OrbitField | None) -> list[Phasor]:
    """Return the disturbances of a robot as phasors; constants have the rate 0.

    `field` is the field of the robot's orbit, or None without an orbit. A vector with inertial axes
    rotates in the orbital frame, so that it has the rate of the orbit there.
    """
    phasors = list[Phasor]()
    for name, axes, vector, rate, phase in waves_of(robot):
        # sin(rate t + phase) is the real part of `wave` times exp(j rate t).
        wave = -1j * np.exp(1j * phase)
        if not rate:
            wave = math.sin(phase) + 0j
        value = np.array(vector) + 0j
        if axes != INERTIAL or field is None:
            phasors.append(Phasor(name, axes, wave * value, rate))
            continue
        orbit_rate = float(np.linalg.norm(field.rate))
        normal = field.rate / orbit_rate
        along = normal * normal.dot(value)
        phasors.append(Phasor(name, ORBITAL, wave * along, rate))
        # The part in the orbit plane rotates backwards: it is the real part of `turning` times
        # exp(j orbit_rate t). The product of two real parts has the sum and the difference of
        # their rates.
        turning = value - along + 1j * np.cross(normal, value)
        if not rate:
            phasors.append(Phasor(name, ORBITAL, wave * turning, orbit_rate))
            continue
        total = 0.5 * turning * wave
        difference = 0.5 * turning * np.conj(wave)
        if rate > orbit_rate:
            difference = np.conj(difference)
        phasors.append(Phasor(name, ORBITAL, total, orbit_rate + rate))
        phasors.append(Phasor(name, ORBITAL, difference, abs(orbit_rate - rate)))
    return phasors


def _unit(vector: Array) -> Array:
    """Return a vector with the length 1, or a zero vector unchanged."""
    length = float(np.linalg.norm(vector))
    if not length:
        return vector
    unit: Array = vector / length
    return unit


class Plate:
    """Flat plate with its forces as functions of the directions of flight and of the sun.

    `field` is the field of the robot's orbit, or None without an orbit. The world is the orbital
    frame in orbit, and otherwise inertial.
    """

    def __init__(self, plate: FlatPlate, field: OrbitField | None) -> None:
        self.plate = plate
        self._field = field
        self.normal = _unit(np.array(plate.normal))
        self.position = np.array(plate.position)
        # Unit vector to the sun in inertial axes; zero without solar pressure.
        self.sun = _unit(np.array(plate.sun))
        self._velocity = np.array(plate.velocity)
        # Whether the velocity is given in inertial axes. By default, it is the orbital velocity.
        self.flow_is_inertial = bool(self._velocity.any())
        # Solar pressure times area [N].
        self.sunlight = 0.0
        if any(plate.sun):
            self.sunlight = plate.solar_pressure * plate.area

    def _velocity_now(self) -> Array:
        """Return the velocity [m/s] in inertial axes, or in the axes of the orbital frame."""
        if self.flow_is_inertial or self._field is None:
            return self._velocity
        return self._field.velocity

    @property
    def flow(self) -> Array:
        """Unit vector along the velocity; zero without a velocity."""
        return _unit(self._velocity_now())

    @property
    def drag(self) -> float:
        """Drag [N] if the plate is normal to the velocity; 0 without drag."""
        plate = self.plate
        square = float(self._velocity_now() @ self._velocity_now())
        return 0.5 * plate.density * square * plate.drag_coefficient * plate.area

    def _in_world(self, vector: Array, t: float) -> Array:
        """Return an inertial vector in the axes of the world at time t [s]."""
        if self._field is None:
            return vector
        turned: Array = self._field.turned(t).T @ vector
        return turned

    def wrench(self, t: float, R: Array) -> Array:
        """Return force and torque (6,) in base axes at time t [s]; R is the attitude of the base.

        See (11.7) and (11.8).
        """
        plate = self.plate
        force = np.zeros(3)
        if plate.density:
            flow = self.flow
            if self.flow_is_inertial:
                flow = self._in_world(flow, t)
            direction = flow @ R
            cosine, _ = self._facing(direction)
            force -= self.drag * cosine * direction
        if self.sunlight:
            direction = self._in_world(self.sun, t) @ R
            cosine, normal = self._facing(direction)
            along_normal = 2.0 * (plate.specular * cosine + plate.diffuse / 3.0)
            per_pressure = (1.0 - plate.specular) * direction + along_normal * normal
            force -= self.sunlight * cosine * per_pressure
        return np.concatenate((force, np.cross(self.position, force)))

    def _facing(self, direction: Array) -> tuple[float, Array]:
        """Return the cosine of the angle of incidence, at least 0, and the normal of the face."""
        cosine = float(self.normal @ direction)
        if cosine >= 0.0:
            return cosine, self.normal
        if self.plate.two_sided:
            return -cosine, -self.normal
        return 0.0, self.normal


def plate_phasors(
    robot: Robot, field: OrbitField | None, R: Array
) -> dict[float, Values]:
    """Return {rate [rad/s]: phasor (6,)} of force and torque of the flat plates, in base axes.

    R (3, 3) is the constant attitude of the base in the world. `field` is the field of a circular
    orbit, or None without an orbit. The wrench is the sum of the real parts of phasor times
    exp(j rate t), up to the harmonic `_HARMONICS` of the orbit.
    """
    plates = [Plate(plate, field) for plate in plates_of(robot.disturbance)]
    if not plates:
        return {}
    if field is None:
        constant = sum((plate.wrench(0.0, R) for plate in plates), np.zeros(6))
        return {0.0: constant + 0j}
    rate = float(np.linalg.norm(field.rate))
    times = np.arange(_TIMES) * (2.0 * math.pi / rate / _TIMES)
    wrenches = np.zeros((_TIMES, 6))
    for plate in plates:
        wrenches += [plate.wrench(t, R) for t in times.tolist()]
    coefficients = np.fft.rfft(wrenches, axis=0)[: _HARMONICS + 1] / _TIMES
    coefficients[1:] *= 2.0
    largest = np.abs(coefficients).max()
    return {
        harmonic * rate: phasor
        for harmonic, phasor in enumerate(coefficients)
        if np.abs(phasor).max() > _ROUNDING * largest
    }


def distortion(robot: Robot, field: OrbitField) -> Array | None:
    """Return the matrix (3, 3) of the errors of the magnetic field, or None without errors."""
    (scale,) = magnetic_values(robot.disturbance, FIELD_SCALE)
    rotation = magnetic_values(robot.disturbance, FIELD_ROTATION)
    if not scale and not any(rotation):
        return None
    return distortion_of(field.axes, scale, np.array(rotation))


def true_field(robot: Robot, field: OrbitField) -> MagneticField | DistortedField:
    """Return the magnetic field of an orbit with the errors that the robot's disturbance adds."""
    magnetic = field.magnetic
    assert magnetic is not None
    matrix = distortion(robot, field)
    return magnetic if matrix is None else DistortedField(magnetic, matrix)


class BaseDisturbance:
    """Disturbances of a robot as functions of time and of the attitude of the base.

    `field` is the field of the robot's orbit, or None without an orbit. If `constant` is true, the
    periodic parts and the torque of the residual dipole are left out.
    """

    def __init__(
        self, robot: Robot, field: OrbitField | None, *, constant: bool = False
    ) -> None:
        self.waves = waves_of(robot)
        if constant:
            self.waves = [wave for wave in self.waves if not wave.rate]
        self.periodic = any(wave.rate for wave in self.waves)
        plates = plates_of(robot.disturbance)
        self.plates = [Plate(plate, field) for plate in plates]
        # Residual dipole [A m^2] in base axes, and the magnetic field that acts on it.
        self.dipole = np.array(magnetic_values(robot.disturbance, RESIDUAL_DIPOLE))
        self._magnetic: MagneticField | DistortedField | None = None
        if self.dipole.any() and field is not None and not constant:
            self._magnetic = true_field(robot, field)
        self._root = robot.model.jointPlacements[ROOT].rotation
        self._field = field

    @property
    def acts(self) -> bool:
        """Whether there is any disturbance."""
        return bool(self.waves or self.plates or self._magnetic)

    def clear(self) -> None:
        """Remove all disturbances."""
        self.waves.clear()
        self.plates.clear()
        self._magnetic = None

    def wrench(self, t: float, q: Array) -> Array:
        """Return force and torque (6,) on the base, in base axes, at time t [s] and q (nq,)."""
        total: Array = np.zeros(6)
        R = self._root @ rotation_matrix(q[3:7])
        for wave in self.waves:
            value = np.array(wave.vector) * math.sin(wave.rate * t + wave.phase)
            if wave.axes == INERTIAL and self._field:
                value = self._field.turned(t).T @ value
            if wave.axes != BASE:
                value = value @ R
            total[_ROWS[wave.name]] += value
        for plate in self.plates:
            total += plate.wrench(t, R)
        if self._magnetic is not None:
            total[PIN_ANGULAR] += np.cross(self.dipole, self._magnetic.at(t) @ R)
        return total
