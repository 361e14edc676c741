"""Starts of a search: given values, regulators, simpler laws and random values."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from itertools import chain
from typing import NamedTuple

import numpy as np

from fflin.base.validation import Array
from fflin.tuning.problem import Problem
from fflin.tuning.search import Minimum, OnStep, Term, minimise

# Largest number of steps of the search for a stable loop.
_STABILISING = 150

# Steps of each start; the best one is then continued.
_SCREENING = 60

# Decades by which the weight of the commands of a regulator is larger or smaller, at random.
_DECADES = 2.0

# Decades by which a random gain is larger than the gain of a regulator.
_SIZES = -0.5, 1.5

# Weights that make the equations of a regulator solvable, relative to the others.
_SMALL = 1e-6

# Hard goals hold if they exceed their limits by less than this number, in the logarithm.
_HOLDS = 1e-6

# Starts reached the best value if their value is larger by at most this factor.
_NEAR = 1.01


class Start(NamedTuple):
    """Largest value of the soft goals at the end of a start, or of the missed hard goals.

    The value is infinite if no stable loop was found.
    """

    value: float
    holds: bool


def reached(starts: Sequence[Start]) -> int:
    """Return how many starts reached the best value within 1 %."""
    if not starts:
        return 0
    best = min(starts, key=lambda start: (not start.holds, start.value))
    return sum(
        start.holds == best.holds
        and math.isfinite(start.value)
        and start.value <= _NEAR * best.value
        for start in starts
    )


def searched(
    problem: Problem,
    starts: int,
    steps: int,
    seed: int,
    say: Callable[[str], object] | None = None,
    *,
    first: Array | None = None,
    others: Sequence[Array] = (),
    target: float = -math.inf,
) -> tuple[Minimum | None, tuple[Start, ...]]:
    """Search from several starts, and return the best result and the values of all.

    The best result has the least soft value of all results whose hard goals hold. If no result
    holds them all, the best one misses them least.

    The first start of a law with states is the best law with one state less, so that a law of a
    higher order is never worse. `first` is another point for the first start. `others` are further
    starts, before all others. The search ends if all values are at most `target`. `say` is called
    in each step with a text about the progress.
    """
    total = starts + len(others)
    screening = min(steps, _SCREENING) if total > 1 else steps
    best: Minimum | None = None
    values: list[Start] = []
    every = chain(others, _starts(problem, starts, steps, seed, say, first))
    for number, start in enumerate(every):
        x = None if start is None else stabilised(problem, start)
        on_step = step_texts(say, f"start {number + 1} of {total}")
        end = Start(math.inf, False)
        if x is not None:
            minimum = minimise(
                problem.evaluate,
                x,
                problem.bounds,
                steps=screening,
                target=target,
                on_step=on_step,
            )
            end = _end_of(minimum)
            if best is None or _is_better(minimum, best):
                best = minimum
        values.append(end)
        if end.holds and end.value <= math.exp(target):
            return best, tuple(values)
    if best is not None and best.steps == _SCREENING and steps > _SCREENING:
        on_step = step_texts(say, "best start")
        more = minimise(
            problem.evaluate,
            best.x,
            problem.bounds,
            steps=steps,
            target=target,
            on_step=on_step,
        )
        best = more.after(best)
    return best, tuple(values)


def step_texts(say: Callable[[str], object] | None, search: str) -> OnStep | None:
    """Return a function that says the step of a search and its largest value."""
    if say is None:
        return None

    def on_step(number: int, level: float) -> None:
        value = math.exp(min(level, 100.0))
        say(f"{search}, step {number}: largest value {value:.4g}")

    return on_step


def stabilised(problem: Problem, x: Array) -> Array | None:
    """Return a point whose loops are all stable, found from x; None if there is none."""
    if problem.evaluate(x) is not None:
        return x
    if problem.abscissas(x) is None:
        return None

    def is_stable(terms: list[Term]) -> bool:
        return max(term.value for term in terms) < 0.0

    minimum = minimise(
        problem.abscissas, x, problem.bounds, steps=_STABILISING, is_done=is_stable
    )
    if problem.evaluate(minimum.x) is None:
        return None
    return minimum.x


def _starts(
    problem: Problem,
    starts: int,
    steps: int,
    seed: int,
    say: Callable[[str], object] | None,
    given: Array | None,
) -> Iterator[Array | None]:
    """Yield the starts of a search.

    The first one is `given`, or has the values of the structure. If the law can be a static gain,
    the first one is a projected regulator. It is followed in turn by a regulator with a random
    weight, a random gain of the size of the regulator, and random parameters. For other laws, all
    other starts have random parameters.
    """
    has_gain = problem.structured.has_gain
    for number in range(starts):
        rng = np.random.default_rng([seed, number])
        if number == 0 and given is not None:
            yield given
        elif number == 0:
            first = _simpler(problem, starts, steps, seed, say)
            if first is None and has_gain:
                first = _regulator(problem, None)
            yield problem.start() if first is None else first
        elif has_gain and number % 3 == 1:
            yield _regulator(problem, rng)
        elif has_gain and number % 3 == 2:
            yield _random_gain(problem, rng)
        else:
            yield problem.start(rng)


def _simpler(
    problem: Problem,
    starts: int,
    steps: int,
    seed: int,
    say: Callable[[str], object] | None,
) -> Array | None:
    """Return the point of the best simpler law, or None."""
    simple = problem.simpler
    if simple is None:
        return None
    # The simplest law is searched from all starts, and each other law from the next simpler law.
    few = starts if simple.simpler is None else 1
    best = searched(simple, few, min(steps, _SCREENING), seed, say)[0]
    return None if best is None else problem.extended(simple, best.x)


def _random_gain(problem: Problem, rng: np.random.Generator) -> Array | None:
    """Return the point of a random gain, whose rows and columns have sizes as of a regulator."""
    regulator = _regulator_gain(problem, None)
    if regulator is None:
        return None
    rows = np.linalg.norm(regulator, axis=1)
    columns = np.linalg.norm(regulator, axis=0)
    size = 10.0 ** rng.uniform(*_SIZES) / max(float(np.linalg.norm(rows)), 1e-300)
    random = rng.standard_normal(regulator.shape)
    return problem.of_gain(size * np.outer(rows, columns) * random)


def _regulator(problem: Problem, rng: np.random.Generator | None) -> Array | None:
    """Return the point of a projected regulator."""
    gain = _regulator_gain(problem, rng)
    return None if gain is None else problem.of_gain(gain)


def _regulator_gain(problem: Problem, rng: np.random.Generator | None) -> Array | None:
    """Return the gain of a regulator of all states, projected to the measured outputs.

    The regulator minimises the outputs of all goals. Its gain F becomes ``K = F P C' (C P C')^-1``
    with the covariance P of its loop under the inputs of all goals, so that K y is the best linear
    estimate of F x from the measured outputs y. With `rng`, the weight of the commands is random.
    Products of a state and a command in the outputs of the goals are neglected.
    """
    from scipy.linalg import solve_continuous_are, solve_continuous_lyapunov

    case = problem.cases[0]
    measured, commanded = problem.structured.used
    plant = case.plant
    A, B, C = plant.A, plant.B[:, list(commanded)], plant.C[list(measured)]
    n, nu = B.shape
    if not n:
        return None
    cost = _SMALL * np.eye(n)
    effort = _SMALL * np.eye(nu)
    noise = _SMALL * np.eye(n)
    for channel in case.channels:
        if channel is None or channel.plant is not plant:
            continue
        D12 = channel.D12[:, list(commanded)]
        cost = cost + channel.C1.T @ channel.C1
        effort = effort + D12.T @ D12
        noise = noise + channel.B1 @ channel.B1.T
    if rng is not None:
        effort = effort * 10.0 ** rng.uniform(-_DECADES, _DECADES)
    try:
        X = solve_continuous_are(A, B, cost, effort)
        F = -np.linalg.solve(effort, B.T @ X)
        P = solve_continuous_lyapunov(A + B @ F, -noise)
        gain = F @ P @ C.T @ np.linalg.pinv(C @ P @ C.T, rcond=1e-10)
    except (np.linalg.LinAlgError, ValueError):
        return None
    if not np.isfinite(gain).all():
        return None
    projected: Array = gain
    return projected


def _end_of(minimum: Minimum) -> Start:
    """Return the value of a result, and whether its hard goals hold."""
    if minimum.violation <= _HOLDS:
        return Start(math.exp(minimum.objective), True)
    return Start(math.exp(minimum.violation), False)


def _is_better(minimum: Minimum, other: Minimum) -> bool:
    """Return whether a result is better: first its hard goals, then its value."""
    end, known = _end_of(minimum), _end_of(other)
    if end.holds != known.holds:
        return end.holds
    return end.value < known.value
