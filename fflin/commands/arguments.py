"""Options of commands: parsers of their values, and the options that several commands share."""

from __future__ import annotations

import argparse
import copy
import math
import re
import sys
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from fflin.base.errors import FflinWarning

if TYPE_CHECKING:
    from fflin.commands.results import Report

Commands: TypeAlias = "argparse._SubParsersAction[Any]"
Container: TypeAlias = "argparse._ActionsContainer"

# Titles of groups of options in the help. Those of ROBOT repeat settings of a robot.toml.
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
    """Read the path of an input file, or a bundled name."""
    return text


@dataclass(frozen=True)
class OutputFile:
    """Reader of the path of an output file, with the endings that it may have."""

    endings: tuple[str, ...]

    def __call__(self, text: str) -> Path:
        """Read the path."""
        return input_file(text)

    def __str__(self) -> str:
        *first, last = self.endings
        return f"{', '.join(first)} or {last}" if first else last


RECORD, TABLE = OutputFile((".npz", ".mat", ".json")), OutputFile((".npz", ".mat", ".json", ".csv"))
ROWS, FIGURE = OutputFile((".npz", ".h5")), OutputFile((".png", ".pdf", ".svg"))
PAGE, PICTURE, ANIMATION = (OutputFile((f".{ending}",)) for ending in ("html", "png", "gif"))


def assignment(text: str) -> tuple[str, float]:
    """Read NAME=VALUE."""
    name, separator, value = text.rpartition("=")
    if not separator or not name:
        raise argparse.ArgumentTypeError(f"'{text}' is not of the form NAME=VALUE")
    return name, number(value)


def joint_or_all(text: str) -> tuple[str | None, float | str]:
    """Read NAME=VALUE, or VALUE or urdf for all joints (name None)."""
    if "=" in text:
        return assignment(text)
    return None, text if text == "urdf" else number(text)


def orbit(text: str) -> dict[str, float | str]:
    """Read ALTITUDE or ALTITUDE:BODY."""
    altitude, _, body = text.partition(":")
    return {"altitude": number(altitude), "body": body or "earth"}


def lock(text: str) -> tuple[str, float | None]:
    """Read NAME=VALUE, or NAME for the neutral position (value None)."""
    return assignment(text) if "=" in text else (text, None)


_REPEATABLE = " (repeatable)"
_METAVARS: dict[Any, str] = {
    input_file: "FILE",
    input_name: "FILE.toml",
    assignment: "NAME=VALUE",
    joint_or_all: "[NAME=]VALUE",
    lock: "NAME[=VALUE]",
    orbit: "ALTITUDE[:BODY]",
    count_of: "N",
}


def command(
    commands: Commands,
    name: str,
    run: Callable[[argparse.Namespace], Report],
    summary: str,
    *,
    example: str,
    common: str = "",
) -> argparse.ArgumentParser:
    """Add a command and its option --json.

    Its help ends with `example`. ``--help`` lists the `common` options and --json, by default all
    options.
    """
    command: argparse.ArgumentParser = commands.add_parser(
        name,
        add_help=False,
        help=summary,
        description=f"{summary[0].upper()}{summary[1:]}.",
        epilog=f"example: {example}",
    )
    about = "show help for the common options; --help all shows help for all options"
    command.add_argument("-h", "--help", nargs="?", metavar="all", action=_Help, help=about)
    command.set_defaults(run=run, command=command, common=[*common.split(), "json"] * bool(common))
    switch(group_of(command, OUTPUT), "--json", "print the results as one JSON object")
    return command


class _Help(argparse.Action):
    """Option that prints the short help, or the full help if its value is `all`."""

    def __call__(self, parser: argparse.ArgumentParser, _: Any, value: Any, *__: Any) -> None:
        text = parser.format_help() if value == "all" else short_help(parser)
        parser._print_message(text, sys.stdout)
        parser.exit()


