"""Steps of fixed size of a motion on the manifold, by name.

Each is prepared for a model and a step, takes the acceleration f(t, q, v), whose stages it calls
in order, and returns q and v at the end. What f gets as v is overwritten by the stages that
follow. The weights say with which share of the step each stage counts, for what is summed along.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple, TypeAlias

import numpy as np
import pinocchio as pin

from fflin.errors import unknown
from fflin.validation import Array

Acceleration: TypeAlias = Callable[[float, Array, Array], Array]
Step: TypeAlias = Callable[[Acceleration, float, Array, Array], tuple[Array, Array]]

_integrate = pin.integrate


class Integrator(NamedTuple):
    r"""A kind of step and the weights of its stages.

    Attributes
    ----------
    prepare : callable
        prepare(model, h) -> step(f, t, q, v) -> (q, v), with a work space of its own.
    weights : tuple of float
    reach : float
        Largest |pole| dt with which it is stable on the negative real axis.
    """

    prepare: Callable[[pin.Model, float], Step]
    weights: tuple[float, ...]
    reach: float


def _cf4(model: pin.Model, h: float) -> Step:
    """Commutator-free, of order 4, with two exponentials at the end.

    The stages of the velocity are put in, so that v and the accelerations alone are left: all
    that one of them makes known is one product of a small matrix with them as rows.
    """
    half, s = 0.5 * h, h * h / 12.0
    known = np.zeros((5, model.nv))
    at, l1, l2, l3, l4 = known
    # Moves to q2, v2 and the move to q3; v3 and the move from q2 to q4; v4 and the moves at last.
    by_1 = np.array([[half, 0.0], [1.0, half], [half, half * half]])
    by_2 = np.array([[1.0, 0.0, half], [half, 0.0, h * half]])
    by_3 = np.array([[1.0, 0.0, 0.0, h], [half, s, s, -s], [half, s, s, 3.0 * s]])
    by_4 = np.array([1.0, h / 6.0, h / 3.0, h / 3.0, h / 6.0])
    of_1, of_2, of_3 = known[:2], known[:3], known[:4]
    new_1, new_2, new_3 = np.empty((3, model.nv)), np.empty((2, model.nv)), np.empty((3, model.nv))
    (to_2, v2, to_3), (v3, to_4), (v4, to_5, to_6) = new_1, new_2, new_3

    def step(f: Acceleration, t: float, q: Array, v: Array) -> tuple[Array, Array]:
        at[:] = v
        l1[:] = f(t, q, at)
        by_1.dot(of_1, new_1)
        q2 = _integrate(model, q, to_2)
        l2[:] = f(t + half, q2, v2)
        by_2.dot(of_2, new_2)
        l3[:] = f(t + half, _integrate(model, q, to_3), v3)
        by_3.dot(of_3, new_3)
        l4[:] = f(t + h, _integrate(model, q2, to_4), v4)
        return _integrate(model, _integrate(model, q, to_5), to_6), by_4.dot(known)

    return step


def _rkmk4(
    model: pin.Model, h: float, f: Acceleration, t: float, q: Array, v: Array
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
    model: pin.Model, h: float, f: Acceleration, t: float, q: Array, v: Array
) -> tuple[Array, Array]:
    """Of order 1: the new velocity moves the configuration."""
    v = v + h * f(t, q, v)
    return _integrate(model, q, h * v), v


_FOURTH = (1.0 / 6.0, 1.0 / 3.0, 1.0 / 3.0, 1.0 / 6.0)


def _unprepared(step: Callable[..., tuple[Array, Array]]) -> Callable[[pin.Model, float], Step]:
    return lambda model, h: partial(step, model, h)


INTEGRATORS = {
    "cf4": Integrator(_cf4, _FOURTH, 2.78),
    "rkmk4": Integrator(_unprepared(_rkmk4), _FOURTH, 2.78),
    "semi_implicit_euler": Integrator(_unprepared(_semi_implicit_euler), (1.0,), 2.0),
}


def integrator(name: str) -> Integrator:
    """Return the integrator of a name, or raise `UnknownNameError`."""
    if name not in INTEGRATORS:
        raise unknown("method", str(name), list(INTEGRATORS))
    return INTEGRATORS[name]
