"""The kinds of results in files: a command replaces a file of its own kinds, others by --force."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from fflin.base.errors import FileError

# The entries by which a result is known whose file does not name its kind.
_ENTRIES = {
    "Sensitivity": {"urdf_sha256", "dA", "dB"},
    "LinearModel": {"urdf_sha256", "certificate"},
    "LinearBatch": {"header", "B_lower"},
    "Campaign": {"header", "drawn"},
}


def require_own_kind(arguments: argparse.Namespace) -> None:
    """Raise `FileError` if -o names a file of a kind that the command does not write."""
    path, kinds = getattr(arguments, "output_file", None), getattr(arguments, "kinds", ())
    if path is None or not kinds or arguments.force or not path.is_file():
        return
    found = kind_of(path)
    if found not in kinds and path.stat().st_size:
        there = f"holds a {found}" if found else "exists and is not a result of fflin"
        raise FileError(
            f"{path} {there}; without --force this command replaces only files of kind "
            f"{' or '.join(kinds)}. Name another file or add --force"
        )


def kind_of(path: Path) -> str:
    """Return the name of the class whose result a file holds; "" if it is not known."""
    try:
        names, kind = _entries(path)
    except Exception:  # each decoder has its own
        return ""
    return kind or next((name for name, of in _ENTRIES.items() if of <= names), "")


def _entries(path: Path) -> tuple[set[str], str]:
    """Return the names of a file's entries, and its kind where it has one."""
    from fflin.base.record import decoded, text

    entries: Any
    if path.suffix == ".csv":
        with path.open(encoding="utf-8") as file:
            names = {*file.readline().strip().split(",")}
        return names, "Motion" if {"t", "q_b.x"} <= names else ""
    if path.suffix == ".h5":
        from fflin.batch.files import hdf5

        with hdf5().File(path, "r") as file:
            return {*file, *file.attrs}, ""
    if path.suffix == ".npz":
        import numpy as np

        with path.open("rb") as content, np.load(content, allow_pickle=False) as entries:
            return {*entries.files}, text(entries["kind"]) if "kind" in entries.files else ""
    entries, _ = decoded(path.suffix, path.read_bytes())  # `read_file` would make it an input
    return {*entries}, text(entries["kind"]) if "kind" in entries else ""
