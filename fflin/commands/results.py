"""Results of commands: files to write, and a report as text or JSON."""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from pathlib import Path

import fflin
from fflin.base import __version__
from fflin.base.errors import FileError
from fflin.base.tables import first_paragraph, headed
from fflin.base.writing import followed_path
from fflin.commands import DONE

# For files with these endings, the report shows the file size.
_PAGES = (".html", ".gif")


# Entries by which the kind of a result is recognised if its file does not state the kind.
_ENTRIES = {
    "Sensitivity": {"urdf_sha256", "dA", "dB"},
    "LinearModel": {"urdf_sha256", "certificate"},
    "LinearBatch": {"header", "B_lower"},
    "Campaign": {"header", "drawn"},
    "Motion": {"t [s]", "q_b.x"},
}


@dataclass(frozen=True)
class Report:
    """Report of a command.

    Attributes
    ----------
    robot : str or None
        Name of the robot.
    result : object
        Result of the library, or a mapping; --json prints its fields.
    text : str
        Report without --json. Its first paragraph is the entry "result" of --json.
    files : mapping
        {path: function that writes the file, or None if the file is already written}. An entry with
        the path None is ignored.
    code : int
        Exit code.
    interrupted : str
        Reason of an interruption, or "". Existing files are not replaced after an interruption.
    """

    robot: str | None
    result: object
    text: str
    files: Mapping[Path | None, Callable[[Path], object] | None] = field(default_factory=dict)
    code: int = DONE
    interrupted: str = ""


def finish(report: Report, arguments: argparse.Namespace) -> int:
    """Write the files of a report, print the report, and return the exit code."""
    command, said = arguments.command.prog.split()[-1], [report.interrupted]
    written: list[Path] = []
    # Write the files before the report is printed, so that a closed pipe cannot prevent writing
    # them. If writing a file fails, the report is still printed.
    try:
        for path, write in report.files.items():
            if path is None:
                continue
            if report.interrupted and path.exists():
                said.append(f"{path} is unchanged")
                continue
            if write:
                write(path)
            written.append(path)
    finally:
        if arguments.json:
            head: dict[str, object] = {
                "fflin": __version__,
                "command": command,
                "robot": report.robot,
                "result": first_paragraph(report.text),
                "files": [str(path) for path in written],
            }
            result = plain(report.result)
            assert isinstance(result, dict)
            # The common entries come first. An entry of the result with the same name does not
            # replace them.
            print(json.dumps(head | result | head, allow_nan=False))
        else:
            lines = [headed(command, report.text)]
            for path in written:
                size = f": {path.stat().st_size / 1e6:.2f} MB" if path.suffix in _PAGES else ""
                lines.append(f"wrote {path}{size}")
            print("\n".join(lines))
    if report.interrupted:
        raise KeyboardInterrupt("; ".join(said))
    return report.code


def plain(value: object) -> object:
    """Convert a value for JSON: arrays to lists, results to objects, and inf or NaN to null."""
    import numpy as np

    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, complex):
        value = {"real": value.real, "imag": value.imag}
    value = _fields(value)
    if isinstance(value, Mapping):
        return {str(key): plain(x) for key, x in value.items() if str(key)[0] != "_"}
    if isinstance(value, list | tuple):
        return [plain(x) for x in value]
    return value if not isinstance(value, float) or math.isfinite(value) else None


def _fields(value: object) -> object:
    """Return the fields of a result; if it can be saved, return the entries of its file."""
    from fflin.base.record import Design, record_of
    from fflin.linear.files import record_of as record_of_model

    if isinstance(value, fflin.LinearModel):
        return record_of_model(value)
    if isinstance(value, Design):
        return record_of(value)
    if is_dataclass(value):
        own = {each.name: getattr(value, each.name) for each in fields(value)}
        # Omit linear models, because they are results of their own.
        return {key: x for key, x in own.items() if not isinstance(x, fflin.LinearModel)}
    return value._asdict() if hasattr(value, "_asdict") else value


def require_own_kind(path: Path, kinds: Sequence[str]) -> None:
    """Raise `FileError` if -o would replace a file of another kind."""
    if path.suffix == ".csv" and "LinearModel" in kinds:
        from fflin.linear.files import foreign_table

        path = foreign_table(path) or path
        followed_path(path)  # refuses a table that is an input file
    if not path.is_file():
        return
    found = kind_of(path)
    if found not in kinds and path.stat().st_size:
        there = f"holds a {found}" if found else "exists and is not a result of fflin"
        raise FileError(
            f"{path} {there}; without --force, this command replaces only files that contain a "
            f"{' or '.join(kinds)}. Give another file name, or add --force"
        )


def kind_of(path: Path) -> str:
    """Return the class name of the result in a file, or "" if the class is unknown."""
    import numpy as np

    from fflin.base.record import CODECS, text

    kind = ""
    try:
        if path.suffix == ".csv":
            with path.open(encoding="utf-8") as file:
                names = {*file.readline().strip().split(",")}
        elif path.suffix == ".h5":
            from fflin.batch.files import hdf5

            with hdf5().File(path, "r") as file:
                names = {*file, *file.attrs}
        elif path.suffix == ".npz":
            with path.open("rb") as content, np.load(content, allow_pickle=False) as entries:
                names, kind = {*entries}, text(entries.get("kind", ""))
        else:
            entries, _ = CODECS[path.suffix][1](path.read_bytes())  # `read_file` registers an input
            names, kind = {*entries}, text(entries.get("kind", ""))
    except Exception:  # each decoder raises its own types
        return ""
    return kind or next((name for name, of in _ENTRIES.items() if of <= names), "")