def short_help(command: argparse.ArgumentParser) -> str:
    """Return the help of a command with the first sentence about each common option."""
    arguments = [each for each in command._actions if not each.option_strings]
    every = [each for each in command._actions if each.option_strings]
    options = {each.dest: each for each in reversed(every)}  # a former name comes second
    del options["help"]
    common = [name.replace("-", "_") for name in command.get_default("common")] or list(options)
    formatter = argparse.HelpFormatter(command.prog, max_help_position=30)
    operands = " ".join(str(each.metavar) for each in arguments)
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


def group_of(command: argparse.ArgumentParser, title: str) -> Container:
    """Return the group of options with this title; the first call creates it."""
    groups = (group for group in command._action_groups if group.title == title)
    return next(groups, None) or command.add_argument_group(title)


def add(
    group: Container,
    name: str,
    help: str,
    type: Callable[[str], Any] = str,
    metavar: str | tuple[str, ...] | None = None,
    *,
    default: Any = None,
    repeatable: bool = False,
    **more: Any,
) -> None:
    """Add an option with a value.

    A tuple `metavar` takes as many values. The help states the default of a number.
    """
    if repeatable:
        more |= {"action": "append", "default": []}
        help += _REPEATABLE
    else:
        more["default"] = default
    if default is not None and type in (number, whole, count_of):
        help = f"{help}; {default:g} by default"
    if isinstance(metavar, tuple):
        more["nargs"] = len(metavar)
    if "choices" not in more or metavar:
        file = "FILE" if isinstance(type, OutputFile) else None
        more["metavar"] = metavar or _METAVARS.get(type, file)
    group.add_argument(name, help=help, type=type, **more)


class _FormerName(argparse.Action):
    """Option under its former name, which warns of the new one."""

    def __call__(self, _: Any, given: argparse.Namespace, value: Any, option: Any = None) -> None:
        new = f"--{self.dest.replace('_', '-')}"
        warnings.warn(
            f"{option} has the new name {new}; write {new} {value}", FflinWarning, stacklevel=2
        )
        setattr(given, self.dest, value)


def add_former_name(group: Container, name: str, new: str) -> None:
    """Add the former name of an option for a time in seconds."""
    text = f"former name of --{new}"
    group.add_argument(name, dest=new, type=number, metavar="H", action=_FormerName, help=text)


def switch(group: Container, name: str, help: str) -> None:
    """Add an option without a value."""
    group.add_argument(name, help=help, action="store_true")


def yes_or_no(group: Container, name: str, help: str) -> None:
    """Add the options --NAME and --no-NAME; the value is None without them."""
    group.add_argument(name, help=help, action=argparse.BooleanOptionalAction)


def files_of(arguments: argparse.Namespace) -> tuple[list[Path], list[Path]]:
    """Return the input files and the output files that the arguments name."""
    inputs: list[Path] = []
    for action in arguments.command._actions:
        value = getattr(arguments, action.dest, None)
        if action.type in (input_file, input_name) and value is not None:
            inputs += map(Path, value if isinstance(value, list) else [value])
    return inputs, [path for path, _ in outputs_of(arguments)]


def outputs_of(arguments: argparse.Namespace) -> list[tuple[Path, OutputFile]]:
    """Return the output files that the arguments name, with their readers."""
    actions = arguments.command._actions
    given = ((getattr(arguments, action.dest, None), action.type) for action in actions)
    return [(path, kind) for path, kind in given if isinstance(kind, OutputFile) and path]


def add_robot(command: argparse.ArgumentParser) -> None:
    """Add ROBOT and --lock."""
    what = "robot name listed by `fflin robots`, or path of a URDF or robot.toml"
    command.add_argument("robot", metavar="ROBOT", type=input_name, help=what)
    add(
        group_of(command, ROBOT),
        "--lock",
        "lock a joint at VALUE [rad|m]; by default at its neutral position. In all options, NAME "
        "may be a pattern such as 'hinge_*'",
        lock,
        repeatable=True,
    )


