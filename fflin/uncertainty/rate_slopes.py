r"""Derivatives of the accelerations and their Jacobians with respect to the robot's parameters.

M and RNEA are linear in the ten dynamic parameters of a body. The derivative with respect to one of
them is therefore M or RNEA of bodies that consist of the unit change alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pinocchio as pin

from fflin.base.rotation import skew
from fflin.base.validation import Array
from fflin.dynamics.names import LINEAR, PIN_ANGULAR
from fflin.dynamics.orbital import field_of
from fflin.dynamics.rnea import Rates
from fflin.dynamics.tidal import Tide
from fflin.linear.prepared import Prepared
from fflin.robot.frames import ROOT
from fflin.uncertainty.parameters import Parameter

_LOCAL = pin.ReferenceFrame.LOCAL
_E = np.eye(3)


def _units() -> Array:
    """Return the spatial inertias (10, 6, 6) of a unit of each dynamic parameter, linear first."""
    found = np.zeros((10, 6, 6))
    found[0, :3, :3] = _E
    for axis in range(3):
        found[1 + axis, :3, 3:], found[1 + axis, 3:, :3] = -skew(_E[axis]), skew(_E[axis])
    for at, (i, j) in enumerate(((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2)), 4):
        found[at, 3 + i, 3 + j] = found[at, 3 + j, 3 + i] = 1.0
    return found


_UNITS = _units()
# Bodies that Pinocchio can hold, whose parameters span all ten: at the joint, and beside it.
_BODIES = (
    pin.Inertia(1.0, np.zeros(3), np.zeros((3, 3))),
    *(pin.Inertia(1.0, axis, np.zeros((3, 3))) for axis in _E),
    *(pin.Inertia(0.0, np.zeros(3), unit[3:, 3:]) for unit in _UNITS[4:]),
)
_OF_BODIES = np.linalg.inv([body.toDynamicParameters() for body in _BODIES]).round()


class BodySlopes:
    """Derivatives over the ten dynamic parameters of every body at one point, (12.1) and (12.2)."""

    def __init__(self, ready: Prepared, rates: Rates, q: Array, v: Array, inverse: Array) -> None:
        self.state, self.model = ready.map, ready.robot.model
        self.q, self.v, self.inverse = q.copy(), v.copy(), inverse
        # Nothing depends on where the base is and how fast it moves along, see `Accelerations`.
        self.q[:3] = self.v[:3] = 0.0
        field = field_of(ready.robot, self.state.frame)
        self._tide = Tide.at(field, q) if field else None
        if self._tide:
            self.v[PIN_ANGULAR] += self._tide.spin
        self.data, self.rates = ready.robot.create_data(), rates
        self.joints = range(ROOT, self.model.njoints)

    def all(self) -> Rates:
        """Return them as rates, (bodies * 10, ..), of the joints in Pinocchio's order."""
        rates, size = self.rates, len(self.inverse)
        given = np.concatenate((rates.by_u, rates.slopes), axis=1)
        moved = self._by_inertia(given).reshape(-1, size, given.shape[1])
        by_u, slopes = np.split(moved, rates.by_u.shape[1:], axis=2)
        found = Rates(np.zeros((len(moved), size)), slopes, by_u, np.zeros((len(moved), 3)))
        if self.v.any() or rates.c.any():
            F, F_q, F_nu, F_turn = self._forces()
            found.c[:] = -F @ self.inverse
            F_q += [self._slope(self.model, np.zeros_like(self.v), each)[1] for each in found.c]
            found.by_q_m[:] -= self.inverse @ F_q
            found.by_nu[:] -= self.inverse @ F_nu
            found.by_turn[:] -= self.inverse @ F_turn
        found.by_nu[..., LINEAR] = 0.0
        return found

    def share(self, changes: Mapping[int, Array]) -> float:
        """Return how much of M a change of bodies is at the most: the radius of M^-1 M_p."""
        of_bodies = self._by_inertia(np.eye(len(self.inverse)))
        total = sum(np.tensordot(change, of_bodies[at - ROOT], 1) for at, change in changes.items())
        return float(np.abs(np.linalg.eigvals(total)).max())

    def _by_inertia(self, given: Array) -> Array:
        """Return -M^-1 M_p times a matrix (6 + n, k): (bodies, 10, 6 + n, k)."""
        pin.computeJointJacobians(self.model, self.data, self.q)
        J = np.array(
            [
                self.state.columns(pin.getJointJacobian(self.model, self.data, joint, _LOCAL))
                for joint in self.joints
            ]
        )
        bodies, _, size = J.shape
        X, k = J @ self.inverse, given.shape[1]
        Z = _UNITS.reshape(60, 6) @ (J @ given)
        Z = Z.reshape(bodies, 10, 6, k).transpose(0, 2, 1, 3).reshape(bodies, 6, 10 * k)
        product = -(X.mT @ Z)
        return product.reshape(bodies, size, 10, k).transpose(0, 2, 1, 3)

    def _forces(self) -> tuple[Array, ...]:
        """Return F_p (bodies * 10, 6 + n), F_qp over q_m, F_nup, and in orbit that over turns."""
        lone = self.model.copy()
        lone.armature = np.zeros_like(lone.armature)
        for joint in range(lone.njoints):
            lone.inertias[joint] = pin.Inertia.Zero()
        found: tuple[list[Array], ...] = ([], [], [], [])
        for joint in self.joints:
            of_bodies = []
            for body in _BODIES:
                lone.inertias[joint] = body
                of_bodies.append(self._slope(lone, self.v, self.rates.c, self._tide))
            lone.inertias[joint] = pin.Inertia.Zero()
            for kept, values in zip(found, zip(*of_bodies, strict=True), strict=True):
                kept.append(np.tensordot(_OF_BODIES, values, 1))
        return tuple(np.concatenate(each) for each in found)

    def _slope(
        self, model: pin.Model, v: Array, c: Array, tide: Tide | None = None
    ) -> tuple[Array, ...]:
        """Return RNEA and its slopes over q_m, nu and turns, without springs and inputs."""
        state, data, q = self.state, self.data, self.q
        by_turn: Array = np.zeros((len(v), 3))
        if tide:  # first, as what Pinocchio returns is overwritten
            pull = tide.force(model, data, q)
            pull_by_q, by_turn = tide.slopes(model, data, q)
        by_q, by_v, _ = pin.computeRNEADerivatives(model, data, q, v, state.spread(c))
        tau = np.array(data.tau)
        if tide:
            tau, by_q = tau - pull, by_q - pull_by_q
            by_turn = by_v[:, PIN_ANGULAR] @ skew(tide.spin) - by_turn
        project = state.project
        return state.forces(tau), project(by_q)[:, 6:], project(by_v), state.forces(by_turn)


