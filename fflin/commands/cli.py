"""Entry point: parse, run a command, convert errors to one line and an exit code."""

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

# The commands by task, in the order of the help, each with its module.
TASKS = {
    "inspect robots": {"robots": "models", "info": "models", "init": "init", "view": "visual"},
    "make and check a linear model": {"linearize": "models", "check": "models"},
    "analyse a model": {
        **dict.fromkeys(("analyze", "modes", "validity", "sensitivity", "uncertain"), "analysis"),
        "funnel": "funnels",
    },
    "design and simulate": {"lqr": "regulator", "tvlqr": "tracking", "simulate": "simulation"},
    "many models or simulations": {"sweep": "sweeps", "montecarlo": "montecarlo"},
}
_MODULES = {name: module for names in TASKS.values() for name, module in names.items()}


class _Parser(argparse.ArgumentParser):
    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        # A negative number such as -1e-3 is a value, not an option.
        self._negative_number_matcher = re.compile(r"^-(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?$")

    def _print_message(self, message: str, file: Any = None) -> None:
        # argparse ignores errors when it writes a help.
        if file is not None:
            file.write(message)
            file.flush()

    def error(self, message: str) -> NoReturn:
        _tell(f"fflin: error: {message} (see {self.prog} --help)")
        self.exit(BAD_INPUT)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return 0 done, 1 a check failed, 2 invalid input."""
    # Warnings of other packages are shown after success only: an error has its own reason.
    held: list[str] = []
    told: set[str] = set()  # each once per command

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
        # Names may contain characters that the terminal cannot show.
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
    except (FflinError, FflinWarning) as error:  # a warning if Python raises warnings
        _tell(f"fflin: error: {error}")
        return BAD_INPUT
    except BrokenPipeError:
        # The reader, such as head, closed the pipe; the interpreter must not report it at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return DONE
    except OSError as error:
        _tell(f"fflin: error: the output cannot be written: {error.strerror}")
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return BAD_INPUT


def _tell(line: str) -> None:
    """Write a line to stderr; if stderr is closed, the exit code is the only report."""
    try:
        print(one_line(line), file=sys.stderr, flush=True)
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stderr.fileno())


def _parser(asked: str) -> argparse.ArgumentParser:
    """Return the parser of one command, or of all commands."""
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
    # argparse puts all commands in one group.
    left = {command.dest: command for command in commands._choices_actions}
    commands._choices_actions = []
    for task, names in TASKS.items():
        group = parser.add_argument_group(task)._group_actions
        group += [left[name] for name in names if name in left]
    return parser