def add_point(command: argparse.ArgumentParser) -> None:
    """Add the robot and the options of its operating point."""
    point = group_of(command, POINT)
    add_robot(command)
    add_pose(point)
    add_inputs_there(point)
    add_system(command)
    add_frame(point)
    add_reference(point)


def add_pose(group: Container) -> None:
    """Add the options for the configuration and velocity of the robot."""
    add(
        group,
        "--joint",
        "position of a joint [rad|m]. The default is the position in robot.toml, or the neutral "
        "position",
        assignment,
        repeatable=True,
    )
    rpy = "base attitude: roll, pitch, yaw [deg] about fixed axes"
    add(group, "--rpy", rpy, number, ("R", "P", "Y"))
    add(group, "--position", "base position [m]", number, ("X", "Y", "Z"))
    add(
        group,
        "--velocity",
        "velocity of a joint or wheel [rad/s|m/s], or a component omega_b.x ... v_b.z of the base "
        "velocity in base axes",
        assignment,
        repeatable=True,
    )


def add_target(group: Container) -> None:
    """Add the options for the configuration and velocity of the target."""
    add(
        group,
        "--target-joint",
        "target position of a joint [rad|m]. The default is the value in [target] of robot.toml, "
        "then in [point], then the neutral position",
        assignment,
        repeatable=True,
    )
    rpy = "target attitude of the base: roll, pitch, yaw [deg] about fixed axes"
    add(group, "--target-rpy", rpy, number, ("R", "P", "Y"))
    add(group, "--target-position", "target position of the base [m]", number, ("X", "Y", "Z"))
    add(
        group,
        "--target-velocity",
        "target velocity, such as the speed of a wheel. In a simulation, the target velocity is "
        "also the initial velocity unless --velocity is given",
        assignment,
        repeatable=True,
    )


def add_limits(group: Container) -> None:
    """Add --limits and --limit."""
    add(
        group,
        "--limits",
        "limits of the inputs. `urdf` (default) uses the limits of the robot and of --limit; "
        "`none` uses only --limit. The limits of the robot are the efforts in the URDF, max and "
        "min of the inputs, and the speeds of the wheels",
        choices=("urdf", "none"),
        default="urdf",
    )
    add(
        group,
        "--limit",
        "largest magnitude of an input, or of all inputs in a group or pattern such as tau_m. This "
        "limit replaces the limit of the robot",
        assignment,
        repeatable=True,
    )


def add_step(group: Container) -> None:
    """Add --dt, and --step as it was called."""
    add(group, "--dt", "integration step [s]; chosen automatically by default", number, "H")
    add(group, "--step", "former name of --dt", number, "H")


def settle_step(arguments: argparse.Namespace) -> None:
    """Set --dt and --sample from their former names, --step and --dt, with a warning."""
    said = ""
    if arguments.step is not None:
        said = "the integration step --step has the new name --dt"
        if arguments.dt is not None:
            said += ", and the sample time --dt has the new name --sample"
            arguments.sample = arguments.dt
        arguments.dt = arguments.step
    elif arguments.dt is not None and arguments.sample is None:
        said = "--dt is the integration step; give the sample time of the controller by --sample"
    if said:
        warnings.warn(said, FflinWarning, stacklevel=2)


def add_inputs_there(group: Container) -> None:
    """Add the options for the inputs at the operating point."""
    add(
        group,
        "--effort",
        "value of an input at the operating point. NAME is the name of the input in u, such as "
        "tau_m.joint_1",
        assignment,
        repeatable=True,
    )
    switch(
        group,
        "--equilibrium",
        "apply the minimum-norm inputs that make the operating point an equilibrium under springs "
        "and gravity, or a steady motion. Passive joints deflect their springs to balance the "
        "load. If no inputs hold the point, the command reports an error",
    )
    add(
        group,
        "--relative-equilibrium",
        "for a robot in orbit: use the N-th of the 24 attitudes without gravity-gradient torque (1 "
        "by default), and the inputs that --equilibrium computes. Attitude and position in the "
        "state are relative to the pose of this equilibrium",
        count_of,
        "N",
        nargs="?",
        const=1,
        choices=range(1, 25),
    )


