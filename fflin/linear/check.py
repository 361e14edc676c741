"""Check of linear models by ABA derivatives and by finite differences of the nonlinear model."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from fflin.base import html
from fflin.base.errors import InputError
from fflin.base.tables import folded, grid
from fflin.base.validation import Array, instance, share
from fflin.dynamics.constraints import Constraints
from fflin.dynamics.coordinates import ANGULAR, LINEAR
from fflin.dynamics.state import StateMap
from fflin.linear.aba_route import (
    Route,
    inertia_matrix,
    inertia_residual,
    inverse_inertia,
    scaled_condition,
)
from fflin.linear.constrained_check import ConstrainedReferences
from fflin.linear.fit import require_fit
from fflin.linear.model import Certificate, LinearModel, refuse_delayed, refuse_sampled
from fflin.linear.nonlinear import Nonlinear, jacobians
from fflin.linear.output_reference import OutputReference
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
from fflin.robot.outputs import FullState
from fflin.robot.robot import Robot

# The tolerance for M M^-1 = I is larger if this factor times the condition number of the scaled M
# exceeds the tolerance.
_ROUTE_ROUNDING = 1e2 * EPS

# Upper bound of this tolerance. A larger tolerance would confirm fewer than two digits.
_LOOSEST = 1e-2


@dataclass(frozen=True, repr=False)
class Check(html.Reported):
    """Result of `check`: the errors of a linear model; ``print`` shows a table.

    Attributes
    ----------
    rows : tuple of Row
        One row per comparison of a block of A, B, C or D, with its error and tolerance.
    title : str
        Description of the checked model.
    robot : str
        Name of the robot.
    remarks : tuple of str
        Limits of the comparisons, such as rounding errors near a singular posture of constraints.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> lin = fflin.linearize(robot)
    >>> [row.block for row in fflin.check(robot, lin).rows][:3]
    ['A[q_b, q_b]', 'A[q_b, r_b]', 'A[q_b, q_m]']
    """

    rows: tuple[Row, ...]
    title: str
    robot: str
    remarks: tuple[str, ...] = ()

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

    @property
    def _verified(self) -> str:
        # Unless the output is the state, C and D are also compared with independent computations.
        outputs = any(row.block.startswith("C (") for row in self.rows)
        return "A, B, C and D" if outputs else "A and B"

    def _failed(self, block: str) -> str:
        """Return the name of a block, with the comparisons of A or B that failed."""
        tests = [row.test for row in self.failures if row.block == block]
        if tests == ["outputs"]:
            return block
        return f"{block} ({', '.join(tests)})"

    def __str__(self) -> str:
        """Show whether the model is verified, and the largest error of each kind of comparison."""
        texts = self._verdict(), self._counted_title(), *self.remarks
        lines = [folded([text]) for text in texts]
        return "\n\n".join((*lines, grid(self._table(), "lrrlr")))

    def _html_parts(self) -> list[str]:
        every = [["compared with", "block", "error", "allowed"]]
        for row in self.rows:
            figures = f"{row.error:.1e}", f"{row.tolerance:.1e}"
            every.append([row.test, row.block, *figures])
        return [
            html.verdict(self._verdict(), self.ok),
            html.paragraph(self._counted_title(), "note"),
            *(html.paragraph(remark, "note") for remark in self.remarks),
            html.table(self._table(), "lrrlr"),
            html.folded("all comparisons", html.table(every, "ll")),
        ]

    def _counted_title(self) -> str:
        return f"{self.title}, {len(self.rows)} comparisons"

    def _verdict(self) -> str:
        """Return one line that states whether the model is verified."""
        if failures := self.failures:
            blocks = list(dict.fromkeys(row.block for row in failures))
            names = [self._failed(block) for block in blocks[:6]]
            if len(blocks) > 6:
                names.append("...")
            verb = "is" if len(blocks) == 1 else "are"
            count = f"{len(failures)} of {len(self.rows)} comparisons FAILED"
            return f"{', '.join(names)} {verb} not verified: {count}"
        largest = max(self.rows, key=lambda row: row.error)
        error_text = f"{largest.error:.1e} (allowed {largest.tolerance:.1e})"
        matrices = f"{self._verified} of {self.robot}"
        return f"{matrices}: verified, largest error {error_text}"

    def _table(self) -> list[list[str]]:
        """Return a table with the largest error of each kind of comparison."""
        table = [["compared with", "comparisons", "largest error", "of", "allowed"]]
        for test in dict.fromkeys(row.test for row in self.rows):
            rows = [row for row in self.rows if row.test == test]
            worst = max(rows, key=lambda row: (not row.ok, row.error))
            figures = f"{worst.error:.1e}", worst.block, f"{worst.tolerance:.1e}"
            table.append([test, str(len(rows)), *figures])
        return table


def check(robot: Robot, lin: LinearModel, *, tolerance: float | None = None) -> Check:
    r"""Check a linear model by two independent computations.

    A and B are compared block by block with

    - Pinocchio's ABA derivatives, mapped into the attitude chart of the model (relative tolerance
      1e-9);
    - sixth-order central differences of the nonlinear model :math:`\dot x = f(x, u)` in the same
      chart (relative tolerance 1e-8). The function f is itself verified against integrated motions.

    C and D are compared with finite differences of the outputs, combined with the ABA derivatives
    (relative tolerance 1e-9).

    The error of an entry is relative to its scale (4.10): the largest entry of its column in the
    block, or the terms that cancel in the entry. The scale does not depend on units. If M is
    ill-conditioned, the scale is larger, because it includes the rounding errors of the independent
    computations.

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
    refuse_delayed(lin, "check")
    return check_all(robot, [lin], tolerance=tolerance)


