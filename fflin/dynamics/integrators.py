"""Steps of fixed size of a motion on the manifold, by name.

Each takes the acceleration f(t, q, v), whose stages it calls in order, and returns q and v at the
end. The weights say with which share of the step each stage counts, for what is summed along.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar, TypeAlias

import numpy as np
import pinocchio as pin

from fflin.base.errors import unknown
from fflin.base.validation import Array

Acceleration: TypeAlias = Callable[[float, Array, Array], Array]

_integrate = pin.integrate


class Integrator:
    """Steps of one size of one model."""

    # Of the stages, in what is summed along: v of the end is v + h sum(weights a),
    weights: ClassVar[tuple[float, ...]]
    # and in the sum of a sum: a free place of the end is r + h v + h^2 sum(moments a).
    moments: ClassVar[tuple[float, ...]]
    # Largest pole times step with which it is stable on the negative real axis.
    reach: ClassVar[float]

    def __init__(self, model: pin.Model, dt: float) -> None:
        self.model, self.dt = model, dt

    def step(self, f: Acceleration, t: float, q: Array, v: Array) -> tuple[Array, Array]:
        """Return q and v one step later."""
        raise NotImplementedError


class CommutatorFree4(Integrator):
    r"""CF4 of Celledoni, Marthinsen and Owren: order 4, with two exponentials at the end (11.1).

    With the stages of the velocity put in, only accelerations :math:`l_i` are left to combine:

    .. math:: k_2 = v + \tfrac h2 l_1,\quad k_3 = v + \tfrac h2 l_2,\quad k_4 = v + h l_3

    and what moves q is :math:`\tfrac h2 v` and sums of :math:`l_i`. Each combination is a row of
    a small matrix, so that a stage is one product with all stages so far. What f gets as v lies
    in the work space, and the next step overwrites it.
    """

    weights = (1.0 / 6.0, 1.0 / 3.0, 1.0 / 3.0, 1.0 / 6.0)
    moments = (1.0 / 6.0, 1.0 / 6.0, 1.0 / 6.0, 0.0)
    reach = 2.78

    def __init__(self, model: pin.Model, dt: float) -> None:
        super().__init__(model, dt)
        h, half, twelfth = dt, 0.5 * dt, dt * dt / 12.0
        self._stages = np.zeros((5, model.nv))  # v, l1, ..., l4
        self._two, self._three, self._four = (self._stages[:k] for k in (2, 3, 4))
        self._after_1 = np.array([[half, 0.0], [1.0, half], [half, half * half]])
        self._after_2 = np.array([[1.0, 0.0, half], [half, 0.0, h * half]])
        self._after_3 = np.array(
            [
                [1.0, 0.0, 0.0, h],
                [half, twelfth, twelfth, -twelfth],
                [half, twelfth, twelfth, 3.0 * twelfth],
            ]
        )
        self._after_4 = np.array([1.0, *(h * weight for weight in self.weights)])
        self._new_1, self._new_3 = np.empty((3, model.nv)), np.empty((3, model.nv))
        self._new_2 = np.empty((2, model.nv))
        self._rows = (*self._stages, *self._new_1, *self._new_2, *self._new_3)

    def step(self, f: Acceleration, t: float, q: Array, v: Array) -> tuple[Array, Array]:
        """Return q and v one step later."""
        model, middle = self.model, t + 0.5 * self.dt
        at, l1, l2, l3, l4, to_2, v2, to_3, v3, to_4, v4, first, second = self._rows
        at[:] = v
        l1[:] = f(t, q, at)
        self._after_1.dot(self._two, self._new_1)
        q2 = _integrate(model, q, to_2)
        l2[:] = f(middle, q2, v2)
        self._after_2.dot(self._three, self._new_2)
        l3[:] = f(middle, _integrate(model, q, to_3), v3)
        self._after_3.dot(self._four, self._new_3)
        l4[:] = f(t + self.dt, _integrate(model, q2, to_4), v4)
        end = _integrate(model, _integrate(model, q, first), second)
        return end, self._after_4.dot(self._stages)


class RungeKuttaMuntheKaas4(Integrator):
    """Order 4 in the tangent at q, with the inverse of dexp at each stage."""

    weights, moments = CommutatorFree4.weights, CommutatorFree4.moments
    reach = 2.78

    def step(self, f: Acceleration, t: float, q: Array, v: Array) -> tuple[Array, Array]:
        """Return q and v one step later."""
        model, h, half = self.model, self.dt, 0.5 * self.dt

        def rate(theta: Array, velocity: Array) -> Array:
            slope = pin.dIntegrate(model, q, theta, pin.ArgumentPosition.ARG1)
            result: Array = np.linalg.solve(slope, velocity)
            return result

        l1 = f(t, q, v)
        k2, v2 = half * v, v + half * l1
        d2 = rate(k2, v2)
        l2 = f(t + half, _integrate(model, q, k2), v2)
        k3, v3 = half * d2, v + half * l2
        d3 = rate(k3, v3)
        l3 = f(t + half, _integrate(model, q, k3), v3)
        k4, v4 = h * d3, v + h * l3
        d4 = rate(k4, v4)
        l4 = f(t + h, _integrate(model, q, k4), v4)
        moved = h / 6.0 * (v + 2.0 * (d2 + d3) + d4)
        return _integrate(model, q, moved), v + h / 6.0 * (l1 + 2.0 * (l2 + l3) + l4)


class SemiImplicitEuler(Integrator):
    """Order 1: the new velocity moves the configuration."""

    weights = moments = (1.0,)
    reach = 2.0

    def step(self, f: Acceleration, t: float, q: Array, v: Array) -> tuple[Array, Array]:
        """Return q and v one step later."""
        v = v + self.dt * f(t, q, v)
        return _integrate(self.model, q, self.dt * v), v


INTEGRATORS: dict[str, type[Integrator]] = {
    "cf4": CommutatorFree4,
    "rkmk4": RungeKuttaMuntheKaas4,
    "semi_implicit_euler": SemiImplicitEuler,
}


def integrator(name: str) -> type[Integrator]:
    """Return the integrator of a name, or raise `UnknownNameError`."""
    if not isinstance(name, str) or name not in INTEGRATORS:
        raise unknown("method", str(name), list(INTEGRATORS))
    return INTEGRATORS[name]
