"""Commands `analyze`, `modes`, `equilibrium`, `sensitivity` and `uncertain`."""

from __future__ import annotations

import argparse
import math
import warnings
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from fflin.base.errors import FflinWarning, InputError, listed
from fflin.base.tables import counted, folded, signals
from fflin.commands import options, parser
from fflin.commands.points import attitude, linear_model, load_robot, once, placed, point_of, refuse
from fflin.commands.results import Report, figure_of, plain

if TYPE_CHECKING:
    from fflin.linear.model import LinearModel


_SLACK = 1e-9  # [SI]; a value counts as at its limit within this distance


def add_commands(commands: parser.Commands) -> None:
    """Add the commands analyze, modes, equilibrium, sensitivity and uncertain."""
    analyze = parser.command(
        commands,
        _analyze,
        "joint rpy velocity equilibrium relative-equilibrium orbit stiffness inputs output "
        "frame plot",
    )
    options.add_point(analyze)
    options.add_figure(analyze, "the modes")
    modes = parser.command(
        commands,
        _modes,
        "joint rpy velocity equilibrium relative-equilibrium orbit stiffness inputs output "
        "frame plot html",
    )
    options.add_point(modes)
    options.add_figure(modes, "the frequencies, damping ratios and shapes of the modes")
    pages = modes.group(parser.OUTPUT)
    pages.add("--html", "write an HTML page that animates the mode shapes", parser.PAGE)
    held = parser.command(
        commands,
        _equilibrium,
        "joint rpy velocity relative-equilibrium orbit stiffness gravity passive inputs frame "
        "output-file",
    )
    options.add_point(held)
    what = "the equilibrium (q, u, spring deflections and poles)"
    options.add_output_file(held.group(parser.OUTPUT), what, parser.RECORD, "Equilibrium")
    _add_sensitivity(commands)
    _add_uncertain(commands)


def _add_sensitivity(commands: parser.Commands) -> None:
    sensitivity = parser.command(
        commands,
        _sensitivity,
        "joint rpy velocity equilibrium inputs frame dt top only output-file",
    )
    options.add_point(sensitivity)
    model = sensitivity.group("derivatives")
    model.add(
        "--dt",
        "differentiate the model after it is sampled at the sample time H [s] with zero-order hold",
        float,
        "H",
    )
    top = "show the N parameters with the largest effect"
    model.add("--top", top, int, default=15)
    model.add(
        "--only",
        "show only the parameters that NAME selects. NAME is a kind of parameter, a link or a "
        "pattern, such as mass, link_3 or *.density",
        metavar="NAME",
    )
    what = "the derivatives dA, dB and df0 for each parameter"
    options.add_output_file(sensitivity.group(parser.OUTPUT), what, parser.RECORD, "Sensitivity")


def _add_uncertain(commands: parser.Commands) -> None:
    uncertain = parser.command(commands, _uncertain)
    options.add_joint(uncertain.group(parser.POINT))
    options.add_robot(uncertain)
    options.add_system(uncertain)
    uncertain.group("parameters").add(
        "--vary",
        "range of the parameter NAME, or of all parameters that match a pattern; `fflin "
        "sensitivity` lists the names. RANGE is a largest deviation as a fraction of the nominal "
        "value, such as 0.2, or the bounds LEAST:LARGEST. With `,tied` after RANGE, such as "
        "0.2,tied, all parameters that match the pattern vary together",
        _range,
        "NAME=RANGE",
        repeatable=True,
        required=True,
    )
    what = "the matrices A, B1 .. D22 and the blocks of Delta"
    options.add_output_file(uncertain.group(parser.OUTPUT), what, parser.RECORD, "LFT")


def _range(text: str) -> tuple[str, object]:
    name, _, value = text.rpartition("=")
    tied = value.endswith(",tied")
    ends = value.removesuffix(",tied").split(":")
    if not name or len(ends) > 2:
        raise argparse.ArgumentTypeError(
            f"'{text}' is not of the form NAME=FRACTION or NAME=LEAST:LARGEST"
        )
    found = tuple(map(parser.number, ends)) if ends[1:] else parser.number(ends[0])
    return name, {"range": found, "tied": True} if tied else found