def add_reference(group: Container) -> None:
    """Add the option for the reference of attitude and position."""
    add(
        group,
        "--reference",
        "reference pose of attitude and position in the state: the base pose at the operating "
        "point (base, default), or the world frame (world)",
        choices=("base", "world"),
        default="base",
    )


def add_frame(group: Container) -> None:
    """Add the option for the axes of velocities and wrenches."""
    add(
        group,
        "--frame",
        "axes of base velocities and wrenches. `hybrid` (default) uses base axes for angular parts "
        "and reference axes for linear parts. `local` uses base axes for all parts, and `world` "
        "uses reference axes for all parts. A robot in orbit has the axes of `hybrid`, and an "
        "orbital frame is its world. In `lvlh` (default in orbit), x is along the orbit, y "
        "opposite to the orbit normal and z towards the central body. In `hill`, x is away from "
        "the central body, y along the orbit and z along the orbit normal",
        choices=("hybrid", "local", "world", "lvlh", "hill"),
    )


def add_orbit(group: Container) -> None:
    """Add --orbit."""
    add(
        group,
        "--orbit",
        "circular orbit at an altitude [m] above a central body: earth (default), moon, mars ... "
        "The world is then the orbital frame",
        orbit,
    )


def add_system(command: argparse.ArgumentParser) -> None:
    """Add the options for forces, inputs and outputs, which robot.toml may set too."""
    group = group_of(command, ROBOT)
    add_orbit(group)
    add(
        group,
        "--stiffness",
        "stiffness of a joint [N m/rad|N/m], or one value for all joints",
        joint_or_all,
        repeatable=True,
    )
    add(
        group,
        "--damping",
        "damping of a joint [N m s/rad|N s/m], or one value for all joints. The value `urdf` means "
        "the damping in the URDF",
        joint_or_all,
        repeatable=True,
    )
    gravity = "uniform gravity in world axes [m/s^2]; zero by default"
    add(group, "--gravity", gravity, number, ("X", "Y", "Z"))
    add(
        group,
        "--passive",
        "joint without a motor: the default inputs do not include a torque at this joint",
        metavar="NAME",
        repeatable=True,
    )
    add(
        group,
        "--inputs",
        "inputs of the robot: a TOML file of inputs, a bundled name such as cubesat, `joints` "
        "(joint torques only) or `base` (base torque and force only). The default is the inputs in "
        "robot.toml, or base torque, base force and all joint torques",
        input_name,
    )
    add(
        group,
        "--output",
        "outputs of the model: state (default), base, joints, rates, joints:NAME, rates:NAME (a "
        "joint or a pattern), com, momentum, frame:NAME (pose and velocity), pose:NAME, "
        "velocity:NAME, gyroscope:NAME, accelerometer:NAME, relative:NAME:TO (frame NAME relative "
        "to frame TO)",
        metavar="SPEC",
        repeatable=True,
    )


def add_output_file(
    group: Container, what: str, endings: OutputFile, *kinds: str, force: str = ""
) -> None:
    """Add -o FILE.

    With the `kinds` of results that are written there, add --force too; see `require_own_kind`.
    """
    what = f"save {what} to FILE: {endings}"
    group.add_argument("-o", "--output-file", metavar="FILE", type=endings, help=what)
    if kinds:
        force = (
            "let -o replace a file of any content; by default -o replaces only results of the same "
            "kind"
        )
        group.set_defaults(kinds=kinds)
    switch(group, "--force", force)


def add_figure(command: argparse.ArgumentParser, what: str) -> None:
    """Add --plot FILE."""
    add(group_of(command, OUTPUT), "--plot", f"plot {what} to FILE: {FIGURE}", FIGURE)
