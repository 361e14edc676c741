"""Check of linear models by ABA derivatives and by finite differences of the nonlinear model."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from fflin.base.rotation import rotation_matrices, rotation_matrix, skew
from fflin.base.tables import folded, grid
from fflin.base.validation import Array, Indices, Mask, frozen, instance, share
from fflin.dynamics import coordinates
from fflin.dynamics.aba import Aba, scaled_inverse
from fflin.dynamics.coordinates import ANGULAR, LINEAR, PIN_ANGULAR, PIN_LINEAR, Chart
from fflin.dynamics.integrators import integrate_rows
from fflin.dynamics.outputs import Measuring, state_indices
from fflin.dynamics.rnea import Inertia
from fflin.dynamics.state import StateMap
from fflin.linear.fit import require_fit
from fflin.linear.model import Certificate, LinearModel, refuse_sampled
from fflin.linear.scales import (
    Reference,
    Row,
    block_scales,
    sampled,
    scales,
    spread_over,
)
from fflin.linear.tool_coordinates import ToolCoordinates
from fflin.robot.outputs import FullState
from fflin.robot.robot import Robot


_EPS = float(np.finfo(float).eps)

# Relative tolerances for the comparison with ABA derivatives and with finite differences. Rounding
# errors that exceed them increase the tolerance, see `Reference`.
_ROUTE_TOLERANCE, _DIFFERENCE_TOLERANCE = 1e-9, 1e-8

# The tolerance for M M^-1 = I is larger if this factor times the condition number of the scaled M
# exceeds the tolerance.
_ROUTE_ROUNDING = 1e2 * _EPS

# Upper bound of this tolerance. A larger tolerance would confirm fewer than two digits.
_LOOSEST = 1e-2

# Assumed rounding error [ulp] of sums, relative to the sum of the magnitudes of their terms.
_ULPS = 64.0

# The same for short sums.
_SUM_ULPS = 8.0

# Relative change of the operating point, for which the ABA derivatives are computed again to sample
# their rounding errors. It is a few ulp, so it changes the exact derivatives by no more than their
# rounding errors.
_NUDGE, _SAMPLES = 1e-14, 3

# Ratio of the steps of the two finite differences, from which their error is estimated.
_STEP_RATIO = 1.5

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
        for row in _comparisons(robot, lin):
            if tolerance is not None:
                row = row._replace(tolerance=tolerance)
            before = worst.setdefault((row.test, row.block), row)
            if not row.error * before.tolerance <= before.error * row.tolerance:
                worst[row.test, row.block] = row
        if not title:
            condition = scaled_condition(inertia_matrix(robot, lin))
            title = f"{robot.name}, frame {lin.frame}, scaled cond(M) {condition:.1e}"
    title += "" if tolerance is None else f", each error at most {tolerance:.1e}"
    return Check(tuple(worst.values()), title)


def _comparisons(robot: Robot, lin: LinearModel) -> Iterator[Row]:
    """Yield the row of each comparison of a model with independent computations."""
    state = StateMap(robot, reference=lin.reference, frame=lin.frame)
    require_fit(lin, robot, state, whole=True, sensed=True)
    yield from References(robot, lin).rows(lin)


class References:
    """Independent computations of everything that `check` compares, at the point of a model.

    They use the operating point of the model, but none of its matrices.
    """

    def __init__(self, robot: Robot, lin: LinearModel) -> None:
        self.route = Route(robot, lin)
        state = self.route.state
        self._model = Nonlinear(self.route.aba, lin)
        self._point = np.concatenate((lin.x0, lin.u0))
        self.A, self.B = self.route.A, self.route.B
        self.by_steps = self._differences(lin)
        self.x0 = state.read(self.route.q, self.route.v, near=lin.x0)
        self.f0 = self._rates()
        self.flow_error = self._model.flow_error()
        self.outputs: Outputs | None = None
        if robot.outputs != (FullState(),):
            self.outputs = Outputs(
                self._model, self.route, lin, self._steps(lin, joints=0.03, modes=0.1)
            )

    def rows(self, lin: LinearModel) -> Iterator[Row]:
        """Compare a model that has this operating point."""
        route, groups = self.route, self.route.state.groups
        names = groups._asdict()
        of_A, of_B = self.by_steps
        for test, A, B, least in (
            ("ABA derivatives", self.A, self.B, _ROUTE_TOLERANCE),
            ("differences", of_A, of_B, _DIFFERENCE_TOLERANCE),
        ):
            for row, rows in names.items():
                for column, columns in names.items():
                    where = np.ix_(_indices(rows), _indices(columns))
                    yield A.row(test, f"A[{row}, {column}]", lin.A, where, least)
                for column, inputs in route.aba.actuation.groups.items():
                    where = np.ix_(_indices(rows), inputs)
                    yield B.row(test, f"B[{row}, {column}]", lin.B, where, least)
        if self.outputs is None:
            of_C = _largest(lin.C - np.eye(len(lin.x0)))
            errors = {"y0": _largest(lin.y0 - lin.x0), "C": of_C, "D": _largest(lin.D)}
            for block, error in errors.items():
                yield Row("outputs", block, error, _DIFFERENCE_TOLERANCE)
        else:
            yield from self.outputs.rows(lin)
        yield Row("flow", "f", self.flow_error, _DIFFERENCE_TOLERANCE)
        apart = _largest((lin.x0 - self.x0) / np.maximum(1.0, np.abs(self.x0)))
        yield Row("point", "x0", apart, _ROUTE_TOLERANCE)
        for name, rows in names.items():
            where = np.ix_(_indices(rows), [0])
            yield self.f0.row("point", f"f0[{name}]", lin.f0[:, None], where, _ROUTE_TOLERANCE)

        # If the inputs are the default ones, the lower half of B is M^-1.
        M, condition = route.M, scaled_condition(route.M)
        own = route.aba.actuation.default
        inverse = lin.B[-len(M) :] if own else inverse_inertia(route.state, lin)
        scale = 1.0 / np.sqrt(np.abs(inverse.diagonal()))
        scaled = scale[:, None] * inverse * scale
        least = float(np.linalg.eigvalsh((scaled + scaled.T) / 2.0)[0])
        allowed = min(max(_ROUTE_TOLERANCE, _ROUTE_ROUNDING * condition), _LOOSEST)
        root = np.sqrt(M.diagonal())
        yield Row("inertia", "M", _largest((lin.M - M) / np.outer(root, root)), _ROUTE_TOLERANCE)
        yield Row("inertia", "M M^-1 = I", inertia_residual(M, inverse), allowed)
        yield Row("inertia", "M^-1 symmetric", _largest(scaled - scaled.T), 1e-12)
        yield Row("inertia", "M^-1 positive", max(0.0, -least), 1e-12)

    def _steps(self, lin: LinearModel, joints: float, modes: float) -> Array:
        """Return the steps (nx + nu,) of finite differences.

        `joints` and `modes` are the displacements [rad or m] of joints and of the bodies that model
        modes.
        """
        route, g = self.route, self.route.state.groups
        nx, nv, nu = route.state.nx, len(route.M), len(lin.u0)
        # A unit of the amplitude of a mode moves its body by `scale` [rad or m].
        bodies = route.state.robot.joints
        steps = np.zeros(nx + nu)
        steps[g.q_m] = [(modes if body.mode else joints) / body.scale for body in bodies]
        # Keep the points of the differences well inside the chart, because f is steep near the
        # limit |q_b| = 1 of the chart.
        steps[g.q_b] = 5e-3 * (1.0 - np.linalg.norm(lin.x0[g.q_b]))
        # f and the outputs are at most quadratic in the position of the base and in the velocities,
        # and linear in the inputs. So central differences have no truncation error, even with large
        # steps.
        steps[g.r_b] = 0.1
        per_unit = np.array([1.0 / body.scale for body in bodies])
        speed = np.abs(route.nu)
        fastest = max(1.0, _largest(speed[ANGULAR]), _largest(speed[6:] / per_unit))
        steps[g.omega_b] = 0.1 * fastest
        steps[g.qdot_m] = 0.1 * fastest * per_unit
        steps[g.v_b] = 0.1 * max(1.0, _largest(speed[LINEAR]))
        steps[nx:] = max(1.0, _largest(route.rates / route.mobility)) / route.input_mobility
        return steps

    def _differences(self, lin: LinearModel) -> tuple[Reference, Reference]:
        """Return A and B by finite differences of the nonlinear model."""
        route, model = self.route, self._model
        nx, nv, g = route.state.nx, len(route.M), route.state.groups
        # The steps of the joint positions must be small. If light links are aligned, even a small
        # rotation of a joint strongly changes the accelerations. Only the attitude and the joint
        # positions need sixth-order differences.
        steps = self._steps(lin, joints=2e-4, modes=1e-2)
        is_curved = np.zeros(len(steps), dtype=bool)
        is_curved[g.q_b] = is_curved[g.q_m] = True
        slopes = jacobian(model.rates, self._point, steps, is_curved)
        again = jacobian(model.rates, self._point, steps / _STEP_RATIO, is_curved)
        # The rounding error of a difference is the rounding error of f, divided by the step. The
        # rounding error of f contains the rounding error of x.
        still = np.abs(slopes) @ np.abs(self._point)
        size = np.tile((still + route.rate_terms(np.zeros(nv)))[:, None], len(steps))
        size[:, nv:nx] = (still + route.rate_terms(steps[nv:nx]))[:, None]
        rounding = _ULPS * _EPS * size / steps
        rounding += sampled(g._asdict(), slopes, [again], route.units)
        return (
            Reference(slopes[:, :nx], self.A.scale, rounding[:, :nx]),
            Reference(slopes[:, nx:], self.B.scale, rounding[:, nx:]),
        )

    def _rates(self) -> Reference:
        """Return f0 (nx, 1) as computed by the nonlinear model."""
        route = self.route
        f0 = self._model.rates(self._point[None])[0][:, None]
        terms = route.rate_terms(np.zeros(len(route.M)))[:, None]
        units = route.units
        columns = {"f0": slice(1)}
        scale = scales(route.state.groups._asdict(), columns, f0, terms, units, np.ones(1))
        rounding = np.zeros_like(f0)
        nv = len(route.M)
        rounding[nv:, 0] = (_whole(route.at.P, nv) @ np.append(np.zeros(nv), route.rate_error))[nv:]
        return Reference(f0, scale, rounding)


def _indices(part: slice) -> Array:
    return np.arange(part.start, part.stop)


class Dynamics(NamedTuple):
    """Accelerations (6 + n,) and their derivatives in base axes."""

    rates: Array
    by_q: Array
    by_v: Array
    by_u: Array


def _dynamics(aba: Aba, q: Array, v: Array, u: Array) -> Dynamics:
    """Return the accelerations by ABA and their derivatives; `u` is in base axes."""
    state = aba.state
    # Pinocchio differentiates about the world's origin, and loses accuracy if the base is distant.
    # So place the base at the world's origin. This is allowed, because A and B do not depend on the
    # position of the base, even in orbit.
    q = q.copy()
    q[:3] = 0.0
    if state.field:
        by_q, by_v, by_u = aba.slopes(q, v, u)
        (rates,) = state.velocities(aba.accelerations(q[None], v[None], u[None]))
        return Dynamics(rates, by_q, by_v, by_u)
    # Without an orbit, the dynamics do not depend on the linear velocity of the base, except for
    # the rotation of the base axes, in which the rate of this velocity is -omega x v.
    slow = v.copy()
    slow[PIN_LINEAR] = 0.0
    by_q, by_v, by_u = aba.slopes(q, slow, u)
    (rates,) = state.velocities(aba.accelerations(q[None], slow[None], u[None]))
    linear, angular = v[PIN_LINEAR], v[PIN_ANGULAR]
    rates[LINEAR] -= np.cross(angular, linear)
    by_v[:, LINEAR] = 0.0
    by_v[LINEAR, LINEAR] = -skew(angular)
    by_v[LINEAR, ANGULAR] += skew(linear)
    return Dynamics(rates, by_q, by_v, by_u)


class Route:
    """A and B by ABA's derivatives, with the scales and the rounding errors of their entries."""

    def __init__(self, robot: Robot, lin: LinearModel) -> None:
        self.state = state = StateMap(robot, reference=lin.reference, frame=lin.frame)
        self.aba = aba = Aba(state)
        self.q, self.v = robot.checked_configuration(lin.q), robot.checked_velocity(lin.v)
        self._own = ToolCoordinates(state, moving=lin.moving)
        self.nu = nu = state.velocities(self.v)
        chart = state.chart(self.q)
        self.u = u = aba.actuation.in_base_axes(chart, lin.u0)
        self.M = M = inertia_matrix(robot, lin)
        inverse = scaled_inverse(M)
        # The mobility of coordinate i is sqrt((M^-1)_ii): the speed that it gets from an energy of
        # 1/2 J if all other coordinates are free.
        self.mobility = np.sqrt(inverse.diagonal())
        self.units = np.concatenate((self.mobility, self.mobility))

        found = _dynamics(aba, self.q, self.v, u)
        self.inverse = aba.inverse
        rng = np.random.default_rng(0)
        others = [_dynamics(aba, *self._nudged(rng)) for _ in range(_SAMPLES)]
        self.at = self._own.jacobians(self.q, nu, u, found.rates)
        self.by_x, self.by_u, A, B = self._assemble(found)
        assembled = [self._assemble(other) for other in others]

        lower = B[-len(M) :]
        self.input_mobility = np.sqrt(np.einsum("ik,ij,jk->k", lower, M, lower))
        self.input_mobility[self.input_mobility == 0.0] = 1.0
        self.rates = state.to_frame(chart, found.rates[:, None])[:, 0]

        groups, inputs = state.groups._asdict(), aba.actuation.groups
        accelerations = {"omega_b": ANGULAR, "v_b": LINEAR, "qdot_m": slice(6, None)}
        sums_A, sums_B = self._sums(found)
        # The accelerations are sums of M^-1 times the generalised forces, and so are their
        # derivatives. The rates of the positions are sums of kinematic terms.
        size, nv = np.abs(inverse), len(M)
        terms_A = np.vstack((sums_A[:nv], size @ np.abs(M @ A[nv:])))
        terms_B = np.vstack((sums_B[:nv], size @ np.abs(M @ B[nv:])))
        self.A = Reference(
            A,
            scales(groups, groups, A, terms_A, self.units, self.units),
            sampled(groups, A, [x[2] for x in assembled], self.units) + _SUM_ULPS * _EPS * sums_A,
        )
        self.B = Reference(
            B,
            scales(groups, inputs, B, terms_B, self.units, 1.0 / self.input_mobility),
            sampled(groups, B, [x[3] for x in assembled], self.units) + _SUM_ULPS * _EPS * sums_B,
        )

        self.base_mobility = own_units = np.sqrt(_in_base(state, self.q, inverse).diagonal())
        self.rate_error = sampled(
            accelerations, found.rates[:, None], [x.rates[:, None] for x in others], own_units
        )[:, 0]
        # Of the derivatives of the accelerations in base axes, by the state and by the inputs.
        self.by_x_error = sampled(accelerations, self.by_x, [x[0] for x in assembled], own_units)
        self.by_u_error = sampled(accelerations, self.by_u, [x[1] for x in assembled], own_units)

    def _nudged(self, rng: np.random.Generator) -> tuple[Array, Array, Array]:
        state, model = self.state, self.state.robot.model
        scale = np.concatenate((np.ones(6), [joint.scale for joint in state.robot.joints]))
        step = _NUDGE * rng.choice((-1.0, 1.0), len(scale)) / scale
        q = pin.integrate(model, self.q, state.spread(step))
        v = state.spread(self.nu * (1.0 + _NUDGE * rng.choice((-1.0, 1.0), len(scale))))
        return q, v, self.u * (1.0 + _NUDGE * rng.choice((-1.0, 1.0), len(self.u)))

    def _assemble(self, found: Dynamics) -> tuple[Array, Array, Array, Array]:
        """Return the derivatives of the accelerations by the state and by the inputs, and A and B.

        The accelerations are in base axes.
        """
        at = self.at
        by_y = np.hstack((found.by_q, found.by_v)) + found.by_u @ at.H
        A, B = assembled(self._own, self.q, self.nu, self.u, found)
        return by_y @ at.left, found.by_u @ at.V, A, B

    def _sums(self, found: Dynamics) -> tuple[Array, Array]:
        """Return the magnitudes of the terms of A and B in the transformation to the frame."""
        nv, at = len(self.M), self.at
        A, B = np.zeros((2 * nv, 2 * nv)), np.zeros((2 * nv, len(self.u)))
        A[:nv, nv:] = np.eye(nv)
        A[ANGULAR, ANGULAR] = A[LINEAR, LINEAR] = _norm(self.nu[ANGULAR])
        A[LINEAR, ANGULAR] = _norm(self.nu[LINEAR])
        A[nv:], B[nv:] = np.hstack((np.abs(found.by_q), np.abs(found.by_v))), np.abs(found.by_u)
        P, left = _whole(at.P, nv), _whole(at.left, nv)
        A = (P @ (A + B @ np.abs(at.H)) + _whole(at.rate, nv)) @ left
        return A, P @ B @ np.abs(at.V)

    def rate_terms(self, faster: Array) -> Array:
        """Return magnitudes of the terms of f (nx,), if the velocities are increased by `faster`."""
        state, aba = self.state, self.aba
        v = self.v.copy()
        v[PIN_LINEAR] = 0.0
        v = state.spread(np.abs(state.velocities(v)) + faster)
        if state.field:
            v = state.field.absolute(self.q, v)
        low = aba.terms(self.q, v, self.u)
        low[LINEAR] += _norm(self.nu[ANGULAR]) * _norm(self.nu[LINEAR])
        turned = np.concatenate((np.abs(self.nu) + faster, low))
        return _whole(self.at.P, len(self.M)) @ turned


