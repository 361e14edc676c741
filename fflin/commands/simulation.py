"""The command that closes the loop around the nonlinear robot."""

from __future__ import annotations

import argparse
import warnings
from typing import TYPE_CHECKING, Any

from fflin.base.errors import FflinWarning, InputError
from fflin.base.names import chosen, input_keys
from fflin.commands import DONE, FELL_SHORT
from fflin.commands.arguments import (
    Commands,
    add_inputs_there,
    add_output_file,
    add_pose,
    add_robot,
    add_system,
    add_values,
    command,
    count_of,
    file_name,
    number,
)
from fflin.commands.loops import about_point, along, refuse_law, require_held, start_of
from fflin.commands.points import load_robot, once
from fflin.commands.regulator import add_weights
from fflin.commands.tracking import add_trajectory
from fflin.commands.visual import add_pictures, check_figure, check_pictures, show_motion

if TYPE_CHECKING:
    from fflin.control.policies import StateFeedback
    from fflin.robot.robot import Robot
    from fflin.simulation.motion import Motion


_GROUPS = (
    *("where it starts", "where it is to be", "what regulates it", "the run", "the robot"),
    "what is kept and shown of it",
)

# The options that name a file to write.
_OUTPUTS = ("output_file", "plot", "html", "png", "gif")


def add_commands(commands: Commands) -> None:
    """Add simulate."""
    simulate = command(
        commands,
        "simulate",
        _simulate,
        "let a regulator bring the nonlinear robot from where it is put to the target, or "
        "along a trajectory",
        "fflin simulate ets_vii --rpy 30 0 0 --duration 60 --html loop.html --plot loop.png",
    )
    add_robot(simulate)
    start, goal, law, run, system, shown = map(simulate.add_argument_group, _GROUPS)
    add_system(system)
    add_pose(start)
    add_values(
        start,
        "--offset",
        "how far from the trajectory's start it starts, in the base's axes there: a state, group "
        "or pattern such as r_b.x, q_m, omega_b.z, or roll, pitch, yaw [deg]",
    )
    add_values(
        goal,
        "--target-joint",
        "where a joint is to go [rad|m]; the others go to neutral, the base to the world's origin",
    )
    add_values(
        goal,
        "--target-velocity",
        "a velocity of the target, such as the speed of a wheel that is to be held; it starts with "
        "it where --velocity does not say otherwise",
    )
    add_inputs_there(goal)
    add_trajectory(goal)
    add_weights(law)
    law.add_argument(
        "--schedule",
        metavar="FILE",
        type=file_name,
        help="follow the trajectory with these gains, as tvlqr saves them; without it they are "
        "designed",
    )
    law.add_argument(
        "--gain",
        metavar="FILE",
        type=file_name,
        help="regulate with this gain, as lqr saves it, about the point it was designed for",
    )
    law.add_argument(
        "--allocate",
        action=argparse.BooleanOptionalAction,
        help="whether to design with torque and force on the base, and let the thrusters, none of "
        "which pulls, give what comes nearest; by default where they push every way; else a "
        "thrust below zero is cut",
    )
    law.add_argument(
        "--free", action="store_true", help="let it move without a regulator or any input"
    )
    law.add_argument(
        "--limits",
        choices=("urdf", "none"),
        default="urdf",
        help="what cuts the inputs: efforts of the URDF, max and min of the inputs and speeds of "
        "wheels (urdf, default), or only what --limit says (none)",
    )
    add_values(
        law,
        "--limit",
        "largest magnitude of an input, a group of them such as tau_m, or a pattern; goes first",
    )
    law.add_argument(
        "--delay",
        metavar="T",
        type=number,
        default=0.0,
        help="time from a sample to its effect [s]",
    )
    run.add_argument(
        "--duration",
        metavar="T",
        type=number,
        help="time [s]; by default that of the trajectory, or from 60 to 600, what the linear loop "
        "takes to settle",
    )
    run.add_argument(
        "--step", metavar="H", type=number, help="step of the integration [s]; chosen by default"
    )
    run.add_argument(
        "--every",
        metavar="N",
        type=count_of,
        help="steps from one recorded row to the next; chosen where there are many",
    )
    run.add_argument("--method", default="cf4", help="cf4 (default), rkmk4 or semi_implicit_euler")
    shown.add_argument(
        "--plot",
        metavar="FILE",
        type=file_name,
        help="draw linear beside nonlinear into FILE: .png, .pdf or .svg",
    )
    add_values(
        shown,
        "--show",
        "what --plot draws: a state or input, a group or a pattern, such as q_m, '*.hinge_*'",
        metavar="NAME",
        read=str,
    )
    add_output_file(shown, "save the motion to FILE: .npz, .mat, .json or .csv")
    add_pictures(shown)


