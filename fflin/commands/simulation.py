"""Commands `plan`, `simulate` and `view`, and the control loops that commands simulate."""

from __future__ import annotations

import sys
from argparse import Namespace
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import fflin
from fflin.base.errors import InputError
from fflin.base.names import chosen, input_keys, rates_by_name
from fflin.commands import DONE, FELL_SHORT
from fflin.commands.points import (
    attitude,
    limits_of_options,
    load_robot,
    model_about,
    models_along,
    once,
    point_of,
    refuse,
    state_of,
)
from fflin.commands.regulator import (
    gain_of,
    regulated_part,
    robot_of_design,
    schedule_of,
    weights_of,
)
from fflin.commands.results import Report

if TYPE_CHECKING:
    import pinocchio as pin

    from fflin.base.validation import Array
    from fflin.control.mpc import Mpc

_WEIGHTS = ("weights", "q", "r", "bryson", "sample")
_POSE = ("target_rpy", "target_position")
_TARGETS = ("target_joint", "target_velocity", "effort", "equilibrium", "reduce")

_FILES, _SHOWN = ("html", "png", "gif"), ("scene", "follow", "tool")


def plan(arguments: Namespace) -> Report:
    """Plan a low-effort trajectory between two states within limits.

    example: fflin plan planar_detumble --target-joint joint_1=0.3 --duration 20 -o plan.npz
    """
    from fflin.dynamics.points import combined

    robot = load_robot(arguments)
    q0, v0 = state_of(robot, arguments, combined(robot.point, robot.start))
    motion = fflin.plan(
        robot,
        target_of(robot, arguments)[:2],
        arguments.duration,
        q0=q0,
        v0=v0,
        knots=arguments.knots,
        hold=arguments.hold,
        limits=limits_of_options(arguments),
        R=once("--r", arguments.r) or None,
        free=arguments.free_end,
    )
    return Report(robot.name, motion, str(motion), {arguments.output_file: motion.save})


def simulate(arguments: Namespace) -> Report:
    """Simulate the robot with a regulator to a target or along a trajectory.

    example: fflin simulate ets_vii --rpy 30 0 0 --duration 60 --html loop.html --plot loop.png
    """
    from fflin.simulation.report import motion_record, motion_report

    robot, show = load_robot(arguments), arguments.show
    check_pictures(robot, arguments)
    if show:
        lin = fflin.linearize(robot)
        chosen("state or input", show, (*lin.state_names, *input_keys(lin)))
    policy, settings = loop_of(robot, arguments)
    try:
        motion = fflin.simulate(
            robot, policy, every=arguments.every, engine=arguments.engine, **settings
        )
    except InputError as error:
        hint = " (--sample)" if "needs sampled commands" in str(error) else ""
        raise InputError(f"{error}{hint}") from None
    files: dict[Path | None, Callable[[Path], object] | None] = {
        arguments.output_file: motion.save,
        arguments.plot: partial(motion.plot, show=show or None),
        **pictures(robot, lambda: motion, arguments),
    }
    code = FELL_SHORT if motion.stopped else DONE
    interrupted = motion.stopped if motion.stopped.startswith("interrupted") else ""
    text = motion_report(motion)
    return Report(robot.name, motion_record(motion), text, files, code, interrupted)


def view(arguments: Namespace) -> Report:
    """Show a robot live in the browser with a slider for each joint.

    example: fflin view servicer_7dof --joint joint_2=0.4
    """
    from fflin.dynamics.points import combined
    from fflin.view.live import Live

    robot = load_robot(arguments)
    q, _ = state_of(robot, arguments, combined(robot.point, robot.start))
    how = {name: getattr(arguments, name) for name in (*_SHOWN, "frame")}
    live = fflin.visualize(robot, open=False, q=q, port=arguments.port or 0, **how)
    assert isinstance(live, Live)  # since there is no motion
    print(f"fflin: {robot.name} at {live.url} (Ctrl-C ends)", file=sys.stderr, flush=True)
    if not arguments.no_open:
        live.open()
    live.wait()
    return Report(robot.name, {}, f"{robot.name}: the view is closed")


