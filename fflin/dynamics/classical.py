"""Constraints in world axes, and Pinocchio's constrained dynamics, for checks of linear models.

`fflin.dynamics.constraints` computes the same constraints by spatial algebra in the axes of their
frames. Here, they are velocities and classical accelerations of points and angular velocities of
bodies in world axes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pinocchio as pin

from fflin.base.rotation import skew
from fflin.base.validation import Array
from fflin.dynamics.constraints import Constraints
from fflin.dynamics.state import StateMap
from fflin.robot.constraints import Hinge, Spherical
from fflin.robot.joints import ROOT, Carried

_WORLD = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED

# Relative singular values of the scaled rows below this are rounding errors.
_ZERO = 1e-9

# Number of iterations of Pinocchio's proximal solver.
_ITERATIONS = 10

# The solver does not iterate if the first solution is exact, such as at rest. Then its derivatives
# have an error that is a power series in the regularisation. The sum of the derivatives with these
# {factor of the regularisation: weight} has only an error of fourth order.
_EXTRAPOLATION = {1.0: -1 / 21, 0.5: 2 / 3, 0.25: -8 / 3, 0.125: 64 / 21}
# Coefficient of the error: the product of the factors.
_FOURTH = 1 / 64

# Assumed rounding error [ulp] of the solver, relative to the condition of J M^-1 J^T.
_ULPS = 8.0

# Distance [m] between the two points that represent a hinge in Pinocchio.
_HINGE = 0.5


class Conditioning(NamedTuple):
    """Condition of the constraints, and accuracy of Pinocchio's solver.

    The solver inverts J M^-1 J^T + mu E. In the directions of redundant rows, its rounding errors
    grow by the largest eigenvalue divided by mu. In the direction of the smallest eigenvalue that
    is not zero, the extrapolated error is the fourth power of the ratio of mu to this eigenvalue.
    """

    # smallest eigenvalue of J M^-1 J^T that is not zero
    least: float
    # ratio of the largest to the smallest singular value of J M^(-1/2)
    condition: float

    @property
    def regularisation(self) -> float:
        """Ratio of mu to the smallest eigenvalue at which both errors are equal."""
        ratio: float = (self._rounding / _FOURTH) ** 0.2
        return ratio

    @property
    def error(self) -> float:
        """Relative error of the derivatives, the sum of both."""
        return 2.0 * self._rounding / self.regularisation

    @property
    def _rounding(self) -> float:
        """Rounding error of the solver for mu equal to the smallest eigenvalue."""
        return _ULPS * float(np.finfo(float).eps) * self.condition**2


class _Body(NamedTuple):
    """Motion of a point of a body in world axes, with zero joint accelerations."""

    linear: Array  # Jacobian (3, nv) of the velocity of the point
    angular: Array  # Jacobian (3, nv) of the angular velocity
    acceleration: Array  # classical acceleration (3,) of the point
    turning: Array  # angular acceleration (3,)
    omega: Array  # angular velocity (3,)
    rotation: Array  # rotation matrix (3, 3) of the frame


class ClassicalConstraints:
    """Constraints of a robot in world axes; velocities and accelerations in state order."""

    def __init__(self, state: StateMap) -> None:
        self.state = state
        self.frames = Constraints(state.robot)
        self._model = state.robot.model
        self._data = state.robot.create_data()

    def constrained(self, q: Array, v: Array, rate: Array) -> Array:
        """Return the constrained dv/dt (nv,) from the free dv/dt at q and v."""
        state = self.state
        rows, bias = self.rows(q, v)
        scaled, scale, factor = self._scaled(q, rows)
        free = state.velocities(rate)
        missing = -(rows @ free + bias)
        change = np.linalg.lstsq(scaled, missing, rcond=_ZERO)[0]
        free = free + scale * np.linalg.solve(factor.T, change)
        constrained: Array = state.spread(free)
        return constrained

    def forces(self, q: Array, v: Array, free: Array) -> dict[str, Array]:
        """Return {constraint: wrench (6,)} on frame 2 in the axes of frame 1.

        `free` (nv,) is dv/dt without constraints. Of redundant forces, it returns one solution.
        """
        state = self.state
        rows, _ = self.rows(q, v)
        M = state.project(pin.crba(self._model, self._data, q).T)
        change = state.velocities(self.constrained(q, v, free) - free)
        multipliers = np.linalg.lstsq(rows.T, M @ change, rcond=_ZERO)[0]
        wrenches = {}
        pin.forwardKinematics(self._model, self._data, q)
        for pair in self.frames.pairs:
            given = multipliers[pair.rows]
            joint = self._data.oMi[pair.first.joint]
            R = joint.rotation @ pair.first.placement.rotation
            torque: Array = np.zeros(3)
            if isinstance(pair.constraint, Hinge):
                torque = pair.selected[3:, 3:].T @ given[3:]
            elif not isinstance(pair.constraint, Spherical):
                torque = given[3:]
            wrenches[pair.constraint.title] = np.concatenate((R.T @ given[:3], torque))
        return wrenches

    def rows(self, q: Array, v: Array) -> tuple[Array, Array]:
        """Return the rows (k, 6 + n) of the constraints and their bias (k,)."""
        pin.computeJointJacobians(self._model, self._data, q)
        pin.forwardKinematics(self._model, self._data, q, v, np.zeros_like(v))
        rows, biases = [], []
        for pair in self.frames.pairs:
            first, second = self._body(pair.first), self._body(pair.second)
            rows.append(second.linear - first.linear)
            biases.append(second.acceleration - first.acceleration)
            if isinstance(pair.constraint, Spherical):
                continue
            across: Array = np.eye(3)
            if isinstance(pair.constraint, Hinge):
                across = pair.selected[3:, 3:].T
            across = first.rotation @ across
            apart = second.omega - first.omega
            rows.append(across.T @ (second.angular - first.angular))
            turned = np.cross(first.omega, across.T)
            biases.append(across.T @ (second.turning - first.turning) + turned @ apart)
        return self.state.columns(np.vstack(rows)), np.concatenate(biases)

    def _body(self, frame: Carried) -> _Body:
        model, data = self._model, self._data
        if frame.joint < ROOT:
            none = np.zeros((3, model.nv))
            still = np.zeros(3)
            return _Body(none, none, still, still, still, frame.placement.rotation)
        jacobian = pin.getJointJacobian(model, data, frame.joint, _WORLD)
        velocity = pin.getVelocity(model, data, frame.joint, _WORLD)
        rate = pin.getClassicalAcceleration(model, data, frame.joint, _WORLD)
        R = data.oMi[frame.joint].rotation
        lever = R @ frame.placement.translation
        omega = velocity.angular.copy()
        rotating = skew(omega)
        return _Body(
            linear=jacobian[:3] - skew(lever) @ jacobian[3:],
            angular=jacobian[3:],
            acceleration=rate.linear
            + (skew(rate.angular) + rotating @ rotating) @ lever,
            turning=rate.angular.copy(),
            omega=omega,
            rotation=R @ frame.placement.rotation,
        )

    def derivatives(
        self, model: pin.Model, q: Array, v: Array, tau: Array
    ) -> tuple[Array, Array, Array]:
        """Return the derivatives of the constrained dv/dt with respect to q, v and tau.

        Pinocchio computes them, with a hinge as two points on its axis.
        """
        at = self.conditioning(q, v)
        mu = at.regularisation * at.least
        total = np.zeros((3, model.nv, model.nv))
        for factor, weight in _EXTRAPOLATION.items():
            settings = pin.ProximalSettings(0.0, factor * mu, _ITERATIONS)
            total += weight * self._regularised(model, q, v, tau, settings)
        by_q, by_v, by_tau = total
        return by_q, by_v, by_tau

    def conditioning(self, q: Array, v: Array) -> Conditioning:
        """Return the condition of the constraints at a point.

        The smallest eigenvalue of J M^-1 J^T is the square of a singular value. Near a singular
        posture, rounding errors of the largest eigenvalue would hide it.
        """
        rows, _ = self.rows(q, v)
        scaled, _, _ = self._scaled(q, rows)
        sizes = np.linalg.svd(scaled, compute_uv=False)
        least = float(sizes[sizes > _ZERO * sizes[0]][-1])
        return Conditioning(least**2, float(sizes[0]) / least)

    def _scaled(self, q: Array, rows: Array) -> tuple[Array, Array, Array]:
        """Return the rows in coordinates of unit inertia, the scale of these, and a factor of M.

        In the scaled coordinates, the inertia is W W^T with the Cholesky factor W. The rows are
        W^-1 times the scaled rows, transposed.
        """
        state = self.state
        M = state.project(pin.crba(self._model, self._data, q).T)
        scale = 1.0 / np.sqrt(M.diagonal())
        factor = np.linalg.cholesky(scale[:, None] * M * scale)
        scaled = np.linalg.solve(factor, (rows * scale).T).T
        return scaled, scale, factor

    def _regularised(
        self,
        model: pin.Model,
        q: Array,
        v: Array,
        tau: Array,
        settings: pin.ProximalSettings,
    ) -> Array:
        """Return the derivatives (3, nv, nv) by Pinocchio's solver with given settings."""
        models = self._models(model)
        contacts = pin.StdVec_RigidConstraintModel()
        data_of = pin.StdVec_RigidConstraintData()
        for item in models:
            contacts.append(item)
            data_of.append(item.createData())
        data = model.createData()
        pin.initConstraintDynamics(model, data, contacts, data_of)
        pin.constraintDynamics(model, data, q, v, tau, contacts, data_of, settings)
        derivatives = pin.computeConstraintDynamicsDerivatives(
            model, data, contacts, data_of, settings
        )
        return np.array(derivatives[:3])

    def _models(self, model: pin.Model) -> list[pin.RigidConstraintModel]:
        """Return Pinocchio's models of all constraints."""
        models = []
        for pair in self.frames.pairs:
            first, second = pair.first, pair.second
            shifts = [np.zeros(3)]
            kind = pin.ContactType.CONTACT_3D
            if isinstance(pair.constraint, Hinge):
                shifts.append(_HINGE * np.array(pair.constraint.axis))
            elif not isinstance(pair.constraint, Spherical):
                kind = pin.ContactType.CONTACT_6D
            for shift in shifts:
                point = pin.SE3(np.eye(3), shift)
                models.append(
                    pin.RigidConstraintModel(
                        kind,
                        model,
                        first.joint,
                        first.placement * point,
                        second.joint,
                        second.placement * point,
                        pin.ReferenceFrame.LOCAL,
                    )
                )
        return models
