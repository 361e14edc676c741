"""Atomic writing of files.

- A file is written completely. If anything fails, the old file stays unchanged.
- The target is a new name or a regular file. An existing file keeps its permissions. The
  permissions of a new file follow from the umask.
- If the target is a symbolic link, the link stays and the file to which it leads is written.
- A command never overwrites a file that it reads.
"""

import csv
import os
import stat
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from itertools import combinations
from pathlib import Path
from types import SimpleNamespace

from fflin.base.errors import FileError, InputError
from fflin.base.process import same_file

# Endings of saved results. `base.record` reads and writes them.
RECORDS = (".npz", ".mat", ".json")

# If a file is missing, similar names are suggested only if its folder contains fewer names than
# this.
_MANY = 1000


# Output files that a command has yet to write, and input files that it has read. The value is None
# in a Python session, which may overwrite files that it has read.
_of_command: ContextVar[tuple[set[Path], set[str]] | None] = ContextVar(
    "files", default=None
)


def as_path(path: object) -> Path:
    """Return a path, or raise `InputError` if the value is not a path."""
    if not isinstance(path, str | os.PathLike) or "\0" in str(path):
        raise InputError(f"{path!r} is not a path")
    if not str(path):
        raise InputError("the path is empty; give the name of a file or folder")
    return Path(path)


def check_ending(path: Path, endings: tuple[str, ...]) -> None:
    """Raise `FileError` if the name of a file has none of the given endings."""
    if path.suffix not in endings:
        raise FileError(
            f"'{path}' ends in '{path.suffix}', expected one of {', '.join(endings)}"
        )


def read_file(
    path: Path, kind: str, limit: int | None = None, *, replaceable: bool = False
) -> bytes:
    """Return the content of a regular file of at most `limit` bytes, or raise `FileError`.

    If `replaceable`, the file is not registered as an input, so that it can be overwritten.
    """
    require_regular(path, kind, limit, replaceable=replaceable)
    size = -1 if limit is None else limit
    with failing(path, "read"), path.open("rb") as file:
        return file.read(size)


def require_regular(
    path: Path, kind: str, limit: int | None = None, *, replaceable: bool = False
) -> None:
    """Raise `FileError` if an input file is not a regular file of at most `limit` bytes.

    Other files are not opened: a pipe would block until another process writes into it, and a
    device may have no end.

    The file is also registered as an input, so that the command cannot overwrite it. If
    `replaceable` is true, it is not registered.
    """
    with failing(path, "read"):
        status = path.stat()
    if stat.S_ISDIR(status.st_mode):
        raise FileError(f"{path}: is a folder; give the path of a {kind} file")
    if not stat.S_ISREG(status.st_mode):
        raise FileError(
            f"{path}: is not a regular file; give the path of a {kind} file"
        )
    if limit is not None and status.st_size > limit:
        size = f"{limit >> 20} MiB" if limit >> 20 else f"{limit >> 10} KiB"
        raise FileError(f"{path}: is larger than {size}, too large for a {kind} file")
    if not replaceable:
        remember(path)


@contextmanager
def failing(path: Path, what: str) -> Iterator[None]:
    """Convert errors of the file system to `FileError`."""
    try:
        yield
    except FileError:
        raise
    except (OSError, ValueError) as error:
        if what == "read" and isinstance(error, FileNotFoundError):
            raise FileError(f"{shown(path)}: No such file{missing(path)}") from None
        raise FileError(f"{shown(path)}: cannot be {what}: {reason(error)}") from None


@contextmanager
def files_of_command(inputs: Iterable[Path], outputs: Iterable[Path]) -> Iterator[None]:
    """Check the files of a command while the command runs.

    Raise `FileError` if the command would overwrite a file that it reads, or write two outputs to
    one file. `inputs` are the input files known at the start; `read_file` and `remember` add
    further files.
    """
    check_distinct(*(outputs := list(outputs)))
    token = _of_command.set((set(outputs), set()))
    try:
        remember(*inputs)
        yield
    finally:
        _of_command.reset(token)


def remember(*paths: str | Path) -> None:
    """Register files that a command reads, so that it cannot overwrite them.

    Raise `FileError` if one of the files is an output of the command.
    """
    outputs, inputs = _of_command.get() or (set(), set())
    inputs.update(map(os.path.abspath, paths))
    for target in outputs:
        _require_other(target, paths)


def _require_other(target: Path, inputs: Iterable[str | Path]) -> None:
    for path in inputs:
        if same_file(path, target):
            message = f"output {target} is the input file {os.path.abspath(path)}"
            raise FileError(f"{message}; give another output file")


