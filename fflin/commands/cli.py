"""Entry point: parse the arguments, run the command, and report an error in one line."""

from __future__ import annotations

import argparse
import io
import json
import math
import os
import sys
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

import fflin
from fflin.base import __version__
from fflin.base.errors import FflinError, FflinWarning, FileError
from fflin.base.paragraphs import first_paragraph
from fflin.base.tables import headed
from fflin.base.terminal import color_report
from fflin.base.writing import (
    check_ending,
    check_output_path,
    files_of_command,
    followed_path,
)
from fflin.commands import BAD_INPUT, DONE, parser

if TYPE_CHECKING:
    from fflin.commands.builders import Report

# {task: commands}, in the order of the help.
TASKS = {
    "inspect robots": ("robots", "info", "init", "view"),
    "make and check a linear model": ("linearize", "check"),
    "analyse a model": (
        "analyze",
        "modes",
        "equilibrium",
        "sensitivity",
        "uncertain",
        "validity",
        "funnel",
    ),
    "design and simulate": (
        "lqr",
        "lqg",
        "tvlqr",
        "tune",
        "plan",
        "simulate",
        "export",
    ),
    "many models or simulations": ("sweep", "montecarlo"),
}

# Commands of the module `control`; the module `models` defines all other commands.
_CONTROL = "lqr lqg tvlqr tune plan simulate export montecarlo validity funnel sweep"

# For files with these endings, the report shows the file size.
_PAGES = (".html", ".gif")

