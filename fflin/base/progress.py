"""A progress bar on stderr, for runs that take long and on terminals alone."""

import sys
import time

_PATIENCE = 1.0  # seconds before a bar is shown
_INTERVAL = 0.1


class Progress:
    """A bar; `shown` None shows it on a terminal, once the run takes long."""

    def __init__(self, shown: bool | None = None) -> None:
        terminal = sys.stderr is not None and sys.stderr.isatty()
        self._shown = terminal if shown is None else shown
        self._start = time.monotonic()
        self._next = self._start + (_PATIENCE if shown is None else 0.0)
        self._drawn = False

    def update(self, done: int, total: int, what: str = "") -> None:
        """Say how many steps of how many are done, and of `what`."""
        if not self._shown or (now := time.monotonic()) < self._next:
            return
        self._next = now + _INTERVAL
        share = done / total
        left = (now - self._start) * (1.0 - share) / share
        bar = "#" * round(30 * share)
        self._drawn = True
        said = f"\r{what}[{bar:<30}] {share:4.0%}, {left:.0f} s left "
        print(said, end="", file=sys.stderr, flush=True)

    def close(self) -> None:
        """Take the bar away."""
        if self._drawn:
            print("\r\x1b[2K", end="", file=sys.stderr, flush=True)
