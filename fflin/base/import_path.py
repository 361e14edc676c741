"""Folders that this process imports modules from."""

import os
import sys


def import_path_without(*folders: str | os.PathLike[str]) -> list[str]:
    """Return `sys.path` without some folders, whatever their entries are called."""
    return [entry for entry in sys.path if not any(same_folder(entry, each) for each in folders)]


def same_folder(first: str | os.PathLike[str], second: str | os.PathLike[str]) -> bool:
    """Whether two names lead to one folder; an empty one is the working folder's."""
    try:
        return os.path.samefile(first or os.curdir, second or os.curdir)
    except (OSError, ValueError):  # one of them does not exist
        return False
