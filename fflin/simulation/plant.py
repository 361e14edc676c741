"""The nonlinear robot that a simulation integrates, with inputs, faults and a disturbance."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from typing import TypeAlias

import numpy as np
import pinocchio as pin

from fflin.base.errors import FflinWarning, InputError
from fflin.base.names import by_name
from fflin.base.validation import Array, ArrayLike, as_double, dimension, number, vector
from fflin.dynamics.aba import Aba
from fflin.dynamics.coordinates import ANGULAR, LINEAR, forces_of
from fflin.dynamics.disturbance import BaseDisturbance, true_field
from fflin.dynamics.magnetic import DistortedField
from fflin.dynamics.state import StateMap
from fflin.kernel.forward import ActuatorFaults, apply_faults
from fflin.robot.inputs import lags_of
from fflin.simulation.constrained import Constrained

# Generalised forces {name or group: value}, such as {"tau_b": (0, 0, 1e-3), "tau_m.joint_1": 0.2}.
# The torque and the force on the base are in the axes of the inputs tau_b and F_b.
Forces: TypeAlias = Mapping[str, ArrayLike]

# Constant forces by name, or a function of (t, q, v) that returns them. The function may instead
# return a generalised force (nv,) in Pinocchio's order: force on the base, torque on the base,
# forces or torques of the joints. The first two are then in base axes.
Disturbance: TypeAlias = Forces | Callable[[float, Array, Array], Forces | ArrayLike]

# If an entry of v exceeds this magnitude [SI units], the motion counts as diverging. In a diverging
# motion, a disturbance that is not finite raises no error.
_DIVERGED = 1e6
_LINEAR_FIRST = [3, 4, 5, 0, 1, 2]

# A disturbance may jump at the time of a step. The times of the stages are rounded into the step,
# so that all stages are on the same side of the jump.
ROUNDED_UP, ROUNDED_DOWN = 1.0 + 1e-15, 1.0 - 1e-15

# [rad] largest rotation within a step for which integrators are accurate
LARGEST_TURN = 1.0


class Plant(Aba):
    """The nonlinear robot with inputs, actuator faults and disturbances.

    The disturbances are `Robot.disturbance` and the argument `disturbance` of `simulate`.
    The base torque and the base force in u are in the axes that the frame of `state` defines.
    """

    def __init__(
        self,
        state: StateMap,
        disturbance: Disturbance | None = None,
        faults: ActuatorFaults | None = None,
    ) -> None:
        self.robot = robot = state.robot
        robot.require_inertia()
        super().__init__(state)
        self.disturbance = disturbance
        # Constraints of the robot, or None; written by `constrain`.
        self.constrained: Constrained | None = None
        if state.field and state.field.magnetic:
            field = true_field(robot, state.field)
            if isinstance(field, DistortedField):
                self.actuation.true_field = field
        # Disturbances of the robot itself.
        self.on_base = BaseDisturbance(robot, state.field)
        # Whether the warning about a disturbance given as an array was already issued.
        self._warned = False
        nu = len(self.actuation.names)
        # Time constants (nu,) of the actuators [s].
        self.lags: Array = np.array(lags_of(robot.named_inputs))
        groups = self.actuation.groups
        # Indices in u at which the base torque and the base force begin, if they are inputs.
        self.triads = sorted(
            int(groups[key][0]) for key in ("tau_b", "F_b") if key in groups
        )
        self.faults = faults or ActuatorFaults(
            gain=np.ones(nu),
            bias=np.zeros(nu),
            until=np.full(nu, np.inf),
            turn=np.tile(np.eye(3).ravel(), len(self.triads)),
        )
        self._faulty = faults is not None
        # Start and length [s] of the present step; written by the caller of `stage`.
        self.step = (0.0, 1.0)
        # Indices in v of the angular rates: the angular velocity of the base, and the rates of all
        # joints that are not prismatic. Rotors are excluded, because nothing depends on the angle
        # of a rotor.
        rotors = robot.rotors
        joints = [
            x.idx_v for x in robot.joints if not (x.prismatic or x.name in rotors)
        ]
        self.turning = np.array([3, 4, 5, *joints])
        self._columns = state.lift(self.actuation.fixed)
        # True if the generalised force of the inputs is `_columns` @ u, and no other force acts,
        # apart from a disturbance. Mimic joints and modes are excluded.
        others = (
            robot.stored_momentum,
            np.any(robot.springs),
            any(robot.gravity),
            robot.orbit,
            robot.disturbance,
            robot.constraints,
        )
        self._plain = state.S is None and not self.actuation.carried and not any(others)

    def stage(self, t: float, q: Array, v: Array, u: Array) -> tuple[Array, Array]:
        """Return dv/dt (nv,), and the external wrench (6,) of inputs and disturbance.

        The wrench consists of the force and the torque on the robot about the base, in base axes.
        Gravity is not included. In orbit, the wrench is replaced by [power, 0, 0, 0, 0, 0], with
        the total power [W] of inputs, disturbance and dampers, and of the change of an elliptic
        orbit's field.
        """
        if self.state.varying:
            self.state.move_to(t)
        if self._faulty:
            given = np.empty(len(u))
            begin, h = self.step
            apply_faults(self.faults, self.triads, begin, h, u, given)
            u = given
        if self.actuation.held:  # use R, because the chart is singular at 180 deg
            R, u = self.state.rotation(q), u.copy()
            for held in self.actuation.held:
                u[held] = u[held].dot(R)
        if self._plain and self.disturbance is None:
            tau = self._columns.dot(u)
            return pin.aba(self._model, self._data, q, v, tau), tau[:6]
        force = self.actuation.columns(self._data, q) @ u
        disturbed = None
        if self.disturbance is not None:
            begin, h = self.step
            within = min(max(t, begin * ROUNDED_UP), (begin + h) * ROUNDED_DOWN)
            disturbed = self.disturbing(within, q, v)
        if self.on_base.acts:
            on_base = np.zeros(self.robot.nv)
            on_base[:6] = self.on_base.wrench(t, q)
            disturbed = on_base if disturbed is None else disturbed + on_base
        rate = self.acceleration(q, v, u, disturbed)
        push = force[_LINEAR_FIRST]
        if disturbed is not None:
            push = push + disturbed[:6]
        if self.field:
            nu = self.state.velocities(v)
            power = nu.dot(force) - self.robot.springs.damping.dot(nu[6:] ** 2)
            if disturbed is not None:
                power = power + v.dot(disturbed)
            power = power + self.field.power(self._model, self._data, q, v)
            push = np.append(power, np.zeros(5))
        return rate, push

    def constrain(self, q: Array, v: Array) -> tuple[Array, Array]:
        """Return an initial q (nq,) and v (nv,) on the constraints of the robot, if it has any.

        From then on, `constrained` is set. Raise `ConstraintError` if q or v is far from them.
        """
        if not self.robot.constraints:
            return q, v
        self.constrained = Constrained(self.state, q)
        # `stage` then computes the accelerations without constraints, which `constrained_stage`
        # corrects.
        self._constraints = None
        return self.constrained.start(q, v)

    def constrained_stage(
        self, t: float, q: Array, v: Array, u: Array
    ) -> tuple[Array, Array]:
        """Return dv/dt and the external wrench as `stage`, for a robot with constraints."""
        assert self.constrained is not None
        rate, push = self.stage(t, q, v, u)
        rate, wrench = self.constrained.accelerate(q, v, rate)
        # In orbit, `push` contains a power, and constraints do no work.
        if self.constrained.outside:
            push = push + wrench
        return rate, push

    def disturbing(self, t: float, q: Array, v: Array) -> Array:
        """Return the generalised force (nv,) of the disturbance, or raise `InputError`."""
        assert self.disturbance is not None
        name = f"at t = {t:g} s, disturbance(t, q, v)"
        given = self.disturbance
        forces = given if isinstance(given, Mapping) else given(t, q.copy(), v.copy())
        if isinstance(forces, Mapping):
            return self._named_force(forces, q)
        if not self._warned:
            self._warned = True
            warnings.warn(
                "the disturbance is an array in Pinocchio's order, with the force on the base "
                "before the torque, both in base axes; this form is deprecated; give forces by "
                "name, such as {'tau_b': (0, 0, 1e-3)}, in the axes of the inputs",
                FflinWarning,
                2,
            )
        disturbed = as_double(name, forces)
        if np.abs(v).max() < _DIVERGED:
            expected = "a generalised force (nv,) in Pinocchio's order"
            disturbed = vector(name, disturbed, self.robot.nv, expected)
        return disturbed

    def _named_force(self, forces: Forces, q: Array) -> Array:
        """Return the generalised force (nv,) of forces by name, in base axes."""
        names = tuple(forces_of(self.robot))
        total, single = np.zeros(len(names)), dict[str, float]()
        for key, value in forces.items():
            label = f"disturbance '{key}'"
            if callable(value):
                raise InputError(
                    f"{label} is a function, expected a number; for a disturbance that changes in "
                    f"time, give a function of (t, q, v) that returns {{'{key}': number}}"
                )
            if key in ("tau_b", "F_b") and dimension(label, value) > 0:
                rows = ANGULAR if key == "tau_b" else LINEAR
                total[rows] = vector(label, value, 3, "the components x, y and z")
            else:
                single[key] = number(label, value)
        for index, force in by_name("generalised force", single, names).items():
            total[index] = force
        R = self.state.rotation(q)
        for rows in self.state.in_reference:
            total[rows] = total[rows] @ R
        return self.state.lift(total)

    def isolated(self, *, driven: bool) -> bool:
        """Return True if no external force acts on the robot.

        If `driven` is true, or if an actuator fault has a bias, the inputs may be nonzero. In this
        case, forces and torques on the base, thrusters, and wheels without a joint count as
        external. Gravity and a disturbance are always external. In orbit, return False.
        """
        driven = driven or bool(self.faults.bias.any())
        base = driven and (self._columns[:6].any() or self.actuation.carried)
        outside = (
            self.disturbance is not None,
            self.on_base.acts,
            any(self.robot.gravity),
            self.robot.orbit,
            self.constrained is not None and self.constrained.outside,
        )
        return not (base or any(outside))
