"""Options that commands share: robot, operating point, system; parsers of their values."""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeAlias

_OPTION = re.compile(r"--(\[no-\])?([\w-]+)(?: (\S+?)([*!])?(?: = (\S+))?)?: (.+)")

Commands: TypeAlias = "argparse._SubParsersAction[Any]"
Container: TypeAlias = "argparse._ActionsContainer"


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


def output_file(text: str) -> Path:
    """Read the path of an output file."""
    return input_file(text)


def assignment(text: str) -> tuple[str, float]:
    """Read NAME=VALUE."""
    name, separator, value = text.rpartition("=")
    if not separator or not name:
        raise argparse.ArgumentTypeError(f"'{text}' is not of the form NAME=VALUE")
    return name, number(value)


def passive(text: str) -> tuple[str | None, float | str]:
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


_READ: dict[str, Callable[[str], Any]] = {
    **dict.fromkeys(("FILE", "FILE.npz"), input_file),
    **{"FILE.toml": input_name, ">FILE": output_file},
    **dict.fromkeys(("T", "H", "P", "X", "FPS", "SPEED"), number),
    **{"N": count_of, "S": whole, "K": whole, "[NAME=]VALUE": passive, "NAME[=VALUE]": lock},
    "ALTITUDE[:BODY]": orbit,
    **dict.fromkeys(("NAME=VALUE", "NAME=W"), assignment),
}


def command(
    commands: Commands,
    name: str,
    run: Callable[[argparse.Namespace], int],
    summary: str,
    example: str,
) -> argparse.ArgumentParser:
    """Add a command; its help ends with `example`."""
    command: argparse.ArgumentParser = commands.add_parser(
        name,
        help=summary,
        description=f"{summary[0].upper()}{summary[1:]}.",
        epilog=f"example: {example}",
    )
    command.set_defaults(run=run, command=command)
    return command


def files_of(arguments: argparse.Namespace) -> tuple[list[Path], list[Path]]:
    """Return the input files and the output files that the arguments name."""
    given: dict[Any, list[Path]] = {input_file: [], input_name: [], output_file: []}
    for action in arguments.command._actions:
        value = getattr(arguments, action.dest, None)
        if action.type in given and value is not None:
            given[action.type] += map(Path, value if isinstance(value, list) else [value])
    return given[input_file] + given[input_name], given[output_file]


def add_options(group: Container, text: str, **more: Any) -> None:
    """Add options; each is a line ``--name METAVAR: help`` with its continuation lines.

    A metavar in _READ selects the parser of the value, a|b lists the choices, and X,Y are numbers.
    FILE is an input file and >FILE an output file. A suffix ``*`` marks a repeatable option, ``!``
    a required one, and ``= default`` gives the default. An option without a metavar is a switch;
    ``--[no-]x`` can be switched on and off. `more` applies to all options of the text.
    """
    for line in re.split(r"\n\s*(?=--)", text.strip()):
        found = _OPTION.fullmatch(" ".join(line.split()))
        assert found, line
        both, name, metavar, many, default, said = found.groups()
        options: dict[str, Any] = {"help": said + " (repeatable)" * (many == "*"), **more}
        if not metavar:
            options["action"] = argparse.BooleanOptionalAction if both else "store_true"
        elif "|" in metavar:
            options["choices"] = metavar.split("|")
        elif "," in metavar:
            options |= {"metavar": (each := tuple(metavar.split(","))), "nargs": len(each)}
            options["type"] = number
        else:
            kind = _READ.get(metavar, str)
            options = {"metavar": metavar.lstrip(">"), "type": kind} | options
        if many == "*":
            options |= {"action": "append", "default": []}
        if many == "!":
            options["required"] = True
        if default:
            options["default"] = options.get("type", str)(default)
        group.add_argument(f"--{name}", **options)


def add_robot(command: argparse.ArgumentParser) -> None:
    """Add ROBOT and --lock."""
    what = "name of a robot in `fflin robots`, or path of a URDF or of a robot.toml"
    command.add_argument("robot", metavar="ROBOT", type=input_name, help=what)
    add_options(
        command,
        """
        --lock NAME[=VALUE]*: lock a joint at VALUE [rad|m], or at its neutral position; NAME may
            be a pattern such as 'hinge_*', here and in the options below""",
    )


