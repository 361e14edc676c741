"""The command `tvlqr`, and the trajectory options of other commands."""

from __future__ import annotations

import argparse
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from fflin.base.errors import InputError
from fflin.commands import DONE, FELL_SHORT, options, parser
from fflin.commands.points import load_robot, once
from fflin.commands.regulator import add_weights
from fflin.commands.results import Report

if TYPE_CHECKING:
    from fflin.control.gain_schedule import GainSchedule
    from fflin.linear.check import Check
    from fflin.linear.linear_trajectory import LinearTrajectory
    from fflin.robot.robot import Robot


def add_commands(commands: parser.Commands) -> None:
    """Add tvlqr."""
    tvlqr = parser.command(
        commands,
        "tvlqr",
        _tvlqr,
        "design the time-varying regulator along a trajectory",
        example="fflin tvlqr planar_detumble --trajectory plan.csv --hold previous --sample 0.1 "
        "-o gains.npz",
        common="trajectory hold strict weights q r bryson sample qf inputs frame output-file",
    )
    options.add_robot(tvlqr)
    options.add_system(tvlqr)
    options.add_frame(tvlqr.group(parser.TRAJECTORY))
    add_trajectory(tvlqr, required=True)
    add_weights(tvlqr)
    tvlqr.group(parser.CONTROLLER).add(
        "--qf",
        "weight on the final error. The default is the solution of the algebraic Riccati equation "
        "at the last configuration",
        parser.assignment,
        repeatable=True,
    )
    options.add_output_file(tvlqr.group(parser.OUTPUT), "the gains", parser.RECORD)


def add_trajectory(command: parser.Command, *, required: bool = False) -> None:
    """Add --trajectory, --hold and --strict; the file then sets the default of --frame."""
    group = command.group(parser.TRAJECTORY)
    group.add(
        "--trajectory",
        "use the trajectory in FILE: .npz, .mat, .json or .csv; see fflin.Trajectory.load. --frame "
        "defines the axes of the data. The default of --frame is the frame named in FILE, or local",
        Path,
        required=required,
    )
    group.add(
        "--hold",
        "inputs between the knots of FILE: linearly interpolated (linear), or constant from each "
        "knot to the next (previous). The default is the setting in FILE, or linear",
        choices=("linear", "previous"),
    )
    group.switch(
        "--strict", "report an error if the trajectory in FILE violates the dynamics of the robot"
    )


def models_along(arguments: argparse.Namespace, robot: Robot | None = None) -> LinearTrajectory:
    """Return the linear models along the given trajectory."""
    from fflin.linear.linear_trajectory import linearize_trajectory
    from fflin.linear.trajectory import Trajectory

    for name in ("joint", "velocity", "effort", "equilibrium", "rpy", "position"):
        given = getattr(arguments, name, None)
        if given is True or any(given or ()):
            raise InputError(
                f"--{name} defines an operating point, but --trajectory defines a motion; give "
                "only one of them"
            )
    robot, settings = (
        robot or load_robot(arguments),
        {"hold": arguments.hold, "frame": arguments.frame},
    )
    motion = Trajectory.load(arguments.trajectory, robot, **settings)
    return linearize_trajectory(robot, motion, strict=arguments.strict)


def linearize_along(arguments: argparse.Namespace) -> Report:
    """Show or save the models along a trajectory."""
    along = models_along(arguments)
    if arguments.dt is not None:
        along = along.discretize(arguments.dt)
    return Report(along.robot.name, along, str(along), {arguments.output_file: along.save})


def check_along(arguments: argparse.Namespace) -> Report:
    """Check the models along a trajectory."""
    from fflin.linear.check import held_to

    along = models_along(arguments)
    found = held_to(arguments.tolerance, along.check())
    return checked(along.robot, found, f"{found}\n\n{along}")


def checked(robot: Robot, found: Check, text: str, files: Any = MappingProxyType({})) -> Report:
    """Return the report of a check."""
    result = {"ok": found.ok, "max_error": found.max_error, "rows": found.rows}
    return Report(robot.name, result, text, files, DONE if found.ok else FELL_SHORT)


def _tvlqr(arguments: argparse.Namespace) -> Report:
    if arguments.reduce:
        raise InputError(
            "--reduce does not apply along a trajectory, because the finite-horizon cost always "
            "exists; remove --reduce"
        )
    along = models_along(arguments)
    schedule = schedule_of(along, arguments, once("--qf", arguments.qf) or "steady")
    return Report(along.robot.name, schedule, str(schedule), {arguments.output_file: schedule.save})


def schedule_of(
    along: LinearTrajectory, arguments: argparse.Namespace, Qf: Any = "steady"
) -> GainSchedule:
    """Return the regulator of the weights along a trajectory."""
    from fflin.control.default_weights import pace_along
    from fflin.control.tvlqr import steady_end, tvlqr
    from fflin.control.weights import rule_weights

    settings: dict[str, Any] = {"sample": arguments.sample, "weights": arguments.weights}
    given = {key: once(f"--{key}", getattr(arguments, key)) for key in ("q", "r", "bryson")}
    if any(given.values()):
        pace = pace_along(float(along.t[-1] - along.t[0]), arguments.sample or 0.0)
        Q, R, _, rule = rule_weights(steady_end(along), arguments.weights, given, pace=pace)
        settings |= {"Q": Q, "R": R, "weights": None, "rule": rule}
    return tvlqr(along, Qf=Qf, **settings)
