"""Controllers of full order that minimise the H-infinity norm of goals.

See K. Glover and J. C. Doyle, State-space formulae for all stabilizing controllers that satisfy an
H-infinity norm bound, Systems & Control Letters 11, 1988.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from fflin.base import html
from fflin.base.errors import InputError, optional_package
from fflin.base.process import in_one_thread
from fflin.base.tables import folded
from fflin.base.validation import Array, instance, positive, whole
from fflin.control.linear_controller import LinearController
from fflin.linear.model import LinearModel
from fflin.tuning.channels import Ends, channel_of, ends_of, signals_in_use
from fflin.tuning.closed_loop import ClosedLoop
from fflin.tuning.criteria import pieces_of
from fflin.tuning.goal_values import (
    GoalValue,
    goal_rows,
    goal_table,
    is_active,
    legend,
    rounded_up,
)
from fflin.tuning.goals import Goal, MaxGain
from fflin.tuning.law import Law, law_of
from fflin.tuning.loop import (
    sensor_delays,
    with_delayed_outputs,
    with_robot_lags,
)
from fflin.tuning.minimal import reduction_of
from fflin.tuning.plant import Plant, plant_of, signals_of
from fflin.tuning.reduction import truncations
from fflin.tuning.structures import Names, indices, input_indices
from fflin.tuning.tuned import matrices_of
from fflin.tuning.verification import largest_in_band, second_value

# Relative accuracy of the search, and relative sizes of added disturbances and outputs of states.
_ACCURACY, _SIZES = 1e-3, (0.0, 1e-6, 1e-4)

# Largest relative excess of the norm of the closed loop over the level of its design.
_EXCESS = 0.01

# Factor of the norm that messages propose for a reduced controller if the goals do not hold.
_KEPT = 1.05

# Largest level that is tried, and how many levels in a row may fail until the search ends.
_LARGEST, _FAILURES = 1e12, 3

# Poles nearer to the imaginary axis, relative to the fastest pole, are not stable.
_AXIS = 1e-13


class Generalised(NamedTuple):
    """Plant from (w, u) to (z, y)."""

    A: Array
    B1: Array
    B2: Array
    C1: Array
    C2: Array
    D11: Array
    D12: Array
    D21: Array
    D22: Array


class _Design(NamedTuple):
    """Controller for a generalised plant, its norm, and its signals among the model's signals.

    `model` is the plant of the goals with their `ends`. `full` contains the order and the norm of
    the controller of full order.
    """

    law: tuple[Array, Array, Array, Array]
    gamma: float
    plant: Generalised
    selected: Array
    placed: Array
    model: Plant
    goals: tuple[Goal, ...]
    ends: tuple[Ends, ...]
    full: tuple[int, float]

    def continuous_law(self) -> Law:
        """Return the continuous law from all outputs to all inputs of the model."""
        A, B, C, D = self.law
        B, C, D = B @ self.selected, self.placed @ C, self.placed @ D @ self.selected
        return law_of((A, B, C, D), [])


class HInfinity(LinearController):
    """Controller of full order that `hinf` designed; a linear policy.

    ``print`` shows the value of each goal.

    Attributes
    ----------
    gamma : float
        Largest gain from all inputs to all outputs of the goals together, each divided by its
        limit. All goals hold if it is at most 1.
    order : int
        Number of states of the controller.
    goals : tuple of GoalValue
        Value of each goal by itself, divided by its limit; `least` is the norm of full order if
        there is one goal.

    Examples
    --------
    >>> lin = fflin.linearize(fflin.load("planar_detumble"))
    >>> goal = fflin.MaxGain({"tau_b": 0.01, "q_b": 1e-3}, {"q_b": 0.05, "tau_b": 1.0})
    >>> policy = fflin.hinf(lin, goal, measured="q_b", inputs="tau_b")
    >>> policy.order
    6
    """

    gamma: float
    order: int

    def __init__(self, design: _Design, lin: LinearModel) -> None:
        law = design.continuous_law()
        super().__init__(matrices_of(law, lin.dt), lin)
        self.gamma = design.gamma
        self.order = len(law.A)
        self._design = design

    @cached_property
    def goals(self) -> tuple[GoalValue, ...]:
        """Value of each goal by itself, divided by its limit."""
        design = self._design
        loop = ClosedLoop(design.model, design.continuous_law())
        peaks = []
        for goal, ends in zip(design.goals, design.ends, strict=True):
            channel = channel_of(goal, ends, design.model)
            piece = pieces_of(goal, ends, channel, loop, np.zeros(0))[0]
            check = second_value(goal, ends, channel, loop)
            peaks.append((piece, math.nan if check is None else check))
        largest = max(piece.value for piece, _ in peaks)
        least = design.full[1] if len(peaks) == 1 else math.nan
        return tuple(
            GoalValue(
                goal.label,
                goal.hard,
                piece.value,
                check,
                piece.where,
                {},
                is_active(piece.value, False, largest),
                least,
            )
            for goal, (piece, check) in zip(design.goals, peaks, strict=True)
        )

    def _verdict(self) -> str:
        """Return whether the goals hold, and the norm of the loop."""
        missed = [goal.label for goal in self.goals if not goal.met]
        text = f"{', '.join(missed)} not met" if missed else "all goals hold"
        together = ""
        if len(self.goals) > 1:
            together = " from all inputs to all outputs of the goals"
        return (
            f"{self.lin.robot}: {text} with order {self.order}; the norm of the loop{together} is "
            f"{self.gamma:.4g}"
        )

    def _bound(self) -> str:
        """Return the least norm of all linear controllers."""
        order, gamma = self._design.full
        return (
            f"full order {order}: the norm is {gamma:.4g}, within 1 % of the least norm of all "
            "linear controllers"
        )

    def report(self) -> str:
        """Return the report: goals with their values, the order, and the norm of full order."""
        return "\n\n".join(
            (
                folded([self._verdict()]),
                goal_table(self.goals),
                folded(legend(self.goals)),
                folded([self._bound()]),
            )
        )

    def __str__(self) -> str:
        return self.report()

    def _repr_html_(self) -> str:
        return html.result_card(
            self,
            html.paragraph(self._verdict()),
            html.table(goal_rows(self.goals), "llrrrr"),
            *(html.paragraph(line) for line in legend(self.goals)),
            html.paragraph(self._bound()),
        )

    def reduced(
        self, order: int | None = None, *, below: float | None = None
    ) -> HInfinity:
        """Return a controller of lower order that keeps the goals.

        The states that affect the outputs of the goals least are left out, by balanced truncation
        in the closed loop. The loop of each lower order is verified as in `hinf`.

        Parameters
        ----------
        order : int, optional
            Number of states. By default, the lowest order whose norm is at most `below`.
        below : float, optional
            Largest norm of the loop; by default 1, so that all goals hold. It is required if the
            goals do not hold with all states.

        Returns
        -------
        HInfinity
            Controller of the lower order, with the norm of its loop; this controller if its own
            norm is at most `below`, but no lower order has such a norm.

        Raises
        ------
        InputError
            If one of these conditions is true:

            - the loop with a controller of the given order is unstable, or its norm is above
              `below`;
            - fewer states than `order` affect the goals;
            - neither `order` nor `below` is given, and the goals do not hold with all states;
            - `below` is less than `gamma`, and no lower order has such a norm.

        Examples
        --------
        >>> lin = fflin.linearize(fflin.load("planar_detumble"))
        >>> goal = fflin.MaxGain({"tau_b": 0.01, "q_b": 1e-3}, {"q_b": 0.05, "tau_b": 1.0})
        >>> policy = fflin.hinf(lin, goal, measured="q_b", inputs="tau_b")
        >>> policy.reduced().gamma <= 1.0
        True
        """
        level = 1.0
        if below is not None:
            level = positive("below", below)
        elif order is not None:
            level = math.inf
        elif self.gamma > level:
            kept = rounded_up(_KEPT * self.gamma)
            raise InputError(
                f"the goals do not hold with all {self.order} states, whose norm is "
                f"{self.gamma:.4g}; give the largest norm of the reduced controller, such as "
                f"below={kept}"
            )
        if order is not None:
            whole("order", order, 0, max(self.order - 1, 0))
        design = self._design
        laws = truncations(design.law, _closed(design.plant, design.law))
        if not self.order:
            laws = [design.law]
        if order is not None:
            highest = len(laws) - 1
            if order > highest:
                raise InputError(
                    f"order is {order}, but only {highest} states of the controller affect the "
                    f"goals; give order={highest} or less"
                )
            laws = [laws[order]]
        for law in laws:
            norm = _norm(design.plant, law)
            if norm is not None and norm <= level:
                lower = design._replace(law=law, gamma=norm)
                return HInfinity(lower, self.lin)
        if order is None and self.gamma <= level:
            return self
        if order is None:
            raise InputError(
                f"below is {level:g}, but the controller with all {self.order} states has the norm "
                f"{self.gamma:.4g}, and no lower order a norm of {level:g}; give "
                f"below={rounded_up(self.gamma)} or more"
            )
        limit = f" or has a norm above {level:.4g}" if math.isfinite(level) else ""
        raise InputError(
            f"the loop with the controller of order {order} is unstable{limit}; give a higher "
            "order, or tune a fflin.StateSpaceLaw of this order"
        )

    def __repr__(self) -> str:
        time = f"dt={self.dt:g} s" if self.dt else "continuous"
        (nu, ny) = self.system.D.shape
        return (
            f"HInfinity('{self.lin.robot}', gamma={self.gamma:.4g}, order={self.order}, ny={ny}, "
            f"nu={nu}, {time})"
        )


@in_one_thread
def hinf(
    lin: LinearModel,
    goals: Goal | Sequence[Goal],
    *,
    measured: Names = "*",
    inputs: Names = "*",
) -> HInfinity:
    """Design the controller of full order with the least H-infinity norm of goals.

    The generalised plant contains the inputs and outputs of all goals, divided by their sizes and
    limits. The norm is the largest gain of all of them together, so it is an upper bound of the
    value of each goal. SLICOT's SB10FD solves the Riccati equations for the balanced plant, and a
    bisection finds the least norm within 0.1 %. If undisturbed poles or zeros are on the imaginary
    axis, the design adds disturbances and outputs of all states, of at most 1e-4 of the others.

    Each design is verified on the plant without these changes: its loop must be stable, and the
    norm of the loop, from eigenvalues of Hamiltonian matrices, must not exceed the level of the
    design by more than 1 %. `gamma` is this norm. Every command must be an output of a goal, and
    every measured output must be an input, because the least norm otherwise requires infinite
    gains.

    Parameters
    ----------
    lin : LinearModel
        Continuous or sampled model. For a sampled one, the controller is sampled too. A model
        without lags gets the lags of the inputs and outputs of its robot.
    goals : MaxGain or sequence of MaxGain
        Goals at all frequencies; their bounds may depend on frequency.
    measured, inputs : str or sequence of str
        Outputs that the controller measures, and inputs that it commands; all by default.

    Returns
    -------
    HInfinity

    Raises
    ------
    InputError
        If a goal is not a `MaxGain` at all frequencies, a signal does not exist, a command or
        measured output is not in the goals, a measured output has a `sample` other than that of
        the model or a `delay` that is not a multiple of it, the model holds only at one time, or
        no design is stable and verified.
    MissingPackageError
        If slycot is not installed.

    Examples
    --------
    >>> lin = fflin.linearize(fflin.load("planar_detumble"))
    >>> goal = fflin.MaxGain({"tau_b": 0.01, "q_b": 1e-3}, {"q_b": 0.05, "tau_b": 1.0})
    >>> policy = fflin.hinf(lin, goal, measured="q_b", inputs="tau_b")
    >>> policy.gamma < 1.0
    True
    """
    instance("lin", lin, LinearModel, "a fflin.LinearModel")
    every = [goals] if isinstance(goals, Goal) else goals
    if not isinstance(every, Sequence) or not every:
        raise InputError(f"goals are {goals!r}, expected one goal or more")
    lin = with_robot_lags(lin)
    signals = signals_of(lin)
    rows = indices("output", measured, signals.outputs)
    delays = sensor_delays(lin, rows)
    columns = input_indices(inputs, signals)
    ends = []
    for goal in every:
        instance("goal", goal, MaxGain, "a fflin.MaxGain, the goal of hinf")
        assert isinstance(goal, MaxGain)
        if goal.band != (0.0, np.inf):
            raise InputError(
                f"the goal '{goal.label}' has a band, but hinf needs goals at all frequencies; "
                "give below= as a transfer function, or use fflin.tune"
            )
        found = ends_of(goal, signals, lin.state_names, rows, columns)
        assert found is not None
        if lin.dt and len(found.weight.denominator) > 1:
            raise InputError(
                f"below of the goal '{goal.label}' depends on frequency, but the model is sampled; "
                "give a number, or the continuous model"
            )
        ends.append(found)
    model = _plant(lin, ends, rows, columns, delays)
    # Outputs without a state that the inputs move are not fed back.
    rows = tuple(row for row in rows if model.C[row].any())
    if not rows:
        raise InputError(
            "the inputs move no measured output; give other outputs in measured="
        )
    plant = _generalised(model, every, ends, rows, columns)
    free = _dependent(plant.D12)
    if free is not None:
        raise InputError(
            f"the goals do not limit the command '{signals.inputs[columns[free]]}' at all "
            "frequencies; add it to the outputs of a goal, or give the other inputs in inputs="
        )
    exact = _dependent(plant.D21.T)
    if exact is not None:
        raise InputError(
            f"the goals contain no error of the measured '{signals.outputs[rows[exact]]}'; add it "
            "to the inputs of a goal, or give the other outputs in measured="
        )
    law, gamma = synthesis(plant)
    ny, nu = len(signals.outputs), len(signals.inputs)
    selected, placed = np.eye(ny)[list(rows)], np.eye(nu)[:, list(columns)]
    design = _Design(
        law,
        gamma,
        plant,
        selected,
        placed,
        model,
        tuple(every),
        tuple(ends),
        (len(law[0]), gamma),
    )
    return HInfinity(design, lin)


def _plant(
    lin: LinearModel,
    ends: Sequence[Ends],
    rows: Sequence[int],
    columns: Sequence[int],
    delays: Sequence[int],
) -> Plant:
    """Return the plant with the states that connect signals of the goals and the controller."""
    matrices = with_delayed_outputs((lin.A, lin.B, lin.C, lin.D), delays)
    used, inputs = signals_in_use(ends, rows, columns, len(lin.C) + len(lin.A))
    reduction = reduction_of([matrices], lin.dt, used, inputs)
    return plant_of(matrices, lin.dt, reduction)


def _generalised(
    plant: Plant,
    goals: Sequence[Goal],
    ends: Sequence[Ends],
    rows: Sequence[int],
    columns: Sequence[int],
) -> Generalised:
    """Return the generalised plant of goals, with the states of their weights."""
    channels = [
        channel_of(goal, end, plant) for goal, end in zip(goals, ends, strict=True)
    ]
    sizes = [len(channel.C1) for channel in channels]
    widths = [channel.B1.shape[1] for channel in channels]
    C1 = np.vstack([channel.C1 for channel in channels])
    D12 = np.vstack([channel.D12 for channel in channels])[:, list(columns)]
    B1 = np.hstack([channel.B1 for channel in channels])
    D21 = np.hstack([channel.D21 for channel in channels])[list(rows)]
    D11 = np.zeros((sum(sizes), sum(widths)))
    row = 0
    for goal, end, size in zip(goals, ends, sizes, strict=True):
        column = 0
        for other, width in zip(ends, widths, strict=True):
            # Outputs of one goal also depend directly on inputs of the others.
            mixed = Ends(
                other.sources, end.sinks, other.source_sizes, end.sink_sizes, end.weight
            )
            block = channel_of(goal, mixed, plant).D11
            D11[row : row + size, column : column + width] = block
            column += width
        row += size
    A, C2, D22 = plant.A, plant.C[list(rows)], plant.D[np.ix_(rows, columns)]
    B2 = plant.B[:, list(columns)]
    blocks = [
        end.weight.state_space()
        for end, size in zip(ends, sizes, strict=True)
        for _ in range(size)
    ]
    a, b, c, d = (_diagonal([block[k] for block in blocks]) for k in range(4))
    n = len(a)
    return Generalised(
        np.block([[A, np.zeros((len(A), n))], [b @ C1, a]]),
        np.vstack((B1, b @ D11)),
        np.vstack((B2, b @ D12)),
        np.hstack((d @ C1, c)),
        np.hstack((C2, np.zeros((len(C2), n)))),
        d @ D11,
        d @ D12,
        D21,
        D22,
    )


def _diagonal(blocks: Sequence[Array]) -> Array:
    """Return a block-diagonal matrix; blocks may be empty."""
    rows = sum(len(block) for block in blocks)
    columns = sum(block.shape[1] for block in blocks)
    result = np.zeros((rows, columns))
    row = column = 0
    for block in blocks:
        height, width = block.shape
        result[row : row + height, column : column + width] = block
        row += height
        column += width
    return result


def _dependent(matrix: Array) -> int | None:
    """Return the index of the first column that is a combination of the others, or None."""
    lengths = np.linalg.norm(matrix, axis=0)
    lengths[lengths == 0.0] = 1.0
    scaled = matrix / lengths
    rank = np.linalg.matrix_rank(scaled)
    for index in range(scaled.shape[1]):
        others = np.delete(scaled, index, axis=1)
        if np.linalg.matrix_rank(others) == rank:
            return index
    return None


def synthesis(plant: Generalised) -> tuple[tuple[Array, Array, Array, Array], float]:
    """Return the controller (A, B, C, D) of u = K y, and the norm of the closed loop.

    D12 must have full column rank, and D21 full row rank. The search accepts a level only if the
    norm of the closed loop, computed for `plant` itself, exceeds it by at most 1 %. A failure at
    one level can be a rounding error, so the search also tries lower levels.
    """
    best = None
    for size in _SIZES:
        result = _least(plant, _prepared(plant, size))
        if result is None:
            continue
        if best is None or result[1] < best[1] * (1.0 - _EXCESS):
            best = result
    if best is None:
        raise InputError(
            "no controller with a finite H-infinity norm was found and verified; check that the "
            "inputs and measured outputs can stabilise all states of the goals"
        )
    return best


def _least(
    plant: Generalised, prepared: _Prepared
) -> tuple[tuple[Array, Array, Array, Array], float] | None:
    """Return the controller with the least norm, and the norm; None if there is none."""
    high = 1.0
    best = _controller(plant, prepared, high)
    while best is None and high < _LARGEST:
        high *= 10.0
        best = _controller(plant, prepared, high)
    if best is None:
        return None
    level = high
    failures = 0
    while failures < _FAILURES and level > 1.0 / _LARGEST:
        level *= 0.5
        result = _controller(plant, prepared, level)
        if result is None:
            failures += 1
            continue
        high, best, failures = level, result, 0
    low = 0.5 * high
    while high > low * (1.0 + _ACCURACY):
        level = math.sqrt(low * high)
        result = _controller(plant, prepared, level)
        if result is None:
            low = level
        else:
            high, best = level, result
    return best


class _Prepared(NamedTuple):
    """Balanced plant, and the sizes by which y and u are divided."""

    A: Array
    B: Array
    C: Array
    D: Array
    y_sizes: Array
    u_sizes: Array


def _prepared(plant: Generalised, size: float) -> _Prepared:
    """Return a plant in which each y has noise of size 1, and each u has a cost of size 1.

    The states are balanced. Signals of the relative `size` are then added: a disturbance and an
    output for each state. They remove zeros on the imaginary axis, for which the Riccati equations
    have no solution.
    """
    y_sizes = np.linalg.norm(plant.D21, axis=1)
    u_sizes = 1.0 / np.linalg.norm(plant.D12, axis=0)
    A, B1, C1, D11 = plant.A, plant.B1, plant.C1, plant.D11
    B2, D12 = plant.B2 * u_sizes, plant.D12 * u_sizes
    C2, D21 = plant.C2 / y_sizes[:, None], plant.D21 / y_sizes[:, None]
    D22 = plant.D22 * u_sizes / y_sizes[:, None]
    n = len(A)
    B, C = np.hstack((B1, B2)), np.vstack((C1, C2))
    if n:
        balanced = _slycot().tb01id(
            n, B.shape[1], len(C), 0.0, A.copy(), B.copy(), C.copy()
        )
        A, B, C = balanced[1:4]
    if size:
        push = size * np.linalg.norm(B, 2) * np.eye(n)
        read = size * np.linalg.norm(C, 2) * np.eye(n)
        B = np.hstack((push, B))
        C = np.vstack((read, C))
        D11 = np.pad(D11, ((n, 0), (n, 0)))
        D12 = np.pad(D12, ((n, 0), (0, 0)))
        D21 = np.pad(D21, ((0, 0), (n, 0)))
    return _Prepared(A, B, C, np.block([[D11, D12], [D21, D22]]), y_sizes, u_sizes)


def _controller(
    plant: Generalised, prepared: _Prepared, level: float
) -> tuple[tuple[Array, Array, Array, Array], float] | None:
    """Return the central controller for a level and its norm; None if it is not verified."""
    A, B, C, D, y_sizes, u_sizes = prepared
    nu, ny = len(u_sizes), len(y_sizes)
    try:
        design = _slycot().sb10fd(len(A), B.shape[1], len(C), nu, ny, level, A, B, C, D)
    except ArithmeticError:
        return None
    Ak, Bk, Ck, Dk = design[:4]
    law = (
        Ak,
        Bk / y_sizes,
        Ck * u_sizes[:, None],
        Dk * u_sizes[:, None] / y_sizes,
    )
    if not all(np.isfinite(matrix).all() for matrix in law):
        return None
    norm = _norm(plant, law)
    if norm is None or norm > level * (1.0 + _EXCESS):
        return None
    return law, norm


def _norm(plant: Generalised, law: tuple[Array, Array, Array, Array]) -> float | None:
    """Return the norm of the closed loop; None if it is unstable."""
    loop = _closed(plant, law)
    poles = np.linalg.eigvals(loop[0])
    fastest = np.abs(poles).max(initial=0.0)
    if poles.real.max(initial=-np.inf) >= -_AXIS * fastest:
        return None
    return largest_in_band(loop, 0.0, np.inf)[0]


def _slycot() -> Any:
    """Return the package slycot, or raise `MissingPackageError`."""
    return optional_package("slycot", "hinf needs slycot", "robust")


def _closed(
    plant: Generalised, law: tuple[Array, Array, Array, Array]
) -> tuple[Array, Array, Array, Array]:
    """Return the closed loop of a plant and a controller."""
    A, B, C, D = law
    left = np.linalg.inv(np.eye(len(D)) - D @ plant.D22)
    K, Cu = left @ D, left @ C
    Cy = plant.C2 + plant.D22 @ K @ plant.C2
    Dy = plant.D21 + plant.D22 @ K @ plant.D21
    return (
        np.block(
            [
                [plant.A + plant.B2 @ K @ plant.C2, plant.B2 @ Cu],
                [B @ Cy, A + B @ plant.D22 @ Cu],
            ]
        ),
        np.vstack((plant.B1 + plant.B2 @ K @ plant.D21, B @ Dy)),
        np.hstack((plant.C1 + plant.D12 @ K @ plant.C2, plant.D12 @ Cu)),
        plant.D11 + plant.D12 @ K @ plant.D21,
    )
