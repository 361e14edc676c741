"""Entry point: parse, run a command, convert errors to one line and an exit code."""

from __future__ import annotations

import argparse
import io
import os
import sys
import warnings
from collections.abc import Sequence
from importlib import import_module

from fflin.base import __version__
from fflin.base.errors import FflinError, FflinWarning
from fflin.base.writing import check_ending, check_output_path, files_of_command
from fflin.commands import BAD_INPUT, DONE, parser
from fflin.commands.results import finish, require_own_kind

# The commands by task, in the order of the help, each with its module.
TASKS = {
    "inspect robots": {"robots": "models", "info": "models", "init": "models", "view": "visual"},
    "make and check a linear model": {"linearize": "models", "check": "models"},
    "analyse a model": {
        **dict.fromkeys(("analyze", "modes", "equilibrium", "sensitivity"), "analysis"),
        **{"uncertain": "analysis", "validity": "regions", "funnel": "regions"},
    },
    "design and simulate": {
        **{
            "lqr": "regulator",
            "tvlqr": "regulator",
            "plan": "simulation",
            "simulate": "simulation",
        },
        "export": "regulator",
    },
    "many models or simulations": {"sweep": "sweeps", "montecarlo": "simulation"},
}
_MODULES = {name: module for names in TASKS.values() for name, module in names.items()}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return 0 done, 1 a check failed, 2 invalid input."""
    reported: set[str] = set()  # each warning once per command

    def show(message: Warning | str, *_: object, **__: object) -> None:
        if (text := str(message)) not in reported:
            parser.print_error(f"fflin: warning: {text}")
        reported.add(text)

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
            from difflib import get_close_matches

            near = get_close_matches(unknown[0], chosen._option_string_actions, n=1, cutoff=0.75)
            hint = f"; did you mean {near[0]}?" if near else ""
            chosen.error(f"unrecognized arguments: {' '.join(unknown)}{hint}")
        with files_of_command(*parser.files_of(arguments)):
            check_outputs(arguments)
            code = finish(arguments.run(arguments), arguments)
        if sys.stdout is not None:
            sys.stdout.flush()
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
