"""Accelerations and their derivatives by ABA, for simulations and for checks of linear models."""

import numpy as np
import pinocchio as pin

from fflin.base.rotation import skew
from fflin.base.validation import Array
from fflin.dynamics.classical import ClassicalConstraints, Conditioning
from fflin.dynamics.coordinates import PIN_ANGULAR
from fflin.dynamics.state import Actuation, StateMap


def scaled_inverse(matrix: Array) -> Array:
    """Return the inverse of a symmetric positive definite matrix, scaled to a unit diagonal.

    Without the scaling, a matrix of coordinates of very different inertia would lose digits.
    """
    scale = 1.0 / np.sqrt(np.diagonal(matrix))
    inverse: Array = (
        scale[:, None] * np.linalg.inv(scale[:, None] * matrix * scale) * scale
    )
    return inverse


class Aba:
    """Nonlinear dynamics of a robot with all its forces; base velocities are in base axes."""

    def __init__(self, state: StateMap) -> None:
        robot = state.robot
        self.state = state
        self.actuation = Actuation(state)
        self._data = robot.create_data()
        self._weightless = robot.model
        self._model = robot.model.copy()
        self._model.gravity.linear = np.array(robot.gravity)
        # M^-1 in base axes, which the last call of `slopes` computed by ABA.
        self.inverse: Array = np.zeros((6 + robot.n, 6 + robot.n))
        self.field = state.field
        self._resists = bool(np.any(robot.springs))
        self._none = pin.StdVec_Force(robot.model.njoints, pin.Force.Zero())
        self._constraints: ClassicalConstraints | None = None
        if robot.constraints:
            self._constraints = ClassicalConstraints(state)

    def acceleration(
        self, q: Array, v: Array, u: Array, tau: Array | None = None
    ) -> Array:
        """Return dv/dt (nv,) in Pinocchio's order.

        In `u`, the torque and force on the base are in base axes. `tau` (nv,) is an additional
        generalised force in Pinocchio's order.
        """
        forces = self.actuation.fixed @ u
        if self.actuation.torquers:
            forces += self._magnetic_columns(q) @ u
        if self._resists:
            forces += self._passive_force(q, v)
        if tau is not None:
            forces += self.state.forces(tau)
        absolute = v
        if self.field:
            absolute = self.field.absolute(q, v)
        wrenches = self._wrenches(q, absolute, u)
        rate = self._accelerate(self._model, q, absolute, forces, wrenches)
        if self.field:
            return self.field.relative(q, v, absolute, rate)
        return rate

    def constraint_forces(self, q: Array, v: Array, u: Array) -> dict[str, Array]:
        """Return {constraint: wrench (6,)} at a point, see `ClassicalConstraints.forces`."""
        assert self._constraints is not None
        forces = self.actuation.fixed @ u + self._passive_force(q, v)
        absolute = self.field.absolute(q, v) if self.field else v
        wrenches = self._wrenches(q, absolute, u)
        free = self._free_acceleration(self._model, q, absolute, forces, wrenches)
        return self._constraints.forces(q, absolute, free)

    def accelerations(
        self, q: Array, v: Array, u: Array, t: Array | None = None
    ) -> Array:
        """Return dv/dt (N, nv) at N points, computed as in `acceleration`.

        `t` (N,) are the times [s] of the points, by default the time of `state`.
        """
        state = self.state
        if t is not None and state.varying:
            rates = np.empty_like(v)
            for k, time in enumerate(t.tolist()):
                state.move_to(time)
                rates[k] = self.acceleration(q[k], v[k], u[k])
            return rates
        if (
            self.field
            or state.robot.followers
            or state.robot.stored_momentum
            or self._constraints
        ):
            return np.array(
                [self.acceleration(*point) for point in zip(q, v, u, strict=True)]
            )
        forces = u @ self.actuation.fixed.T
        if self._resists:
            forces += self._passive_force(q, v)
        tau = state.lift(forces.T).T
        rates = np.empty_like(v)
        for k, point in enumerate(zip(q, v, tau, strict=True)):
            wrenches = self.actuation.wrenches(u[k]) or self._none
            rates[k] = pin.aba(self._model, self._data, *point, wrenches)
        return rates

    def terms(self, q: Array, v: Array, u: Array) -> Array:
        """Return, for each entry of dnu/dt (6 + n,), the sum of the magnitudes of its terms.

        The sum excludes gyroscopic torques of wheels without inertia.
        """
        state, data = self.state, self._data
        M = state.project(pin.crba(self._model, data, q).T)
        columns = self.actuation.columns(data, q)
        bias = state.forces(pin.nonLinearEffects(self._model, data, q, v))
        forces = (
            np.abs(columns) @ np.abs(u)
            + np.abs(bias)
            + np.abs(self._passive_force(q, v))
        )
        if self.field:
            pin.forwardKinematics(self._model, data, q)
            forces += self.field.force_sizes(data, M)
        total: Array = np.abs(np.linalg.inv(M)) @ forces
        return total

    def conditioning(self, q: Array, v: Array) -> Conditioning:
        """Return the condition of the constraints at a point, see `Conditioning`."""
        assert self._constraints is not None
        return self._constraints.conditioning(q, v)

    def slopes(self, q: Array, v: Array, u: Array) -> tuple[Array, Array, Array]:
        """Return the derivatives of dnu/dt with respect to the tangent of q, to nu and to u.

        The derivatives (6 + n, ..) are in state order. In `u`, the torque and force on the base are
        in base axes.
        """
        # Wrenches of thrusters are constant in the frames of their links, so the derivative with
        # respect to q includes d(B u)/dq. The derivatives with respect to u are the accelerations
        # that unit inputs cause at rest without gravity.
        state = self.state
        stiffness, damping, _ = state.robot.springs
        tau = state.lift(self.actuation.fixed @ u + self._passive_force(q, v))
        field = self.field
        given_point = q, v
        if field:
            q, v = field.near(q, v)
        external = self._wrenches(q, v, u)
        if state.robot.followers:
            assert state.S is not None
            by_q, by_v, by_force = self._constrained_derivatives(
                q, v, external, tau, state.S
            )
        else:
            if self._constraints is None:
                slopes = pin.computeABADerivatives(
                    self._model, self._data, q, v, tau, external
                )
            else:
                slopes = self._held_derivatives(q, v, tau, external)
            by_q, by_v, by_force = state.velocities(np.array(slopes).mT).mT
            by_q, by_v = state.columns(by_q), state.columns(by_v)
            by_force = state.velocities(by_force)
        self.inverse = by_force
        at_rest = np.zeros_like(v)
        for joint, momentum in state.robot.stored_momentum:
            pin.computeForwardKinematicsDerivatives(
                self._model, self._data, q, v, at_rest
            )
            local = self._model, self._data, joint, pin.ReferenceFrame.LOCAL
            # Derivatives, with respect to q and v, of the angular velocity of the link that carries
            # the wheel. They are in the axes of this link.
            turning, jacobian = (
                x[PIN_ANGULAR] for x in pin.getJointVelocityDerivatives(*local)
            )
            torque = by_force @ state.forces(jacobian.T) @ skew(momentum)
            by_q += torque @ state.columns(turning)
            by_v += torque @ state.columns(jacobian)
        by_q[:, 6:] -= by_force[:, 6:] * stiffness
        by_v[:, 6:] -= by_force[:, 6:] * damping
        if field:
            pin.computeJointJacobians(self._model, self._data, q)
            by_q += by_force @ state.forces(state.columns(field.slopes(self._data)))
            field.add_turning(*given_point, by_q, by_v)
        by_u = []
        columns = self.actuation.fixed
        if self.actuation.torquers:
            columns = columns + self._magnetic_columns(given_point[0])
        for unit, forces in zip(np.eye(len(u)), columns.T, strict=True):
            wrenches = self.actuation.wrenches(unit) or self._none
            rate = self._accelerate(self._weightless, q, at_rest, forces, wrenches)
            by_u.append(state.velocities(rate))
        return by_q, by_v, np.column_stack(by_u)

    def _magnetic_columns(self, q: Array) -> Array:
        """Return the generalised forces (6 + n, nu) of magnetorquers for unit inputs."""
        flux = self.actuation.flux(self.state.t)
        return self.actuation.magnetic_columns(self._data, q, flux)

    def _wrenches(self, q: Array, v: Array, u: Array) -> pin.StdVec_Force:
        """Return the wrench on each link from inputs, gyroscopic torques and gravity gradient."""
        stored = self.state.robot.stored_momentum
        wrenches = self.actuation.wrenches(u)
        wrenches = wrenches or self._none
        if not (stored or self.field):
            return wrenches
        total = pin.StdVec_Force(wrenches)
        pin.forwardKinematics(self._model, self._data, q, v)
        for joint, momentum in stored:
            torque = -np.cross(self._data.v[joint].angular, momentum)
            total[joint] += pin.Force(np.zeros(3), torque)
        if self.field:
            for joint, pull in enumerate(self.field.wrenches(self._data)):
                total[joint] += pull
        return total

    def _passive_force(self, q: Array, v: Array) -> Array:
        stiffness, damping, rest = self.state.robot.springs
        force = np.zeros((*q.shape[:-1], 6 + self.state.robot.n))
        force[..., 6:] -= stiffness * (self.state.joint_positions(q) - rest)
        force[..., 6:] -= damping * self.state.velocities(v)[..., 6:]
        return force

    def _held_derivatives(
        self, q: Array, v: Array, tau: Array, external: pin.StdVec_Force
    ) -> tuple[Array, Array, Array]:
        """Return the derivatives of dv/dt with constraints, with respect to q, v and tau.

        Pinocchio's constrained dynamics have no wrenches on links. So the wrenches become
        generalised forces, whose derivatives with respect to q are added.
        """
        assert self._constraints is not None
        at_rest = np.zeros_like(v)
        point = (self._weightless, self._data, q, at_rest, at_rest, external)
        force = -pin.rnea(*point)
        force_by_q = -pin.computeRNEADerivatives(*point)[0]
        by_q, by_v, by_force = self._constraints.derivatives(
            self._model, q, v, tau + force
        )
        return by_q + by_force @ force_by_q, by_v, by_force

    def _accelerate(
        self,
        model: pin.Model,
        q: Array,
        v: Array,
        forces: Array,
        external: pin.StdVec_Force,
    ) -> Array:
        rate = self._free_acceleration(model, q, v, forces, external)
        if self._constraints is None:
            return rate
        return self._constraints.constrained(q, v, rate)

    def _free_acceleration(
        self,
        model: pin.Model,
        q: Array,
        v: Array,
        forces: Array,
        external: pin.StdVec_Force,
    ) -> Array:
        state = self.state
        if not state.robot.followers:
            rates: Array = pin.aba(
                model, self._data, q, v, state.lift(forces), external
            )
            return rates
        # Mimic joints: solve S^T M S nudot = S^T (tau - b) with M from CRBA.
        M = state.project(pin.crba(model, self._data, q))
        bias = pin.rnea(model, self._data, q, v, np.zeros(model.nv), external)
        return state.spread(scaled_inverse(M) @ (forces - state.forces(bias)))

    def _constrained_derivatives(
        self, q: Array, v: Array, external: pin.StdVec_Force, tau: Array, S: Array
    ) -> tuple[Array, Array, Array]:
        """Return the derivatives of dnu/dt for a robot with mimic joints, in state order.

        The derivatives are with respect to q, to v and to generalised forces. S is `StateMap.S`.
        """
        # The accelerations satisfy S^T M S nudot = S^T (tau - b), without the constraint forces of
        # mimic joints. ABA requires an invertible M, but M is singular if a mimic joint or its
        # leader moves no mass. Therefore each mimic joint and each leader gets a rotor. The inertia
        # of the rotor is the diagonal entry of S^T M S for the coordinate of the leader. The
        # contribution of the rotors to S^T M S is subtracted afterwards.
        state, data = self.state, self._data
        shared = S @ state.project(pin.crba(self._model, data, q)).diagonal()
        model = self._model.copy()
        rotor = np.zeros(model.nv)
        for joint, leader, *_ in state.robot.followers:
            rotor[[joint.idx_v, leader.idx_v]] = shared[leader.idx_v]
        model.armature = model.armature + rotor
        with_rotor = scaled_inverse(pin.computeMinverse(model, data, q))
        by_force = scaled_inverse(S.T @ with_rotor @ S - (S.T * rotor) @ S)
        to_independent = by_force @ S.T @ with_rotor
        free = pin.aba(model, data, q, v, tau, external)
        in_step = tau + with_rotor @ (S @ (to_independent @ free) - free)
        by_q, by_v, _ = pin.computeABADerivatives(model, data, q, v, in_step, external)
        return to_independent @ by_q @ S, to_independent @ by_v @ S, by_force
