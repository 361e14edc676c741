"""The commands `analyze`, `modes`, `validity`, `sensitivity` and `uncertain`."""

from __future__ import annotations

import argparse
from contextlib import nullcontext
from typing import TYPE_CHECKING, Any

from fflin.base.errors import InputError
from fflin.base.tables import counted, headed
from fflin.commands import DONE
from fflin.commands.arguments import (
    Commands,
    add_options,
    add_output_file,
    add_point,
    add_robot,
    add_system,
    command,
    number,
)
from fflin.commands.points import linear_model, load_robot, once, placed
from fflin.commands.regulator import add_weights, gain_of, regulated_part
from fflin.commands.tracking import say
from fflin.commands.visual import add_figure, check_figure, draw

if TYPE_CHECKING:
    from fflin.linear.model import LinearModel


def add_commands(commands: Commands) -> None:
    """Add analyze, modes, validity, sensitivity and uncertain."""
    analyze = command(
        *(commands, "analyze", _analyze),
        "show controllability, conserved momenta, modes and observability of a linear model",
        "fflin analyze servicer_7dof --stiffness panel_left=100 --output joints",
    )
    add_point(analyze)
    add_figure(analyze, "plot the modes")
    modes = command(
        *(commands, "modes", _modes),
        "show natural frequencies, damping ratios, kinetic energies and effective masses",
        "fflin modes servicer_7dof --stiffness panel_left=100 --stiffness panel_right=100",
    )
    add_point(modes)
    add_figure(modes, "plot frequencies, damping and shapes")
    add_options(modes, "--html >FILE: write a page that plays the mode shapes")
    validity = command(
        *(commands, "validity", _validity),
        "measure how far the robot can be displaced until the linear model or its regulator fails",
        "fflin validity ets_vii --attitude 120 --samples 200 --jobs 2",
    )
    add_point(validity)
    add_weights(validity)
    add_options(
        validity,
        """
        --attitude X = 90: largest rotation of the base [deg]; 90 by default
        --offset X = 0.5: largest displacement of the base [m]; 0.5 by default
        --spread X = 1: largest displacement of a joint [rad|m]; 1 by default
        --samples N = 100: number of random runs; 100 by default
        --seed S = 0: random seed of the runs; 0 by default
        --jobs N = 1: number of processes, at most one for each core; 1 by default
        --limits urdf|none = none: saturate the inputs at the limits of the robot (urdf), or never
            (none, default)""",
    )
    frames = """--frames hybrid|local|world: also test the loop with base velocities and inputs in
        these axes"""
    add_options(validity, frames, nargs="+", default=())
    add_figure(validity, "plot the results")
    sensitivity = command(
        *(commands, "sensitivity", _sensitivity),
        "show or save the derivatives of A and B with respect to masses, springs, thrusters ...",
        "fflin sensitivity servicer_7dof --joint joint_2=0.6 --top 10 -o changes.mat",
    )
    add_point(sensitivity)
    add_options(sensitivity, "--dt H: differentiate the sampled model, with inputs held for H [s]")
    add_options(
        sensitivity, "--top N = 15: show the N parameters with the largest effect; 15 by default"
    )
    add_options(
        sensitivity,
        "--only NAME: show only the parameters of this kind, link or pattern, such as mass, "
        "link_3, *.density",
    )
    add_output_file(
        sensitivity,
        "save dA, dB, df0 for each parameter to FILE: .npz, .mat or .json",
        "Sensitivity",
    )
    uncertain = command(
        *(commands, "uncertain", _uncertain),
        "show or save the exact linear-fractional model (LFT) at rest for uncertain parameters",
        "fflin uncertain servicer_7dof --vary base.mass=0.2 --vary panel_left.stiffness=80:120 "
        "-o uncertain.mat",
    )
    add_robot(uncertain)
    add_options(uncertain, "--joint NAME=VALUE*: position of a joint [rad|m]; default: neutral")
    add_system(uncertain, axes=False)
    vary = """--vary NAME=RANGE*: range of a parameter named by `fflin sensitivity`, or of all
        parameters that match a pattern: a fraction of the nominal value, such as 0.2, or
        LEAST:LARGEST. With RANGE,tied all parameters of the pattern share one delta"""
    add_options(uncertain, vary, type=_range, required=True)
    add_output_file(
        uncertain, "save A, B1 .. D22 and the blocks to FILE: .npz, .mat or .json", "LFT"
    )


