"""The compiled kernel: whether it pays, and its functions."""

from __future__ import annotations

import logging
import math
import os
import sys
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from threading import Lock
from typing import Any

# Fewest points for which the kernel is quicker than the loop, where numba is loaded and where it is
# not. To load it takes half a second, which a sweep of that size does not win back but the next
# ones do: sweeps are seldom alone.
_BREAK_EVEN, _BREAK_EVEN_UNLOADED = 16, 2000

# Files in which Linux tells a container's quota of computing time and its period [us], of version 2
# and of version 1 of its control groups.
_QUOTAS = (
    ("/sys/fs/cgroup/cpu.max",),
    ("/sys/fs/cgroup/cpu/cpu.cfs_quota_us", "/sys/fs/cgroup/cpu/cpu.cfs_period_us"),
)

_log = logging.getLogger("fflin")
_TURN = Lock()


def available_cores() -> int:
    """How many cores this process may use, by its affinity and its share in a container."""
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


def pays(count: int) -> bool:
    """Whether the kernel is there and beats the loop over so many points."""
    if "numba" in sys.modules:
        return count >= _BREAK_EVEN
    return count >= _BREAK_EVEN_UNLOADED and find_spec("numba") is not None


def kernel(module: str, name: str) -> Any:
    """Return a function of the kernel, compiled at the first call ever and kept on disk."""
    with _TURN:  # threads come here together
        return _prepared(module, name)


@cache
def _prepared(module: str, name: str) -> Any:
    compiled = getattr(import_module(f"fflin.kernel.{module}"), name)
    folder = Path(compiled.stats.cache_path)
    kept = list(folder.glob(f"{module}.{name}-*.nbi"))
    # numba compares with the function's own file, not with those of the functions that it calls.
    source = max(file.stat().st_mtime for file in _sources())
    for entry in [entry for entry in kept if entry.stat().st_mtime < source]:
        entry.unlink(missing_ok=True)
        kept.remove(entry)
    if not kept:
        _log.warning("fflin: compiling the batch kernel, once; it is kept in %s", folder)
    return compiled


def _sources() -> list[Path]:
    return list(Path(__file__).parent.glob("*.py"))
