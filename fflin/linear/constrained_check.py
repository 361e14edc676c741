"""Independent computations of linear models of robots with constraints, which `check` compares.

1. A and B in all coordinates from Pinocchio's constrained derivatives, reduced to the independent
   states by finite differences of configurations on the manifold.
2. Finite differences of the nonlinear motion on the manifold, in the independent states.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pinocchio as pin

from fflin.base.names import group_of
from fflin.base.validation import Array, Indices
from fflin.dynamics.closure import Closure
from fflin.dynamics.coordinates import ANGULAR, LINEAR
from fflin.dynamics.outputs import Measuring
from fflin.dynamics.state import StateMap
from fflin.linear.aba_route import Route, inertia_matrix
from fflin.linear.model import Certificate, LinearModel
from fflin.linear.nonlinear import TRUNCATION, Nonlinear, jacobian, jacobians
from fflin.linear.scales import (
    DIFFERENCE_TOLERANCE,
    EPS,
    ROUTE_TOLERANCE,
    ULPS,
    Reference,
    Row,
    sampled,
    scales,
    spread_over,
    worst,
)
from fflin.robot.robot import Robot

# Largest displacement of any coordinate in a finite difference: rad, or radii of gyration.
_STEP = 2e-3

# Newton's method on the manifold: number of steps, and step at which it ends.
_STEPS, _ARRIVED = 12, 1e-13

# Step of the differences from which the steps of the other differences follow.
_ROUGH = 1e-6

# Rounding error of the differences, relative to the largest entry of a row.
_ROUNDING = 1e-13

# Largest rounding error, relative to the largest entry of a row, that needs no remark.
_HIDDEN = 1e-2

# Largest residual [m, rad] of a closed operating point.
_CLOSED = 1e-9


class OnManifold:
    """Configurations and velocities on the manifold for given independent states."""

    def __init__(self, state: StateMap, lin: LinearModel) -> None:
        self.state = state
        self.q, self.v = lin.q, lin.v
        self._constraints = Closure(state).constraints
        self._nv = state.nx // 2
        count = len(lin.state_names) // 2
        names = lin.state_names[:count]
        self.picked = np.array([state.names.index(x) for x in names], dtype=np.intp)
        self.kept = np.concatenate((self.picked, self.picked + self._nv))
        self.x0 = state.read(lin.q, lin.v)
        model = state.robot.model
        M = state.project(pin.crba(model, state.robot.create_data(), lin.q).T)
        self._columns = 1.0 / np.sqrt(M.diagonal())

    @property
    def z0(self) -> Array:
        """Independent states (2 d,) at the operating point."""
        z0: Array = self.x0[self.kept]
        return z0

    def states(self, z: Array) -> Array:
        """Return all states (N, 12 + 2 n) for rows (N, 2 d) of independent states."""
        rows = [self._state(row) for row in z]
        return np.array(rows).reshape(len(z), self.state.nx)

    def residuals(self) -> tuple[float, float]:
        """Return the largest residuals of the constraints at q, and of their rates at v."""
        residual = self._constraints.residual(self.q)
        rate = self._constraints.jacobian(self.q) @ self.v
        return float(np.abs(residual).max()), float(np.abs(rate).max())

    def _state(self, z: Array) -> Array:
        state = self.state
        positions, rates = np.split(z, 2)
        q = self.q
        for _ in range(_STEPS):
            by_position, _ = self._frame(q)
            x = state.read(q, self.v, near=self.x0)
            missing = positions - x[self.picked]
            residual = self._constraints.residual(q)
            step = self._solved(q, by_position, np.concatenate((-residual, missing)))
            q = pin.integrate(state.robot.model, q, state.spread(step))
            if float(np.abs(step / self._columns).max()) < _ARRIVED:
                break
        _, by_rate = self._frame(q)
        still = np.zeros(self._constraints.count)
        nu = self._solved(q, by_rate, np.concatenate((still, rates)))
        x = state.read(q, state.spread(nu), near=self.x0)
        return x

    def _solved(self, q: Array, rows: Array, right: Array) -> Array:
        """Solve J x = first part, and rows of the independent coordinates = second part."""
        J = self.state.columns(self._constraints.jacobian(q))
        whole = np.vstack((J, rows[self.picked])) * self._columns
        solution: Array = self._columns * np.linalg.lstsq(whole, right, rcond=None)[0]
        return solution

    def _frame(self, q: Array) -> tuple[Array, Array]:
        """Return the derivatives of the positions, and of the rates with respect to nu."""
        chart = self.state.unchecked_chart(q)
        by_position, by_rate = np.eye(self._nv), np.eye(self._nv)
        by_position[ANGULAR, ANGULAR] = chart.N
        by_position[LINEAR, LINEAR] = chart.R
        for part in self.state.in_reference:
            by_rate[part, part] = chart.R
        return by_position, by_rate


class ConstrainedReferences:
    """Independent computations at the point of a model of a robot with constraints."""

    def __init__(self, robot: Robot, lin: LinearModel) -> None:
        self.route = Route(robot, lin)
        state = self.route.state
        self._lin = lin
        self._manifold = OnManifold(state, lin)
        self._kept = self._manifold.kept
        self._groups = groups_of(lin.state_names)
        inputs = self.route.aba.actuation.groups
        self._inputs = {key: np.array(x, dtype=np.intp) for key, x in inputs.items()}
        self._differentiated = False
        self._conditioning = self.route.aba.conditioning(lin.q, lin.v)
        self._nonlinear = Nonlinear(self.route.aba, replace(lin, x0=self._manifold.x0))
        self._measuring = Measuring(state, lin.q)
        self._units = self.route.units[self._kept]
        self._input_units = 1.0 / self.route.input_mobility
        self._differentiate_states()
        self._by_pinocchio()

    def _rates(self, point: Array) -> Array:
        """Return dz/dt and y (N, 2 d + ny) for rows (N, 2 d + nu) of z and u."""
        z, u = np.split(point, [len(self._kept)], axis=1)
        x = self._manifold.states(z)
        whole = np.hstack((x, u))
        motion = self._nonlinear.accelerations(whole)
        rates = self._nonlinear.rates_of(whole, motion)[:, self._kept]
        return np.hstack((rates, self._outputs(whole, *motion[1:])))

    def _outputs(self, point: Array, q: Array, v: Array, a: Array) -> Array:
        """Return the outputs (N, ny) for rows of all states and inputs, and their motion."""
        aba, nx = self.route.aba, self.route.state.nx
        rows = []
        for k, (x, u) in enumerate(zip(point[:, :nx], point[:, nx:], strict=True)):
            at = q[k], v[k]
            base = aba.actuation.in_base_axes(self.route.state.unchecked_chart(q[k]), u)
            forces = aba.constraint_forces(*at, base) if self._measures_forces else {}
            rows.append(self._measuring(x, *at, a[k], forces))
        return np.array(rows).reshape(len(point), len(self._lin.y0))

    @property
    def _measures_forces(self) -> bool:
        return any(x.WORD == "force" for x in self.route.state.robot.outputs)

    def _differentiate_states(self) -> None:
        """Differentiate all states on the manifold with respect to the independent states."""
        manifold = self._manifold
        d = len(self._kept) // 2
        z0 = manifold.z0
        self._curved = np.arange(2 * d) < d
        # A rough T gives the steps: no coordinate moves by more than _STEP.
        rough = jacobian(manifold.states, z0, np.full(2 * d, _ROUGH), self._curved)
        self._steps = self._chosen_steps(rough)
        self.T, again = jacobians(manifold.states, z0, self._steps, self._curved)
        apart = np.max([np.abs(x - self.T) for x in again], axis=0)
        self._T_error = TRUNCATION * apart

    def _by_motion(self) -> None:
        """Differentiate the nonlinear motion and the outputs on the manifold, once."""
        if self._differentiated:
            return
        self._differentiated = True
        lin, count = self._lin, len(self._kept)
        point = np.concatenate((self._manifold.z0, lin.u0))
        acceleration = np.abs(self.route.accelerations.rates / self.route.base_mobility)
        of_inputs = max(1.0, float(acceleration.max())) * self._input_units
        steps = np.concatenate((self._steps, of_inputs))
        is_curved = np.append(self._curved, np.zeros(len(lin.u0), dtype=bool))
        values = self._rates(point[None])[0]
        slopes, repetitions = jacobians(self._rates, point, steps, is_curved)
        rounding = ULPS * EPS * self._terms()[:, None] / steps
        rounding += sampled(
            self._groups, slopes[:count], [x[:count] for x in repetitions], self._units
        )
        rounding += _noise(slopes[:count], self._all_units, _ROUNDING)
        A, B = np.split(slopes[:count], [count], axis=1)
        self.f0 = values[:count]
        self._differences = (
            self._reference(A, rounding[:, :count], self._groups, self._units),
            self._reference(B, rounding[:, count:], self._inputs, self._input_units),
        )
        self._y0 = values[count:]
        size = np.abs(self._y0) + np.abs(slopes[count:]) @ np.abs(point) + 1.0
        by_y = slopes[count:]
        rows = {k: slice(k, k + 1) for k in range(len(by_y))}
        ones = np.ones(len(by_y))
        error = ULPS * EPS * size[:, None] / steps
        error += sampled(rows, by_y, [x[count:] for x in repetitions], ones)
        largest = np.abs(by_y).max(axis=0, initial=0.0)
        scale = np.broadcast_to(np.where(largest > 0.0, largest, 1.0), by_y.shape)
        columns = slice(count), slice(count, None)
        self._C, self._D = (
            Reference(by_y[:, part], scale[:, part], error[:, part]) for part in columns
        )

    @property
    def _all_units(self) -> Array:
        return np.concatenate((self._units, self._input_units))

    def _terms(self) -> Array:
        """Return the magnitudes (2 d,) of the terms of dz/dt."""
        terms: Array = self.route.rate_terms(np.zeros(len(self.route.M)))[self._kept]
        return terms

    def _point_rates(self) -> Reference:
        """Return dz/dt at the operating point.

        The constraints correct the accelerations by J^+ (J a + gamma). If J has a large condition,
        the correction multiplies rounding errors of all accelerations by it.
        """
        size = np.maximum(np.abs(self.f0), self._terms()) + self._units
        route = self.route
        terms = route.rate_terms(np.zeros(len(route.M))) / route.units
        largest = float(terms[len(route.M) :].max())
        error = ULPS * EPS * self._conditioning.condition * largest * self._units
        error[: len(self._kept) // 2] = 0.0
        return Reference(self.f0, size, error)

    def _chosen_steps(self, T: Array) -> Array:
        """Return the steps (2 d,) of the independent states."""
        state = self.route.state
        d = len(self._kept) // 2
        M = self.route.M
        radius = float(np.sqrt(np.mean(M.diagonal()[:3]) / state.robot.mass))
        size = np.array(
            [1.0] * 3
            + [radius] * 3
            + [
                1.0 / joint.scale if joint.unit != "m" else radius
                for joint in state.robot.joints
            ]
        )
        moved = np.abs(T[: len(M), :d]) / size[:, None]
        steps = np.empty(2 * d)
        steps[:d] = _STEP / moved.max(axis=0, initial=1e-12)
        # The rates enter at most squared, so large steps have no truncation error.
        speed = max(1.0, float(np.abs(self.route.nu / size).max()))
        faster = np.abs(T[len(M) :, d:]) / size[:, None]
        steps[d:] = 0.1 * speed / faster.max(axis=0, initial=1e-12)
        return steps

    def _reference(
        self, value: Array, rounding: Array, columns: dict[str, Indices], units: Array
    ) -> Reference:
        size = spread_over(self._groups, value, self._units)
        return Reference(
            value, scales(self._groups, columns, size, self._units, units), rounding
        )

    def _by_pinocchio(self) -> None:
        route, kept, T = self.route, self._kept, self.T
        size = np.abs(T)
        A, B = route.A, route.B
        rounding = A.rounding[kept] @ size + np.abs(A.value[kept]) @ self._T_error
        value = A.value[kept] @ T
        # The error of Pinocchio's solver is relative to the terms of the accelerations.
        scale = A.scale[kept] @ size
        terms = np.hstack((scale, B.scale[kept]))
        noise = _noise(terms, self._all_units, self._conditioning.error)
        of_A, of_B = np.split(noise, [len(kept)], axis=1)
        self.A = Reference(value, scale, rounding + of_A)
        self.B = Reference(B.value[kept], B.scale[kept], B.rounding[kept] + of_B)

    def remarks(self, lin: LinearModel) -> Iterator[str]:
        """State which errors of A the comparisons cannot detect, if these are not small."""
        hidden = self._undetected(lin)
        if hidden > _HIDDEN:
            yield (
                f"near a singular posture (condition of the constraints "
                f"{self._conditioning.condition:.1e}), errors of A below {hidden:.1g} times the "
                "largest entry of their row are not detected, because the comparisons have "
                "rounding errors of this size"
            )

    def _undetected(self, lin: LinearModel) -> float:
        """Return the largest rounding error of A, relative to the largest entry of the row.

        Each entry counts with the more accurate of the comparisons.
        """
        references = [self._differences[0]]
        if self._has_pinocchio:
            references.append(self.A)
        rounding = np.min([x.rounding for x in references], axis=0) * self._units
        largest = np.abs(lin.A * self._units).max(axis=1, initial=0.0)
        moved = largest > 0.0
        ratios = rounding[moved] / largest[moved, None]
        return float(ratios.max(initial=0.0))

    @property
    def _has_pinocchio(self) -> bool:
        # Pinocchio's constrained dynamics have no mimic joints.
        return not self.route.state.robot.followers

    def certificate(self, lin: LinearModel) -> Certificate:
        """Return the certificate of a model: its errors, and properties of its inertia."""
        if not self._has_pinocchio:
            self._by_motion()
        A, B = (self.A, self.B) if self._has_pinocchio else self._differences
        scale = 1.0 / np.sqrt(lin.M.diagonal())
        scaled = scale[:, None] * lin.M * scale
        residual = scaled @ np.linalg.inv(scaled) - np.eye(len(scaled))
        return Certificate(
            condition=float(np.linalg.cond(scaled)) if len(scaled) else 1.0,
            inertia_residual=float(np.abs(residual).max(initial=0.0)),
            route_A=float(A.errors(lin.A, ROUTE_TOLERANCE).max(initial=0.0)),
            route_B=float(B.errors(lin.B, ROUTE_TOLERANCE).max(initial=0.0)),
            f0=float(np.abs(lin.f0).max(initial=0.0)),
        )

    def rows(self, lin: LinearModel) -> Iterator[Row]:
        """Compare a model that has this operating point."""
        self._by_motion()
        if self._has_pinocchio:
            yield from self._blocks(
                "constrained derivatives", lin, self.A, self.B, DIFFERENCE_TOLERANCE
            )
        yield from self._blocks(
            "differences", lin, *self._differences, DIFFERENCE_TOLERANCE
        )
        least = DIFFERENCE_TOLERANCE
        y0 = np.abs(lin.y0 - self._y0) / np.maximum(1.0, np.abs(self._y0))
        yield worst("outputs", "y0", y0, least)
        yield worst("outputs", "C", self._C.errors(lin.C, least), least)
        yield worst("outputs", "D", self._D.errors(lin.D, least), least)
        yield Row("flow", "f", self._nonlinear.flow_error(), least)
        z0 = self._manifold.z0
        apart = np.abs(lin.x0 - z0) / np.maximum(1.0, np.abs(z0))
        yield worst("point", "x0", apart, ROUTE_TOLERANCE)
        f0 = self._point_rates().errors(lin.f0, ROUTE_TOLERANCE)
        yield worst("point", "f0", f0, ROUTE_TOLERANCE)
        residual, rate = self._manifold.residuals()
        yield Row("point", "constraints", residual, _CLOSED)
        speed = 1.0 + float(np.abs(lin.v).max())
        yield Row("point", "rates of constraints", rate / speed, _CLOSED)
        nv = len(self.route.M)
        rates = self.T[nv:, len(self._kept) // 2 :]
        M = rates.T @ inertia_matrix(self.route.state.robot, lin) @ rates
        root = np.sqrt(M.diagonal())
        yield worst(
            "inertia", "M", np.abs(lin.M - M) / np.outer(root, root), ROUTE_TOLERANCE
        )

    def _blocks(
        self, test: str, lin: LinearModel, A: Reference, B: Reference, least: float
    ) -> Iterator[Row]:
        of_A, of_B = A.errors(lin.A, least), B.errors(lin.B, least)
        for row, rows in self._groups.items():
            for column, columns in self._groups.items():
                block = of_A[np.ix_(rows, columns)]
                yield worst(test, f"A[{row}, {column}]", block, least)
            for column, indices in self._inputs.items():
                block = of_B[np.ix_(rows, indices)]
                yield worst(test, f"B[{row}, {column}]", block, least)


def _noise(x: Array, column_units: Array, fraction: float) -> Array:
    """Return rounding errors that are a fraction of the largest entry of each row of x.

    Entries of a row are compared in units (k,) of the columns.
    """
    largest = np.abs(x * column_units).max(axis=1, initial=0.0)
    return fraction * np.outer(largest, 1.0 / column_units)


def groups_of(names: tuple[str, ...]) -> dict[str, Indices]:
    """Return the indices of the states of each group, such as q_m, in the order of the states."""
    indices = dict[str, list[int]]()
    for index, name in enumerate(names):
        indices.setdefault(group_of(name), []).append(index)
    return {group: np.array(x, dtype=np.intp) for group, x in indices.items()}
