"""The command line: parses, runs a command, and turns errors into lines and exit codes."""

from __future__ import annotations

import argparse
import io
import os
import re
import sys
import warnings
from collections.abc import Sequence
from importlib import import_module
from typing import Any, NoReturn

from fflin.base.errors import FflinError, FflinWarning, one_line
from fflin.base.version import __version__
from fflin.base.writing import files_of_command
from fflin.commands import BAD_INPUT, DONE
from fflin.commands.arguments import files_of
from fflin.commands.kinds import require_own_kind

# The commands by task, as the help lists them, each with its module.
TASKS = {
    "look at robots": {"robots": "models", "info": "models", "init": "init", "view": "visual"},
    "make and check a linear model": {"linearize": "models", "check": "models"},
    "judge it": {
        **dict.fromkeys(("analyze", "modes", "validity", "sensitivity", "uncertain"), "analysis"),
        "funnel": "funnels",
    },
    "close the loop": {"lqr": "regulator", "tvlqr": "tracking", "simulate": "simulation"},
    "go through many": {"sweep": "sweeps", "montecarlo": "montecarlo"},
}
_MODULES = {name: module for names in TASKS.values() for name, module in names.items()}


class _Parser(argparse.ArgumentParser):
    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        # What is a negative number and no option; by default -1e-3 is taken for one.
        self._negative_number_matcher = re.compile(r"^-(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?$")

    def _print_message(self, message: str, file: Any = None) -> None:
        # argparse ignores that a help cannot be written.
        if file is not None:
            file.write(message)
            file.flush()

    def error(self, message: str) -> NoReturn:
        _tell(f"fflin: error: {message} (see {self.prog} --help)")
        self.exit(BAD_INPUT)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return 0 done, 1 a check fell short, 2 bad input."""
    # What other packages warn of is shown at the end of what went well: an error says why.
    held: list[str] = []
    told: set[str] = set()  # each once, however many models a command makes

    def show(message: Warning | str, category: type[Warning], *_: object, **__: object) -> None:
        text = str(message)
        if issubclass(category, FflinWarning):
            if text not in told:
                _tell(f"fflin: warning: {text}")
            told.add(text)
        else:
            held.append(f"fflin: {category.__name__}: {' '.join(text.split())}")

    warnings.showwarning = show
    if isinstance(sys.stdout, io.TextIOWrapper):
        # Names may hold what the terminal cannot show.
        sys.stdout.reconfigure(errors="backslashreplace")
    argv = sys.argv[1:] if argv is None else argv
    try:
        arguments = _parser(argv[0] if argv else "").parse_args(argv)
        with files_of_command(*files_of(arguments)):
            require_own_kind(arguments)
            code: int = arguments.run(arguments)
        if sys.stdout is not None:
            sys.stdout.flush()
        for line in held:
            _tell(line)
        return code
    except (FflinError, FflinWarning) as error:  # a warning where Python is told to raise them
        _tell(f"fflin: error: {error}")
        return BAD_INPUT
    except BrokenPipeError:
        # The reader, such as head, has what it wanted; the interpreter must not complain either.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return DONE
    except OSError as error:
        _tell(f"fflin: error: the output cannot be written: {error.strerror}")
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return BAD_INPUT


def _tell(line: str) -> None:
    """Write a line to stderr; the exit code tells enough where that cannot be written."""
    try:
        print(one_line(line), file=sys.stderr, flush=True)
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stderr.fileno())


def _parser(asked: str) -> argparse.ArgumentParser:
    """Make the parser of the command that is asked for, or else of all of them."""
    parser = _Parser(
        prog="fflin",
        usage="fflin [-h] [--version] COMMAND ...",
        description="Linear models of free-floating robots from URDF.",
        epilog="example: fflin linearize ets_vii -o ets_vii.mat",
    )
    parser.add_argument("--version", action="version", version=f"fflin {__version__}")
    commands = parser.add_subparsers(
        prog="fflin", metavar="COMMAND", required=True, help=argparse.SUPPRESS
    )
    for name in [_MODULES[asked]] if asked in _MODULES else dict.fromkeys(_MODULES.values()):
        import_module(f"fflin.commands.{name}").add_commands(commands)
    # argparse lists all in one group.
    left = {command.dest: command for command in commands._choices_actions}
    commands._choices_actions = []
    for task, names in TASKS.items():
        group = parser.add_argument_group(task)._group_actions
        group += [left[name] for name in names if name in left]
    return parser
