"""The compiled kernel: its functions, their machine code on disk, and the available cores."""

from __future__ import annotations

import logging
import math
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import cache, partial
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from threading import Event, Lock, RLock, Thread
from typing import TYPE_CHECKING

from fflin.base.errors import InputError, unknown
from fflin.base.process import Progress

if TYPE_CHECKING:
    from fflin.kernel.machine_code import Compiled

# Linux files with a container's quota of computing time [us], followed by the period [us] to which
# the quota applies. The first tuple is for version 2 of control groups, the second for version 1.
_QUOTAS = (
    ("/sys/fs/cgroup/cpu.max",),
    ("/sys/fs/cgroup/cpu/cpu.cfs_quota_us", "/sys/fs/cgroup/cpu/cpu.cfs_period_us"),
)

ENGINES = ("python", "compiled")

# {name of a kernel function that Python calls: description of this function in messages}.
_COMPILED = {
    "advance": "the loop that simulates eight runs at a time",
    "advance_one": "the loop that simulates one run",
    "advance_in_orbit": "the loop that simulates eight runs at a time in orbit",
    "advance_one_in_orbit": "the loop that simulates one run in orbit",
    "advance_extended": (
        "the loop with constraints, lags or flat plates for eight runs at a time"
    ),
    "advance_one_extended": (
        "the loop with constraints, lags or flat plates for one run"
    ),
    "advance_extended_in_orbit": (
        "the loop with constraints, lags or flat plates for eight runs at a time in orbit"
    ),
    "advance_one_extended_in_orbit": (
        "the loop with constraints, lags or flat plates for one run in orbit"
    ),
    "derive": "the batch kernel",
    "derive_in_orbit": "the batch kernel in orbit",
    "take": "the run statistics",
}

# Command that installs numba.
INSTALL = "pip install 'fflin[fast]'"

# Version of Python, written as in the names of numba's cache files.
VERSION = f"py{sys.version_info.major}{sys.version_info.minor}"

# Times [s] to wait while another process compiles. After _SILENCE, a message is logged. The second
# wait is at most _LONGEST_WAIT.
_SILENCE, _LONGEST_WAIT = 2.0, 600.0
# [s] between updates of the time that a terminal shows during a compilation
_INTERVAL = 1.0

_log = logging.getLogger("fflin")
_TURN, _COMPILING = Lock(), RLock()
_warned_unstored = Event()  # set after the warning that machine code cannot be stored


def available_cores() -> int:
    """Return the number of cores that this process may use.

    The CPU affinity of the process and the quota of the process's container limit the number.
    """
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
    """Return whether numba is installed and compiles."""
    return not numba_is_missing() and not _numba_is_disabled()


def _numba_is_disabled() -> bool:
    """Return whether the user has switched numba off, so that it leaves functions as they are."""
    return os.environ.get("NUMBA_DISABLE_JIT", "").strip() not in ("", "0")


def numba_is_missing() -> bool:
    """Return whether numba is not installed."""
    return find_spec("numba") is None


def without_numba() -> str:
    """Return the reason why numba cannot be used."""
    if _numba_is_disabled():
        return "the environment variable NUMBA_DISABLE_JIT switches numba off"
    return f"numba is not installed ({INSTALL})"


def compiles(engine: object, obstacle: Callable[[], str]) -> bool:
    """Return whether compiled code is used for the engine that the user chose.

    The function `obstacle` returns the reason why compiled code cannot be used, or an empty text.
    Compiled code is used if `engine` is not "python" and there is no such reason. Raise an error
    for an unknown engine, and for the engine "compiled" if there is a reason.
    """
    if engine is not None and not (isinstance(engine, str) and engine in ENGINES):
        raise unknown("engine", str(engine), list(ENGINES))
    if engine == "python":
        return False
    reason = obstacle()
    if reason and engine == "compiled":
        raise InputError(
            f"engine='compiled' is not possible, because {reason}; leave engine out"
        )
    return not reason


def kernel(module: str, name: str) -> Compiled:
    """Return a compiled function of the kernel.

    At its first call, the returned function is compiled, and the machine code is stored on disk. If
    the machine code is already on disk, the first call only loads the machine code.
    """
    with _TURN:  # several threads may call this function at the same time
        return _prepared(module, name)


