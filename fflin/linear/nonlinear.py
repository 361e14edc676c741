"""Nonlinear model in the chart of a linear model, and its derivatives by finite differences."""

from collections.abc import Callable

import numpy as np
import pinocchio as pin

from fflin.base.rotation import rotation_matrices, rotation_matrix, skew
from fflin.base.validation import Array, Mask
from fflin.dynamics.aba import Aba
from fflin.dynamics.coordinates import (
    LINEAR,
    PIN_ANGULAR,
    PIN_LINEAR,
    Chart,
    moving_errors,
    state_history,
    times,
)
from fflin.dynamics.integrators import integrate_rows
from fflin.dynamics.state import StateMap
from fflin.linear.model import LinearModel

# Base speed [m/s] whose rounding errors would hide the other velocities. A faster base is described
# relative to an observer that moves with it.
_FAST = 100.0

# Sixth-order central difference: weights of f(x + k h) - f(x - k h), k = 1, 2, 3. Its error is
# h^6 f^(7) / 140.
_WEIGHTS = (45.0 / 60.0, -9.0 / 60.0, 1.0 / 60.0)


class Nonlinear:
    """Nonlinear model ``xdot = f(x, u)`` in the chart of a linear model, computed by ABA.

    If the linear model has a moving reference, x is the error relative to this reference. Then f is
    0 at the operating point.
    """

    def __init__(self, aba: Aba, lin: LinearModel, state: StateMap | None = None) -> None:
        self._aba, self._lin = aba, lin
        self.state = state or aba.state
        observer = rotation_matrix(lin.q[3:7]) @ lin.v[PIN_LINEAR]
        moves = np.linalg.norm(observer) > _FAST and aba.field is None
        self._observer = observer if moves else np.zeros(3)
        # Velocity and acceleration of the reference.
        self._v: Array = np.zeros((1, aba.state.robot.nv))
        self._a: Array = np.zeros_like(self._v)
        if lin.moving:
            _, _, self._v, self._a = self.accelerations(np.concatenate((lin.x0, lin.u0))[None])

    def accelerations(self, point: Array) -> tuple[Chart, Array, Array, Array]:
        """Return the charts, q, v and dv/dt (Pinocchio's order) for rows (x, u) (N, nx + nu)."""
        x, u = np.split(point, [self.state.nx], axis=1)
        chart, q, v = self.state.points(x)
        observer = self._observer @ rotation_matrices(q[:, 3:7])
        relative = v.copy()
        relative[:, PIN_LINEAR] -= observer
        a = self._aba.accelerations(q, relative, self._aba.actuation.in_base_axes(chart, u))
        a[:, PIN_LINEAR] -= times(skew(v[:, PIN_ANGULAR]), observer)
        return chart, q, v, a

    def rates(self, point: Array) -> Array:
        """Return dx/dt (N, nx) for rows (x, u) (N, nx + nu)."""
        state, (chart, _, v, a) = self.state, self.accelerations(point)
        # Rates of the error relative to a reference with velocities v* and w*: edot = (e0 (w - w*)
        # + e x (w + w*)) / 2 and rdot = R_e v - v* - w* x r.
        linear, angular = v[:, PIN_LINEAR], v[:, PIN_ANGULAR]
        at_linear, at_angular = self._v[:, PIN_LINEAR], self._v[:, PIN_ANGULAR]
        turning = chart.q0 * (angular - at_angular)
        turning += times(skew(chart.q_b), angular + at_angular)
        position_rate = times(chart.R, linear) - at_linear
        position_rate -= times(skew(at_angular), point[:, state.groups.r_b])
        rate = state.velocities(a)
        if state.axes[1]:
            # Components of v in reference axes have another derivative than components in base
            # axes. Add the difference w x v.
            rate[:, LINEAR] += times(skew(angular), linear)
        rate = state.to_frame(chart, rate[..., None])[..., 0] - state.velocities(self._a)
        joint_rates = state.velocities(v - self._v)[:, 6:]
        return np.concatenate((0.5 * turning, position_rate, joint_rates, rate), axis=1)

    def flow_error(self) -> float:
        """Return the relative error of f, compared with finite differences along short motions."""
        lin, robot = self._lin, self.state.robot
        state = self.state.about(pin.SE3(lin.reference.rotation, np.zeros(3)))
        near = Nonlinear(self._aba, lin, state)
        # The first row is the point itself. In each other row, one base velocity is increased by 1.
        x = np.tile(lin.x0, (7, 1))
        x[:, state.groups.r_b] = 0.0
        x[1:, 6 + robot.n : 12 + robot.n] += np.eye(6)
        point = np.hstack((x, np.tile(lin.u0, (7, 1))))
        (chart, q, v, a), expected = near.accelerations(point), near.rates(point)
        # Differences at t = -3 h ... 3 h.
        h = 1e-2 * chart.q0 / (1.0 + np.abs(v[:, 3:]).max(axis=1, keepdims=True))
        t = np.concatenate((h, 2.0 * h, 3.0 * h, -h, -2.0 * h, -3.0 * h))

        def after_motion(q: Array, v: Array, a: Array) -> Array:
            q, v, a = np.tile(q, (6, 1)), np.tile(v, (6, 1)), np.tile(a, (6, 1))
            return state_history(state, integrate_rows(robot.model, q, t * v), v + t * a, x[0])

        after = after_motion(q, v, a)
        if lin.moving:
            reference = (np.tile(each[:1], (7, 1)) for each in (q, v, a))
            after = moving_errors("local", after, after_motion(*reference))
        ahead, behind = after.reshape(2, 3, *x.shape)
        rates = np.tensordot(_WEIGHTS, ahead - behind, axes=1) / h
        floor, size = 1.0 + np.abs(v).max(axis=1), np.abs(expected).max(axis=1)
        return float((np.abs(expected - rates).max(axis=1) / np.maximum(floor, size)).max())


def jacobian(f: Callable[[Array], Array], point: Array, steps: Array, is_curved: Mask) -> Array:
    """Compute the Jacobian of f by central differences; f maps rows of points to rows of values.

    Columns in the mask `is_curved` use sixth-order differences. All others use second-order
    differences.
    """
    curved, straight = np.diag(steps)[is_curved], np.diag(steps)[~is_curved]
    offsets = np.concatenate((curved, 2.0 * curved, 3.0 * curved, straight))
    first, last = np.split(f(np.concatenate((point + offsets, point - offsets))), 2)
    *near, rest = np.split(first - last, len(curved) * np.arange(1, 4))
    derivatives: Array = np.empty((rest.shape[1], len(point)))
    derivatives[:, is_curved] = np.tensordot(_WEIGHTS, near, axes=1).T
    derivatives[:, ~is_curved] = 0.5 * rest.T
    return derivatives / steps