# Entries by which the class of a result is recognised if its file does not state the class.
_ENTRIES = {
    "Sensitivity": {"urdf_sha256", "dA", "dB"},
    "LinearModel": {"urdf_sha256", "certificate"},
    "LinearBatch": {"header", "B_lower"},
    "Campaign": {"header", "drawn"},
    "Motion": {"t [s]", "q_b.x"},
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command and return its exit code.

    The code is 0 for success, 1 if a check fails or a simulation ends early, and 2 for an error.
    """
    reported: set[str] = set()  # each warning is shown only once

    def show(message: Warning | str, *_: object, **__: object) -> None:
        if (text := str(message)) not in reported:
            parser.print_error(f"fflin: warning: {text}")
        reported.add(text)

    warnings.showwarning = show
    if isinstance(sys.stdout, io.TextIOWrapper):
        # Names may contain characters that the terminal cannot encode.
        sys.stdout.reconfigure(errors="backslashreplace")
    argv = sys.argv[1:] if argv is None else argv
    try:
        asked = argv[0] if argv else ""
        main_parser = _parser(asked)
        arguments, unknown = main_parser.parse_known_args(argv)
        if unknown:  # the error refers to the options of the command
            chosen = getattr(arguments, "command", main_parser)
            from difflib import get_close_matches

            near = get_close_matches(
                unknown[0], chosen._option_string_actions, n=1, cutoff=0.75
            )
            hint = f"; did you mean {near[0]}?" if near else ""
            chosen.error(f"unrecognized arguments: {' '.join(unknown)}{hint}")
        parser.settle_former_names(arguments)
        given = [
            (action.type, value)
            for action in arguments.command._actions
            if (value := getattr(arguments, action.dest, None)) is not None
        ]
        outputs = [
            (path, kind) for kind, path in given if isinstance(kind, parser.OutputFile)
        ]
        readers = parser.input_file, parser.input_name
        inputs = [Path(name) for kind, name in given if kind in readers]
        with files_of_command(inputs, [path for path, _ in outputs]):
            # Check the output files first, so that an unwritable file is reported before any
            # computation.
            for path, kind in outputs:
                # first, because it reports an output that is also an input
                check_output_path(path)
                check_ending(path, kind.endings)
                if kind.kinds and not arguments.force:
                    require_own_kind(path, kind.kinds)
            if getattr(arguments, "plot", None):
                from fflin.base.figures import require_matplotlib

                require_matplotlib()
            code = finish(arguments.run(arguments), arguments)
        if sys.stdout is not None:
            sys.stdout.flush()
        return code
    except (FflinError, FflinWarning) as error:  # Python may raise warnings as errors
        parser.print_error(f"fflin: error: {error}")
        return BAD_INPUT
    except BrokenPipeError:
        # A program that reads the output, such as head, has closed the pipe. Redirect the output,
        # because Python would report the closed pipe again at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return DONE
    except OSError as error:
        parser.print_error(
            f"fflin: error: the output cannot be written: {error.strerror}"
        )
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return BAD_INPUT


def _parser(asked: str) -> parser.Command:
    """Return the parser of the command `asked`, or of all commands if there is no such command."""
    main = parser.Command(
        prog="fflin",
        usage="fflin [-h] [--version] COMMAND ...",
        description="Linear models of free-floating robots from URDF.",
        epilog="example: fflin linearize ets_vii -o ets_vii.mat",
    )
    main.add_argument("--version", action="version", version=f"fflin {__version__}")
    commands = main.add_subparsers(
        prog="fflin", metavar="COMMAND", required=True, help=argparse.SUPPRESS
    )
    known = any(asked in names for names in TASKS.values())
    for task, names in TASKS.items():
        group = main.add_argument_group(task)
        shown = {asked} & {*names} if known else names
        for name in shown:
            module = "control" if name in _CONTROL.split() else "models"
            parser.add_command(
                commands, getattr(import_module(f"fflin.commands.{module}"), name)
            )
        # argparse puts all commands in one group; move them to the group of their task.
        group._group_actions += commands._choices_actions
        commands._choices_actions = []
    return main


def finish(report: Report, arguments: argparse.Namespace) -> int:
    """Write the files of a report, print the report, and return the exit code."""
    command = arguments.command.prog.split()[-1]
    messages = [report.interrupted]
    written: list[Path] = []
    # Write the files before the report is printed, so that a closed pipe cannot prevent writing
    # them. If writing a file fails, the report is still printed.
    try:
        for path, write in report.files.items():
            if path is None:
                continue
            if report.interrupted and path.exists():
                messages.append(f"{path} is unchanged")
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
            # The entries of `head` come first, and they override entries of the result with the
            # same names.
            print(json.dumps(head | result | head, allow_nan=False))
        else:
            lines = [headed(command, report.text)]
            for path in written:
                line = f"wrote {path}"
                if path.suffix in _PAGES:
                    line += f": {path.stat().st_size / 1e6:.2f} MB"
                lines.append(line)
            colors = getattr(arguments, "joint_colors", None)
            print(color_report("\n".join(lines), colors))
    if report.interrupted:
        raise KeyboardInterrupt("; ".join(messages))
    return report.code


def plain(value: object) -> object:
    """Convert a value for JSON: arrays to lists, results to objects, and inf or NaN to null.

    A model or design is converted to the entries of its file. Any other result is converted to its
    fields. Names that begin with "_" are omitted.
    """
    import numpy as np

    from fflin.base.record import Design, record_of
    from fflin.linear.files import record_of as record_of_model

    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, complex):
        value = {"real": value.real, "imag": value.imag}
    elif isinstance(value, fflin.LinearModel):
        value = record_of_model(value)
    elif isinstance(value, Design):
        value = record_of(value)
    elif is_dataclass(value):
        entries = {item.name: getattr(value, item.name) for item in fields(value)}
        # Omit linear models that a result contains, because `fflin linearize` prints such models.
        value = {
            key: x for key, x in entries.items() if not isinstance(x, fflin.LinearModel)
        }
    elif hasattr(value, "_asdict"):
        value = value._asdict()
    if isinstance(value, Mapping):
        return {str(key): plain(x) for key, x in value.items() if str(key)[0] != "_"}
    if isinstance(value, list | tuple):
        return [plain(x) for x in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def require_own_kind(path: Path, kinds: Sequence[str]) -> None:
    """Raise `FileError` if a non-empty file contains no result of the given `kinds`."""
    if path.suffix == ".csv" and "LinearModel" in kinds:
        from fflin.linear.files import foreign_table

        path = foreign_table(path) or path
        followed_path(path)  # refuses a table that is an input file
    if not path.is_file():
        return
    kind = kind_of(path)
    if kind not in kinds and path.stat().st_size:
        state = f"holds a {kind}" if kind else "exists and is not a result of fflin"
        raise FileError(
            f"{path} {state}; without --force, this command replaces only files that contain a "
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
            with (
                path.open("rb") as content,
                np.load(content, allow_pickle=False) as entries,
            ):
                names = {*entries}
                kind = text(entries.get("kind", ""))
        else:
            # Do not call `read_file`, because it would register the file as an input.
            entries, _ = CODECS[path.suffix][1](path.read_bytes())
            names = {*entries}
            kind = text(entries.get("kind", ""))
    except Exception:  # each decoder raises its own types of errors
        return ""
    return kind or next(
        (name for name, required in _ENTRIES.items() if required <= names), ""
    )
