r"""Derivatives of a linear model with respect to the robot's parameters.

M and RNEA are linear in the ten dynamic parameters of each body. So their derivative with respect
to a dynamic parameter is M or RNEA of a robot in which this parameter is 1 and all others are 0.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
import pinocchio as pin

from fflin.base.errors import InputError
from fflin.base.rotation import skew
from fflin.base.validation import Array
from fflin.dynamics.aba import Aba
from fflin.dynamics.coordinates import LINEAR, PIN_ANGULAR, Standing
from fflin.dynamics.integrators import held_derivatives, held_exponential
from fflin.dynamics.orbital import GravityGradient, field_of
from fflin.dynamics.rnea import AccelerationDerivatives, Accelerations, Inertia
from fflin.dynamics.state import StateMap
from fflin.linear.check import aba_route
from fflin.linear.linearization import Prepared, own_reference
from fflin.linear.model import LinearModel
from fflin.linear.state_equations import assemble, output_equations
from fflin.robot.joints import ROOT
from fflin.robot.outputs import CenterOfMass, Momentum
from fflin.robot.robot import Robot
from fflin.uncertainty.parameters import Parameter

WEIGH = (CenterOfMass, Momentum)

# Step of a finite difference: the relative change of M by the changed parameter.
_STEP = 2e-3
# If such a step changes A or B by less than this fraction, rounding errors hide the change.
_LEAST = 1e-6


class ModelDerivatives:
    """Derivatives of the matrices of a model; `source` is the model in continuous time."""

    def __init__(self, lin: LinearModel, robot: Robot, source: LinearModel) -> None:
        self.lin, self.robot, self._source = lin, robot, source
        own = lin.moving or bool(np.array_equal(lin.placement, own_reference(robot, lin)))
        own = own and robot.orbit is None
        self._how: Any = {"frame": lin.frame, "moving": lin.moving}
        self._how["reference"] = None if own else lin.reference
        ready = self._ready = Prepared(robot, **self._how)
        state, data = ready.map, robot.create_data()
        self._chart = Standing() if own else state.chart(lin.q)
        self._u = ready.actuation.in_base_axes(self._chart, lin.u0)
        nu = state.velocities(lin.v)
        self._rates = Accelerations(state, ready.actuation, data).rates(
            lin.q,
            lin.v,
            nu,
            self._u,
            slopes=np.empty((len(nu), state.nx)),
            by_u=np.empty((len(nu), len(self._u))),
        )
        inverse = np.empty((len(nu), len(nu)))
        centred = lin.q.copy()  # with the base at the origin
        centred[:3] = 0.0
        Inertia(state, data).invert(centred, inverse)
        self.bodies = BodyDerivatives(ready, self._rates, lin.q, lin.v, inverse)

    @cached_property
    def _of_bodies(self) -> AccelerationDerivatives:
        return self.bodies.all()

    def over(self, parameters: Sequence[Parameter]) -> tuple[Array, ...]:
        """Return dA, dB, dC, dD, df0 and dy0 (P, ..)."""
        rates = derivatives_of(parameters, self.bodies, self._of_bodies, self._u)
        # A, B and f0 are affine in the rates. The additional last row has zero rates, so it gives
        # the constant part, which is subtracted below.
        ready, state, nu = self._ready, self._ready.map, self._ready.map.velocities(self.lin.v)
        count, nv = len(rates.c) + 1, len(nu)
        A, B = np.zeros((count, state.nx, state.nx)), np.zeros((count, state.nx, len(self._u)))
        with_none = AccelerationDerivatives(
            np.zeros((count, nv)), A[:, nv:], B[:, nv:], np.zeros((count, 3))
        )
        for part, of_parameters in zip(with_none, rates, strict=True):
            part[:-1] = of_parameters
        f0 = assemble(
            state,
            ready.actuation,
            self._chart,
            nu=np.broadcast_to(nu, (count, nv)),
            u=np.broadcast_to(self._u, (count, len(self._u))),
            rates=with_none,
            A=A,
            moving=ready.moving,
        )
        A, B, f0 = (each[:-1] - each[-1] for each in (A, B, f0))
        if self.lin.dt:
            driven, h = np.column_stack((self._source.B, self._source.f0)), self.lin.dt
            for row in range(len(A)):
                given = np.column_stack((B[row], f0[row]))
                A[row], held = held_derivatives(self._source.A, driven, h, A[row], given)
                B[row], f0[row] = held[:, :-1], held[:, -1]
        C, D, y0 = np.split(self._seen(parameters, rates), (state.nx, -1), axis=2)
        return A, B, C, D, f0, y0[..., 0]

    def _seen(self, parameters: Sequence[Parameter], rates: AccelerationDerivatives) -> Array:
        """Return dC, dD and dy0 side by side (P, ny, ..), for outputs that depend on masses."""
        # If the rates change linearly with a parameter, the robot's mass times such an output is
        # quadratic in the parameter. So a difference of three values is exact for any step.
        lin, now = self.lin, self._rates
        found = np.zeros((len(parameters), len(lin.C), lin.C.shape[1] + lin.D.shape[1] + 1))
        outputs = (o for o in self.robot.outputs if o.FEELS_ACCELERATION or type(o) in WEIGH)
        rows = [lin.output_names.index(name) for o in outputs for name, _ in o.signals]
        if not rows:
            return found
        other = replace(self.robot, model=self.robot.model.copy())
        ready = Prepared(other, **self._how)
        sensing, actuation = ready.sensing, ready.actuation
        assert sensing is not None
        data, point = other.create_data(), (lin.q, lin.v, ready.map.velocities(lin.v), self._u)

        def weighed(one: Parameter, by: Sequence[Array], size: float) -> Array:
            for joint, body in with_bodies(self.robot, one, size).items():
                other.model.inertias[joint] = body
            moved = AccelerationDerivatives(*(a + size * b for a, b in zip(now, by, strict=True)))
            made = output_equations(sensing, actuation, data, self._chart, moved, lin.x0, point)
            seen = np.column_stack((made["C"], made["D"], made["y0"]))[rows]
            total = pin.computeTotalMass(other.model)
            for joint in one.bodies:
                other.model.inertias[joint] = self.robot.model.inertias[joint]
            return total * seen

        total = pin.computeTotalMass(self.robot.model)
        for row, one in enumerate(parameters):
            step = 1.0 / (self.bodies.fraction(one.bodies) or 1.0) if one.bodies else 1.0
            mass = sum(change[0] for change in one.bodies.values())
            of = [weighed(one, [part[row] for part in rates], k * step) for k in (0.0, 1.0, 2.0)]
            derivative = (4.0 * of[1] - of[2] - 3.0 * of[0]) / (2.0 * step)
            found[row, rows] = (derivative - mass * of[0] / total) / total
        return found


def with_bodies(robot: Robot, one: Parameter, size: float) -> dict[int, pin.Inertia]:
    """Return {joint: body} with the changed bodies if a parameter grows by `size`."""
    found = {}
    for joint, change in one.bodies.items():
        changed = robot.model.inertias[joint].toDynamicParameters() + size * change
        found[joint] = pin.Inertia.FromDynamicParameters(changed)
        if not changed[0]:  # a wheel without mass, for which Pinocchio would divide 0 by 0
            about = changed[4:][[[0, 1, 3], [1, 2, 4], [3, 4, 5]]]
            found[joint] = pin.Inertia(0.0, np.zeros(3), about)
    return found


def difference(derivatives: ModelDerivatives, one: Parameter) -> float:
    """Compare the derivatives of A and B with fourth-order differences; return the error."""
    if not one.bodies:
        raise InputError(
            f"'{one.name}' is not a parameter of a link or body; only such parameters can be "
            "checked, for example 'base.mass'"
        )
    lin, robot = derivatives.lin, derivatives.robot
    step = _STEP / derivatives.bodies.fraction(one.bodies)

    def at(times: float) -> tuple[Array, Array]:
        model = robot.model.copy()
        for joint, body in with_bodies(robot, one, times * step).items():
            model.inertias[joint] = body
        state = StateMap(replace(robot, model=model), reference=lin.reference, frame=lin.frame)
        route = aba_route(Aba(state), lin.q, lin.v, lin.u0, moving=lin.moving)
        return held_exponential(*route[:2], lin.dt) if lin.dt else route[:2]

    (dA, dB, *_), worst = derivatives.over([one]), 0.0
    for *stepped, now, exact in zip(
        *map(at, (-2.0, -1.0, 1.0, 2.0, 0.0)), (dA[0], dB[0]), strict=True
    ):
        far, near, nearer, farther = stepped
        by_steps = (far - 8.0 * near + 8.0 * nearer - farther) / (12.0 * step)
        size = max(np.abs(by_steps).max(), _LEAST * np.abs(now).max() / step)
        worst = max(worst, float(np.abs(by_steps - exact).max() / size))
    return worst


_LOCAL = pin.ReferenceFrame.LOCAL
_E = np.eye(3)


def _units() -> Array:
    """Return the spatial inertias (10, 6, 6) per unit of each dynamic parameter.

    Linear rows come before angular rows.
    """
    found = np.zeros((10, 6, 6))
    found[0, :3, :3] = _E
    for axis in range(3):
        found[1 + axis, :3, 3:], found[1 + axis, 3:, :3] = -skew(_E[axis]), skew(_E[axis])
    for at, (i, j) in enumerate(((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2)), 4):
        found[at, 3 + i, 3 + j] = found[at, 3 + j, 3 + i] = 1.0
    return found


UNITS = _units()
# Valid bodies whose parameters span all ten: a mass at the joint, masses away from it, and
# inertias.
_BODIES = (
    pin.Inertia(1.0, np.zeros(3), np.zeros((3, 3))),
    *(pin.Inertia(1.0, axis, np.zeros((3, 3))) for axis in _E),
    *(pin.Inertia(0.0, np.zeros(3), unit[3:, 3:]) for unit in UNITS[4:]),
)
_OF_BODIES = np.linalg.inv([body.toDynamicParameters() for body in _BODIES]).round()


class BodyDerivatives:
    """Derivatives over the ten dynamic parameters of each body at one point, (12.1) and (12.2)."""

    def __init__(
        self, ready: Prepared, rates: AccelerationDerivatives, q: Array, v: Array, inverse: Array
    ) -> None:
        self.state, self.model = ready.map, ready.robot.model
        self.q, self.v, self.inverse = q.copy(), v.copy(), inverse
        # The accelerations do not depend on position and velocity of the base; see `Accelerations`.
        self.q[:3] = self.v[:3] = 0.0
        field = field_of(ready.robot, self.state.frame)
        self._gradient = GravityGradient.at(field, q) if field else None
        if self._gradient:
            self.v[PIN_ANGULAR] += self._gradient.spin
        self.data, self.rates = ready.robot.create_data(), rates
        self.joints = range(ROOT, self.model.njoints)

    def all(self) -> AccelerationDerivatives:
        """Return the derivatives (bodies * 10, ..) of the rates, in Pinocchio's joint order."""
        rates, size = self.rates, len(self.inverse)
        given = np.concatenate((rates.by_u, rates.slopes), axis=1)
        moved = self._by_inertia(given).reshape(-1, size, given.shape[1])
        by_u, by_state = np.split(moved, rates.by_u.shape[1:], axis=2)
        found = AccelerationDerivatives(
            np.zeros((len(moved), size)), by_state, by_u, np.zeros((len(moved), 3))
        )
        if self.v.any() or rates.c.any():
            F, F_q, F_nu, F_turn = self._forces()
            found.c[:] = -F @ self.inverse
            F_q += [
                self._rnea_derivatives(self.model, np.zeros_like(self.v), each)[1]
                for each in found.c
            ]
            found.by_q_m[:] -= self.inverse @ F_q
            found.by_nu[:] -= self.inverse @ F_nu
            found.by_turn[:] -= self.inverse @ F_turn
        found.by_nu[..., LINEAR] = 0.0
        return found

    def fraction(self, changes: Mapping[int, Array]) -> float:
        """Return the largest relative change of M: the spectral radius of M^-1 times the change."""
        of_bodies = self._by_inertia(np.eye(len(self.inverse)))
        total = sum(np.tensordot(change, of_bodies[at - ROOT], 1) for at, change in changes.items())
        return float(np.abs(np.linalg.eigvals(total)).max())

    def _by_inertia(self, given: Array) -> Array:
        """Return -M^-1 M_p (bodies, 10, 6 + n, k) times a matrix (6 + n, k)."""
        pin.computeJointJacobians(self.model, self.data, self.q)
        J = np.array(
            [
                self.state.columns(pin.getJointJacobian(self.model, self.data, joint, _LOCAL))
                for joint in self.joints
            ]
        )
        bodies, _, size = J.shape
        X, k = J @ self.inverse, given.shape[1]
        Z = UNITS.reshape(60, 6) @ (J @ given)
        Z = Z.reshape(bodies, 10, 6, k).transpose(0, 2, 1, 3).reshape(bodies, 6, 10 * k)
        product = -(X.mT @ Z)
        return product.reshape(bodies, size, 10, k).transpose(0, 2, 1, 3)

    def _forces(self) -> tuple[Array, ...]:
        """Return F_p (bodies * 10, 6 + n) and its derivatives over q_m, nu and base rotations."""
        lone = self.model.copy()
        lone.armature = np.zeros_like(lone.armature)
        for joint in range(lone.njoints):
            lone.inertias[joint] = pin.Inertia.Zero()
        found: tuple[list[Array], ...] = ([], [], [], [])
        for joint in self.joints:
            of_bodies = []
            for body in _BODIES:
                lone.inertias[joint] = body
                of_bodies.append(self._rnea_derivatives(lone, self.v, self.rates.c, self._gradient))
            lone.inertias[joint] = pin.Inertia.Zero()
            for kept, values in zip(found, zip(*of_bodies, strict=True), strict=True):
                kept.append(np.tensordot(_OF_BODIES, values, 1))
        return tuple(np.concatenate(each) for each in found)

    def _rnea_derivatives(
        self, model: pin.Model, v: Array, c: Array, gradient: GravityGradient | None = None
    ) -> tuple[Array, ...]:
        """Return the forces of RNEA and their derivatives over q_m, nu and base rotations.

        Springs and inputs are left out.
        """
        state, data, q = self.state, self.data, self.q
        by_turn: Array = np.zeros((len(v), 3))
        if gradient:  # before RNEA, because these calls overwrite Pinocchio's results
            pull = gradient.force(model, data, q)
            pull_by_q, by_turn = gradient.slopes(model, data, q)
        by_q, by_v, _ = pin.computeRNEADerivatives(model, data, q, v, state.spread(c))
        tau = np.array(data.tau)
        if gradient:
            tau, by_q = tau - pull, by_q - pull_by_q
            by_turn = by_v[:, PIN_ANGULAR] @ skew(gradient.spin) - by_turn
        project = state.project
        return state.forces(tau), project(by_q)[:, 6:], project(by_v), state.forces(by_turn)


