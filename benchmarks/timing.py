"""Times of several functions, measured side by side."""

import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

SAMPLE_SECONDS, CASE_SECONDS = 2e-3, 3.0
FEWEST_ROUNDS, MOST_ROUNDS = 7, 41


@dataclass(frozen=True)
class Times:
    """Samples of one function [s], taken in turns with those of the others."""

    samples: tuple[float, ...]

    @property
    def median(self) -> float:
        return statistics.median(self.samples)

    def ratio(self, other: "Times") -> float:
        """Median of this one's time over the other's, each pair taken one after the other."""
        return statistics.median(
            mine / theirs for mine, theirs in zip(self.samples, other.samples, strict=True)
        )


def interleaved(functions: Mapping[str, Callable[[], object]]) -> dict[str, Times]:
    """Time functions in turns, so that a machine that is busy for a while is so for all.

    Of the rounds the quicker half is kept: in the others the machine was at something else.
    """
    once = {name: _once(function) for name, function in functions.items()}
    loops = {name: max(1, min(2000, round(SAMPLE_SECONDS / each))) for name, each in once.items()}
    round_seconds = sum(loops[name] * once[name] for name in functions)
    rounds = max(FEWEST_ROUNDS, min(MOST_ROUNDS, round(CASE_SECONDS / round_seconds)))
    taken = [
        {name: _sample(functions[name], loops[name]) for name in functions} for _ in range(rounds)
    ]
    taken.sort(key=lambda samples: sum(samples[name] * loops[name] for name in functions))
    kept = taken[: rounds // 2 + 1]
    return {name: Times(tuple(samples[name] for samples in kept)) for name in functions}


def _sample(function: Callable[[], object], loops: int) -> float:
    start = time.perf_counter()
    for _ in range(loops):
        function()
    return (time.perf_counter() - start) / loops


def _once(function: Callable[[], object]) -> float:
    function()  # the first call pays for what is prepared once
    return max(1e-9, min(_sample(function, 1) for _ in range(3)))
