"""Accelerations at a point and their derivatives, from CRBA's M and the derivatives of RNEA."""

from typing import NamedTuple

import numpy as np
import pinocchio as pin

from fflin.base.rotation import skew
from fflin.base.validation import Array
from fflin.dynamics.actuation import Actuation
from fflin.dynamics.inertia import Inertia
from fflin.dynamics.names import ANGULAR, LINEAR, PIN_ANGULAR
from fflin.dynamics.orbital import GravityGradient, field_of
from fflin.dynamics.state import StateMap


class AccelerationDerivatives(NamedTuple):
    """Accelerations of the base origin and the joints, in base axes, and their derivatives.

    At one point, or with leading axes at many.
    """

    c: Array  # (.., 6 + n) of (3.1): without gravity and omega x v_b
    slopes: Array  # (.., 6 + n, 12 + 2 n) over the state's displacements in base axes, see below
    by_u: Array  # D_u (.., 6 + n, nu) of (3.3), u held in base axes
    gravity: Array  # (.., 3) in base axes

    @property
    def by_turn(self) -> Array:
        """Slopes (.., 6 + n, 3) over a turn of the base: in an orbit (14.5), else zero."""
        return self.slopes[..., :3]

    @property
    def by_q_m(self) -> Array:
        """D_m (.., 6 + n, n) of (3.3)."""
        return self.slopes[..., 6 : self.c.shape[-1]]

    @property
    def by_nu(self) -> Array:
        """D_nu (.., 6 + n, 6 + n) of (3.3), zero over the base's linear velocity."""
        return self.slopes[..., self.c.shape[-1] :]


class Gyroscopic(NamedTuple):
    r"""Gyroscopic torques :math:`-\omega \times h` of stored momentum, and their derivatives."""

    wrenches: pin.StdVec_Force  # on every joint, in its frame
    force: Array  # what they are as a generalised force (nv,)
    # Its slopes (nv, nv); over q with the Jacobian held, for RNEA's with the wrenches has the rest.
    by_q: Array
    by_v: Array


