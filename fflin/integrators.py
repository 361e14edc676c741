"""Steps of fixed size of a motion on the manifold, by name.

Each takes the acceleration f(t, q, v), whose stages it calls in order, and returns q and v at the
end. The weights say with which share of the step each stage counts, for what is summed along.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import numpy as np
import pinocchio as pin

from fflin.errors import unknown
from fflin.validation import Array

Acceleration: TypeAlias = Callable[[float, Array, Array], Array]
Step: TypeAlias = Callable[
    [pin.Model, Acceleration, float, Array, Array, float], tuple[Array, Array]
]

_integrate = pin.integrate


class Integrator(NamedTuple):
    r"""A step and the weights of its stages.

    Attributes
    ----------
    step : callable
    weights : tuple of float
    reach : float
        Largest |pole| dt with which it is stable on the negative real axis.
    """

    step: Step
    weights: tuple[float, ...]
    reach: float


def _cf4(
    model: pin.Model, f: Acceleration, t: float, q: Array, v: Array, h: float
) -> tuple[Array, Array]:
    """Commutator-free, of order 4, with two exponentials at the end.

    The stages of the velocity are put in, so that only accelerations are left to combine.
    """
    half = 0.5 * h
    moved = half * v
    l1 = f(t, q, v)
    q2 = _integrate(model, q, moved)
    l2 = f(t + half, q2, v + half * l1)
    q3 = _integrate(model, q, moved + (half * half) * l1)
    l3 = f(t + half, q3, v + half * l2)
    q4 = _integrate(model, q2, moved + (h * half) * l2)
    l4 = f(t + h, q4, v + h * l3)
    sixth = h / 6.0
    l12, last = l1 + l2, (half * sixth) * l3
    moved += (half * sixth) * l12
    q = _integrate(model, _integrate(model, q, moved - last), moved + 3.0 * last)
    return q, v + sixth * (l12 + l2 + 2.0 * l3 + l4)


def _rkmk4(
    model: pin.Model, f: Acceleration, t: float, q: Array, v: Array, h: float
) -> tuple[Array, Array]:
    """Runge-Kutta-Munthe-Kaas of order 4, with the inverse of dexp at each stage."""

    def rate(theta: Array, velocity: Array) -> Array:
        slope = pin.dIntegrate(model, q, theta, pin.ArgumentPosition.ARG1)
        result: Array = np.linalg.solve(slope, velocity)
        return result

    half = 0.5 * h
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


def _semi_implicit_euler(
    model: pin.Model, f: Acceleration, t: float, q: Array, v: Array, h: float
) -> tuple[Array, Array]:
    """Of order 1: the new velocity moves the configuration."""
    v = v + h * f(t, q, v)
    return _integrate(model, q, h * v), v


_FOURTH = (1.0 / 6.0, 1.0 / 3.0, 1.0 / 3.0, 1.0 / 6.0)

INTEGRATORS = {
    "cf4": Integrator(_cf4, _FOURTH, 2.78),
    "rkmk4": Integrator(_rkmk4, _FOURTH, 2.78),
    "semi_implicit_euler": Integrator(_semi_implicit_euler, (1.0,), 2.0),
}


def integrator(name: str) -> Integrator:
    """Return the integrator of a name, or raise `UnknownNameError`."""
    if name not in INTEGRATORS:
        raise unknown("method", str(name), list(INTEGRATORS))
    return INTEGRATORS[name]
