"""Detumbling by magnetorquers: the B-dot law, and damping of the measured rate."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pinocchio as pin

from fflin.base.errors import InputError
from fflin.base.rotation import rotation_matrix
from fflin.base.validation import Array, positive
from fflin.control.policy import BDotForm, Command, Policy
from fflin.dynamics.coordinates import PIN_ANGULAR, Frame
from fflin.dynamics.disturbance import true_field
from fflin.dynamics.state import Actuation, StateMap
from fflin.robot.inputs import has_magnetorquers
from fflin.robot.joints import ROOT
from fflin.robot.robot import Robot

_FRAME: Frame = "lvlh"

# Smallest divisor |b|^2 [T^2].
TINY = float(np.finfo(float).tiny)


@dataclass(frozen=True)
class _MagneticLaw(Policy):
    """Law whose moments are the components of a vector along the axes of the magnetorquers."""

    gain: float

    # Unit of the gain, and whether the law measures the rate of the base.
    _UNIT: ClassVar[str]
    _MEASURES_RATE: ClassVar[bool]

    def __post_init__(self) -> None:
        object.__setattr__(self, "gain", positive("gain", self.gain, self._UNIT))

    @property
    def axes(self) -> tuple[Frame | None, pin.SE3 | None]:
        """Frame of the simulated motion, and None, because any reference is accepted."""
        return _FRAME, None

    def form(self, robot: Robot) -> BDotForm:
        """Return the gain of the law for a robot."""
        return BDotForm(self._gains(_actuation(robot)), self._MEASURES_RATE)

    def bind(self, robot: Robot) -> Command:
        """Return the law as a function of t, q and v."""
        actuation = _actuation(robot)
        gains = self._gains(actuation)
        measure = measured_field(robot, rate=self._MEASURES_RATE)

        def command(t: float, q: Array, v: Array) -> Array:
            vector = measure(t, q, v)
            if self._MEASURES_RATE:
                b, omega = np.split(vector, 2)
                # Without a field, the vector is zero.
                vector = np.cross(b, omega) / max(float(b @ b), TINY)
            u: Array = gains @ vector
            return u

        return command

    def _gains(self, actuation: Actuation) -> Array:
        """Return the gain (nu, 3) for the measured vector in base axes."""
        gains = np.zeros((len(actuation.names), 3))
        for joint, index, axis in actuation.torquers:
            if joint != ROOT:
                raise InputError(
                    f"{actuation.names[index]} is mounted on a link that moves relative to the "
                    f"base, but {self.kind} requires magnetorquers on the base"
                )
            gains[index] = -self.gain * axis
        return gains


@dataclass(frozen=True)
class BDot(_MagneticLaw):
    r"""B-dot law, which slows down the rotation of a satellite by magnetorquers.

    Each magnetorquer with the axis s receives the command :math:`-k\, s^T \dot b`, with the
    derivative of the magnetic flux density b in base axes. A magnetometer on the base measures it
    without errors. The mean angular velocity relative to inertial space falls to about twice the
    orbital rate, because the law follows the rotation of the field. All other inputs are zero.

    Parameters
    ----------
    gain : float
        Gain k [A m^2 s/T], positive. A usual value is :math:`2 n (1 + \sin i) J / |b|^2`, with the
        mean motion n, the inclination i of the orbit to the magnetic equator, and the smallest
        principal moment of inertia J.

    Raises
    ------
    InputError
        If the gain is not positive. When the law is used: if the robot has no magnetorquers, or if
        a magnetorquer is not fixed on the base.

    Examples
    --------
    >>> orbit = fflin.CircularOrbit(500e3, inclination=1.7, field="dipole")
    >>> rods = [fflin.Magnetorquer(axis, max=0.2) for axis in np.eye(3)]
    >>> robot = fflin.load("cubesat", inputs=rods, orbit=orbit)
    >>> v0 = fflin.velocity(robot, {"omega_b": 0.05})
    >>> motion = fflin.simulate(robot, fflin.BDot(2e4), v0=v0, duration=600.0, dt=1.0)
    >>> bool(np.linalg.norm(motion.v[-1, 3:6]) < np.linalg.norm(v0[3:6]))
    True
    """

    _UNIT: ClassVar[str] = "A m^2 s/T"
    _MEASURES_RATE: ClassVar[bool] = False


@dataclass(frozen=True)
class RateDamping(_MagneticLaw):
    r"""Damping of the rotation by magnetorquers, from the measured angular velocity.

    Each magnetorquer with the axis s receives the command
    :math:`k\, s^T (\omega \times b) / |b|^2`, with the magnetic flux density b and the angular
    velocity :math:`\omega` relative to inertial space. Three orthogonal magnetorquers then exert
    the torque -k times the part of :math:`\omega` across the field. In contrast to `BDot`, the
    rotation relative to inertial space approaches zero. A magnetometer and a gyroscope on the base
    measure without errors. All other inputs are zero.

    Parameters
    ----------
    gain : float
        Gain k [N m s], positive. A usual value is :math:`2 n (1 + \sin i) J`, with the mean motion
        n, the inclination i of the orbit to the magnetic equator, and the smallest principal moment
        of inertia J.

    Raises
    ------
    InputError
        If the gain is not positive. When the law is used: if the robot has no magnetorquers, or if
        a magnetorquer is not fixed on the base.

    Examples
    --------
    >>> robot = fflin.load("cubesat_magnetic")
    >>> v0 = fflin.velocity(robot, {"omega_b": 0.05})
    >>> motion = fflin.simulate(robot, fflin.RateDamping(3e-5), v0=v0, duration=600.0, dt=1.0)
    >>> bool(np.linalg.norm(motion.v[-1, 3:6]) < np.linalg.norm(v0[3:6]))
    True
    """

    _UNIT: ClassVar[str] = "N m s"
    _MEASURES_RATE: ClassVar[bool] = True


def measured_field(
    robot: Robot, *, rate: bool
) -> Callable[[float, Array, Array], Array]:
    """Return a function of t, q and v for the vectors that a law of the magnetic field measures.

    With `rate`, they are the flux density (3,) [T] and the inertial angular velocity (3,) [rad/s],
    and otherwise the derivative (3,) [T/s] of the flux density. All are in base axes.
    """
    orbit = StateMap(robot, frame=_FRAME).field
    assert orbit is not None
    field = true_field(robot, orbit)
    root = robot.model.jointPlacements[ROOT].rotation

    def measure(t: float, q: Array, v: Array) -> Array:
        R = root @ rotation_matrix(q[3:7])
        b = field.at(t) @ R
        if rate:
            orbit.move_to(t)
            omega = v[PIN_ANGULAR] + orbit.rate @ R
            return np.concatenate((b, omega))
        derivative: Array = field.rate(t) @ R + np.cross(b, v[PIN_ANGULAR])
        return derivative

    return measure


def _actuation(robot: Robot) -> Actuation:
    """Return the actuation of a robot; raise `InputError` if it has no magnetorquers."""
    if not has_magnetorquers(robot.inputs):
        raise InputError(
            f"'{robot.name}' has no magnetorquers for this law; give it inputs such as "
            "Magnetorquer((1, 0, 0), max=0.2)"
        )
    return Actuation(StateMap(robot, frame=_FRAME))
