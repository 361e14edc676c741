"""The command line: parses, calls one public function, prints or saves."""

from __future__ import annotations

import argparse
import io
import math
import os
import re
import sys
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from fflin import __version__
from fflin.errors import FflinError, FflinWarning, InputError

if TYPE_CHECKING:
    from fflin.linear_model import LinearModel
    from fflin.model import Robot

_DONE, _FELL_SHORT, _BAD_INPUT, _INTERRUPTED = 0, 1, 2, 130


class _Parser(argparse.ArgumentParser):
    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        # What is a negative number and no option; by default -1e-3 is taken for one.
        self._negative_number_matcher = re.compile(r"^-(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?$")

    def error(self, message: str) -> NoReturn:
        self.exit(_BAD_INPUT, f"fflin: error: {message} (see {self.prog} --help)\n")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Returns
    -------
    int
        0 done; 1 a check fell short; 2 bad input.
    """
    warnings.showwarning = _show_warning
    if isinstance(sys.stdout, io.TextIOWrapper):
        # Names may hold what the terminal cannot show.
        sys.stdout.reconfigure(errors="backslashreplace")
    arguments = _parser().parse_args(argv)
    try:
        code: int = arguments.run(arguments)
        if sys.stdout is not None:
            sys.stdout.flush()
        return code
    except (FflinError, FflinWarning) as error:  # a warning where Python is told to raise them
        print(f"fflin: error: {' '.join(str(error).split())}", file=sys.stderr)
        return _BAD_INPUT
    except BrokenPipeError:
        # The reader, such as head, has what it wanted; the interpreter must not complain either.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return _DONE
    except OSError as error:
        print(f"fflin: error: the output cannot be written: {error.strerror}", file=sys.stderr)
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return _BAD_INPUT
    except KeyboardInterrupt:
        return _INTERRUPTED


def _show_warning(
    message: Warning | str, category: type[Warning], *_: object, **__: object
) -> None:
    name = "warning" if issubclass(category, FflinWarning) else category.__name__
    print(f"fflin: {name}: {' '.join(str(message).split())}", file=sys.stderr)


def _robots(_: argparse.Namespace) -> int:
    from fflin.loading import load
    from fflin.reports import robot_list
    from fflin.robots import find_robot, list_robots

    entries: list[tuple[str, Robot | str, str]] = []
    for name in list_robots():
        try:
            with warnings.catch_warnings():
                # `fflin info` shows them, robot by robot.
                warnings.simplefilter("ignore", FflinWarning)
                entries.append((name, load(name), find_robot(name).origin))
        except FflinError as error:
            entries.append((name, str(error), find_robot(name).origin))
    print(robot_list(entries))
    return _DONE


def _info(arguments: argparse.Namespace) -> int:
    from fflin.reports import robot_info

    print(robot_info(_load(arguments)))
    return _DONE


def _linearize(arguments: argparse.Namespace) -> int:
    if arguments.output_file:
        from fflin.files import check_format, save_model

        check_format(arguments.output_file)
    robot, lin = _point(arguments)
    if arguments.output_file:
        save_model(lin, arguments.output_file, spare=robot.urdf)
        print(f"wrote {arguments.output_file}: {lin.B.shape[0]} states, {lin.B.shape[1]} inputs")
    else:
        from fflin.reports import linear_model

        print(linear_model(lin))
    return _DONE


def _check(arguments: argparse.Namespace) -> int:
    from fflin.verification import check

    robot, lin = _point(arguments)
    found = check(robot, lin)
    print(found)
    return _DONE if found.ok else _FELL_SHORT


def _load(arguments: argparse.Namespace) -> Robot:
    from fflin.loading import load

    robot = load(arguments.robot, lock=_once("--lock", arguments.lock))
    fields: dict[str, Any] = {}
    for name in ("stiffness", "damping"):
        values = getattr(arguments, name, [])
        for_all = [value for joint, value in values if joint is None]
        if for_all and len(values) > 1:
            raise InputError(f"--{name} is given for all joints and once more; give either")
        if values:
            fields[name] = for_all[0] if for_all else _once(f"--{name}", values)
    if getattr(arguments, "gravity", None):
        fields["gravity"] = arguments.gravity
    if getattr(arguments, "inputs", None):
        from fflin.input_files import load_inputs

        fields["inputs"] = load_inputs(arguments.inputs)
    if getattr(arguments, "output", []):
        from fflin.output_specs import parse_output

        fields["outputs"] = [output for text in arguments.output for output in parse_output(text)]
    return robot.replace(**fields) if fields else robot


def _once(option: str, pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    values = dict(pairs)
    if len(values) < len(pairs):
        raise InputError(f"{option} names a joint twice; give one value for each")
    return values


def _point(arguments: argparse.Namespace) -> tuple[Robot, LinearModel]:
    import pinocchio as pin

    from fflin.linearization import linearize
    from fflin.model import configuration
    from fflin.points import effort, velocity

    robot = _load(arguments)
    rotation = pin.rpy.rpyToMatrix(*(math.radians(angle) for angle in arguments.rpy))
    base = pin.SE3(rotation, pin.SE3.Identity().translation + arguments.position)
    q = configuration(robot, _once("--joint", arguments.joint), base)
    reference = pin.SE3.Identity() if arguments.reference == "world" else None
    v = velocity(robot, _once("--velocity", arguments.velocity)) if arguments.velocity else None
    u = None
    if arguments.effort:
        u = effort(robot, _once("--effort", arguments.effort))
    return robot, linearize(robot, q, v, u, frame=arguments.frame, reference=reference)


def _number(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"'{text}' is not a number") from None
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"'{text}' is not a finite number")
    return value


def _assignment(text: str) -> tuple[str, float]:
    name, separator, value = text.rpartition("=")
    if not separator or not name:
        raise argparse.ArgumentTypeError(f"'{text}' is not NAME=VALUE")
    return name, _number(value)


def _passive(text: str) -> tuple[str | None, float | str]:
    if "=" in text:
        return _assignment(text)
    return None, text if text == "urdf" else _number(text)


def _lock(text: str) -> tuple[str, float | None]:
    return _assignment(text) if "=" in text else (text, None)


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="fflin",
        description="Linear models of free-floating robots from URDF.",
        epilog="example: fflin linearize ets_vii -o ets_vii.mat",
    )
    parser.add_argument("--version", action="version", version=f"fflin {__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)

    _command(commands, "robots", _robots, "list the robots that can be named", "fflin robots")
    info = _command(
        commands, "info", _info, "show tree, joints, masses and limits", "fflin info servicer_7dof"
    )
    _add_robot(info)
    linearize = _command(
        commands,
        "linearize",
        _linearize,
        "show or save A, B, C, D",
        "fflin linearize ets_vii --joint joint_2=0.5 -o ets_vii.mat",
    )
    _add_point(linearize)
    linearize.add_argument(
        "-o",
        "--output-file",
        metavar="FILE",
        dest="output_file",
        type=Path,
        help="save to FILE: .npz, .mat, .json, or .csv (one file a matrix: NAME.A.csv, ...)",
    )
    check = _command(
        commands,
        "check",
        _check,
        "check A and B by two other routes; exit 1 where they do not hold",
        "fflin check canadarm2 --rpy 20 0 0 --reference world --frame world",
    )
    _add_point(check)
    return parser


def _command(
    commands: argparse._SubParsersAction[_Parser],
    name: str,
    run: Callable[[argparse.Namespace], int],
    summary: str,
    example: str,
) -> argparse.ArgumentParser:
    command = commands.add_parser(
        name,
        help=summary,
        description=f"{summary[0].upper()}{summary[1:]}.",
        epilog=f"example: {example}",
    )
    command.set_defaults(run=run)
    return command


def _add_robot(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "robot",
        metavar="ROBOT",
        help="a name of `fflin robots`, or the path of a URDF",
    )
    command.add_argument(
        "--lock",
        metavar="NAME[=VALUE]",
        type=_lock,
        action="append",
        default=[],
        help="weld a joint, at VALUE [rad|m] or at neutral (repeatable)",
    )


def _add_point(command: argparse.ArgumentParser) -> None:
    _add_robot(command)
    command.add_argument(
        "--joint",
        metavar="NAME=VALUE",
        type=_assignment,
        action="append",
        default=[],
        help="put a joint at VALUE [rad|m] (repeatable); the others are at neutral",
    )
    command.add_argument(
        "--rpy",
        nargs=3,
        type=_number,
        default=(0.0, 0.0, 0.0),
        metavar=("R", "P", "Y"),
        help="base attitude: roll, pitch, yaw [deg] about fixed axes",
    )
    command.add_argument(
        "--position",
        nargs=3,
        type=_number,
        default=(0.0, 0.0, 0.0),
        metavar=("X", "Y", "Z"),
        help="base position [m]",
    )
    for name, unit in (("stiffness", "N m/rad|N/m"), ("damping", "N m s/rad|N s/m")):
        command.add_argument(
            f"--{name}",
            metavar="[NAME=]VALUE",
            type=_passive,
            action="append",
            default=[],
            help=f"{name} of a joint [{unit}] (repeatable), or one value for all joints"
            + ("; `urdf`: what the URDF says" if name == "damping" else ""),
        )
    command.add_argument(
        "--gravity",
        nargs=3,
        type=_number,
        metavar=("X", "Y", "Z"),
        help="uniform gravity in world axes [m/s^2]; none by default",
    )
    command.add_argument(
        "--velocity",
        metavar="NAME=VALUE",
        type=_assignment,
        action="append",
        default=[],
        help="a velocity at the point (repeatable): a joint's rate [rad/s|m/s], or omega_b.x ... "
        "v_b.z of the base in base axes",
    )
    command.add_argument(
        "--effort",
        metavar="NAME=VALUE",
        type=_assignment,
        action="append",
        default=[],
        help="an input at the point (repeatable), by its name in u, such as tau_m.joint_1",
    )
    command.add_argument(
        "--inputs",
        metavar="FILE.toml",
        help="what acts on the robot, as fflin.load_inputs reads it: a file, or the name of a "
        "bundled one; by default torque and force on the base and every joint's",
    )
    command.add_argument(
        "--output",
        metavar="SPEC",
        action="append",
        default=[],
        help="what is watched (repeatable): state (default), base, joints, rates, com, momentum, "
        "frame:NAME (pose and velocity), pose:NAME, velocity:NAME, gyroscope:NAME or "
        "accelerometer:NAME",
    )
    command.add_argument(
        "--reference",
        choices=("base", "world"),
        default="base",
        help="what attitude and position are relative to: the base where it stands (default), "
        "or the world",
    )
    command.add_argument(
        "--frame",
        choices=("hybrid", "local", "world"),
        default="hybrid",
        help="axes of velocities and wrenches: angular in base axes and linear in reference axes "
        "(hybrid, default), both in base axes (local), both in reference axes (world)",
    )
