"""Parser of the command line: the options in options.txt, and functions that read their values."""

from __future__ import annotations

import argparse
import copy
import math
import os
import re
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, TypeAlias

from fflin.base.errors import one_line
from fflin.commands import BAD_INPUT

if TYPE_CHECKING:
    from fflin.commands.results import Report

Commands: TypeAlias = "argparse._SubParsersAction[Command]"


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


def attitude_number(text: str) -> int:
    """Read the number of a relative equilibrium, 1 to 24."""
    if (count := count_of(text)) > 24:
        raise argparse.ArgumentTypeError(f"{count} is too large, expected 1 to 24")
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


def lock(text: str) -> tuple[str, float | None]:
    """Read NAME=VALUE, or NAME with the value None, which means the neutral position."""
    return assignment(text) if "=" in text else (text, None)


def orbit(text: str) -> dict[str, float | str]:
    """Read ALTITUDE or ALTITUDE:BODY."""
    altitude, _, body = text.partition(":")
    return {"altitude": number(altitude), "body": body or "earth"}


def parameter_range(text: str) -> tuple[str, object]:
    """Read NAME=FRACTION or NAME=LEAST:LARGEST, with or without ,tied."""
    name, _, value = text.rpartition("=")
    tied = value.endswith(",tied")
    ends = value.removesuffix(",tied").split(":")
    if not name or len(ends) > 2:
        raise argparse.ArgumentTypeError(
            f"'{text}' is not of the form NAME=FRACTION or NAME=LEAST:LARGEST"
        )
    found = tuple(map(number, ends)) if ends[1:] else number(ends[0])
    return name, {"range": found, "tied": True} if tied else found


def grid_axis(text: str) -> tuple[str, tuple[float, float, int]]:
    """Read JOINT=LO:HI:N."""
    name, parts = _parts(text, "JOINT=LO:HI:N", "joint_1=-1:1:21")
    low, high, count = *map(number, parts[:2]), count_of(parts[2])
    if not (low < high or (count == 1 and low == high)):
        raise argparse.ArgumentTypeError(f"'{text}' is empty; LO must be less than HI")
    return name, (low, high, count)


def joint_range(text: str) -> tuple[str, tuple[float, float]]:
    """Read JOINT=LO:HI."""
    name, (low, high) = _parts(text, "JOINT=LO:HI", "joint_1=-1:1")
    return name, (number(low), number(high))


def _parts(text: str, form: str, example: str) -> tuple[str, list[str]]:
    """Split JOINT=A:B:... into the name and its values; `form` has the same number of values."""
    name, _, values = text.rpartition("=")
    parts = values.split(":")
    if not name or len(parts) != len(form.split(":")):
        raise argparse.ArgumentTypeError(f"'{text}' is not of the form {form}, such as {example}")
    return name, parts


# {word for the value in options.txt: function that reads it}; all other values are texts.
READERS: dict[str, Callable[[str], object]] = {
    **dict.fromkeys(("FPS", "H", "P", "R", "SPEED", "T", "X", "Y", "Z"), number),
    **dict.fromkeys(("K", "PORT", "S"), whole),
    **dict.fromkeys(("FILE", "DISPERSIONS"), input_file),
    **dict.fromkeys(("FILE.toml", "ROBOT", "URDF"), input_name),
    **dict.fromkeys(("NAME=VALUE", "NAME=W"), assignment),
    "N": count_of,
    "[N]": attitude_number,
    "NAME=RANGE": parameter_range,
    "NAME[=VALUE]": lock,
    "[NAME=]VALUE": joint_or_all,
    "ALTITUDE[:BODY]": orbit,
    "JOINT=LO:HI:N": grid_axis,
    "JOINT=LO:HI": joint_range,
}

_REPEATABLE = " (repeatable)"


@cache
def _blocks() -> dict[str, list[tuple[str, str]]]:
    """Return {block: lines} of options.txt, each with the text of the indented lines below it."""
    text = Path(__file__).with_name("options.txt").read_text("utf-8")
    line = re.compile(r"^(\S.*)((?:\n +.*)*)", re.MULTILINE)
    return {
        name: [(each[1], " ".join(each[2].split())) for each in line.finditer(lines)]
        for name, _, lines in (block.partition("]") for block in text.split("\n\n[")[1:])
    }


