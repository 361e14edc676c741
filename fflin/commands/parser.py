"""Parser of a command, the `add_argument` keywords of all options, and readers of option values."""

from __future__ import annotations

import argparse
import copy
import math
import os
import re
import sys
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn, TypeAlias

from fflin.base.errors import FflinWarning, one_line
from fflin.base.terminal import color_message
from fflin.base.writing import RECORDS
from fflin.commands import BAD_INPUT, NO_ORBIT
from fflin.commands.options import ABOUT, COMMON, DESCRIPTIONS, OPTIONS, OUTPUT
from fflin.dynamics.methods import DEFAULT_METHOD


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
    if not whole(text):
        raise argparse.ArgumentTypeError("0 is too small, expected 1 or more")
    return int(text)


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
    """Reader for the path of an output file, which must have one of the `endings`.

    `kinds` are class names of results. If there are any, the command replaces an existing file only
    if the file contains such a result, or if --force is given.
    """

    endings: tuple[str, ...]
    kinds: tuple[str, ...] = ()

    def __call__(self, text: str) -> Path:
        """Read the path."""
        return input_file(text)

    def __str__(self) -> str:
        *first, last = self.endings
        if first:
            return f"{', '.join(first)} or {last}"
        return last


def assignment(text: str) -> tuple[str, float]:
    """Read NAME=VALUE."""
    name, (value,) = _parts(text, "NAME=VALUE", 1)
    return name, number(value)


def joint_or_all(text: str) -> tuple[str | None, float | str]:
    """Read NAME=VALUE for one joint, or VALUE or the word `urdf` for all joints.

    Return (name, value); the name is None for all joints.
    """
    if "=" in text:
        return assignment(text)
    if text == "urdf":
        return None, text
    return None, number(text)


def lock(text: str) -> tuple[str, float | None]:
    """Read NAME=VALUE or NAME; return (name, value), or (name, None) for the neutral position."""
    if "=" in text:
        return assignment(text)
    return text, None


def weld(text: str) -> tuple[str, str | None]:
    """Read FRAME=TO or FRAME; return (frame, to), or (frame, None) for inertial space."""
    frame, equals, to = text.partition("=")
    if not frame or (equals and not to):
        raise argparse.ArgumentTypeError(
            f"'{text}' is not FRAME or FRAME=TO, such as tool_left=tool_right"
        )
    return frame, to or None


def xacro_argument(text: str) -> tuple[str, str]:
    """Read NAME=VALUE, the value of an argument of a xacro file."""
    name, equals, value = text.partition("=")
    if not (name and equals):
        raise argparse.ArgumentTypeError(
            f"'{text}' is not NAME=VALUE, such as arm=long"
        )
    return name, value


def orbit(text: str) -> dict[str, float | str] | str:
    """Read ALTITUDE or PERIGEE/APOGEE, with :BODY or without it; none removes an orbit."""
    if text == NO_ORBIT:
        return text
    heights, _, body = text.partition(":")
    low, slash, high = heights.partition("/")
    given: dict[str, float | str] = {"body": body or "earth"}
    if slash:
        return given | {"perigee": number(low), "apogee": number(high)}
    return given | {"altitude": number(low)}


def parameter_range(text: str) -> tuple[str, object]:
    """Read NAME=FRACTION or NAME=LEAST:LARGEST; both forms can end with ",tied"."""
    name, ends = _parts(text, "NAME=FRACTION or NAME=LEAST:LARGEST", 1, 2)
    tied = ends[-1].endswith(",tied")
    ends[-1] = ends[-1].removesuffix(",tied")
    bounds = tuple(map(number, ends)) if ends[1:] else number(ends[0])
    if tied:
        return name, {"range": bounds, "tied": True}
    return name, bounds


# Largest number of values of one joint in a grid. They are all in memory.
_MOST_POINTS = 1_000_000


