"""The command `plan`: a trajectory between two states within limits."""

from __future__ import annotations

import argparse

from fflin.commands.arguments import (
    OUTPUT,
    TABLE,
    TRAJECTORY,
    Commands,
    add,
    add_limits,
    add_output_file,
    add_pose,
    add_robot,
    add_system,
    add_target,
    assignment,
    command,
    count_of,
    group_of,
    number,
)
from fflin.commands.loops import target_of
from fflin.commands.points import configuration_of, limits_of_options, load_robot, once, velocity_of
from fflin.commands.results import Report


def add_commands(commands: Commands) -> None:
    """Add plan."""
    plan = command(
        commands,
        "plan",
        _plan,
        "plan a low-effort trajectory between two states within limits",
        example="fflin plan planar_detumble --target-joint joint_1=0.3 --duration 20 -o plan.npz",
        common="joint rpy position velocity target-joint target-rpy target-position "
        "target-velocity duration knots hold free-end r limits limit inputs output-file",
    )
    add_robot(plan)
    add_system(plan)
    add_pose(group_of(plan, "start"))
    add_target(group_of(plan, "target"))
    group = group_of(plan, TRAJECTORY)
    add(group, "--duration", "duration of the motion [s]", number, "T", required=True)
    add(group, "--knots", "number of equally spaced knots", count_of, default=101)
    hold = "inputs between knots: constant (previous, default) or linearly interpolated (linear)"
    add(group, "--hold", hold, choices=("previous", "linear"), default="previous")
    free = "state whose final value is free. NAME is a state, group or pattern"
    add(group, "--free-end", free, metavar="NAME", repeatable=True)
    weight = "weight on an input, a group or a pattern. The default is 1/limit^2"
    add(group, "--r", weight, assignment, "NAME=W", repeatable=True)
    add_limits(group)
    add_output_file(group_of(plan, OUTPUT), "the trajectory", TABLE, "Trajectory", "Motion")
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
