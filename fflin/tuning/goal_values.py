"""Values of goals for a law, and their table in reports."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from fflin.base.tables import cut, grid, width

# A goal whose value is this near to the largest one is active.
_ACTIVE = 1e-2

# Least width of the column of the goals.
_NARROWEST = 16

# Goals with lower limits: the beginnings of their labels, and their plurals.
_LOWER = {
    "disk margin": "margins",
    "decay rate": "decay rates",
    "damping ratio": "damping ratios",
}


@dataclass(frozen=True)
class GoalValue:
    """Value of a goal for a tuned law.

    Attributes
    ----------
    label : str
        The goal in words.
    hard : bool
    value : float
        Value at the worst model, divided by the limit; the goal holds if it is at most 1. For
        margins, decay rates and damping ratios, the limit divided by the least value.
    check : float
        The same value by a second method; NaN for poles.
    frequency : float
        Frequency [rad/s] of the peak, magnitude [rad/s] of the pole, or time [s] of a step
        response; NaN for variances.
    parameters : mapping
        Uncertain parameters at which the value occurs; empty for the nominal model.
    active : bool
        Whether this goal limits the others: its value is the largest, or it is a hard goal that
        just holds.
    least : float
        Least value of all linear controllers for the nominal model, from `hinf`, within 1 %. NaN if
        `hinf` does not accept the goal, or slycot is not installed.
    bound : float
        Upper bound of the value over the whole ranges of an `Uncertain`, from the structured
        singular value; infinite if no bound was found. NaN for goals that are not gains, for
        sampled laws, and for plants without ranges.
    no_bound : str
        Why `bound` is infinite or NaN; empty for plants without ranges.

    Examples
    --------
    >>> lin = fflin.linearize(fflin.load("planar_detumble"))
    >>> law = fflin.PD("q_b", "tau_b", rates="omega_b")
    >>> tuned = fflin.tune(lin, law, [fflin.Decay(0.1)], starts=1)
    >>> tuned.goals[0].met, tuned.goals[0].label
    (True, 'decay rate')
    """

    label: str
    hard: bool
    value: float
    check: float
    frequency: float
    parameters: Mapping[str, float]
    active: bool
    least: float = math.nan
    bound: float = math.nan
    no_bound: str = ""

    @property
    def worst(self) -> float:
        """The larger of both values."""
        return with_check(self.value, self.check)

    @property
    def met(self) -> bool:
        """Whether both values are at most 1."""
        return self.worst <= 1.0


def rounded_up(value: float) -> str:
    """Return a number with four digits that is not smaller."""
    if not math.isfinite(value):
        return f"{value:g}"
    size = 10.0 ** (math.floor(math.log10(value)) - 3)
    return f"{math.ceil(value / size) * size:.4g}"


def with_check(value: float, check: float) -> float:
    """Return the larger of a value and its check, which is NaN if there is none."""
    return value if math.isnan(check) else max(value, check)


def is_active(value: float, hard: bool, level: float) -> bool:
    """Return whether a goal limits the others; `level` is the largest value of the soft goals."""
    limit = 1.0 if hard else level
    return value >= limit * (1.0 - _ACTIVE)


def models_of(goals: Sequence[GoalValue]) -> list[Mapping[str, float]]:
    """Return the parameters of the models in the table of goals, without the nominal one."""
    models: list[Mapping[str, float]] = []
    for goal in goals:
        if goal.parameters and goal.parameters not in models:
            models.append(goal.parameters)
    return models


def model_lines(goals: Sequence[GoalValue]) -> list[str]:
    """Return the parameters of the models, which have numbers in the table of goals."""
    lines = []
    for number, parameters in enumerate(models_of(goals), 1):
        values = (f"{key} {value:.4g}" for key, value in parameters.items())
        lines.append(f"model {number}: {', '.join(values)}")
    return lines


def goal_rows(goals: Sequence[GoalValue]) -> list[list[str]]:
    """Return the rows of the table of goals."""
    models = models_of(goals)
    rows = [["goal", "", "value", "check", "at", *(["model"] if models else [])]]
    for goal in goals:
        mark = "hard " if goal.hard else ""
        if goal.active:
            mark += "*"
        check = "" if math.isnan(goal.check) else f"{goal.check:.6g}"
        where = ""
        if not math.isnan(goal.frequency):
            unit = "s" if goal.label.startswith("step") else "rad/s"
            where = f"{goal.frequency:.3g} {unit}"
        model = []
        if models:
            number = "nominal"
            if goal.parameters:
                number = str(models.index(goal.parameters) + 1)
            model.append(number)
        rows.append([goal.label, mark, f"{goal.value:.6g}", check, where, *model])
    return rows


def goal_table(goals: Sequence[GoalValue]) -> str:
    """Return the table of goals in the width of the terminal; long labels are wrapped."""
    rows = cut(goal_rows(goals), "see goals")
    sizes = [max(map(len, column)) for column in zip(*rows, strict=True)]
    room = max(width() - sum(sizes[1:]) - 2 * (len(sizes) - 1), _NARROWEST)
    wrapped: list[list[str]] = []
    for label, *cells in rows:
        first, *others = textwrap.wrap(
            label, room, subsequent_indent="  ", break_on_hyphens=False
        )
        wrapped.append([first, *cells])
        wrapped += [[part, *[""] * len(cells)] for part in others]
    return grid(wrapped, "llrrrr"[: len(rows[0])])


def legend(goals: Sequence[GoalValue]) -> list[str]:
    """Return lines that explain the table of goals."""
    lines = [
        "value: largest value divided by its limit, which must be at most 1; check: the same by a "
        "second method; *: active, limits the other goals"
    ]
    labels = [goal.label for goal in goals]
    kinds = [
        plural
        for start, plural in _LOWER.items()
        if any(label.startswith(start) for label in labels)
    ]
    if kinds:
        *others, last = kinds
        named = f"{', '.join(others)} and {last}" if others else last
        lines.append(
            f"{named} have lower limits: value is the limit divided by the least value; to relax "
            "such a limit by a factor is to divide it"
        )
    return lines
