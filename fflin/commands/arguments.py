"""What the commands take: the robot, the point, and how their values are read."""

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
    """Read a whole number that is not negative."""
    if not text.isascii() or not text.isdigit():
        raise argparse.ArgumentTypeError(f"'{text}' is not a whole number")
    return int(text)


def count_of(text: str) -> int:
    """Read a whole number from 1 on."""
    if not (count := whole(text)):
        raise argparse.ArgumentTypeError("0 is too few, expected 1 or more")
    return count


def input_file(text: str) -> Path:
    """Read the name of a file that the command reads."""
    if not text:
        raise argparse.ArgumentTypeError("the name of the file is empty")
    return Path(text)


def input_name(text: str) -> str:
    """Read the name of a file that the command reads, or of what is bundled."""
    return text


def output_file(text: str) -> Path:
    """Read the name of a file that the command writes."""
    return input_file(text)


def assignment(text: str) -> tuple[str, float]:
    """Read NAME=VALUE."""
    name, separator, value = text.rpartition("=")
    if not separator or not name:
        raise argparse.ArgumentTypeError(f"'{text}' is not NAME=VALUE")
    return name, number(value)


def passive(text: str) -> tuple[str | None, float | str]:
    """Read NAME=VALUE, VALUE for all joints (name None), or urdf."""
    if "=" in text:
        return assignment(text)
    return None, text if text == "urdf" else number(text)


def orbit(text: str) -> dict[str, float | str]:
    """Read ALTITUDE or ALTITUDE:BODY."""
    altitude, _, body = text.partition(":")
    return {"altitude": number(altitude), "body": body or "earth"}


def lock(text: str) -> tuple[str, float | None]:
    """Read NAME=VALUE, or NAME for neutral (value None)."""
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
    """Add a command; `example` stands at the end of its help."""
    command: argparse.ArgumentParser = commands.add_parser(
        name,
        help=summary,
        description=f"{summary[0].upper()}{summary[1:]}.",
        epilog=f"example: {example}",
    )
    command.set_defaults(run=run, command=command)
    return command


def files_of(arguments: argparse.Namespace) -> tuple[list[Path], list[Path]]:
    """Return the files that the arguments have a command read, and those that it is to write."""
    given: dict[Any, list[Path]] = {input_file: [], input_name: [], output_file: []}
    for action in arguments.command._actions:
        value = getattr(arguments, action.dest, None)
        if action.type in given and value is not None:
            given[action.type] += map(Path, value if isinstance(value, list) else [value])
    return given[input_file] + given[input_name], given[output_file]


def add_options(group: Container, text: str, **more: Any) -> None:
    """Add options, each a line ``--name METAVAR: help`` and those that go on with it.

    A metavar in _READ says how the value is read, one such as a|b what it may be, X,Y numbers;
    FILE is read and >FILE written. Behind it stand ``*`` where the option is repeatable, ``!``
    where it is required, or ``= default``. Without one it is a switch, ``--[no-]x`` of both ways.
    What holds of all is in `more`.
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
    what = "a name of `fflin robots`, or the path of a URDF or of a robot.toml"
    command.add_argument("robot", metavar="ROBOT", type=input_name, help=what)
    add_options(
        command,
        """
        --lock NAME[=VALUE]*: weld a joint, at VALUE [rad|m] or at neutral; NAME may be a pattern,
            'hinge_*', here and below""",
    )


def add_point(command: argparse.ArgumentParser) -> None:
    """Add the robot and what says the point that it is linearised about."""
    add_robot(command)
    add_pose(command)
    add_system(command)
    add_inputs_there(command)
    add_reference(command)


def add_reference(command: argparse.ArgumentParser) -> None:
    """Add what attitude and position are relative to."""
    add_options(
        command,
        """
        --reference base|world = base: what attitude and position are relative to: the base where it
            stands (default), or the world""",
    )


def add_pose(command: Container) -> None:
    """Add what says where the robot is and how it moves."""
    add_options(
        command,
        """
        --joint NAME=VALUE*: put a joint at VALUE [rad|m]; the others are at neutral
        --rpy R,P,Y: base attitude: roll, pitch, yaw [deg] about fixed axes
        --position X,Y,Z: base position [m]
        --velocity NAME=VALUE*: a velocity at the point: the rate [rad/s|m/s] of a joint or wheel,
            or omega_b.x ... v_b.z of the base in base axes""",
    )


def add_inputs_there(command: Container) -> None:
    """Add what says the inputs at the point."""
    add_options(
        command,
        """
        --effort NAME=VALUE*: an input at the point, by its name in u, such as tau_m.joint_1
        --equilibrium: take the least inputs that balance springs, gravity and a steady motion at
            the point, where passive joints sag on their springs; refused where there are none""",
    )
    text = """--relative-equilibrium N: in orbit, take the N-th of 24 attitudes (default 1) that the
        field does not turn, with --equilibrium; attitude and position count from there"""
    add_options(command, text, nargs="?", const=1, choices=range(1, 25))


def add_orbit(command: Container) -> None:
    """Add --orbit."""
    add_options(
        command,
        """
        --orbit ALTITUDE[:BODY]: a circular orbit at so many metres over the earth (default), moon,
            mars ...: the world is then the frame of the orbit""",
    )


def add_system(command: Container, *, axes: bool = True) -> None:
    """Add what acts on the robot, what is watched of it, and in which axes."""
    add_orbit(command)
    add_options(
        command,
        """
        --stiffness [NAME=]VALUE*: stiffness of a joint [N m/rad|N/m], or one value for all joints
        --damping [NAME=]VALUE*: damping of a joint [N m s/rad|N s/m], or one value for all joints;
            `urdf`: what the URDF says
        --gravity X,Y,Z: uniform gravity in world axes [m/s^2]; none by default
        --passive NAME*: a joint without a motor: it gets no torque by default
        --inputs FILE.toml: what acts on the robot, as fflin.load_inputs reads it: a file, or the
            name of a bundled one; `joints` or `base`: those alone; by default those of a
            robot.toml, or torque and force on the base and every joint's
        --output SPEC*: what is watched: state (default), base, joints, rates, joints:NAME,
            rates:NAME (a joint or a pattern), com, momentum, frame:NAME (pose and velocity),
            pose:NAME, velocity:NAME, gyroscope:NAME, accelerometer:NAME; relative:NAME:TO, as
            another frame sees it""",
    )
    frame = """
        --frame hybrid|local|world|lvlh|hill: axes of velocities and wrenches: angular in base axes
            and linear in reference axes (hybrid, default), both in base axes (local), both in
            reference axes (world); in orbit the world is along, minus normal, to the body (lvlh,
            default), or from the body, along, normal (hill), with axes as hybrid"""
    if axes:
        add_options(command, frame)


def add_output_file(command: Container, what: str, *kinds: str) -> None:
    """Add -o FILE; `what` says which endings there are.

    With the `kinds` of results that are written there, add --force too; see `require_own_kind`.
    """
    command.add_argument("-o", "--output-file", metavar="FILE", type=output_file, help=what)
    if kinds:
        add_options(command, "--force: let -o replace a file that holds anything of another kind")
        command.set_defaults(kinds=kinds)
