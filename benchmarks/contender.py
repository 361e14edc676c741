"""What is timed of a simulator in a closed loop."""

from collections.abc import Callable
from dataclasses import dataclass

from benchmarks.closed_loop import Loop
from benchmarks.robots import Array


@dataclass(frozen=True)
class Contender:
    """`run` goes from the loop's start to its end; `end` tells the last state (nx,) of that.

    One without an `end` is no closed loop, but a floor of the others.
    """

    name: str
    loop: Loop
    run: Callable[[], object]
    end: Callable[[], Array] | None = None