def grid_axis(text: str) -> tuple[str, tuple[float, float, int]]:
    """Read JOINT=LO:HI:N."""
    name, (*ends, points) = _parts(text, "JOINT=LO:HI:N, such as joint_1=-1:1:21", 3)
    low, high = map(number, ends)
    count = count_of(points)
    if count > _MOST_POINTS:
        raise argparse.ArgumentTypeError(
            f"'{text}' has too many points, expected at most {_MOST_POINTS:,} for each joint"
        )
    if not (low < high or (count == 1 and low == high)):
        raise argparse.ArgumentTypeError(f"'{text}' is empty; LO must be less than HI")
    return name, (low, high, count)


def joint_range(text: str) -> tuple[str, tuple[float, float]]:
    """Read JOINT=LO:HI."""
    name, (low, high) = _parts(text, "JOINT=LO:HI, such as joint_1=-1:1", 2)
    return name, (number(low), number(high))


def _parts(text: str, form: str, *counts: int) -> tuple[str, list[str]]:
    """Split NAME=A:B:... into NAME and [A, B, ...]; `counts` are the valid numbers of values."""
    name, _, values = text.rpartition("=")
    parts = values.split(":")
    if not name or len(parts) not in counts:
        raise argparse.ArgumentTypeError(f"'{text}' is not of the form {form}")
    return name, parts


# keywords of `argparse.ArgumentParser.add_argument`
Form: TypeAlias = Mapping[str, Any]


def one(
    reader: Callable[[str], object],
    metavar: str | tuple[str, ...],
    default: float | str | None = None,
    **more: object,
) -> Form:
    """Return the `Form` of an option of which only the last occurrence counts."""
    return {"type": reader, "metavar": metavar, "default": default, **more}


def many(reader: Callable[[str], object], metavar: str, **more: object) -> Form:
    """Return the `Form` of a repeatable option, whose values form a list."""
    return {
        "type": reader,
        "metavar": metavar,
        "action": "append",
        "default": [],
        **more,
    }


def _saved(*kinds: str, endings: tuple[str, ...] = RECORDS) -> Form:
    """Return the `Form` of the option -o; `kinds` are the class names of the command's results."""
    return one(OutputFile(endings, kinds), "FILE")


_PAIRS = many(assignment, "NAME=VALUE")
_WEIGHTS = many(assignment, "NAME=W")
_OF_JOINT = many(joint_or_all, "[NAME=]VALUE")
_NAMES = many(str, "NAME")
_ANGLES = one(number, ("R", "P", "Y"), nargs=3)
_AXES = one(number, ("X", "Y", "Z"), nargs=3)
_TIME, _FILE, _COUNT = one(number, "H"), one(input_file, "FILE"), one(count_of, "N")
_YES_OR_NO: Form = {"action": argparse.BooleanOptionalAction}
_FORMER: Form = {**_TIME, "dest": "former_dt"}
_UNSATURATED: Form = {"choices": ("urdf", "none"), "default": "none"}
_TABLE = (*RECORDS, ".csv")

