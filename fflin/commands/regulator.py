"""Commands `lqr`, `tvlqr` and `export`, and design options that other commands share."""

from __future__ import annotations

import argparse
import warnings
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fflin.base.errors import (
    EquilibriumError,
    FflinWarning,
    InputError,
    StabilizabilityError,
    UnknownNameError,
)
from fflin.base.tables import folded
from fflin.commands import options, parser
from fflin.commands.points import linear_model, load_robot, once, refuse
from fflin.commands.results import Report, figure_of

if TYPE_CHECKING:
    from fflin.control.gain import Gain
    from fflin.control.gain_schedule import GainSchedule
    from fflin.control.kalman import Compensator
    from fflin.linear.linear_trajectory import LinearTrajectory
    from fflin.linear.model import LinearModel
    from fflin.robot.robot import Robot


def add_commands(commands: parser.Commands) -> None:
    """Add the commands lqr, tvlqr and export."""
    _add_lqr(commands)
    _add_tvlqr(commands)
    _add_export(commands)


def _add_lqr(commands: parser.Commands) -> None:
    lqr = parser.command(
        commands,
        _lqr,
        "joint velocity equilibrium inputs frame weights q r bryson sample reduce "
        "wheel-speeds output-file plot",
    )
    options.add_point(lqr)
    add_weights(lqr)
    add_allocation(lqr.group(parser.CONTROLLER))
    options.add_output_file(lqr.group(parser.OUTPUT), "the gain", parser.RECORD, "Gain")
    options.add_figure(lqr, "the poles, the loop gain of each input and the stability margins")


