"""Commands `plan`, `simulate` and `montecarlo`: plan a trajectory, simulate one or many motions."""

from __future__ import annotations

import argparse
from functools import cache, partial
from typing import TYPE_CHECKING, Any

from fflin.base.errors import FileError, InputError
from fflin.base.names import chosen, input_keys
from fflin.base.tables import folded
from fflin.commands import DONE, FELL_SHORT, options, parser
from fflin.commands.loops import add_loop, loop_of, target_of
from fflin.commands.points import configuration_of, limits_of_options, load_robot, once, velocity_of
from fflin.commands.results import Report, figure_of
from fflin.commands.sweeps import going_on
from fflin.commands.visual import add_pictures, check_pictures, pictures

if TYPE_CHECKING:
    from fflin.robot.robot import Robot
    from fflin.simulation.motion import Motion

_ROWS = 240  # rows of errors and inputs in a figure
_PASSED = ("runs", "seed", "until", "width", "confidence", "workers", "threads")


def add_commands(commands: parser.Commands) -> None:
    """Add the commands plan, simulate and montecarlo."""
    _add_plan(commands)
    _add_simulate(commands)
    _add_montecarlo(commands)


def _add_plan(commands: parser.Commands) -> None:
    plan = parser.command(
        commands,
        _plan,
        "joint rpy position velocity target-joint target-rpy target-position target-velocity "
        "duration knots hold free-end r limits limit inputs output-file",
    )
    options.add_robot(plan)
    options.add_system(plan)
    options.add_pose(plan.group("start"))
    options.add_target(plan.group("target"))
    group = plan.group(parser.TRAJECTORY)
    group.add("--duration", "duration of the motion [s]", float, "T", required=True)
    group.add("--knots", "number of equally spaced knots", int, default=101)
    hold = "inputs between knots: constant (previous, default) or linearly interpolated (linear)"
    group.add("--hold", hold, choices=("previous", "linear"), default="previous")
    free = "state whose final value is free. NAME is a state, group or pattern"
    group.add("--free-end", free, metavar="NAME", repeatable=True)
    weight = "weight on an input, a group or a pattern. The default is 1/limit^2"
    group.add("--r", weight, parser.assignment, "NAME=W", repeatable=True)
    options.add_limits(group)
    options.add_output_file(
        plan.group(parser.OUTPUT), "the trajectory", parser.TABLE, "Trajectory", "Motion"
    )
    # The functions for start and target read these options, which only other commands have, so they
    # need a value here.
    plan.set_defaults(relative_equilibrium=None)


def _add_simulate(commands: parser.Commands) -> None:
    simulate = parser.command(
        commands,
        _simulate,
        "joint rpy target-joint target-rpy trajectory weights q r sample mpc gain schedule "
        "free limits duration inputs output-file plot html",
    )
    add_loop(simulate)
    simulate.group(parser.SIMULATION).add(
        "--every",
        "save the state at every N-th integration step; by default N is 1, or larger for long runs",
        int,
    )
    simulate.group(parser.SIMULATION).add(
        "--engine",
        "simulate in compiled code or in Python. By default, long runs use compiled code if "
        "numba is installed, and all other runs use Python",
        choices=("compiled", "python"),
    )
    options.add_figure(simulate, "the nonlinear and the linear motion")
    shown = simulate.group(parser.OUTPUT)
    shown.add(
        "--show",
        "show only these curves in --plot. NAME is a state, input, group or pattern, such as q_m "
        "or '*.hinge_*'",
        metavar="NAME",
        repeatable=True,
    )
    options.add_output_file(shown, "the motion", parser.TABLE, "Motion")
    add_pictures(simulate)


def _simulate(arguments: argparse.Namespace) -> Report:
    """Simulate the robot with a regulator to a target or along a trajectory.

    example: fflin simulate ets_vii --rpy 30 0 0 --duration 60 --html loop.html --plot loop.png
    """
    from fflin.simulation.report import motion_record, motion_report

    robot = load_robot(arguments)
    check_pictures(robot, arguments)
    if arguments.show:
        from fflin.linear.linearization import linearize

        lin = linearize(robot)
        chosen("state or input", arguments.show, (*lin.state_names, *input_keys(lin)))
    try:
        motion = simulated(robot, arguments)
    except InputError as error:
        hint = " (--sample)" if "needs sampled commands" in str(error) else ""
        raise InputError(f"{error}{hint}") from None
    return Report(
        robot.name,
        motion_record(motion),
        motion_report(motion),
        {
            arguments.output_file: motion.save,
            arguments.plot: partial(motion.plot, show=arguments.show or None),
            **pictures(robot, lambda: motion, arguments),
        },
        FELL_SHORT if motion.stopped else DONE,
        motion.stopped if motion.stopped.startswith("interrupted") else "",
    )


def simulated(robot: Robot, arguments: argparse.Namespace) -> Motion:
    """Return the motion that the arguments define."""
    from fflin.simulation.simulate import simulate

    loop = loop_of(robot, arguments)
    # A continuous model predicts all rows of the motion, a sampled model only the rows at its
    # samples.
    shown = {"every": arguments.every, "engine": arguments.engine}
    return simulate(robot, loop.policy, **shown, **loop.options, **loop.prediction)