# {option or ARGUMENT: its `Form`}. A key "COMMAND OPTION" applies to this command only.
# Options without an entry are switches.
FORMS: dict[str, Form] = {
    "ROBOT": {"dest": "robot", "type": input_name, "metavar": "ROBOT"},
    "URDF": {"dest": "robot", "type": input_name, "metavar": "URDF"},
    "FILE": {"dest": "file", "type": input_file, "metavar": "FILE"},
    "DISPERSIONS": {
        "dest": "dispersions",
        "type": input_file,
        "metavar": "DISPERSIONS",
    },
    **dict.fromkeys(
        ("joint", "velocity", "target-joint", "target-velocity", "offset"), _PAIRS
    ),
    **dict.fromkeys(("effort", "limit", "bryson", "qf", "goal", "within"), _PAIRS),
    **dict.fromkeys(("noise", "bias"), _PAIRS),
    "q": _WEIGHTS,
    "r": _WEIGHTS,
    "stiffness": _OF_JOINT,
    "damping": _OF_JOINT,
    "passive": _NAMES,
    "independent": _NAMES,
    "integral": _NAMES,
    "free-end": _NAMES,
    "show": _NAMES,
    "output": many(str, "SPEC"),
    "lock": many(lock, "NAME[=VALUE]"),
    "weld": many(weld, "FRAME[=TO]"),
    "xacro": many(xacro_argument, "NAME=VALUE"),
    "vary": many(parameter_range, "NAME=RANGE", required=True),
    "grid": many(grid_axis, "JOINT=LO:HI:N"),
    "range": many(joint_range, "JOINT=LO:HI"),
    "orbit": one(orbit, "ALTITUDE|PERIGEE/APOGEE[:BODY]|none"),
    "inclination": one(number, "I"),
    "field": one(str, "FIELD"),
    "rpy": _ANGLES,
    "target-rpy": _ANGLES,
    "position": _AXES,
    "target-position": _AXES,
    "gravity": _AXES,
    "dt": _TIME,
    "step": _TIME,
    "sample": _TIME,
    "duration": one(number, "T"),
    "pointing": one(number, "WINDOW"),
    "accuracy": one(number, "X"),
    "delay": one(number, "T"),
    "times": one(number, "T", nargs="+"),
    "attitude": one(number, "X", 90.0),
    "spread": one(number, "X", 1.0),
    "tolerance": one(number, "X"),
    "width": one(number, "P", 0.02),
    "confidence": one(number, "P", 0.95),
    "fps": one(number, "FPS", 30.0),
    "speed": one(number, "SPEED"),
    **dict.fromkeys(("every", "random", "workers", "threads"), _COUNT),
    "periodic": one(count_of, "N"),
    "motion": {"choices": ("held", "free")},
    **dict.fromkeys(("time", "period"), one(number, "T")),
    **dict.fromkeys(("bdot", "rate-damping"), one(number, "GAIN")),
    "runs": one(count_of, "N", required=True),
    "samples": one(count_of, "N", 100),
    "top": one(count_of, "N", 15),
    "knots": one(count_of, "N", 101),
    "horizon": one(count_of, "N", 20),
    "jobs": one(count_of, "N", 1),
    "relative-equilibrium": one(
        count_of, "N", nargs="?", const=1, choices=range(1, 25)
    ),
    "seed": one(whole, "S", 0),
    "worst": one(whole, "K", 3),
    "port": one(whole, "N"),
    **dict.fromkeys(
        ("trajectory", "schedule", "gain", "controller", "guess", "after"), _FILE
    ),
    "inputs": one(input_name, "FILE.toml"),
    "robot": one(input_name, "ROBOT"),
    "only": one(str, "NAME"),
    "until": one(str, "CONDITION"),
    "tool": one(str, "FRAME"),
    "method": one(str, "METHOD", DEFAULT_METHOD),
    "name": one(str, "NAME", "controller"),
    "output-folder": one(str, "FOLDER", required=True),
    "frame": {"choices": ("hybrid", "local", "world", "lvlh", "hill")},
    "reference": {"choices": ("base", "world"), "default": "base"},
    "hold": {"choices": ("linear", "previous")},
    "weights": {"choices": ("urdf", "identity")},
    "limits": {"choices": ("urdf", "none"), "default": "urdf"},
    "engine": {"choices": ("compiled", "python")},
    "scene": {"choices": ("space", "lab")},
    "for": {
        "choices": (
            "drake",
            "mujoco",
            "pinocchio",
            "crocoddyl",
            "spart",
            "euler",
            "euler_rates",
        ),
        "metavar": "TOOL",
    },
    "real": {"choices": ("double", "float"), "default": "double"},
    **dict.fromkeys(("wheel-speeds", "allocate", "follow", "tilt"), _YES_OR_NO),
    "plot": one(OutputFile((".png", ".pdf", ".svg")), "FILE"),
    **{
        ending: one(OutputFile((f".{ending}",)), "FILE")
        for ending in ("html", "png", "gif")
    },
    "init output-file": _saved(endings=(".toml",)),
    "view frame": {"choices": ("lvlh", "hill")},
    "linearize output-file": _saved(
        "LinearModel", "LinearTrajectory", "ToolModel", endings=_TABLE
    ),
    "equilibrium output-file": _saved("Equilibrium"),
    "sensitivity output-file": _saved("Sensitivity"),
    "uncertain output-file": _saved("LFT"),
    **dict.fromkeys(("validity dt", "lqr dt", "tvlqr dt"), _FORMER),
    **dict.fromkeys(("validity limits", "export limits"), _UNSATURATED),
    "validity offset": one(number, "X", 0.5),
    "funnel knots": one(count_of, "N", 10),
    "funnel output-file": _saved("Funnel"),
    "lqr output-file": _saved("Gain"),
    "tvlqr output-file": _saved("GainSchedule"),
    "tune output-file": _saved("Tuned"),
    "tune goal": many(str, "'TYPE KEY=VALUE ...'"),
    "law": many(str, "'TYPE KEY=VALUE ...'"),
    "lqg output-file": _saved("Compensator", "MultirateCompensator"),
    "process-noise": many(assignment, "NAME=W"),
    "bias-noise": many(assignment, "NAME=W"),
    "disturbance": many(lock, "NAME[=W]"),
    "disturbance-frequency": many(assignment, "NAME=HZ"),
    "lqg noise": many(assignment, "NAME=SIGMA"),
    **dict.fromkeys(("tune vary", "lqg vary"), many(parameter_range, "NAME=RANGE")),
    "tune seed": one(whole, "S"),
    **dict.fromkeys(("starts", "steps"), _COUNT),
    "plan duration": one(number, "T", required=True),
    "plan hold": {"choices": ("linear", "previous"), "default": "previous"},
    "plan output-file": _saved("Trajectory", "Motion", endings=_TABLE),
    "simulate output-file": _saved("Motion", endings=_TABLE),
    "sweep output-file": {
        **_saved("LinearBatch", endings=(".npz", ".h5")),
        "required": True,
    },
    "montecarlo goal": many(str, "CONDITION"),
    "montecarlo output-file": _saved(endings=(".npz", ".h5", ".csv", ".mat")),
}

