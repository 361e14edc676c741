"""The nonlinear model in the chart, its slopes by differences, and the flow that it must follow."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
import pinocchio as pin

from fflin.base.rotation import rotation_matrices, rotation_matrix, skew
from fflin.base.validation import Array
from fflin.dynamics.aba import Aba
from fflin.dynamics.chart import Chart, times
from fflin.dynamics.state import ANGULAR, LINEAR, PIN_ANGULAR, PIN_LINEAR, StateMap
from fflin.dynamics.state_rows import moving_error
from fflin.linear.certificate import mobilities
from fflin.linear.model import LinearModel
from fflin.robot.robot import Robot

# Where the base flies faster than this [m/s], the rounding of its speed would hide the rest.
_FAST = 100.0

# Sixth-order central difference: weights of f(x + k h) - f(x - k h), k = 1, 2, 3. Its error is
# h^6 f^(7) / 140.
_WEIGHTS = (45.0 / 60.0, -9.0 / 60.0, 1.0 / 60.0)


class Nonlinear:
    """The nonlinear model in the chart, by ABA: ``xdot = f(x, u)``.

    Where the base is fast, accelerations are taken by an observer who flies with the point at
    constant velocity: they are the same, v_b's rate but for the turning of the base's axes.
    """

    def __init__(self, state: StateMap, lin: LinearModel) -> None:
        self.state = state
        self.aba = Aba(state)
        observer = rotation_matrix(lin.q[3:7]) @ lin.v[PIN_LINEAR]
        self._observer = observer if np.linalg.norm(observer) > _FAST else np.zeros(3)

    def acceleration(self, x: Array, u: Array) -> tuple[Array, Array, Array]:
        """Return (q, v, a) in Pinocchio's order."""
        _, q, v, a = self._accelerations(x[None], u[None])
        return q[0], v[0], a[0]

    def _accelerations(self, x: Array, u: Array) -> tuple[Chart, Array, Array, Array]:
        """Return the chart, q, v and a of rows."""
        chart, q, v = self.state.points(x)
        u = self.aba.actuation.in_base_axes(chart, u)
        observer = self._observer @ rotation_matrices(q[:, 3:7])
        seen = v.copy()
        seen[:, PIN_LINEAR] -= observer
        rows = zip(q, seen, u, strict=True)
        a = np.array([self.aba.acceleration(*each).copy() for each in rows])
        a[:, PIN_LINEAR] -= times(skew(v[:, PIN_ANGULAR]), observer)
        return chart, q, v, a

    def passing(self, x: Array, motion: Sequence[Array], t: float) -> Array:
        """Return the state a time t after x on a motion that has (q, v, a) there."""
        q, v, a = motion
        after = pin.integrate(self.state.robot.model, q, t * v)
        return self.state.to_state(after, v + t * a, near=x)

    def __call__(self, x: Array, u: Array) -> Array:
        """Return dx/dt (nx,)."""
        return self.rates(x[None], u[None])[0]

    def rates(self, x: Array, u: Array) -> Array:
        """Return dx/dt (N, nx) of rows x (N, nx) and u (N, nu)."""
        state = self.state
        chart, _, v, a = self._accelerations(x, u)
        linear, angular = v[:, PIN_LINEAR], v[:, PIN_ANGULAR]
        rate = state.velocities(a)
        if state.axes[1]:
            # Of the velocity's reference-axis components.
            rate[:, LINEAR] += times(skew(angular), linear)
        turning = chart.q0 * angular + times(skew(chart.q_b), angular)
        flying, rates = times(chart.R, linear), state.velocities(v)[:, 6:]
        rate = state.to_frame(chart, rate[..., None])[..., 0]
        return np.concatenate((0.5 * turning, flying, rates, rate), axis=1)


