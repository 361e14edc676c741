"""Check of linear models by ABA derivatives and by finite differences of the nonlinear model."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from fflin.base.rotation import rotation_matrices, rotation_matrix, skew
from fflin.base.tables import folded, grid
from fflin.base.validation import Array, Mask, frozen, instance, share
from fflin.dynamics import coordinates
from fflin.dynamics.aba import Aba
from fflin.dynamics.coordinates import ANGULAR, LINEAR, PIN_ANGULAR, PIN_LINEAR, Chart
from fflin.dynamics.integrators import integrate_rows
from fflin.dynamics.outputs import Measuring
from fflin.dynamics.rnea import Inertia
from fflin.dynamics.state import StateMap
from fflin.linear.fit import require_fit
from fflin.linear.model import Certificate, LinearModel, refuse_sampled
from fflin.linear.tool_coordinates import ToolCoordinates
from fflin.robot.outputs import FullState
from fflin.robot.robot import Robot


class Row(NamedTuple):
    """One error of a check, and the tolerance of the error."""

    test: str
    block: str
    error: float
    tolerance: float

    @property
    def ok(self) -> bool:
        """Whether the error is at most the tolerance; False if the error is NaN."""
        return self.error <= self.tolerance


_EPS = float(np.finfo(float).eps)
# Assumed rounding error [ulp] of a finite difference of outputs. Two ulp come from the weights of
# the difference, and the rest from the outputs.
_ULPS = 8.0

# Assumed rounding error [ulp] of a finite difference of accelerations.
_STEP_ULPS = 64.0

# The relative tolerance for the comparison with ABA derivatives is the largest of three values:
# _ROUTE_TOLERANCE, _ROUTE_ROUNDING times the condition number of M, and _ROUTE_SAFETY times the
# residual M M^-1 - I of ABA's M^-1. M is scaled to a unit diagonal.
_ROUTE_TOLERANCE, _ROUTE_ROUNDING = 1e-9, 1e2 * _EPS
# The comparison with finite differences has a tolerance of the first two kinds. Both values are
# larger, because the division by a small step amplifies rounding errors.
_DIFFERENCE_TOLERANCE, _DIFFERENCE_ROUNDING = 1e-8, 1e4 * _EPS

# Largest expected ratio of the error of ABA's derivatives to the residual M M^-1 - I of ABA's M^-1.
_ROUTE_SAFETY = 10.0

# Upper bound of all default tolerances, even for an ill-conditioned M. A larger tolerance would
# confirm fewer than two digits.
_LOOSEST = 1e-2

# In ABA's derivatives, the terms with the base's linear velocity cancel in exact arithmetic.
# Numerically, rounding errors of about 1e-16 of the terms remain. So the scale by which the errors
# of A are divided includes _ROUNDING_FRACTION times the terms. _ROUNDING_FRACTION times the
# tolerance 1e-9 is far above 1e-16. A larger _ROUNDING_FRACTION would hide other errors.
_ROUNDING_FRACTION = 1e-3


# If the base is faster than _FAST [m/s], ABA receives velocities relative to an observer. The
# observer moves with the velocity that the base has at the operating point. Without the observer,
# rounding errors of the base velocity would hide the other velocities. There is no observer in
# orbit.
_FAST = 100.0

# Sixth-order central difference: weights of f(x + k h) - f(x - k h), k = 1, 2, 3. The error of the
# difference is h^6 f^(7) / 140.
_WEIGHTS = (45.0 / 60.0, -9.0 / 60.0, 1.0 / 60.0)


@dataclass(frozen=True)
class Check:
    """Result of `check`: the errors of a linear model; ``print`` shows a table.

    Attributes
    ----------
    rows : tuple of Row
        One row per comparison of a block of A or B, with its error and tolerance.
    title : str
        Description of the checked model.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> lin = fflin.linearize(robot)
    >>> [row.block for row in fflin.check(robot, lin).rows][:3]
    ['A[q_b, q_b]', 'A[q_b, r_b]', 'A[q_b, q_m]']
    """

    rows: tuple[Row, ...]
    title: str

    @property
    def ok(self) -> bool:
        """Whether all errors are within their tolerances."""
        return all(row.ok for row in self.rows)

    @property
    def max_error(self) -> float:
        """Largest relative error."""
        return float(np.max([row.error for row in self.rows]))

    @property
    def failures(self) -> tuple[Row, ...]:
        """Rows in which the error exceeds the tolerance."""
        return tuple(row for row in self.rows if not row.ok)

    def __str__(self) -> str:
        """Show whether the model is verified, and the largest error of each kind of comparison."""
        if failures := self.failures:
            names = [f"{row.block} ({row.test})" for row in failures[:6]]
            names += ["..."] * (len(failures) > 6)
            said = f"{len(failures)} of {len(self.rows)} comparisons FAILED: {', '.join(names)}"
            verdict = f"A and B are not verified: {said}"
        else:
            largest = max(self.rows, key=lambda row: row.error)
            said = f"{largest.error:.1e} (allowed {largest.tolerance:.1e})"
            verdict = f"A and B are verified: largest error {said}"
        table = [["compared with", "comparisons", "largest error", "of", "allowed"]]
        for test in dict.fromkeys(row.test for row in self.rows):
            rows = [row for row in self.rows if row.test == test]
            worst = max(rows, key=lambda row: (not row.ok, row.error))
            figures = f"{worst.error:.1e}", worst.block, f"{worst.tolerance:.1e}"
            table.append([test, str(len(rows)), *figures])
        title = f"{self.title}, {len(self.rows)} comparisons"
        return "\n\n".join((folded([verdict]), folded([title]), grid(table, "lrrlr")))


def check(robot: Robot, lin: LinearModel, *, tolerance: float | None = None) -> Check:
    r"""Check a linear model by two independent computations.

    A and B are compared block by block with

    - Pinocchio's ABA derivatives, mapped into the attitude chart of the model (relative tolerance
      1e-9);
    - sixth-order central differences of the nonlinear model :math:`\dot x = f(x, u)` in the same
      chart (relative tolerance 1e-8). The function f is itself verified against integrated motions.

    For an ill-conditioned inertia matrix M, the tolerances are larger, because round-off errors
    grow with the condition number of M.

    Parameters
    ----------
    robot : Robot
        Robot whose linear model is checked.
    lin : LinearModel
        Continuous-time model from `linearize`, a file or another tool.
    tolerance : float, optional
        Relative tolerance for all errors, instead of the default tolerances. For example, use 1e-5
        if another tool computed A and B by finite differences.

    Returns
    -------
    Check
        Result, in which ``ok`` is True if no error exceeds its tolerance.

    Raises
    ------
    InputError
        If the model is in discrete time, the model and the robot have different states or inputs,
        or the tolerance is not between 0 and 1.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> lin = fflin.linearize(robot)
    >>> found = fflin.check(robot, lin)
    >>> found.ok, found.max_error < 1e-6
    (True, True)
    """
    instance("lin", lin, LinearModel, "a fflin.LinearModel")
    refuse_sampled(lin.dt, "check")
    return check_all(robot, [lin], tolerance=tolerance)


def check_all(
    robot: Robot, models: Iterable[LinearModel], title: str = "", *, tolerance: float | None = None
) -> Check:
    """Check models; for each comparison, keep only the row with the largest error / tolerance."""
    if tolerance is not None:
        tolerance = share("tolerance", tolerance)
    worst: dict[tuple[str, str], Row] = {}
    for lin in models:
        for test, errors, allowed in _comparisons(robot, lin):
            for block, error in errors.items():
                row = Row(test, block, error, tolerance or allowed)
                before = worst.setdefault((test, block), row)
                if not row.error * before.tolerance <= before.error * row.tolerance:
                    worst[test, block] = row
        if not title:
            condition = scaled_condition(inertia_matrix(robot, lin))
            title = f"{robot.name}, frame {lin.frame}, scaled cond(M) {condition:.1e}"
    title += "" if tolerance is None else f", each error at most {tolerance:.1e}"
    return Check(tuple(worst.values()), title)


def _comparisons(robot: Robot, lin: LinearModel) -> Iterator[tuple[str, dict[str, float], float]]:
    """Yield the name, the errors {block: error} and the tolerance of each comparison."""
    state = StateMap(robot, reference=lin.reference, frame=lin.frame)
    require_fit(lin, robot, state, whole=True, sensed=True)
    q, v = robot.checked_configuration(lin.q), robot.checked_velocity(lin.v)
    aba, M = Aba(state), inertia_matrix(robot, lin)
    A, B, aba_inverse = aba_route(aba, q, v, lin.u0, moving=lin.moving)
    scales = Scales(aba, lin, M, B)

    condition = scaled_condition(M)
    route = min(max(_ROUTE_TOLERANCE, _ROUTE_ROUNDING * condition), _LOOSEST)
    difference = min(max(_DIFFERENCE_TOLERANCE, _DIFFERENCE_ROUNDING * condition), _LOOSEST)
    # If links are far apart, ABA is less accurate than the composite-rigid-body algorithm. So the
    # error of ABA's derivatives is estimated from the residual M M^-1 - I. M is from the
    # composite-rigid-body algorithm, and M^-1 is from ABA.
    own_error = inertia_residual(M, _in_frame(state, q, aba_inverse))
    by_aba = min(max(route, _ROUTE_SAFETY * own_error), _LOOSEST)
    yield "ABA derivatives", scales.errors(A, B), by_aba

    model, nx, nv, g = Nonlinear(aba, lin), state.nx, len(M), state.groups
    point = np.concatenate((lin.x0, lin.u0))
    # The steps of the joint positions must be small. If light links are aligned, even a small
    # rotation of a joint strongly changes the accelerations.
    steps = np.full(nx + len(lin.u0), 2e-4)
    # Keep the points of the differences well inside the chart, because f is steep near the limit
    # |q_b| = 1 of the chart.
    steps[g.q_b] = 1e-2 * (1.0 - np.linalg.norm(lin.x0[g.q_b]))
    # f is quadratic in the velocities and linear in the inputs. So central differences with respect
    # to velocities and inputs have no truncation error, even with large steps.
    speed = np.abs(lin.x0[-nv:])
    steps[nv:nx] = 0.1 * max(1.0, _largest(speed[ANGULAR]), _largest(speed[6:]))
    steps[g.v_b] = 0.1 * max(1.0, _largest(speed[LINEAR]))
    steps[nx:] = max(1.0, _largest(lin.f0[-nv:] / scales.mobility)) / scales.input_mobility
    # Only the attitude and the joint positions need sixth-order differences, because f is at most
    # quadratic in every other variable.
    bends = np.zeros(len(point), dtype=bool)
    bends[g.q_b] = bends[g.q_m] = True
    slopes = jacobian(model.rates, point, steps, bends)
    rounding = _STEP_ULPS * _EPS / difference
    errors = scales.errors(slopes[:, :nx], slopes[:, nx:], steps=steps[:nx], rounding=rounding)
    yield "differences", errors, difference
    yield "outputs", _output_errors(model, lin, steps, difference), difference
    yield "flow", {"f": model.flow_error()}, difference

    x0 = state.read(q, v, near=lin.x0)
    yield "point", {"x0": _largest(lin.x0 - x0) / max(1.0, _largest(x0))}, route
    f0, sizes = model.rates(point[None])[0], np.append(np.ones(nv), scales.mobility * scales.push)
    for name, part in g._asdict().items():
        size = max(_largest(sizes[part]) or 1.0, _largest(f0[part]))
        yield "point", {f"f0[{name}]": _largest(lin.f0[part] - f0[part]) / size}, route

    # If the inputs are the default ones, the lower half of B is M^-1.
    inverse = lin.B[-len(M) :] if aba.actuation.default else inverse_inertia(state, lin)
    scale = 1.0 / np.sqrt(np.abs(inverse.diagonal()))
    scaled = scale[:, None] * inverse * scale
    least = float(np.linalg.eigvalsh((scaled + scaled.T) / 2.0)[0])
    yield "inertia", {"M": _largest(lin.M - M) / _largest(M)}, route
    yield "inertia", {"M M^-1 = I": inertia_residual(M, inverse)}, route
    yield "inertia", {"M^-1 symmetric": _largest(scaled - scaled.T)}, 1e-12
    yield "inertia", {"M^-1 positive": max(0.0, -least)}, 1e-12


def _output_errors(
    model: Nonlinear, lin: LinearModel, steps: Array, tolerance: float
) -> dict[str, float]:
    """Return the errors of y0, C and D.

    y0 is compared with the outputs of the nonlinear model. C and D are compared with finite
    differences of the outputs. If the output is the state, the errors are y0 - x0, C - I and D.
    """
    state, nx = model.state, len(lin.x0)
    if state.robot.outputs == (FullState(),):
        of_C = _largest(lin.C - np.eye(nx))
        return {"y0": _largest(lin.y0 - lin.x0), "C": of_C, "D": _largest(lin.D)}
    measuring, point = Measuring(state, lin.q), np.concatenate((lin.x0, lin.u0))

    def y(z: Array) -> Array:
        _, q, v, a = model.accelerations(z)
        return np.array([measuring(*each) for each in zip(z[:, :nx], q, v, a, strict=True)])

    here, slopes = y(point[None])[0], jacobian(y, point, steps, np.ones(len(point), dtype=bool))
    errors = {"y0": _largest(lin.y0 - here) / max(1.0, float(np.abs(here).max()))}
    # Divide the errors of a row by the largest derivative in the row, or by `noise` if `noise` is
    # larger. `noise` is the rounding error of y / step, divided by the tolerance. So rounding
    # errors alone do not exceed the tolerance.
    noise = _ULPS * _EPS / tolerance * np.maximum(1.0, np.abs(here))[:, None] / steps
    for name, given, part in (("C", lin.C, slice(nx)), ("D", lin.D, slice(nx, None))):
        largest = np.abs(slopes[:, part]).max(axis=1, initial=0.0, keepdims=True)
        errors[name] = _largest((given - slopes[:, part]) / np.maximum(largest, noise[:, part]))
    return errors


def certify(robot: Robot, lin: LinearModel) -> Certificate:
    """Return the certificate of a continuous-time model.

    The certificate contains the largest errors of A and of B, compared with ABA derivatives.
    """
    aba = Aba(StateMap(robot, reference=lin.reference, frame=lin.frame))
    A, B, _ = aba_route(aba, lin.q, lin.v, lin.u0, moving=lin.moving)
    errors = Scales(aba, lin, lin.M, B).errors(A, B)
    return Certificate(
        condition=scaled_condition(lin.M),
        inertia_residual=inertia_residual(lin.M, inverse_inertia(aba.state, lin)),
        route_A=max(error for name, error in errors.items() if name[0] == "A"),
        route_B=max(error for name, error in errors.items() if name[0] == "B"),
        f0=float(np.abs(lin.f0).max()),
    )


def scaled_condition(M: Array) -> float:
    """Return the condition number of M scaled to a unit diagonal."""
    scale = 1.0 / np.sqrt(M.diagonal())
    return float(np.linalg.cond(scale[:, None] * M * scale))


def inertia_residual(M: Array, inverse: Array) -> float:
    """Return the largest magnitude in ``M M^-1 - I``, with M scaled to a unit diagonal."""
    scale = np.sqrt(M.diagonal())
    residual = M @ inverse - np.eye(len(M))
    return float(np.abs(residual * scale / scale[:, None]).max())


def inertia_matrix(robot: Robot, lin: LinearModel) -> Array:
    """Return M (6 + n, 6 + n) of a linear model, in state order and in the frame's axes."""
    state = StateMap(robot, reference=lin.reference, frame=lin.frame)
    upper = pin.crba(robot.model, robot.create_data(), lin.q)
    return frozen(_in_frame(state, lin.q, state.project(upper.T)))