_REPEATABLE = " (repeatable)"


class Command(argparse.ArgumentParser):
    """Parser of a command; it reports errors in one line."""

    def _print_message(self, message: str, file: object = None) -> None:
        # Print the text here, because argparse would ignore an error while it writes the text.
        print(message, end="", flush=True)

    def error(self, message: str) -> NoReturn:
        """Report invalid or missing arguments in one line, and exit."""
        if "required: DISPERSIONS" in message:
            message += (
                "; DISPERSIONS is a TOML file with lines such as [dispersions] and "
            )
            message += '"base.mass" = 0.05'
        print_error(f"fflin: error: {message} (see {self.prog} --help)")
        self.exit(BAD_INPUT)


def add_command(
    commands: argparse._SubParsersAction[Command],
    run: Callable[[argparse.Namespace], object],
) -> None:
    """Add a command and its options. The command has the name of the function `run`.

    The function executes the command, and its docstring is the help text: a summary and an example.
    ``--help`` lists --json and the options in `COMMON`; ``--help all`` lists all options.
    """
    name, (summary, _, example) = run.__name__, (run.__doc__ or "").partition("\n\n")
    command = commands.add_parser(
        name,
        add_help=False,
        help=summary[:1].lower() + summary[1:].removesuffix("."),
        description=summary,
        epilog=example,
    )
    # A negative number such as -1e-3 is a value, not an option.
    command._negative_number_matcher = re.compile(
        r"^-(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?$"
    )
    about = "show help for the common options; --help all shows help for all options"
    command.add_argument(
        "-h", "--help", nargs="?", metavar="all", action=Help, help=about
    )
    command.set_defaults(run=run, command=command, common=COMMON.get(name, "").split())
    for title, options in ((OUTPUT, "json"), *OPTIONS[name].items()):
        groups = {
            "": command,
            **{existing.title: existing for existing in command._action_groups},
        }
        group = groups.get(title) or command.add_argument_group(
            title, DESCRIPTIONS.get(title)
        )
        for option in options.split():
            key = f"{name} {option}"
            text = ABOUT.get(key) or ABOUT[option]
            form = FORMS.get(key) or FORMS.get(option, {"action": "store_true"})
            reader, default = form.get("type"), form.get("default")
            if isinstance(reader, OutputFile):
                text = text.replace("FILE", f"FILE: {reader}")
            elif form.get("action") == "append":
                text += _REPEATABLE
            elif default is not None and reader in (number, count_of, whole):
                text += f"; {default:g} by default"
            flags = [] if option.isupper() else [f"--{option}"]
            if option.startswith("output-f"):
                flags.insert(0, "-o")
            group.add_argument(*flags, help=text, **form)
            if isinstance(reader, OutputFile) and reader.kinds:
                group.add_argument("--force", help=ABOUT["force"], action="store_true")


