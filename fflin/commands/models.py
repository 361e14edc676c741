"""Commands `robots`, `info`, `init`, `linearize` and `check`."""

from __future__ import annotations

import math
import os
import textwrap
import warnings
from argparse import Namespace
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import fflin
from fflin.base.errors import FflinError, FflinWarning, FileError, InputError
from fflin.base.names import runs
from fflin.base.tables import cut, grid, matrix, signals, width
from fflin.base.writing import check_ending, check_output_path, write_atomically
from fflin.commands import DONE, FELL_SHORT
from fflin.commands.points import linear_model, load_robot, models_along, refuse, state_of
from fflin.commands.results import Report

if TYPE_CHECKING:
    from fflin.base.validation import Array


def robots(_: Namespace) -> Report:
    """List the robots that can be loaded by name.

    example: fflin robots
    """
    from fflin.robot.catalog import find_robot
    from fflin.robot.summary import robot_list

    entries: list[tuple[str, fflin.Robot | str, str]] = []
    result: dict[str, dict[str, object]] = {}
    for name in fflin.list_robots():
        found = find_robot(name)
        try:
            with warnings.catch_warnings():
                # Do not show these warnings here; `fflin info` shows them.
                warnings.simplefilter("ignore", FflinWarning)
                robot = fflin.load(name)
            entries.append((name, robot, found.origin))
            result[name] = {"n": robot.n, "mass": robot.mass}
        except FflinError as error:
            reason = str(error).replace(f"{found.path.parent}{os.sep}", "")
            entries.append((name, reason, found.origin))
            result[name] = {"error": reason}
    return Report(None, {"robots": result}, robot_list(entries))


def info(arguments: Namespace) -> Report:
    """Show the joints, limits, settings, mass, inertia, wheels and thrusters of a robot.

    example: fflin info servicer_7dof
    """
    import numpy as np

    from fflin.control.authority import point_properties
    from fflin.dynamics.state import Actuation
    from fflin.robot.fields import limits_of
    from fflin.robot.summary import robot_info

    robot = load_robot(arguments)
    q, v = state_of(robot, arguments, robot.point)
    properties = point_properties(robot, q, np.zeros(robot.nv) if v is None else v)
    state, limits = fflin.StateMap(robot), limits_of(robot)
    inputs = Actuation(state)
    rows = [["input", "unit", "min", "max"]]
    for name, unit in zip(inputs.names, inputs.units, strict=True):
        ends = limits.get(name, (-math.inf, math.inf))
        rows.append([name, unit, *(f"{end:.5g}" if math.isfinite(end) else "." for end in ends)])
    table = grid(cut(rows, "see --json"), "ll")
    text = f"{robot_info(robot, str(properties))}\n\n{table}"
    result = {
        "mass": robot.mass,
        **properties._asdict(),
        "joint_names": robot.joint_names,
        "wheels": robot.wheels,
        "state_names": state.names,
        "state_units": state.units,
        "input_names": inputs.names,
        "input_units": inputs.units,
        "limits": limits,
        "notes": robot.notes,
    }
    return Report(robot.name, result, text)


def init(arguments: Namespace) -> Report:
    """Write an initial robot.toml for a URDF, with all inputs, limits and unactuated joints.

    example: fflin init my.urdf && fflin simulate my.toml
    """
    from fflin.robot.catalog import find_robot
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
        robot = fflin.load(arguments.robot)
    write_atomically({target: draft(robot, urdf).encode()})
    fflin.load(target)  # warns of settings that the file leaves open
    text = (
        f"wrote {target}, a robot file of '{robot.name}'; to simulate the robot, run: fflin "
        f"simulate {target}"
    )
    return Report(robot.name, {}, text, {target: None})