def inverse_inertia(state: StateMap, lin: LinearModel) -> Array:
    """Return M^-1 (6 + n, 6 + n) at the point of a linear model, in the frame's axes."""
    nv = 6 + state.robot.n
    inverse: Array = np.empty((nv, nv))
    Inertia(state, state.robot.create_data()).invert(lin.q, inverse)
    return _in_frame(state, lin.q, inverse)


def _in_frame(state: StateMap, q: Array, matrix: Array) -> Array:
    """Transform M or its inverse (6 + n, 6 + n) from base axes to the axes of the frame."""
    chart = state.chart(q)
    return state.to_frame(chart, state.to_frame(chart, matrix).T).T


def aba_route(
    aba: Aba, q: Array, v: Array, u: Array, *, moving: bool = False
) -> tuple[Array, Array, Array]:
    """Return A and B from ABA's derivatives, see (4.9), (15.3), (15.4); also return ABA's M^-1.

    `u` is in the axes of the frame. M^-1 (6 + n, 6 + n) is in base axes.
    """
    state = aba.state
    own, nu = ToolCoordinates(state, moving=moving), state.velocities(v)
    u, nv = aba.actuation.in_base_axes(state.chart(q), u), len(nu)
    # Pinocchio differentiates about the world's origin, and loses accuracy if the base is distant.
    # So place the base at the world's origin. This is allowed, because A and B do not depend on the
    # position of the base, even in orbit.
    at_origin = q.copy()
    at_origin[:3] = 0.0
    by_q, by_v, by_u = aba.slopes(at_origin, v, u)
    (rates,) = state.velocities(aba.accelerations(at_origin[None], v[None], u[None]))
    there = own.jacobians(q, nu, u, rates)
    # Assemble A_y and B_y of (4.9). The upper half of A_y is the kinematics of a small displacement
    # in axes that rotate with the base.
    A, B = np.zeros((state.nx, state.nx)), np.zeros((state.nx, len(u)))
    A[ANGULAR, ANGULAR] = A[LINEAR, LINEAR] = -skew(nu[ANGULAR])
    A[LINEAR, ANGULAR] = -skew(nu[LINEAR])
    A[:nv, nv:] = np.eye(nv)
    A[nv:], B[nv:] = np.hstack((by_q, by_v)), by_u
    A = (there.P @ (A + B @ there.H) + there.rate) @ there.left
    return A, there.P @ B @ there.V, aba.inverse