def _range(text: str) -> tuple[str, Any]:
    name, _, value = text.rpartition("=")
    tied = value.endswith(",tied")
    ends = value.removesuffix(",tied").split(":")
    if not name or len(ends) > 2:
        raise argparse.ArgumentTypeError(
            f"'{text}' is not of the form NAME=FRACTION or NAME=LEAST:LARGEST"
        )
    found = tuple(map(number, ends)) if ends[1:] else number(ends[0])
    return name, {"range": found, "tied": True} if tied else found


def _analyze(arguments: argparse.Namespace) -> int:
    from fflin.analysis.controllability import controllability
    from fflin.analysis.modes import modes
    from fflin.analysis.observability import observability

    check_figure(arguments.plot)
    _, lin = linear_model(arguments)
    found = modes(lin)
    moved, shown = controllability(lin), observability(lin)
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
    print("\n\n".join([headed("analyze", ", ".join(head)), *sections]))
    draw(arguments.plot, "plot_modes", found)
    return DONE


def _modes(arguments: argparse.Namespace) -> int:
    from fflin.analysis.effective_masses import effective_masses
    from fflin.analysis.modes import modes

    check_figure(arguments.plot)
    if arguments.html:
        from fflin.base.writing import check_place

        check_place(arguments.html, (".html",))
    robot, lin = linear_model(arguments)
    found = modes(lin)
    print(headed("modes", str(found)))
    if any(robot.stiffness.values()):
        print(f"\n{effective_masses(lin)}")
    if robot.orbit and not found.equilibrium:
        print("\nequilibria in orbit: --equilibrium, --relative-equilibrium")
    draw(arguments.plot, "plot_modes", found)
    if arguments.html:
        from fflin.view.visualize import visualize

        visualize(robot, found, html=arguments.html)
        print(f"wrote {arguments.html}: {arguments.html.stat().st_size / 1e6:.2f} MB")
    return DONE


def _momentum(lin: LinearModel) -> str:
    from fflin.analysis.momentum import momentum_reduction
    from fflin.base.tables import folded

    try:
        reduced = momentum_reduction(lin)
    except InputError as error:
        text = f"no reduction: {error}"
    else:
        count, left = len(reduced.momenta), len(reduced.A)
        wheels = ", the wheels" * (len(lin.A) > left + 2 * count)
        field = "orbit's field, the " * bool(lin.mean_motion)
        text = (
            f"no momentum is conserved: the {field}inputs, springs and dampers act on all momenta"
        )
        if count:
            text = (
                f"{count} momenta are conserved for all inputs; without these momenta{wheels} and "
                f"the coordinates that they drive, {left} states remain"
            )
        elif not lin.is_equilibrium():
            text = "no momentum can be removed: the operating point is not an equilibrium"
        text = "\n".join((text, *(f"note: {note}" for note in reduced.notes)))
    return folded(text.splitlines())


_FREE = "as large as it takes; --limits urdf cuts them"


def _validity(arguments: argparse.Namespace) -> int:
    from fflin.base.progress import Progress
    from fflin.batch.workers import OwnWorkers
    from fflin.campaign.validity import validity

    robot, lin = linear_model(arguments)
    check_figure(arguments.plot)
    lin = regulated_part(lin, arguments)
    gain = gain_of(lin, arguments)
    judged = lin.discretize(arguments.dt) if arguments.dt else lin
    bar, cut = Progress(), arguments.limits == "urdf"
    try:
        with OwnWorkers(arguments.jobs) if arguments.jobs > 1 else nullcontext() as executor:
            found = validity(
                robot,
                judged,
                gain,
                attitude=arguments.attitude,
                position=arguments.offset,
                joint=arguments.spread,
                samples=arguments.samples,
                seed=arguments.seed,
                frames=arguments.frames,
                limits="urdf" if cut else None,
                executor=executor,
                progress=bar.update,
            )
    finally:
        bar.close()
    print(headed("validity", str(found)))
    if cut or any(name in lin.limits for name in lin.input_names):
        print("inputs were " + ("cut to the limits of the robot" if cut else _FREE))
    draw(arguments.plot, "plot_validity", found)
    return DONE


def _sensitivity(arguments: argparse.Namespace) -> int:
    from fflin.uncertainty.sensitivity import sensitivity

    _, lin = linear_model(arguments)
    found = sensitivity(lin if arguments.dt is None else lin.discretize(arguments.dt))
    say("sensitivity", found, arguments, found.table(arguments.top, arguments.only))
    return DONE


def _uncertain(arguments: argparse.Namespace) -> int:
    from fflin.uncertainty.uncertain import uncertain

    robot, ranges = load_robot(arguments), once("--vary", arguments.vary)
    lft = uncertain(robot, ranges).lft(placed(robot, "--joint", arguments.joint))
    say("uncertain", lft, arguments)
    return DONE
