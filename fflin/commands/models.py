"""Commands for one robot or one linear model, such as robots, linearize and uncertain."""

from __future__ import annotations

import math
import os
import sys
import warnings
from argparse import Namespace
from dataclasses import asdict
from functools import partial
from pathlib import Path

import fflin
from fflin.base.errors import (
    EquilibriumError,
    FflinError,
    FflinWarning,
    FileError,
    InputError,
    listed,
)
from fflin.base.names import with_units
from fflin.base.tables import counted, cut, folded, grid, matrix, signals
from fflin.base.writing import RECORDS, check_ending, write_atomically
from fflin.commands import DONE, FELL_SHORT
from fflin.commands.builders import (
    SHOWN,
    Report,
    linear_model,
    load_robot,
    may_tilt,
    models_along,
    once,
    point_of,
    refuse,
    state_of,
)

# Entries of f0 [SI] up to this magnitude count as zero.
_MOVES = 1e-9


def robots(_: Namespace) -> Report:
    """List the robots that can be loaded by name.

    example: fflin robots
    """
    from fflin.robot.catalog import find_robot

    rows = [["name", "n", "mass [kg]", "from"]]
    notes = []
    result = dict[str, object]()
    for name in fflin.list_robots():
        robot_file = find_robot(name)
        try:
            with warnings.catch_warnings():
                # Ignore the warnings of `load` here, because `fflin info` shows them.
                warnings.simplefilter("ignore", FflinWarning)
                robot = fflin.load(name)
            rows.append([name, str(robot.n), f"{robot.mass:.6g}", robot_file.origin])
            result[name] = {"n": robot.n, "mass": robot.mass}
        except FflinError as error:
            reason = str(error).replace(f"{robot_file.path.parent}{os.sep}", "")
            notes.append(folded([f"{name} does not load: {reason}"]))
            result[name] = {"error": reason}
    head = (
        f"{len(rows) - 1} robots can be loaded by name; {len(notes)} cannot be loaded"
    )
    return Report(
        None, {"robots": result}, "\n\n".join((head, grid(rows, "lrrl"), *notes))
    )


def info(arguments: Namespace) -> Report:
    """Show the joints, limits, settings, mass, inertia, wheels and thrusters of a robot.

    example: fflin info servicer_7dof
    """
    import numpy as np

    from fflin.control.authority import point_properties
    from fflin.dynamics.state import Actuation
    from fflin.robot.fields import limits_of
    from fflin.robot.summary import ideal_inputs, robot_info

    robot = load_robot(arguments)
    q, v = state_of(robot, arguments, robot.point)
    v = np.zeros(robot.nv) if v is None else v
    properties = point_properties(robot, q, v)
    state, limits = fflin.StateMap(robot), limits_of(robot)
    inputs = Actuation(state)
    rows = [["input", "unit", "min", "max"]]
    for name, unit in zip(inputs.names, inputs.units, strict=True):
        ends = limits.get(name, (-math.inf, math.inf))
        row = [name, unit]
        for end in ends:
            row.append(f"{end:.5g}" if math.isfinite(end) else ".")
        rows.append(row)
    table = grid(cut(rows, "see --json"), "ll")
    text = f"{robot_info(robot, str(properties))}\n\n{table}"
    constraints: dict[str, object] = {}
    if robot.constraints:
        from fflin.dynamics.closure import redundancy

        found = redundancy(robot, q)
        lines = [f"constraints: {found}", *map(str, robot.constraints)]
        text += f"\n\n{folded(lines)}"
        constraints = {
            "constraints": [item.title for item in robot.constraints],
            **found._asdict(),
        }
    notes = robot.notes
    if remark := ideal_inputs(robot):
        notes = (*notes, remark)
        text += f"\n\n{folded([f'warning: {remark}'])}"
    result = {
        "mass": robot.mass,
        **properties._asdict(),
        "joint_names": robot.joint_names,
        "wheels": robot.wheels,
        "state_names": state.names,
        "state_units": state.units,
        "input_names": inputs.names,
        "input_units": inputs.units,
        "input_lags": {
            names[0]: item.lag for item, names in robot.named_inputs if item.lag
        },
        "thrusters": {
            names[0]: {
                "on_off": item.on_off,
                "least_impulse": item.least_impulse,
                "isp": item.isp,
            }
            for item, names in robot.named_inputs
            if isinstance(item, fflin.Thruster)
        },
        "outputs": [
            {"type": output.WORD, **asdict(output)} for output in robot.outputs
        ],
        "limits": limits,
        "orbit": asdict(robot.orbit) if robot.orbit else None,
        "notes": notes,
        **constraints,
    }
    return Report(robot.name, result, text)


