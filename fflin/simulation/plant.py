"""A simulated robot: its accelerations under inputs, a disturbance and faults of the inputs."""

from collections.abc import Callable
from typing import TypeAlias

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from fflin.base.errors import InputError
from fflin.base.validation import Array, as_double
from fflin.dynamics.aba import Aba
from fflin.dynamics.state import StateMap
from fflin.kernel.forward import ActuatorFaults, apply_faults
from fflin.robot.mass_properties import require_inertia

# Function of (t, q, v) that returns a generalised force (nv,) in Pinocchio's order: force and
# torque on the base in base axes, then joint forces.
Disturbance: TypeAlias = Callable[[float, Array, Array], ArrayLike]

_aba = pin.aba
# Velocity above which a disturbance need not be finite, because the motion has diverged.
_DIVERGED = 1e6
_LINEAR_FIRST = [3, 4, 5, 0, 1, 2]


class Plant:
    """The nonlinear robot under inputs (in the axes of the state's frame) and a disturbance."""

    def __init__(
        self,
        state: StateMap,
        disturbance: Disturbance | None = None,
        faults: ActuatorFaults | None = None,
    ) -> None:
        robot = state.robot
        require_inertia(robot)
        self.state, self.robot = state, robot
        self._aba = Aba(state)
        self.actuation = self._aba.actuation
        if disturbance is not None and not callable(disturbance):
            raise InputError(
                f"disturbance has type {type(disturbance).__name__}, expected a function of (t, q, "
                "v)"
            )
        self.disturbance = disturbance
        self._model, self._data = robot.model, robot.create_data()
        nu, groups = len(self.actuation.names), self.actuation.groups
        # Index of the first of the three inputs of each vector on the base.
        self.triads = sorted(int(groups[key][0]) for key in ("tau_b", "F_b") if key in groups)
        self.faults = faults or ActuatorFaults(
            gain=np.ones(nu),
            bias=np.zeros(nu),
            until=np.full(nu, np.inf),
            turn=np.tile(np.eye(3).ravel(), len(self.triads)),
        )
        self._faulty = faults is not None
        self._columns = np.column_stack(
            [state.lift(self.actuation.torques(unit)) for unit in np.eye(nu)]
        )
        # Whether only u acts on the robot, with a constant input matrix.
        self._plain = (
            state.S is None
            and not self.actuation.carried
            and not robot.stored_momentum
            and not any(values.any() for values in robot.springs)
            and not any(robot.gravity)
            and not robot.orbit
        )
        self.field = self._aba.field

    def stage(self, t: float, q: Array, v: Array, u: Array) -> tuple[Array, Array]:
        """Return dv/dt (nv,), and the external wrench (6,) without gravity, in base axes.

        In orbit, the wrench is replaced by the power [W] of inputs, disturbance and dampers,
        followed by zeros.
        """
        if self._faulty:
            given = np.empty(len(u))
            apply_faults(self.faults, self.triads, t, u, given)
            u = given
        if self.actuation.held:  # rotated by R instead of the chart, which is singular at 180 deg
            R, u = self.state.rotation(q), u.copy()
            for held in self.actuation.held:
                u[held] = u[held].dot(R)
        if self._plain and self.disturbance is None:
            tau = self._columns.dot(u)
            return _aba(self._model, self._data, q, v, tau), tau[:6]
        force = self.actuation.columns(self._data, q) @ u
        disturbed = None
        if self.disturbance is not None:
            disturbed = self._disturbed(self.disturbance(t, q.copy(), v.copy()), t, v)
        rate = self._aba.acceleration(q, v, u, disturbed)
        push = force[_LINEAR_FIRST] if disturbed is None else force[_LINEAR_FIRST] + disturbed[:6]
        if self.field:
            nu = self.state.velocities(v)
            power = nu.dot(force) - self.robot.springs.damping.dot(nu[6:] ** 2)
            push = np.append(power if disturbed is None else power + v.dot(disturbed), np.zeros(5))
        return rate, push

    def isolated(self, *, driven: bool) -> bool:
        """Return whether no external force acts; if `driven`, wrenches of inputs count too."""
        driven = driven or bool(self.faults.bias.any())
        base = driven and (self._columns[:6].any() or self.actuation.carried)
        outside = self.disturbance is not None or any(self.robot.gravity) or self.robot.orbit
        return not (base or outside)

    def _disturbed(self, given: ArrayLike, t: float, v: Array) -> Array:
        force = as_double(f"disturbance(t, q, v) at t = {t:g} s", given)
        finite = np.isfinite(force).all() or not np.abs(v).max() < _DIVERGED
        if force.shape != (self.robot.nv,) or not finite:
            raise InputError(
                f"disturbance(t, q, v) returned shape {force.shape} at t = {t:g} s, expected "
                f"({self.robot.nv},) finite numbers: a generalised force in Pinocchio's order"
            )
        return force
