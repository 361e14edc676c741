"""Entry point: parse the arguments, run the command, and report an error in one line."""

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
from fflin.commands import BAD_INPUT, DONE, options, parser
from fflin.commands.results import finish, require_own_kind

# {task: commands}, in the order of the help.
TASKS = {
    "inspect robots": ("robots", "info", "init", "view"),
    "make and check a linear model": ("linearize", "check"),
    "analyse a model": (
        *("analyze", "modes", "equilibrium", "sensitivity"),
        *("uncertain", "validity", "funnel"),
    ),
    "design and simulate": ("lqr", "tvlqr", "plan", "simulate", "export"),
    "many models or simulations": ("sweep", "montecarlo"),
}

# {command: module that defines it}. The module `models` defines all other commands.
_MODULES = {
    **dict.fromkeys(("montecarlo", "validity", "funnel", "sweep"), "campaigns"),
    **dict.fromkeys(("lqr", "tvlqr", "plan", "simulate", "export", "view"), "control"),
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; return 0 if it succeeds, 1 if a check fails, 2 for invalid input."""
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
        main_parser = _parser(argv[0] if argv else "")
        arguments, unknown = main_parser.parse_known_args(argv)
        if unknown:  # the error refers to the options of the command
            chosen = getattr(arguments, "command", main_parser)
            from difflib import get_close_matches

            near = get_close_matches(unknown[0], chosen._option_string_actions, n=1, cutoff=0.75)
            hint = f"; did you mean {near[0]}?" if near else ""
            chosen.error(f"unrecognized arguments: {' '.join(unknown)}{hint}")
        parser.settle_former_names(arguments)
        inputs, outputs = parser.files_of(arguments)
        with files_of_command(inputs, [path for path, _ in outputs]):
            # Check the output files first, so that an unwritable file is reported before any
            # computation.
            for path, kind in outputs:
                check_output_path(path)  # first, because it reports an output that is also an input
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
        parser.print_error(f"fflin: error: the output cannot be written: {error.strerror}")
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
        for name in names if not known else {asked} & {*names}:
            module = import_module(f"fflin.commands.{_MODULES.get(name, 'models')}")
            options.add_command(commands, getattr(module, name))
        # argparse puts all commands in one group; move them to the group of their task.
        group._group_actions += commands._choices_actions
        commands._choices_actions = []
    return main