def check_pictures(robot: fflin.Robot, arguments: Namespace) -> None:
    """Raise an error before the simulation if `pictures` would refuse the options."""
    from fflin.simulation.plan import LONGEST
    from fflin.view.visualize import check_outputs, check_rates, check_times, tool_frame

    if not check_outputs({f".{name}": getattr(arguments, name) for name in _FILES}):
        return
    tool_frame(robot, arguments.tool)
    duration = arguments.duration or LONGEST
    check_rates(arguments.fps, arguments.speed, duration)
    if arguments.times:
        check_times(arguments.times, 0.0, duration)


def pictures(
    robot: fflin.Robot, motion: Callable[[], fflin.Motion], arguments: Namespace
) -> dict[Path | None, Callable[[Path], object]]:
    """Return {path: function that writes the file} for the files that display a motion."""
    how = {name: getattr(arguments, name) for name in ("times", "fps", "speed", *_SHOWN)}

    def show(path: Path) -> None:
        fflin.visualize(robot, motion(), **how | {path.suffix.removeprefix("."): path})

    return {getattr(arguments, name): show for name in _FILES}


def loop_of(robot: fflin.Robot, arguments: Namespace) -> tuple[object, dict[str, Any]]:
    """Return the policy that the arguments define, and the options of `fflin.simulate`."""
    from fflin.simulation.plan import SHORTEST, time_to_settle

    settings: dict[str, Any] = {
        **{name: getattr(arguments, name) for name in ("dt", "method", "delay", "duration")},
        "limits": limits_of_options(arguments),
    }
    if not arguments.controller:
        refuse(arguments, ("negative_feedback",), "only --controller has a sign of the feedback")
    if arguments.trajectory or arguments.schedule:
        design = robot_of_design(robot, bool(arguments.allocate))
        tracking = along(design, arguments)
        if offset := once("--offset", arguments.offset):
            settings["q0"], settings["v0"] = tracking.beside(offset)
        return fflin.Allocation(tracking, design) if arguments.allocate else tracking, settings
    refuse(arguments, ("offset", "hold"), "without --trajectory FILE, this has no effect")
    if arguments.free:
        of_law = ("limit", "delay", "reduce", "allocate", "gain", "controller", "mpc")
        names = (*_WEIGHTS, *_POSE, *_TARGETS[:2], *of_law)
        refuse(arguments, names, "with --free there is no regulator and all inputs are zero")
        q, v = start_of(robot, arguments)
        if arguments.duration is None:
            settings["duration"] = SHORTEST
        return None, settings | {"q0": q, "v0": v, "frame": arguments.frame}
    policy, linear, lin = about_point(robot, arguments)
    q, v = start_of(robot, arguments, linear.lin.reference)
    if arguments.duration is None:
        settings["duration"] = time_to_settle(robot, linear, q, v)
    return policy, settings | {"q0": q, "v0": v, "linear": lin}


def start_of(
    robot: fflin.Robot, arguments: Namespace, reference: pin.SE3 | None = None
) -> tuple[Array, Array | None]:
    """Return the initial q (nq,) and v (nv,) from the arguments or the robot."""
    from fflin.dynamics.points import combined

    point, number = robot.point, arguments.relative_equilibrium
    if number:  # the start is relative to this pose, which replaces the pose of the point
        point = {part: point[part] for part in ("joints", "velocity") if part in point}
    rates = rates_by_name(robot.joint_names, once("--target-velocity", arguments.target_velocity))
    state = combined(combined(point, {"velocity": rates}), robot.start)
    q, v = state_of(robot, arguments, state)
    if number:
        import pinocchio as pin

        about = reference or attitude(robot, q, number, arguments.frame)[1]
        q[:7] = pin.SE3ToXYZQUAT(about * pin.XYZQUATToSE3(q[:7]))
    return q, v