def init(arguments: Namespace) -> Report:
    """Write an initial robot.toml for a URDF, with unactuated joints and suggestions for inputs.

    example: fflin init my.urdf && fflin simulate my.toml
    """
    from fflin.robot.catalog import find_robot
    from fflin.robot.summary import draft

    robot_file = find_robot(arguments.robot)
    if robot_file.path.suffix.lower() == ".toml":
        raise InputError(
            f"{robot_file.path} is already a robot file; give the path of a URDF"
        )
    target = arguments.output_file or Path(f"{robot_file.name}.toml")
    if target.exists() and not arguments.force:
        raise FileError(
            f"{target} already exists; give another name with -o, or replace the file with --force"
        )
    urdf = robot_file.name
    if robot_file.origin == "file":
        urdf = os.path.relpath(
            os.path.realpath(robot_file.path), os.path.realpath(target.parent)
        )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        robot = fflin.load(arguments.robot)
    write_atomically({target: draft(robot, urdf).encode()})
    fflin.load(target)  # warns of settings that the file leaves open
    text = (
        f"wrote {target}, a robot file of '{robot.name}', with an ideal torque and force on the "
        "base until you uncomment its inputs; to simulate the robot, run: fflin simulate "
        f"{target}"
    )
    return Report(robot.name, {}, text, {target: None})


def view(arguments: Namespace) -> Report:
    """Show a robot live in the browser with a slider for each joint.

    example: fflin view servicer_7dof --joint joint_2=0.4
    """
    from fflin.view.live import Live

    robot = load_robot(arguments)
    q, _ = state_of(robot, arguments, robot.point, robot.start)
    how = {name: getattr(arguments, name) for name in (*SHOWN, "frame")}
    live = fflin.visualize(robot, open=False, q=q, port=arguments.port or 0, **how)
    assert isinstance(live, Live)  # since there is no motion
    print(
        f"fflin: {robot.name} at {live.url} (Ctrl-C ends)", file=sys.stderr, flush=True
    )
    if not arguments.no_open:
        live.open()
    live.wait()
    return Report(robot.name, {}, f"{robot.name}: the view is closed")


def linearize(arguments: Namespace) -> Report:
    """Show or save the linear model A, B, C, D about an operating point.

    example: fflin linearize ets_vii --joint joint_2=0.5 -o ets_vii.mat
    """
    path = arguments.output_file
    tool = getattr(arguments, "for")
    if tool and not path:
        raise InputError("--for saves the converted model; add -o FILE")
    many = arguments.trajectory or arguments.periodic
    if path and (tool or many):
        check_ending(path, RECORDS)
    if many:
        why = "this option is for one model, but --trajectory and --periodic give many"
        refuse(arguments, ("for", "plot", "time"), why)
        along = models_along(arguments)
        if arguments.dt is not None:
            along = along.discretize(arguments.dt)
        return _report_along(along, path)
    refuse(arguments, ("motion", "period"), "without --periodic N, this has no effect")
    _, lin = linear_model(arguments)
    if arguments.dt is not None:
        lin = lin.discretize(arguments.dt)
    model = lin.to(tool) if tool else lin
    nx, nu = model.B.shape
    text = f"{lin.robot}: {nx} states, {nu} inputs" if path else model_report(lin)
    files = {
        path: model.save,
        arguments.plot: lambda path: fflin.plot_matrices(lin, path),
    }
    return Report(lin.robot, model, text, files)