class ErrorDynamics(Nonlinear):
    """The dynamics of the error from a reference that moves through the point: ``f(x0, u0) = 0``.

    With the error quaternion (e, e0) = q*^-1 q: edot = (e0 (w - w*) + e x (w + w*)) / 2, and
    with r = R*^T (p - p*): rdot = R_e v - v* - w* x r.
    """

    def __init__(self, state: StateMap, lin: LinearModel) -> None:
        super().__init__(state, lin)
        self._q, self._v = lin.q.copy(), lin.v
        self._q[:3] = 0.0
        self._a = state.velocities(self.acceleration(lin.x0, lin.u0)[2])

    def passing(self, x: Array, motion: Sequence[Array], t: float) -> Array:
        """Return the error when reference and robot, at x, have both moved on for a time t."""
        model, (q, v, a) = self.state.robot.model, motion
        ahead = pin.integrate(model, self._q, t * self._v), self._v
        error = moving_error(self.state, *ahead, pin.integrate(model, q, t * v), v + t * a)
        error[-len(self._a) :] -= t * self._a
        return error

    def rates(self, x: Array, u: Array) -> Array:
        """Return the rates of the error (N, nx) of rows."""
        state = self.state
        chart, _, v, a = self._accelerations(x, u)
        linear, angular = v[:, PIN_LINEAR], v[:, PIN_ANGULAR]
        at_linear, at_angular = self._v[PIN_LINEAR], self._v[PIN_ANGULAR]
        turning = chart.q0 * (angular - at_angular)
        turning += times(skew(chart.q_b), angular + at_angular)
        flying = times(chart.R, linear) - at_linear - x[:, state.groups.r_b] @ skew(at_angular).T
        rates = state.velocities(v - self._v)[:, 6:]
        return np.concatenate((0.5 * turning, flying, rates, state.velocities(a) - self._a), axis=1)


def jacobian(f: Callable[[Array], Array], point: Array, steps: Array, bends: Any) -> Array:
    """Return the slopes of f, of rows, at a point by central differences of the given steps.

    Of sixth order where f `bends`; it is at most quadratic in the others, so that one is exact.
    """
    curved, straight = np.diag(steps)[bends], np.diag(steps)[~bends]
    ways = np.concatenate((*(k * curved for k in (1, 2, 3)), straight))
    first, last = np.split(f(np.concatenate((point + ways, point - ways))), 2)
    *near, rest = np.split(first - last, [len(curved) * k for k in (1, 2, 3)])
    slopes: Array = np.empty((rest.shape[1], len(point)))
    slopes[:, bends] = np.tensordot(_WEIGHTS, near, axes=1).T
    slopes[:, ~bends] = 0.5 * rest.T
    return slopes / steps


def difference_steps(state: StateMap, lin: LinearModel, M: Array) -> tuple[Array, Array]:
    """Return the steps for differences in x (nx,) and u (nu,) at a model's point."""
    groups, nv = state.groups, len(M)
    # Small against the angles over which accelerations change where light links line up.
    step = np.full(state.nx, 2e-4)
    # Well inside the chart, whose edge |q_b| = 1 the model feels long before.
    step[groups.q_b] = 1e-2 * (1.0 - np.linalg.norm(lin.x0[groups.q_b]))
    # f is quadratic in the velocities and linear in the input: no truncation at any step.
    speed = np.abs(lin.x0[-nv:])
    step[-nv:] = 0.1 * max(1.0, float(speed[ANGULAR].max()), float(speed[6:].max(initial=0.0)))
    step[groups.v_b] = 0.1 * max(1.0, float(speed[LINEAR].max()))
    mobility, input_mobility = mobilities(M, lin.B)
    push = max(1.0, float(np.abs(lin.f0[-nv:] / mobility).max())) / input_mobility
    return step, push


def _derivative(f: Callable[[float], Array], h: float) -> Array:
    """Return df/dt at 0 by differences at t = -3 h ... 3 h."""
    differences = [f(k * h) - f(-k * h) for k in range(1, 1 + len(_WEIGHTS))]
    return np.tensordot(_WEIGHTS, differences, axes=1) / h


def flow_error(robot: Robot, lin: LinearModel) -> float:
    """How far f is from the rate of the state along motions of the robot.

    The motions pass the point with its own velocity and with a unit of each base velocity added.
    They pass it at the origin, since a step would drown in the digits of a distant place.
    """
    turned = pin.SE3(lin.reference.rotation, np.zeros(3))
    state = StateMap(robot, reference=turned, frame=lin.frame)
    model = (ErrorDynamics if lin.moving else Nonlinear)(state, lin)
    x = np.tile(lin.x0, (7, 1))
    x[:, state.groups.r_b] = 0.0
    x[1:, 6 + robot.n : 12 + robot.n] += np.eye(6)
    u = np.tile(lin.u0, (7, 1))
    chart, *motions = model._accelerations(x, u)
    worst = 0.0
    for at, q0, expected, *motion in zip(
        x, np.asarray(chart.q0), model.rates(x, u), *motions, strict=True
    ):
        v = motion[1]
        h = 1e-2 * float(q0[0]) / (1.0 + float(np.abs(v[3:]).max()))
        rate = _derivative(partial(model.passing, at, motion), h)
        floor = 1.0 + float(np.abs(v).max())
        scale = max(floor, float(np.abs(expected).max()))
        worst = max(worst, float(np.abs(expected - rate).max()) / scale)
    return worst