def about_point(
    robot: fflin.Robot, arguments: Namespace
) -> tuple[object, fflin.StateFeedback | fflin.LinearController, fflin.LinearModel | None]:
    """Return the policy about a point, its linear feedback, and the model that predicts the motion.

    The model is None if the prediction would not contain every row of the motion.
    """
    gain: fflin.Gain | None = None
    feedback: fflin.StateFeedback | fflin.LinearController
    if arguments.mpc:
        names = ("allocate", "gain", "controller", "reduce")
        refuse(arguments, names, "--mpc replaces the regulator and its options")
        arguments.allocate = False
    if arguments.gain:
        why = "the file of --gain already contains the weights and the operating point"
        refuse(arguments, (*_WEIGHTS, *_TARGETS), why)
        gain = fflin.Gain.load(arguments.gain)
    design = robot_of_design(robot, arguments.allocate, gain)
    if gain:
        lin = _about_gain(design, gain, arguments)
    else:
        lin = model_about(design, arguments, *target_of(design, arguments))
        lin = regulated_part(lin, arguments)
    if arguments.mpc:
        by = _mpc(lin, arguments)
        return by, fflin.StateFeedback(by.lin, by.gain.K), None
    if arguments.controller:
        of_gain = (*_WEIGHTS, "gain", "reduce")
        refuse(arguments, of_gain, "--controller replaces the regulator and its options")
        sign = -1.0 if arguments.negative_feedback else 1.0
        feedback = fflin.LinearController(arguments.controller, lin, sign=sign)
    else:
        gain = gain or gain_of(lin, arguments, allocated=design is not robot)
        feedback = fflin.StateFeedback(lin.discretize(gain.dt) if gain.dt else lin, gain.K)
    if design is not robot:
        return fflin.Allocation(feedback, design), feedback, None
    return feedback, feedback, None if arguments.reduce or arguments.controller else lin


def _mpc(lin: fflin.LinearModel, arguments: Namespace) -> Mpc:
    """Return the predictive controller with the weights and limits of the arguments."""
    from fflin.control.mpc import Mpc
    from fflin.control.weights import rule_weights

    if (sample := arguments.sample) is None:
        raise InputError("--mpc needs the sample time of the controller; add --sample H")
    settings = {"horizon": arguments.horizon, "dt": sample, "limits": limits_of_options(arguments)}
    if given := weights_of(arguments):
        Q, R, _, _ = rule_weights(lin.discretize(sample), arguments.weights, given)
        by = fflin.mpc(lin, Q, R, **settings)
    else:
        by = fflin.mpc(lin, weights=arguments.weights, **settings)
    assert isinstance(by, Mpc)  # since the model is about a point
    return by


def along(robot: fflin.Robot, arguments: Namespace) -> fflin.TrajectoryFeedback:
    """Return the feedback along the trajectory of --trajectory or --schedule."""
    regulator = ("free", "mpc", "gain", "controller", "relative_equilibrium", *_POSE, *_TARGETS)
    why = (
        "the trajectory defines the regulator, its target, and the start, which --offset displaces"
    )
    refuse(arguments, (*regulator, "joint", "rpy", "position", "velocity"), why)
    if arguments.schedule is None:
        models = models_along(arguments, robot)
        return fflin.TrajectoryFeedback(models, schedule_of(models, arguments))
    why = "the file of --schedule already contains the trajectory and the design of its gains"
    refuse(arguments, ("trajectory", "hold", *_WEIGHTS), why)
    schedule = fflin.GainSchedule.load(arguments.schedule)
    return fflin.TrajectoryFeedback(schedule.trajectory(robot), schedule)


def _about_gain(robot: fflin.Robot, gain: fflin.Gain, arguments: Namespace) -> fflin.LinearModel:
    """Return the linear model about the operating point of a gain.

    If the operating point is at its own reference, the target pose of the base is the reference.
    """
    import pinocchio as pin

    from fflin.control.gain import model_of

    if gain.x0[:6].any():
        refuse(arguments, _POSE, "the file of --gain already contains the pose of the base")
        pose = gain.placement
    else:
        pose = target_of(robot, arguments)[0][:7]
    linear = partial(model_of, gain, robot, f"{arguments.gain} was made for '{gain.robot}'")
    lin = linear(pin.XYZQUATToSE3(pose))
    if number := arguments.relative_equilibrium:
        return linear(attitude(robot, lin.q, number, lin.frame)[1])
    return lin


def target_of(
    robot: fflin.Robot, arguments: Namespace
) -> tuple[Array, Array | None, pin.SE3 | None]:
    """Return q (nq,), v (nv,) and the reference of the target, by default the operating point."""
    from fflin.dynamics.points import combined

    return point_of(robot, arguments, combined(robot.point, robot.target), "target_")