def _plan(arguments: argparse.Namespace) -> Report:
    """Plan a low-effort trajectory between two states within limits.

    example: fflin plan planar_detumble --target-joint joint_1=0.3 --duration 20 -o plan.npz
    """
    from fflin.control.plan import plan
    from fflin.dynamics.points import combined

    robot = load_robot(arguments)
    state = combined(robot.point, robot.start)
    motion = plan(
        robot,
        target_of(robot, arguments),
        arguments.duration,
        q0=configuration_of(robot, arguments, state),
        v0=velocity_of(robot, arguments, state, "velocity"),
        knots=arguments.knots,
        hold=arguments.hold,
        limits=limits_of_options(arguments),
        R=once("--r", arguments.r) or None,
        free=arguments.free_end,
    )
    return Report(robot.name, motion, str(motion), {arguments.output_file: motion.save})


def _add_montecarlo(commands: parser.Commands) -> None:
    montecarlo = parser.command(
        commands,
        _montecarlo,
        "runs seed until width confidence workers goal worst joint rpy trajectory gain "
        "schedule duration inputs output-file plot",
    )
    add_loop(montecarlo)
    montecarlo.add_argument(
        "dispersions",
        metavar="DISPERSIONS",
        type=parser.input_file,
        help='TOML file with a line [dispersions], and a line such as "base.mass" = 0.05 '
        "(standard deviation) for each random parameter; see fflin.load_dispersions",
    )
    runs = montecarlo.group("runs")
    runs.add("--runs", "number of runs", int, required=True)
    runs.add("--seed", "random seed", parser.whole, "S", default=0)
    runs.add(
        "--until",
        "stop the runs when the confidence interval of the success rate is at most --width wide. "
        "CONDITION defines success, such as 'attitude < 1 deg'",
        metavar="CONDITION",
    )
    width = "width of the confidence interval at which --until stops the runs"
    runs.add("--width", width, float, "P", default=0.02)
    runs.add("--confidence", "confidence level of all intervals", float, "P", default=0.95)
    runs.add("--workers", "distribute the runs over N processes", int)
    threads = "distribute the runs over N threads; by default one per core"
    runs.add("--threads", threads, int)
    shown = montecarlo.group(parser.OUTPUT)
    shown.add(
        "--goal",
        "report the fraction of runs that meet CONDITION, such as 'attitude < 1 deg and settle < "
        "60 s', and draw the bounds of CONDITION in --plot",
        metavar="CONDITION",
        repeatable=True,
    )
    shown.add("--worst", "list the K worst runs", parser.whole, "K", default=3)
    options.add_figure(montecarlo, "quantile bands over time, histograms and the worst runs")
    what = (
        "the runs (.csv and .mat are tables for other programs; with .h5, the same command resumes "
        "after an interruption)"
    )
    force = "replace the file of -o even if it contains the runs of another command"
    options.add_output_file(shown, what, parser.RUNS)
    shown.switch("--force", force)
    add_pictures(montecarlo, "that plays the worst run")


def _montecarlo(arguments: argparse.Namespace) -> Report:
    """Simulate a loop with random parameters; show quantiles, success rates and the worst runs.

    example: fflin montecarlo ets_vii uncertain.toml --runs 1000 --plot runs.png
    """
    from fflin.campaign.monte_carlo import monte_carlo
    from fflin.campaign.report import campaign_record, worst_runs
    from fflin.campaign.spreads import load_dispersions
    from fflin.control.policies import bound

    path = arguments.output_file
    is_table = path is not None and path.suffix in (".csv", ".mat")
    if is_table and path.exists() and not arguments.force:
        raise FileError(f"{path} already exists; give another file name, or add --force")
    dispersions = load_dispersions(arguments.dispersions)
    robot = load_robot(arguments)
    check_pictures(robot, arguments)
    loop = loop_of(robot, arguments)
    settings: dict[str, Any] = {name: getattr(arguments, name) for name in _PASSED} | loop.options
    settings |= {"goals": arguments.goal, "histories": _ROWS if arguments.plot else 0}
    with going_on(path, "runs") as progress:
        settings |= {"progress": progress, "out": None if is_table else path}
        settings["overwrite"] = arguments.force
        campaign = monte_carlo(robot, loop.policy, dispersions, **settings)
    worst = cache(lambda: campaign.replay(campaign.worst(1)[0]))
    files = {
        path: campaign.save if is_table else None,
        arguments.plot: figure_of("plot_campaign", campaign),
        **pictures(robot, worst, arguments),
    }
    notes = getattr(bound(loop.policy, robot), "notes", ()) if loop.policy else ()
    shown = [str(campaign), *(folded([note]) for note in notes)]
    text = "\n".join([*shown, *worst_runs(campaign, arguments.worst)])
    result = {**campaign_record(campaign, arguments.worst), "notes": notes}
    return Report(robot.name, result, text, files)