class Accelerations:
    """Solution of ``M nudot + b = B u`` of a robot, with its derivatives, in base axes."""

    def __init__(self, state: StateMap, actuation: Actuation, data: pin.Data) -> None:
        robot = state.robot
        self._state, self._actuation, self._data = state, actuation, data
        self._model, self._nv = robot.model, 6 + robot.n
        self._inertia = Inertia(state, data)
        self._springs = robot.springs
        self._resists = bool(np.any(robot.springs))
        # Derivatives of M a + b - B u - springs over the same as those of the accelerations. The
        # first six columns, over attitude and position of the base, stay zero without an orbit.
        self._force_slopes = np.zeros((self._nv, 2 * self._nv))
        self._by_turn, self._by_q_m = self._force_slopes[:, :3], self._force_slopes[:, 6 : self._nv]
        self._by_nu = self._force_slopes[:, self._nv :]
        # Views of the diagonals on which the derivatives of springs and dampers stand.
        self._of_stiffness = np.einsum("ii->i", self._by_q_m[6:])
        self._of_damping = np.einsum("ii->i", self._by_nu[6:, 6:])
        self._stored = [(joint, skew(momentum)) for joint, momentum in robot.stored_momentum]
        self._field = field_of(robot, state.frame)
        self._still = np.zeros(robot.nq), np.zeros(robot.nv)

    def invert(self, q: Array, out: Array) -> None:
        """Write M^-1 (6 + n, 6 + n) at a valid configuration into a C-contiguous array."""
        self._inertia.invert(q, out, quick=True)

    def rates(
        self, q: Array, v: Array, nu: Array, q_m: Array, u: Array, slopes: Array, by_u: Array
    ) -> AccelerationDerivatives:
        """Return the rates at q, v and u in base axes, v being `nu` and q_m in state order.

        Their slopes and by_u are the C-contiguous arrays of their shapes that are given.
        """
        model, data, state, actuation = self._model, self._data, self._state, self._actuation
        tide = self._field and GravityGradient.at(self._field, q)
        # Without the base's position and linear velocity: nothing here depends on them, and
        # Pinocchio's derivatives lose digits to both. Nor does it depend on gravity, which
        # accelerates the base origin and nothing against it (equivalence).
        q_still, v_still = self._still
        q_still[3:], v_still[3:] = q[3:], v[3:]
        if tide:
            v_still[PIN_ANGULAR] += tide.spin
            pull = tide.force(model, data, q_still)
            pull_by_q, pull_by_turn = tide.slopes(model, data, q_still)
        inverse = by_u if actuation.default else np.empty((self._nv, self._nv))
        self._inertia.invert(q_still, inverse)
        columns = actuation.columns(data, q_still)
        bias = pin.nonLinearEffects(model, data, q_still, v_still)
        gyroscopic = self._gyroscopic(q_still, v_still, u) if self._stored else None
        if gyroscopic:
            bias = bias - gyroscopic.force
        if tide:
            bias = bias - pull
        force = (u if actuation.default else columns.dot(u)) - state.forces(bias)
        if self._resists:
            force[6:] += self._springs.force(q_m, nu[6:])
        c = inverse.dot(force)

        # Derivatives of M a + b - B u - springs (3.3), (7.1). Wrenches are constant in the frames
        # of their links, so that RNEA's derivatives include -d(B u)/dq.
        wrenches = gyroscopic.wrenches if gyroscopic else actuation.wrenches(u)
        external = () if wrenches is None else (wrenches,)
        by_q, by_v, _ = pin.computeRNEADerivatives(
            model, data, q_still, v_still, state.spread(c), *external
        )
        if gyroscopic:
            by_q, by_v = by_q - gyroscopic.by_q, by_v - gyroscopic.by_v
        if tide:
            by_q = by_q - pull_by_q
        self._by_q_m[:], self._by_nu[:] = state.project(by_q)[:, 6:], state.project(by_v)
        self._by_nu[:, LINEAR] = 0.0
        if self._resists:
            self._of_stiffness += self._springs.stiffness
            self._of_damping += self._springs.damping
        if tide:
            by_spin = self._by_nu[:, ANGULAR].dot(skew(tide.spin))
            self._by_turn[:] = by_spin - state.forces(pull_by_turn)
        np.dot(-inverse, self._force_slopes, out=slopes)
        if not actuation.default:
            np.dot(inverse, columns, out=by_u)
        return AccelerationDerivatives(c, slopes, by_u, tide.fall if tide else state.gravity(q))

    def _gyroscopic(self, q: Array, v: Array, u: Array) -> Gyroscopic:
        """Return the torques of stored momentum; the wrenches include the inputs'."""
        model, data, nv = self._model, self._data, len(v)
        # With the angular Jacobian J of a link in its axes, h x omega is J^T [h]x J v (6.3).
        wrenches = self._actuation.wrenches(u)
        if wrenches is None:
            wrenches = pin.StdVec_Force(model.njoints, pin.Force.Zero())
        force, by_q, by_v = np.zeros(nv), np.zeros((nv, nv)), np.zeros((nv, nv))
        pin.computeForwardKinematicsDerivatives(model, data, q, v, np.zeros(nv))
        for joint, momentum in self._stored:
            slopes = pin.getJointVelocityDerivatives(model, data, joint, pin.ReferenceFrame.LOCAL)
            turned, jacobian = (part[PIN_ANGULAR] for part in slopes)
            torque = momentum @ data.v[joint].angular
            wrenches[joint] += pin.Force(np.zeros(3), torque)
            force += jacobian.T @ torque
            by_q += jacobian.T @ momentum @ turned
            by_v += jacobian.T @ momentum @ jacobian
        return Gyroscopic(wrenches, force, by_q, by_v)
