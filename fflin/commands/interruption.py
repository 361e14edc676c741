"""Ctrl-C on the command line: one line and exit code 130 at any time."""

from __future__ import annotations

import os
import signal
import sys
from types import FrameType
from typing import NoReturn

from fflin.commands import INTERRUPTED


def listen() -> None:
    """Raise `KeyboardInterrupt` after an import or callback in which it would be lost."""
    # If SIGINT is ignored, as under nohup, it remains ignored.
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _heard)
        sys.unraisablehook = _passed_over


def leave(reason: KeyboardInterrupt) -> NoReturn:
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


def _heard(_: int, frame: FrameType | None) -> None:
    importer = _importer(frame)
    if importer is None:
        raise KeyboardInterrupt
    _raise_in(importer)


def _passed_over(unraisable: sys.UnraisableHookArgs) -> None:
    if issubclass(unraisable.exc_type, KeyboardInterrupt):
        frame = sys._getframe(1)
        _raise_in(_importer(frame) or frame)
    else:
        sys.__unraisablehook__(unraisable)


def _importer(frame: FrameType | None) -> FrameType | None:
    """Return the frame whose import statement runs in `frame`, the outermost if nested."""
    importer = None
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            importer = frame.f_back
        frame = frame.f_back
    return importer


def _raise_in(frame: FrameType) -> None:
    """Raise `KeyboardInterrupt` in a frame at its next line or at its end."""

    def interrupt(*_: object) -> None:
        sys.settrace(None)
        raise KeyboardInterrupt

    frame.f_trace = interrupt
    sys.settrace(lambda *_: None)
