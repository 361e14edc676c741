"""The accelerations of a robot in simulation, and what pushes it from outside."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from fflin.aba import Aba
from fflin.errors import InputError
from fflin.state import Chart, StateMap
from fflin.validation import Array

Disturbance: TypeAlias = Callable[[float, Array, Array], ArrayLike]

_aba = pin.aba
_ANY = np.zeros(3)


class Dynamics:
    """The nonlinear robot under inputs and a disturbance.

    Parameters
    ----------
    state : StateMap
        Its frame says the axes of the inputs on the base.
    disturbance : callable, optional
        disturbance(t, q, v) -> generalised force (nv,) in Pinocchio's order: on the base linear,
        then angular, in base axes; then on the joints.
    """

    def __init__(self, state: StateMap, disturbance: Disturbance | None = None) -> None:
        robot = state.robot
        self._state, self._robot = state, robot
        self._aba = Aba(state)
        self.actuation = self._aba.actuation
        self._disturbance = disturbance
        self._model, self._data = robot.model, robot.create_data()
        nu = len(self.actuation.names)
        self._columns = np.column_stack(
            [state.lift(self.actuation.torques(unit)) for unit in np.eye(nu)]
        )
        # Where nothing but u acts, and that along fixed columns.
        self._plain = (
            state.S is None
            and not self.actuation.carried
            and not robot.stored_momentum
            and not any(values.any() for values in robot.passive)
            and not any(robot.gravity)
        )

    def force(self, q: Array, u: Array) -> Array:
        """Return tau (nv,) of inputs that act along fixed columns."""
        if self.actuation.held:
            u = self.actuation.in_base_axes(self._turned(q), u)
        tau: Array = self._columns.dot(u)
        return tau

    def acceleration(self, t: float, q: Array, v: Array, u: Array) -> Array:
        """Return dv/dt (nv,) in Pinocchio's order."""
        if self._plain and self._disturbance is None:
            return _aba(self._model, self._data, q, v, self.force(q, u))
        u = self.actuation.in_base_axes(self._turned(q), u) if self.actuation.held else u
        if self._disturbance is None:
            return self._aba.acceleration(q, v, u)
        return self._aba.acceleration(q, v, u, self._disturbed(t, q, v))

    def push(self, t: float, q: Array, v: Array, u: Array) -> Array:
        """Return the generalised force (6,) on the base, angular then linear in base axes.

        It is the sum of all wrenches from outside at the base origin, but for gravity.
        """
        held = self.actuation.held
        in_base = self.actuation.in_base_axes(self._turned(q), u) if held else u
        force: Array = self.actuation.columns(self._data, q)[:6] @ in_base
        if self._disturbance is not None:
            force = force + self._disturbed(t, q, v)[[3, 4, 5, 0, 1, 2]]
        return force

    @property
    def isolated(self) -> bool:
        """Whether nothing pushes from outside whatever the inputs are."""
        base = self._columns[:6].any() or self.actuation.carried
        return not (base or self._disturbance is not None or any(self._robot.gravity))

    def free(self, q: Array, v: Array) -> Callable[[float, Array, Array], Array]:
        """Return f(t, q, v) for inputs that are zero, with nothing in between where it can be."""
        if self._plain and self._disturbance is None:
            model, data, zero = self._model, self._data, np.zeros(self._robot.nv)
            return lambda _, q, v: _aba(model, data, q, v, zero)
        nothing = np.zeros(len(self.actuation.names))
        return lambda t, q, v: self.acceleration(t, q, v, nothing)

    def _turned(self, q: Array) -> Chart:
        """Return the attitude at any turn, beyond the chart too, for its rotation alone."""
        return Chart(_ANY, 1.0, self._state.rotation(q))

    def _disturbed(self, t: float, q: Array, v: Array) -> Array:
        assert self._disturbance is not None
        force = np.asarray(self._disturbance(t, q, v), dtype=float)
        if force.shape != (self._robot.nv,) or not np.isfinite(force).all():
            raise InputError(
                f"disturbance(t, q, v) gave shape {force.shape} at t = {t:g} s, expected "
                f"({self._robot.nv},) finite numbers: a generalised force in Pinocchio's order"
            )
        return force