def derivatives_of(
    parameters: Sequence[Parameter],
    at: BodyDerivatives,
    of_bodies: AccelerationDerivatives,
    u: Array,
) -> AccelerationDerivatives:
    """Return the derivatives (P, ..) of the rates over P parameters; u (nu,) is in base axes."""
    found = AccelerationDerivatives(
        *(np.zeros((len(parameters), *part.shape[1:])) for part in of_bodies)
    )
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


def _of_force(parameter: Parameter, at: BodyDerivatives, u: Array) -> AccelerationDerivatives:
    """Return the derivatives of the rates over a parameter that changes only forces, not bodies."""
    state, rates, size = at.state, at.rates, len(at.inverse)
    F: Array = np.zeros(size)
    B = np.zeros_like(rates.by_u)
    F_q: Array = np.zeros((size, size - 6))
    F_nu = np.zeros((size, size))
    joint = max(parameter.spring, parameter.damper)
    if parameter.spring >= 0:
        rest = state.robot.springs.rest[joint]
        F_q[6 + joint, joint] = parameter.by_stiffness
        F[6 + joint] = parameter.by_stiffness * (state.joint_positions(at.q)[joint] - rest)
    if parameter.damper >= 0:
        F_nu[6 + joint, 6 + joint] = parameter.by_damping
        F[6 + joint] += parameter.by_damping * state.velocities(at.v)[6 + joint]
    if parameter.wrench:
        joint, column, wrench = parameter.wrench
        pin.computeJointJacobians(at.model, at.data, at.q)
        J = pin.getJointJacobian(at.model, at.data, joint, _LOCAL)
        B[:, column] = state.forces(J.T @ wrench)
        F = -B @ u
        if u[column]:
            pushed = pin.StdVec_Force(at.model.njoints, pin.Force.Zero())
            pushed[joint] = pin.Force(wrench * u[column])
            at_rest = np.zeros_like(at.v)
            by_q = pin.computeRNEADerivatives(at.model, at.data, at.q, at_rest, at_rest, pushed)[0]
            F_q = state.project(by_q)[:, 6:]
    found = AccelerationDerivatives(
        -at.inverse @ F, np.zeros((size, 2 * size)), at.inverse @ B, np.zeros(3)
    )
    if found.c.any():
        F_q = F_q + at._rnea_derivatives(at.model, np.zeros_like(at.v), found.c)[1]
    found.by_q_m[:], found.by_nu[:] = -at.inverse @ F_q, -at.inverse @ F_nu
    return found
