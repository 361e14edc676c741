"""The commands `robots`, `info`, `linearize` and `check`."""

from __future__ import annotations

import argparse
import os
import warnings
from typing import TYPE_CHECKING

from fflin.base.errors import FflinError, FflinWarning, InputError
from fflin.base.tables import headed
from fflin.commands import DONE, FELL_SHORT
from fflin.commands.arguments import (
    Commands,
    add_options,
    add_output_file,
    add_point,
    add_robot,
    add_system,
    command,
)
from fflin.commands.points import linear_model, load_robot
from fflin.commands.tracking import add_trajectory, check_along, linearize_along
from fflin.commands.visual import add_figure, check_figure, draw

if TYPE_CHECKING:
    from fflin.robot.robot import Robot


def add_commands(commands: Commands) -> None:
    """Add robots, info, linearize and check."""
    command(
        commands, "robots", _robots, "list the robots that can be loaded by name", "fflin robots"
    )
    info = command(
        commands,
        "info",
        _info,
        "show tree, masses, limits and settings of a robot",
        "fflin info servicer_7dof",
    )
    add_robot(info)
    add_system(info, axes=False)
    linearize = command(
        *(commands, "linearize", _linearize),
        "show or save the linear model A, B, C, D about an operating point",
        "fflin linearize ets_vii --joint joint_2=0.5 -o ets_vii.mat",
    )
    add_point(linearize)
    add_options(linearize, "--dt H: sample the model, with inputs held for H [s]")
    tools = "drake|mujoco|pinocchio|spart|euler|euler_rates"
    add_options(
        linearize,
        f"--for {tools}: convert the model to the coordinates of this tool; needs -o FILE",
        dest="tool",
    )
    add_trajectory(linearize)
    add_output_file(
        *(linearize, "save to FILE: .npz, .mat, .json, or .csv (one per matrix: NAME.A.csv, ...)"),
        *("LinearModel", "LinearTrajectory", "ToolModel"),
    )
    add_figure(linearize, "plot the magnitudes of the entries of A and B")
    check = command(
        *(commands, "check", _check),
        "compare A and B with two independent computations; exit code 1 if they differ",
        "fflin check canadarm2 --rpy 20 0 0 --reference world --frame world",
    )
    add_point(check)
    add_trajectory(check)
    add_options(
        check,
        "--tolerance X: relative tolerance of all errors; by default each error has its own",
    )
    add_figure(check, "plot the errors and their tolerances")


def _robots(_: argparse.Namespace) -> int:
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
    print(headed("robots", robot_list(entries)))
    return DONE


def _info(arguments: argparse.Namespace) -> int:
    from dataclasses import replace

    from fflin.robot.summary import robot_info

    robot = load_robot(arguments)
    print(headed("info", robot_info(robot)))
    default = replace(robot, inputs=()).inputs
    if arguments.inputs is not None or robot.limits or robot.inputs != default:
        from fflin.commands.model_text import inputs_report

        print(f"\n{inputs_report(robot)}")
    return DONE


def _linearize(arguments: argparse.Namespace) -> int:
    if arguments.tool and (arguments.trajectory or not arguments.output_file):
        raise InputError(
            "--for saves a model at a point; give it with -o FILE and without --trajectory"
        )
    if arguments.trajectory:
        return linearize_along(arguments)
    if arguments.output_file:
        from fflin.base.writing import check_place
        from fflin.linear.files import FORMATS

        check_place(arguments.output_file, FORMATS)
    check_figure(arguments.plot)
    _, lin = linear_model(arguments)
    if arguments.dt is not None:
        lin = lin.discretize(arguments.dt)
    if arguments.output_file:
        model = lin.to(arguments.tool) if arguments.tool else lin
        model.save(arguments.output_file)
        nx, nu = model.B.shape
        print(f"linearize: wrote {arguments.output_file}: {nx} states, {nu} inputs")
    else:
        from fflin.commands.model_text import model_report

        print(headed("linearize", model_report(lin)))
    draw(arguments.plot, "plot_matrices", lin)
    return DONE


def _check(arguments: argparse.Namespace) -> int:
    if arguments.trajectory:
        return check_along(arguments)
    from fflin.linear.check import check

    check_figure(arguments.plot)
    robot, lin = linear_model(arguments)
    found = check(robot, lin, tolerance=arguments.tolerance)
    print(headed("check", str(found)))
    draw(arguments.plot, "plot_check", found)
    return DONE if found.ok else FELL_SHORT
