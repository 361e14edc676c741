"""Files that are written whole or not at all."""

import os
import tempfile
from pathlib import Path
from typing import Any

from fflin.base.errors import FileError, InputError


def as_path(path: Any) -> Path:
    """Return a path, or raise `InputError` where it is none."""
    if not isinstance(path, str | os.PathLike) or "\0" in str(path):
        raise InputError(f"{path!r} is not a path")
    return Path(path)


def write_whole(contents: dict[Path, bytes]) -> None:
    """Write files so that each is whole or, where anything fails, as it was before.

    Raises
    ------
    FileError
        If a file cannot be written.
    """
    written: dict[Path, Path] = {}
    target = Path()
    try:
        for target, content in contents.items():
            real = _real(target)
            handle, name = tempfile.mkstemp(prefix=".fflin-", dir=real.parent)
            temporary = Path(name)
            written[temporary] = real
            with os.fdopen(handle, "wb") as file:
                file.write(content)
            os.chmod(temporary, real.stat().st_mode & 0o777 if real.exists() else 0o666 & ~_umask())
        for temporary, target in list(written.items()):
            os.replace(temporary, target)
            del written[temporary]
    except FileError:
        raise
    except OSError as error:
        raise FileError(f"{target}: cannot be written: {error.strerror}") from None
    finally:
        for temporary in written:
            temporary.unlink(missing_ok=True)


def check_place(target: Path) -> None:
    """Raise `FileError` where no file can be written there, before work is done for it."""
    try:
        with tempfile.TemporaryFile(prefix=".fflin-", dir=_real(target).parent):
            pass
    except OSError as error:
        raise FileError(f"{target}: cannot be written: {error.strerror}") from None


def _real(target: Path) -> Path:
    """Return the file that is meant, so that a link stays one."""
    real = Path(os.path.realpath(target))
    if real.exists() and not real.is_file():
        kind = "a folder" if real.is_dir() else "not a regular file"
        raise FileError(f"{target}: is {kind}; give the name of a file")
    return real


def _umask() -> int:
    # It can be read only by setting it.
    mask = os.umask(0o077)
    os.umask(mask)
    return mask