def _report_along(along: fflin.LinearTrajectory, path: Path | None) -> Report:
    """Return the report of linear models along a trajectory or over one period."""
    from fflin.base.record import record_of

    text, result = str(along), record_of(along)
    if along.period:
        sizes = abs(along.multipliers)
        shown = ", ".join(f"{size:.6g}" for size in sizes)
        text += f"\n{folded([f'magnitudes of all multipliers: {shown}'])}"
        result["multipliers"] = along.multipliers
    return Report(along.robot.name, result, text, {path: along.save})


def check(arguments: Namespace) -> Report:
    """Compare A and B with two independent computations; the exit code is 1 if the results differ.

    example: fflin check canadarm2 --rpy 20 0 0 --reference world --frame world
    """
    if arguments.trajectory or arguments.periodic:
        along = models_along(arguments)
        robot = along.robot
        comparison = along.check(tolerance=arguments.tolerance)
        text = f"{comparison}\n\n{along}"
    else:
        robot, lin = linear_model(arguments)
        comparison = fflin.check(robot, lin, tolerance=arguments.tolerance)
        text = str(comparison)
    result = {
        "ok": comparison.ok,
        "max_error": comparison.max_error,
        "rows": comparison.rows,
    }
    files = {arguments.plot: lambda path: fflin.plot_check(comparison, path)}
    code = DONE if comparison.ok else FELL_SHORT
    return Report(robot.name, result, text, files, code)


def model_report(lin: fflin.LinearModel) -> str:
    """Format a linear model: its operating point, A, B, C, D and its certificate."""
    import numpy as np

    nx, nu = lin.B.shape
    stays, f0 = lin.is_equilibrium(), np.where(np.abs(lin.f0) > _MOVES, lin.f0, 0.0)
    point = "a fixed point" if stays else "not a fixed point"
    if stays and (lin.moving or f0.any()):
        point = "a relative equilibrium"
    head = f"{lin.robot}: {nx} states, {nu} inputs, frame {lin.frame}"
    if lin.dt:
        head += f", sampled every {lin.dt:g} s"
    if lin.t is not None:
        head += f", at t = {lin.t:g} s"
    head += f"; the operating point is {point}"
    parts = [folded([head, *_units(lin)])]
    if lin.dependent:
        parts.append(
            folded(
                [
                    f"constraints of rank {lin.rank} determine {len(lin.dependent)} other states: "
                    f"{listed(lin.dependent)}"
                ]
            )
        )
    rates = lin.state_units if lin.dt else [_rate(unit) for unit in lin.state_units]
    # Report unstable poles only for a continuous, constant model at an equilibrium. Otherwise,
    # poles do not determine stability. If A^2 = 0, do not compute the poles, because all of them
    # are zero.
    constant = lin.t is None and not lin.dt
    has_poles = stays and constant and (lin.A @ lin.A).any()
    growing = fflin.modes(lin).unstable if has_poles else ()
    if growing:
        shown = ", ".join(f"{mode.pole:.5g}" for mode in growing)
        parts.append(folded([f"unstable poles (positive real part): {shown}"]))
    vectors = (
        ("x0", lin.x0, lin.state_names, lin.state_units),
        ("u0", lin.u0, lin.input_names, lin.input_units),
        ("f0", f0, lin.state_names, rates),
    )
    if moved := [signals(*vector) for vector in vectors if vector[1].any()]:
        parts.append("\n".join(moved))
    x, u, y = lin.state_names, lin.input_names, lin.output_names
    matrices = [("A", x, x), ("B", x, u), ("C", y, x), ("D", y, u)]
    of_states = y == x and not lin.D.any()
    if of_states:
        matrices = matrices[:2]
    for title, rows, columns in matrices:
        values = getattr(lin, title)
        text = f"{title} ({len(rows)} x {len(columns)})"
        if values.any():
            text += "; rows and columns of zeros are not shown\n\n"
            text += matrix(values, rows, columns, "see -o")
        else:
            text += " is zero"
        parts.append(text)
    if of_states:
        parts.append("C = I, D = 0: the output is the state")
    c = lin.certificate
    computation = "constrained" if lin.dependent else "ABA"
    parts.append(
        f"relative error compared with {computation} derivatives: A {c.route_A:.1e}, B "
        f"{c.route_B:.1e}\nlargest entries: M M^-1 - I {c.inertia_residual:.1e}, f0 "
        f"{c.f0:.1e}\ncondition number of the scaled M: {c.condition:.1e}"
    )
    return "\n\n".join(parts)


