"""Commands `analyze`, `modes`, `equilibrium`, `sensitivity` and `uncertain`."""

from __future__ import annotations

import math
import warnings
from argparse import Namespace
from functools import partial

import fflin
from fflin.base.errors import FflinWarning, InputError, listed
from fflin.base.tables import counted, folded, signals
from fflin.commands.points import (
    linear_model,
    load_robot,
    once,
    point_of,
    refuse,
    state_of,
)
from fflin.commands.results import Report

_SLACK = 1e-9  # [SI]; a value counts as at its limit within this distance


def analyze(arguments: Namespace) -> Report:
    """Show controllability, conserved momenta, modes and observability of a linear model.

    example: fflin analyze servicer_7dof --stiffness panel_left=100 --output joints
    """
    _, lin = linear_model(arguments)
    moved, shown, found = fflin.controllability(lin), fflin.observability(lin), fflin.modes(lin)
    parts = {"inputs": moved, "momentum": _momentum(lin), "modes": found, "outputs": shown}
    nx = len(lin.A)
    head = [
        "controllable" if moved.dimension == nx else f"not controllable ({moved.dimension}/{nx})",
        "observable" if shown.dimension == nx else f"not observable ({shown.dimension}/{nx})",
        counted(len(found.unstable), "unstable pole"),
    ]
    sections = (f"{title}\n{'-' * len(title)}\n{text}" for title, text in parts.items())
    result = {"controllability": moved, "observability": shown, "modes": found}
    text = "\n\n".join([", ".join(head), *sections])
    files = {arguments.plot: lambda path: fflin.plot_modes(found, path)}
    return Report(lin.robot, result, text, files)


def modes(arguments: Namespace) -> Report:
    """Show natural frequencies, damping ratios, kinetic energies and effective masses.

    example: fflin modes servicer_7dof --stiffness panel_left=100 --stiffness panel_right=100
    """
    robot, lin = linear_model(arguments)
    found = fflin.modes(lin)
    result: dict[str, object] = {"modes": found}
    if any(robot.stiffness.values()):
        result["effective_masses"] = fflin.effective_masses(lin)
    parts = [str(part) for part in result.values()]
    if robot.orbit and not found.equilibrium:
        parts.append(
            "for the modes about an equilibrium in orbit, add --equilibrium or "
            "--relative-equilibrium"
        )
    files = {
        arguments.plot: lambda path: fflin.plot_modes(found, path),
        arguments.html: lambda path: fflin.visualize(robot, found, html=path),
    }
    return Report(robot.name, result, "\n\n".join(parts), files)


def equilibrium(arguments: Namespace) -> Report:
    """Show whether an operating point is stable, its holding inputs, and its spring deflections.

    example: fflin equilibrium servicer_7dof --stiffness panel_left=100 --gravity 0 0 -0.01
    """
    from fflin.base.record import write_record
    from fflin.robot.fields import limits_of

    refuse(arguments, ("effort",), "this command computes the inputs at the operating point")
    robot = load_robot(arguments)
    q, v, reference = point_of(robot, arguments, robot.point)
    axes = {"frame": arguments.frame, "reference": reference}
    held = fflin.equilibrium(robot, q, v=v, **axes)
    lin = fflin.linearize(robot, held.q, v, held.u, **axes)
    found = fflin.modes(lin)
    poles = found.poles
    growth = float(poles.real.max(initial=-math.inf))
    decays = not found.zero_eigenvalues and all(mode.margin < -1.0 for mode in found.modes)
    stability = "unstable" if found.unstable else "stable" if decays else "marginally stable"
    lines = [
        f"{robot.name}: {stability}; the largest real part of a pole is {growth:.3g} 1/s, "
        f"{counted(found.zero_eigenvalues, 'eigenvalue')} at zero",
        signals("x0", lin.x0, lin.state_names, lin.state_units) if lin.x0.any() else "x0: all zero",
        str(held),
    ]
    names = (*lin.state_names, *lin.input_names)
    there = dict(zip(names, (*lin.x0, *held.u), strict=True))
    limits = limits_of(robot).items()
    excess = {k: max(low - there[k], there[k] - high) for k, (low, high) in limits if k in there}
    beyond = [name for name, size in excess.items() if size > _SLACK]
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
        "zero_eigenvalues": found.zero_eigenvalues,
        "poles": poles,
    }
    entries = {"kind": "Equilibrium", **vars(held), "poles": poles}
    write = partial(write_record, record=entries, checksummed=True)
    return Report(robot.name, result, "\n".join(lines), {arguments.output_file: write})


def _momentum(lin: fflin.LinearModel) -> str:
    try:
        reduced = fflin.momentum_reduction(lin)
    except InputError as error:
        text = f"no reduction: {error}"
    else:
        orbit = "the orbit, " * bool(lin.mean_motion)
        text = (
            f"no momentum is conserved, because {orbit}inputs, springs or dampers change every "
            "component of the momentum"
        )
        if len(reduced.momenta):
            components = counted(len(reduced.momenta), "component")
            text = (
                f"{components} of the momentum cannot be changed by any input; the model reduced "
                f"by the conserved momentum has {len(reduced.A)} states"
            )
        elif not lin.is_equilibrium():
            text = "no momentum can be removed, because the operating point is not an equilibrium"
        text = "\n".join((text, *(f"note: {note}" for note in reduced.notes)))
    return folded(text.splitlines())


def sensitivity(arguments: Namespace) -> Report:
    """Show or save the derivatives of A and B with respect to the parameters of the robot.

    example: fflin sensitivity servicer_7dof --joint joint_2=0.6 --top 10 -o changes.mat
    """
    from fflin.uncertainty.sensitivity import sensitivity_record

    _, lin = linear_model(arguments)
    found = fflin.sensitivity(lin if arguments.dt is None else lin.discretize(arguments.dt))
    text = found.table(arguments.top, arguments.only)
    return Report(lin.robot, sensitivity_record(found), text, {arguments.output_file: found.save})


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
