"""Nonlinear model in the chart, its derivatives by differences, and motions to compare it with."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin

from fflin.base.errors import InputError
from fflin.base.rotation import rotation_matrices, rotation_matrix, skew
from fflin.base.validation import Array, instance, vector
from fflin.dynamics.aba import Aba
from fflin.dynamics.chart import Chart, times
from fflin.dynamics.names import ANGULAR, LINEAR, PIN_ANGULAR, PIN_LINEAR
from fflin.dynamics.outputs import Measuring
from fflin.dynamics.state import StateMap, moving_errors, state_history
from fflin.linear.certificate import mobilities
from fflin.linear.fit import require_fit, require_sensed
from fflin.linear.model import LinearModel
from fflin.robot.robot import Robot

if TYPE_CHECKING:
    from numpy.typing import NDArray

# Where the base flies faster than this [m/s], the rounding of its speed would hide the rest.
_FAST = 100.0

# Sixth-order central difference: weights of f(x + k h) - f(x - k h), k = 1, 2, 3. Its error is
# h^6 f^(7) / 140.
_WEIGHTS = (45.0 / 60.0, -9.0 / 60.0, 1.0 / 60.0)


class Nonlinear:
    """Nonlinear model ``xdot = f(x, u)`` in the chart, by ABA."""

    def __init__(self, state: StateMap, lin: LinearModel, aba: Aba | None = None) -> None:
        self.state = state
        self.aba = aba or Aba(state)
        observer = rotation_matrix(lin.q[3:7]) @ lin.v[PIN_LINEAR]
        moves = np.linalg.norm(observer) > _FAST and state.robot.orbit is None
        self._observer = observer if moves else np.zeros(3)

    def acceleration(self, x: Array, u: Array) -> tuple[Array, Array, Array]:
        """Return (q, v, a) in Pinocchio's order."""
        _, q, v, a = self._accelerations(x[None], u[None])
        return q[0], v[0], a[0]

    def _accelerations(self, x: Array, u: Array) -> tuple[Chart, Array, Array, Array]:
        """Return the chart, q, v and a of rows."""
        chart, q, v = self.state.points(x)
        u = self.aba.actuation.in_base_axes(chart, u)
        observer = self._observer @ rotation_matrices(q[:, 3:7])
        relative = v.copy()
        relative[:, PIN_LINEAR] -= observer
        rows = zip(q, relative, u, strict=True)
        a = np.array([self.aba.acceleration(*each).copy() for each in rows])
        a[:, PIN_LINEAR] -= times(skew(v[:, PIN_ANGULAR]), observer)
        return chart, q, v, a

    def after_motion(self, x: Array, q: Array, v: Array, a: Array, t: Array) -> Array:
        """Return the states (N, nx) a time t (N, 1) after rows of q, v and a, near the state x."""
        model = self.state.robot.model
        after = np.array([pin.integrate(model, *each) for each in zip(q, t * v, strict=True)])
        return state_history(self.state, after, v + t * a, x)

    def __call__(self, x: Array, u: Array) -> Array:
        """Return dx/dt (nx,)."""
        return self.rates(x[None], u[None])[0]

    def rates(self, x: Array, u: Array) -> Array:
        """Return dx/dt (N, nx) of rows x (N, nx) and u (N, nu)."""
        return self._rates(x, *self._accelerations(x, u))

    def _rates(self, x: Array, chart: Chart, q: Array, v: Array, a: Array) -> Array:
        state = self.state
        linear, angular = v[:, PIN_LINEAR], v[:, PIN_ANGULAR]
        rate = state.velocities(a)
        if state.axes[1]:
            # Of the velocity's reference-axis components.
            rate[:, LINEAR] += times(skew(angular), linear)
        turning = chart.q0 * angular + times(skew(chart.q_b), angular)
        position_rate, rates = times(chart.R, linear), state.velocities(v)[:, 6:]
        rate = state.to_frame(chart, rate[..., None])[..., 0]
        return np.concatenate((0.5 * turning, position_rate, rates, rate), axis=1)


class ErrorDynamics(Nonlinear):
    """Error dynamics about a reference that moves through the point; f is 0 there."""

    def __init__(self, state: StateMap, lin: LinearModel, aba: Aba | None = None) -> None:
        super().__init__(state, lin, aba)
        self._q, self._v = lin.q.copy(), lin.v
        self._q[:3] = 0.0
        self._a = state.velocities(self.acceleration(lin.x0, lin.u0)[2])

    def after_motion(self, x: Array, q: Array, v: Array, a: Array, t: Array) -> Array:
        """Return the errors when reference and robot have both moved on for a time t."""
        at, at_rest = np.tile(self._q, (len(t), 1)), np.zeros_like(a)
        ahead = super().after_motion(x, at, np.tile(self._v, (len(t), 1)), at_rest, t)
        errors = moving_errors("local", super().after_motion(x, q, v, a, t), ahead)
        errors[:, -len(self._a) :] -= t * self._a
        return errors

    def _rates(self, x: Array, chart: Chart, q: Array, v: Array, a: Array) -> Array:
        state = self.state
        linear, angular = v[:, PIN_LINEAR], v[:, PIN_ANGULAR]
        at_linear, at_angular = self._v[PIN_LINEAR], self._v[PIN_ANGULAR]
        # edot = (e0 (w - w*) + e x (w + w*)) / 2 and rdot = R_e v - v* - w* x r.
        turning = chart.q0 * (angular - at_angular)
        turning += times(skew(chart.q_b), angular + at_angular)
        position_rate = (
            times(chart.R, linear) - at_linear - x[:, state.groups.r_b] @ skew(at_angular).T
        )
        rates = state.velocities(v - self._v)[:, 6:]
        return np.concatenate(
            (0.5 * turning, position_rate, rates, state.velocities(a) - self._a), axis=1
        )


