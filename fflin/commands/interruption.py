"""Ctrl-C on the command line: one line and exit 130, whenever it comes."""

from __future__ import annotations

import os
import signal
import sys
from types import FrameType
from typing import Any, NoReturn

from fflin.commands import INTERRUPTED


def listen() -> None:
    """Have Ctrl-C raise `KeyboardInterrupt` after imports and callbacks, where it would be lost."""
    # Where it is ignored, as under nohup, it stays so.
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _heard)
        sys.unraisablehook = _passed_over


def leave(reason: KeyboardInterrupt) -> NoReturn:
    """Say in a line that the command was stopped, and end without waiting for threads."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        # In one piece, between what other processes write.
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


def _passed_over(unraisable: Any) -> None:
    if issubclass(unraisable.exc_type, KeyboardInterrupt):
        frame = sys._getframe(1)
        _raise_in(_importer(frame) or frame)
    else:
        sys.__unraisablehook__(unraisable)


def _importer(frame: FrameType | None) -> FrameType | None:
    """Return the code whose import runs in a frame, the outermost where imports are nested."""
    importer = None
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            importer = frame.f_back
        frame = frame.f_back
    return importer


def _raise_in(frame: FrameType) -> None:
    """Raise it in a frame as this comes to its next line, or to its end."""

    def interrupt(*_: object) -> None:
        sys.settrace(None)
        raise KeyboardInterrupt

    frame.f_trace = interrupt
    sys.settrace(lambda *_: None)