def print_error(line: str) -> None:
    """Write a line to stderr. If stderr is closed, only the exit code reports the error."""
    try:
        print(color_message(one_line(line)), file=sys.stderr, flush=True)
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stderr.fileno())


class Help(argparse.Action):
    """Option --help, which prints the short help; --help all prints help for all options."""

    def __call__(
        self, parser: argparse.ArgumentParser, _: object, value: object, *__: object
    ) -> None:
        """Print the help, and exit."""
        text = parser.format_help() if value == "all" else short_help(parser)
        parser._print_message(text, sys.stdout)
        parser.exit()


def short_help(command: argparse.ArgumentParser) -> str:
    """Return the short help of a command, with one sentence about each of its common options."""
    arguments = [action for action in command._actions if not action.option_strings]
    _, *every = (action for action in command._actions if action.option_strings)
    options = {action.dest.replace("_", "-"): action for action in every}
    common = command.get_default("common")
    names = [*common, "json"] if common else [*options]
    formatter = argparse.HelpFormatter(command.prog, max_help_position=30)
    required = [
        f"{action.option_strings[-1]} {action.metavar}"
        for action in every
        if action.required
    ]
    operands = [command.prog, *(str(action.metavar) for action in arguments), *required]
    formatter.add_text(f"usage: {' '.join(operands)} [options]")
    formatter.add_text(command.description)
    shown = {"arguments": arguments, "options": [options[name] for name in names]}
    for title, actions in shown.items():
        formatter.start_section(title)
        for action in map(copy.copy, actions):
            text = action.help or ""
            first = re.split(r"; |(?<!\.)\. ", text.removesuffix(_REPEATABLE))[0]
            action.help = first
            if text.endswith(_REPEATABLE):
                action.help += _REPEATABLE
            formatter.add_argument(action)
        formatter.end_section()
    formatter.add_text(command.epilog)
    if options:
        formatter.add_text(
            f"help for all {len(every)} options: {command.prog} --help all"
        )
    return formatter.format_help()


def settle_former_names(arguments: argparse.Namespace) -> None:
    """Accept former option names with a warning: --step (now --dt) and --dt (now --sample)."""
    if (step := getattr(arguments, "step", None)) is not None:
        message = "the integration step --step has the new name --dt"
        if arguments.dt is not None:
            message += ", and the sample time --dt has the new name --sample"
            arguments.sample = arguments.dt
        arguments.dt = step
    elif (sample := getattr(arguments, "former_dt", None)) is not None:
        message = f"--dt has the new name --sample; write --sample {sample:g}"
        arguments.sample = sample
    else:
        return
    warnings.warn(message, FflinWarning, stacklevel=2)
