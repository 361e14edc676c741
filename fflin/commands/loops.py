"""Closed loop that commands simulate, with a controller from files or designed from options."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

from fflin.base.errors import InputError
from fflin.commands import options, parser
from fflin.commands.points import (
    attitude,
    configuration_of,
    held_at,
    limits_of_options,
    once,
    refuse,
    refuse_pose,
    velocity_of,
)
from fflin.commands.regulator import (
    add_allocation,
    add_trajectory,
    add_weights,
    gain_of,
    models_along,
    regulated_part,
    robot_of_design,
    schedule_of,
    weights_of,
)

if TYPE_CHECKING:
    import pinocchio as pin

    from fflin.base.validation import Array
    from fflin.control.gain import Gain
    from fflin.control.policies import Allocation, Feedback
    from fflin.linear.model import LinearModel
    from fflin.robot.robot import Robot

_WEIGHTS = ("weights", "q", "r", "bryson", "sample")
_POSE = ("target_rpy", "target_position")
_TARGETS = ("target_joint", "target_velocity", "effort", "equilibrium", "reduce")


class Loop(NamedTuple):
    """Policy, simulation options, and for state feedback the model that predicts the motion."""

    policy: Any
    options: dict[str, Any]
    prediction: Mapping[str, Any] = MappingProxyType({})


def add_loop(command: parser.Command) -> None:
    """Add the options that define the closed loop and its simulation."""
    options.add_robot(command)
    start, goal = command.group("start"), command.group("target")
    options.add_pose(start)
    start.add(
        "--offset",
        "initial error with respect to the start of the trajectory, in base axes. NAME is a "
        "state, a group or a pattern, such as r_b.x, q_m or omega_b.z (SI units), or it is roll, "
        "pitch or yaw [deg]",
        parser.assignment,
        repeatable=True,
    )
    options.add_target(goal)
    options.add_inputs_there(goal)
    add_trajectory(command)
    add_weights(command, integrated=True)
    _add_controllers(command.group(parser.CONTROLLER))
    run = command.group(parser.SIMULATION)
    run.add(
        "--duration",
        "duration of the simulation [s]. The default is the duration of the trajectory. Without "
        "a trajectory, the default is the settling time of the linear loop, limited to 60 ... "
        "600 s",
        float,
        "T",
    )
    options.add_step(run)
    methods = "integration method: cf4 (default) or semi_implicit_euler"
    run.add("--method", methods, metavar="METHOD", default="cf4")
    options.add_system(command)
    options.add_frame(run)


def add_schedule(group: parser.Group) -> None:
    """Add --schedule."""
    group.add(
        "--schedule",
        "use the gains in FILE, which `fflin tvlqr` saved, and follow the trajectory that FILE "
        "also contains. This option replaces --trajectory",
        Path,
    )


def _add_controllers(group: parser.Group) -> None:
    add_schedule(group)
    group.add(
        "--gain",
        "use the gain in FILE, which `fflin lqr` saved, and regulate to the operating point for "
        "which the gain was designed",
        Path,
    )
    group.add(
        "--controller",
        "use a linear controller K with positive feedback, u - u0 = K (y - y0), about the "
        "target. FILE (.mat, .npz or .json) contains the matrices A, B, C and D of the "
        "controller and, if the controller is sampled, its sample time dt or Ts. --output "
        "defines y",
        Path,
    )
    group.switch(
        "--negative-feedback",
        "apply the controller of --controller with negative feedback, u - u0 = -K (y - y0)",
    )
    add_allocation(group)
    group.switch(
        "--mpc",
        "use model predictive control (MPC) with the limits of the robot; MPC requires --sample",
    )
    group.add("--horizon", "number of samples in the horizon of --mpc", int, default=20)
    group.switch("--free", "simulate the robot without a regulator and without inputs")
    options.add_limits(group)
    delay = (
        "delay [s] between a sample and the application of the command that is computed from "
        "this sample"
    )
    group.add("--delay", delay, float, "T", default=0.0)


def loop_of(robot: Robot, arguments: argparse.Namespace) -> Loop:
    """Return the loop that the options of `add_loop` define."""
    from fflin.control.policies import StateFeedback
    from fflin.simulation.plan import SHORTEST, time_to_settle

    options.settle_step(arguments)
    settings: dict[str, Any] = {
        "dt": arguments.dt,
        "method": arguments.method,
        "limits": limits_of_options(arguments),
        "delay": arguments.delay,
        "duration": arguments.duration,
    }
    if not arguments.controller:
        refuse(arguments, ("negative_feedback",), "only --controller has a sign of the feedback")
    if arguments.trajectory or arguments.schedule:
        policy, start = along(robot, arguments)
        return Loop(policy, settings | start)
    refuse(arguments, ("offset", "hold"), "without --trajectory FILE, this has no effect")
    if arguments.free:
        of_law = ("limit", "delay", "reduce", "allocate", "gain", "controller", "mpc")
        names = (*_WEIGHTS, *_POSE, *_TARGETS[:2], *of_law)
        refuse(arguments, names, "with --free there is no regulator and all inputs are zero")
        settings["q0"], settings["v0"] = start_of(robot, arguments)
        settings["duration"] = SHORTEST if arguments.duration is None else arguments.duration
        return Loop(None, settings | {"frame": arguments.frame})
    policy, feedback, lin = about_point(robot, arguments)
    settings["q0"], settings["v0"] = q, v = start_of(robot, arguments, feedback.lin.reference)
    if arguments.duration is None:
        linear = StateFeedback(feedback.lin, feedback.gain.K) if arguments.mpc else feedback
        settings["duration"] = time_to_settle(robot, linear, q, v)
    alone = policy is feedback and not (arguments.controller or arguments.mpc)
    return Loop(policy, settings, {"linear": lin} if alone else {})


def start_of(
    robot: Robot, arguments: argparse.Namespace, reference: pin.SE3 | None = None
) -> tuple[Array, Array | None]:
    """Return the initial q (nq,) and v (nv,) from the arguments or the robot."""
    from fflin.base.names import rates_by_name
    from fflin.dynamics.points import combined

    point, number = robot.point, arguments.relative_equilibrium
    if number:  # the start is relative to this pose, which replaces the pose of the point
        point = {part: point[part] for part in ("joints", "velocity") if part in point}
    rates = rates_by_name(robot.joint_names, once("--target-velocity", arguments.target_velocity))
    state = combined(combined(point, {"velocity": rates}), robot.start)
    q = configuration_of(robot, arguments, state)
    if number:
        import pinocchio as pin

        about = reference or attitude(robot, q, number, arguments.frame)[1]
        q[:7] = pin.SE3ToXYZQUAT(about * pin.XYZQUATToSE3(q[:7]))
    return q, velocity_of(robot, arguments, state, "velocity")


def about_point(
    robot: Robot, arguments: argparse.Namespace
) -> tuple[Feedback | Allocation, Any, LinearModel | None]:
    """Return the policy, its feedback, and the model that predicts every row of the motion."""
    from fflin.control.linear_controller import LinearController
    from fflin.control.policies import Allocation, StateFeedback

    gain: Gain | None = None
    if arguments.mpc:
        names = ("allocate", "gain", "controller", "reduce")
        refuse(arguments, names, "--mpc replaces the regulator and its options")
        arguments.allocate = False
    if arguments.gain:
        from fflin.control.gain import Gain

        why = "the file of --gain already contains the weights and the operating point"
        refuse(arguments, (*_WEIGHTS, *_TARGETS), why)
        gain = Gain.load(arguments.gain)
        design = robot_of_design(robot, arguments.allocate, gain)
        lin = _about_gain(design, gain, arguments)
    else:
        design = robot_of_design(robot, arguments.allocate)
        lin = _about_target(design, arguments)
    if arguments.controller:
        of_gain = (*_WEIGHTS, "gain", "reduce")
        refuse(arguments, of_gain, "--controller replaces the regulator and its options")
        sign = -1.0 if arguments.negative_feedback else 1.0
        feedback: Any = LinearController(arguments.controller, lin, sign=sign)
    elif arguments.mpc:
        feedback = _mpc(lin, arguments)
    else:
        gain = gain or gain_of(lin, arguments, allocated=design is not robot)
        feedback = StateFeedback(lin.discretize(gain.dt) if gain.dt else lin, gain.K)
    if design is not robot:
        return Allocation(feedback, design), feedback, None
    return feedback, feedback, None if arguments.reduce else lin


def _mpc(lin: LinearModel, arguments: argparse.Namespace) -> Feedback:
    """Return the predictive controller with the weights and limits of the arguments."""
    from fflin.control.mpc import mpc
    from fflin.control.weights import rule_weights

    if arguments.sample is None:
        raise InputError("--mpc needs the sample time of the controller; add --sample H")
    settings: dict[str, Any] = {"weights": arguments.weights}
    if given := weights_of(arguments):
        Q, R, _, _ = rule_weights(lin.discretize(arguments.sample), arguments.weights, given)
        settings = {"Q": Q, "R": R}
    limits = limits_of_options(arguments)
    return mpc(lin, horizon=arguments.horizon, dt=arguments.sample, limits=limits, **settings)


def along(robot: Robot, arguments: argparse.Namespace) -> tuple[Any, dict[str, Any]]:
    """Return the feedback along a trajectory, and the options of its start."""
    from fflin.control.gain_schedule import GainSchedule
    from fflin.control.policies import Allocation
    from fflin.control.tracking import TrajectoryFeedback

    regulator = ("free", "mpc", "gain", "controller", "relative_equilibrium", *_POSE, *_TARGETS)
    why = (
        "the trajectory defines the regulator, its target, and the start, which --offset displaces"
    )
    refuse(arguments, (*regulator, "joint", "rpy", "position", "velocity"), why)
    design = robot_of_design(robot, bool(arguments.allocate))
    if arguments.schedule is None:
        models = models_along(arguments, design)
        policy = TrajectoryFeedback(models, schedule_of(models, arguments))
    else:
        why = "the file of --schedule already contains the trajectory and the design of its gains"
        refuse(arguments, ("trajectory", "hold", *_WEIGHTS), why)
        schedule = GainSchedule.load(arguments.schedule)
        policy = TrajectoryFeedback(schedule.trajectory(design), schedule)
    start: dict[str, Any] = {}
    if offset := once("--offset", arguments.offset):
        start["q0"], start["v0"] = policy.beside(offset)
    return (Allocation(policy, design) if arguments.allocate else policy), start


def _about_gain(robot: Robot, gain: Any, arguments: argparse.Namespace) -> LinearModel:
    """Return the linear model about the operating point of a gain.

    If the operating point is at its own reference, the target pose of the base is the reference.
    """
    from fflin.dynamics.actuation import Actuation
    from fflin.dynamics.state import StateMap
    from fflin.linear.fit import require_same
    from fflin.linear.linearization import linearize

    made = f"{arguments.gain} was made for '{gain.robot}'"
    state, reference = StateMap(robot, frame=gain.frame), None
    for kind, there in (("state", state), ("input", Actuation(state))):
        own = getattr(gain, f"{kind}_names"), getattr(gain, f"{kind}_units")
        require_same(made, robot, kind, own, (there.names, there.units))
    q, v = state.to_pinocchio(gain.x0)
    if gain.x0[:6].any():
        refuse(arguments, _POSE, "the file of --gain already contains the pose of the base")
    else:
        q[:7] = target_of(robot, arguments)[0][:7]
    if number := arguments.relative_equilibrium:
        q, reference = attitude(robot, q, number, gain.frame)
    return linearize(robot, q, v, gain.u0, frame=gain.frame, reference=reference)


def _about_target(robot: Robot, arguments: argparse.Namespace) -> LinearModel:
    from fflin.linear.linearization import linearize

    q, v = target_of(robot, arguments)
    q, u, reference = held_at(robot, q, v, arguments)
    lin = linearize(robot, q, v, u, frame=arguments.frame, reference=reference)
    return regulated_part(lin, arguments)


def target_of(robot: Robot, arguments: argparse.Namespace) -> tuple[Array, Array | None]:
    """Return the target q (nq,) and v (nv,), by default the operating point of the robot."""
    from fflin.dynamics.points import combined

    refuse_pose(arguments, "target_")
    state = combined(robot.point, robot.target)
    q = configuration_of(robot, arguments, state, "target_")
    return q, velocity_of(robot, arguments, state, "target_velocity")
