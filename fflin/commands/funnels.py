"""The command that measures the region around a trajectory from which its regulator holds."""

from __future__ import annotations

import argparse
from typing import Any

from fflin.base.errors import InputError
from fflin.commands import DONE
from fflin.commands.arguments import (
    Commands,
    add_output_file,
    add_robot,
    add_system,
    add_values,
    command,
    count_of,
    file_name,
    number,
    whole,
)
from fflin.commands.loops import along
from fflin.commands.points import load_robot, once
from fflin.commands.regulator import add_weights
from fflin.commands.tracking import add_trajectory
from fflin.commands.visual import add_figure, check_figure, draw

# What `along` refuses of others' options.
_NONE = (
    *("free", "gain", "target_joint", "target_velocity", "effort", "equilibrium", "joint"),
    *("rpy", "position", "velocity", "offset", "allocate"),
)


def add_commands(commands: Commands) -> None:
    """Add funnel."""
    funnel = command(
        commands,
        "funnel",
        _funnel,
        "measure from which errors along a trajectory its regulator still ends inside a goal",
        "fflin funnel arm.toml --trajectory plan.csv --schedule gains.npz --goal attitude=1",
    )
    add_robot(funnel)
    add_system(funnel)
    add_trajectory(funnel)
    add_weights(funnel)
    for name, what in (
        ("schedule", "the gains, as tvlqr saves them; without it they are designed"),
        ("html", "write a page that plays the motion with the funnel as a tube"),
    ):
        funnel.add_argument(f"--{name}", metavar="FILE", type=file_name, help=what)
    kinds = "attitude [deg], position [m], joints, turning, moving or rates"
    add_values(funnel, "--goal", f"largest error at the end: {kinds}")
    add_values(funnel, "--within", "largest error on the way, as of --goal")
    funnel.add_argument(
        "--limits",
        choices=("urdf", "none"),
        default="urdf",
        help="what cuts the inputs: the limits of the robot (default), or none",
    )
    for option, metavar, read, default, what in (
        ("--knots", "N", count_of, 10, "knots that are done; 10 by default"),
        ("--samples", "N", count_of, 100, "runs from each; 100 by default"),
        ("--seed", "N", whole, 0, "seed of the runs; 0 by default"),
        ("--confidence", "P", number, 0.95, "of the intervals; 0.95 by default"),
        ("--step", "H", number, None, "step of the integration [s]; chosen by default"),
        ("--threads", "N", count_of, None, "threads; by default one for each core"),
    ):
        funnel.add_argument(option, metavar=metavar, type=read, default=default, help=what)
    add_figure(funnel, "draw it")
    add_output_file(funnel, "save it to FILE: .npz, .mat or .json")
    funnel.set_defaults(**dict.fromkeys(_NONE, ()))


def _funnel(arguments: argparse.Namespace) -> int:
    from fflin.base.progress import Progress
    from fflin.base.writing import check_place
    from fflin.campaign.funnel import funnel

    if arguments.trajectory is None and arguments.schedule is None:
        raise InputError("--trajectory and --schedule are missing; give either, or both")
    check_figure(arguments.plot)
    for path, endings in ((arguments.html, (".html",)), (arguments.output_file, ())):
        if path is not None:
            check_place(path, *([endings] if endings else []))
    robot = load_robot(arguments)
    policy, _ = along(robot, arguments)
    options: dict[str, Any] = {"limits": "urdf" if arguments.limits == "urdf" else None}
    options |= {"dt": arguments.step}
    goal, within = once("--goal", arguments.goal), once("--within", arguments.within)
    kept = {
        key: getattr(arguments, key)
        for key in ("knots", "samples", "seed", "confidence", "threads")
    }
    bar = Progress()
    try:
        found = funnel(robot, policy, goal, within=within, progress=bar.update, **kept, **options)
    finally:
        bar.close()
    print(found)
    draw(arguments.plot, "plot_funnel", found)
    if arguments.output_file:
        found.save(arguments.output_file)
        print(f"wrote {arguments.output_file}")
    if arguments.html:
        from fflin.simulation.simulate import simulate
        from fflin.view.visualize import visualize

        visualize(robot, simulate(robot, policy, **options), html=arguments.html, funnel=found)
        print(f"wrote {arguments.html}: {arguments.html.stat().st_size / 1e6:.2f} MB")
    return DONE
