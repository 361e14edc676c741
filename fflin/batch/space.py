"""Whether there is room for the result of a sweep, before anything of it is begun."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from fflin.base.errors import FileError, InputError

# Of a file beside its rows: names, what is the same at all points, digests [bytes].
_OVERHEAD = 2**16


def check_room(count: int, size: int, path: Path | None) -> None:
    """Raise where so many points with a result of so many bytes do not fit.

    Parameters
    ----------
    count : int
        Points.
    size : int
        Of the result [bytes].
    path : Path or None
        File that is to be written; None keeps the result in memory.

    Raises
    ------
    FileError
        If the disk has not so much free.
    InputError
        If the machine has not so much memory.
    """
    said = f"{count:,} points are {readable(size)}"
    if path is None:
        if size > (memory := _memory()):
            raise InputError(
                f"{said}, and the machine has {readable(memory)} of memory; write them to a file "
                "with out='NAME.h5', or choose fewer points"
            )
    # What stands in an unfinished file has its room already.
    elif path.parent.is_dir() and not part_of(path).exists():
        # An .npz is made from the unfinished file.
        needed = 2 * size if path.suffix == ".npz" else size
        if needed > (free := shutil.disk_usage(path.parent).free):
            needs = ", and .npz needs twice that on the way" if path.suffix == ".npz" else ""
            raise FileError(f"{said}{needs}: only {readable(free)} are free in {path.parent}")
        if size + _OVERHEAD > (most := _largest_file()):
            raise FileError(f"{said}: a file may have no more than {readable(most)} (ulimit -f)")


def part_of(path: Path) -> Path:
    """Return the file that a result grows in until it is whole, beside what a link leads to."""
    real = Path(os.path.realpath(path)) if os.path.islink(path) else path
    return real.with_name(real.name + ".part")


def readable(size: float) -> str:
    """Show a number of bytes."""
    for unit, scale in (("PB", 1e15), ("TB", 1e12), ("GB", 1e9), ("MB", 1e6)):
        if size >= scale:
            return f"{size / scale:,.1f} {unit}"
    return f"{size / 1e3:.1f} kB"


def _largest_file() -> float:
    try:
        import resource
    except ImportError:  # not on this system
        return float("inf")
    most = resource.getrlimit(resource.RLIMIT_FSIZE)[0]
    return float("inf") if most == resource.RLIM_INFINITY else float(most)


def _memory() -> float:
    try:
        return float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    except (AttributeError, ValueError, OSError):  # not on this system
        return float("inf")
