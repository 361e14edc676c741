"""Run the command line, as ``fflin`` and as ``python -m fflin``."""

from __future__ import annotations

# Built in, so that no module of the working folder takes its place.
import _signal as signal  # type: ignore[import-not-found]
import gc
import os
import sys
from typing import TYPE_CHECKING

from fflin.base.process import import_path_without, same_folder
from fflin.commands import INTERRUPTED

if TYPE_CHECKING:
    from types import FrameType
    from typing import NoReturn


def main() -> int:
    """Run the command line on the arguments of this process, and return its exit code."""
    # With `python -m fflin` the working folder comes first on the path; leave it out before more
    # is imported, unless fflin itself is imported from there.
    if not same_folder(os.path.join(os.path.dirname(__file__), os.pardir), ""):
        sys.path[:] = import_path_without("")
    listen()
    gc.set_threshold(50_000)  # most of what a command makes, it keeps to its end
    try:
        from fflin.commands import cli

        code = cli.main()
    except KeyboardInterrupt as reason:
        leave(reason)
    # All is done and said.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    gc.freeze()  # what ends with the process need not be searched for circles
    return code


def listen() -> None:
    """End at Ctrl-C also in an import or a callback, where `KeyboardInterrupt` would be lost."""
    # If SIGINT is ignored, as under nohup, it remains ignored.
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _interrupt)
        sys.unraisablehook = _unraisable


def leave(reason: BaseException) -> NoReturn:
    """Report the stop in one line, and exit without waiting for threads."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        # One write, which output of other processes cannot split.
        sys.stderr.write(f"fflin: {reason}\n" if reason.args else "fflin: stopped\n")
        if sys.stdout is not None:
            sys.stdout.flush()
    except OSError:  # nobody reads it
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
