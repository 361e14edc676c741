"""The compiled kernel: its functions, their stored machine code, and the available cores."""

from __future__ import annotations

import logging
import math
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from threading import Event, Lock, RLock, Thread
from typing import TYPE_CHECKING

from fflin.base.errors import InputError, unknown
from fflin.base.process import Progress

if TYPE_CHECKING:
    from fflin.kernel.machine_code import Compiled

# Linux files that contain a container's quota of computing time and the quota's period [us]. The
# first line is for control groups version 2, the second for version 1.
_QUOTAS = (
    ("/sys/fs/cgroup/cpu.max",),
    ("/sys/fs/cgroup/cpu/cpu.cfs_quota_us", "/sys/fs/cgroup/cpu/cpu.cfs_period_us"),
)

ENGINES = ("python", "compiled")

# Functions that Python calls in compiled code.
_COMPILED = {
    "advance": "the loop that simulates eight runs at a time",
    "derive": "the batch kernel",
    "take": "the run statistics",
}

# Version of Python, as in the names of numba's cache files.
VERSION = f"py{sys.version_info.major}{sys.version_info.minor}"

# Time [s] to wait for another process's compilation before logging it, and the longest wait [s].
_SILENCE, _LONGEST_WAIT = 2.0, 600.0
_INTERVAL = 1.0  # [s] between updates of the time that a terminal shows during a compilation

_log = logging.getLogger("fflin")
_TURN, _COMPILING = Lock(), RLock()


def available_cores() -> int:
    """Return the number of cores of this process, by CPU affinity and container quota."""
    if not hasattr(os, "sched_getaffinity"):
        return os.cpu_count() or 1
    cores = len(os.sched_getaffinity(0))
    for names in _QUOTAS:
        try:
            quota, period = " ".join(map(Path.read_text, map(Path, names))).split()
        except (OSError, ValueError):
            continue
        if quota not in ("max", "-1"):
            cores = min(cores, math.ceil(int(quota) / int(period)))
    return max(cores, 1)


def numba_is_there() -> bool:
    """Return whether numba is installed."""
    return find_spec("numba") is not None


def compiles(engine: object, obstacle: Callable[[], str]) -> bool:
    """Return whether compiled code computes: if `engine` is not "python", and there is no obstacle.

    `obstacle` returns the reason why compiled code cannot compute, or an empty text. An error is
    raised for an unknown engine, and for the engine "compiled" if there is an obstacle.
    """
    if engine is not None and not (isinstance(engine, str) and engine in ENGINES):
        raise unknown("engine", str(engine), list(ENGINES))
    if engine == "python":
        return False
    reason = obstacle()
    if reason and engine == "compiled":
        raise InputError(f"engine='compiled' is not possible, because {reason}; leave engine out")
    return not reason


def kernel(module: str, name: str) -> Compiled:
    """Return a function of the kernel, whose machine code is stored on disk at its first call."""
    with _TURN:  # several threads may call this function at the same time
        return _prepared(module, name)


@cache
def _prepared(module: str, name: str) -> Compiled:
    from fflin.kernel.machine_code import translated

    compiled = translated(getattr(import_module(f"fflin.kernel.{module}"), name), "compiled")
    compile, folder = compiled.compile, Path(str(compiled.stats.cache_path))
    lock = folder / f"{module}.{name}.lock"
    with _between_processes(lock):
        for entry in _stored(folder, module, name)[1]:
            entry.unlink(missing_ok=True)

    def compile_alone(signature: object) -> object:
        """Compile for a signature; if another process has compiled it meanwhile, load its code."""
        # _COMPILING admits one thread, so no thread waits for a file lock of its own process.
        with _COMPILING, _between_processes(lock):
            if _stored(folder, module, name)[0]:
                return compile(signature)
            _log.warning(
                "fflin: compiling %s; this happens only once, because the code is stored in %s",
                _COMPILED[name],
                folder,
            )
            with _seconds_shown(_COMPILED[name]):
                return compile(signature)

    compiled.compile = compile_alone
    return compiled


@contextmanager
def _seconds_shown(what: str) -> Iterator[None]:
    """Show the elapsed seconds of a compilation on a terminal."""
    done, begun, bar = Event(), time.monotonic(), Progress()

    def count() -> None:
        while not done.wait(_INTERVAL):
            bar.say(f"compiling {what}: {time.monotonic() - begun:.0f} s ")

    thread = Thread(target=count, daemon=True)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()
        bar.close()


def _between_processes(path: Path) -> ExitStack:
    """Hold the file lock of a function's machine code until the returned context ends.

    The system frees the lock if the process dies. There is no lock if the package filelock is
    missing, if the folder is not writable, or after a long wait. At worst, two processes then
    compile the same function.
    """
    held = ExitStack()
    # An OSError may be the `Timeout` of the second wait.
    with suppress(ImportError, OSError, NotImplementedError):
        from filelock import FileLock, Timeout

        lock = FileLock(path)
        try:
            lock.acquire(timeout=_SILENCE)
        except Timeout:
            _log.warning(
                "fflin: waiting for another process that compiles the code in %s", path.parent
            )
            lock.acquire(timeout=_LONGEST_WAIT)
        held.callback(lock.release)
    return held


def is_kept(module: str, name: str) -> bool:
    """Return whether the machine code of a function for the current sources is on disk."""
    chosen, own = os.environ.get("NUMBA_CACHE_DIR"), Path(__file__).parent
    folders = Path(chosen).glob(f"{own.name}_*") if chosen else [own / "__pycache__"]
    return any(_stored(folder, module, name)[0] for folder in folders)


def _stored(folder: Path, module: str, name: str) -> tuple[list[Path], list[Path]]:
    """Return the machine code's index files for this Python: newer than all sources, and others."""
    # numba checks the age of the function's own file only, not of the files of called functions.
    source = max(file.stat().st_mtime for file in Path(__file__).parent.glob("*.py"))
    newer: list[Path] = []
    older: list[Path] = []
    for entry in folder.glob(f"{module}.{name}-*.{VERSION}*.nbi"):
        (newer if entry.stat().st_mtime >= source else older).append(entry)
    return newer, older
