"""Detumbling by magnetorquers: the B-dot law."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from fflin.base.errors import InputError
from fflin.base.rotation import rotation_matrix
from fflin.base.validation import Array, positive
from fflin.control.policy import BDotForm, Command, Policy
from fflin.dynamics.coordinates import PIN_ANGULAR, Frame
from fflin.dynamics.state import Actuation, StateMap
from fflin.robot.inputs import has_magnetorquers
from fflin.robot.joints import ROOT
from fflin.robot.robot import Robot

_FRAME: Frame = "lvlh"


@dataclass(frozen=True)
class BDot(Policy):
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

    gain: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "gain", positive("gain", self.gain, "A m^2 s/T"))

    @property
    def axes(self) -> tuple[Frame | None, pin.SE3 | None]:
        """Frame of the simulated motion, and None, because any reference is accepted."""
        return _FRAME, None

    def form(self, robot: Robot) -> BDotForm:
        """Return the gain of the law for a robot."""
        return BDotForm(self._gains(_actuation(robot)))

    def bind(self, robot: Robot) -> Command:
        """Return the law as a function of t, q and v."""
        actuation = _actuation(robot)
        gains = self._gains(actuation)
        state = actuation.state
        assert state.field is not None
        field = state.field.magnetic
        assert field is not None
        root = robot.model.jointPlacements[ROOT].rotation

        def command(t: float, q: Array, v: Array) -> Array:
            R = root @ rotation_matrix(q[3:7])
            rate = field.rate(t) @ R + np.cross(field.at(t) @ R, v[PIN_ANGULAR])
            u: Array = gains @ rate
            return u

        return command

    def _gains(self, actuation: Actuation) -> Array:
        """Return the gain (nu, 3) for the derivative of the flux density in base axes."""
        gains = np.zeros((len(actuation.names), 3))
        for joint, index, axis in actuation.torquers:
            if joint != ROOT:
                raise InputError(
                    f"{actuation.names[index]} is mounted on a link that moves relative to the "
                    "base, but BDot requires magnetorquers on the base"
                )
            gains[index] = -self.gain * axis
        return gains


def _actuation(robot: Robot) -> Actuation:
    """Return the actuation of a robot; raise `InputError` if it has no magnetorquers."""
    if not has_magnetorquers(robot.inputs):
        raise InputError(
            f"'{robot.name}' has no magnetorquers, which BDot commands; give it inputs such as "
            "Magnetorquer((1, 0, 0), max=0.2)"
        )
    return Actuation(StateMap(robot, frame=_FRAME))
