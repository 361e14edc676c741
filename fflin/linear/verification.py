"""Independent computations of A and B: ABA derivatives, and differences of the nonlinear model."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from copy import copy
from typing import TypeAlias

import numpy as np
import pinocchio as pin

from fflin.base.rotation import rotation_matrices, rotation_matrix, skew
from fflin.base.validation import Array, Indices, Mask
from fflin.dynamics.aba import Aba
from fflin.dynamics.actuation import Actuation
from fflin.dynamics.coordinates import (
    ANGULAR,
    LINEAR,
    PIN_ANGULAR,
    PIN_LINEAR,
    Chart,
    moving_errors,
    state_history,
    times,
)
from fflin.dynamics.rnea import Inertia
from fflin.dynamics.state import StateMap
from fflin.linear.model import Certificate, LinearModel
from fflin.linear.tool_coordinates import ToolCoordinates
from fflin.robot.robot import Robot

Index: TypeAlias = slice | Indices

# Terms that cancel exactly still leave rounding errors of 1e-16 of their size. Errors are
# therefore relative to a scale that includes this fraction of such terms. It allows for the
# rounding errors and hides no larger ones.
_ROUNDING_FRACTION = 1e-3


def certify(robot: Robot, lin: LinearModel) -> Certificate:
    """Return the residuals of a continuous-time model of this robot."""
    state = StateMap(robot, reference=lin.reference, frame=lin.frame)
    aba = Aba(state)
    A, B, _ = aba_route(state, aba, lin.q, lin.v, lin.u0, moving=lin.moving)
    blocks = compare(state, aba.actuation, lin, lin.M, A, B)
    return Certificate(
        condition=scaled_condition(lin.M),
        inertia_residual=inertia_residual(lin.M, inverse_inertia(state, lin)),
        route_A=max(error for name, error in blocks if name[0] == "A"),
        route_B=max(error for name, error in blocks if name[0] == "B"),
        f0=float(np.abs(lin.f0).max()),
    )


def scaled_condition(M: Array) -> float:
    """Return the condition number of M scaled to a unit diagonal."""
    scale = 1.0 / np.sqrt(M.diagonal())
    return float(np.linalg.cond(scale[:, None] * M * scale))


def inertia_residual(M: Array, inverse: Array) -> float:
    """Return the largest entry of ``M M^-1 - I`` with M scaled to a unit diagonal."""
    scale = np.sqrt(M.diagonal())
    residual = M @ inverse - np.eye(len(M))
    return float(np.abs(residual * scale / scale[:, None]).max())


def aba_route(
    state: StateMap, aba: Aba, q: Array, v: Array, u: Array, *, moving: bool = False
) -> tuple[Array, Array, Array]:
    """Return A and B from ABA's derivatives by (4.9) and (15.3), and M^-1 by ABA."""
    own, nu = ToolCoordinates(state, moving=moving), state.velocities(v)
    u, nv = aba.actuation.in_base_axes(state.chart(q), u), len(nu)
    # Pinocchio differentiates about the world's origin, and a base far from it would cost digits.
    # So the base is placed at the origin: no derivative depends on its position, not even in
    # orbit.
    at_origin = q.copy()
    at_origin[:3] = 0.0
    by_q, by_v, by_u = aba.slopes(at_origin, v, u)
    there = own.jacobians(q, nu, u, state.velocities(aba.acceleration(at_origin, v, u)))
    # Upper half of A: kinematics of the tangent displacement in axes that rotate with the base.
    A, B = np.zeros((state.nx, state.nx)), np.zeros((state.nx, len(u)))
    A[ANGULAR, ANGULAR] = A[LINEAR, LINEAR] = -skew(nu[ANGULAR])
    A[LINEAR, ANGULAR] = -skew(nu[LINEAR])
    A[:nv, nv:] = np.eye(nv)
    A[nv:], B[nv:] = np.hstack((by_q, by_v)), by_u
    A = (there.P @ (A + B @ there.H) + there.rate) @ there.left
    return A, there.P @ B @ there.V, aba.inverse