def outputs(
    robot: Robot, lin: LinearModel, q: Array, v: Array | None = None, u: Array | None = None
) -> Array:
    """Return the outputs y of a robot in the coordinates of a linear model.

    - Attitudes are in the model's chart, with q0 >= 0.
    - Rotations of frames are relative to the point of linearisation.
    - Angles of continuous joints are unwrapped to be nearest to the point of linearisation.

    The input of a controller designed for the linear model is ``y - lin.y0``.

    Parameters
    ----------
    robot : Robot
        Robot with the states, inputs and outputs of the model; its masses may differ.
    lin : LinearModel
        Model that defines the reference and the point.
    q, v : array_like (nq,), (nv,)
        Configuration and velocity in Pinocchio's order; v is zero by default.
    u : array_like (nu,), optional
        Inputs; u0 by default. Only accelerometer outputs depend on u.

    Returns
    -------
    ndarray (ny,)
        Outputs in the order of ``lin.output_names``.

    Raises
    ------
    InputError
        If a size is wrong, the model does not fit the robot, or the model has a moving reference.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble", outputs=[fflin.JointPositions()])
    >>> lin = fflin.linearize(robot)
    >>> fflin.outputs(robot, lin, fflin.configuration(robot, {"joint_2": 0.4}))
    array([0. , 0.4, 0. ])
    """
    instance("robot", robot, Robot, "a fflin.Robot")
    if instance("lin", lin, LinearModel, "a fflin.LinearModel").moving:
        raise InputError(
            "the model has a moving reference, expected a fixed one; linearise with moving=False"
        )
    state = StateMap(robot, reference=lin.reference, frame=lin.frame)
    require_fit(lin, robot, state)
    require_sensed(lin, robot, state)
    at = robot.checked_configuration(q)
    moving = np.zeros(robot.nv) if v is None else robot.checked_velocity(v)
    u = lin.u0 if u is None else vector("u", u, len(lin.u0), "one for each input")
    a: Array = np.zeros(robot.nv)
    if any(output.FEELS_ACCELERATION for output in robot.outputs):
        aba = Aba(state)
        a = aba.acceleration(at, moving, aba.actuation.in_base_axes(state.chart(at), u))
    x = state.read(at, moving, near=state.read(lin.q, lin.v))
    return Measuring(state, lin.q)(x, at, moving, a)


def jacobian(
    f: Callable[[Array], Array], point: Array, steps: Array, is_curved: NDArray[np.bool_]
) -> Array:
    """Return the Jacobian of f, a function of rows, by central differences of the given steps."""
    curved, straight = np.diag(steps)[is_curved], np.diag(steps)[~is_curved]
    offsets = np.concatenate((*(k * curved for k in (1, 2, 3)), straight))
    first, last = np.split(f(np.concatenate((point + offsets, point - offsets))), 2)
    *near, rest = np.split(first - last, [len(curved) * k for k in (1, 2, 3)])
    derivatives: Array = np.empty((rest.shape[1], len(point)))
    derivatives[:, is_curved] = np.tensordot(_WEIGHTS, near, axes=1).T
    derivatives[:, ~is_curved] = 0.5 * rest.T
    return derivatives / steps


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


def flow_error(model: Nonlinear, lin: LinearModel) -> float:
    """Return the relative error of f compared with the state derivative along motions."""
    model = copy(model)
    model.state = state = model.state.about(pin.SE3(lin.reference.rotation, np.zeros(3)))
    x = np.tile(lin.x0, (7, 1))
    x[:, state.groups.r_b] = 0.0
    x[1:, 6 + state.robot.n : 12 + state.robot.n] += np.eye(6)
    u = np.tile(lin.u0, (7, 1))
    chart, q, v, a = model._accelerations(x, u)
    expected = model._rates(x, chart, q, v, a)
    # Differences at t = -3 h ... 3 h.
    h = 1e-2 * chart.q0 / (1.0 + np.abs(v[:, 3:]).max(axis=1, keepdims=True))
    offsets = np.concatenate([k * h for k in (1, 2, 3, -1, -2, -3)])
    q, v_there, a = (np.tile(each, (6, 1)) for each in (q, v, a))
    after = model.after_motion(x[0], q, v_there, a, offsets)
    ahead, behind = after.reshape(2, 3, *x.shape)
    rates = np.tensordot(_WEIGHTS, ahead - behind, axes=1) / h
    floor, size = 1.0 + np.abs(v).max(axis=1), np.abs(expected).max(axis=1)
    return float((np.abs(expected - rates).max(axis=1) / np.maximum(floor, size)).max())