class Scales:
    """Magnitudes of the terms of a model, by which the errors of A and B are divided.

    The arguments are the inertia M (6 + n, 6 + n) and B (nx, nu). B must come from an independent
    computation, not from the model.
    """

    def __init__(self, aba: Aba, lin: LinearModel, M: Array, B: Array) -> None:
        self._state = state = aba.state
        self._inputs, self._lin, self._nv = aba.actuation.groups, lin, len(M)
        # In orbit, the terms that cancel contain the inertial velocity, not the velocity relative
        # to the orbital frame.
        self._v = state.field.absolute(lin.q, lin.v) if state.field else lin.v
        # The mobility of coordinate i is sqrt((M^-1)_ii). The mobility of an input is
        # sqrt(b^T M^-1 b), where b is the generalised force of a unit input.
        self.mobility = np.sqrt(np.linalg.inv(M).diagonal())
        lower = B[-self._nv :]
        inputs = np.sqrt(np.einsum("ik,ij,jk->k", lower, M, lower))
        self.input_mobility = np.where(inputs > 0.0, inputs, 1.0)
        self._terms, self.push = self._sizes(self._v)

    def errors(
        self, A: Array, B: Array, *, steps: Array | None = None, rounding: float = 0.0
    ) -> dict[str, float]:
        """Compare the model with other A and B; return {block: error}.

        A block is, for example, "A[q_b, q_m]". Give `steps` and `rounding` if A and B were computed
        by finite differences. `steps` (nx,) are the steps of the differences. `rounding` is the
        rounding error of the differences, divided by the tolerance.
        """
        # Divide the row of each acceleration by the mobility of the coordinate, so that a light
        # joint does not hide the error of a heavy joint. Divide each column of B by the mobility of
        # the input. Next, divide the errors of each block of A by the largest scaled entry of the
        # block. Terms that are larger than the entries may cancel in a block, but the rounding
        # errors of the terms remain. If so, divide by the magnitude of the terms.
        state, lin, nv = self._state, self._lin, self._nv
        terms = self._terms
        if steps is not None:
            there, _ = self._sizes(np.abs(self._v) + state.spread(steps[-nv:]))
            terms = np.maximum(terms, rounding * there)
        row_scale = np.concatenate((np.ones(nv), self.mobility))[:, None]
        column_scale = np.where(np.arange(2 * nv)[:, None] < nv, 1.0, self.input_mobility)
        of_A, of_B = (lin.A - A) / row_scale, (lin.B - B) / row_scale / column_scale
        own, groups, errors = lin.A / row_scale, state.groups._asdict(), dict[str, float]()
        for i, (row, rows) in enumerate(groups.items()):
            for j, (column, columns) in enumerate(groups.items()):
                size = max(_largest(own[rows, columns]), float(terms[i, j])) or 1.0
                errors[f"A[{row}, {column}]"] = _largest(of_A[rows, columns]) / size
            for column, inputs in self._inputs.items():
                errors[f"B[{row}, {column}]"] = _largest(of_B[rows, inputs])
        return errors

    def _sizes(self, v: Array) -> tuple[Array, float]:
        """Return magnitudes of terms that may cancel: (6, 6) for the blocks of A, and one for f0.

        The terms are evaluated at the velocity v (nv,), in Pinocchio's order. In the row of each
        acceleration, the terms are divided by the mobility of the coordinate.
        """
        mobility, lin, robot = self.mobility, self._lin, self._state.robot
        speed, momentum = np.abs(self._state.velocities(v)), 0.0
        wheels = robot.wheels_at(v)
        for i, name in enumerate(robot.joint_names, 6):
            if name in wheels:  # a wheel counts by its momentum, not by its speed
                momentum += wheels[name] * float(speed[i])
                speed[i] = 0.0
        for _, stored in robot.stored_momentum:
            momentum += float(np.linalg.norm(stored))
        rate = max(_largest(speed[ANGULAR]), _largest(speed[6:]))
        # Gyroscopic torque of the wheels per unit angular velocity of the links, multiplied by the
        # largest mobility. The acceleration is the torque times the squared mobility. So the scaled
        # acceleration is the torque times the mobility.
        spin = momentum * max(_largest(mobility[ANGULAR]), _largest(mobility[6:]))
        # Multiply the base's linear velocity by _ROUNDING_FRACTION, because terms with the linear
        # velocity contribute only rounding errors to Pinocchio's derivatives.
        slowed = speed.copy()
        slowed[LINEAR] *= _ROUNDING_FRACTION
        resting, unit = slowed / mobility, 1.0 / mobility
        accelerations = _largest(lin.f0[-self._nv :] / mobility)
        forces = _largest(lin.u0 * self.input_mobility)
        terms: Array = np.zeros((6, 6))
        terms[:3, :3] = _largest(speed[:6])
        terms[3:, :3] = accelerations + forces + rate * (_largest(resting) + spin)
        # Magnitudes of the derivatives of the velocity-dependent accelerations with respect to
        # omega_b, v_b and the joint velocities, at the velocity v. The derivatives with respect to
        # omega_b and to the joint velocities also contain the linear velocity of the base.
        turning = rate * np.array([*map(_largest, np.split(unit, (3, 6)))])
        turning[[0, 2]] = np.maximum(turning[[0, 2]] + spin, _largest(resting[LINEAR]))
        terms[3:, 3:] = turning
        terms[:, 0] *= _largest(self._state.chart(lin.q).J)
        return terms, forces + rate**2 * _largest(unit) + rate * momentum * _largest(mobility)