def check_all(
    robot: Robot,
    models: Iterable[LinearModel],
    title: str = "",
    *,
    tolerance: float | None = None,
) -> Check:
    """Check models; for each comparison, keep only the row with the largest error / tolerance."""
    if tolerance is not None:
        tolerance = share("tolerance", tolerance)
    largest: dict[tuple[str, str], Row] = {}
    remarks: list[str] = []
    for lin in models:
        for comparison in _comparisons(robot, lin, remarks):
            row = comparison
            if tolerance is not None:
                row = comparison._replace(tolerance=tolerance)
            before = largest.setdefault((row.test, row.block), row)
            if not row.error * before.tolerance <= before.error * row.tolerance:
                largest[row.test, row.block] = row
        if not title:
            condition = scaled_condition(inertia_matrix(robot, lin))
            title = f"{robot.name}, frame {lin.frame}, scaled cond(M) {condition:.1e}"
    if tolerance is not None:
        title += f", each error at most {tolerance:.1e}"
    # Of models along a motion, the first one with a remark counts.
    return Check(tuple(largest.values()), title, robot.name, tuple(remarks[:1]))


def _comparisons(robot: Robot, lin: LinearModel, remarks: list[str]) -> Iterator[Row]:
    """Yield the row of each comparison of a model with independent computations.

    Append what the comparisons cannot detect to `remarks`.
    """
    state = StateMap(robot, reference=lin.reference, frame=lin.frame, t=lin.time)
    if robot.constraints:
        require_fit(lin, robot, state, sensed=True)
        Constraints(robot).settle(lin.q)
        _require_independent(robot, lin)
        references = ConstrainedReferences(robot, lin)
        yield from references.rows(lin)
        remarks += references.remarks(lin)
        return
    require_fit(lin, robot, state, whole=True, sensed=True)
    yield from References(robot, lin).rows(lin)


def _require_independent(robot: Robot, lin: LinearModel) -> None:
    """Raise `InputError` if a model does not have as many states as the robot's motions."""
    expected = StateMap(robot).nx - 2 * lin.rank
    if len(lin.state_names) != expected:
        raise InputError(
            f"the model has {len(lin.state_names)} states and constraints of rank {lin.rank}, but "
            f"'{robot.name}' then has {expected} states; make the model with fflin.linearize"
        )