def compare(
    state: StateMap,
    actuation: Actuation,
    lin: LinearModel,
    M: Array,
    A: Array,
    B: Array,
    *,
    steps: Array | None = None,
    rounding: float = 0.0,
) -> list[tuple[str, float]]:
    """Compare A and B with other matrices; return the errors of blocks such as "A[q_b, q_m]"."""
    # Errors are relative to the largest entry of a block. Rows of accelerations are divided by the
    # mobility sqrt((M^-1)_ii), so that a light joint does not hide a heavy one. Columns of B are
    # divided by the mobility of their input. If large terms cancel in a block, errors are relative
    # to these terms, because the terms' rounding errors remain in the differences.
    nv = len(M)
    mobility, input_mobility = mobilities(M, B)
    row_scale = np.concatenate((np.ones(state.nx - nv), mobility))[:, None]
    difference_A, scaled_A = np.abs(lin.A - A) / row_scale, np.abs(lin.A) / row_scale
    column_scale = np.where(np.arange(state.nx)[:, None] < state.nx - nv, 1.0, input_mobility)
    difference_B = np.abs(lin.B - B) / row_scale / column_scale
    groups, inputs = state.groups._asdict(), actuation.groups
    errors, errors_B = _blocks(difference_A, groups, groups), _blocks(difference_B, groups, inputs)
    if errors.any():
        # In orbit, the terms that cancel contain the inertial velocity.
        field = state.field
        v = field.absolute(lin.q, lin.v) if field else lin.v
        terms = _cancelling_terms(state, lin, v, mobility, input_mobility)
        if steps is not None:
            v = np.abs(v) + state.spread(steps[-nv:])
            there = _cancelling_terms(state, lin, v, mobility, input_mobility)
            terms = np.maximum(terms, rounding * there)
        sizes = np.maximum(_blocks(scaled_A, groups, groups), terms)
        errors /= np.where(sizes > 0.0, sizes, 1.0)
    every = ("A", groups, errors.tolist()), ("B", inputs, errors_B.tolist())
    return [
        (f"{matrix}[{row}, {column}]", error)
        for i, row in enumerate(groups)
        for matrix, columns, found in every
        for column, error in zip(columns, found[i], strict=True)
    ]


def _blocks(matrix: Array, rows: Mapping[str, Index], columns: Mapping[str, Index]) -> Array:
    """Return the largest entry of each block of a nonnegative matrix, 0 for an empty block."""
    largest = np.array([matrix[each].max(axis=0, initial=0.0) for each in rows.values()])
    found = [largest[:, each].max(axis=1, initial=0.0) for each in columns.values()]
    return np.array(found).reshape(len(columns), len(rows)).T


def mobilities(M: Array, B: Array) -> tuple[Array, Array]:
    """Return sqrt((M^-1)_ii) (6 + n,), and sqrt(b^T M^-1 b) (nu,) for the force b of each input."""
    own = np.sqrt(np.linalg.inv(M).diagonal())
    lower = B[-len(M) :]
    inputs = np.sqrt(np.einsum("ik,ij,jk->k", lower, M, lower))
    return own, np.where(inputs > 0.0, inputs, 1.0)


def _cancelling_terms(
    state: StateMap, lin: LinearModel, v: Array, mobility: Array, input_mobility: Array
) -> Array:
    """Return the size (6, 6) of the terms that may cancel, for each block of the scaled A."""
    # The base's linear velocity counts only through the rounding errors that it causes in
    # Pinocchio's derivatives.
    speed, rate, momentum = speeds(state, v)
    # Gyroscopic torque of the wheels on a rotating link, in the units of the rows.
    spin = momentum * max(_largest(mobility[ANGULAR]), _largest(mobility[6:]))
    slowed = speed.copy()
    slowed[LINEAR] *= _ROUNDING_FRACTION
    resting = slowed / mobility
    accelerations = np.abs(lin.f0[-len(mobility) :]) / mobility
    forces = np.abs(lin.u0) * input_mobility
    size = _largest(accelerations) + _largest(forces) + rate * (_largest(resting) + spin)
    # Effect of a unit velocity at the present rates; for rotations, also at the present speed of
    # the base.
    unit = 1.0 / mobility
    turning = rate * np.array([_largest(unit[part]) for part in (ANGULAR, LINEAR, slice(6, None))])
    turning[[0, 2]] = np.maximum(turning[[0, 2]] + spin, _largest(resting[LINEAR]))
    terms: Array = np.zeros((6, 6))
    terms[:3, :3], terms[3:, :3], terms[3:, 3:] = _largest(speed[:6]), size, turning
    terms[:, 0] *= _largest(state.chart(lin.q).J)
    return terms


