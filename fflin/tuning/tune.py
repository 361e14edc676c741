"""Tuning of a law of a given structure to goals, over one model, several, or uncertain ones."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from itertools import combinations
from typing import NamedTuple

import numpy as np

from fflin.base.errors import InputError, MissingPackageError, listed
from fflin.base.names import group_of
from fflin.base.process import Progress, in_one_thread
from fflin.base.validation import Array, ArrayLike, Values, count, instance, whole
from fflin.linear.model import Delay
from fflin.tuning.channels import ends_of, signals_in_use
from fflin.tuning.closed_loop import ClosedLoop
from fflin.tuning.criteria import Piece
from fflin.tuning.curves import GoalLoops
from fflin.tuning.goal_values import GoalValue, is_active, with_check
from fflin.tuning.goals import Goal
from fflin.tuning.hinf import hinf
from fflin.tuning.law import Law, Matrices, without_unused_states
from fflin.tuning.loop import sensor_delays, with_delayed_outputs
from fflin.tuning.minimal import reduction_of
from fflin.tuning.plant import Plant, Signals, plant_of, signals_of
from fflin.tuning.points import Point, Points, points_of
from fflin.tuning.problem import Case, Measure, Problem
from fflin.tuning.robust import UncertainLoop
from fflin.tuning.search import Minimum, minimise
from fflin.tuning.starts import Start, reached, searched, stabilised, step_texts
from fflin.tuning.structures import Structure, Structured
from fflin.tuning.tuned import Tuned
from fflin.tuning.verification import peak_above, second_value

# Goals limit the least factor if their value is nearer to the largest one than this fraction, or
# if their weight in the combination of gradients is larger than this number.
_LIMITING, _WEIGHT = 1e-2, 1e-3

# Steps of each search for a law that meets a few goals.
_FEW_GOALS = 60

# Rounds in which worst models are added.
_ROUNDS = 12

# A model is worse if a goal exceeds its value in the search, or its limit, by this factor.
_WORSE = 1.0 + 1e-4

# Peaks below this fraction of the largest known value are not refined.
_REFINED = 0.9

# Random models that are examined in all rounds but the last.
_FEW = 24

# A hard goal that holds in the search but not in the report is tightened so often, and only if it
# exceeds its limit by less than this factor.
_TIGHTENINGS, _NEARLY = 3, 1.05

# Factor by which such a goal is then below its limit.
_BELOW = 1.0 - 1e-6

# Number of random laws whose poles are added.
_RANDOM_LAWS = 3

# A pole of the plant is fixed if a test of Hautus has a smaller singular value.
_FIXED = 1e-9


@in_one_thread
def tune(
    plant: object,
    structure: Structure,
    goals: Goal | Sequence[Goal],
    *,
    dt: float | None = None,
    delay: Delay = 0.0,
    q: ArrayLike | None = None,
    starts: int = 3,
    steps: int = 300,
    seed: int = 0,
    start: Mapping[str, float] | None = None,
    progress: Callable[[str], object] | None = None,
) -> Tuned:
    """Tune the parameters of a law of a given structure to goals.

    The search minimises the largest value of the soft goals, while the hard goals hold. It is
    local: it starts several times, and stops at points where no small change improves all active
    goals.

    Parameters
    ----------
    plant : LinearModel, sequence of LinearModel, or Uncertain
        Model or models for which the goals must hold. For an `Uncertain`, the search begins with
        the nominal model. It adds the worst of the corners and of 200 random points of the ranges,
        until none of them is worse. Models without lags get the lags of the inputs and outputs of
        their robot.
    structure : Structure
        Structure of the law: `PD`, `PID`, `StaticGain`, `StateSpaceLaw`, `CustomLaw`, filters, sums
        and series.
    goals : Goal or sequence of Goal
        `MaxGain`, `RollOff`, `Margin`, `Decay`, `Damping`, `Variance` and `Track`.
    dt : float, optional
        Sample time of the law [s]: the plant is sampled with held inputs, and the law by Tustin's
        method. By default, the law is continuous, or has the sample time of the model.
    delay : float or mapping, optional
        Delay of the inputs [s] with `dt`; see `LinearModel.discretize`.
    q : array_like (nq,), optional
        Configuration of an `Uncertain`; neutral by default.
    starts : int
        Number of starts. The first one begins at the values of the structure, or for a
        `StateSpaceLaw` at the best law with one state less. If a `StaticGain` has no given values,
        the first start is a regulator of all states, projected to the outputs. It is followed in
        turn by a regulator with a random weight, a random gain of similar size, and random values.
        The other starts of other laws are random.
    steps : int
        Largest number of steps of each search.
    seed : int
        The same seed gives the same law, bit for bit.
    start : mapping, optional
        Values of parameters for the first start, {name: value}, such as `parameters` or `relaxed`
        of another result. The other parameters have the values of the structure.
    progress : callable, optional
        Function that is called with a text about the progress, often several times per second. By
        default, a line on stderr shows the text if stderr is a terminal.

    Returns
    -------
    Tuned
        Law with the values of its parameters and the report.

    Raises
    ------
    InputError
        If one of these conditions is true:

        - a signal of a goal or of the structure does not exist;
        - `start` has a parameter that the structure does not have, or a value outside its bounds;
        - a measured output has a `sample` other than `dt`, or a `delay` that is not a multiple of
          `dt`;
        - a model holds only at one time, as in an elliptic orbit;
        - no start reaches a stable loop, for example because no law can move an unstable pole;
        - the variance of a goal is infinite, because noise reaches its output without a lag.

    References
    ----------
    P. Apkarian and D. Noll, Nonsmooth H-infinity synthesis, IEEE Transactions on Automatic Control
    51(1), 2006.

    Examples
    --------
    >>> lin = fflin.linearize(fflin.load("planar_detumble"))
    >>> law = fflin.PD("q_b", "tau_b", rates="omega_b")
    >>> goals = [fflin.MaxGain({"tau_b": 0.01}, {"q_b": 0.05}), fflin.Margin(0.8, hard=True)]
    >>> tuned = fflin.tune(lin, law, goals, starts=1)
    >>> tuned.met
    True
    """
    started = time.process_time()
    _require_structure(structure)
    every = [goals] if isinstance(goals, Goal) else goals
    if not isinstance(every, Sequence) or not every:
        raise InputError(f"goals are {goals!r}, expected one goal or more")
    for goal in every:
        instance("goal", goal, Goal, "a goal, such as fflin.MaxGain")
    starts = count("starts", starts, largest=1000)
    steps = count("steps", steps, largest=100_000)
    seed = whole("seed", seed, 0)
    instance("start", start or {}, Mapping, "{name: value}")
    with closing(Progress()) as line:
        say = line.say if progress is None else progress
        say("models of the plant")
        points = points_of(plant, dt, delay, seed, q)
        task = _Task(structure, every, points, say)
        search = _Search(starts, steps, seed)
        problem, minimum, values = task.first(search, start)
        problem, minimum = task.with_worst(problem, minimum, steps)
        problem, minimum, figures = task.checked(problem, minimum, steps)
        solution = task.relaxed(problem, minimum, figures, search)
        seconds = time.process_time() - started
        return task.result(solution, values, seconds)


class _Search(NamedTuple):
    """Number of starts, number of steps of each start, and seed."""

    starts: int
    steps: int
    seed: int


@dataclass(frozen=True, eq=False)
class _Worst:
    """Largest value of a goal, the model where it occurs, and its piece."""

    value: float
    point: Point
    case: Case
    piece: Piece | None
    check: float = math.nan

    @property
    def larger(self) -> float:
        """The larger of the value and its check."""
        return with_check(self.value, self.check)


class _Solution(NamedTuple):
    """Law with its figures, the least factor by which all goals would hold, and its law."""

    problem: Problem
    minimum: Minimum
    figures: list[_Worst]
    factor: float
    relaxed: Array
    conflict: tuple[str, ...] = ()


class _Task:
    """Search of a structure, goals and models."""

    def __init__(
        self,
        structure: Structure,
        goals: Sequence[Goal],
        points: Points,
        say: Callable[[str], object],
    ) -> None:
        self.points = points
        self.say = say
        lin = points.nominal
        self.lin = lin
        self.signals: Signals = signals_of(lin)
        self.structured = Structured(structure, self.signals)
        measured, commanded = self.structured.used
        self.delays = sensor_delays(lin, measured)
        self.measures = [
            Measure(
                goal,
                ends_of(goal, self.signals, lin.state_names, measured, commanded),
            )
            for goal in goals
        ]
        for measure in self.measures:
            if lin.dt and measure.ends is not None:
                _require_slow(measure, lin.dt)
        used, inputs = signals_in_use(
            [measure.ends for measure in self.measures],
            measured,
            commanded,
            len(lin.output_names) + len(lin.state_names),
        )
        models = [
            self._matrices(point) for point in (*points.fixed, *points.candidates)
        ]
        self.reduction = reduction_of(models, lin.dt, used, inputs)
        if not self.reduction.size:
            longer = f", or a longer dt than {lin.dt:g} s" if lin.dt else ""
            raise InputError(
                "no mode of the model depends on the inputs of the law and the goals and changes "
                f"their outputs; give other signals{longer}"
            )
        self.cases: dict[int, Case] = {}
        self.chosen: list[Point] = list(points.fixed)
        self.tight: Array = np.zeros(len(self.measures))

    def case(self, point: Point) -> Case:
        """Return the plant of a model with the channels of the goals."""
        key = id(point)
        if key not in self.cases:
            self.cases[key] = Case(self.plant(point), self.measures)
        return self.cases[key]

    def plant(self, point: Point) -> Plant:
        """Return the plant of a model."""
        return plant_of(self._matrices(point), self.lin.dt, self.reduction)

    def _matrices(self, point: Point) -> Matrices:
        """Return the matrices of a model with the delays of the measured outputs."""
        return with_delayed_outputs(point.matrices, self.delays)

    def problem(self, objective: Sequence[int] | None = None) -> Problem:
        """Return the problem of the models that are chosen, and maybe of a few goals."""
        cases = [self.case(point) for point in self.chosen]
        tight = self.tight.copy()
        return Problem(self.structured, self.measures, cases, tight, objective)

    def first(
        self, search: _Search, start: Mapping[str, float] | None
    ) -> tuple[Problem, Minimum, tuple[Start, ...]]:
        """Search from several starts, and return the best result and the values of all."""
        problem = self.problem()
        given = None if start is None else problem.given(start)
        best, values = searched(problem, *search, self.say, first=given)
        if best is None:
            raise InputError(self._why_unstable(problem, search.starts))
        return problem, best, values

    def with_worst(
        self,
        problem: Problem,
        minimum: Minimum,
        steps: int,
        *,
        objective: Sequence[int] | None = None,
        stable: Array | None = None,
        target: float = -math.inf,
    ) -> tuple[Problem, Minimum]:
        """Add the worst models until none is worse, and return the last problem and result.

        If no stable loop is found from the result, the search continues from `stable`.
        """
        candidates = self.points.candidates
        few = candidates[: self.points.corners + _FEW]
        for _ in range(_ROUNDS):
            added, values = self._worse(problem, minimum.x, few)
            if not added:
                added, values = self._worse(problem, minimum.x, candidates)
            if not added and not self._watch_missed(problem, minimum.x, values):
                break
            self.chosen += added
            problem = self.problem(objective)
            start = stabilised(problem, minimum.x)
            if start is None and stable is not None:
                start = stabilised(problem, stable)
            if start is None:
                raise InputError(
                    "no law of this structure was found that stabilises all models; give narrower "
                    "ranges, or another structure"
                )
            on_step = step_texts(self.say, f"search with {len(self.chosen)} models")
            more = minimise(
                problem.evaluate,
                start,
                problem.bounds,
                steps=steps,
                target=target,
                on_step=on_step,
            )
            minimum = more.after(minimum)
        return problem, minimum

    def _watch_missed(self, problem: Problem, x: Array, known: list[float]) -> bool:
        """Return whether a gain exceeds its limit, or its largest known value, at any model.

        The frequencies of such gains are then watched, and the worst models are added to the
        search.
        """
        soft = _objective_level(problem, known)
        levels = []
        for value, measure in zip(known, self.measures, strict=True):
            limit = 1.0 if measure.goal.hard else min(soft, 1.0)
            levels.append(_WORSE * max(value, limit))
        law = problem.law(x)
        missed: dict[int, tuple[float, Point]] = {}
        points = (*self.points.fixed, *self.points.candidates)
        for number, point in enumerate(points, 1):
            self.say(f"gains of model {number} of {len(points)} at all frequencies")
            case = self.case(point)
            for index, loop in enumerate(case.loops(law) or []):
                if not problem.is_counted[index]:
                    continue
                measure, scaling = self.measures[index], problem.scaling(x, index)
                goal, ends, channel = measure.goal, measure.ends, case.channels[index]
                peak = peak_above(goal, ends, channel, loop, scaling, levels[index])
                if peak is None or ends is None:
                    continue
                gain, frequency = peak
                ends.watched.append(frequency)
                if index not in missed or gain > missed[index][0]:
                    missed[index] = gain, point
        for _, point in missed.values():
            if point not in self.chosen:
                self.chosen.append(point)
        return bool(missed)

    def _worse(
        self, problem: Problem, x: Array, candidates: Sequence[Point]
    ) -> tuple[list[Point], list[float]]:
        """Return the worst model of each goal among candidates, if it is worse than all chosen.

        The second result contains the largest values of the goals over all of these models.
        """
        known = [worst.value for worst in self.worst(problem, x, self.chosen)]
        level = _objective_level(problem, known)
        added: list[Point] = []
        others = [point for point in candidates if point not in self.chosen]
        largest = list(known)
        for index, worst in enumerate(self.worst(problem, x, others)):
            limit = 1.0 if problem.is_constraint[index] else level
            if worst.value > limit * _WORSE and worst.point not in added:
                added.append(worst.point)
            largest[index] = max(largest[index], worst.value)
        return added, largest

    def worst(
        self, problem: Problem, x: Array, points: Sequence[Point]
    ) -> list[_Worst]:
        """Return the largest value of each goal over models."""
        results: list[_Worst | None] = [None] * len(self.measures)
        for number, point in enumerate(points, 1):
            self.say(f"goals of model {number} of {len(points)}")
            case = self.case(point)
            floors = [
                0.0 if known is None else _REFINED * known.value for known in results
            ]
            pieces = problem.pieces(x, case, floors)
            for index in range(len(self.measures)):
                value, piece = math.inf, None
                if not problem.is_counted[index]:
                    value = 0.0
                elif pieces is not None:
                    piece = pieces[index][0]
                    value = piece.value
                known = results[index]
                if known is None or value > known.value:
                    results[index] = _Worst(value, point, case, piece)
        return [result for result in results if result is not None]

    @property
    def examined(self) -> list[Point]:
        """All models, each once."""
        every = [*self.chosen, *self.points.candidates]
        return list({id(point): point for point in every}.values())

    def figures(self, problem: Problem, x: Array) -> list[_Worst]:
        """Return the largest value of each goal over all models, and its check."""
        law = problem.law(x)
        figures = []
        for index, worst in enumerate(self.worst(problem, x, self.examined)):
            measure, channel = self.measures[index], worst.case.channels[index]
            loops = worst.case.loops(law)
            check = None
            if loops is not None and worst.piece is not None:
                check = second_value(measure.goal, measure.ends, channel, loops[index])
            figures.append(worst if check is None else replace(worst, check=check))
        return figures

    def checked(
        self, problem: Problem, minimum: Minimum, steps: int
    ) -> tuple[Problem, Minimum, list[_Worst]]:
        """Return the problem, the result and its figures.

        A hard goal that holds in the search can exceed its limit a little in the check, or at a
        model that is not in the search. It is then tightened, and the search continues.
        """
        figures = self.figures(problem, minimum.x)
        for _ in range(_TIGHTENINGS):
            if minimum.violation > 0.0 or not self._tighten(figures):
                break
            problem = self.problem()
            on_step = step_texts(self.say, "search with tightened hard goals")
            more = minimise(
                problem.evaluate,
                minimum.x,
                problem.bounds,
                steps=steps,
                on_step=on_step,
            )
            problem, minimum = self.with_worst(problem, more.after(minimum), steps)
            figures = self.figures(problem, minimum.x)
        return problem, minimum, figures

    def _tighten(self, figures: Sequence[_Worst]) -> bool:
        """Tighten the hard goals that nearly hold, and return whether there are any."""
        if all(measure.goal.hard for measure in self.measures):
            return False
        nearly = np.array(
            [
                measure.goal.hard and 1.0 < worst.larger < _NEARLY
                for measure, worst in zip(self.measures, figures, strict=True)
            ]
        )
        excess = np.log([max(worst.larger, 1.0) / _BELOW for worst in figures])
        self.tight = np.where(nearly, self.tight + excess, self.tight)
        return bool(nearly.any())

    def relaxed(
        self,
        problem: Problem,
        minimum: Minimum,
        figures: list[_Worst],
        search: _Search,
    ) -> _Solution:
        """Return the law, the least factor by which all goals would hold, and why it is above 1.

        If the search for this factor finds a law that meets all goals, the search for the best law
        continues from it.
        """
        factor = _largest(figures)
        if factor <= 1.0:
            return _Solution(problem, minimum, figures, factor, minimum.x)
        every = range(len(self.measures))
        loose, easiest, loose_figures = problem, minimum, figures
        if any(problem.is_constraint):
            loose = self.problem(every)
            self.say("search for the least factor")
            found, _ = searched(loose, *search, self.say, others=[minimum.x])
            assert found is not None
            loose, easiest = self.with_worst(
                loose, found, search.steps, objective=every, stable=minimum.x
            )
            loose_figures = self.figures(loose, easiest.x)
        least = _largest(loose_figures)
        if least <= 1.0:
            return self._continued(easiest, loose_figures, search.steps)
        if least > factor:
            easiest, least = minimum, factor
        conflict = self._conflict(easiest, loose_figures, minimum.x, search)
        return _Solution(problem, minimum, figures, least, easiest.x, conflict)

    def _continued(
        self, start: Minimum, figures: list[_Worst], steps: int
    ) -> _Solution:
        """Return the best law that is found from a law that meets all goals."""
        problem = self.problem()
        on_step = step_texts(self.say, "search from a law that meets all goals")
        more = minimise(
            problem.evaluate, start.x, problem.bounds, steps=steps, on_step=on_step
        )
        problem, better = self.with_worst(
            problem, more.after(start), steps, stable=start.x
        )
        problem, better, better_figures = self.checked(problem, better, steps)
        factor = _largest(better_figures)
        if factor <= 1.0:
            return _Solution(problem, better, better_figures, factor, better.x)
        return _Solution(problem, start, figures, _largest(figures), start.x)

    def result(
        self, solution: _Solution, starts: tuple[Start, ...], seconds: float
    ) -> Tuned:
        """Return the tuned law with its report."""
        problem, minimum, worst = solution[:3]
        law = problem.law(minimum.x)
        level = _objective_level(problem, [found.value for found in worst])
        uncertain = None
        if self.points.lft is not None:
            uncertain = UncertainLoop(self.points.lft, law, self.reduction)
        goals = []
        for found, measure in zip(worst, self.measures, strict=True):
            where = math.nan if found.piece is None else found.piece.where
            hard = measure.goal.hard
            active = is_active(found.value, hard, level)
            bound = math.nan
            no_bound = ""
            if uncertain is not None:
                self.say(f"bound over the whole ranges: {measure.goal.label}")
                bound, no_bound = uncertain.bound(
                    measure.goal, measure.ends, found.larger
                )
            goals.append(
                GoalValue(
                    measure.goal.label,
                    hard,
                    found.value,
                    found.check,
                    where,
                    dict(found.point.parameters),
                    active,
                    self._least(measure.goal),
                    bound,
                    no_bound,
                )
            )
        parameters = self.structured.parameters
        return Tuned(
            law,
            self.lin,
            parameters=self._named(problem, minimum.x),
            units={p.name: p.unit for p in parameters},
            goals=tuple(goals),
            factor=solution.factor,
            relaxed=self._named(problem, solution.relaxed),
            conflict=solution.conflict,
            stationarity=minimum.stationarity,
            points=tuple(dict(point.parameters) for point in self.chosen),
            examined=len(self.examined),
            starts=tuple(start.value for start in starts),
            reached=reached(starts),
            seconds=seconds,
            remarks=self.reduction.remarks,
            history=np.exp(np.array(minimum.history).reshape(-1, 2)),
            parameter_history=np.array(
                [problem.values(x)[0] for x in minimum.path]
            ).reshape(-1, len(parameters)),
            loops=self.loops(problem, minimum.x, law),
        )

    def _named(self, problem: Problem, x: Array) -> dict[str, float]:
        """Return the values of all parameters at a point."""
        names = [parameter.name for parameter in self.structured.parameters]
        return dict(zip(names, problem.values(x)[0].tolist(), strict=True))

    def loops(self, problem: Problem, x: Array, law: Law) -> tuple[GoalLoops, ...]:
        """Return the loops of each goal in the models of the search."""
        cases = [
            (self.case(point), self.case(point).loops(law)) for point in self.chosen
        ]
        results = []
        for index, measure in enumerate(self.measures):
            loops = tuple(
                (of_goals[index], case.channels[index])
                for case, of_goals in cases
                if of_goals is not None
            )
            scaling = problem.scaling(x, index)
            results.append(GoalLoops(measure.goal, measure.ends, loops, scaling))
        return tuple(results)

    def _least(self, goal: Goal) -> float:
        """Return the norm of full order of a goal that `hinf` accepts, or NaN."""
        self.say(f"least value of all controllers: {goal.label}")
        measured, commanded = self.structured.used
        outputs = [self.signals.outputs[index] for index in measured]
        inputs = [self.signals.inputs[index] for index in commanded]
        try:
            return hinf(self.lin, goal, measured=outputs, inputs=inputs).gamma
        except (InputError, MissingPackageError):
            return math.nan

    def _conflict(
        self,
        easiest: Minimum,
        figures: list[_Worst],
        other: Array,
        search: _Search,
    ) -> tuple[str, ...]:
        """Return the fewest goals that were not met together, among those that limit the factor.

        The result is one goal, two goals that contradict each other, or goals that are met two at a
        time but not together. `figures` belong to the law `easiest` of the least factor, and
        `other` is the best law with the hard goals as constraints.
        """
        weights: dict[int, float] = {}
        for key, weight in (easiest.weights or {}).items():
            if not isinstance(key, tuple):
                continue
            index = key[1]
            weights[index] = weights.get(index, 0.0) + weight
        near = (1.0 - _LIMITING) * _largest(figures)
        limiting = [
            index
            for index, figure in enumerate(figures)
            if weights.get(index, 0.0) > _WEIGHT or figure.larger >= near
        ]
        limiting.sort(key=lambda index: -weights.get(index, 0.0))
        groups = [*combinations(limiting, 1), *combinations(limiting, 2)]
        unmet = next(
            (
                group
                for group in groups
                if len(group) < len(limiting)
                and not self._is_met(group, [easiest.x, other], search)
            ),
            tuple(limiting),
        )
        return tuple(self.measures[index].goal.label for index in unmet)

    def _is_met(
        self, group: tuple[int, ...], points: list[Array], search: _Search
    ) -> bool:
        """Return whether a search finds a law that meets a few goals at all models.

        The searches begin at points, and at the other starts. Laws that are found are appended to
        the points.
        """
        labels = " and ".join(self.measures[index].goal.label for index in group)
        self.say(f"search for a law that meets {labels}")
        problem = self.problem(group)
        few = search._replace(steps=min(search.steps, _FEW_GOALS))
        target = math.log(_BELOW)
        best, _ = searched(problem, *few, self.say, others=points, target=target)
        if best is None or best.objective > 0.0:
            return False
        problem, best = self.with_worst(
            problem, best, few.steps, objective=group, stable=points[0], target=target
        )
        points.append(best.x)
        return _largest(self.figures(problem, best.x)) <= 1.0

    def _has_no_damping(self, problem: Problem) -> bool:
        """Return whether no law is stable because of the sum of the poles of its loop.

        The sum of the poles, or of their inverses, is the same for all laws if it is the same at
        random parameters. If it is not negative, some real parts are not negative.
        """
        plant = problem.cases[0].plant
        poles = []
        for seed in range(_RANDOM_LAWS):
            law = problem.law(problem.start(np.random.default_rng(seed)))
            loop = ClosedLoop(plant, without_unused_states(law))
            if not loop.well_posed or not np.isfinite(loop.A).all():
                return False
            poles.append(loop.poles)
        rows: Values = np.array(poles)
        if _sum_never_changes(rows):
            return True
        return bool(rows.all()) and _sum_never_changes(np.reciprocal(rows))

    def _without_damping(self, commanded: Sequence[int]) -> str:
        """Return that a law has no damping, and which rates it can measure."""
        signals = self.signals
        rates = []
        for index, name in enumerate(signals.outputs):
            responses = [signals.response(index, command) for command in commanded]
            if any(gain and order == 1 for gain, order in responses):
                rates.append(group_of(name) or name)
        advice = "add an output of rates, such as fflin.Gyroscope, to the robot"
        if rates:
            advice = f"measure rates, such as {listed(rates)}"
        return (
            "no law of this structure is stable: the sum of the poles of the loop, or of their "
            f"inverses, is never negative, so the law adds no damping; {advice}, or use a PD whose "
            "kd is not 0"
        )

    def _why_unstable(self, problem: Problem, starts: int) -> str:
        """Return why no start was stable."""
        plant = problem.cases[0].plant
        poles = np.linalg.eigvals(plant.A)
        measured, commanded = self.structured.used
        for pole in poles[poles.real >= -1e-9 * np.abs(poles).max(initial=0.0)]:
            inner = plant.A - pole * np.eye(len(plant.A))
            size = np.abs(plant.A).max(initial=1.0)
            tests = {
                "the inputs of the structure cannot move": np.hstack(
                    (inner, plant.B[:, list(commanded)])
                ),
                "the measured outputs do not contain": np.vstack(
                    (inner, plant.C[list(measured)])
                ).T,
            }
            for reason, matrix in tests.items():
                scales = np.linalg.norm(matrix, axis=0)
                scaled = matrix / np.where(scales > 0.0, scales, 1.0)
                if np.linalg.svd(scaled, compute_uv=False)[-1] < _FIXED * size:
                    return (
                        f"no law of this structure is stable: {reason} the pole {pole:.3g} of the "
                        "plant; give other inputs or outputs, or goals without the states of this "
                        "pole"
                    )
        if self._has_no_damping(problem):
            return self._without_damping(commanded)
        models = len(problem.cases)
        loop = (
            "a stable loop" if models == 1 else f"stable loops of all {models} models"
        )
        return (
            f"none of {starts} starts reached {loop}; give another bandwidth= of a PD or PID, "
            "start values (start= or fflin.Tunable), more starts, or another structure"
        )


def _sum_never_changes(poles: Values) -> bool:
    """Return whether the sums of rows of poles are equal, and not negative.

    Differences below a fraction of the magnitudes of the poles are rounding errors.
    """
    sums = poles.sum(axis=1).real
    rounding = _FIXED * np.abs(poles).sum(axis=1).max()
    return bool(np.ptp(sums) <= rounding and sums.min() >= -rounding)


def _largest(figures: Sequence[_Worst]) -> float:
    """Return the largest value of all goals."""
    return max(figure.larger for figure in figures)


def _objective_level(problem: Problem, values: Sequence[float]) -> float:
    """Return the largest value of the goals that are the objective."""
    return max(
        value
        for value, is_constraint in zip(values, problem.is_constraint, strict=True)
        if not is_constraint
    )


def _require_structure(structure: object) -> None:
    """Raise `InputError` unless the structure of a law is one structure."""
    if isinstance(structure, list | tuple):
        raise InputError(
            f"structure is a {type(structure).__name__}, expected one structure, such as "
            "fflin.PD('q_b', 'tau_b'); write sums of structures as a + b, and series as a * b"
        )
    if isinstance(structure, type):
        raise InputError(
            f"structure is the class {structure.__name__}, expected an object, such as "
            "fflin.PD('q_b', 'tau_b')"
        )
    instance(
        "structure",
        structure,
        Structure,
        "a structure of a law, such as fflin.PD('q_b', 'tau_b')",
    )


def _require_slow(measure: Measure, dt: float) -> None:
    """Raise `InputError` if a goal is about frequencies above half the sample rate."""
    assert measure.ends is not None
    low = measure.ends.band[0]
    if low >= math.pi / dt:
        raise InputError(
            f"the goal '{measure.goal.label}' begins at {low:g} rad/s, but the law is sampled at "
            f"{dt:g} s, half of whose rate is {math.pi / dt:.3g} rad/s; give a lower frequency"
        )