def _units(lin: fflin.LinearModel) -> list[str]:
    """Return lines of text with the units of the states, of the inputs and of the outputs.

    For example, the line for the inputs is "u: tau_b [N m], F_b [N], tau_m [N m]". There is no line
    for the outputs if they are the states.
    """
    signals = {
        "x": (lin.state_names, lin.state_units),
        "u": (lin.input_names, lin.input_units),
    }
    if lin.output_names != lin.state_names:
        signals["y"] = lin.output_names, lin.output_units
    return [
        f"{title}: {with_units(names, units)}"
        for title, (names, units) in signals.items()
    ]


def _rate(unit: str) -> str:
    if unit == "1":
        return "1/s"
    if unit.endswith("/s"):
        return f"{unit}^2"
    return f"{unit}/s"


def analyze(arguments: Namespace) -> Report:
    """Show controllability, conserved momenta, modes and observability of a linear model.

    example: fflin analyze servicer_7dof --stiffness panel_left=100 --output joints
    """
    if arguments.periodic:
        return _analysis_of_period(arguments)
    refuse(arguments, ("motion", "period"), "without --periodic N, this has no effect")
    _, lin = linear_model(arguments)
    moved = fflin.controllability(lin)
    shown = fflin.observability(lin)
    lin_modes = fflin.modes(lin)
    parts = {
        "inputs": moved,
        "momentum": _momentum(lin),
        "modes": lin_modes,
        "outputs": shown,
    }
    poles = counted(len(lin_modes.unstable), "unstable pole")
    if not lin_modes.equilibrium:
        # away from an equilibrium, poles do not decide stability
        poles += " of the frozen A"
    head = [_rank(moved, "controllable"), _rank(shown, "observable"), poles]
    sections = (f"{title}\n{'-' * len(title)}\n{text}" for title, text in parts.items())
    result = {"controllability": moved, "observability": shown, "modes": lin_modes}
    text = "\n\n".join([", ".join(head), *sections])
    files = {arguments.plot: lambda path: fflin.plot_modes(lin_modes, path)}
    return Report(lin.robot, result, text, files)


def _analysis_of_period(arguments: Namespace) -> Report:
    """Return the report of controllability, observability and multipliers over one period."""
    why = "this option is for one model, but --periodic gives many"
    refuse(arguments, ("plot",), why)
    along = models_along(arguments)
    moved = fflin.controllability(along)
    shown = fflin.observability(along)
    head = [_rank(moved, "controllable"), _rank(shown, "observable")]
    parts = {"inputs": str(moved), "motion": str(along), "outputs": str(shown)}
    sections = (f"{title}\n{'-' * len(title)}\n{text}" for title, text in parts.items())
    result = {
        "controllability": moved,
        "observability": shown,
        "multipliers": along.multipliers,
    }
    text = "\n\n".join([", ".join(head), *sections])
    return Report(along.robot.name, result, text)


