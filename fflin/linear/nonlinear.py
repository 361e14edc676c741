"""Nonlinear model in the coordinates of a linear model, and its finite differences."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pinocchio as pin

from fflin.base.rotation import rotation_matrices, rotation_matrix
from fflin.base.validation import Array, Mask
from fflin.dynamics.aba import Aba
from fflin.dynamics.coordinates import LINEAR, PIN_ANGULAR, PIN_LINEAR, Chart, times
from fflin.dynamics.integrators import integrate_rows
from fflin.dynamics.state import StateMap
from fflin.dynamics.state_rows import moving_errors, state_history
from fflin.linear.model import LinearModel
from fflin.linear.scales import DIFFERENCE_TOLERANCE, EPS, ULPS

# Sixth-order central difference: weights of f(x + k h) - f(x - k h), k = 1, 2, 3. The error of the
# difference is h^6 f^(7) / 140.
_WEIGHTS = (45.0 / 60.0, -9.0 / 60.0, 1.0 / 60.0)


class Nonlinear:
    """Nonlinear model ``xdot = f(x, u)`` in the chart of a linear model, computed by ABA.

    If the linear model has a moving reference, x is the error relative to the reference. In this
    case, f is 0 at the operating point.
    """

    def __init__(
        self, aba: Aba, lin: LinearModel, state: StateMap | None = None
    ) -> None:
        self._aba, self._lin = aba, lin
        self.state = state or aba.state
        # Unless the robot is in orbit or anchored in inertial space, ABA receives velocities
        # relative to an observer. The observer moves with the velocity that the base has at the
        # operating point. Otherwise, rounding errors of the velocity of a fast base would hide the
        # other velocities.
        self._observer = np.zeros(3)
        if aba.field is None and not aba.state.robot.anchored:
            self._observer = rotation_matrix(lin.q[3:7]) @ lin.v[PIN_LINEAR]
        # Velocity and acceleration of a moving reference; zero for a fixed reference.
        self._v: Array = np.zeros((1, aba.state.robot.nv))
        self._a: Array = np.zeros_like(self._v)
        if lin.moving:
            _, _, self._v, self._a = self.accelerations(
                np.concatenate((lin.x0, lin.u0))[None]
            )

    def accelerations(self, point: Array) -> tuple[Chart, Array, Array, Array]:
        """Return the charts, q, v and dv/dt for rows (N, nx + nu) of states and inputs.

        q, v and dv/dt are in Pinocchio's order.
        """
        x, u = np.split(point, [self.state.nx], axis=1)
        chart, q, v = self.state.points(x)
        observer = self._observer @ rotation_matrices(q[:, 3:7])
        relative = v.copy()
        relative[:, PIN_LINEAR] -= observer
        a = self._aba.accelerations(
            q, relative, self._aba.actuation.in_base_axes(chart, u)
        )
        a[:, PIN_LINEAR] -= np.cross(v[:, PIN_ANGULAR], observer)
        return chart, q, v, a

    def rates(self, point: Array) -> Array:
        """Return dx/dt (N, nx) for rows (N, nx + nu) of states and inputs."""
        return self.rates_of(point, self.accelerations(point))

    def rates_of(
        self, point: Array, motion: tuple[Chart, Array, Array, Array]
    ) -> Array:
        """Return dx/dt (N, nx) for rows of states and inputs, and their `accelerations`."""
        state = self.state
        chart, _, v, a = motion
        # The error (5.1) relative to a reference with velocities v* and w* has the derivatives
        # de/dt = (e0 (w - w*) + e x (w + w*)) / 2 and dr/dt = R_e v - v* - w* x r. Here (e, e0) is
        # the error quaternion, and R_e is the rotation matrix of the error.
        linear, angular = v[:, PIN_LINEAR], v[:, PIN_ANGULAR]
        at_linear, at_angular = self._v[:, PIN_LINEAR], self._v[:, PIN_ANGULAR]
        turning = chart.q0 * (angular - at_angular)
        turning += np.cross(chart.q_b, angular + at_angular)
        position_rate = times(chart.R, linear) - at_linear
        position_rate -= np.cross(at_angular, point[:, state.groups.r_b])
        rate = state.velocities(a)
        if state.axes[1]:
            # `rate` contains the time derivative of the components of v in base axes, which rotate.
            # Add w x v to obtain the time derivative of v relative to the reference axes.
            rate[:, LINEAR] += np.cross(angular, linear)
        rate = state.to_frame(chart, rate[..., None])[..., 0] - state.velocities(
            self._a
        )
        joint_rates = state.velocities(v - self._v)[:, 6:]
        return np.concatenate((0.5 * turning, position_rate, joint_rates, rate), axis=1)

    def flow_error(self) -> float:
        """Return the relative error of f, compared with differences of x along short motions."""
        lin, robot = self._lin, self.state.robot
        reference = pin.SE3(lin.reference.rotation, np.zeros(3))
        state = StateMap(robot, reference=reference, frame=lin.frame, t=lin.time)
        near = Nonlinear(self._aba, lin, state)
        # The first row is the operating point. In each other row, one component of the base
        # velocity is increased by 1.
        count = 7
        x = np.tile(lin.x0, (count, 1))
        x[:, state.groups.r_b] = 0.0
        x[1:, 6 + robot.n : 12 + robot.n] += np.eye(6)
        point = np.hstack((x, np.tile(lin.u0, (count, 1))))
        chart, q, v, a = near.accelerations(point)
        expected = near.rates(point)
        # Evaluate each motion at the times t = +-h, +-2 h and +-3 h.
        fastest = np.abs(v[:, 3:]).max()
        h = float(1e-2 * np.min(chart.q0) / (1.0 + fastest))
        times = (1.0, 2.0, 3.0, -1.0, -2.0, -3.0)
        t = h * np.repeat(times, count)[:, None]
        copies = (len(times), 1)
        speeds = np.tile(v, copies)
        moved_q = integrate_rows(robot.model, np.tile(q, copies), t * speeds)
        moved_v = speeds + t * np.tile(a, copies)
        after = state_history(state, moved_q, moved_v, x[0])
        # The rates of a moving reference cancel in the errors, but not their rounding errors.
        largest = np.abs(after).reshape(len(times), *x.shape).max(axis=0)
        rounding = ULPS * EPS * largest / h
        if lin.moving:  # the first row is also the motion of the reference
            reference_motion = np.repeat(after[::count], count, axis=0)
            after = moving_errors("local", after, reference_motion)
        ahead, behind = after.reshape(2, 3, *x.shape)
        rates = np.tensordot(_WEIGHTS, ahead - behind, axes=1) / h
        size = np.maximum(1.0 + np.abs(v).max(axis=1), np.abs(expected).max(axis=1))
        scale = np.maximum(size[:, None], rounding / DIFFERENCE_TOLERANCE)
        errors = np.abs(expected - rates) / scale
        return float(errors.max())


# (ratio, sign) of each repetition of the differences of `jacobians`: the steps are divided by the
# ratio, and curved variables are displaced by sign * _NEGLIGIBLE * steps.
_REPETITIONS = (1.5, 1.0), (1.2, -1.0)

# Ratio of two errors of a Jacobian by sixth-order differences with the step h: its truncation
# error, and its difference from the Jacobian with the smallest step: h^6 / (h^6 - (h / 1.5)^6).
TRUNCATION = 1.0 / (1.0 - _REPETITIONS[0][0] ** -6)

# Fraction of a step that changes the rounding errors of a function, but not its derivatives.
_NEGLIGIBLE = 1e-12


def jacobians(
    f: Callable[[Array], Array], point: Array, steps: Array, is_curved: Mask
) -> tuple[Array, list[Array]]:
    """Return the Jacobian of f at a point by central differences, and repetitions of it.

    The repetitions have smaller steps than `steps`. They displace the curved variables by a
    negligible fraction of the steps, so that their rounding errors are independent. The differences
    between the Jacobians show the truncation error and the rounding error of the first one.
    """
    again = []
    for ratio, sign in _REPETITIONS:
        beside = point + sign * _NEGLIGIBLE * steps * is_curved
        again.append(jacobian(f, beside, steps / ratio, is_curved))
    return jacobian(f, point, steps, is_curved), again


def jacobian(
    f: Callable[[Array], Array], point: Array, steps: Array, is_curved: Mask
) -> Array:
    """Return the Jacobian of f at a point, computed by central differences with the given steps.

    f maps rows of points to rows of values. The mask `is_curved` selects the variables for which
    sixth-order differences are used. For all other variables, second-order differences are used.
    """
    offset_rows = np.diag(steps)
    curved = offset_rows[is_curved]
    straight = offset_rows[~is_curved]
    offsets = np.concatenate((curved, 2.0 * curved, 3.0 * curved, straight))
    values = f(np.concatenate((point + offsets, point - offsets)))
    ahead, behind = np.split(values, 2)
    *near_to_far, rest = np.split(ahead - behind, len(curved) * np.arange(1, 4))
    sixth_order = np.tensordot(_WEIGHTS, near_to_far, axes=1)
    second_order = 0.5 * rest
    differences: Array = np.empty((values.shape[1], len(point)))
    differences[:, is_curved] = sixth_order.T
    differences[:, ~is_curved] = second_order.T
    return differences / steps
