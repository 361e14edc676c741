"""The compiled kernel: its functions, and whether compiling is worthwhile."""

from __future__ import annotations

import logging
import math
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache, partial
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from threading import Event, Lock, RLock, Thread
from typing import Any

from fflin.base.errors import unknown

# Files in which Linux tells a container's quota of computing time and its period [us], of version 2
# and of version 1 of its control groups.
_QUOTAS = (
    ("/sys/fs/cgroup/cpu.max",),
    ("/sys/fs/cgroup/cpu/cpu.cfs_quota_us", "/sys/fs/cgroup/cpu/cpu.cfs_period_us"),
)

ENGINES = ("python", "compiled")

# In the names of numba's files.
VERSION = f"py{sys.version_info.major}{sys.version_info.minor}"

# Wait for another process's compilation for so long [s] before saying so, and at most.
_SILENCE, _LONGEST_WAIT = 2.0, 600.0
_INTERVAL = 1.0  # [s] between the seconds that a terminal shows during a compilation

_log = logging.getLogger("fflin")
_TURN, _COMPILING = Lock(), RLock()


def available_cores() -> int:
    """Return the number of cores of this process, by CPU affinity and container quota."""
    if not hasattr(os, "sched_getaffinity"):
        return os.cpu_count() or 1
    cores = len(os.sched_getaffinity(0))
    for names in _QUOTAS:
        try:
            quota, period = " ".join(Path(name).read_text() for name in names).split()
        except (OSError, ValueError):
            continue
        if quota not in ("max", "-1"):
            cores = min(cores, math.ceil(int(quota) / int(period)))
    return max(cores, 1)


def numba_is_there() -> bool:
    """Whether the kernel can be compiled."""
    return find_spec("numba") is not None


def checked_engine(engine: Any) -> str | None:
    """Return the name of an engine, or None, or raise `UnknownNameError`."""
    if engine is not None and not (isinstance(engine, str) and engine in ENGINES):
        raise unknown("engine", str(engine), list(ENGINES))
    return engine


def kernel(module: str, name: str, what: str = "the batch kernel") -> Any:
    """Return a function of the kernel, compiled at the first call ever and kept on disk."""
    with _TURN:  # threads come here together
        return _prepared(module, name, what)


@cache
def _prepared(module: str, name: str, what: str) -> Any:
    from fflin.kernel.machine_code import translated

    compiled = translated(getattr(import_module(f"fflin.kernel.{module}"), name))
    folder = Path(compiled.stats.cache_path)
    with _between_processes(folder / f"{module}.{name}.lock"):
        older = set(_entries(folder, module, name)) - set(_kept(folder, module, name))
        for entry in older:
            entry.unlink(missing_ok=True)
    if not isinstance(compiled.compile, partial):  # a lock within itself would wait for itself
        compiled.compile = partial(_compile_alone, compiled.compile, folder, module, name, what)
    return compiled


def _compile_alone(
    compile: Callable[[Any], Any], folder: Path, module: str, name: str, what: str, signature: Any
) -> Any:
    """Compile for a signature, or load the code that another process has compiled meanwhile."""
    # Threads wait for one another here, and so never for a lock that this process holds.
    with _COMPILING, _between_processes(folder / f"{module}.{name}.lock"):
        if not _kept(folder, module, name):
            _log.warning(
                "fflin: compiling %s; this happens only once, because the code is stored in %s",
                what,
                folder,
            )
            with _seconds_shown(what):
                return compile(signature)
        return compile(signature)


@contextmanager
def _seconds_shown(what: str) -> Iterator[None]:
    """Count the seconds of a compilation on a terminal."""
    if sys.stderr is None or not sys.stderr.isatty():
        yield
        return
    done, begun = Event(), time.monotonic()

    def count() -> None:
        while not done.wait(_INTERVAL):
            said = f"\rcompiling {what}: {time.monotonic() - begun:.0f} s "
            print(said, end="", file=sys.stderr, flush=True)

    thread = Thread(target=count, daemon=True)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()
        print("\r\x1b[2K", end="", file=sys.stderr, flush=True)


@contextmanager
def _between_processes(path: Path) -> Iterator[None]:
    """Hold the lock of a function's machine code; the system frees it if the process dies.

    Without the package, in a folder that cannot be written, or after a long wait it goes on without
    the lock: at worst two processes compile the same.
    """
    try:
        from filelock import FileLock, Timeout
    except ImportError:
        yield
        return
    lock = FileLock(path)
    with suppress(OSError, NotImplementedError):  # `Timeout` is an OSError too
        try:
            lock.acquire(timeout=_SILENCE)
        except Timeout:
            _log.warning(
                "fflin: waiting for another process that compiles the code in %s", path.parent
            )
            lock.acquire(timeout=_LONGEST_WAIT)
    try:
        yield
    finally:
        lock.release()


def is_kept(module: str, name: str) -> bool:
    """Whether the machine code of a function is on disk, for the sources as they are."""
    chosen, own = os.environ.get("NUMBA_CACHE_DIR"), Path(__file__).parent
    folders = Path(chosen).glob(f"{own.name}_*") if chosen else [own / "__pycache__"]
    return any(_kept(folder, module, name) for folder in folders)


def _kept(folder: Path, module: str, name: str) -> list[Path]:
    """Return a function's stored machine code if no source is newer."""
    # numba compares with the function's own file, not with those of the functions that it calls.
    source = max(file.stat().st_mtime for file in _sources())
    entries = _entries(folder, module, name)
    return [entry for entry in entries if entry.stat().st_mtime >= source]


def _entries(folder: Path, module: str, name: str) -> list[Path]:
    """Return what there is of a function for this version of Python."""
    return list(folder.glob(f"{module}.{name}-*.{VERSION}*.nbi"))


def _sources() -> list[Path]:
    return list(Path(__file__).parent.glob("*.py"))
