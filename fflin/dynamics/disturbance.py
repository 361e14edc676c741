"""Torque and force that the disturbances of a robot exert on its base."""

import math
from typing import NamedTuple

import numpy as np

from fflin.base.rotation import rotation_matrix
from fflin.base.validation import Array, Values
from fflin.dynamics.coordinates import PIN_ANGULAR, PIN_LINEAR
from fflin.dynamics.orbital import OrbitField
from fflin.robot.disturbance import BASE, INERTIAL, ORBITAL, plates_of, terms_of
from fflin.robot.flat_plate import FlatPlate
from fflin.robot.inputs import BaseForce, BaseTorque
from fflin.robot.joints import ROOT
from fflin.robot.robot import Robot

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


class Plate:
    """Flat plate with its forces as functions of the directions of flight and of the sun.

    `field` is the field of the robot's orbit, or None without an orbit. The world is the orbital
    frame in orbit, and otherwise inertial.
    """

    def __init__(self, plate: FlatPlate, field: OrbitField | None) -> None:
        self._plate = plate
        self._field = field
        self._normal = np.array(plate.normal) / np.linalg.norm(plate.normal)
        self._position = np.array(plate.position)
        self._sun = np.array(plate.sun)
        self._velocity = np.array(plate.velocity)
        # Whether the velocity is given in inertial axes. By default, it is the orbital velocity.
        self._is_inertial = bool(self._velocity.any())

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
        plate = self._plate
        force = np.zeros(3)
        if plate.density:
            velocity = self._velocity
            if self._is_inertial:
                velocity = self._in_world(velocity, t)
            elif self._field is not None:
                velocity = self._field.velocity
            speed = float(np.linalg.norm(velocity))
            direction = (velocity / speed) @ R
            cosine, _ = self._facing(direction)
            pressure = 0.5 * plate.density * speed**2
            force -= pressure * plate.drag_coefficient * plate.area * cosine * direction
        if any(plate.sun):
            sun = self._in_world(self._sun, t)
            direction = (sun / np.linalg.norm(sun)) @ R
            cosine, normal = self._facing(direction)
            along_normal = 2.0 * (plate.specular * cosine + plate.diffuse / 3.0)
            per_pressure = (1.0 - plate.specular) * direction + along_normal * normal
            force -= plate.solar_pressure * plate.area * cosine * per_pressure
        return np.concatenate((force, np.cross(self._position, force)))

    def _facing(self, direction: Array) -> tuple[float, Array]:
        """Return the cosine of the angle of incidence, at least 0, and the normal of the face."""
        cosine = float(self._normal @ direction)
        if cosine >= 0.0:
            return cosine, self._normal
        if self._plate.two_sided:
            return -cosine, -self._normal
        return 0.0, self._normal


class BaseDisturbance:
    """Disturbances of a robot as functions of time and of the attitude of the base.

    `field` is the field of the robot's orbit, or None without an orbit. If `constant` is true, the
    periodic parts are left out.
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
        self._root = robot.model.jointPlacements[ROOT].rotation
        self._field = field

    @property
    def acts(self) -> bool:
        """Whether there is any disturbance."""
        return bool(self.waves or self.plates)

    def clear(self) -> None:
        """Remove all disturbances."""
        self.waves.clear()
        self.plates.clear()

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
        return total
