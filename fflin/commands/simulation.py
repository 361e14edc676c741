"""The command `simulate`: the closed loop of a controller and the nonlinear robot."""

from __future__ import annotations

import argparse
import warnings
from typing import TYPE_CHECKING, Any

from fflin.base.errors import FflinWarning, InputError
from fflin.base.names import chosen, input_keys
from fflin.base.tables import headed
from fflin.commands import DONE, FELL_SHORT
from fflin.commands.arguments import (
    OUTPUT,
    SIMULATION,
    Commands,
    add,
    add_output_file,
    command,
    count_of,
    group_of,
)
from fflin.commands.loops import add_loop, loop_of
from fflin.commands.points import load_robot
from fflin.commands.visual import (
    add_figure,
    add_pictures,
    check_figure,
    check_pictures,
    show_motion,
)

if TYPE_CHECKING:
    from fflin.control.policies import StateFeedback
    from fflin.robot.robot import Robot
    from fflin.simulation.motion import Motion

# The options that name an output file.
_OUTPUTS = ("output_file", "plot", "html", "png", "gif")


def add_commands(commands: Commands) -> None:
    """Add simulate."""
    simulate = command(
        commands,
        "simulate",
        _simulate,
        "simulate the nonlinear robot with a regulator to a target or along a trajectory",
        example="fflin simulate ets_vii --rpy 30 0 0 --duration 60 --html loop.html "
        "--plot loop.png",
        common="joint rpy velocity target-joint target-rpy trajectory weights q r gain schedule "
        "free limits duration inputs output-file plot html",
    )
    add_loop(simulate)
    add(
        group_of(simulate, SIMULATION),
        "--every",
        "number of steps between saved rows; chosen automatically for long runs",
        count_of,
    )
    add_figure(simulate, "plot the nonlinear and the linear motion")
    shown = group_of(simulate, OUTPUT)
    add(
        shown,
        "--show",
        "show only these curves in --plot: a state, input, group or pattern, as q_m or '*.hinge_*'",
        metavar="NAME",
        repeatable=True,
    )
    add_output_file(shown, "save the motion to FILE: .npz, .mat, .json or .csv", "Motion")
    add_pictures(simulate)


def _simulate(arguments: argparse.Namespace) -> int:
    from fflin.base.writing import check_place
    from fflin.simulation.motion import FORMATS
    from fflin.simulation.report import motion_report

    robot = load_robot(arguments)
    if arguments.output_file:
        check_place(arguments.output_file, FORMATS)
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

    # Printed after the files are written, so that a closed pipe does not prevent them.
    lines = [headed("simulate", motion_report(motion))]
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
    """Do not replace earlier files by a part of a motion; return a line for each."""
    files = {name: path for name in _OUTPUTS if (path := getattr(arguments, name))}
    earlier = {name: path for name, path in files.items() if path.exists()}
    vars(arguments).update(dict.fromkeys(earlier))
    return [f"{path} is left as it was" for path in earlier.values()]


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