def linearize(arguments: Namespace) -> Report:
    """Show or save the linear model A, B, C, D about an operating point.

    example: fflin linearize ets_vii --joint joint_2=0.5 -o ets_vii.mat
    """
    path, tool = arguments.output_file, getattr(arguments, "for")
    if tool and arguments.trajectory:
        raise InputError(
            "--for converts the model about one operating point, but --trajectory defines many; "
            "remove one of them"
        )
    if tool and not path:
        raise InputError("--for saves the converted model; add -o FILE")
    if path and (tool or arguments.trajectory):
        check_ending(path, (".npz", ".mat", ".json"))
    if arguments.trajectory:
        refuse(arguments, ("plot",), "with --trajectory, there is no single model to plot")
        along = models_along(arguments)
        if arguments.dt is not None:
            along = along.discretize(arguments.dt)
        return Report(along.robot.name, along, str(along), {path: along.save})
    _, lin = linear_model(arguments)
    if arguments.dt is not None:
        lin = lin.discretize(arguments.dt)
    model = lin.to(tool) if tool else lin
    nx, nu = model.B.shape
    text = f"{lin.robot}: {nx} states, {nu} inputs" if path else model_report(lin)
    files = {path: model.save, arguments.plot: lambda path: fflin.plot_matrices(lin, path)}
    return Report(lin.robot, model, text, files)


def check(arguments: Namespace) -> Report:
    """Compare A and B with two independent computations; the exit code is 1 if the results differ.

    example: fflin check canadarm2 --rpy 20 0 0 --reference world --frame world
    """
    if arguments.trajectory:
        from fflin.linear.check import held_to

        along = models_along(arguments)
        robot, found = along.robot, held_to(arguments.tolerance, along.check())
        text = f"{found}\n\n{along}"
    else:
        robot, lin = linear_model(arguments)
        found = fflin.check(robot, lin, tolerance=arguments.tolerance)
        text = str(found)
    result = {"ok": found.ok, "max_error": found.max_error, "rows": found.rows}
    files = {arguments.plot: lambda path: fflin.plot_check(found, path)}
    return Report(robot.name, result, text, files, DONE if found.ok else FELL_SHORT)


# Rates [SI] below this value count as zero.
_MOVES = 1e-9


def model_report(lin: fflin.LinearModel) -> str:
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
    moving = stays and not lin.dt and (lin.A @ lin.A).any()
    if growing := fflin.modes(lin).unstable if moving else ():
        shown = ", ".join(f"{mode.pole:.5g}" for mode in growing)
        shown = f"unstable poles (positive real part): {shown}"
        parts.append(textwrap.fill(shown, width()))
    vectors = (
        ("x0", lin.x0, lin.state_names, lin.state_units),
        ("u0", lin.u0, lin.input_names, lin.input_units),
        ("f0", f0, lin.state_names, rates),
    )
    if moved := [signals(*vector) for vector in vectors if vector[1].any()]:
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


def _named_matrix(title: str, values: Array, rows: Sequence[str], columns: Sequence[str]) -> str:
    size = f"{title} ({values.shape[0]} x {values.shape[1]})"
    if not values.any():
        return f"{size} is zero"
    return f"{size}; rows and columns of zeros are not shown\n\n{matrix(values, rows, columns)}"


def _units(lin: fflin.LinearModel) -> str:
    """Return the units of the states, inputs and outputs, once for each group of names."""
    signals = [("x", lin.state_names, lin.state_units), ("u", lin.input_names, lin.input_units)]
    if lin.output_names != lin.state_names:
        signals.append(("y", lin.output_names, lin.output_units))
    lines = []
    for title, names, units in signals:
        groups = ", ".join(
            f"{group or ' ... '.join(dict.fromkeys((names[first], names[last])))} [{of}]"
            for first, last, group, of in runs(names, units)
        )
        lines.append(textwrap.fill(f"{title}: {groups}", width(), subsequent_indent="   "))
    return "\n".join(lines)


def _rate(unit: str) -> str:
    return "1/s" if unit == "1" else f"{unit}^2" if unit.endswith("/s") else f"{unit}/s"
