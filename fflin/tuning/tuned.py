"""Result of a search: the tuned law with its report."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from fflin.base import html
from fflin.base.figures import Figure
from fflin.base.record import write_record
from fflin.base.tables import counted, cut, folded, grid
from fflin.base.validation import Array
from fflin.base.writing import as_path
from fflin.control.linear_controller import LinearController
from fflin.linear.model import LinearModel
from fflin.tuning.curves import GoalLoops
from fflin.tuning.files import record_of_law
from fflin.tuning.goal_values import (
    GoalValue,
    goal_rows,
    goal_table,
    legend,
    model_lines,
    rounded_up,
)
from fflin.tuning.law import Law


class Tuned(LinearController):
    """Law that `tune` found; a linear policy.

    It is a `LinearController`: `simulate` and `monte_carlo` fly it, `margins` computes its margins,
    `write_c` writes its C code, and `save` writes its matrices.

    Attributes
    ----------
    parameters : mapping
        Values of the parameters of the structure, {name: value}.
    units : mapping
        Units of the parameters; empty for entries of a state-space law.
    goals : tuple of GoalValue
        Values of the goals in the order in which they were given.
    factor : float
        Largest value of all goals. If some goals do not hold, it is the least factor that was found
        by which their limits must be relaxed: upper limits are multiplied by it, and limits of
        margins, decay rates and damping ratios are divided by it. The law of `relaxed` meets all
        goals with these limits at all examined models. A search is local, so a smaller factor may
        exist.
    relaxed : mapping
        Values of the parameters of the law with this factor, {name: value}. They are equal to
        `parameters` if all goals hold.
    conflict : tuple of str
        Goals that no law was found to meet together, if some goals do not hold; empty otherwise.
        One goal was not met by any law. Two goals contradict each other. For more goals, laws were
        found that meet each two of them.
    stationarity : float
        Norm of the convex combination of the gradients of the active goals in the logarithms of the
        parameters; near 0 at a local minimum.
    points : tuple of mapping
        Uncertain parameters of all models that the search used.
    examined : int
        Number of models at which the goals were evaluated at the end.
    starts : tuple of float
        Largest value of the soft goals at the end of each start, or of the hard goals if one of
        them does not hold; infinite if no stable loop was found. If all goals are hard, their
        largest value.
    reached : int
        Number of starts that reached the best value within 1 %. Starts whose hard goals hold are
        better than all others.
    seconds : float
        CPU time of the search [s].
    remarks : tuple of str
        Remarks on the plant, such as poles of the plant that do not decay and that no signal of
        the law or the goals depends on.
    history : ndarray (k, 2)
        Largest value of the soft and of the hard goals in each step of the search, from the best
        start on. The values grow where worse models are added.
    parameter_history : ndarray (k, p)
        Values of the parameters in each step.

    Examples
    --------
    >>> lin = fflin.linearize(fflin.load("planar_detumble"))
    >>> law = fflin.PD("q_b", "tau_b", rates="omega_b")
    >>> tuned = fflin.tune(lin, law, [fflin.Decay(0.1), fflin.Damping(0.7)], starts=1)
    >>> tuned.met, len(tuned.parameters)
    (True, 6)
    """

    parameters: Mapping[str, float]
    units: Mapping[str, str]
    goals: tuple[GoalValue, ...]
    factor: float
    relaxed: Mapping[str, float]
    conflict: tuple[str, ...]
    stationarity: float
    points: tuple[Mapping[str, float], ...]
    examined: int
    starts: tuple[float, ...]
    reached: int
    seconds: float
    remarks: tuple[str, ...]
    history: Array
    parameter_history: Array
    _loops: tuple[GoalLoops, ...]

    def __init__(
        self,
        law: Law,
        lin: LinearModel,
        loops: tuple[GoalLoops, ...] = (),
        **results: object,
    ) -> None:
        super().__init__(matrices_of(law, lin.dt), lin)
        self._loops = loops
        self.__dict__.update(results)

    @property
    def met(self) -> bool:
        """Whether all goals hold."""
        return all(goal.met for goal in self.goals)

    def __str__(self) -> str:
        return self.report()

    def _repr_html_(self) -> str:
        parts = [
            html.paragraph(self._verdict()),
            html.table(goal_rows(self.goals), "llrrrr"),
        ]
        lines = (*legend(self.goals), *self._range_lines())
        parts += [html.paragraph(line) for line in lines]
        parts += [html.paragraph(note, "note") for note in self.remarks]
        parts.append(html.table(self._parameter_rows(), "lrl"))
        return html.result_card(self, *parts)

    def _verdict(self) -> str:
        """Return whether the goals hold, and what limits them."""
        if self.met:
            models = counted(self.examined, "model")
            return (
                f"{self.lin.robot}: all goals hold at {models}; the largest value is "
                f"{self.factor:.4g} of its limit"
            )
        names = [goal.label for goal in self.goals if not goal.met]
        text = (
            f"{self.lin.robot}: {', '.join(names)} not met; the least factor that was found by "
            f"which all limits must be relaxed is {rounded_up(self.factor)}"
        )
        return f"{text}. {self._reason()}"

    def _reason(self) -> str:
        """Return which goals do not hold together."""
        *others, last = self.conflict
        if not others:
            return f"No law was found that meets {last}, even without the other goals"
        text = f"{', '.join(others)} and {last}"
        if len(others) == 1:
            return f"{text} contradict each other: no law was found that meets both"
        return f"Laws were found that meet two of {text}, but no law that meets all"

    def _range_lines(self) -> list[str]:
        """Return what is known of the values between the examined models of an `Uncertain`."""
        if self.examined == len(self.points):
            return []
        if self.dt:
            return [
                "the values hold at the examined models; a bound over the whole ranges requires a "
                "continuous law"
            ]
        finite = [
            f"{goal.label} {goal.bound:.4g}"
            for goal in self.goals
            if math.isfinite(goal.bound)
        ]
        without: dict[str, list[str]] = {}
        for goal in self.goals:
            if not math.isfinite(goal.bound):
                without.setdefault(goal.no_bound, []).append(goal.label)
        lines = []
        if finite:
            lines.append(
                "upper bounds of the values over the whole ranges, by the structured singular "
                f"value: {', '.join(finite)}; a bound above 1 does not certify its goal"
            )
        for reason, labels in without.items():
            lines.append(
                f"not certified over the whole ranges: {', '.join(labels)}; {reason}"
            )
        if without:
            lines.append(
                "without a bound, the values can be larger between the examined models"
            )
        return lines

    def _parameter_rows(self) -> list[list[str]]:
        """Return the table of the parameters."""
        rows = [["parameter", "value", "unit"]]
        for name, value in self.parameters.items():
            rows.append([name, f"{value:.6g}", self.units.get(name, "")])
        return rows

    def report(self) -> str:
        """Return the report: goals with their values, parameters and figures of the search."""
        search = (
            f"{counted(len(self.starts), 'start')}, of which {self.reached} reached the best value "
            f"within 1 %; stationarity {self.stationarity:.1e}; "
            f"{counted(len(self.points), 'model')} in the search, {self.examined} examined"
        )
        parameters = grid(cut(self._parameter_rows(), "see parameters"), "lr")
        parts = [
            folded([self._verdict()]),
            goal_table(self.goals),
            folded(legend(self.goals)),
        ]
        if lines := model_lines(self.goals):
            parts.append(folded(lines))
        for goal in self.goals:
            if math.isfinite(goal.least):
                least = f"the least value of all linear controllers is {goal.least:.4g}"
                parts.append(folded([f"{goal.label}: {least}"]))
        if lines := self._range_lines():
            parts.append(folded(lines))
        if self.remarks:
            parts.append(folded(f"note: {note}" for note in self.remarks))
        return "\n\n".join((*parts, parameters, folded([search])))

    def record(self) -> dict[str, object]:
        """Return the law, its parameters and the figures of the report, for JSON."""
        record = record_of_law(self) | {
            name: getattr(self, name)
            for name in (
                *("parameters", "units", "met", "factor", "relaxed", "conflict"),
                "stationarity",
                *("points", "examined", "starts", "reached", "seconds", "remarks"),
            )
        }
        goals = [
            {
                "label": goal.label,
                "hard": goal.hard,
                "value": goal.value,
                "check": goal.check,
                "met": goal.met,
                "active": goal.active,
                "least": goal.least,
                "bound": goal.bound,
                "no_bound": goal.no_bound,
                "frequency": goal.frequency,
                "parameters": goal.parameters,
            }
            for goal in self.goals
        ]
        return record | {"goals": goals}

    def plot(self, path: str | Path | None = None) -> Figure:
        """Draw the goals, the loops and the search by `plot_tuned`; save a file if given."""
        from fflin import plot_tuned

        return plot_tuned(self, path)

    def save(self, path: str | Path) -> None:
        """Write the law to a file, which `LinearController` and other tools read.

        Parameters
        ----------
        path : str or Path
            Path that ends in .npz, .mat or .json.

        Raises
        ------
        FileError
            If the path has another ending or the file cannot be written.
        """
        record = record_of_law(self) | {"parameters": dict(self.parameters)}
        write_record(as_path(path), record, checksummed=self.lin.verified)


def matrices_of(law: Law, dt: float) -> tuple[Array, Array, Array, Array, float]:
    """Return the matrices of a law, sampled by Tustin's method if dt [s] is not 0."""
    A, B, C, D = law[:4]
    if not dt:
        return A, B, C, D, 0.0
    rate = 2.0 / dt
    unit = rate * np.eye(len(A))
    inverse = np.linalg.inv(unit - A)
    factor = math.sqrt(2.0 * rate)
    return (
        (unit + A) @ inverse,
        factor * inverse @ B,
        factor * C @ inverse,
        D + C @ inverse @ B,
        dt,
    )
