"""Ctrl-C on the command line: one line and exit 130, whenever it comes."""

from __future__ import annotations

import _thread
import os
import signal
import sys
import threading
import time
from types import FrameType
from typing import Any, NoReturn

from fflin.commands import INTERRUPTED

# How long to wait where it cannot be raised [s].
_AGAIN = 0.02


def listen() -> None:
    """Have Ctrl-C raise `KeyboardInterrupt` in the main thread where it cannot be lost.

    What the interpreter itself does raises it in the middle of an import, which packages turn into
    an `ImportError`, and in a callback such as that of a weak reference, where it is printed and
    passed over. Here it is raised after the import, and again after such a callback.
    """
    # Where it is ignored, as under nohup, it stays so.
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _heard)
        sys.unraisablehook = _passed_over


def leave(reason: KeyboardInterrupt) -> NoReturn:
    """Say in a line that the command was stopped, and end without waiting for threads."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        print(f"fflin: {reason}" if reason.args else "fflin: stopped", file=sys.stderr)
        if sys.stdout is not None:
            sys.stdout.flush()
    except OSError:  # nobody reads it
        pass
    finally:
        os._exit(INTERRUPTED)


def _heard(_: int, frame: FrameType | None) -> None:
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            _raise_later()
            return
        frame = frame.f_back
    raise KeyboardInterrupt


def _passed_over(unraisable: Any) -> None:
    if issubclass(unraisable.exc_type, KeyboardInterrupt):
        _raise_later()
    else:
        sys.__unraisablehook__(unraisable)


def _raise_later() -> None:
    # Not a threading.Thread, whose locks the code that was interrupted may hold.
    _thread.start_new_thread(_interrupt, ())


def _interrupt() -> None:
    time.sleep(_AGAIN)
    if hasattr(signal, "pthread_kill"):  # it ends a wait of the main thread, too
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)
    else:
        _thread.interrupt_main()