def _simulate(arguments: argparse.Namespace) -> int:
    from fflin.base.writing import check_distinct, check_place
    from fflin.simulation.motion import FORMATS
    from fflin.simulation.report import motion_report

    robot = load_robot(arguments)
    check_distinct(*(getattr(arguments, name) for name in _OUTPUTS))
    if arguments.output_file:
        check_place(arguments.output_file, FORMATS)
    if arguments.plot:
        check_figure(arguments.plot)
    check_pictures(robot, arguments)
    if arguments.show:
        from fflin.linear.linearization import linearize

        lin = linearize(robot)
        chosen("state or input", arguments.show, (*lin.state_names, *input_keys(lin)))
    try:
        motion = simulated(robot, arguments)
    except InputError as error:
        hint = " (--dt)" if "time between samples" in str(error) else ""
        raise InputError(f"{error}{hint}") from None
    interrupted = motion.stopped.startswith("interrupted")
    left = _leave_earlier(arguments) if interrupted else []

    # Said when the files are there, which they are then even where nobody reads it to its end.
    lines = [motion_report(motion)]
    try:
        if arguments.output_file:
            motion.save(arguments.output_file)
            lines.append(f"wrote {arguments.output_file}")
        if arguments.plot:
            motion.plot(arguments.plot, show=arguments.show or None)
            lines.append(f"wrote {arguments.plot}")
        lines += show_motion(robot, motion, arguments)
    finally:
        print("\n".join(lines))
    if interrupted:
        raise KeyboardInterrupt("; ".join([motion.stopped, *left]))
    return FELL_SHORT if motion.stopped else DONE


def _leave_earlier(arguments: argparse.Namespace) -> list[str]:
    """Write no part of a motion where there is an earlier file; return a line for each."""
    files = {name: path for name in _OUTPUTS if (path := getattr(arguments, name))}
    earlier = {name: path for name, path in files.items() if path.exists()}
    vars(arguments).update(dict.fromkeys(earlier))
    return [f"{path} is left as it was" for path in earlier.values()]


def simulated(robot: Robot, arguments: argparse.Namespace) -> Motion:
    """Return the motion that the arguments ask for."""
    from fflin.simulation.simulate import simulate
    from fflin.simulation.times import SHORTEST, time_to_settle

    given = once("--limit", arguments.limit)
    options: dict[str, Any] = {
        "dt": arguments.step,
        "every": arguments.every,
        "method": arguments.method,
        "limits": [arguments.limits, given] if arguments.limits == "urdf" else given or None,
        "delay": arguments.delay,
        "duration": arguments.duration,
    }
    if arguments.trajectory or arguments.schedule:
        policy, start = along(robot, arguments)
        return simulate(robot, policy, **options, **start)
    if arguments.offset or arguments.hold:
        raise InputError("--offset and --hold are of a --trajectory; give one, or leave them out")
    q, v = start_of(robot, arguments)
    options |= {"q0": q, "v0": v}
    if arguments.free:
        refuse_law(arguments)
        options["duration"] = SHORTEST if arguments.duration is None else arguments.duration
        return simulate(robot, frame=arguments.frame, **options)
    policy, feedback, lin = about_point(robot, arguments)
    require_held(robot, feedback, q)
    if arguments.duration is None:
        options["duration"] = time_to_settle(robot, feedback, q, v)
    if policy is not feedback:
        return simulate(robot, policy, **options)
    # At every row, where a sampled model has the samples alone.
    motion = simulate(robot, policy, **options, linear=lin)
    _warn_of_cut_thrust(robot, motion, feedback)
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
    # What rounding asks of a thruster that has nothing to do is no thrust.
    pulled = (asked < -1e-9 * abs(asked).max(initial=0.0)).any(axis=1).mean()
    if pulled > 0.0:
        warnings.warn(
            f"thrusters cannot pull: in {100.0 * pulled:.1f} % of the run a thrust below zero was "
            "asked for and cut; --allocate gives the wrench with thrusts that push",
            FflinWarning,
            stacklevel=2,
        )
