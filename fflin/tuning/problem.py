"""Problem of a search: parameters, plants and goals as functions of one vector."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from fflin.base.errors import InputError
from fflin.base.validation import Array
from fflin.base.validation import number as checked_number
from fflin.tuning.channels import Channel, Ends, channel_of
from fflin.tuning.closed_loop import ClosedLoop
from fflin.tuning.criteria import Piece, abscissa_pieces, pieces_of
from fflin.tuning.goals import Goal, Margin
from fflin.tuning.law import Law
from fflin.tuning.parameters import Parameter
from fflin.tuning.plant import Plant
from fflin.tuning.search import Term
from fflin.tuning.structures import Structured

# Values of goals below this one are left out of the search.
_LEAST = 1e-9

# Hard goals are tighter by this factor (in the logarithm), so that they hold after rounding.
_TIGHT = 1e-6

# Peaks below this fraction of the level of the goals are not refined.
_ROUGH = 0.5

# Relative rounding error of a given value of a parameter.
_ROUNDING = 1e-9

# Bound of the logarithm of the scaling of a channel.
_SCALING = math.log(1e6)


@dataclass(frozen=True, eq=False)
class Measure:
    """Goal with its inputs and outputs."""

    goal: Goal
    ends: Ends | None


class Case:
    """Plant with the channels of all goals."""

    def __init__(self, plant: Plant, measures: Sequence[Measure]) -> None:
        self.plant = plant
        self.channels: list[Channel | None] = [
            None if m.ends is None else channel_of(m.goal, m.ends, plant)
            for m in measures
        ]

    def loops(self, law: Law) -> list[ClosedLoop] | None:
        """Return the closed loop of each goal, or None if one of them is unstable."""
        main = ClosedLoop(self.plant, law)
        if not main.is_stable:
            return None
        loops = []
        for channel in self.channels:
            loop = main
            if channel is not None and channel.plant is not self.plant:
                loop = ClosedLoop(channel.plant, law)
            loops.append(loop)
        return loops


class Problem:
    """Goals of a structured law for several plants.

    The vector x contains the coordinates of the free parameters, and then the logarithms of the
    scalings of the channels of each margin, without the first channel. `tight` contains logarithms
    by which hard goals are tighter.

    By default, the soft goals are the objective, and the hard goals are constraints. If all goals
    are hard, they are the objective. If `objective` is given, it contains the indices of the goals
    that are the objective, and the other goals are left out.
    """

    def __init__(
        self,
        structured: Structured,
        measures: Sequence[Measure],
        cases: list[Case],
        tight: Array | None = None,
        objective: Sequence[int] | None = None,
    ) -> None:
        self.tight: Array = np.zeros(len(measures)) if tight is None else tight
        self.structured = structured
        self.measures = measures
        self.cases = cases
        hard = [measure.goal.hard for measure in measures]
        self.is_constraint = [False] * len(measures)
        self.is_counted = [True] * len(measures)
        if objective is not None:
            self.is_counted = [index in objective for index in range(len(measures))]
        elif not all(hard):
            self.is_constraint = hard
        self._objective = objective
        parameters = structured.parameters
        self.free = [i for i, is_free in enumerate(structured.free) if is_free]
        self.scalings: list[slice | None] = []
        size = len(self.free)
        for measure in measures:
            place = None
            if isinstance(measure.goal, Margin) and measure.ends is not None:
                more = len(measure.ends.sources) - 1
                place = slice(size, size + more)
                size += more
            self.scalings.append(place)
        self.size = size
        # Least level of the soft goals so far; peaks far below it are not refined.
        self._level = math.inf
        low = np.full(size, -_SCALING)
        high = np.full(size, _SCALING)
        for position, index in enumerate(self.free):
            low[position], high[position] = parameters[index].bounds
        self.bounds = low, high

    def start(self, rng: np.random.Generator | None = None) -> Array:
        """Return the start values, or random ones."""
        parameters = self.structured.parameters
        x = self._point([parameter.value for parameter in parameters])
        if rng is not None:
            for place, index in enumerate(self.free):
                x[place] = parameters[index].drawn(rng)
        return x

    def of_gain(self, gain: Array) -> Array:
        """Return the point of a static gain (commanded, measured)."""
        return self._point(self.structured.of_gain(gain).tolist())

    @property
    def simpler(self) -> Problem | None:
        """Problem of a law with fewer states, or None."""
        structured = self.structured.simpler
        if structured is None:
            return None
        return Problem(
            structured, self.measures, self.cases, self.tight, self._objective
        )

    def extended(self, simple: Problem, x: Array) -> Array:
        """Return the point of the law of a simpler problem at x."""
        names = [parameter.name for parameter in simple.structured.parameters]
        known = dict(zip(names, simple.values(x)[0].tolist(), strict=True))
        parameters = self.structured.parameters
        point = self._point([known.get(p.name, p.value) for p in parameters])
        point[len(self.free) :] = x[len(simple.free) :]
        return point

    def given(self, values: Mapping[str, float]) -> Array:
        """Return the point of given values of parameters, and the start values of the others."""
        parameters = self.structured.parameters
        names = [parameter.name for parameter in parameters]
        start = [parameter.value for parameter in parameters]
        for name, value in values.items():
            if name not in names:
                raise InputError(
                    f"start has the parameter {name!r}, which the structure does not have; give "
                    f"values of {', '.join(names)}"
                )
            index = names.index(name)
            start[index] = checked_number(name, value)
            _require_allowed(parameters[index], start[index])
        return self._point(start)

    def _point(self, values: Sequence[float]) -> Array:
        """Return the point of the values of all parameters."""
        x = np.zeros(self.size)
        for place, index in enumerate(self.free):
            x[place] = self.structured.parameters[index].coordinate(values[index])
        inside: Array = np.clip(x, *self.bounds)
        return inside

    def values(self, x: Array) -> tuple[Array, Array]:
        """Return the values of all parameters, and the derivatives of the free ones."""
        parameters = self.structured.parameters
        values = np.array([parameter.value for parameter in parameters])
        rates = np.zeros(len(self.free))
        for place, index in enumerate(self.free):
            values[index], rates[place] = parameters[index].at(float(x[place]))
        return values, rates

    def law(self, x: Array) -> Law:
        """Return the law at a point."""
        return self.structured.law(self.values(x)[0])

    def scaling(self, x: Array, index: int) -> Array:
        """Return the logarithms of the scalings of the channels of a goal."""
        place = self.scalings[index]
        if place is None:
            return np.zeros(0)
        return np.concatenate(([0.0], x[place]))

    def pieces(
        self, x: Array, case: Case, floors: Sequence[float] | None = None
    ) -> list[list[Piece]] | None:
        """Return the pieces of each goal for a plant, or None if the loop is unstable.

        Goals that are left out have no pieces. Peaks of gains below `floors` are not refined.
        """
        loops = case.loops(self.law(x))
        if loops is None:
            return None
        pieces: list[list[Piece]] = []
        for index, measure in enumerate(self.measures):
            if not self.is_counted[index]:
                pieces.append([])
                continue
            floor = floors[index] if floors is not None else 0.0
            ends, channel, loop = measure.ends, case.channels[index], loops[index]
            scaling = self.scaling(x, index)
            pieces.append(pieces_of(measure.goal, ends, channel, loop, scaling, floor))
        return pieces

    def evaluate(self, x: Array) -> list[Term] | None:
        """Return the logarithms of the values of all goals, or None if a loop is unstable."""
        rates = self.values(x)[1]
        terms: list[Term] = []
        floors = [
            _ROUGH * (1.0 if is_constraint else self._level)
            for is_constraint in self.is_constraint
        ]
        for number, case in enumerate(self.cases):
            pieces = self.pieces(x, case, floors)
            if pieces is None:
                return None
            for index, of_goal in enumerate(pieces):
                hard = self.is_constraint[index]
                for piece in of_goal:
                    if not math.isfinite(piece.value):
                        return None
                    if piece.value > _LEAST:
                        key = (number, index)
                        terms.append(self._term(piece, hard, key, rates))
        level = max((t.value for t in terms if not t.is_constraint), default=0.0)
        self._level = min(self._level, math.exp(min(level, 100.0)))
        return terms or [self._nothing()]

    def _nothing(self) -> Term:
        """Return the term of goals whose values are all smaller than the least value."""
        size = self.size
        return Term(math.log(_LEAST), False, None, math.nan, lambda: np.zeros(size))

    def _term(
        self, piece: Piece, hard: bool, key: tuple[int, int], rates: Array
    ) -> Term:
        place = self.scalings[key[1]]

        def gradient() -> Array:
            of_parameters, of_scaling = piece.gradient()
            result = np.zeros(self.size)
            result[: len(self.free)] = of_parameters[self.free] * rates
            if place is not None and len(of_scaling):
                result[place] = of_scaling[1:]
            return result / piece.value

        where = math.log(piece.where) if piece.where > 0.0 else piece.where
        value = math.log(piece.value)
        if hard:
            value += _TIGHT + float(self.tight[key[1]])
        return Term(value, hard, key, where, gradient)

    def abscissas(self, x: Array) -> list[Term] | None:
        """Return the real parts of the poles of all plants."""
        rates = self.values(x)[1]
        law = self.law(x)
        terms = []
        for number, case in enumerate(self.cases):
            loop = ClosedLoop(case.plant, law)
            if not loop.well_posed or not np.isfinite(loop.A).all():
                return None
            for piece in abscissa_pieces(loop):

                def gradient(piece: Piece = piece) -> Array:
                    result = np.zeros(self.size)
                    of_parameters = piece.gradient()[0]
                    result[: len(self.free)] = of_parameters[self.free] * rates
                    return result

                where = math.log(piece.where) if piece.where > 0.0 else piece.where
                terms.append(Term(piece.value, False, number, where, gradient))
        return terms

    def is_stable(self, x: Array) -> bool:
        """Return whether the loops of all plants are stable."""
        law = self.law(x)
        return all(case.loops(law) is not None for case in self.cases)


def _require_allowed(parameter: Parameter, value: float) -> None:
    """Raise `InputError` if a start value is outside the bounds, or its parameter is fixed."""
    room = _ROUNDING * max(abs(value), abs(parameter.value))
    if parameter.fixed and abs(value - parameter.value) > room:
        raise InputError(
            f"start has {parameter.name} = {value:g}, but the structure fixes it at "
            f"{parameter.value:g}; leave it out, or give the structure no value"
        )
    low, high = parameter.least, parameter.largest
    if not parameter.fixed and not low - room <= value <= high + room:
        raise InputError(
            f"start has {parameter.name} = {value:g}, expected {low:g} to {high:g}"
        )
