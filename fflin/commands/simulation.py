"""The command that closes the loop around the nonlinear robot."""

from __future__ import annotations

import argparse
import warnings
from typing import TYPE_CHECKING, Any

from fflin.base.errors import FflinWarning, InputError, listed
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
from fflin.commands.points import configuration_of, inputs_at, load_robot, once, placed, velocity_of
from fflin.commands.regulator import add_weights, gain_of, regulated_part
from fflin.commands.visual import add_pictures, check_figure, check_pictures, show_motion

if TYPE_CHECKING:
    from fflin.base.validation import Array
    from fflin.control.policies import StateFeedback
    from fflin.linear.model import LinearModel
    from fflin.robot.robot import Robot
    from fflin.simulation.motion import Motion


# The options that name a file to write.
_OUTPUTS = ("output_file", "plot", "html", "png", "gif")


def add_commands(commands: Commands) -> None:
    """Add simulate."""
    simulate = command(
        commands,
        "simulate",
        _simulate,
        "let a regulator bring the nonlinear robot from where it is put to the target",
        "fflin simulate ets_vii --rpy 30 0 0 --duration 60 --html loop.html --plot loop.png",
    )
    add_robot(simulate)
    add_pose(simulate)
    add_system(simulate)
    add_values(
        simulate,
        "--target-joint",
        "where a joint is to go [rad|m]; the others go to neutral, the base to the world's origin",
    )
    add_values(
        simulate,
        "--target-velocity",
        "a velocity of the target, such as the speed of a wheel that is to be held; it starts with "
        "it where --velocity does not say otherwise",
    )
    add_inputs_there(simulate)
    add_weights(simulate)
    simulate.add_argument(
        "--allocate",
        action=argparse.BooleanOptionalAction,
        help="whether to design with torque and force on the base, and let the thrusters, none of "
        "which pulls, give what comes nearest; by default where they push every way; else a "
        "thrust below zero is cut",
    )
    simulate.add_argument(
        "--free", action="store_true", help="let it move without a regulator or any input"
    )
    simulate.add_argument(
        "--duration",
        metavar="T",
        type=number,
        help="time [s]; by default what the linear loop takes to settle, from 60 to 600",
    )
    simulate.add_argument(
        "--step", metavar="H", type=number, help="step of the integration [s]; chosen by default"
    )
    simulate.add_argument(
        "--every",
        metavar="N",
        type=count_of,
        help="steps from one recorded row to the next; chosen where there are many",
    )
    simulate.add_argument(
        "--method", default="cf4", help="cf4 (default), rkmk4 or semi_implicit_euler"
    )
    simulate.add_argument(
        "--limits",
        choices=("urdf", "none"),
        default="urdf",
        help="what cuts the inputs: efforts of the URDF, max and min of the inputs and speeds of "
        "wheels (urdf, default), or only what --limit says (none)",
    )
    add_values(
        simulate,
        "--limit",
        "largest magnitude of an input, a group of them such as tau_m, or a pattern; goes first",
    )
    simulate.add_argument(
        "--delay",
        metavar="T",
        type=number,
        default=0.0,
        help="time from a sample to its effect [s]",
    )
    simulate.add_argument(
        "--plot",
        metavar="FILE",
        type=file_name,
        help="draw linear beside nonlinear into FILE: .png, .pdf or .svg",
    )
    add_values(
        simulate,
        "--show",
        "what --plot draws: a state or input, a group or a pattern, such as q_m, '*.hinge_*'",
        metavar="NAME",
        read=str,
    )
    add_output_file(simulate, "save the motion to FILE: .npz, .mat, .json or .csv")
    add_pictures(simulate)


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
    from fflin.control.bounded import thrusters_push_every_way
    from fflin.simulation.settling import SHORTEST, time_to_settle
    from fflin.simulation.simulate import simulate

    given = once("--limit", arguments.limit)
    options: dict[str, Any] = {
        "q0": configuration_of(robot, arguments, robot.start),
        "v0": velocity_of(robot, arguments, "target_velocity", "velocity", start=robot.start),
        "dt": arguments.step,
        "every": arguments.every,
        "method": arguments.method,
        "limits": [arguments.limits, given] if arguments.limits == "urdf" else given or None,
        "delay": arguments.delay,
    }
    if arguments.free:
        if arguments.limit or arguments.delay:
            raise InputError("--free has no input to limit or delay; leave one out")
        weighed = any((arguments.weights, arguments.q, arguments.r, arguments.bryson, arguments.dt))
        target = arguments.target_joint or arguments.target_velocity
        if weighed or target or arguments.reduce or arguments.allocate:
            raise InputError(
                "--free has no regulator to give weights, a target or thrusters; leave one out"
            )
        duration = SHORTEST if arguments.duration is None else arguments.duration
        return simulate(robot, frame=arguments.frame, duration=duration, **options)
    from fflin.control.policies import Allocation, StateFeedback

    allocate = thrusters_push_every_way(robot) if arguments.allocate is None else arguments.allocate
    design = _without_thrusters(robot) if allocate else robot
    lin = _about_target(design, arguments)
    gain = gain_of(lin, arguments)
    if not (arguments.reduce or allocate):
        options["linear"] = lin  # at every row, where the sampled model has the samples alone
    if gain.dt:
        lin = lin.discretize(gain.dt)
    policy = StateFeedback(lin, gain.K)
    _require_held(robot, policy, options["q0"])
    options["duration"] = arguments.duration
    if arguments.duration is None:
        options["duration"] = time_to_settle(robot, policy, options["q0"], options["v0"])
    if allocate:
        return simulate(robot, Allocation(policy, design), **options)
    motion = simulate(robot, policy, **options)
    _warn_of_cut_thrust(robot, motion, policy)
    return motion


def _require_held(robot: Robot, policy: StateFeedback, q: Array) -> None:
    """Warn of what starts beside the target and is not fed back; refuse a start of nothing else."""
    from fflin.control.policies import fed_back
    from fflin.dynamics.state import StateMap

    lin = policy.lin
    state = StateMap(robot, reference=lin.reference, frame=lin.frame)
    start, target = (state.read(at, lin.v, near=state.read(lin.q, lin.v)) for at in (q, lin.q))
    beside = [name for name, x in zip(state.names, abs(start - target), strict=True) if x > 1e-9]
    loose = [name for name in beside if name not in fed_back(policy)]
    if loose and loose == beside:
        raise InputError(
            f"what starts beside the target is not regulated: {listed(loose)}; no input would act: "
            "give inputs that move it, or another start"
        )
    if loose:
        text = f"{listed(loose)} starts beside the target and is not regulated"
        warnings.warn(text, FflinWarning, stacklevel=2)


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


def _without_thrusters(robot: Robot) -> Robot:
    from fflin.robot.inputs import BaseForce, BaseTorque, Thruster

    others = tuple(each for each in robot.inputs if not isinstance(each, Thruster))
    if len(others) == len(robot.inputs):
        raise InputError(f"--allocate: '{robot.name}' has no thrusters; give --inputs with some")
    missing = [
        kind for kind in (BaseTorque, BaseForce) if not any(isinstance(x, kind) for x in others)
    ]
    base = tuple(kind() for kind in missing)
    return robot.replace(inputs=(*base, *others))


def _about_target(robot: Robot, arguments: argparse.Namespace) -> LinearModel:
    from fflin.linear.linearization import linearize

    q = placed(robot, "--target-joint", arguments.target_joint)
    v = velocity_of(robot, arguments, "target_velocity")
    u = inputs_at(robot, q, v, arguments)
    return regulated_part(linearize(robot, q, v, u, frame=arguments.frame), arguments)
