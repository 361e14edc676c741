"""Motion of a free-floating base that conservation of momentum implies for a motion of joints."""

from typing import NamedTuple

import numpy as np
import pinocchio as pin

from fflin.base.validation import Array
from fflin.control.optimal.shooting import Point
from fflin.dynamics.state import StateMap
from fflin.robot.joints import ROOT


class Centroidal(NamedTuple):
    """Terms of the centroidal momentum at N joint positions, in base axes.

    With the momentum p and the angular momentum L about the centre of mass, in base axes,

    - ``omega_b = inverse @ L + coupling @ qdot_m``,
    - ``v_b = p / mass - omega_b x center - sliding @ qdot_m``.
    """

    inverse: Array  # inverse inertia about the centre of mass (N, 3, 3)
    coupling: Array  # (N, 3, n)
    center: Array  # centre of mass relative to the origin of the base (N, 3)
    sliding: Array  # derivative of `center` with respect to q_m (N, 3, n)


class FloatingBase:
    """Base of a robot whose inputs do not change its momentum.

    Uniform gravity accelerates the centre of mass. The angular momentum about the centre of mass is
    constant. Both are given by the state `start` at the time 0.
    """

    def __init__(self, state: StateMap, start: Point) -> None:
        robot = state.robot
        self._state = state
        self._model = robot.model
        self._data = robot.create_data()
        self._spread = np.array([state.spread(row) for row in np.eye(6 + robot.n)]).T
        self._gravity = np.array(robot.gravity)
        q, v = start
        data = robot.create_data()
        pin.computeCentroidalMomentum(self._model, data, q, v)
        self._mass = float(data.mass[0])
        self._center: Array = data.com[0].copy()
        self._velocity: Array = data.hg.linear / self._mass
        self.angular_momentum: Array = data.hg.angular.copy()
        self.start_rotation: Array = state.rotation(q)

    def terms(self, joints: Array) -> Centroidal:
        """Return the terms of the momentum at joint positions (N, n)."""
        count, n = joints.shape
        states = np.zeros((count, self._state.nx))
        states[:, 6 : 6 + n] = joints
        _, configurations, _ = self._state.points(states)
        rest = np.zeros(self._model.nv)
        matrices, center = np.empty((count, 6, 6 + n)), np.empty((count, 3))
        for k, q in enumerate(configurations):
            pin.ccrba(self._model, self._data, q, rest)
            matrices[k] = self._data.Ag @ self._spread
            center[k] = self._data.com[0]
        inverse = np.linalg.inv(matrices[:, 3:, :3])
        coupling = -inverse @ matrices[:, 3:, 6:]
        return Centroidal(inverse, coupling, center, matrices[:, :3, 6:] / self._mass)

    def inertia(self, joints: Array) -> Array:
        """Return the generalised inertia (n, n) of the joints if the base floats, at q_m (n,)."""
        states = np.zeros((1, self._state.nx))
        states[0, 6 : 6 + len(joints)] = joints
        _, q, _ = self._state.points(states)
        M = self._spread.T @ pin.crba(self._model, self._data, q[0]) @ self._spread
        reduced: Array = M[6:, 6:] - M[6:, :6] @ np.linalg.solve(M[:6, :6], M[:6, 6:])
        return reduced

    def rotations(self, t: Array, joints: Array) -> Array:
        """Return the rotations of the base (N, 3, 3) along a joint path (N, n) at times t (N,).

        Each interval between two rows is one step of the midpoint rule.
        """
        middle = self.terms(0.5 * (joints[1:] + joints[:-1]))
        h = np.diff(t)[:, None]
        rotations = (middle.coupling @ np.diff(joints, axis=0)[..., None])[..., 0]
        rotating = bool(self.angular_momentum.any())
        R = np.empty((len(t), 3, 3))
        R[0] = self.start_rotation
        for k, rotation in enumerate(rotations):
            if rotating:
                drift = h[k] * middle.inverse[k]
                half = R[k] @ pin.exp3(
                    0.5 * (rotation + drift @ (R[k].T @ self.angular_momentum))
                )
                rotation = rotation + drift @ (half.T @ self.angular_momentum)  # noqa: PLW2901
            R[k + 1] = R[k] @ pin.exp3(rotation)
        return R

    def motion(self, t: Array, joints: Array, rates: Array, R: Array) -> Point:
        """Return q (N, nq) and v (N, nv) for joint positions, joint rates and base rotations."""
        terms = self.terms(joints)
        late = t[:, None]
        center = self._center + late * self._velocity + 0.5 * late**2 * self._gravity
        falling = self._velocity + late * self._gravity
        momentum = (self.angular_momentum @ R)[..., None]
        omega = (terms.inverse @ momentum + terms.coupling @ rates[..., None])[..., 0]
        sliding = (terms.sliding @ rates[..., None])[..., 0]
        nu = np.zeros((len(t), 6 + joints.shape[1]))
        nu[:, :3] = omega
        nu[:, 3:6] = (
            (falling[:, None] @ R)[:, 0] - np.cross(omega, terms.center) - sliding
        )
        nu[:, 6:] = rates
        states = np.zeros((len(t), self._state.nx))
        states[:, 6 : 6 + joints.shape[1]] = joints
        _, q, _ = self._state.points(states)
        position = center - (R @ terms.center[..., None])[..., 0]
        root = self._model.jointPlacements[ROOT]
        for row, rotation, at in zip(q, R, position, strict=True):
            row[:7] = pin.SE3ToXYZQUAT(root.actInv(pin.SE3(rotation, at)))
        return q, self._state.spread(nu)
