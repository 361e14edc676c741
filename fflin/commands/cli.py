"""Entry point: parse, run a command, convert errors to one line and an exit code."""

from __future__ import annotations

import argparse
import io
import os
import sys
import warnings
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

from fflin.base import __version__
from fflin.base.errors import FflinError, FflinWarning, FileError
from fflin.base.writing import check_ending, check_output_path, files_of_command, followed_path
from fflin.commands import BAD_INPUT, DONE, parser
from fflin.commands.results import finish

# The commands by task, in the order of the help, each with its module.
TASKS = {
    "inspect robots": {"robots": "models", "info": "models", "init": "models", "view": "visual"},
    "make and check a linear model": {"linearize": "models", "check": "models"},
    "analyse a model": {
        **dict.fromkeys(("analyze", "modes", "equilibrium", "sensitivity"), "analysis"),
        **{"uncertain": "analysis", "validity": "regions", "funnel": "regions"},
    },
    "design and simulate": {
        **{"lqr": "regulator", "tvlqr": "tracking", "plan": "simulation", "simulate": "simulation"},
        "export": "regulator",
    },
    "many models or simulations": {"sweep": "sweeps", "montecarlo": "montecarlo"},
}
_MODULES = {name: module for names in TASKS.values() for name, module in names.items()}


# The entries by which a result is known whose file does not name its kind.
_ENTRIES = {
    "Sensitivity": {"urdf_sha256", "dA", "dB"},
    "LinearModel": {"urdf_sha256", "certificate"},
    "LinearBatch": {"header", "B_lower"},
    "Campaign": {"header", "drawn"},
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return 0 done, 1 a check failed, 2 invalid input."""
    # Warnings of other packages are shown after success only: an error has its own reason.
    held: list[str] = []
    reported: set[str] = set()  # each once per command

    def show(message: Warning | str, category: type[Warning], *_: object, **__: object) -> None:
        text = str(message)
        if issubclass(category, FflinWarning):
            if text not in reported:
                parser.print_error(f"fflin: warning: {text}")
            reported.add(text)
        else:
            held.append(f"fflin: {category.__name__}: {' '.join(text.split())}")

    warnings.showwarning = show
    if isinstance(sys.stdout, io.TextIOWrapper):
        # Names may contain characters that the terminal cannot show.
        sys.stdout.reconfigure(errors="backslashreplace")
    argv = sys.argv[1:] if argv is None else argv
    try:
        main_parser = _parser(argv[0] if argv else "")
        arguments, unknown = main_parser.parse_known_args(argv)
        if unknown:  # its command has the list of options
            chosen = getattr(arguments, "command", main_parser)
            chosen.error(f"unrecognized arguments: {' '.join(unknown)}")
        with files_of_command(*parser.files_of(arguments)):
            check_outputs(arguments)
            code = finish(arguments.run(arguments), arguments)
        if sys.stdout is not None:
            sys.stdout.flush()
        for line in held:
            parser.print_error(line)
        return code
    except (FflinError, FflinWarning) as error:  # a warning if Python raises warnings
        parser.print_error(f"fflin: error: {error}")
        return BAD_INPUT
    except BrokenPipeError:
        # The reader, such as head, closed the pipe; the interpreter must not report it at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return DONE
    except OSError as error:
        parser.print_error(f"fflin: error: the output cannot be written: {error.strerror}")
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return BAD_INPUT


def _parser(asked: str) -> parser.Command:
    """Return the parser of one command, or of all commands."""
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
    for name in [_MODULES[asked]] if asked in _MODULES else dict.fromkeys(_MODULES.values()):
        import_module(f"fflin.commands.{name}").add_commands(commands)
    # argparse puts all commands in one group.
    left = {command.dest: command for command in commands._choices_actions}
    commands._choices_actions = []
    for task, names in TASKS.items():
        group = main.add_argument_group(task)._group_actions
        group += [left[name] for name in names if name in left]
    return main


def check_outputs(arguments: argparse.Namespace) -> None:
    """Refuse output files that cannot be written, before any computation."""
    for path, kind in parser.outputs_of(arguments):
        check_output_path(path)  # first, since it says that an output is an input
        check_ending(path, kind.endings)
        if kind is parser.FIGURE:
            from fflin.base.figures import require_matplotlib

            require_matplotlib()
    require_own_kind(arguments)


def require_own_kind(arguments: argparse.Namespace) -> None:
    """Raise `FileError` if -o names a file of a kind that the command does not write."""
    path, kinds = getattr(arguments, "output_file", None), getattr(arguments, "kinds", ())
    if path is None or not kinds or arguments.force:
        return
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
    """Return the name of the class of a file's result; "" if it is not known."""
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
        return names, "Motion" if {"t [s]", "q_b.x"} <= names else ""
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
