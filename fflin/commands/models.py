"""The commands `robots`, `info`, `init`, `linearize` and `check`."""

from __future__ import annotations

import argparse
import os
import warnings
from pathlib import Path
from typing import TYPE_CHECKING

from fflin.base.errors import FflinError, FflinWarning, FileError, InputError
from fflin.base.writing import check_ending
from fflin.commands import options, parser
from fflin.commands.points import configuration_of, linear_model, load_robot, velocity_of
from fflin.commands.results import Report, figure_of
from fflin.commands.tracking import add_trajectory, check_along, checked, linearize_along

if TYPE_CHECKING:
    from fflin.robot.robot import Robot


def add_commands(commands: parser.Commands) -> None:
    """Add robots, info, init, linearize and check."""
    summary = "list the robots that can be loaded by name"
    parser.command(commands, "robots", _robots, summary, example="fflin robots")
    info = parser.command(
        commands,
        "info",
        _info,
        "show mass, inertia, wheels and thrusters at a point, and tree, limits and settings",
        example="fflin info servicer_7dof",
    )
    options.add_robot(info)
    options.add_pose(info.group(parser.POINT))
    options.add_system(info)
    init = parser.command(
        commands,
        "init",
        _init,
        "write a first robot.toml from a URDF: inputs, limits, joints without a motor",
        example="fflin init my.urdf && fflin simulate my.toml",
    )
    urdf = "path of a URDF, or name of a robot in `fflin robots`"
    init.add_argument("robot", metavar="URDF", type=parser.input_name, help=urdf)
    what = "the robot file (by default the URDF's name with .toml, in the current folder)"
    options.add_output_file(
        init.group(parser.OUTPUT),
        what,
        parser.OutputFile((".toml",)),
        force="replace an existing file",
    )
    _add_linearize(commands)
    _add_check(commands)


def _add_linearize(commands: parser.Commands) -> None:
    linearize = parser.command(
        commands,
        "linearize",
        _linearize,
        "show or save the linear model A, B, C, D about an operating point",
        example="fflin linearize ets_vii --joint joint_2=0.5 -o ets_vii.mat",
        common="joint rpy position velocity effort equilibrium frame reference inputs dt tool "
        "trajectory output-file plot",
    )
    options.add_point(linearize)
    made = linearize.group(parser.OUTPUT)
    made.add("--dt", "sample the model, with inputs held for H [s]", float, "H")
    made.add(
        "--for",
        "convert the model to the coordinates of this tool; needs -o FILE",
        choices=("drake", "mujoco", "pinocchio", "spart", "euler", "euler_rates"),
        dest="tool",
    )
    add_trajectory(linearize)
    what = "A, B, C, D (with .csv one file per matrix: NAME.A.csv, ...)"
    options.add_output_file(
        made, what, parser.TABLE, "LinearModel", "LinearTrajectory", "ToolModel"
    )
    options.add_figure(linearize, "the magnitudes of the entries of A and B")


def _add_check(commands: parser.Commands) -> None:
    check = parser.command(
        commands,
        "check",
        _check,
        "compare A and B with two independent computations; exit code 1 if they differ",
        example="fflin check canadarm2 --rpy 20 0 0 --reference world --frame world",
        common="joint rpy position velocity effort equilibrium frame reference inputs trajectory "
        "tolerance plot",
    )
    options.add_point(check)
    add_trajectory(check)
    shown = check.group(parser.OUTPUT)
    tolerance = "relative tolerance of all errors; by default each error has its own"
    shown.add("--tolerance", tolerance, float, "X")
    options.add_figure(check, "the errors and their tolerances")


def _robots(_: argparse.Namespace) -> Report:
    from fflin.robot.catalog import find_robot, list_robots
    from fflin.robot.loading import load
    from fflin.robot.summary import robot_list

    entries: list[tuple[str, Robot | str, str]] = []
    for name in list_robots():
        try:
            with warnings.catch_warnings():
                # `fflin info` shows the warnings of each robot.
                warnings.simplefilter("ignore", FflinWarning)
                entries.append((name, load(name), find_robot(name).origin))
        except FflinError as error:
            found = find_robot(name)
            reason = str(error).replace(f"{found.path.parent}{os.sep}", "")
            entries.append((name, reason, found.origin))
    robots = {
        name: {"error": robot} if isinstance(robot, str) else {"n": robot.n, "mass": robot.mass}
        for name, robot, _ in entries
    }
    return Report(None, {"robots": robots}, robot_list(entries))


