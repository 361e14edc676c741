"""Entry point of the command line, for ``fflin`` and for ``python -m fflin``."""

from __future__ import annotations

# `_signal` is built into Python, so a signal.py in the working folder cannot replace it.
import _signal as signal  # type: ignore[import-not-found]
import gc
import os
import sys
from typing import TYPE_CHECKING

from fflin.base.process import import_path_without, same_file
from fflin.commands import INTERRUPTED

if TYPE_CHECKING:
    from types import FrameType
    from typing import NoReturn


def main() -> int:
    """Run the command that the command-line arguments name, and return its exit code."""
    # `python -m fflin` puts the working folder first on the import path, where its files could
    # replace other modules. The folder is removed from the path before further imports, unless
    # fflin itself is imported from it.
    if not same_file(os.path.join(os.path.dirname(__file__), os.pardir), ""):
        sys.path[:] = import_path_without("")
    listen()
    # search rarely for cycles, because most objects live until the end
    gc.set_threshold(50_000)
    try:
        from fflin.commands import cli

        code = cli.main()
    except KeyboardInterrupt as reason:
        leave(reason)
    # The command is finished: Ctrl-C must no longer change its exit code.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    gc.freeze()  # no search for reference cycles, since the process ends
    return code


def listen() -> None:
    """Make Ctrl-C end the process even in a callback, where Python drops `KeyboardInterrupt`."""
    # A shell script starts its background commands with SIGINT ignored. In such a command, SIGINT
    # must stay ignored.
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _interrupt)
        sys.unraisablehook = _unraisable


def leave(reason: BaseException) -> NoReturn:
    """Print in one line that the command was stopped, and exit without waiting for threads."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    why = reason if reason.args else "stopped"
    try:
        # The line is written in one call, so that the output of other processes cannot split it.
        sys.stderr.write(f"fflin: {why}\n")
        if sys.stdout is not None:
            sys.stdout.flush()
    except OSError:  # the program that reads the output has ended
        pass
    finally:
        os._exit(INTERRUPTED)


def _interrupt(_: int, frame: FrameType | None) -> None:
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            leave(KeyboardInterrupt())
        frame = frame.f_back
    raise KeyboardInterrupt


def _unraisable(unraisable: sys.UnraisableHookArgs) -> None:
    if issubclass(unraisable.exc_type, KeyboardInterrupt):
        leave(KeyboardInterrupt())
    sys.__unraisablehook__(unraisable)


if __name__ == "__main__":
    sys.exit(main())