def slopes_of(parameters: Sequence[Parameter], at: BodySlopes, of_bodies: Rates, u: Array) -> Rates:
    """Return the derivatives of the rates over each parameter, (P, ..); u (nu,) in base axes."""
    found = Rates(*(np.zeros((len(parameters), *part.shape[1:])) for part in of_bodies))
    for block, joint in enumerate(at.joints):
        rows = [row for row, each in enumerate(parameters) if joint in each.bodies]
        changes = np.array([parameters[row].bodies[joint] for row in rows])
        for part, own in zip(found, of_bodies, strict=True):
            if rows:
                part[rows] += np.tensordot(changes, own[10 * block : 10 * block + 10], 1)
    for row, each in enumerate(parameters):
        if not each.bodies:
            for part, own in zip(found, _of_force(each, at, u), strict=True):
                part[row] = own
    return found


def _of_force(parameter: Parameter, at: BodySlopes, u: Array) -> Rates:
    """Return the derivatives over what changes the forces alone: F_p, F_qp, F_nup and B_p."""
    state, rates, size = at.state, at.rates, len(at.inverse)
    F: Array = np.zeros(size)
    B = np.zeros_like(rates.by_u)
    F_q: Array = np.zeros((size, size - 6))
    F_nu = np.zeros((size, size))
    joint = max(parameter.spring, parameter.damper)
    if parameter.spring >= 0:
        rest = state.robot.springs.rest[joint]
        F[6 + joint], F_q[6 + joint, joint] = state.joint_positions(at.q)[joint] - rest, 1.0
    if parameter.damper >= 0:
        F[6 + joint], F_nu[6 + joint, 6 + joint] = state.velocities(at.v)[6 + joint], 1.0
    if parameter.wrench:
        joint, column, wrench = parameter.wrench
        pin.computeJointJacobians(at.model, at.data, at.q)
        J = pin.getJointJacobian(at.model, at.data, joint, _LOCAL)
        B[:, column] = state.forces(J.T @ wrench)
        F = -B @ u
        if u[column]:
            pushed = pin.StdVec_Force(at.model.njoints, pin.Force.Zero())
            pushed[joint] = pin.Force(wrench * u[column])
            still = np.zeros_like(at.v)
            by_q = pin.computeRNEADerivatives(at.model, at.data, at.q, still, still, pushed)[0]
            F_q = state.project(by_q)[:, 6:]
    found = Rates(-at.inverse @ F, np.zeros((size, 2 * size)), at.inverse @ B, np.zeros(3))
    if found.c.any():
        F_q = F_q + at._slope(at.model, np.zeros_like(at.v), found.c)[1]
    found.by_q_m[:], found.by_nu[:] = -at.inverse @ F_q, -at.inverse @ F_nu
    return found