@cache
def _prepared(module: str, name: str) -> Compiled:
    from fflin.kernel.machine_code import optimisation_level, translated

    compiled = translated(
        getattr(import_module(f"fflin.kernel.{module}"), name), "compiled"
    )
    compile = optimisation_level()(compiled.compile)
    if compiled.stats.cache_path is None:
        compiled.compile = partial(_compile_unstored, compile, name)
        return compiled
    folder = Path(str(compiled.stats.cache_path))
    lock = folder / f"{module}.{name}.lock"
    with _between_processes(lock):
        for entry in _stored(folder, module, name)[1]:
            entry.unlink(missing_ok=True)

    def compile_alone(signature: object) -> object:
        """Compile the function for a signature, or load code that another process has stored."""
        # A thread must not wait for a file lock that is held by another thread of the same process.
        # So `_COMPILING` admits only one thread at a time.
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


def _compile_unstored(
    compile: Callable[[object], object], name: str, signature: object
) -> object:
    """Compile a function whose machine code cannot be stored; warn once per process."""
    with _COMPILING:
        if not _warned_unstored.is_set():
            _warned_unstored.set()
            _log.warning(
                "fflin: compiling without storing the code, because neither the folder of fflin "
                "nor the user's cache folder is writable; every process compiles again. Set "
                "NUMBA_CACHE_DIR to a writable folder"
            )
        with _seconds_shown(_COMPILED[name]):
            return compile(signature)


@contextmanager
def _seconds_shown(subject: str) -> Iterator[None]:
    """Show the elapsed time [s] of a compilation on a terminal, until the context ends."""
    done, begun, bar = Event(), time.monotonic(), Progress()

    def count() -> None:
        while not done.wait(_INTERVAL):
            bar.say(f"compiling {subject}: {time.monotonic() - begun:.0f} s ")

    thread = Thread(target=count, daemon=True)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()
        bar.close()


def _between_processes(path: Path) -> ExitStack:
    """Hold the file lock at `path` until the returned context ends.

    The lock keeps other processes from compiling the same function. If this process dies, the
    operating system frees the lock. The function continues without the lock if the package filelock
    is missing, if the folder is not writable, or after a wait of `_LONGEST_WAIT`. At worst, two
    processes compile the same function.
    """
    held = ExitStack()
    # The `Timeout` of the second wait is suppressed too, because `Timeout` is an OSError.
    with suppress(ImportError, OSError, NotImplementedError):
        from filelock import FileLock, Timeout

        lock = FileLock(path)
        try:
            lock.acquire(timeout=_SILENCE)
        except Timeout:
            _log.warning(
                "fflin: waiting for another process that compiles the code in %s",
                path.parent,
            )
            lock.acquire(timeout=_LONGEST_WAIT)
        held.callback(lock.release)
    return held


def is_kept(module: str, name: str) -> bool:
    """Return whether the disk has machine code of a function, compiled from the current sources."""
    chosen = os.environ.get("NUMBA_CACHE_DIR")
    kernel_folder = Path(__file__).parent
    folders = (
        Path(chosen).glob(f"{kernel_folder.name}_*")
        if chosen
        else [kernel_folder / "__pycache__"]
    )
    return any(_stored(folder, module, name)[0] for folder in folders)


def _stored(folder: Path, module: str, name: str) -> tuple[list[Path], list[Path]]:
    """Return numba's index files for the machine code of a function, for this version of Python.

    The first list has the files that are newer than all sources of the kernel. The second list has
    the older files.
    """
    # The machine code of a function includes called functions from other source files. numba checks
    # only whether the machine code is older than the function's own source file. So this function
    # compares the index files with all source files.
    source = max(file.stat().st_mtime for file in Path(__file__).parent.glob("*.py"))
    newer: list[Path] = []
    older: list[Path] = []
    for entry in folder.glob(f"{module}.{name}-*.{VERSION}*.nbi"):
        (newer if entry.stat().st_mtime >= source else older).append(entry)
    return newer, older
