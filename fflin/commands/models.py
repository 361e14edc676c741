"""Commands `robots`, `info`, `init`, `linearize` and `check`."""

from __future__ import annotations

import argparse
import math
import os
import textwrap
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from fflin.base.errors import FflinError, FflinWarning, FileError, InputError
from fflin.base.names import runs
from fflin.base.tables import cut, grid, matrix, signals, width
from fflin.base.writing import check_ending
from fflin.commands import DONE, FELL_SHORT, options, parser
from fflin.commands.points import configuration_of, linear_model, load_robot, refuse, velocity_of
from fflin.commands.regulator import add_trajectory, models_along
from fflin.commands.results import Report, figure_of

if TYPE_CHECKING:
    from fflin.base.validation import Array
    from fflin.linear.model import LinearModel
    from fflin.robot.robot import Robot


def add_commands(commands: parser.Commands) -> None:
    """Add the commands robots, info, init, linearize and check."""
    parser.command(commands, _robots)
    info = parser.command(commands, _info)
    options.add_robot(info)
    options.add_pose(info.group(parser.POINT))
    options.add_system(info)
    init = parser.command(commands, _init)
    urdf = "path of a URDF, or a robot name listed by `fflin robots`"
    init.add_argument("robot", metavar="URDF", type=parser.input_name, help=urdf)
    what = "the robot file (by default the URDF's name with .toml, in the current folder)"
    output = init.group(parser.OUTPUT)
    options.add_output_file(output, what, parser.OutputFile((".toml",)))
    output.switch("--force", "replace an existing file")
    _add_linearize(commands)
    _add_check(commands)


def _add_linearize(commands: parser.Commands) -> None:
    linearize = parser.command(
        commands,
        _linearize,
        "joint rpy position velocity effort equilibrium frame reference inputs dt tool "
        "trajectory output-file plot",
    )
    options.add_point(linearize)
    made = linearize.group(parser.OUTPUT)
    made.add("--dt", "sample the model at the sample time H [s] with zero-order hold", float, "H")
    made.add(
        "--for",
        "convert the model to the coordinates that a tool uses, and save the result; requires -o "
        "FILE",
        choices=("drake", "mujoco", "pinocchio", "spart", "euler", "euler_rates"),
        dest="tool",
    )
    add_trajectory(linearize)
    what = "A, B, C and D (.csv: one file per matrix, such as NAME.A.csv)"
    options.add_output_file(
        made, what, parser.TABLE, "LinearModel", "LinearTrajectory", "ToolModel"
    )
    options.add_figure(linearize, "the magnitudes of the entries of A and B")


def _add_check(commands: parser.Commands) -> None:
    check = parser.command(
        commands,
        _check,
        "joint rpy position velocity effort equilibrium frame reference inputs trajectory "
        "tolerance plot",
    )
    options.add_point(check)
    add_trajectory(check)
    shown = check.group(parser.OUTPUT)
    tolerance = (
        "relative tolerance for all errors. By default, each kind of error has its own tolerance"
    )
    shown.add("--tolerance", tolerance, float, "X")
    options.add_figure(check, "the errors and their tolerances")


