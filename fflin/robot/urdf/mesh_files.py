"""Where the mesh files lie that a URDF names."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from urllib.parse import unquote


def find_mesh(uri: str, urdf: Path, package_dirs: Sequence[Path]) -> Path | None:
    """Return the file of package://NAME/PATH, file:///PATH or a path; None without one."""
    scheme, separator, rest = uri.partition("://")
    candidates: Iterable[Path]
    if not separator:
        candidates = (folder / uri for folder in (urdf.parent, *package_dirs))
    elif scheme == "file":
        candidates = [Path(unquote(rest))]
    else:

        def folders() -> Iterator[Path]:
            yield from package_dirs
            yield from urdf.resolve().parents

        inside = Path(*Path(rest).parts[1:])
        # A package's own folder may have been given, or be called otherwise.
        candidates = (folder / part for part in (rest, inside) for folder in folders())
    # Unlike Path.is_file, this takes a name that is too long for one that does not exist.
    return next((path for path in candidates if os.path.isfile(path)), None)
