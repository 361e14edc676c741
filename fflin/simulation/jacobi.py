"""The Jacobi integral, the energy that a motion in orbit conserves in the orbit's frame (14.3)."""

import numpy as np
import pinocchio as pin

from fflin.base.validation import Array
from fflin.dynamics.orbital import OrbitField
from fflin.robot.robot import Robot
from fflin.simulation.conservation import Conserved, Histories


class Jacobi(Conserved):
    """Energy relative to the frame, and the work done on it in place of the impulse."""

    def __init__(self, robot: Robot, start: Array, field: OrbitField) -> None:
        super().__init__(robot, start)
        self._field, self._scale = field, 0.0

    def about_point(self, history: Histories) -> Array:
        """Return zeros (N, 6), to which the work is added in the first place."""
        return np.zeros_like(history.momentum)

    def wrench(self, q: Array, push: Array) -> Array:
        """Return the power (1,) and zeros (5,) of a plant's push."""
        return push

    def histories(self, q: Array, v: Array) -> Histories:
        """Return what there is at each row, with the energies of tide and turning frame."""
        found, potential = super().histories(q, v), np.empty(len(q))
        for i, q_i in enumerate(q):
            pin.forwardKinematics(self._model, self._data, q_i)
            potential[i] = self._field.potential(self._data)
        self._scale = float((np.abs(found.energy) + np.abs(potential)).max())
        return found._replace(energy=found.energy + potential)

    def momentum_drift(self, history: Histories, expected: Array) -> Array:
        """Return how far the integral is from its first value and the work since, relative."""
        missing = np.abs(history.energy - history.energy[0] - expected[:, 0])
        return missing / (self._scale or 1.0)


def conserved_by(robot: Robot, start: Array, field: OrbitField | None) -> Conserved:
    """Return what a robot's motion from a configuration (nq,) conserves."""
    return Conserved(robot, start) if field is None else Jacobi(robot, start, field)