def _norm(x: Array) -> float:
    return float(np.linalg.norm(x))


def _whole(x: Array, nv: int) -> Array:
    """Return the magnitudes of a matrix, with the blocks (3, 3) of the base at their largest entry.

    The rounding error of an entry of a rotation matrix is relative to 1, not to the entry.
    """
    found = np.abs(x)
    starts = (0, 3, nv, nv + 3)
    for i in starts:
        for j in starts:
            found[i : i + 3, j : j + 3] = found[i : i + 3, j : j + 3].max()
    return found


class Outputs:
    """Independent computation of y0, C and D.

    The outputs are y = h(x, a(x, u)), where a is the acceleration. Finite differences of the
    kinematics h are combined with the ABA derivatives of a: C = dh/dx + dh/da da/dx and
    D = dh/da da/du. So the differences are as accurate for an ill-conditioned M as for any other.
    """

    def __init__(self, model: Nonlinear, route: Route, lin: LinearModel, steps: Array) -> None:
        self._route, self._lin = route, lin
        self._measuring = Measuring(route.state, lin.q)
        self._kinds, self._vectors = _parts(route.state)
        x, ones = lin.x0, np.ones(len(lin.y0))
        _, _, _, a = model.accelerations(np.concatenate((x, lin.u0))[None])
        self._a = a[0]

        by_x, by_x_rounding, here, sizes = self._kinematics(steps[: len(x)])
        by_a = self._by_acceleration()
        size = np.abs(by_a)
        C, D = by_x + by_a @ route.by_x, by_a @ route.by_u
        terms = np.abs(by_x) + size @ np.abs(route.by_x)
        nv = len(route.M)
        halves = {"positions": slice(nv), "velocities": slice(nv, 2 * nv)}
        scale = block_scales(self._vectors, halves, C, terms, ones, route.units)
        self.C = Reference(C, scale, by_x_rounding + size @ route.by_x_error)
        terms = size @ np.abs(route.by_u)
        inputs, units = route.aba.actuation.groups, 1.0 / route.input_mobility
        scale = block_scales(self._vectors, inputs, D, terms, ones, units)
        self.D = Reference(D, scale, size @ route.by_u_error)
        sizes += size @ np.abs(route.state.velocities(self._a))
        error = size @ route.rate_error
        column = {"y0": slice(1)}
        scale = block_scales(self._vectors, column, here, sizes[:, None], ones, np.ones(1))
        self.y0 = Reference(here, scale, error[:, None])

    def _kinematics(self, steps: Array) -> tuple[Array, Array, Array, Array]:
        """Return dh/dx and its rounding errors, h (ny, 1), and the magnitudes (ny,) of its terms.

        The acceleration is constant.
        """
        state, lin, x = self._route.state, self._lin, self._lin.x0
        is_curved = np.zeros(len(x), dtype=bool)
        is_curved[state.groups.q_b] = is_curved[state.groups.q_m] = True
        here = self._evaluate(x[None])[0]
        by_x = jacobian(self._evaluate, x, steps, is_curved)
        again = jacobian(self._evaluate, x, steps / _STEP_RATIO, is_curved)
        reach = _norm(lin.q[:3]) + _norm(lin.reference.translation)
        places = state.robot.model.jointPlacements.tolist()
        reach += sum(_norm(place.translation) for place in places)
        least = {"rad": 1.0, "1": 1.0, "m": reach}
        ny = len(lin.y0)
        sizes = np.abs(here) + np.abs(by_x) @ np.abs(x)
        sizes[:ny] += [least.get(unit, 0.0) for unit in lin.output_units]
        bodies = {k: np.arange(k, k + 3) for k in range(ny, len(here), 3)}
        vectors = {**self._vectors, **bodies}
        ones = np.ones(len(here))
        sizes = spread_over(vectors, sizes[:, None], ones)
        # A vector that does not depend on a variable has no rounding error in its column.
        depends = spread_over(vectors, np.abs(by_x) + np.abs(again), ones) > 0.0
        # The model may have rounding errors even there: those of the displacements of one unit.
        unit = np.zeros(len(x))
        unit[state.groups.q_b] = 2.0
        unit[state.groups.r_b] = 1.0 / max(reach, 1e-300)
        unit[state.groups.q_m] = [body.scale for body in state.robot.joints]
        rounding = _SUM_ULPS * _EPS * sizes * (depends / steps + unit)
        rounding += sampled(vectors, by_x, [again], ones)
        total = self._sums(here)
        value = (self._measuring(x, *self._at(), self._a))[:, None]
        return total @ by_x, np.abs(total) @ rounding, value, (np.abs(total) @ sizes)[:, 0]

    def _at(self) -> tuple[Array, Array]:
        return self._lin.q, self._route.v

    def _evaluate(self, x: Array) -> Array:
        """Return h for the rows of states x, followed by the parts that `_bodies` returns."""
        _, q, v = self._route.state.points(x)
        rows = []
        for point in zip(x, q, v, strict=True):
            y = self._measuring(*point, self._a)
            rows.append(np.concatenate((y, self._bodies())))
        return np.array(rows)

    def _bodies(self) -> Array:
        """Return the contributions of each body to the centre of mass and to the momentum.

        They are three vectors for each body, about the position of the base at the operating point.
        The differences of a light body, such as the body of a mode, are lost in the sum over the
        bodies. So each body is differentiated by itself.
        """
        if not {"com", "momentum"} & self._kinds.keys():
            return np.zeros(0)
        data, robot = self._measuring.data, self._route.state.robot
        mass, stored = robot.mass, np.zeros((robot.model.njoints, 3))
        for joint, momentum in robot.stored_momentum:
            stored[joint] += momentum
        rows = []
        for joint, body in enumerate(robot.model.inertias.tolist()):
            place = data.oMi[joint]
            near = pin.SE3(place.rotation, place.translation - self._lin.q[:3])
            momentum = near.act(body * data.v[joint])
            spin = momentum.angular + place.rotation @ stored[joint]
            rows += [body.mass / mass * (near * body.lever), momentum.linear, spin]
        return np.concatenate(rows)

    def _sums(self, here: Array) -> Array:
        """Return the matrix (ny, ..) that sums the contributions of the bodies in derivatives."""
        ny = len(self._lin.y0)
        total = np.eye(ny, len(here))
        if len(here) == ny:
            return total
        back = self._lin.reference.rotation.T
        count = (len(here) - ny) // 9
        center, P, _ = here[ny:].reshape(count, 3, 3).sum(axis=0)
        unit, none = np.eye(3), np.zeros((3, 3))
        maps = {
            "com": (unit, none, none),
            # h = sum of (c_b x p_b + I_b omega_b) - c x P
            "momentum": (skew(P), -skew(center), unit),
            "linear": (none, unit, none),
        }
        for word, name, part in (
            ("com", "com", slice(0, 3)),
            ("momentum", "momentum", slice(0, 3)),
            ("momentum", "linear", slice(3, 6)),
        ):
            if word in self._kinds:
                rows = self._kinds[word][part]
                total[rows] = 0.0
                total[rows, ny:] = back @ np.tile(np.hstack(maps[name]), count)
        return total

    def _by_acceleration(self) -> Array:
        """Return dh/da (ny, 6 + n); h is linear in the acceleration a."""
        route, state = self._route, self._route.state
        units = route.base_mobility
        by_a = np.zeros((len(self._lin.y0), len(units)))
        if not any(output.FEELS_ACCELERATION for output in state.robot.outputs):
            return by_a
        for k, unit in enumerate(units):
            step = state.spread(unit * np.eye(len(units))[k])
            ahead = self._measuring(self._lin.x0, *self._at(), self._a + step)
            behind = self._measuring(self._lin.x0, *self._at(), self._a - step)
            by_a[:, k] = (ahead - behind) / (2.0 * unit)
        return by_a

    def rows(self, lin: LinearModel) -> Iterator[Row]:
        """Compare y0, C and D of a model, output by output."""
        for name, reference, given in (
            ("y0", self.y0, lin.y0[:, None]),
            ("C", self.C, lin.C),
            ("D", self.D, lin.D),
        ):
            columns = np.arange(given.shape[1])
            for word, rows in self._kinds.items():
                where = np.ix_(rows, columns)
                block = f"{name} ({word})"
                yield reference.row("outputs", block, given, where, _ROUTE_TOLERANCE)


