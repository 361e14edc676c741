"""Times of several functions, measured side by side."""

import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

SAMPLE_SECONDS = 2e-3


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


def interleaved(
    functions: Mapping[str, Callable[[], object]], repetitions: int = 31
) -> dict[str, Times]:
    """Time functions in turns, so that a machine that is busy for a while is so for all."""
    loops = {name: _loops(function) for name, function in functions.items()}
    samples: dict[str, list[float]] = {name: [] for name in functions}
    for _ in range(repetitions):
        for name, function in functions.items():
            count = loops[name]
            start = time.perf_counter()
            for _ in range(count):
                function()
            samples[name].append((time.perf_counter() - start) / count)
    return {name: Times(tuple(values)) for name, values in samples.items()}


def _loops(function: Callable[[], object]) -> int:
    function()  # the first call pays for what is prepared once
    start = time.perf_counter()
    function()
    once = time.perf_counter() - start
    return max(1, min(2000, round(SAMPLE_SECONDS / max(once, 1e-9))))