class Command(argparse.ArgumentParser):
    """Parser of a command that reports errors in one line."""

    common: Sequence[str] = ()
    required: Sequence[str] = ()
    kinds: Sequence[str] = ()

    def add_block(self, name: str, title: str = "") -> None:
        """Add the options of a block; up to its first title, they are in the group `title`."""
        for line, text in _blocks()[name]:
            key, _, values = f"{line} {text}".partition(": ")
            if key == "uses":
                for each in values.split():
                    self.add_block(each, title)
            elif key in ("common", "required", "kinds"):
                setattr(self, key, values.split())
            elif line.endswith(":"):
                title = line[:-1]
                self._group(title).description = text or None
            else:
                self._add_option(line, text, title)

    def _group(self, title: str) -> argparse._ArgumentGroup:
        groups = {each.title: each for each in self._action_groups}
        return groups.get(title) or self.add_argument_group(title)

    def _add_option(self, line: str, text: str, title: str) -> None:
        """Add an option to the group `title`, or an argument of the command."""
        parts = re.fullmatch(r"((?:-\S+ ?)*)(.*?)( \.\.\.)?(?: = (\S+))?", line)
        assert parts
        names, words, default = parts[1].split(), parts[2].split(), parts[4]
        if not words:
            action = argparse.BooleanOptionalAction if "[no-]" in line else "store_true"
            name = names[0].replace("[no-]", "")
            self._group(title).add_argument(name, help=text, action=action)
            return
        word = words[0].removesuffix("...")
        reader = READERS.get(word, str)
        more: dict[str, Any] = {"default": default, "metavar": tuple(words) if words[1:] else word}
        if parts[3]:
            text += _REPEATABLE
            more |= {"action": "append", "default": []}
        elif default and reader is not str:
            text += f"; {default} by default"
        if words[1:]:
            more["nargs"] = len(words)
        elif word != words[0]:
            more["nargs"] = "+"
        elif word == "[N]":
            more |= {"nargs": "?", "const": 1, "metavar": "N"}
        elif word.startswith("{"):
            more |= {"choices": word[1:-1].split(","), "metavar": None}
        elif word.endswith(")"):
            more["metavar"], _, endings = word[:-1].partition("(")
            reader = OutputFile(tuple(endings.split(",")))
            text = text.replace("FILE", f"FILE: {reader}")
        place = self._group(title) if names else self
        place.add_argument(*(names or [word.lower()]), help=text, type=reader, **more)

    def _print_message(self, message: str, file: object = None) -> None:
        # argparse would ignore errors in writing a help text, so the text is written here.
        print(message, end="", flush=True)

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


def add_command(commands: Commands, run: Callable[[argparse.Namespace], Report]) -> None:
    """Add the command that a function with the same name runs, with its options in options.txt.

    The docstring of the function is the help of the command: a summary, and an example at the end.
    """
    summary, _, example = (run.__doc__ or "").partition("\n\n")
    command = commands.add_parser(
        run.__name__,
        add_help=False,
        help=summary[:1].lower() + summary[1:].removesuffix("."),
        description=summary,
        epilog=example,
    )
    # A negative number such as -1e-3 is a value, not an option.
    command._negative_number_matcher = re.compile(r"^-(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?$")
    about = "show help for the common options; --help all shows help for all options"
    command.add_argument("-h", "--help", nargs="?", metavar="all", action=_Help, help=about)
    command.set_defaults(run=run, command=command)
    command.add_block("every")
    command.add_block(run.__name__)
    for action in command._actions:
        action.required |= action.dest.replace("_", "-") in command.required


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
    assert isinstance(command, Command)
    arguments = [each for each in command._actions if not each.option_strings]
    every = [each for each in command._actions if each.option_strings]
    options = {each.dest.replace("_", "-"): each for each in every[1:]}
    common = [*command.common, "json"] if command.common else options
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


def files_of(arguments: argparse.Namespace) -> tuple[list[Path], list[tuple[Path, OutputFile]]]:
    """Return the input files in the arguments, and the output files with their readers."""
    inputs, outputs = list[Path](), list[tuple[Path, OutputFile]]()
    for action in arguments.command._actions:
        value = getattr(arguments, action.dest, None)
        if value is not None and isinstance(action.type, OutputFile):
            outputs.append((value, action.type))
        elif value is not None and action.type in (input_file, input_name):
            inputs.append(Path(value))
    return inputs, outputs
