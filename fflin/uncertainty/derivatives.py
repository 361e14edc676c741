r"""Derivatives of a linear model with respect to the robot's parameters.

The inertia matrix M and the inverse dynamics (RNEA) are linear in the ten dynamic parameters of
each body. So the derivative of M with respect to one of these parameters is equal to M of another
robot. In that robot, this parameter is 1 and all other parameters are 0. Likewise, the derivative
of RNEA is equal to RNEA of that robot.

A change F of the generalised forces changes the accelerations by -M^-1 F. If the robot has
constraints, it changes the accelerations and the constraint forces by `HeldForces.response` times
F. The rows of all derivatives of accelerations are then followed by the rows of the derivatives of
constraint forces.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from fflin.base.errors import InputError
from fflin.base.rotation import skew
from fflin.base.validation import Array, Indices
from fflin.dynamics.aba import Aba
from fflin.dynamics.closure import closure_of
from fflin.dynamics.coordinates import (
    ANGULAR,
    LINEAR,
    PIN_ANGULAR,
    Chart,
    ReferenceChart,
)
from fflin.dynamics.integrators import held_derivatives, held_exponential
from fflin.dynamics.orbital import GravityGradient
from fflin.dynamics.rnea import AccelerationDerivatives, Accelerations, Inertia
from fflin.dynamics.state import StateMap
from fflin.linear.aba_route import aba_route
from fflin.linear.linearization import Prepared, own_reference
from fflin.linear.model import LinearModel
from fflin.linear.state_equations import assemble, output_equations
from fflin.robot.joints import ROOT
from fflin.robot.outputs import CenterOfMass, Momentum
from fflin.robot.robot import Robot
from fflin.uncertainty.held_forces import HeldForces
from fflin.uncertainty.parameters import Parameter

WEIGH = (CenterOfMass, Momentum)

# Relative change of M in one step of the finite differences.
_STEP = 2e-3
# Errors of dA are divided by the largest entry of dA. But if a step changes A by less than this
# fraction of A, rounding errors dominate the finite differences. In this case, errors of dA are
# divided by the derivative that would change A by this fraction in a step. The same applies to B.
_LEAST = 1e-6
# Pinocchio's solver has relative errors of 1e-11 if rows of the constraints are redundant.
_LEAST_OF_REDUNDANT = 1e-3

_LOCAL = pin.ReferenceFrame.LOCAL
_E = np.eye(3)

# Ten bodies whose dynamic parameters form a basis: a mass at the joint, three masses away from the
# joint, and six inertias without mass. The inertias need not be physically realisable.
_BODIES = (
    pin.Inertia(1.0, np.zeros(3), np.zeros((3, 3))),
    *(pin.Inertia(1.0, axis, np.zeros((3, 3))) for axis in _E),
    *(
        pin.Inertia(
            0.0, np.zeros(3), np.maximum(np.outer(_E[i], _E[j]), np.outer(_E[j], _E[i]))
        )
        for i, j in ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2))
    ),
)
_OF_BODIES = np.linalg.inv([body.toDynamicParameters() for body in _BODIES]).round()
# Spatial inertia (6, 6) per unit of each of the ten dynamic parameters. As in Pinocchio, linear
# rows come before angular rows.
UNITS = np.tensordot(_OF_BODIES, [body.matrix() for body in _BODIES], 1)


class _Rates(NamedTuple):
    """Accelerations, and their derivatives by the state and the inputs, in base axes.

    The rows of the accelerations are followed by the rows of the constraint forces.
    """

    c: Array  # (.., 6 + n + r)
    slopes: Array  # (.., 6 + n + r, 12 + 2 n)
    by_u: Array  # (.., 6 + n + r, nu)


class ModelDerivatives:
    """Derivatives of the matrices of a model with respect to the parameters of its robot.

    The derivatives with respect to the ten dynamic parameters of each body follow from equations
    (12.1) and (12.2) of docs/derivation.md.
    """

    def __init__(self, lin: LinearModel, robot: Robot, source: LinearModel) -> None:
        # `source` is in continuous time
        self.lin, self.robot, self._source = lin, robot, source
        default_reference = lin.moving or bool(
            np.array_equal(lin.placement, own_reference(robot, lin))
        )
        default_reference = default_reference and robot.orbit is None
        reference = None if default_reference else lin.reference
        self._prepare = partial(
            Prepared, frame=lin.frame, reference=reference, moving=lin.moving
        )
        self._ready = self._prepare(robot)
        state = self._ready.map
        actuation = self._ready.actuation
        data = robot.create_data()
        self._state = state
        self._data = robot.create_data()
        self._chart: Chart = ReferenceChart()
        if not default_reference:
            self._chart = state.chart(lin.q)
        self._u = actuation.in_base_axes(self._chart, lin.u0)
        self._nu = state.velocities(lin.v)
        nv, nu = len(self._nu), len(self._u)
        self._inverse, slopes, by_u = (
            np.empty((nv, size)) for size in (nv, state.nx, nu)
        )
        closure = closure_of(state)
        accelerations = Accelerations(state, actuation, data, closure)
        self._rates = accelerations.rates(lin.q, lin.v, self._nu, self._u, slopes, by_u)
        Inertia(state, data).invert(lin.q, self._inverse)
        # A change F of the generalised forces changes the accelerations, and then the constraint
        # forces, by `_response` F.
        self._response: Array = -self._inverse
        self._held: HeldForces | None = None
        # Indices of the states of the model, and map from these to all states.
        self._kept: Indices = np.arange(state.nx)
        self._all_states: Array = np.eye(state.nx)
        if closure is not None and accelerations.contact is not None:
            contact = accelerations.contact
            self._held = HeldForces(closure, contact, lin.q, self._inverse)
            self._response = self._held.response
            names = [state.names.index(name) for name in lin.state_names]
            self._kept = np.array(names, dtype=np.intp)
            assert lin._all_states is not None
            self._all_states = lin._all_states
        # The accelerations do not depend on the position and linear velocity of the base, so both
        # are set to zero; see `Accelerations`.
        self._q, self._v = lin.q.copy(), lin.v.copy()
        self._q[:3] = self._v[:3] = 0.0
        self._gradient: GravityGradient | None = None
        if state.field:
            self._gradient = GravityGradient.at(state.field, lin.q)
            self._v[PIN_ANGULAR] += self._gradient.spin
        self._joints = range(ROOT, robot.model.njoints)

    def over(self, parameters: Sequence[Parameter]) -> tuple[Array, ...]:
        """Return dA, dB, dC, dD, df0 and dy0 (P, ..), one entry for each of P parameters."""
        # Row i of `total` belongs to parameter i. An additional last row contains zeros. `assemble`
        # is an affine function of `rates`. For the row of zeros, it returns the constant part of
        # A, B and f0. This constant part is subtracted below.
        state = self._state
        ready = self._ready
        count = len(parameters) + 1
        nv = len(self._nu)
        total = self._zeros(count)
        for joint in self._joints:
            rows = [row for row, one in enumerate(parameters) if joint in one.bodies]
            changes = np.array([parameters[row].bodies[joint] for row in rows]).reshape(
                -1, 10
            )
            for part, of_bodies in zip(total, self._of_bodies, strict=True):
                part[rows] += np.tensordot(changes, of_bodies[joint - ROOT], 1)
        for row, one in enumerate(parameters):
            if not one.bodies:
                for part, of_force in zip(total, self._over_force(one), strict=True):
                    part[row] = of_force
        of_outputs = self._output_derivatives(parameters, total)
        A: Array = np.zeros((count, state.nx, state.nx))
        B: Array = np.zeros((count, state.nx, len(self._u)))
        A[:, nv:], B[:, nv:] = total.slopes[:, :nv], total.by_u[:, :nv]
        gravity = np.zeros((count, 3))
        rates = AccelerationDerivatives(total.c[:, :nv], A[:, nv:], B[:, nv:], gravity)
        nu, u = (np.broadcast_to(x, (count, len(x))) for x in (self._nu, self._u))
        f0 = assemble(
            ready.actuation, self._chart, nu, u, rates, A, moving=ready.moving
        )
        A, B, f0 = (array[:-1] - array[-1] for array in (A, B, f0))
        C, D, y0 = np.split(of_outputs, (state.nx, -1), axis=2)
        if self._held is not None:
            kept, all_states = self._kept, self._all_states
            A, B, f0 = A[:, kept] @ all_states, B[:, kept], f0[:, kept]
            C = C @ all_states
        if self.lin.dt:
            driven = np.column_stack((self._source.B, self._source.f0))
            given = np.concatenate((B, f0[..., None]), axis=2)
            A, held = held_derivatives(self._source.A, driven, self.lin.dt, A, given)
            B, f0 = held[..., :-1], held[..., -1]
        return A, B, C, D, f0, y0[..., 0]

    def _zeros(self, *count: int) -> _Rates:
        """Return zero derivatives with the leading axes `count`."""
        rows = len(self._response)
        return _Rates(
            np.zeros((*count, rows)),
            np.zeros((*count, rows, self._state.nx)),
            np.zeros((*count, rows, len(self._u))),
        )

    def _output_derivatives(
        self, parameters: Sequence[Parameter], rates: _Rates
    ) -> Array:
        """Return the matrix [dC, dD, dy0] of each parameter (P, ny, ..), by (12.2a).

        Row i of `rates` contains the derivatives of the accelerations with respect to parameter i.
        Only outputs that depend on masses or accelerations have nonzero rows. The columns of C
        belong to all states of the robot.
        """
        lin = self.lin
        nv, x0 = len(self._nu), np.zeros(self._state.nx)
        width = self._state.nx + lin.D.shape[1] + 1
        derivatives = np.zeros((len(parameters), len(lin.C), width))
        rows = [
            lin.output_names.index(name)
            for output in self.robot.outputs
            if output.FEELS_ACCELERATION or type(output) in WEIGH
            for name, _ in output.signals
        ]
        if not rows:
            return derivatives
        model = self.robot.model.copy()
        changed_robot = replace(self.robot, model=model)
        ready = self._prepare(changed_robot)
        sensing, actuation = ready.sensing, ready.actuation
        assert sensing is not None
        data = changed_robot.create_data()
        point = (lin.q, lin.v, self._nu, self._u)

        def g(parameter: Parameter, by_parameter: _Rates, change: float) -> Array:
            """Return g of (12.2a), the mass times [C, D, y0], after a change of a parameter.

            `by_parameter` contains the derivatives of the accelerations. The accelerations are
            extrapolated linearly. So g is a quadratic function of the change, and (12.2a) is exact
            for any step.
            """
            change_bodies(model, self.robot.model, parameter, change)
            changes = _Rates(*(change * part for part in by_parameter))
            accelerations = AccelerationDerivatives(
                self._rates.c + changes.c[:nv],
                self._rates.slopes + changes.slopes[:nv],
                self._rates.by_u + changes.by_u[:nv],
                self._rates.gravity,
            )
            contact = None
            if self._held is not None:
                contact = self._held.changed(*(part[nv:] for part in changes))
            equations = output_equations(
                sensing,
                actuation,
                data,
                self._chart,
                accelerations,
                x0,
                point,
                contact,
            )
            matrix: Array = np.column_stack(
                (equations["C"], equations["D"], equations["y0"])
            )
            mass: float = pin.computeTotalMass(model)
            # Restore the bodies, because the next parameter may belong to other bodies.
            for joint in parameter.bodies:
                model.inertias[joint] = self.robot.model.inertias[joint]
            return mass * matrix[rows]

        m = pin.computeTotalMass(self.robot.model)
        for index, parameter in enumerate(parameters):
            by_parameter = _Rates(*(part[index] for part in rates))
            h = 1.0
            if parameter.bodies:
                h = 1.0 / (self.fraction(parameter.bodies) or 1.0)
            g_0 = g(parameter, by_parameter, 0.0)
            g_h = g(parameter, by_parameter, h)
            g_2h = g(parameter, by_parameter, 2.0 * h)
            g_p = (4.0 * g_h - g_2h - 3.0 * g_0) / (2.0 * h)
            m_p = sum(change[0] for change in parameter.bodies.values())
            # (12.2a) is the quotient rule for y = g / m.
            derivatives[index, rows] = (g_p - m_p * g_0 / m) / m
        return derivatives

    def difference(self, one: Parameter) -> float:
        """Return the larger relative error of dA and dB, from finite differences of order 4."""
        if not one.bodies:
            raise InputError(
                f"'{one.name}' is not a parameter of a link or body; only such parameters can be "
                "checked, for example 'base.mass'"
            )
        lin, least = self.lin, _LEAST
        if self._held is not None:
            self._held.require_no_mimic_joints()
            if self._held.is_redundant:
                least = _LEAST_OF_REDUNDANT
        step = _STEP / self.fraction(one.bodies)

        def matrices(steps: float) -> tuple[Array, Array]:
            """Return A and B for the parameter changed by a number of steps."""
            model = self.robot.model.copy()
            change_bodies(model, self.robot.model, one, steps * step)
            changed = replace(self.robot, model=model)
            state = StateMap(changed, reference=lin.reference, frame=lin.frame)
            A, B, _ = aba_route(Aba(state), lin.q, lin.v, lin.u0, moving=lin.moving)
            if self._held is not None:
                A, B = A[self._kept] @ self._all_states, B[self._kept]
            if lin.dt:
                return held_exponential(A, B, lin.dt)
            return A, B

        dA, dB, *_ = self.over([one])
        two_before = matrices(-2.0)
        one_before = matrices(-1.0)
        nominal = matrices(0.0)
        one_after = matrices(1.0)
        two_after = matrices(2.0)
        worst = 0.0
        for i, exact in enumerate((dA[0], dB[0])):
            difference = (
                two_before[i] - 8.0 * one_before[i] + 8.0 * one_after[i] - two_after[i]
            ) / (12.0 * step)
            nominal_size = np.abs(nominal[i]).max(initial=0.0)
            largest = np.abs(difference).max(initial=0.0)
            size = max(largest, least * nominal_size / step)
            error = float(np.abs(difference - exact).max(initial=0.0))
            if error:
                worst = max(worst, error / size)
        return worst

    @cached_property
    def _of_bodies(self) -> _Rates:
        """Derivatives (bodies, 10, ..) of the accelerations by the dynamic parameters.

        The bodies are in the order of Pinocchio's joints.
        """
        rates, nv = self._rates, len(self._nu)
        derivatives = self._zeros(len(self._joints), 10)
        derivatives.slopes[:] = self._by_inertia(rates.slopes)
        derivatives.by_u[:] = self._by_inertia(rates.by_u)
        if self._v.any() or rates.c.any():
            # In the model `lone`, only one body has an inertia. For this model, RNEA returns F_p of
            # (12.1) for this body. The derivatives of RNEA are the derivatives of F_p with respect
            # to q_m, nu and base rotations.
            lone = self.robot.model.copy()
            lone.armature = np.zeros_like(lone.armature)
            for joint in range(lone.njoints):
                lone.inertias[joint] = pin.Inertia.Zero()
            forces: tuple[list[Array], ...] = ([], [], [], [])
            for joint in self._joints:
                of_bodies = []
                for body in _BODIES:
                    lone.inertias[joint] = body
                    of_bodies.append(self._rnea_derivatives(lone))
                lone.inertias[joint] = pin.Inertia.Zero()
                for kept, values in zip(
                    forces, zip(*of_bodies, strict=True), strict=True
                ):
                    kept.append(np.tensordot(_OF_BODIES, values, 1))
            F, F_q, F_nu, F_turn = map(np.array, forces)
            # RNEA does not depend on the linear velocity of the base.
            F_nu[..., LINEAR] = 0.0
            derivatives.c[:] = F @ self._response.T
            derivatives.slopes[..., ANGULAR] += self._response @ F_turn
            derivatives.slopes[..., 6:nv] += self._response @ F_q
            derivatives.slopes[..., nv:] += self._response @ F_nu
            for body, at in np.ndindex(derivatives.c.shape[:2]):
                change = self._by_acceleration(derivatives.c[body, at])
                derivatives.slopes[body, at, :, :nv] += change
        return derivatives

    def fraction(self, changes: Mapping[int, Array]) -> float:
        """Return the relative size of a change dM of M: the spectral radius of M^-1 dM.

        `changes` is {Pinocchio joint: change (10,) of the dynamic parameters of the joint's body}.
        """
        J = self._jacobians()
        total = np.zeros_like(self._inverse)
        for joint, change in changes.items():
            columns = J[joint - ROOT]
            total += columns.T @ np.tensordot(change, UNITS, 1) @ columns
        return float(np.abs(np.linalg.eigvals(self._inverse @ total)).max())

    def _jacobians(self) -> Array:
        """Return the Jacobians (bodies, 6, 6 + n) of the joints, in the axes of the joints."""
        model, data = self.robot.model, self._data
        pin.computeJointJacobians(model, data, self._q)
        full = (
            pin.getJointJacobian(model, data, joint, _LOCAL) for joint in self._joints
        )
        return np.array([self._state.columns(J) for J in full])

    def _by_inertia(self, given: Array) -> Array:
        """Return the products (bodies, 10, .., k) of -M^-1 M_p and a given matrix (6 + n, k).

        M_p is the derivative of M with respect to a dynamic parameter p of a body. With
        constraints, `_response` replaces -M^-1.
        """
        J = self._jacobians()
        forces = UNITS @ (J @ given)[:, None]
        return np.asarray((self._response @ J.mT)[:, None] @ forces)

    def _rnea_derivatives(self, model: pin.Model) -> tuple[Array, ...]:
        """Return the generalised forces that RNEA computes, and their derivatives.

        The derivatives are with respect to q_m, nu and base rotations. The forces of springs and
        inputs are not included. In orbit, the gravity gradient is subtracted.
        """
        state, data, q, gradient = self._state, self._data, self._q, self._gradient
        by_turn: Array = np.zeros((len(self._v), 3))
        if gradient:  # before RNEA, because `force` overwrites results in `data`
            pull, pull_by_q, by_turn = gradient.force(model, data, q)
        a = state.spread(self._rates.c)
        by_q, by_v, _ = pin.computeRNEADerivatives(model, data, q, self._v, a)
        tau = np.array(data.tau)
        if gradient:
            tau, by_q = tau - pull, by_q - pull_by_q
            by_turn = by_v[:, PIN_ANGULAR] @ skew(gradient.spin) - by_turn
        project = state.project
        return (
            state.forces(tau),
            project(by_q)[:, 6:],
            project(by_v),
            state.forces(by_turn),
        )

    def _by_acceleration(
        self, change: Array, pushed: pin.StdVec_Force | None = None
    ) -> Array:
        """Return derivatives (.., 6 + n) of accelerations by displacements of q.

        They follow from a `change` of the accelerations (and of the constraint forces), and from
        a change `pushed` of the external wrenches, because M and the Jacobians depend on q.
        """
        model, state, nv = self.robot.model, self._state, len(self._nu)
        at_rest = np.zeros_like(self._v)
        c = state.spread(change[:nv])
        wrenches = pushed
        if self._held is not None:
            wrenches = self._held.wrenches(change[nv:], pushed)
        more = () if wrenches is None else (wrenches,)
        given = (self._q, at_rest, c)
        by_q = pin.computeRNEADerivatives(model, self._data, *given, *more)[0]
        F = np.zeros((nv, nv))
        F[:, 6:] = state.project(by_q)[:, 6:]
        if self._held is None:
            return np.asarray(self._response @ F)
        F -= self._held.turning(change[nv:])
        return np.asarray(self._response @ F + self._held.by_row_rates(c))

    def _over_force(self, one: Parameter) -> _Rates:
        """Return the derivatives of the accelerations by a parameter that changes no body.

        The parameter changes a spring, a damper or the wrench of an input.
        """
        state = self._state
        u = self._u
        nv = len(self._nu)
        F = np.zeros(nv)
        B = np.zeros((nv, len(u)))
        F_q, F_nu = np.zeros((nv, nv)), np.zeros((nv, nv))
        pushed: pin.StdVec_Force | None = None
        if (joint := one.joint) >= 0:
            at = 6 + joint
            moved = (
                state.joint_positions(self._q)[joint] - self.robot.springs.rest[joint]
            )
            F[at] = (
                one.by_stiffness * moved
                + one.by_damping * state.velocities(self._v)[at]
            )
            F_q[at, at], F_nu[at, at] = one.by_stiffness, one.by_damping
        if one.wrench:
            joint, column, wrench = one.wrench
            B[:, column] = self._jacobians()[joint - ROOT].T @ wrench
            F = -B @ u
            if u[column]:
                pushed = pin.StdVec_Force(self.robot.model.njoints, pin.Force.Zero())
                pushed[joint] = pin.Force(wrench * u[column])
        response = self._response
        derivatives = self._zeros()
        derivatives.c[:] = response @ F
        derivatives.by_u[:] = -response @ B
        derivatives.slopes[:] = response @ np.hstack((F_q, F_nu))
        if derivatives.c.any() or pushed is not None:
            change = self._by_acceleration(derivatives.c, pushed)
            derivatives.slopes[:, :nv] += change
        return derivatives


def change_bodies(
    model: pin.Model, before: pin.Model, one: Parameter, size: float
) -> None:
    """Set the bodies of `model` that depend on a parameter.

    The bodies are taken from the model `before`, with the parameter increased by `size`.
    """
    for joint, change in one.bodies.items():
        changed = before.inertias[joint].toDynamicParameters() + size * change
        model.inertias[joint] = pin.Inertia.FromDynamicParameters(changed)
        # a wheel without mass, for which Pinocchio would divide 0 by 0
        if not changed[0]:
            # The last six parameters are Ixx, Ixy, Iyy, Ixz, Iyz, Izz.
            inertia = changed[4:][[[0, 1, 3], [1, 2, 4], [3, 4, 5]]]
            model.inertias[joint] = pin.Inertia(0.0, np.zeros(3), inertia)