def _rank(ranks: fflin.Controllability | fflin.Observability, adjective: str) -> str:
    """Return whether all states are controllable, or observable, for the headline."""
    from fflin.analysis.ranks import FROZEN, GRAMIAN

    nx = len(ranks.basis)
    if ranks.method == GRAMIAN and ranks.margin.doubts:
        return f"{adjective.removesuffix('able')}ability undecided"
    if ranks.bound < nx:
        most = "at most " if ranks.method == FROZEN else ""
        return f"not {adjective} ({most}{ranks.bound}/{nx})"
    if ranks.method == FROZEN:
        return f"{ranks.dimension}/{nx} {adjective} by frozen matrices"
    return adjective


def modes(arguments: Namespace) -> Report:
    """Show natural frequencies, damping ratios, kinetic energies and effective masses.

    example: fflin modes servicer_7dof --stiffness panel_left=100 --stiffness panel_right=100
    """
    robot, lin = linear_model(arguments)
    lin_modes = fflin.modes(lin)
    result: dict[str, object] = {"modes": lin_modes}
    if any(robot.stiffness.values()):
        result["effective_masses"] = fflin.effective_masses(lin)
    parts = [str(part) for part in result.values()]
    if robot.orbit and not lin_modes.equilibrium:
        hint = (
            "for the modes about an equilibrium in orbit, add --equilibrium or "
            "--relative-equilibrium"
        )
        parts.append(folded([hint]))
    files = {
        arguments.plot: lambda path: fflin.plot_modes(lin_modes, path),
        arguments.html: lambda path: fflin.visualize(robot, lin_modes, html=path),
    }
    return Report(robot.name, result, "\n\n".join(parts), files)


def equilibrium(arguments: Namespace) -> Report:
    """Show whether an operating point is stable, its holding inputs, and its spring deflections.

    example: fflin equilibrium servicer_7dof --stiffness panel_left=100 --gravity 0 0 -0.01
    """
    from fflin.base.record import write_record
    from fflin.dynamics.points import LIMIT_SLACK
    from fflin.linear.holding import wheel_notes
    from fflin.robot.disturbance import plates_of, terms_of
    from fflin.robot.fields import limits_of

    refuse(
        arguments,
        ("effort",),
        "this command computes the inputs at the operating point",
    )
    robot = load_robot(arguments)
    q, v, reference = point_of(robot, arguments)
    axes = {"frame": arguments.frame, "reference": reference}
    held = fflin.equilibrium(robot, q, v=v, tilt=may_tilt(robot, arguments), **axes)
    lin = fflin.linearize(robot, held.q, v, held.u, **axes)
    lin_modes = fflin.modes(lin)
    poles = lin_modes.poles
    growth = float(poles.real.max(initial=-math.inf))
    decays = not lin_modes.zero_eigenvalues and all(
        mode.margin < -1.0 for mode in lin_modes.modes
    )
    stability = "marginally stable"
    if lin_modes.zero_eigenvalues:
        # A push is not undone, and a double eigenvalue at zero drifts with constant velocity.
        stability = "neutral, it may drift"
    if lin_modes.unstable:
        stability = "unstable"
    elif decays:
        stability = "stable"
    state = "x0: all zero"
    if lin.x0.any():
        state = signals("x0", lin.x0, lin.state_names, lin.state_units)
    lines = [
        f"{robot.name}: {stability}; the largest real part of a pole is {growth:.3g} 1/s, "
        f"{counted(lin_modes.zero_eigenvalues, 'eigenvalue')} at zero",
        state,
        str(held),
        *(folded([note]) for note in wheel_notes(lin)),
    ]
    disturbed: fflin.Equilibrium | None = None
    constant = any(any(term.constant) for _, term in terms_of(robot.disturbance))
    if constant or plates_of(robot.disturbance):
        title = "u against the constant disturbance too"
        try:
            disturbed = fflin.equilibrium(
                robot, q, v=v, tilt=may_tilt(robot, arguments), disturbed=True, **axes
            )
            names, units = disturbed.input_names, disturbed.input_units
            lines.append(signals(title, disturbed.u, names, units))
        except EquilibriumError as error:
            lines.append(folded([f"{title}: none, {error}"]))
    names = (*lin.state_names, *lin.input_names)
    value_of = dict(zip(names, (*lin.x0, *held.u), strict=True))
    limits = limits_of(robot).items()
    excess = {
        k: max(low - value_of[k], value_of[k] - high)
        for k, (low, high) in limits
        if k in value_of
    }
    beyond = [name for name, size in excess.items() if size > LIMIT_SLACK]
    if beyond:
        lines.append(folded([f"beyond their limits: {listed(beyond)}"]))
    result = {
        **vars(held),
        "beyond_limits": beyond,
        "state_names": lin.state_names,
        "state_units": lin.state_units,
        "x0": lin.x0,
        "stability": stability,
        "largest_real_part": growth,
        "zero_eigenvalues": lin_modes.zero_eigenvalues,
        "poles": poles,
    }
    if disturbed is not None:
        result["disturbed_u"] = disturbed.u
    entries = {"kind": "Equilibrium", **vars(held), "poles": poles}
    write = partial(write_record, record=entries, checksummed=True)
    return Report(robot.name, result, "\n".join(lines), {arguments.output_file: write})


