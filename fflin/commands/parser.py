"""Command line parser: commands, groups of options, and functions that read values."""

from __future__ import annotations

import argparse
import copy
import math
import os
import re
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, TypeAlias

from fflin.base.errors import one_line
from fflin.commands import BAD_INPUT

if TYPE_CHECKING:
    from fflin.commands.results import Report

Commands: TypeAlias = "argparse._SubParsersAction[Command]"

# Titles of groups of options in the help. The options of ROBOT override settings of robot.toml.
POINT, ROBOT, OUTPUT = "operating point", "robot (these options override robot.toml)", "output"
TRAJECTORY, CONTROLLER, SIMULATION = "trajectory", "controller", "simulation"


def number(text: str) -> float:
    """Read a finite number."""
    try:
        value = float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"'{text}' is not a number") from None
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"'{text}' is not a finite number")
    return value


def whole(text: str) -> int:
    """Read a non-negative integer."""
    if not text.isascii() or not text.isdigit():
        raise argparse.ArgumentTypeError(f"'{text}' is not a non-negative integer")
    return int(text)


def count_of(text: str) -> int:
    """Read a positive integer."""
    if not (count := whole(text)):
        raise argparse.ArgumentTypeError("0 is too small, expected 1 or more")
    return count


def input_file(text: str) -> Path:
    """Read the path of an input file."""
    if not text:
        raise argparse.ArgumentTypeError("the file name is empty, expected a path")
    return Path(text)


def input_name(text: str) -> str:
    """Read a bundled name or the path of an input file."""
    return text


@dataclass(frozen=True)
class OutputFile:
    """Reader for the path of an output file, with the allowed endings."""

    endings: tuple[str, ...]

    def __call__(self, text: str) -> Path:
        """Read the path."""
        return input_file(text)

    def __str__(self) -> str:
        *first, last = self.endings
        return f"{', '.join(first)} or {last}" if first else last


RECORD, TABLE = OutputFile((".npz", ".mat", ".json")), OutputFile((".npz", ".mat", ".json", ".csv"))
ROWS, FIGURE = OutputFile((".npz", ".h5")), OutputFile((".png", ".pdf", ".svg"))
RUNS = OutputFile((".npz", ".h5", ".csv", ".mat"))
PAGE, PICTURE, ANIMATION = (OutputFile((f".{ending}",)) for ending in ("html", "png", "gif"))


def assignment(text: str) -> tuple[str, float]:
    """Read NAME=VALUE."""
    name, separator, value = text.rpartition("=")
    if not separator or not name:
        raise argparse.ArgumentTypeError(f"'{text}' is not of the form NAME=VALUE")
    return name, number(value)


def joint_or_all(text: str) -> tuple[str | None, float | str]:
    """Read NAME=VALUE, or for all joints VALUE or urdf alone, with None as the name."""
    if "=" in text:
        return assignment(text)
    return None, text if text == "urdf" else number(text)


def orbit(text: str) -> dict[str, float | str]:
    """Read ALTITUDE or ALTITUDE:BODY."""
    altitude, _, body = text.partition(":")
    return {"altitude": number(altitude), "body": body or "earth"}


def lock(text: str) -> tuple[str, float | None]:
    """Read NAME=VALUE, or NAME with the value None, which means the neutral position."""
    return assignment(text) if "=" in text else (text, None)


_REPEATABLE = " (repeatable)"
# Readers for the Python types that `Group.add` accepts.
_READERS: dict[object, Callable[[str], object]] = {float: number, int: count_of, Path: input_file}
_METAVARS: dict[object, str] = {
    input_file: "FILE",
    input_name: "FILE.toml",
    assignment: "NAME=VALUE",
    joint_or_all: "[NAME=]VALUE",
    lock: "NAME[=VALUE]",
    orbit: "ALTITUDE[:BODY]",
    count_of: "N",
}


class Group(argparse._ArgumentGroup):
    """Group of options of a command."""

    def add(
        self,
        name: str,
        help: str,
        type: Callable[[str], object] = str,
        metavar: str | tuple[str, ...] | None = None,
        *,
        default: object = None,
        repeatable: bool = False,
        **more: Any,
    ) -> None:
        """Add an option with a value.

        For the type float, the value must be finite. For int, it must be a positive integer. For
        Path, it is the name of an input file. If `metavar` is a tuple, the option takes one value
        for each entry. For a number, the help contains the default.
        """
        reader = _READERS.get(type, type)
        if repeatable:
            more |= {"action": "append", "default": []}
            help += _REPEATABLE
        else:
            more["default"] = default
        if default is not None and reader in (number, whole, count_of):
            help = f"{help}; {default:g} by default"
        if isinstance(metavar, tuple):
            more["nargs"] = len(metavar)
        if "choices" not in more or metavar:
            file = "FILE" if isinstance(reader, OutputFile) else None
            more["metavar"] = metavar or _METAVARS.get(reader, file)
        self.add_argument(name, help=help, type=reader, **more)

    def switch(self, name: str, help: str) -> None:
        """Add an option without a value."""
        self.add_argument(name, help=help, action="store_true")

    def yes_or_no(self, name: str, help: str) -> None:
        """Add the options --NAME and --no-NAME; the value is None if neither is given."""
        self.add_argument(name, help=help, action=argparse.BooleanOptionalAction)


