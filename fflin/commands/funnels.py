"""The command `funnel`: the region of attraction along a trajectory."""

from __future__ import annotations

import argparse
from typing import Any

from fflin.base.errors import InputError
from fflin.base.tables import headed
from fflin.commands import DONE
from fflin.commands import arguments as of
from fflin.commands.loops import along
from fflin.commands.points import load_robot, once
from fflin.commands.regulator import add_weights
from fflin.commands.tracking import add_trajectory
from fflin.commands.visual import add_figure, check_figure, draw

_KINDS = "attitude [deg], position [m], joints, turning (omega_b), moving (v_b) or rates"
_RUNS = ["knots", "samples", "seed", "confidence", "threads"]

# Options of other commands, which `along` refuses.
_NONE = "free gain controller target_joint target_velocity effort equilibrium"
_NONE += " joint rpy position velocity"


def add_commands(commands: of.Commands) -> None:
    """Add funnel."""
    funnel = of.command(
        *(commands, "funnel", _funnel),
        "measure from which errors the regulator along a trajectory still reaches a goal",
        "fflin funnel arm.toml --trajectory plan.csv --schedule gains.npz --goal attitude=1",
    )
    of.add_robot(funnel)
    of.add_system(funnel)
    add_trajectory(funnel)
    add_weights(funnel)
    of.add_options(
        funnel,
        f"""
        --schedule FILE: use the gains that tvlqr saved; without this option, gains are designed
            along the trajectory
        --html >FILE: write a page that plays the motion with the funnel as a tube
        --goal NAME=VALUE*: largest error allowed at the end: {_KINDS}
        --within NAME=VALUE*: largest error allowed at any time of a run; names as in --goal
        --limits urdf|none = urdf: saturate the inputs at the limits of the robot (urdf, default),
            or never (none)
        --knots N = 10: number of knots to test; 10 by default
        --samples N = 100: number of runs from each knot; 100 by default
        --seed S = 0: random seed of the runs; 0 by default
        --confidence P = 0.95: confidence level of the intervals; 0.95 by default
        --threads N: number of threads; by default one for each core
        --step H: integration step [s]; chosen automatically by default""",
    )
    add_figure(funnel, "plot the funnel")
    of.add_output_file(funnel, "save the funnel to FILE: .npz, .mat or .json", "Funnel")
    funnel.set_defaults(**dict.fromkeys((*_NONE.split(), "offset", "allocate"), ()))


def _funnel(arguments: argparse.Namespace) -> int:
    from fflin.base.progress import Progress
    from fflin.base.record import FORMATS
    from fflin.base.writing import check_place
    from fflin.campaign.funnel import funnel

    if arguments.trajectory is None and arguments.schedule is None:
        raise InputError("neither --trajectory nor --schedule is given; give one of them, or both")
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
    print(headed("funnel", str(found)))
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
