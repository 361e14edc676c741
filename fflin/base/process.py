"""Progress bar on stderr, checks of the import path, and a limit on the threads of BLAS."""

import math
import os
import sys
import time
from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
T = TypeVar("T")

_PATIENCE = 1.0  # seconds before a bar is shown
_LONG = 600.0  # shortest work [s] for which a faster way is recommended
_WORTH = 10.0  # shortest work [s] for which an estimate is shown
_INTERVAL = 0.1
_BETWEEN_LINES = 20.0  # least time [s] between two lines without a terminal
LONG_RUN = 20.0  # duration of a run [s] after which a faster engine is recommended


def on_terminal() -> bool:
    """Return whether stderr is a terminal."""
    return sys.stderr is not None and sys.stderr.isatty()


class Progress:
    """Progress bar; by default, it appears only on a terminal, and only after one second."""

    def __init__(self, shown: bool | None = None) -> None:
        self._shown = on_terminal() if shown is None else shown
        self._start = time.monotonic()
        patience = _PATIENCE if shown is None else 0.0
        self._next = self._start + patience
        self._drawn = False
        self._announced = ""
        self.done, self.total = 0, 0

    def announce(self, text: str) -> None:
        """Print a text on stderr when the first step is done, so that no error follows it."""
        self._announced = text

    def expect(
        self, seconds: float, cores: int, what: str = "", faster: str = ""
    ) -> None:
        """Print the estimated duration of the computation `what`, if it is at least 10 s.

        If it is at least 10 min, also print `faster`, which states how to compute faster.
        """
        if seconds < _WORTH:
            return
        if seconds < 120.0:
            size, unit = seconds, "s"
        elif seconds <= 7200.0:
            size, unit = seconds / 60.0, "min"
        else:
            size, unit = seconds / 3600.0, "h"
        shown = float(f"{size:.2g}")
        counted_cores = "1 core" if cores == 1 else f"{cores} cores"
        text = f"about {shown:g} {unit} on {counted_cores}"
        if what:
            text = f"{what}: {text}"
        if faster and seconds >= _LONG:
            text += f"; {faster}"
        print(f"fflin: {text}", file=sys.stderr)

    def __call__(self, done: int, total: int, what: str = "", hint: str = "") -> None:
        """Show the label `what`, and a bar for `done` of `total` steps.

        After 20 s, also show `hint`.
        """
        self.done, self.total = done, total
        if self._announced:
            print(self._announced, file=sys.stderr)
            self._announced = ""
        if self._shown:
            share = done / total
            spent = time.monotonic() - self._start
            left = spent * (1.0 - share) / share
            if spent <= LONG_RUN:
                hint = ""
            bar = "#" * round(30 * share)
            self.say(f"{what}[{bar:<30}] {share:4.0%}, {left:.0f} s left {hint}")

    def say(self, text: str) -> None:
        """Show a line of text in the bar's place, for example for work of unknown length.

        A text is ignored if it comes less than 0.1 s after the last shown text.
        """
        if self._shown and (now := time.monotonic()) >= self._next:
            self._next = now + _INTERVAL
            self._drawn = True
            print(f"\r\x1b[2K{text}", end="", file=sys.stderr, flush=True)

    def close(self) -> None:
        """Remove the bar from the terminal."""
        if self._drawn:
            print("\r\x1b[2K", end="", file=sys.stderr, flush=True)


class Status(Progress):
    """Line of text about a long computation.

    On a terminal, the line is updated. Without a terminal, the first text is printed at once, and
    later ones at least 20 s apart.
    """

    def __init__(self) -> None:
        super().__init__()
        self._next_line = -math.inf

    def say(self, text: str) -> None:
        """Show a text on a terminal, or print it as a line if the last one is old enough."""
        if self._shown:
            super().say(text)
            return
        now = time.monotonic()
        if now < self._next_line:
            return
        self._next_line = now + _BETWEEN_LINES
        print(f"fflin: {text}", file=sys.stderr, flush=True)


def import_path_without(*folders: str | os.PathLike[str]) -> list[str]:
    """Return `sys.path` without the entries that lead to the given folders."""
    return [
        entry
        for entry in sys.path
        if not any(same_file(entry, folder) for folder in folders)
    ]


def memory() -> float:
    """Return the size of the machine's memory [bytes], or infinity if it is unknown."""
    try:
        return float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    except (
        AttributeError,
        ValueError,
        OSError,
    ):  # this system does not report the size
        return math.inf


def same_file(first: str | os.PathLike[str], second: str | os.PathLike[str]) -> bool:
    """Return whether two paths lead to one file or folder; "" means the working folder."""
    try:
        return os.path.samefile(first or os.curdir, second or os.curdir)
    except (OSError, ValueError):  # a path does not exist or is invalid
        return False


def in_one_thread(function: Callable[P, T]) -> Callable[P, T]:
    """Limit BLAS to one thread while a function runs.

    For many small matrices, several threads are no faster, because they wait for each other.
    """

    @wraps(function)
    def limited(*args: P.args, **kwargs: P.kwargs) -> T:
        from threadpoolctl import threadpool_limits

        with threadpool_limits(1, user_api="blas"):
            return function(*args, **kwargs)

    return limited
