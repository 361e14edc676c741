"""Commands for controller design, simulation and C code; builders of closed loops."""

from __future__ import annotations

import sys
import warnings
from argparse import Namespace
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import fflin
from fflin.base.errors import FflinWarning, InputError, UnknownNameError
from fflin.base.names import chosen, input_keys, rates_by_name
from fflin.base.tables import folded
from fflin.commands import DONE, FELL_SHORT
from fflin.commands.points import (
    attitude,
    limits_of_options,
    linear_model,
    load_robot,
    model_about,
    models_along,
    once,
    point_of,
    refuse,
    state_of,
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


_ALLOCATED = (
    "allocation: tau_b and F_b are realised by the thrusters, in `fflin simulate --gain` too; "
    "--no-allocate designs the thrusts themselves"
)

_NOT_ALLOCATED = (
    "no allocation: the gains command each thruster, in `fflin simulate` too, and negative thrust "
    "is cut at zero"
)


def lqr(arguments: Namespace) -> Report:
    """Design a linear quadratic regulator; show gain, poles, residual and margins.

    example: fflin lqr canadarm2 -o gain.npz
    """
    from fflin.base.record import record_of

    robot, design, _, gain = designed(arguments)
    # The report omits warnings, because they already appear on stderr.
    text = "\n\n".join(x for x in str(gain).split("\n\n") if not x.startswith("warning: "))
    if design is not robot:
        text += f"\n\n{folded([_ALLOCATED])}"
    result = {**record_of(gain), "margins": gain.margins, "allocated": design is not robot}
    files = {
        arguments.output_file: gain.save,
        arguments.plot: lambda path: fflin.plot_loops(gain, path),
    }
    return Report(gain.robot, result, text, files)


def tvlqr(arguments: Namespace) -> Report:
    """Design a time-varying linear quadratic regulator along a trajectory.

    example: fflin tvlqr planar_detumble --trajectory plan.csv --hold previous --sample 0.1 -o
    gains.npz
    """
    why = "along a trajectory no reduced model is needed, because the finite-horizon cost exists"
    refuse(arguments, ("reduce",), why)
    along = models_along(arguments)
    schedule = schedule_of(along, arguments, once("--qf", arguments.qf) or "steady")
    text = str(schedule)
    if any(isinstance(each, fflin.Thruster) for each in along.robot.inputs):
        text += f"\n{folded([_NOT_ALLOCATED])}"
    return Report(along.robot.name, schedule, text, {arguments.output_file: schedule.save})


def export(arguments: Namespace) -> Report:
    """Write C99 code of a gain, compensator or gain schedule, with a test program.

    example: fflin export gain.npz --robot servicer_7dof --limits urdf -o flight
    """
    from fflin.base.record import read_record, reading, text

    kinds = {kind.__name__: kind for kind in (fflin.Gain, fflin.GainSchedule, fflin.Compensator)}
    with reading(arguments.file, "Gain, GainSchedule or Compensator"):
        found = text(read_record(arguments.file)[0]["kind"])
        if found not in kinds:
            raise ValueError(f"the file contains: {found}")
    law = kinds[found].load(arguments.file)
    robot = robot_of_design(fflin.load(arguments.robot), None, law) if arguments.robot else None
    limits = None if arguments.limits == "none" else arguments.limits
    name, real = arguments.name, arguments.real
    folder = fflin.write_c(
        law, arguments.output_folder, robot=robot, limits=limits, name=name, real=real
    )
    test = f"cc -std=c99 -o {name}_test {name}.c {name}_test.c -lm && ./{name}_test"
    said = f"C99 code of {law!r}, with numbers of type {real}\nto test it in {folder}: {test}"
    return Report(law.robot, {"name": name, "real": real, "folder": str(folder)}, said)


def plan(arguments: Namespace) -> Report:
    """Plan a low-effort trajectory between two states within limits.

    example: fflin plan planar_detumble --target-joint joint_1=0.3 --duration 20 -o plan.npz
    """
    robot = load_robot(arguments)
    q0, v0 = state_of(robot, arguments, robot.point, robot.start)
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
    motion = fflin.simulate(
        robot, policy, every=arguments.every, engine=arguments.engine, **settings
    )
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
    from fflin.view.live import Live

    robot = load_robot(arguments)
    q, _ = state_of(robot, arguments, robot.point, robot.start)
    how = {name: getattr(arguments, name) for name in (*_SHOWN, "frame")}
    live = fflin.visualize(robot, open=False, q=q, port=arguments.port or 0, **how)
    assert isinstance(live, Live)  # since there is no motion
    print(f"fflin: {robot.name} at {live.url} (Ctrl-C ends)", file=sys.stderr, flush=True)
    if not arguments.no_open:
        live.open()
    live.wait()
    return Report(robot.name, {}, f"{robot.name}: the view is closed")


def robot_of_design(
    robot: fflin.Robot,
    allocate: bool | None,
    law: fflin.Gain | fflin.GainSchedule | fflin.Compensator | None = None,
) -> fflin.Robot:
    """Return the robot of a design; for allocation, a base torque and force replace thrusters.

    If `allocate` is None, thrusters are allocated if they can produce every wrench on the base. A
    given `law` must also command a base torque.
    """
    if allocate is None:
        from fflin.control.authority import thrusters_give_every_wrench

        of_wrench = law is None or "tau_b.x" in law.input_names
        allocate = of_wrench and thrusters_give_every_wrench(robot)
    if not allocate:
        return robot
    others = tuple(each for each in robot.inputs if not isinstance(each, fflin.Thruster))
    if len(others) == len(robot.inputs):
        raise InputError(
            f"--allocate needs thrusters, but '{robot.name}' has none; define them in the file of "
            "--inputs"
        )
    present = {*map(type, others)}
    missing = [kind() for kind in (fflin.BaseTorque, fflin.BaseForce) if kind not in present]
    return robot.replace(inputs=(*missing, *others))


def designed(
    arguments: Namespace,
) -> tuple[fflin.Robot, fflin.Robot, fflin.LinearModel, fflin.Gain]:
    """Return the robot, the robot of the design, the regulated linear model, and its regulator."""
    robot = load_robot(arguments)
    design = robot_of_design(robot, arguments.allocate)
    _, lin = linear_model(arguments, design)
    if arguments.reduce:
        lin = fflin.momentum_reduction(lin, wheel_speeds=arguments.wheel_speeds)
    return robot, design, lin, gain_of(lin, arguments, allocated=design is not robot)


def weights_of(arguments: Namespace) -> dict[str, dict[str, float]]:
    """Return the weights of --q, --r and --bryson, or {} if none of these options is given."""
    names = ("q", "r", "bryson")
    given = {name: once(f"--{name}", getattr(arguments, name)) for name in names}
    return given if any(given.values()) else {}


def gain_of(lin: fflin.LinearModel, arguments: Namespace, *, allocated: bool = False) -> fflin.Gain:
    """Return the regulator of a model with the weights of the options; warn of small margins."""
    from fflin.control.gain import fragility, one_sided
    from fflin.control.lqr import require_fixed_point
    from fflin.control.weights import rule_weights

    require_fixed_point(lin)
    if arguments.sample is not None:
        lin = lin.discretize(arguments.sample)
    given, speeds = weights_of(arguments), arguments.wheel_speeds
    try:
        *QRN, rule = rule_weights(lin, arguments.weights, given, wheel_speeds=speeds)
    except UnknownNameError as error:
        hint = "; --no-allocate weights single thrusters" * allocated
        raise UnknownNameError(f"{error}{hint}") from None
    gain = replace(fflin.lqr(lin, *QRN, wheel_speeds=speeds), weights=rule)
    for text in filter(None, (fragility(gain), one_sided(gain))):
        warnings.warn(text, FflinWarning, stacklevel=2)
    return gain


def schedule_of(
    along: fflin.LinearTrajectory, arguments: Namespace, Qf: str | dict[str, float] = "steady"
) -> fflin.GainSchedule:
    """Return the time-varying regulator along a trajectory with the weights of the options."""
    from fflin.control.default_weights import pace_along
    from fflin.control.tvlqr import steady_end
    from fflin.control.weights import rule_weights

    sample, lin = arguments.sample, steady_end(along)
    pace = pace_along(float(along.t[-1] - along.t[0]), sample or 0.0)
    Q, R, _, rule = rule_weights(lin, arguments.weights, weights_of(arguments), pace=pace)
    return fflin.tvlqr(along, Q, R, Qf, sample, rule=rule)


def check_pictures(robot: fflin.Robot, arguments: Namespace) -> None:
    """Raise an error for invalid options of `pictures`, before a long simulation starts."""
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
    """Return {path: function that writes it} for the requested page and pictures of a motion."""
    how = {name: getattr(arguments, name) for name in ("times", "fps", "speed", *_SHOWN)}

    def show(path: Path) -> None:
        fflin.visualize(robot, motion(), **how | {path.suffix.removeprefix("."): path})

    return {getattr(arguments, name): show for name in _FILES}


def loop_of(robot: fflin.Robot, arguments: Namespace) -> tuple[object, dict[str, Any]]:
    """Return the policy that the arguments define, and keyword arguments of `simulate`."""
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
        design = policy.design if isinstance(policy, fflin.Allocation) else robot
        settings["duration"] = time_to_settle(design, linear, q, v)
    return policy, settings | {"q0": q, "v0": v, "linear": lin}


def start_of(
    robot: fflin.Robot, arguments: Namespace, reference: pin.SE3 | None = None
) -> tuple[Array, Array | None]:
    """Return the initial q (nq,) and v (nv,) from the arguments or the robot."""
    point, number = robot.point, arguments.relative_equilibrium
    if number:  # the start is relative to this pose, which replaces the pose of the point
        point = {part: point[part] for part in ("joints", "velocity") if part in point}
    rates = rates_by_name(robot.joint_names, once("--target-velocity", arguments.target_velocity))
    q, v = state_of(robot, arguments, point, {"velocity": rates}, robot.start)
    if number:
        import pinocchio as pin

        about = reference or attitude(robot, q, number, arguments.frame)[1]
        q[:7] = pin.SE3ToXYZQUAT(about * pin.XYZQUATToSE3(q[:7]))
    return q, v


def about_point(
    robot: fflin.Robot, arguments: Namespace
) -> tuple[object, fflin.StateFeedback | fflin.LinearController, fflin.LinearModel | None]:
    """Return the policy about a point, its linear feedback, and the model for the prediction.

    The model is None for MPC, a reduced model, a controller from a file, or allocated thrusters.
    `simulate` then predicts with the policy's own model, or not at all.
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
        if arguments.reduce:
            lin = fflin.momentum_reduction(lin, wheel_speeds=arguments.wheel_speeds)
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
    from fflin.control.default_weights import Pace
    from fflin.control.mpc import Mpc
    from fflin.control.weights import rule_weights

    if (sample := arguments.sample) is None:
        raise InputError("--mpc needs the sample time of the controller; add --sample H")
    # Q and R weight a cost integral, because `lin` is in continuous time. Their default values
    # depend on the sample time.
    given = weights_of(arguments)
    Q, R, *_ = rule_weights(lin, arguments.weights, given, pace=Pace(hold=sample))
    limits = limits_of_options(arguments)
    by = fflin.mpc(lin, Q, R, horizon=arguments.horizon, dt=sample, limits=limits)
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
    """Return the linear model about the point for which a gain was designed.

    If the base is at the reference of the gain, the target pose of the base is the new reference.
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
    """Return q (nq,), v (nv,) and reference of the target; the default is the operating point."""
    return point_of(robot, arguments, robot.point, robot.target, prefix="target_")