def _momentum(lin: fflin.LinearModel) -> str:
    try:
        reduced = fflin.momentum_reduction(lin)
    except InputError as error:
        return folded([f"no reduction: {error}"])
    if len(reduced.momenta):
        components = counted(len(reduced.momenta), "component")
        # The reduction also removes wheels, whose torques change the momentum of the other bodies.
        removed = {f"q_m.{name}" for name in lin.wheels} - {*reduced.state_names}
        bodies = " of the robot without its wheels" if removed else ""
        text = (
            f"{components} of the momentum{bodies} cannot be changed by any input; the model "
            f"reduced by the conserved momentum has {len(reduced.A)} states"
        )
    elif not lin.is_equilibrium():
        cause = "the orbit" if lin.mean_motion else "inputs"
        text = (
            "no momentum can be removed: the operating point is not an equilibrium, and "
            f"{cause} may change every component of the momentum"
        )
    else:
        causes = "inputs, springs or dampers"
        if lin.mean_motion:
            causes = f"the orbit, {causes}"
        text = f"no momentum is conserved, because {causes} change every component of the momentum"
    return folded([text, *(f"note: {note}" for note in reduced.notes)])


def sensitivity(arguments: Namespace) -> Report:
    """Show or save the derivatives of A and B with respect to the parameters of the robot.

    example: fflin sensitivity servicer_7dof --joint joint_2=0.6 --top 10 -o changes.mat
    """
    from fflin.uncertainty.sensitivity import sensitivity_record

    _, lin = linear_model(arguments)
    model = lin if arguments.dt is None else lin.discretize(arguments.dt)
    derivatives = fflin.sensitivity(model)
    text = derivatives.table(arguments.top, arguments.only)
    return Report(
        lin.robot,
        sensitivity_record(derivatives),
        text,
        {arguments.output_file: derivatives.save},
    )


def uncertain(arguments: Namespace) -> Report:
    """Show or save the exact linear-fractional model (LFT) of an uncertain robot at rest.

    example: fflin uncertain servicer_7dof --vary base.mass=0.2 --vary panel_left.stiffness=80:120
    -o uncertain.mat
    """
    robot, ranges = load_robot(arguments), once("--vary", arguments.vary)
    q, v = state_of(robot, arguments, robot.point)
    if v is not None:
        text = (
            "the uncertain model describes the robot at rest, so the velocity in [point] of "
            "robot.toml is ignored"
        )
        warnings.warn(text, FflinWarning, stacklevel=2)
    lft = fflin.uncertain(robot, ranges).lft(q)
    return Report(robot.name, lft, str(lft), {arguments.output_file: lft.save})