def _robots(_: argparse.Namespace) -> Report:
    """List the robots that can be loaded by name.

    example: fflin robots
    """
    from fflin.robot.catalog import find_robot, list_robots
    from fflin.robot.loading import load
    from fflin.robot.summary import robot_list

    entries: list[tuple[str, Robot | str, str]] = []
    for name in list_robots():
        try:
            with warnings.catch_warnings():
                # Do not show these warnings here; `fflin info` shows them.
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
    """Show the joints, limits, settings, mass, inertia, wheels and thrusters of a robot.

    example: fflin info servicer_7dof
    """
    import numpy as np

    from fflin.control.authority import point_properties, point_report
    from fflin.dynamics.actuation import Actuation
    from fflin.dynamics.state import StateMap
    from fflin.robot.fields import limits_of
    from fflin.robot.summary import robot_info

    robot = load_robot(arguments)
    q = configuration_of(robot, arguments, robot.point)
    v = velocity_of(robot, arguments, robot.point, "velocity")
    properties = point_properties(robot, q, np.zeros(robot.nv) if v is None else v)
    text = f"{robot_info(robot, point_report(properties))}\n\n{inputs_report(robot)}"
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
    """Write an initial robot.toml for a URDF, with all inputs, limits and unactuated joints.

    example: fflin init my.urdf && fflin simulate my.toml
    """
    from fflin.base.writing import check_output_path, write_atomically
    from fflin.robot.catalog import find_robot
    from fflin.robot.loading import load
    from fflin.robot.summary import draft

    found = find_robot(arguments.robot)
    if found.path.suffix.lower() == ".toml":
        raise InputError(f"{found.path} is already a robot file; give the path of a URDF")
    target = arguments.output_file or Path(f"{found.name}.toml")
    check_output_path(target)
    if target.exists() and not arguments.force:
        raise FileError(
            f"{target} already exists; give another name with -o, or replace the file with --force"
        )
    urdf = found.name
    if found.origin == "file":
        urdf = os.path.relpath(os.path.realpath(found.path), os.path.realpath(target.parent))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        robot = load(arguments.robot)
    write_atomically({target: draft(robot, urdf).encode()})
    load(target)  # warns of settings that the file leaves open
    text = (
        f"wrote {target}, a robot file of '{robot.name}'; to simulate the robot, run: fflin "
        f"simulate {target}"
    )
    return Report(robot.name, {}, text, {target: None})


def _linearize(arguments: argparse.Namespace) -> Report:
    """Show or save the linear model A, B, C, D about an operating point.

    example: fflin linearize ets_vii --joint joint_2=0.5 -o ets_vii.mat
    """
    if arguments.tool and arguments.trajectory:
        raise InputError(
            "--for converts the model about one operating point, but --trajectory defines many; "
            "remove one of them"
        )
    if arguments.tool and not arguments.output_file:
        raise InputError("--for saves the converted model; add -o FILE")
    if arguments.output_file and (arguments.tool or arguments.trajectory):
        check_ending(arguments.output_file, parser.RECORD.endings)
    if arguments.trajectory:
        refuse(arguments, ("plot",), "with --trajectory, there is no single model to plot")
        along = models_along(arguments)
        if arguments.dt is not None:
            along = along.discretize(arguments.dt)
        return Report(along.robot.name, along, str(along), {arguments.output_file: along.save})
    _, lin = linear_model(arguments)
    if arguments.dt is not None:
        lin = lin.discretize(arguments.dt)
    model = lin.to(arguments.tool) if arguments.tool else lin
    if arguments.output_file:
        nx, nu = model.B.shape
        text = f"{lin.robot}: {nx} states, {nu} inputs"
    else:
        text = model_report(lin)
    files = {arguments.output_file: model.save, arguments.plot: figure_of("plot_matrices", lin)}
    return Report(lin.robot, model, text, files)


def _check(arguments: argparse.Namespace) -> Report:
    """Compare A and B with two independent computations; the exit code is 1 if the results differ.

    example: fflin check canadarm2 --rpy 20 0 0 --reference world --frame world
    """
    from fflin.linear.check import check, held_to

    if arguments.trajectory:
        along = models_along(arguments)
        robot, found = along.robot, held_to(arguments.tolerance, along.check())
        text = f"{found}\n\n{along}"
    else:
        robot, lin = linear_model(arguments)
        found = check(robot, lin, tolerance=arguments.tolerance)
        text = str(found)
    result = {"ok": found.ok, "max_error": found.max_error, "rows": found.rows}
    files = {arguments.plot: figure_of("plot_check", found)}
    return Report(robot.name, result, text, files, DONE if found.ok else FELL_SHORT)


# Rates [SI] below this value count as zero.
_MOVES = 1e-9


