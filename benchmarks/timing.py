"""Times of several functions, measured side by side."""

import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

SAMPLE_SECONDS, CASE_SECONDS = 1e-3, 3.0
FEWEST_ROUNDS, MOST_ROUNDS = 9, 101


@dataclass(frozen=True)
class Times:
    """Samples of one function [s], taken in turns with those of the others.

    The least is what the function costs; the others hold what else the machine did.
    """

    samples: tuple[float, ...]

    @property
    def least(self) -> float:
        return min(self.samples)

    def per(self, count: int) -> "Times":
        """Return the times of one of `count` equal parts of the function's work."""
        return Times(tuple(sample / count for sample in self.samples))

    def ratio(self, other: "Times") -> float:
        return self.least / other.least

    def ratios(self, other: "Times") -> tuple[float, float, float]:
        """Return the least, the median and the largest ratio of the rounds."""
        each = [a / b for a, b in zip(self.samples, other.samples, strict=True)]
        return min(each), statistics.median(each), max(each)


def interleaved(functions: Mapping[str, Callable[[], object]]) -> dict[str, Times]:
    """Time functions in turns, so that a machine that is busy for a while is so for all."""
    once = {name: _once(function) for name, function in functions.items()}
    loops = {
        name: max(1, min(2000, round(SAMPLE_SECONDS / each)))
        for name, each in once.items()
    }
    round_seconds = sum(loops[name] * once[name] for name in functions)
    # What takes seconds is measured by three rounds.
    fewest = FEWEST_ROUNDS if round_seconds < CASE_SECONDS else 3
    rounds = max(fewest, min(MOST_ROUNDS, round(CASE_SECONDS / round_seconds)))
    samples: dict[str, list[float]] = {name: [] for name in functions}
    for _ in range(rounds):
        for name, function in functions.items():
            samples[name].append(_sample(function, loops[name]))
    return {name: Times(tuple(taken)) for name, taken in samples.items()}


def beside(
    floor: Callable[[], object],
    functions: Mapping[str, Callable[[], object]],
    rounds: int,
) -> dict[str, tuple[Times, Times]]:
    """Time functions that take long, once a round, and a floor before and after each of them.

    Returns the times of each, and those of the floor beside it.
    """
    samples: dict[str, list[tuple[float, float]]] = {name: [] for name in functions}
    for _ in range(rounds):
        before = _sample(floor, 1)
        for name, function in functions.items():
            taken, after = _sample(function, 1), _sample(floor, 1)
            samples[name].append((taken, (before + after) / 2.0))
            before = after
    return {
        name: (Times(tuple(own)), Times(tuple(of_floor)))
        for name, pairs in samples.items()
        for own, of_floor in [zip(*pairs, strict=True)]
    }


def _sample(function: Callable[[], object], loops: int) -> float:
    start = time.perf_counter()
    for _ in range(loops):
        function()
    return (time.perf_counter() - start) / loops


def _once(function: Callable[[], object]) -> float:
    first = _sample(function, 1)  # which pays for what is prepared once
    again = (_sample(function, 1) for _ in range(3 if first < 1.0 else 0))
    return max(1e-9, min(again, default=first))