class Command(argparse.ArgumentParser):
    """Parser of a command that reports errors in one line."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        # A negative number such as -1e-3 is a value, not an option.
        self._negative_number_matcher = re.compile(r"^-(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?$")

    def group(self, title: str, description: str | None = None) -> Group:
        """Return the group of options with this title, which the first call creates."""
        for group in self._action_groups:
            if isinstance(group, Group) and group.title == title:
                return group
        group = Group(self, title, description)
        self._action_groups.append(group)
        return group

    def _print_message(self, message: str, file: Any = None) -> None:
        # argparse would ignore errors in writing a help text, so the text is written here.
        if file is not None:
            file.write(message)
            file.flush()

    def error(self, message: str) -> NoReturn:
        """Report invalid arguments in one line, explain missing arguments, and exit."""
        if "required: DISPERSIONS" in message:
            message += "; DISPERSIONS is a TOML file with lines such as [dispersions] and "
            message += '"base.mass" = 0.05'
        print_error(f"fflin: error: {message} (see {self.prog} --help)")
        self.exit(BAD_INPUT)


def print_error(line: str) -> None:
    """Write a line to stderr. If stderr is closed, only the exit code reports the error."""
    try:
        print(one_line(line), file=sys.stderr, flush=True)
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stderr.fileno())


def command(
    commands: Commands, run: Callable[[argparse.Namespace], Report], common: str = ""
) -> Command:
    """Add the command `name` that the function `_name` runs, and its option --json.

    The docstring of the function is the help of the command: a summary, and an example at the end.
    ``--help`` lists --json and the `common` options, or all options if `common` is empty.
    """
    summary, _, example = (run.__doc__ or "").partition("\n\n")
    command = commands.add_parser(
        run.__name__.removeprefix("_"),
        add_help=False,
        help=summary[:1].lower() + summary[1:].removesuffix("."),
        description=summary,
        epilog=example,
    )
    about = "show help for the common options; --help all shows help for all options"
    command.add_argument("-h", "--help", nargs="?", metavar="all", action=_Help, help=about)
    command.set_defaults(run=run, command=command, common=[*common.split(), "json"] * bool(common))
    command.group(OUTPUT).switch("--json", "print the results as one JSON object")
    return command


class _Help(argparse.Action):
    """Option that prints the short help, or the full help if its value is `all`."""

    def __call__(
        self, parser: argparse.ArgumentParser, _: object, value: object, *__: object
    ) -> None:
        text = parser.format_help() if value == "all" else short_help(parser)
        parser._print_message(text, sys.stdout)
        parser.exit()


def short_help(command: argparse.ArgumentParser) -> str:
    """Return a short help: the first sentence about each common option of a command."""
    arguments = [each for each in command._actions if not each.option_strings]
    every = [each for each in command._actions if each.option_strings]
    options = {each.dest: each for each in reversed(every)}  # a new name overrides its former name
    del options["help"]
    common = [name.replace("-", "_") for name in command.get_default("common")] or list(options)
    formatter = argparse.HelpFormatter(command.prog, max_help_position=30)
    required = [f"{each.option_strings[-1]} {each.metavar}" for each in every if each.required]
    operands = " ".join([*(str(each.metavar) for each in arguments), *required])
    formatter.add_text(" ".join(f"usage: {command.prog} {operands} [options]".split()))
    formatter.add_text(command.description)
    for title, actions in (
        ("arguments", arguments),
        ("options", [options[name] for name in common]),
    ):
        formatter.start_section(title)
        for action in actions:
            shown, text = copy.copy(action), action.help or ""
            first = re.split(r"; |(?<!\.)\. ", text.removesuffix(_REPEATABLE))[0]
            shown.help = first + _REPEATABLE * text.endswith(_REPEATABLE)
            formatter.add_argument(shown)
        formatter.end_section()
    formatter.add_text(command.epilog)
    if options:
        formatter.add_text(f"help for all {len(every) - 1} options: {command.prog} --help all")
    return formatter.format_help()


def files_of(arguments: argparse.Namespace) -> tuple[list[Path], list[Path]]:
    """Return all input files and output files in the arguments."""
    inputs: list[Path] = []
    for action in arguments.command._actions:
        value = getattr(arguments, action.dest, None)
        if action.type in (input_file, input_name) and value is not None:
            inputs += map(Path, value if isinstance(value, list) else [value])
    return inputs, [path for path, _ in outputs_of(arguments)]


def outputs_of(arguments: argparse.Namespace) -> list[tuple[Path, OutputFile]]:
    """Return all output files in the arguments, each with its reader."""
    actions = arguments.command._actions
    given = ((getattr(arguments, action.dest, None), action.type) for action in actions)
    return [(path, kind) for path, kind in given if isinstance(kind, OutputFile) and path]