def _add_tvlqr(commands: parser.Commands) -> None:
    tvlqr = parser.command(
        commands,
        _tvlqr,
        "trajectory hold strict weights q r bryson sample qf inputs frame output-file",
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
    options.add_output_file(tvlqr.group(parser.OUTPUT), "the gains", parser.RECORD, "GainSchedule")


def _add_export(commands: parser.Commands) -> None:
    export = parser.command(commands, _export)
    what = "gain, compensator or gain schedule saved by fflin: .npz, .mat or .json"
    export.add_argument("file", metavar="FILE", type=parser.input_file, help=what)
    group = export.group(parser.OUTPUT)
    folder = "folder for the code; a missing folder is created"
    group.add_argument("-o", "--output-folder", metavar="FOLDER", required=True, help=folder)
    group.add(
        "--robot",
        "robot for which FILE was designed: a name listed by `fflin robots`, or the path of a "
        "URDF or robot.toml. The default is the robot that FILE names",
        metavar="ROBOT",
        type=parser.input_name,
    )
    options.add_saturation(group)
    group.add("--name", "prefix of all names in the C code", metavar="NAME", default="controller")
    real = "floating-point type in the C code; double by default"
    group.add("--real", real, choices=("double", "float"), default="double")


def add_weights(command: parser.Command, *, integrated: bool = False) -> None:
    """Add the options for the cost, the sample time and the regulated states.

    With `integrated`, --dt is the integration step. Otherwise, --dt is the former name of --sample.
    """
    group = command.group(parser.CONTROLLER)
    group.add(
        "--weights",
        "rule for all weights that --q, --r and --bryson do not set. `urdf` (default) keeps the "
        "inputs within the limits of the URDF after displacements of 30 deg of the base and 0.3 "
        "rad of the joints. `identity` sets every weight to 1",
        choices=("urdf", "identity"),
    )
    group.add(
        "--q",
        "weight on states. NAME is a state, a group or a pattern, such as q_m.joint_1, q_b or "
        "q_m.hinge_*",
        parser.assignment,
        "NAME=W",
        repeatable=True,
    )
    group.add(
        "--r",
        "weight on inputs. NAME is an input, a group or a pattern, such as tau_b or tau_m.hinge_*",
        parser.assignment,
        "NAME=W",
        repeatable=True,
    )
    group.add(
        "--bryson",
        "largest acceptable value of a state, an input or a group. Its weight is 1/VALUE^2, and "
        "all weights set by the rule are multiplied by one factor, so that both kinds of weights "
        "are comparable",
        parser.assignment,
        repeatable=True,
    )
    group.add(
        "--sample",
        "sample time of the controller [s], with zero-order hold of the inputs. The sampled gain "
        "minimises the continuous-time cost",
        float,
        "H",
    )
    if not integrated:
        options.add_former_name(group, "--dt", "sample")
    group.switch(
        "--reduce",
        "for robots with conserved momentum: regulate only the controllable states",
    )
    group.yes_or_no(
        "--wheel-speeds",
        "whether to regulate the speeds of reaction wheels to their values at the operating "
        "point. By default, wheel speeds are regulated if thrusters or a base torque can absorb "
        "the wheel torque. --wheel-speeds also regulates the combinations of wheel speeds that "
        "exert no net torque on the robot (redundant wheels)",
    )


def add_allocation(group: parser.Group) -> None:
    """Add --allocate and --no-allocate."""
    group.yes_or_no(
        "--allocate",
        "design the regulator with base torque and force as inputs, and allocate its commands to "
        "the thrusters, which produce the nearest possible wrench. Allocation is the default if "
        "the thrusters can push in every direction, but not along a trajectory. With "
        "--no-allocate, the regulator commands each thruster itself, and negative thrust is cut at "
        "zero",
    )


def robot_of_design(
    robot: Robot, allocate: bool | None, law: Gain | GainSchedule | Compensator | None = None
) -> Robot:
    """Return the robot of a design; with allocation, base torque and force replace the thrusters.

    By default, thrusters are allocated if they can push in every direction, unless the controller
    in a file was designed for other inputs.
    """
    from fflin.control.authority import thrusters_give_every_wrench
    from fflin.robot.inputs import BaseForce, BaseTorque, Thruster

    if allocate is None:
        of_wrench = law is None or "tau_b.x" in law.input_names
        allocate = of_wrench and thrusters_give_every_wrench(robot)
    if not allocate:
        return robot
    others = tuple(each for each in robot.inputs if not isinstance(each, Thruster))
    if len(others) == len(robot.inputs):
        raise InputError(
            f"--allocate needs thrusters, but '{robot.name}' has none; define them in the file of "
            "--inputs"
        )
    missing = [
        kind for kind in (BaseTorque, BaseForce) if not any(isinstance(x, kind) for x in others)
    ]
    return robot.replace(inputs=(*(kind() for kind in missing), *others))


def designed(arguments: argparse.Namespace) -> tuple[Robot, Robot, LinearModel, Gain]:
    """Return the robot, the robot of the design, the regulated model, and the regulator."""
    robot = load_robot(arguments)
    design = robot_of_design(robot, arguments.allocate)
    lin = regulated_part(linear_model(arguments, design)[1], arguments)
    return robot, design, lin, gain_of(lin, arguments, allocated=design is not robot)


def weights_of(arguments: argparse.Namespace) -> dict[str, dict[str, float]]:
    """Return the weights of --q, --r and --bryson, or {} if none of these options is given."""
    names = ("q", "r", "bryson")
    given = {name: once(f"--{name}", getattr(arguments, name)) for name in names}
    return given if any(given.values()) else {}


def regulated_part(lin: LinearModel, arguments: argparse.Namespace) -> LinearModel:
    """Return the model for the design: the controllable part of `lin` if --reduce is given."""
    if not arguments.reduce:
        return lin
    from fflin.analysis.reduction import momentum_reduction

    return momentum_reduction(lin, wheel_speeds=arguments.wheel_speeds)


def gain_of(lin: LinearModel, arguments: argparse.Namespace, *, allocated: bool = False) -> Gain:
    """Return the regulator for the weights in the arguments; warn if its margins are small."""
    from fflin.control.gain import fragility, one_sided
    from fflin.control.lqr import lqr, require_fixed_point
    from fflin.control.weights import rule_weights

    try:
        require_fixed_point(lin)
    except EquilibriumError as error:
        # --equilibrium balances the forces, but a moving base is still not a fixed point. The hint
        # is therefore omitted at nonzero velocity.
        given = arguments.equilibrium or arguments.relative_equilibrium or lin.v.any()
        more = ", --relative-equilibrium" if lin.frame in ("lvlh", "hill") else ""
        raise EquilibriumError(str(error) if given else f"{error} (--equilibrium{more})") from None
    if arguments.sample is not None:
        lin = lin.discretize(arguments.sample)
    try:
        speeds = arguments.wheel_speeds
        if given := weights_of(arguments):
            *weights, rule = rule_weights(lin, arguments.weights, given, wheel_speeds=speeds)
            gain = replace(lqr(lin, *weights, wheel_speeds=speeds), weights=rule)
        else:
            gain = lqr(lin, weights=arguments.weights, wheel_speeds=speeds)
    except UnknownNameError as error:
        hint = "; --no-allocate weights single thrusters" * allocated
        raise UnknownNameError(f"{error}{hint}") from None
    except StabilizabilityError as error:
        hint = " (--reduce)" if "momentum_reduction" in str(error) else ""
        raise StabilizabilityError(f"{error}{hint}") from None
    for text in filter(None, (fragility(gain), one_sided(gain))):
        warnings.warn(text, FflinWarning, stacklevel=2)
    return gain


_ALLOCATED = (
    "allocation: tau_b and F_b are realised by the thrusters, in `fflin simulate --gain` too; "
    "--no-allocate designs the thrusts themselves"
)


_NOT_ALLOCATED = (
    "no allocation: the gains command each thruster, in `fflin simulate` too, and negative thrust "
    "is cut at zero"
)


def _lqr(arguments: argparse.Namespace) -> Report:
    """Design a linear quadratic regulator; show gain, poles, residual and margins.

    example: fflin lqr canadarm2 -o gain.npz
    """
    from fflin.base.record import record_of

    robot, design, _, gain = designed(arguments)
    # The report omits warnings, because they already appear on stderr.
    text = "\n\n".join(x for x in str(gain).split("\n\n") if not x.startswith("warning: "))
    if design is not robot:
        text += f"\n\n{folded([_ALLOCATED])}"
    files = {arguments.output_file: gain.save, arguments.plot: figure_of("plot_loops", gain)}
    result = {**record_of(gain), "margins": gain.margins, "allocated": design is not robot}
    return Report(gain.robot, result, text, files)


def _export(arguments: argparse.Namespace) -> Report:
    """Write C99 code of a gain, compensator or gain schedule, with a test program.

    example: fflin export gain.npz --robot servicer_7dof --limits urdf -o flight
    """
    from fflin.base.record import read_record, reading, text
    from fflin.control.gain import Gain
    from fflin.control.gain_schedule import GainSchedule
    from fflin.control.kalman import Compensator
    from fflin.export.writing import write_c
    from fflin.robot.loading import load

    kinds = {kind.__name__: kind for kind in (Gain, GainSchedule, Compensator)}
    with reading(arguments.file, "Gain, GainSchedule or Compensator"):
        found = text(read_record(arguments.file)[0]["kind"])
        if found not in kinds:
            raise ValueError(f"the file contains: {found}")
    law = kinds[found].load(arguments.file)
    robot = robot_of_design(load(arguments.robot), None, law) if arguments.robot else None
    folder = write_c(
        law,
        arguments.output_folder,
        robot=robot,
        limits=None if arguments.limits == "none" else arguments.limits,
        name=arguments.name,
        real=arguments.real,
    )
    name, real = arguments.name, arguments.real
    test = f"cc -std=c99 -o {name}_test {name}.c {name}_test.c -lm && ./{name}_test"
    said = f"C99 code of {law!r}, with numbers of type {real}\nto test it in {folder}: {test}"
    return Report(law.robot, {"name": name, "real": real, "folder": str(folder)}, said)


def add_trajectory(command: parser.Command, *, required: bool = False) -> None:
    """Add --trajectory, --hold and --strict. A trajectory file sets the default of --frame."""
    group = command.group(parser.TRAJECTORY)
    group.add(
        "--trajectory",
        "use the trajectory in FILE: .npz, .mat, .json or .csv; see fflin.Trajectory.load. "
        "--frame states the axes in which FILE gives base velocities and wrenches. The default "
        "of --frame is the frame named in FILE or, if there is none, local",
        Path,
        required=required,
    )
    group.add(
        "--hold",
        "inputs between the knots of FILE: linearly interpolated (linear), or constant from each "
        "knot to the next (previous). The default is the setting in FILE or, if there is none, "
        "linear",
        choices=("linear", "previous"),
    )
    group.switch(
        "--strict", "report an error if the trajectory in FILE violates the dynamics of the robot"
    )


def models_along(arguments: argparse.Namespace, robot: Robot | None = None) -> LinearTrajectory:
    """Return the linear models along the trajectory in the arguments."""
    from fflin.linear.linear_trajectory import linearize_trajectory
    from fflin.linear.trajectory import Trajectory

    point = ("joint", "velocity", "effort", "equilibrium", "rpy", "position")
    refuse(arguments, point, "with --trajectory, the models are about the points of the trajectory")
    robot = robot or load_robot(arguments)
    settings = {"hold": arguments.hold, "frame": arguments.frame}
    motion = Trajectory.load(arguments.trajectory, robot, **settings)
    return linearize_trajectory(robot, motion, strict=arguments.strict)


def _tvlqr(arguments: argparse.Namespace) -> Report:
    """Design a time-varying linear quadratic regulator along a trajectory.

    example: fflin tvlqr planar_detumble --trajectory plan.csv --hold previous --sample 0.1 -o
    gains.npz
    """
    from fflin.robot.inputs import Thruster

    why = "along a trajectory no reduced model is needed, because the finite-horizon cost exists"
    refuse(arguments, ("reduce",), why)
    along = models_along(arguments)
    schedule = schedule_of(along, arguments, once("--qf", arguments.qf) or "steady")
    text = str(schedule)
    if any(isinstance(each, Thruster) for each in along.robot.inputs):
        text += f"\n{folded([_NOT_ALLOCATED])}"
    return Report(along.robot.name, schedule, text, {arguments.output_file: schedule.save})


def schedule_of(
    along: LinearTrajectory, arguments: argparse.Namespace, Qf: Any = "steady"
) -> GainSchedule:
    """Return the regulator along a trajectory for the weights in the arguments."""
    from fflin.control.default_weights import pace_along
    from fflin.control.tvlqr import steady_end, tvlqr
    from fflin.control.weights import rule_weights

    settings: dict[str, Any] = {"sample": arguments.sample, "weights": arguments.weights}
    if given := weights_of(arguments):
        pace = pace_along(float(along.t[-1] - along.t[0]), arguments.sample or 0.0)
        Q, R, _, rule = rule_weights(steady_end(along), arguments.weights, given, pace=pace)
        settings |= {"Q": Q, "R": R, "weights": None, "rule": rule}
    return tvlqr(along, Qf=Qf, **settings)