def csv_table(rows: Iterable[Iterable[object]]) -> bytes:
    """Return the content of a CSV file."""
    # The writer calls `write` once for each row. It quotes a cell with a line break only if the
    # break is part of `lineterminator`.
    lines = list[str]()
    csv.writer(SimpleNamespace(write=lines.append), lineterminator="\r\n").writerows(
        rows
    )
    return "".join(line.removesuffix("\r\n") + "\n" for line in lines).encode()


def write_atomically(contents: Mapping[Path, bytes]) -> None:
    """Write files atomically: each file is either written completely or left unchanged."""
    with replacing(*contents) as files:
        for file, content in zip(files, contents.values(), strict=True):
            file.write_bytes(content)


@contextmanager
def replacing(*targets: Path) -> Iterator[list[Path]]:
    """Yield a temporary file for each target; on success, these files replace the targets."""
    written: dict[Path, Path] = {}
    try:
        for target in targets:
            with failing(target, "written"):
                temporary = (
                    followed_path(target).parent / f".fflin-{os.urandom(8).hex()}"
                )
                temporary.touch(exist_ok=False)  # its mode follows from the umask
            written[temporary] = target
        with failing(targets[-1], "written"):
            yield list(written)
        for temporary, target in list(written.items()):
            with failing(target, "written"):
                install(temporary, target)
            del written[temporary]
    finally:
        for temporary in written:
            temporary.unlink(missing_ok=True)


def install(temporary: Path, target: Path) -> None:
    """Replace a target by a temporary file that contains the complete new content."""
    real = followed_path(target)
    if real.exists():
        os.chmod(temporary, real.stat().st_mode & 0o777)
    os.replace(temporary, real)
    outputs, _ = _of_command.get() or (set(), set())
    outputs.discard(target)  # a command may read its own output


def followed_path(target: Path) -> Path:
    """Return the file to which a target's links lead.

    Raise `FileError` if this file is not a regular file, if its folder does not exist, or if the
    command reads it.
    """
    real = Path(os.path.realpath(target))
    with failing(target, "written"):
        try:
            mode = os.stat(real).st_mode
        except FileNotFoundError:
            if real.parent.is_dir():
                return real
            folder = real.parent if os.path.islink(target) else target.parent
            raise FileError(
                f"{target}: cannot be written: there is no folder {folder}"
            ) from None
    if not stat.S_ISREG(mode):
        kind = "a folder" if stat.S_ISDIR(mode) else "not a regular file"
        raise FileError(f"{target}: is {kind}; give the name of a file")
    _, inputs = _of_command.get() or (set(), set())
    _require_other(target, inputs)
    return real


def check_output_path(target: Path) -> None:
    """Raise `FileError` if a target cannot be written; commands call this before any work."""
    from tempfile import TemporaryFile

    with failing(target, "written"):
        TemporaryFile(prefix=".fflin-", dir=followed_path(target).parent).close()


def check_distinct(*targets: Path | None) -> None:
    """Raise `FileError` if two output paths lead to the same file; skip paths that are None."""
    for first, target in combinations(filter(None, targets), 2):
        same = os.path.realpath(first) == os.path.realpath(target)
        if same or same_file(first, target):
            message = f"outputs {target} and {first} are the same file"
            raise FileError(f"{message}; give each output its own file")


def missing(path: Path, otherwise: str = "") -> str:
    """Return the end of a message on a missing file: its folder, and similar names there.

    If there are no similar names, the message ends with `otherwise`.
    """
    import difflib

    try:
        folder = path.absolute().parent
        names = os.listdir(folder)
    except OSError:
        return f": its folder does not exist{otherwise}"
    if len(names) >= _MANY:
        names = []
    near = difflib.get_close_matches(path.name, names, n=3, cutoff=0.75)
    hint = otherwise
    if near:
        hint = f"; did you mean {', '.join(map(repr, near))}?"
    return f" in the folder {shown(folder)}{hint}"


def reason(error: Exception) -> str:
    """Return in one line why a file could not be read or written."""
    text = str(error)
    if isinstance(error, OSError) and error.strerror:
        text = error.strerror
    if isinstance(error, KeyError) and text.strip("'").isidentifier():
        text = f"it has no entry {text}"
    otherwise = type(error).__name__
    if isinstance(error, EOFError):
        otherwise = "the file ends too early"
    return " ".join(text.split()) or otherwise


def shown(path: str | Path) -> str:
    """Return a path for a message; a very long path is shortened to its two ends."""
    text = str(path)
    if len(text) < 500:
        return text
    return f"{text[:60]} ... {text[-60:]}"
