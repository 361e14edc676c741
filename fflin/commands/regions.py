"""The commands `validity` and `funnel`: regions in which a model or a regulator holds."""

from __future__ import annotations

import argparse
from contextlib import nullcontext
from pathlib import Path

from fflin.base.errors import InputError
from fflin.commands.arguments import (
    CONTROLLER,
    OUTPUT,
    PAGE,
    RECORD,
    TRAJECTORY,
    Commands,
    add,
    add_figure,
    add_frame,
    add_limits,
    add_output_file,
    add_point,
    add_robot,
    add_step,
    add_system,
    assignment,
    command,
    count_of,
    group_of,
    input_file,
    number,
    settle_step,
    whole,
)
from fflin.commands.loops import along
from fflin.commands.points import limits_of_options, linear_model, load_robot, once
from fflin.commands.regulator import add_weights, gain_of, regulated_part
from fflin.commands.results import Report, figure_of
from fflin.commands.tracking import add_trajectory

_ERRORS = "attitude [deg], position [m], joints, turning (omega_b), moving (v_b) or rates"
_RUNS = ["knots", "samples", "seed", "confidence", "threads"]

# Options of other commands, which `along` refuses.
_NONE = "free mpc gain controller target_joint target_rpy target_position target_velocity effort"
_NONE += " equilibrium"
_NONE += " joint rpy position velocity"


def add_commands(commands: Commands) -> None:
    """Add validity and funnel."""
    _add_validity(commands)
    _add_funnel(commands)


def _add_validity(commands: Commands) -> None:
    validity = command(
        commands,
        "validity",
        _validity,
        "find how far the robot can be displaced before the linear model or its regulator fails",
        example="fflin validity ets_vii --attitude 120 --samples 200 --jobs 2",
        common="joint inputs weights q r bryson sample reduce attitude offset spread samples seed "
        "jobs limits frames plot",
    )
    add_point(validity)
    add_weights(validity)
    runs = group_of(validity, "runs")
    add(runs, "--attitude", "largest rotation of the base [deg]", number, "X", default=90.0)
    add(runs, "--offset", "largest displacement of the base [m]", number, "X", default=0.5)
    add(runs, "--spread", "largest displacement of a joint [rad|m]", number, "X", default=1.0)
    add(runs, "--samples", "number of random runs", count_of, default=100)
    add(runs, "--seed", "random seed of the runs", whole, "S", default=0)
    add(runs, "--jobs", "number of processes; at most one per core", count_of, default=1)
    add(
        runs,
        "--limits",
        "urdf: saturate the inputs at the limits of the robot; none (default): do not saturate the "
        "inputs",
        choices=("urdf", "none"),
        default="none",
    )
    add(
        runs,
        "--frames",
        "also test the regulator with base velocities and wrenches in these axes",
        choices=("hybrid", "local", "world"),
        nargs="+",
        default=(),
    )
    add_figure(validity, "the results")


def _add_funnel(commands: Commands) -> None:
    funnel = command(
        commands,
        "funnel",
        _funnel,
        "find the initial errors from which the regulator along a trajectory reaches a goal",
        example="fflin funnel arm.toml --trajectory plan.csv --schedule gains.npz "
        "--goal attitude=1",
        common="trajectory schedule goal within weights q r knots samples seed threads "
        "dt limits limit frame inputs output-file plot html",
    )
    add_robot(funnel)
    add_system(funnel)
    add_frame(group_of(funnel, TRAJECTORY))
    add_trajectory(funnel)
    add_weights(funnel, integrated=True)
    runs, shown = group_of(funnel, "runs"), group_of(funnel, OUTPUT)
    add(
        group_of(funnel, CONTROLLER),
        "--schedule",
        "use gains saved by `fflin tvlqr`. By default, gains are designed along the trajectory",
        input_file,
    )
    goal = f"largest error allowed at the end: {_ERRORS}"
    add(runs, "--goal", goal, assignment, repeatable=True)
    within = "largest error allowed at any time of a run. NAME is as in --goal"
    add(runs, "--within", within, assignment, repeatable=True)
    add_limits(runs)
    add(runs, "--knots", "number of knots to test", count_of, default=10)
    add(runs, "--samples", "number of runs from each knot", count_of, default=100)
    add(runs, "--seed", "random seed of the runs", whole, "S", default=0)
    add(runs, "--confidence", "confidence level of the intervals", number, "P", default=0.95)
    add(runs, "--threads", "number of threads; by default one per core", count_of)
    add_step(runs)
    add(shown, "--html", "write a page that plays the motion with the funnel as a tube", PAGE)
    add_figure(funnel, "the funnel")
    add_output_file(shown, "the funnel", RECORD, "Funnel")
    funnel.set_defaults(**dict.fromkeys((*_NONE.split(), "offset", "allocate"), ()))


_FREE = "not limited; --limits urdf saturates the inputs"


def _validity(arguments: argparse.Namespace) -> Report:
    from fflin.base.process import Progress
    from fflin.batch.workers import OwnWorkers
    from fflin.campaign.validity import validity

    robot, lin = linear_model(arguments)
    lin = regulated_part(lin, arguments)
    gain = gain_of(lin, arguments)
    judged = lin.discretize(arguments.sample) if arguments.sample else lin
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
    text = str(found)
    if cut or any(name in lin.limits for name in lin.input_names):
        text += "\ninputs were " + ("saturated at the limits of the robot" if cut else _FREE)
    return Report(robot.name, found, text, {arguments.plot: figure_of("plot_validity", found)})


def _funnel(arguments: argparse.Namespace) -> Report:
    from fflin.base.process import Progress
    from fflin.campaign.funnel import funnel

    if arguments.trajectory is None and arguments.schedule is None:
        raise InputError("neither --trajectory nor --schedule is given; give one of them, or both")
    robot = load_robot(arguments)
    settle_step(arguments)
    policy, _ = along(robot, arguments)
    options = {"limits": limits_of_options(arguments), "dt": arguments.dt}
    kept = {key: getattr(arguments, key) for key in _RUNS} | options
    kept["within"], bar = once("--within", arguments.within), Progress()
    try:
        goal = once("--goal", arguments.goal)
        found = funnel(robot, policy, goal, progress=bar.update, **kept)
    finally:
        bar.close()

    def page(path: Path) -> None:
        from fflin.simulation.simulate import simulate
        from fflin.view.visualize import visualize

        visualize(robot, simulate(robot, policy, **options), html=path, funnel=found)

    files = {
        arguments.plot: figure_of("plot_funnel", found),
        arguments.output_file: found.save,
        arguments.html: page,
    }
    return Report(robot.name, found, str(found), files)