def _info(arguments: argparse.Namespace) -> Report:
    from dataclasses import replace

    import numpy as np

    from fflin.commands.model_text import inputs_report
    from fflin.control.authority import point_properties, point_report
    from fflin.dynamics.actuation import Actuation
    from fflin.dynamics.state import StateMap
    from fflin.robot.limits import limits_of
    from fflin.robot.summary import robot_info

    robot = load_robot(arguments)
    q = configuration_of(robot, arguments, robot.point)
    v = velocity_of(robot, arguments, robot.point, "velocity")
    properties = point_properties(robot, q, np.zeros(robot.nv) if v is None else v)
    text = robot_info(robot, point_report(properties))
    if (
        arguments.inputs is not None
        or robot.limits
        or robot.inputs != replace(robot, inputs=()).inputs
    ):
        text += f"\n\n{inputs_report(robot)}"
    state = StateMap(robot)
    inputs = Actuation(state)
    result = {
        "mass": robot.mass,
        **properties,
        "joint_names": robot.joint_names,
        "wheels": robot.wheels,
        "state_names": state.names,
        "state_units": state.units,
        "input_names": inputs.names,
        "input_units": inputs.units,
        "limits": limits_of(robot),
        "notes": robot.notes,
    }
    return Report(robot.name, result, text)


def _init(arguments: argparse.Namespace) -> Report:
    from fflin.base.writing import check_output_path, write_atomically
    from fflin.robot.catalog import find_robot
    from fflin.robot.loading import load
    from fflin.robot.summary import draft

    found = find_robot(arguments.robot)
    if found.path.suffix.lower() == ".toml":
        raise InputError(f"{found.path} is already a robot file; give a URDF")
    target = arguments.output_file or Path(f"{found.name}.toml")
    check_output_path(target)
    if target.exists() and not arguments.force:
        raise FileError(f"{target} already exists; give another name with -o, or add --force")
    urdf = found.name
    if found.origin == "file":
        urdf = os.path.relpath(os.path.realpath(found.path), os.path.realpath(target.parent))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        robot = load(arguments.robot)
    write_atomically({target: draft(robot, urdf).encode()})
    load(target)  # warns of settings that the file leaves open
    text = f"robot file of '{robot.name}'; try: fflin simulate {target}"
    return Report(robot.name, {}, text, {target: None})


def _linearize(arguments: argparse.Namespace) -> Report:
    if arguments.tool and (arguments.trajectory or not arguments.output_file):
        raise InputError(
            "--for saves a model at a point; give it with -o FILE and without --trajectory"
        )
    if arguments.output_file and (arguments.tool or arguments.trajectory):
        check_ending(arguments.output_file, parser.RECORD.endings)
    if arguments.trajectory:
        return linearize_along(arguments)
    _, lin = linear_model(arguments)
    if arguments.dt is not None:
        lin = lin.discretize(arguments.dt)
    model = lin.to(arguments.tool) if arguments.tool else lin
    if arguments.output_file:
        nx, nu = model.B.shape
        text = f"{lin.robot}: {nx} states, {nu} inputs"
    else:
        from fflin.commands.model_text import model_report

        text = model_report(lin)
    files = {arguments.output_file: model.save, arguments.plot: figure_of("plot_matrices", lin)}
    return Report(lin.robot, model, text, files)


def _check(arguments: argparse.Namespace) -> Report:
    if arguments.trajectory:
        return check_along(arguments)
    from fflin.linear.check import check

    robot, lin = linear_model(arguments)
    found = check(robot, lin, tolerance=arguments.tolerance)
    return checked(robot, found, str(found), {arguments.plot: figure_of("plot_check", found)})
