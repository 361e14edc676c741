"""Commands `validity` and `funnel`: regions in which a model or a regulator is valid."""

from __future__ import annotations

import argparse
from contextlib import closing

from fflin.base.errors import InputError
from fflin.base.tables import folded
from fflin.commands import options, parser
from fflin.commands.loops import add_schedule, along
from fflin.commands.points import limits_of_options, load_robot, once
from fflin.commands.regulator import add_allocation, add_trajectory, add_weights, designed
from fflin.commands.results import Report, figure_of

_ERRORS = "attitude [deg], position [m], joints, omega_b, v_b or joint rates"
_RUNS = ["knots", "samples", "seed", "confidence", "threads"]


def add_commands(commands: parser.Commands) -> None:
    """Add the commands validity and funnel."""
    _add_validity(commands)
    _add_funnel(commands)


def _add_validity(commands: parser.Commands) -> None:
    validity = parser.command(
        commands,
        _validity,
        "joint inputs weights q r bryson sample reduce attitude offset spread samples seed "
        "jobs limits frame plot",
    )
    options.add_point(validity)
    add_weights(validity)
    add_allocation(validity.group(parser.CONTROLLER))
    runs = validity.group("runs")
    runs.add("--attitude", "largest rotation of the base [deg]", float, "X", default=90.0)
    runs.add("--offset", "largest displacement of the base [m]", float, "X", default=0.5)
    runs.add("--spread", "largest displacement of a joint [rad|m]", float, "X", default=1.0)
    runs.add("--samples", "number of random runs", int, default=100)
    runs.add("--seed", "random seed of the runs", parser.whole, "S", default=0)
    runs.add("--jobs", "number of processes; at most one per core", int, default=1)
    options.add_saturation(runs)
    options.add_figure(validity, "the results")


def _add_funnel(commands: parser.Commands) -> None:
    funnel = parser.command(
        commands,
        _funnel,
        "trajectory schedule goal within weights q r knots samples seed threads dt limits "
        "limit frame inputs output-file plot",
    )
    options.add_robot(funnel)
    options.add_system(funnel)
    options.add_frame(funnel.group(parser.TRAJECTORY))
    add_trajectory(funnel)
    add_weights(funnel, integrated=True)
    runs, shown = funnel.group("runs"), funnel.group(parser.OUTPUT)
    add_schedule(funnel.group(parser.CONTROLLER))
    goal = f"largest error allowed at the end of a run: {_ERRORS}"
    runs.add("--goal", goal, parser.assignment, repeatable=True)
    within = "largest error allowed at any time of a run, named as in --goal"
    runs.add("--within", within, parser.assignment, repeatable=True)
    options.add_limits(runs)
    runs.add("--knots", "number of knots to test", int, default=10)
    runs.add("--samples", "number of runs from each knot", int, default=100)
    runs.add("--seed", "random seed of the runs", parser.whole, "S", default=0)
    runs.add("--confidence", "confidence level of all intervals", float, "P", default=0.95)
    runs.add("--threads", "number of threads; by default one per core", int)
    options.add_step(runs)
    options.add_figure(funnel, "the funnel")
    options.add_output_file(shown, "the funnel", parser.RECORD, "Funnel")
    funnel.set_defaults(offset=(), allocate=False)  # options of `along` that funnel does not have


_FREE = "not saturated; use --limits urdf to saturate them"


def _validity(arguments: argparse.Namespace) -> Report:
    """Find how far the robot can be displaced before the linear model or its regulator fails.

    example: fflin validity ets_vii --attitude 120 --samples 200 --jobs 2
    """
    from fflin.base.process import Progress
    from fflin.campaign.validity import validity

    robot, design, lin, gain = designed(arguments)
    judged = lin.discretize(arguments.sample) if arguments.sample else lin
    cut = arguments.limits == "urdf"
    with closing(Progress()) as bar:
        found = validity(
            design,
            judged,
            gain,
            attitude=arguments.attitude,
            position=arguments.offset,
            joint=arguments.spread,
            samples=arguments.samples,
            seed=arguments.seed,
            limits="urdf" if cut else None,
            workers=arguments.jobs if arguments.jobs > 1 else None,
            progress=bar,
        )
    text = str(found)
    if cut or any(name in lin.limits for name in lin.input_names):
        said = "saturated at the limits of the robot" if cut else _FREE
        text += f"\n{folded([f'inputs were {said}'])}"
    if design is not robot:
        text += "\nan ideal torque and force on the base replace the thrusters (--no-allocate)"
    return Report(robot.name, found, text, {arguments.plot: figure_of("plot_validity", found)})


def _funnel(arguments: argparse.Namespace) -> Report:
    """Find the initial errors from which the regulator along a trajectory reaches a goal.

    example: fflin funnel arm.toml --schedule gains.npz --goal attitude=1
    """
    from fflin.base.process import Progress
    from fflin.campaign.funnel import funnel

    if arguments.trajectory is None and arguments.schedule is None:
        raise InputError("neither --trajectory nor --schedule is given; give one of them")
    robot = load_robot(arguments)
    options.settle_step(arguments)
    policy, _ = along(robot, arguments)
    settings = {"limits": limits_of_options(arguments), "dt": arguments.dt}
    kept = {key: getattr(arguments, key) for key in _RUNS} | settings
    kept["within"], goal = once("--within", arguments.within), once("--goal", arguments.goal)
    with closing(Progress()) as bar:
        found = funnel(robot, policy, goal, progress=bar, **kept)
    files = {arguments.plot: figure_of("plot_funnel", found), arguments.output_file: found.save}
    return Report(robot.name, found, str(found), files)
