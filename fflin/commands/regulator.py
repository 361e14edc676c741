"""Commands `lqr`, `tvlqr` and `export`, and designs of regulators for other commands."""

from __future__ import annotations

import warnings
from argparse import Namespace
from dataclasses import replace

import fflin
from fflin.base.errors import (
    EquilibriumError,
    FflinWarning,
    InputError,
    StabilizabilityError,
    UnknownNameError,
)
from fflin.base.tables import folded
from fflin.commands.points import linear_model, load_robot, models_along, once, refuse
from fflin.commands.results import Report

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


def robot_of_design(
    robot: fflin.Robot,
    allocate: bool | None,
    law: fflin.Gain | fflin.GainSchedule | fflin.Compensator | None = None,
) -> fflin.Robot:
    """Return the robot of a design; with allocation, base torque and force replace the thrusters.

    By default, thrusters are allocated if they can push in every direction, unless the controller
    in a file was designed for other inputs.
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
    """Return the robot, the robot of the design, the regulated model, and the regulator."""
    robot = load_robot(arguments)
    design = robot_of_design(robot, arguments.allocate)
    lin = regulated_part(linear_model(arguments, design)[1], arguments)
    return robot, design, lin, gain_of(lin, arguments, allocated=design is not robot)


def weights_of(arguments: Namespace) -> dict[str, dict[str, float]]:
    """Return the weights of --q, --r and --bryson, or {} if none of these options is given."""
    names = ("q", "r", "bryson")
    given = {name: once(f"--{name}", getattr(arguments, name)) for name in names}
    return given if any(given.values()) else {}


def regulated_part(lin: fflin.LinearModel, arguments: Namespace) -> fflin.LinearModel:
    """Return the model for the design: the controllable part of `lin` if --reduce is given."""
    if not arguments.reduce:
        return lin
    return fflin.momentum_reduction(lin, wheel_speeds=arguments.wheel_speeds)


def gain_of(lin: fflin.LinearModel, arguments: Namespace, *, allocated: bool = False) -> fflin.Gain:
    """Return the regulator for the weights in the arguments; warn if its margins are small."""
    from fflin.control.gain import fragility, one_sided
    from fflin.control.lqr import require_fixed_point
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
        if weights := weights_of(arguments):
            *QRN, rule = rule_weights(lin, arguments.weights, weights, wheel_speeds=speeds)
            gain = replace(fflin.lqr(lin, *QRN, wheel_speeds=speeds), weights=rule)
        else:
            gain = fflin.lqr(lin, weights=arguments.weights, wheel_speeds=speeds)
    except UnknownNameError as error:
        hint = "; --no-allocate weights single thrusters" * allocated
        raise UnknownNameError(f"{error}{hint}") from None
    except StabilizabilityError as error:
        hint = " (--reduce)" if "momentum_reduction" in str(error) else ""
        raise StabilizabilityError(f"{error}{hint}") from None
    for text in filter(None, (fragility(gain), one_sided(gain))):
        warnings.warn(text, FflinWarning, stacklevel=2)
    return gain


def schedule_of(
    along: fflin.LinearTrajectory, arguments: Namespace, Qf: str | dict[str, float] = "steady"
) -> fflin.GainSchedule:
    """Return the regulator along a trajectory for the weights in the arguments."""
    sample = arguments.sample
    if not (given := weights_of(arguments)):
        return fflin.tvlqr(along, Qf=Qf, sample=sample, weights=arguments.weights)
    from fflin.control.default_weights import pace_along
    from fflin.control.tvlqr import steady_end
    from fflin.control.weights import rule_weights

    pace = pace_along(float(along.t[-1] - along.t[0]), sample or 0.0)
    Q, R, _, rule = rule_weights(steady_end(along), arguments.weights, given, pace=pace)
    return fflin.tvlqr(along, Q, R, Qf, sample, rule=rule)