def speeds(state: StateMap, v: Array) -> tuple[Array, float, float]:
    """Return speeds (6 + n,) with wheels at 0, the largest rate, and the wheels' momentum."""
    speed, robot = np.abs(state.velocities(v)), state.robot
    inertia = np.array([robot.wheels.get(name, 0.0) for name in robot.joint_names])
    momentum = float(inertia @ speed[6:])
    momentum += sum(float(np.linalg.norm(stored)) for _, stored in robot.stored_momentum)
    speed[6:][inertia > 0.0] = 0.0
    return speed, max(_largest(speed[ANGULAR]), _largest(speed[6:])), momentum


def _largest(x: Array) -> float:
    return float(np.abs(x).max(initial=0.0))


def inertia_matrix(robot: Robot, lin: LinearModel, state: StateMap | None = None) -> Array:
    """Return M (6 + n, 6 + n) of a linear model, in state order and in the frame's axes."""
    state = state or StateMap(robot, reference=lin.reference, frame=lin.frame)
    M = _in_frame(state, lin.q, state.project(pin.crba(robot.model, robot.create_data(), lin.q).T))
    M.setflags(write=False)
    return M


def inverse_inertia(state: StateMap, lin: LinearModel) -> Array:
    """Return M^-1 (6 + n, 6 + n) from B of a linear model, in the frame's axes."""
    nv = 6 + state.robot.n
    inverse: Array = np.empty((nv, nv))
    Inertia(state, state.robot.create_data()).invert(lin.q, inverse)
    return _in_frame(state, lin.q, inverse)


def _in_frame(state: StateMap, q: Array, matrix: Array) -> Array:
    """Transform M or its inverse (6 + n, 6 + n) from base axes to the axes of the frame."""
    chart = state.chart(q)
    return state.to_frame(chart, state.to_frame(chart, matrix).T).T


# Speed of the base [m/s] above which rounding errors of this speed would hide other velocities.
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
        """Return q, v and dv/dt in Pinocchio's order."""
        _, q, v, a = self._accelerations(x[None], u[None])
        return q[0], v[0], a[0]

    def _accelerations(self, x: Array, u: Array) -> tuple[Chart, Array, Array, Array]:
        """Return the charts, q, v and dv/dt of rows of x and u."""
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
        """Return the states (N, nx) a time t (N, 1) after rows of q, v and a; angles are near x."""
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
            # Add the term by which the derivative of the components in reference axes differs.
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
        """Return the errors (N, nx) after reference and robot have moved for times t (N, 1)."""
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


def jacobian(f: Callable[[Array], Array], point: Array, steps: Array, is_curved: Mask) -> Array:
    """Return the Jacobian of f by central differences; f maps rows of points to rows of values.

    Columns in the mask `is_curved` use sixth-order differences, the others second-order ones.
    """
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
    # The step is small compared with the rotations over which the accelerations of aligned light
    # links change.
    step = np.full(state.nx, 2e-4)
    # The step stays well inside the chart: f becomes steep near the limit |q_b| = 1.
    step[groups.q_b] = 1e-2 * (1.0 - np.linalg.norm(lin.x0[groups.q_b]))
    # f is quadratic in the velocities and linear in the inputs, so there is no truncation error at
    # any step size.
    speed = np.abs(lin.x0[-nv:])
    step[-nv:] = 0.1 * max(1.0, float(speed[ANGULAR].max()), float(speed[6:].max(initial=0.0)))
    step[groups.v_b] = 0.1 * max(1.0, float(speed[LINEAR].max()))
    mobility, input_mobility = mobilities(M, lin.B)
    push = max(1.0, float(np.abs(lin.f0[-nv:] / mobility).max())) / input_mobility
    return step, push


def flow_error(model: Nonlinear, lin: LinearModel) -> float:
    """Return the relative error of f, compared with differentiated states of short motions."""
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
