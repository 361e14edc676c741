"""The command `plan`: a trajectory between two states within limits."""

from __future__ import annotations

import argparse

from fflin.commands import options, parser
from fflin.commands.loops import target_of
from fflin.commands.points import configuration_of, limits_of_options, load_robot, once, velocity_of
from fflin.commands.results import Report


def add_commands(commands: parser.Commands) -> None:
    """Add plan."""
    plan = parser.command(
        commands,
        "plan",
        _plan,
        "plan a low-effort trajectory between two states within limits",
        example="fflin plan planar_detumble --target-joint joint_1=0.3 --duration 20 -o plan.npz",
        common="joint rpy position velocity target-joint target-rpy target-position "
        "target-velocity duration knots hold free-end r limits limit inputs output-file",
    )
    options.add_robot(plan)
    options.add_system(plan)
    options.add_pose(plan.group("start"))
    options.add_target(plan.group("target"))
    group = plan.group(parser.TRAJECTORY)
    group.add("--duration", "duration of the motion [s]", float, "T", required=True)
    group.add("--knots", "number of equally spaced knots", int, default=101)
    hold = "inputs between knots: held (previous, default), or interpolated (linear)"
    group.add("--hold", hold, choices=("previous", "linear"), default="previous")
    free = "state whose final value is free: a name, group or pattern"
    group.add("--free-end", free, metavar="NAME", repeatable=True)
    weight = "weight on an input, a group or a pattern; by default 1/limit^2"
    group.add("--r", weight, parser.assignment, "NAME=W", repeatable=True)
    options.add_limits(group)
    options.add_output_file(
        plan.group(parser.OUTPUT), "the trajectory", parser.TABLE, "Trajectory", "Motion"
    )
    # Options of other commands, which the start and the target read.
    plan.set_defaults(relative_equilibrium=None)


def _plan(arguments: argparse.Namespace) -> Report:
    from fflin.control.plan import plan
    from fflin.robot.fields import combined

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