class Nonlinear:
    """Nonlinear model ``xdot = f(x, u)`` in the chart of a linear model, computed by ABA.

    If the linear model has a moving reference, x is the error relative to the reference. In this
    case, f is 0 at the operating point.
    """

    def __init__(self, aba: Aba, lin: LinearModel, state: StateMap | None = None) -> None:
        self._aba, self._lin = aba, lin
        self.state = state or aba.state
        observer = rotation_matrix(lin.q[3:7]) @ lin.v[PIN_LINEAR]
        moves = np.linalg.norm(observer) > _FAST and aba.field is None
        self._observer = observer if moves else np.zeros(3)
        # Velocity and acceleration of a moving reference; zero for a fixed reference.
        self._v: Array = np.zeros((1, aba.state.robot.nv))
        self._a: Array = np.zeros_like(self._v)
        if lin.moving:
            _, _, self._v, self._a = self.accelerations(np.concatenate((lin.x0, lin.u0))[None])

    def accelerations(self, point: Array) -> tuple[Chart, Array, Array, Array]:
        """Return the charts, q, v and dv/dt for rows (N, nx + nu) of states and inputs.

        q, v and dv/dt are in Pinocchio's order.
        """
        x, u = np.split(point, [self.state.nx], axis=1)
        chart, q, v = self.state.points(x)
        observer = self._observer @ rotation_matrices(q[:, 3:7])
        relative = v.copy()
        relative[:, PIN_LINEAR] -= observer
        a = self._aba.accelerations(q, relative, self._aba.actuation.in_base_axes(chart, u))
        a[:, PIN_LINEAR] -= np.cross(v[:, PIN_ANGULAR], observer)
        return chart, q, v, a

    def rates(self, point: Array) -> Array:
        """Return dx/dt (N, nx) for rows (N, nx + nu) of states and inputs."""
        state, (chart, _, v, a) = self.state, self.accelerations(point)
        # The error (5.1) relative to a reference with velocities v* and w* has the derivatives
        # de/dt = (e0 (w - w*) + e x (w + w*)) / 2 and dr/dt = R_e v - v* - w* x r. Here (e, e0) is
        # the error quaternion, and R_e is the rotation matrix of the error.
        linear, angular = v[:, PIN_LINEAR], v[:, PIN_ANGULAR]
        at_linear, at_angular = self._v[:, PIN_LINEAR], self._v[:, PIN_ANGULAR]
        turning = chart.q0 * (angular - at_angular)
        turning += np.cross(chart.q_b, angular + at_angular)
        position_rate = coordinates.times(chart.R, linear) - at_linear
        position_rate -= np.cross(at_angular, point[:, state.groups.r_b])
        rate = state.velocities(a)
        if state.axes[1]:
            # `rate` contains the time derivative of the components of v in base axes, which rotate.
            # Add w x v to obtain the time derivative of v relative to the reference axes.
            rate[:, LINEAR] += np.cross(angular, linear)
        rate = state.to_frame(chart, rate[..., None])[..., 0] - state.velocities(self._a)
        joint_rates = state.velocities(v - self._v)[:, 6:]
        return np.concatenate((0.5 * turning, position_rate, joint_rates, rate), axis=1)

    def flow_error(self) -> float:
        """Return the relative error of f, compared with differences of x along short motions."""
        lin, robot = self._lin, self.state.robot
        reference = pin.SE3(lin.reference.rotation, np.zeros(3))
        state = StateMap(robot, reference=reference, frame=lin.frame)
        near = Nonlinear(self._aba, lin, state)
        # The first row is the operating point. In each other row, one component of the base
        # velocity is increased by 1.
        x = np.tile(lin.x0, (7, 1))
        x[:, state.groups.r_b] = 0.0
        x[1:, 6 + robot.n : 12 + robot.n] += np.eye(6)
        point = np.hstack((x, np.tile(lin.u0, (7, 1))))
        (chart, q, v, a), expected = near.accelerations(point), near.rates(point)
        # Evaluate each motion at the times t = +-h, +-2 h and +-3 h.
        h = float(1e-2 * np.min(chart.q0) / (1.0 + np.abs(v[:, 3:]).max()))
        t, speeds = h * np.repeat((1.0, 2.0, 3.0, -1.0, -2.0, -3.0), 7)[:, None], np.tile(v, (6, 1))
        moved = integrate_rows(robot.model, np.tile(q, (6, 1)), t * speeds)
        after = coordinates.state_history(state, moved, speeds + t * np.tile(a, (6, 1)), x[0])
        if lin.moving:  # the first row is also the motion of the reference
            after = coordinates.moving_errors("local", after, np.repeat(after[::7], 7, axis=0))
        ahead, behind = after.reshape(2, 3, *x.shape)
        rates = np.tensordot(_WEIGHTS, ahead - behind, axes=1) / h
        floor, size = 1.0 + np.abs(v).max(axis=1), np.abs(expected).max(axis=1)
        return float((np.abs(expected - rates).max(axis=1) / np.maximum(floor, size)).max())


def jacobian(f: Callable[[Array], Array], point: Array, steps: Array, is_curved: Mask) -> Array:
    """Return the Jacobian of f at a point, computed by central differences with the given steps.

    f maps rows of points to rows of values. The mask `is_curved` selects the variables for which
    sixth-order differences are used. For all other variables, second-order differences are used.
    """
    curved, straight = np.diag(steps)[is_curved], np.diag(steps)[~is_curved]
    offsets = np.concatenate((curved, 2.0 * curved, 3.0 * curved, straight))
    first, last = np.split(f(np.concatenate((point + offsets, point - offsets))), 2)
    *near, rest = np.split(first - last, len(curved) * np.arange(1, 4))
    derivatives: Array = np.empty((rest.shape[1], len(point)))
    derivatives[:, is_curved] = np.tensordot(_WEIGHTS, near, axes=1).T
    derivatives[:, ~is_curved] = 0.5 * rest.T
    return derivatives / steps


def _largest(x: Array) -> float:
    return float(np.abs(x).max(initial=0.0))