class References:
    """Independent computations of everything that `check` compares, at the point of a model.

    They use the operating point of the model, but none of its matrices.
    """

    def __init__(self, robot: Robot, lin: LinearModel) -> None:
        self.route = Route(robot, lin)
        self._model = Nonlinear(self.route.aba, lin)
        self._point = np.concatenate((lin.x0, lin.u0))
        self._x0 = self.route.state.read(self.route.q, self.route.v, near=lin.x0)
        self._f0 = self._rates()
        self._flow_error = self._model.flow_error()
        self._differences = self._by_differences(lin)
        self._outputs: OutputReference | None = None
        if robot.outputs != (FullState(),):
            # Large steps are accurate, because the kinematics consist of sines and cosines.
            steps = self._steps(lin, joints=0.03, modes=0.1)
            state_steps = steps[: len(lin.x0)]
            self._outputs = OutputReference(self._model, self.route, lin, state_steps)

    def matrices(self) -> dict[str, Reference]:
        """Return A and B by ABA, and C and D if the output is not the state."""
        references = {"A": self.route.A, "B": self.route.B}
        if self._outputs is not None:
            references |= {"C": self._outputs.C, "D": self._outputs.D}
        return references

    def rows(self, lin: LinearModel) -> Iterator[Row]:
        """Compare a model that has this operating point."""
        route = self.route
        least = ROUTE_TOLERANCE
        yield from self._blocks("ABA derivatives", lin, route.A, route.B, least)
        yield from self._blocks(
            "differences", lin, *self._differences, DIFFERENCE_TOLERANCE
        )
        if self._outputs is None:
            of_C = _largest(lin.C - np.eye(len(lin.x0)))
            yield Row("outputs", "y0", _largest(lin.y0 - lin.x0), least)
            yield Row("outputs", "C", of_C, least)
            yield Row("outputs", "D", _largest(lin.D), least)
        else:
            yield from self._outputs.rows(lin)
        yield Row("flow", "f", self._flow_error, DIFFERENCE_TOLERANCE)
        apart = (lin.x0 - self._x0) / np.maximum(1.0, np.abs(self._x0))
        yield Row("point", "x0", _largest(apart), least)
        errors = self._f0.errors(lin.f0[:, None], least)
        for name, rows in route.state.groups._asdict().items():
            yield worst("point", f"f0[{name}]", errors[rows], least)
        yield from self._inertia(lin)

    def _blocks(
        self, test: str, lin: LinearModel, A: Reference, B: Reference, least: float
    ) -> Iterator[Row]:
        groups = self.route.state.groups._asdict()
        inputs = self.route.aba.actuation.groups
        of_A, of_B = A.errors(lin.A, least), B.errors(lin.B, least)
        for row, rows in groups.items():
            for column, columns in groups.items():
                yield worst(test, f"A[{row}, {column}]", of_A[rows, columns], least)
            for column, indices in inputs.items():
                yield worst(test, f"B[{row}, {column}]", of_B[rows, indices], least)

    def _inertia(self, lin: LinearModel) -> Iterator[Row]:
        route, M = self.route, self.route.M
        # If the inputs are the default ones, the lower half of B is M^-1.
        inverse = lin.B[-len(M) :]
        if not route.aba.actuation.default:
            inverse = inverse_inertia(route.state, lin)
        scale = 1.0 / np.sqrt(np.abs(inverse.diagonal()))
        scaled = scale[:, None] * inverse * scale
        least = float(np.linalg.eigvalsh((scaled + scaled.T) / 2.0)[0])
        root = np.sqrt(M.diagonal())
        allowed = min(
            max(ROUTE_TOLERANCE, _ROUTE_ROUNDING * scaled_condition(M)), _LOOSEST
        )
        yield worst(
            "inertia", "M", np.abs(lin.M - M) / np.outer(root, root), ROUTE_TOLERANCE
        )
        yield Row("inertia", "M M^-1 = I", inertia_residual(M, inverse), allowed)
        yield Row("inertia", "M^-1 symmetric", _largest(scaled - scaled.T), 1e-12)
        yield Row("inertia", "M^-1 positive", max(0.0, -least), 1e-12)

    def _steps(self, lin: LinearModel, joints: float, modes: float) -> Array:
        """Return the steps (nx + nu,) of finite differences.

        `joints` and `modes` are the displacements [rad or m] of joints and of the bodies that model
        modes.
        """
        route, g = self.route, self.route.state.groups
        nx = route.state.nx
        nu = len(lin.u0)
        # `per_unit` is the change of q_m per rad or m of displacement: 1 / `scale`. For a modal
        # amplitude, `scale` can be almost zero, and 1 / `scale` would then be too large a step. But
        # such a body translates by at least 1 / sqrt(robot's mass) [m] per unit of the amplitude,
        # because the modal mass is 1. So sqrt(robot's mass) bounds the step.
        robot = route.state.robot
        per_unit = np.array([1.0 / joint.scale for joint in robot.joints])
        is_mode = np.array([joint.mode for joint in robot.joints], dtype=bool)
        per_unit[is_mode] = np.minimum(per_unit[is_mode], math.sqrt(robot.mass))
        steps = np.zeros(nx + nu)
        steps[g.q_m] = np.where(is_mode, modes, joints) * per_unit
        # Keep the points of the differences well inside the chart, because f is steep near the
        # limit |q_b| = 1 of the chart.
        steps[g.q_b] = 5e-3 * (1.0 - np.linalg.norm(lin.x0[g.q_b]))
        # f and the outputs are at most quadratic in the position of the base and in the velocities,
        # and linear in the inputs. So central differences have no truncation error, even with large
        # steps.
        steps[g.r_b] = 0.1
        speed = np.abs(route.nu)
        fastest = max(1.0, _largest(speed[ANGULAR]), _largest(speed[6:] / per_unit))
        steps[g.omega_b] = 0.1 * fastest
        steps[g.qdot_m] = 0.1 * fastest * per_unit
        steps[g.v_b] = 0.1 * max(1.0, _largest(speed[LINEAR]))
        # The inputs change the accelerations by about their size at the operating point.
        acceleration = _largest(route.accelerations.rates / route.base_mobility)
        steps[nx:] = max(1.0, acceleration) / route.input_mobility
        return steps

    def _by_differences(self, lin: LinearModel) -> tuple[Reference, Reference]:
        """Return A and B by finite differences of the nonlinear model."""
        route, model = self.route, self._model
        nx = route.state.nx
        nv = len(route.M)
        g = route.state.groups
        # The steps of the joint positions must be small. If light links are aligned, even a small
        # rotation of a joint strongly changes the accelerations. Only the attitude and the joint
        # positions need sixth-order differences.
        steps = self._steps(lin, joints=2e-4, modes=1e-2)
        is_curved = np.zeros(len(steps), dtype=bool)
        is_curved[g.q_b] = is_curved[g.q_m] = True
        jacobian, repetitions = jacobians(model.rates, self._point, steps, is_curved)
        # The rounding error of a difference is the rounding error of f, divided by the step. The
        # rounding error of f contains the rounding error of x.
        of_x = np.abs(jacobian) @ np.abs(self._point)
        of_f = of_x + route.rate_terms(np.zeros(nv))
        of_f_with_velocity_steps = of_x + route.rate_terms(steps[nv:nx])
        size = np.tile(of_f[:, None], len(steps))
        size[:, nv:nx] = of_f_with_velocity_steps[:, None]
        size = size / steps + np.hstack((route.sums_A, route.sums_B))
        rounding = ULPS * EPS * size
        rounding += sampled(g._asdict(), jacobian, repetitions, route.units)
        # Differences may be exactly zero where M^-1, and so the model, has rounding errors.
        rounding = np.maximum(rounding, np.hstack((route.A.rounding, route.B.rounding)))
        return (
            Reference(jacobian[:, :nx], route.A.scale, rounding[:, :nx]),
            Reference(jacobian[:, nx:], route.B.scale, rounding[:, nx:]),
        )

    def _rates(self) -> Reference:
        """Return f0 (nx, 1) as computed by the nonlinear model."""
        route = self.route
        f0 = self._model.rates(self._point[None])[0][:, None]
        terms = route.rate_terms(np.zeros(len(route.M)))[:, None]
        units = route.units
        columns = {"f0": slice(1)}
        groups = route.state.groups._asdict()
        size = np.maximum(spread_over(groups, f0, units), terms)
        scale = scales(groups, columns, size, units, np.ones(1))
        nv = len(route.M)
        error = route.frame_size @ np.append(np.zeros(nv), route.rates_error)
        return Reference(f0, scale, error[:, None])


def certify(robot: Robot, lin: LinearModel) -> Certificate:
    """Return the certificate of a continuous-time model.

    The certificate contains the largest errors of A and of B, compared with ABA derivatives.
    """
    if robot.constraints:
        return ConstrainedReferences(robot, lin).certificate(lin)
    route = Route(robot, lin)
    return Certificate(
        condition=scaled_condition(lin.M),
        inertia_residual=inertia_residual(lin.M, inverse_inertia(route.state, lin)),
        route_A=_largest(route.A.errors(lin.A, ROUTE_TOLERANCE)),
        route_B=_largest(route.B.errors(lin.B, ROUTE_TOLERANCE)),
        f0=float(np.abs(lin.f0).max()),
    )


def _largest(x: Array) -> float:
    return float(np.abs(x).max(initial=0.0))
