"""The command that measures the region around a trajectory from which its regulator holds."""

from __future__ import annotations

import argparse
from typing import Any

from fflin.base.errors import InputError
from fflin.commands import DONE
from fflin.commands import arguments as of
from fflin.commands.loops import along
from fflin.commands.points import load_robot, once
from fflin.commands.regulator import add_weights
from fflin.commands.tracking import add_trajectory
from fflin.commands.visual import add_figure, check_figure, draw

_KINDS = "attitude [deg], position [m], joints, turning, moving or rates"
_RUNS = ["knots", "samples", "seed", "confidence", "threads"]

# What `along` refuses of others' options.
_NONE = "free gain controller target_joint target_velocity effort equilibrium"
_NONE += " joint rpy position velocity"


def add_commands(commands: of.Commands) -> None:
    """Add funnel."""
    funnel = of.command(
        *(commands, "funnel", _funnel),
        "measure from which errors along a trajectory its regulator still ends inside a goal",
        "fflin funnel arm.toml --trajectory plan.csv --schedule gains.npz --goal attitude=1",
    )
    of.add_robot(funnel)
    of.add_system(funnel)
    add_trajectory(funnel)
    add_weights(funnel)
    of.add_options(
        funnel,
        f"""
        --schedule FILE: the gains, as tvlqr saves them; without it they are designed
        --html >FILE: write a page that plays the motion with the funnel as a tube
        --goal NAME=VALUE*: largest error at the end: {_KINDS}
        --within NAME=VALUE*: largest error on the way, as of --goal
        --limits urdf|none = urdf: what cuts the inputs: the limits of the robot (default), or none
        --knots N = 10: knots that are done; 10 by default
        --samples N = 100: runs from each; 100 by default
        --seed S = 0: seed of the runs; 0 by default
        --confidence P = 0.95: of the intervals; 0.95 by default
        --threads N: threads; by default one for each core
        --step H: step of the integration [s]; chosen by default""",
    )
    add_figure(funnel, "draw it")
    of.add_output_file(funnel, "save it to FILE: .npz, .mat or .json", "Funnel")
    funnel.set_defaults(**dict.fromkeys((*_NONE.split(), "offset", "allocate"), ()))


def _funnel(arguments: argparse.Namespace) -> int:
    from fflin.base.progress import Progress
    from fflin.base.record import FORMATS
    from fflin.base.writing import check_place
    from fflin.campaign.funnel import funnel

    if arguments.trajectory is None and arguments.schedule is None:
        raise InputError("--trajectory and --schedule are missing; give either, or both")
    check_figure(arguments.plot)
    for path, endings in ((arguments.html, (".html",)), (arguments.output_file, FORMATS)):
        if path:
            check_place(path, endings)
    robot = load_robot(arguments)
    policy, _ = along(robot, arguments)
    limits = "urdf" if arguments.limits == "urdf" else None
    options: dict[str, Any] = {"limits": limits, "dt": arguments.step}
    kept = {key: getattr(arguments, key) for key in _RUNS} | options
    kept["within"], bar = once("--within", arguments.within), Progress()
    try:
        goal = once("--goal", arguments.goal)
        found = funnel(robot, policy, goal, progress=bar.update, **kept)
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
