"""What a motion conserves: energy and momentum, and the velocity that keeps the latter."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pinocchio as pin
from scipy.linalg.lapack import dposv

from fflin.model import ROOT, Robot
from fflin.rotation import skew
from fflin.validation import Array


class Momenta(NamedTuple):
    """Energy [J], momentum (6,) about the centre of mass, and what base and joints add to it."""

    energy: float
    central: Array
    scale: Array


class Conserved:
    """Energy and momentum of a robot.

    Momentum is angular, then linear, in world axes. Where one point is named it is about that,
    which is fixed.

    Parameters
    ----------
    robot : Robot
    """

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self._model = robot.model
        self._data = robot.create_data()
        self._root = robot.model.jointPlacements[ROOT]
        self._gravity = np.array(robot.gravity)
        self._mass = robot.mass
        self._anywhere = self._root.isIdentity(0.0)
        self._stored = robot.stored_momentum

    def about(self, q: Array, v: Array, point: Array) -> Array:
        """Return the momentum (6,) about a fixed point (3,)."""
        pin.computeCentroidalMomentum(self._model, self._data, q, v)
        hg = self._data.hg.vector
        angular = hg[3:] + skew(self._data.com[0] - point).dot(hg[:3])
        return np.concatenate((angular + self._of_wheels(), hg[:3]))

    def wrench(self, q: Array, force: Array, point: Array) -> Array:
        """Return the wrench (6,) about a point, in world axes, of what pushes the robot.

        `force` (6,) is the generalised force on the base, angular then linear in base axes: the
        sum of all that acts from outside. Gravity is added.
        """
        placement = self._base(q)
        linear = placement.rotation @ force[3:]
        angular = placement.rotation @ force[:3]
        angular += skew(placement.translation - point).dot(linear)
        if self._gravity.any():
            weight = self._mass * self._gravity
            com = pin.centerOfMass(self._model, self._data, q, False)
            angular += skew(com - point).dot(weight)
            linear += weight
        return np.concatenate((angular, linear))

    def impose(self, q: Array, v: Array, momentum: Array, point: Array) -> Array:
        r"""Return v with the base velocity that gives the momentum (6,) about a point.

        .. math:: \nu_b = M_{bb}^{-1} (H_b - M_{bm} \dot q_m)

        The present velocity is corrected by what it lacks, so that rounding is of the second
        order.
        """
        M = pin.crba(self._model, self._data, q)[:6]
        placement = self._base(q)
        R = placement.rotation.T
        target = np.empty(6)
        target[:3] = linear = R.dot(momentum[3:])
        arm = R.dot(point - placement.translation)
        angular = momentum[:3]
        if self._stored:
            pin.forwardKinematics(self._model, self._data, q)
            angular = angular - self._of_wheels()
        target[3:] = R.dot(angular) + skew(arm).dot(linear)
        v = v.copy()
        v[:6] += dposv(M[:, :6], target - M.dot(v))[1]
        return v

    def momenta(self, q: Array, v: Array) -> Momenta:
        """Return energy, momentum, and the largest of what base and joints add to it (2,)."""
        model, data = self._model, self._data
        energy = pin.computeKineticEnergy(model, data, q, v)
        pin.computeCentroidalMomentum(model, data, q, v)
        hg = data.hg.vector
        central = np.concatenate((hg[3:] + self._of_wheels(), hg[:3]))
        energy -= self._mass * float(self._gravity @ data.com[0])
        stiffness, _, rest = self._robot.passive
        if stiffness.any():
            positions = np.array([joint.value(q) for joint in self._robot.joints])
            energy += 0.5 * float(stiffness @ (positions - rest) ** 2)
        maps = pin.computeCentroidalMap(model, data, q)
        base, joints = maps[:, :6] @ v[:6], maps[:, 6:] @ v[6:]
        scale = np.array(
            [np.linalg.norm(base[part]) + np.linalg.norm(joints[part]) for part in _PARTS]
        )
        scale[0] += sum(float(np.linalg.norm(stored)) for _, stored in self._stored)
        return Momenta(float(energy), central, scale)

    def _of_wheels(self) -> Array:
        """Return the stored momentum (3,) where the links were put last."""
        total: Array = np.zeros(3)
        for joint, stored in self._stored:
            total += self._data.oMi[joint].rotation @ stored
        return total

    def _base(self, q: Array) -> pin.SE3:
        placement = pin.XYZQUATToSE3(q[:7])
        return placement if self._anywhere else self._root * placement


_PARTS = (slice(3, 6), slice(0, 3))  # angular, linear in Pinocchio's order