def _parts(state: StateMap) -> tuple[dict[str, list[int]], dict[int, Indices]]:
    """Return the rows of y by the name of the output, and the rows of each of its vectors."""
    kinds, vectors, at = dict[str, list[int]](), dict[int, Indices](), 0
    for output in state.robot.outputs:
        count = len(output.signals) or len(state_indices(state, output))
        kinds.setdefault(output.WORD, []).extend(range(at, at + count))
        size = 3 if output.VECTORS else 1
        for k in range(at, at + count, size):
            vectors[k] = np.arange(k, k + size)
        at += count
    return kinds, vectors


def certify(robot: Robot, lin: LinearModel) -> Certificate:
    """Return the certificate of a continuous-time model.

    The certificate contains the largest errors of A and of B, compared with ABA derivatives.
    """
    route, errors = Route(robot, lin), dict[str, float]()
    for name, given, reference in (("A", lin.A, route.A), ("B", lin.B, route.B)):
        errors[name] = _largest((given - reference.value) / reference.scale)
    return Certificate(
        condition=scaled_condition(lin.M),
        inertia_residual=inertia_residual(lin.M, inverse_inertia(route.state, lin)),
        route_A=errors["A"],
        route_B=errors["B"],
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


def _in_base(state: StateMap, q: Array, matrix: Array) -> Array:
    """Transform M or its inverse (6 + n, 6 + n) from the axes of the frame to base axes."""
    chart = state.chart(q)
    return state.to_base(chart, state.to_base(chart, matrix).T).T


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
    nu = state.velocities(v)
    u = aba.actuation.in_base_axes(state.chart(q), u)
    found = _dynamics(aba, q, v, u)
    A, B = assembled(ToolCoordinates(state, moving=moving), q, nu, u, found)
    return A, B, aba.inverse


def assembled(
    own: ToolCoordinates, q: Array, nu: Array, u: Array, found: Dynamics
) -> tuple[Array, Array]:
    """Assemble A and B from the derivatives of the accelerations; `nu` and `u` are in base axes."""
    state, nv = own.state, len(nu)
    there = own.jacobians(q, nu, u, found.rates)
    # Assemble A_y and B_y of (4.9). The upper half of A_y is the kinematics of a small displacement
    # in axes that rotate with the base.
    A, B = np.zeros((state.nx, state.nx)), np.zeros((state.nx, len(u)))
    A[ANGULAR, ANGULAR] = A[LINEAR, LINEAR] = -skew(nu[ANGULAR])
    A[LINEAR, ANGULAR] = -skew(nu[LINEAR])
    A[:nv, nv:] = np.eye(nv)
    A[nv:], B[nv:] = np.hstack((found.by_q, found.by_v)), found.by_u
    A = (there.P @ (A + B @ there.H) + there.rate) @ there.left
    return A, there.P @ B @ there.V


class Nonlinear:
    """Nonlinear model ``xdot = f(x, u)`` in the chart of a linear model, computed by ABA.

    If the linear model has a moving reference, x is the error relative to the reference. In this
    case, f is 0 at the operating point.
    """

    def __init__(self, aba: Aba, lin: LinearModel, state: StateMap | None = None) -> None:
        self._aba, self._lin = aba, lin
        self.state = state or aba.state
        # Without an orbit, ABA receives positions and velocities relative to an observer. The
        # observer is where the base is at the operating point, and moves with its velocity there.
        # Otherwise, rounding errors of a distant or fast base would hide everything else.
        self._observer, self._home = np.zeros((2, 3))
        if aba.field is None:
            self._observer = rotation_matrix(lin.q[3:7]) @ lin.v[PIN_LINEAR]
            self._home = lin.q[:3]
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
        near = q.copy()
        near[:, :3] -= self._home
        a = self._aba.accelerations(near, relative, self._aba.actuation.in_base_axes(chart, u))
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
        rounding = _ULPS * _EPS * np.abs(after).reshape(6, *x.shape).max(axis=0) / h
        if lin.moving:  # the first row is also the motion of the reference
            after = coordinates.moving_errors("local", after, np.repeat(after[::7], 7, axis=0))
        ahead, behind = after.reshape(2, 3, *x.shape)
        rates = np.tensordot(_WEIGHTS, ahead - behind, axes=1) / h
        size = np.maximum(1.0 + np.abs(v).max(axis=1), np.abs(expected).max(axis=1))
        scale = np.maximum(size[:, None], rounding / _DIFFERENCE_TOLERANCE)
        return _largest((expected - rates) / scale)


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