def _analyze(arguments: argparse.Namespace) -> Report:
    """Show controllability, conserved momenta, modes and observability of a linear model.

    example: fflin analyze servicer_7dof --stiffness panel_left=100 --output joints
    """
    from fflin.analysis.controllability import controllability
    from fflin.analysis.modes import modes
    from fflin.analysis.observability import observability

    _, lin = linear_model(arguments)
    moved, shown, found = controllability(lin), observability(lin), modes(lin)
    parts = {
        "inputs": str(moved),
        "momentum": _momentum(lin),
        "modes": str(found),
        "outputs": str(shown),
    }
    nx = len(lin.A)
    head = [
        "controllable" if moved.dimension == nx else f"not controllable ({moved.dimension}/{nx})",
        "observable" if shown.dimension == nx else f"not observable ({shown.dimension}/{nx})",
        counted(len(found.unstable), "unstable pole"),
    ]
    sections = (f"{title}\n{'-' * len(title)}\n{text}" for title, text in parts.items())
    result = {"controllability": moved, "observability": shown, "modes": found}
    text = "\n\n".join([", ".join(head), *sections])
    return Report(lin.robot, result, text, {arguments.plot: figure_of("plot_modes", found)})


def _modes(arguments: argparse.Namespace) -> Report:
    """Show natural frequencies, damping ratios, kinetic energies and effective masses.

    example: fflin modes servicer_7dof --stiffness panel_left=100 --stiffness panel_right=100
    """
    from fflin.analysis.effective_masses import effective_masses
    from fflin.analysis.modes import modes

    robot, lin = linear_model(arguments)
    found = modes(lin)
    result: dict[str, object] = {"modes": found}
    parts = [str(found)]
    if any(robot.stiffness.values()):
        result["effective_masses"] = effective_masses(lin)
        parts.append(str(result["effective_masses"]))
    if robot.orbit and not found.equilibrium:
        parts.append(
            "for the modes about an equilibrium in orbit, add --equilibrium or "
            "--relative-equilibrium"
        )

    def page(path: Path) -> None:
        from fflin.view.visualize import visualize

        visualize(robot, found, html=path)

    files = {arguments.plot: figure_of("plot_modes", found), arguments.html: page}
    return Report(robot.name, result, "\n\n".join(parts), files)


def _equilibrium(arguments: argparse.Namespace) -> Report:
    """Show whether an operating point is stable, its holding inputs, and its spring deflections.

    example: fflin equilibrium servicer_7dof --stiffness panel_left=100 --gravity 0 0 -0.01
    """
    from fflin.analysis.modes import modes
    from fflin.base.record import write_record
    from fflin.linear.equilibrium import equilibrium
    from fflin.linear.linearization import linearize
    from fflin.robot.fields import limits_of

    refuse(arguments, ("effort",), "this command computes the inputs at the operating point")
    robot, q, v, reference = point_of(arguments)
    if arguments.relative_equilibrium:
        q, reference = attitude(robot, q, arguments.relative_equilibrium, arguments.frame)
    axes = {"frame": arguments.frame, "reference": reference}
    held = equilibrium(robot, q, v=v, **axes)
    lin = linearize(robot, held.q, v, held.u, **axes)
    found = modes(lin)
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
        **plain(held),
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


def _momentum(lin: LinearModel) -> str:
    from fflin.analysis.reduction import momentum_reduction

    try:
        reduced = momentum_reduction(lin)
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


def _sensitivity(arguments: argparse.Namespace) -> Report:
    """Show or save the derivatives of A and B with respect to the parameters of the robot.

    example: fflin sensitivity servicer_7dof --joint joint_2=0.6 --top 10 -o changes.mat
    """
    from fflin.uncertainty.sensitivity import sensitivity, sensitivity_record

    _, lin = linear_model(arguments)
    found = sensitivity(lin if arguments.dt is None else lin.discretize(arguments.dt))
    text = found.table(arguments.top, arguments.only)
    return Report(lin.robot, sensitivity_record(found), text, {arguments.output_file: found.save})


def _uncertain(arguments: argparse.Namespace) -> Report:
    """Show or save the exact linear-fractional model (LFT) of an uncertain robot at rest.

    example: fflin uncertain servicer_7dof --vary base.mass=0.2 --vary panel_left.stiffness=80:120
    -o uncertain.mat
    """
    from fflin.dynamics.points import base_of
    from fflin.uncertainty.uncertain import uncertain

    robot, ranges = load_robot(arguments), once("--vary", arguments.vary)
    if robot.point.get("velocity"):
        text = (
            "the uncertain model describes the robot at rest, so the velocity in [point] of "
            "robot.toml is ignored"
        )
        warnings.warn(text, FflinWarning, stacklevel=2)
    base, joints = base_of(robot.point), robot.point.get("joints")
    lft = uncertain(robot, ranges).lft(placed(robot, "--joint", arguments.joint, base, joints))
    return Report(robot.name, lft, str(lft), {arguments.output_file: lft.save})
