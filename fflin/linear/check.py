"""Check of A and B by ABA derivatives and by differences of the nonlinear model."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from fflin.base.errors import InputError
from fflin.base.tables import folded, grid
from fflin.base.validation import Array, instance, share
from fflin.dynamics.aba import Aba
from fflin.dynamics.outputs import Measuring
from fflin.dynamics.state import StateMap
from fflin.linear.fit import require_same, sensed
from fflin.linear.model import LinearModel
from fflin.linear.verification import (
    ErrorDynamics,
    Nonlinear,
    aba_route,
    compare,
    difference_steps,
    flow_error,
    inertia_matrix,
    inertia_residual,
    inverse_inertia,
    jacobian,
    mobilities,
    scaled_condition,
    speeds,
)
from fflin.robot.outputs import FullState
from fflin.robot.robot import Robot


class Row(NamedTuple):
    """One error of a check, with its tolerance."""

    test: str
    block: str
    error: float
    tolerance: float

    @property
    def ok(self) -> bool:
        """Whether the error is at most the tolerance; False if the error is NaN."""
        return self.error <= self.tolerance


_EPS = float(np.finfo(float).eps)
# Rounding error [ulp] of a finite difference of outputs: its weights add two ulp, and the outputs
# the rest.
_ULPS = 8.0

# Rounding error [ulp] of the accelerations in a finite difference.
_STEP_ULPS = 64.0

# Tolerances for the analytic computation, relative to the largest entry of a block. The first is
# the least tolerance, for a well-conditioned M. The second is multiplied by the condition number
# of M, and allows for a long chain of operations.
_ROUTE_TOLERANCE, _ROUTE_ROUNDING = 1e-9, 1e2 * _EPS
# Tolerances for sixth-order finite differences. Their step size costs about four more digits.
_DIFFERENCE_TOLERANCE, _DIFFERENCE_ROUNDING = 1e-8, 1e4 * _EPS

# Assumed ratio of the error of ABA's derivatives to the residual of ABA's M^-1.
_ROUTE_SAFETY = 10.0

# Largest tolerance, even for an ill-conditioned M. With a larger one, the check would confirm
# fewer than two digits.
_LOOSEST = 1e-2


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
        """Return a text with the verdict, and with the largest error of each kind of comparison."""
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
    if lin.dt:
        raise InputError(
            f"the model is sampled at dt = {lin.dt:g} s; check the continuous-time model instead"
        )
    return held_to(tolerance, _checked(Aba(StateMap(robot, frame=lin.frame)), lin))


def held_to(tolerance: float | None, found: Check) -> Check:
    """Replace the tolerance of every error in a check by the given one; None changes nothing."""
    if tolerance is None:
        return found
    rows = tuple(row._replace(tolerance=share("tolerance", tolerance)) for row in found.rows)
    return Check(rows, f"{found.title}, each error at most {tolerance:.1e}")


def _checked(aba: Aba, lin: LinearModel) -> Check:
    robot, state, actuation = aba.state.robot, aba.state.about(lin.reference), aba.actuation
    made = f"the model was made for '{lin.robot}'"
    states, inputs = (lin.state_names, lin.state_units), (lin.input_names, lin.input_units)
    require_same(made, robot, "state", states, (state.names, state.units))
    require_same(made, robot, "input", inputs, (actuation.names, actuation.units))
    q, v = robot.checked_configuration(lin.q), robot.checked_velocity(lin.v)
    M = inertia_matrix(robot, lin, state)
    condition = scaled_condition(M)
    route = min(max(_ROUTE_TOLERANCE, _ROUTE_ROUNDING * condition), _LOOSEST)
    difference = min(max(_DIFFERENCE_TOLERANCE, _DIFFERENCE_ROUNDING * condition), _LOOSEST)
    model = (ErrorDynamics if lin.moving else Nonlinear)(state, lin, aba)
    A, B, inverse = aba_route(state, aba, q, v, lin.u0, moving=lin.moving)
    chart = state.chart(q)
    base_M = state.to_base(chart, state.to_base(chart, M).T).T
    # If links are far apart, ABA loses digits that M retains. ABA's derivatives are as inaccurate
    # as its M^-1, and the error of M^-1 is the residual of M M^-1 = I.
    own_error = inertia_residual(base_M, inverse)
    by_aba = min(max(route, _ROUTE_SAFETY * own_error), _LOOSEST)
    rows = [
        Row("ABA derivatives", *block, by_aba) for block in compare(state, actuation, lin, M, A, B)
    ]
    (steps, input_steps), nx = difference_steps(state, lin, M), state.nx
    # Only over the attitude and the joint positions does f have terms beyond second order.
    bends = np.zeros(nx + len(input_steps), dtype=bool)
    bends[state.groups.q_b] = bends[state.groups.q_m] = True
    point, every = np.concatenate((lin.x0, lin.u0)), np.concatenate((steps, input_steps))
    derivatives = jacobian(
        lambda rows: model.rates(rows[:, :nx], rows[:, nx:]), point, every, bends
    )
    A, B, rounding = derivatives[:, :nx], derivatives[:, nx:], _STEP_ULPS * _EPS / difference
    rows += [
        Row("differences", *block, difference)
        for block in compare(state, actuation, lin, M, A, B, steps=steps, rounding=rounding)
    ]
    rows += _output_rows(model, lin, (steps, input_steps), difference)
    rows.append(Row("flow", "f", flow_error(model, lin), difference))
    rows += [Row("point", name, error, route) for name, error in _point_errors(model, lin, M, q, v)]
    rows.append(Row("inertia", "M", _relative(lin.M, M, floor=0.0), route))
    # With the default inputs, M^-1 is the lower half of B.
    inverse = lin.B[-len(M) :] if actuation.default else inverse_inertia(state, lin)
    rows.append(Row("inertia", "M M^-1 = I", inertia_residual(M, inverse), route))
    scale = 1.0 / np.sqrt(np.abs(inverse.diagonal()))
    scaled = scale[:, None] * inverse * scale
    asymmetry = float(np.abs(scaled - scaled.T).max())
    least = float(np.linalg.eigvalsh((scaled + scaled.T) / 2.0)[0])
    rows.append(Row("inertia", "M^-1 symmetric", asymmetry, 1e-12))
    rows.append(Row("inertia", "M^-1 positive", max(0.0, -least), 1e-12))
    return Check(tuple(rows), f"{robot.name}, frame {lin.frame}, scaled cond(M) {condition:.1e}")


def check_all(robot: Robot, models: Iterable[LinearModel], title: str) -> Check:
    """Check many models; return the largest ratio of error to tolerance in each row of errors."""
    worst: dict[tuple[str, str], Row] = {}
    aba: Aba | None = None
    for lin in models:
        aba = aba or Aba(StateMap(robot, frame=lin.frame))
        for row in _checked(aba, lin).rows:
            before = worst.setdefault((row.test, row.block), row)
            if not row.error * before.tolerance <= before.error * row.tolerance:
                worst[row.test, row.block] = row
    return Check(tuple(worst.values()), title)


def _point_errors(
    model: Nonlinear, lin: LinearModel, M: Array, q: Array, v: Array
) -> list[tuple[str, float]]:
    """Return the errors of x0 and of each state group of f0.

    Errors of f0 are relative to the largest terms that may cancel within a state group.
    """
    state = model.state
    mobility, input_mobility = mobilities(M, lin.B)
    rate = model(lin.x0, lin.u0)
    # In orbit, the terms that cancel contain the inertial velocity.
    field = state.field
    _, rate_of_turn, momentum = speeds(state, field.absolute(q, v) if field else v)
    push = float((np.abs(lin.u0) * input_mobility).max(initial=0.0))
    push += rate_of_turn**2 * float((1.0 / mobility).max())
    push += rate_of_turn * momentum * float(mobility.max())
    natural = np.concatenate((np.ones(len(M)), mobility * push))
    errors = [("x0", _relative(lin.x0, state.to_state(q, v, near=lin.x0)))]
    for name, rows in state.groups._asdict().items():
        floor = float(natural[rows].max(initial=0.0)) or float(np.abs(rate[rows]).max(initial=1.0))
        errors.append((f"f0[{name}]", _relative(lin.f0[rows], rate[rows], floor=floor or 1.0)))
    return errors


def _output_rows(
    model: Nonlinear, lin: LinearModel, steps: tuple[Array, Array], tolerance: float
) -> list[Row]:
    """Compare C, D and y0 with differences of the nonlinear outputs; return the rows."""
    state = model.state
    outputs = (lin.output_names, lin.output_units)
    require_same(
        f"the model was made for '{lin.robot}'", state.robot, "output", outputs, sensed(state)
    )
    if state.robot.outputs == (FullState(),):
        errors = (lin.y0 - lin.x0, lin.C - np.eye(state.nx), lin.D)
        return [
            Row("outputs", name, float(np.abs(error).max()), tolerance)
            for name, error in zip(("y0", "C", "D"), errors, strict=True)
        ]
    measuring = Measuring(state, lin.q)

    def y(x: Array, u: Array) -> Array:
        return measuring(x, *model.acceleration(x, u))

    step_x, step_u = steps
    here = y(lin.x0, lin.u0)
    of_x, of_u = (np.ones(len(each), dtype=bool) for each in (step_x, step_u))
    C = jacobian(lambda rows: np.array([y(x, lin.u0) for x in rows]), lin.x0, step_x, of_x)
    D = jacobian(lambda rows: np.array([y(lin.x0, u) for u in rows]), lin.u0, step_u, of_u)
    # A derivative is noise if it is smaller than the rounding error of y divided by the step.
    scale = _ULPS * np.maximum(1.0, np.abs(here))[:, None]
    rows = [Row("outputs", "y0", _relative(lin.y0, here), tolerance)]
    for name, given, expected, step in (("C", lin.C, C, step_x), ("D", lin.D, D, step_u)):
        size = np.maximum(
            np.abs(expected).max(axis=1, initial=0.0)[:, None], _EPS * scale / step / tolerance
        )
        error = float((np.abs(given - expected) / size).max(initial=0.0))
        rows.append(Row("outputs", name, error, tolerance))
    return rows


def _relative(given: Array, expected: Array, floor: float = 1.0) -> float:
    if not given.size:
        return 0.0
    return float(np.abs(given - expected).max() / max(floor, float(np.abs(expected).max())))