def add_point(command: argparse.ArgumentParser) -> None:
    """Add the robot and the options of its operating point."""
    add_robot(command)
    add_pose(command)
    add_system(command)
    add_inputs_there(command)
    add_reference(command)


def add_reference(command: argparse.ArgumentParser) -> None:
    """Add the option for the reference of attitude and position."""
    add_options(
        command,
        """
        --reference base|world = base: reference of attitude and position in the state: the base
            pose of the operating point (default), or the world""",
    )


def add_pose(command: Container) -> None:
    """Add the options for the configuration and velocity of the robot."""
    add_options(
        command,
        """
        --joint NAME=VALUE*: position of a joint [rad|m]; other joints are at their neutral
            position
        --rpy R,P,Y: base attitude: roll, pitch, yaw [deg] about fixed axes
        --position X,Y,Z: base position [m]
        --velocity NAME=VALUE*: velocity of a joint or wheel [rad/s|m/s], or omega_b.x ... v_b.z of
            the base in base axes""",
    )


def add_inputs_there(command: Container) -> None:
    """Add the options for the inputs at the operating point."""
    add_options(
        command,
        """
        --effort NAME=VALUE*: input at the operating point, by its name in u, such as
            tau_m.joint_1
        --equilibrium: apply the minimum-norm inputs that balance springs, gravity and the inertial
            forces of a steady motion at the operating point. Passive joints sag on their springs.
            If no inputs hold the point, the command reports an error""",
    )
    text = """--relative-equilibrium N: in orbit, use the N-th (default: first) of the 24 attitudes
        without gravity-gradient torque, and the inputs that --equilibrium computes. Attitude
        and position in the state are relative to this pose"""
    add_options(command, text, nargs="?", const=1, choices=range(1, 25))


def add_orbit(command: Container) -> None:
    """Add --orbit."""
    add_options(
        command,
        """
        --orbit ALTITUDE[:BODY]: circular orbit at an altitude [m] above the earth (default), moon,
            mars ...; the world is then the frame of the orbit""",
    )


def add_system(command: Container, *, axes: bool = True) -> None:
    """Add the options for forces, inputs, outputs and the axes of velocities."""
    add_orbit(command)
    add_options(
        command,
        """
        --stiffness [NAME=]VALUE*: stiffness of a joint [N m/rad|N/m], or one value for all joints
        --damping [NAME=]VALUE*: damping of a joint [N m s/rad|N s/m], or one value for all joints;
            `urdf` uses the damping in the URDF
        --gravity X,Y,Z: uniform gravity in world axes [m/s^2]; zero by default
        --passive NAME*: treat this joint as having no motor: the default inputs omit its torque
        --inputs FILE.toml: inputs of the robot: a file for fflin.load_inputs, a bundled name,
            `joints` (joint torques only) or `base` (base torque and force only). The default is
            the inputs of robot.toml, or base torque, base force and all joint torques
        --output SPEC*: outputs of the model: state (default), base, joints, rates, joints:NAME,
            rates:NAME (a joint or a pattern), com, momentum, frame:NAME (pose and velocity),
            pose:NAME, velocity:NAME, gyroscope:NAME, accelerometer:NAME, relative:NAME:TO (NAME
            relative to frame TO)""",
    )
    frame = """
        --frame hybrid|local|world|lvlh|hill: axes of velocities and wrenches. hybrid (default):
            angular parts in base axes, linear parts in reference axes; local: all in base axes;
            world: all in reference axes. For a robot in orbit, the axes are as in hybrid, and the
            orbital frame is the world. lvlh (default): x along the orbit, y opposite to the orbit
            normal, z towards the central body; hill: x away from the central body, y along the
            orbit, z along the orbit normal"""
    if axes:
        add_options(command, frame)


def add_output_file(command: Container, what: str, *kinds: str) -> None:
    """Add -o FILE with the help `what`, which lists the endings.

    With the `kinds` of results that are written there, add --force too; see `require_own_kind`.
    """
    command.add_argument("-o", "--output-file", metavar="FILE", type=output_file, help=what)
    if kinds:
        add_options(
            command,
            "--force: allow -o to replace a file that does not contain the same kind of result",
        )
        command.set_defaults(kinds=kinds)