def model_report(lin: LinearModel) -> str:
    """Format a linear model: its operating point, A, B, C, D and its certificate."""
    import numpy as np

    nx, nu = lin.B.shape
    stays, f0 = lin.is_equilibrium(), np.where(np.abs(lin.f0) > _MOVES, lin.f0, 0.0)
    point = "a fixed point" if stays else "not a fixed point"
    if stays and (lin.moving or f0.any()):
        point = "a relative equilibrium"
    sampled = f", sampled every {lin.dt:g} s" if lin.dt else ""
    head = f"{lin.robot}: {nx} states, {nu} inputs, frame {lin.frame}{sampled}"
    head += f"; the operating point is {point}"
    parts = [f"{textwrap.fill(head, width(), subsequent_indent='  ')}\n{_units(lin)}"]
    rates = lin.state_units if lin.dt else [_rate(unit) for unit in lin.state_units]
    # Poles are reported only at a fixed point, because the poles of a model in motion do not show
    # stability. If A A = 0, all poles are zero.
    if stays and not lin.dt and (lin.A @ lin.A).any():
        from fflin.analysis.modes import modes

        if growing := modes(lin).unstable:
            shown = ", ".join(f"{mode.pole:.5g}" for mode in growing)
            shown = f"unstable poles (positive real part): {shown}"
            parts.append(textwrap.fill(shown, width()))
    moved = [
        signals(title, values, names, units)
        for title, values, names, units in (
            ("x0", lin.x0, lin.state_names, lin.state_units),
            ("u0", lin.u0, lin.input_names, lin.input_units),
            ("f0", f0, lin.state_names, rates),
        )
        if values.any()
    ]
    if moved:
        parts.append("\n".join(moved))
    parts.append(_named_matrix("A", lin.A, lin.state_names, lin.state_names))
    parts.append(_named_matrix("B", lin.B, lin.state_names, lin.input_names))
    if lin.output_names == lin.state_names and not lin.D.any():
        parts.append("C = I, D = 0: the output is the state")
    else:
        parts.append(_named_matrix("C", lin.C, lin.output_names, lin.state_names))
        parts.append(_named_matrix("D", lin.D, lin.output_names, lin.input_names))
    c = lin.certificate
    parts.append(
        f"relative error compared with ABA derivatives: A {c.route_A:.1e}, B "
        f"{c.route_B:.1e}\nlargest entries: M M^-1 - I {c.inertia_residual:.1e}, f0 "
        f"{c.f0:.1e}\ncondition number of the scaled M: {c.condition:.1e}"
    )
    return "\n\n".join(parts)


def inputs_report(robot: Robot) -> str:
    """Format the inputs of a robot and their limits."""
    from fflin.dynamics.actuation import Actuation
    from fflin.dynamics.state import StateMap
    from fflin.robot.fields import limits_of

    acting, limits = Actuation(StateMap(robot)), limits_of(robot)
    rows = [["input", "unit", "min", "max"]]
    for name, unit in zip(acting.names, acting.units, strict=True):
        ends = limits.get(name, (-math.inf, math.inf))
        rows.append([name, unit, *(f"{end:.5g}" if math.isfinite(end) else "." for end in ends)])
    return grid(cut(rows, "see --json"), "ll")


def _named_matrix(title: str, values: Array, rows: Sequence[str], columns: Sequence[str]) -> str:
    size = f"{title} ({values.shape[0]} x {values.shape[1]})"
    if not values.any():
        return f"{size} is zero"
    return f"{size}; rows and columns of zeros are not shown\n\n{matrix(values, rows, columns)}"


def _units(lin: LinearModel) -> str:
    """Return the units of the states, inputs and outputs, once for each group of names."""
    lines = [("x", lin.state_names, lin.state_units), ("u", lin.input_names, lin.input_units)]
    if lin.output_names != lin.state_names:
        lines.append(("y", lin.output_names, lin.output_units))
    return "\n".join(
        textwrap.fill(f"{title}: {_grouped(names, units)}", width(), subsequent_indent="   ")
        for title, names, units in lines
    )


def _grouped(names: Sequence[str], units: Sequence[str]) -> str:
    return ", ".join(
        f"{group or ' ... '.join(dict.fromkeys((names[first], names[last])))} [{of}]"
        for first, last, group, of in runs(names, units)
    )


def _rate(unit: str) -> str:
    return "1/s" if unit == "1" else f"{unit}^2" if unit.endswith("/s") else f"{unit}/s"
