"""The command `simulate`: the closed loop of a controller and the nonlinear robot."""

from __future__ import annotations

import argparse
import warnings
from functools import partial
from typing import TYPE_CHECKING, Any

from fflin.base.errors import FflinWarning, InputError
from fflin.base.names import chosen, input_keys
from fflin.commands import DONE, FELL_SHORT, options, parser
from fflin.commands.loops import add_loop, loop_of
from fflin.commands.points import load_robot
from fflin.commands.results import Report
from fflin.commands.visual import add_pictures, check_pictures, pictures

if TYPE_CHECKING:
    from fflin.control.policies import StateFeedback
    from fflin.robot.robot import Robot
    from fflin.simulation.motion import Motion


def add_commands(commands: parser.Commands) -> None:
    """Add simulate."""
    simulate = parser.command(
        commands,
        "simulate",
        _simulate,
        "simulate the robot with a regulator to a target or along a trajectory",
        example="fflin simulate ets_vii --rpy 30 0 0 --duration 60 --html loop.html "
        "--plot loop.png",
        common="joint rpy target-joint target-rpy trajectory weights q r sample mpc gain schedule "
        "free limits duration inputs output-file plot html",
    )
    add_loop(simulate)
    simulate.group(parser.SIMULATION).add(
        "--every",
        "number of steps between saved rows; chosen automatically for long runs",
        int,
    )
    options.add_figure(simulate, "the nonlinear and the linear motion")
    shown = simulate.group(parser.OUTPUT)
    shown.add(
        "--show",
        "show only these curves in --plot: a state, input, group or pattern, as q_m or '*.hinge_*'",
        metavar="NAME",
        repeatable=True,
    )
    options.add_output_file(shown, "the motion", parser.TABLE, "Motion")
    add_pictures(simulate)


def _simulate(arguments: argparse.Namespace) -> Report:
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
        hint = " (--sample)" if "time between samples" in str(error) else ""
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
    """Return the motion of the arguments."""
    from fflin.simulation.simulate import simulate

    loop = loop_of(robot, arguments)
    # The continuous model predicts every row, a sampled model only its samples.
    foresees: dict[str, Any] = {"linear": loop.lin} if loop.feedback else {}
    motion = simulate(robot, loop.policy, every=arguments.every, **loop.options, **foresees)
    if loop.feedback:
        _warn_of_cut_thrust(robot, motion, loop.feedback)
    return motion


def _warn_of_cut_thrust(robot: Robot, motion: Motion, policy: StateFeedback) -> None:
    from fflin.dynamics.actuation import Actuation
    from fflin.dynamics.state import StateMap

    groups = Actuation(StateMap(robot)).groups
    if "thrust" not in groups:
        return
    lin, names = policy.lin, motion.state_names
    deviation = motion.x[:, [names.index(name) for name in lin.state_names]] - lin.x0
    asked = (lin.u0 - deviation @ policy.K.T)[:, groups["thrust"]]
    # Rounding error in the command of an idle thruster does not count.
    pulled = (asked < -1e-9 * abs(asked).max(initial=0.0)).any(axis=1).mean()
    if pulled > 0.0:
        warnings.warn(
            f"thrusters cannot pull: in {100.0 * pulled:.1f} % of the run a thrust below zero was "
            "asked for and cut; --allocate gives the wrench with thrusts that push",
            FflinWarning,
            stacklevel=2,
        )
