"""The commands `lqr` and `export`, and the design options that other commands share."""

from __future__ import annotations

import argparse
import warnings
from dataclasses import replace
from typing import TYPE_CHECKING

from fflin.base.errors import EquilibriumError, FflinWarning, FileError, StabilizabilityError
from fflin.commands import options, parser
from fflin.commands.points import linear_model, once
from fflin.commands.results import Report, figure_of

if TYPE_CHECKING:
    from fflin.control.gain import Gain
    from fflin.linear.model import LinearModel


def add_commands(commands: parser.Commands) -> None:
    """Add lqr and export."""
    _add_lqr(commands)
    _add_export(commands)


def _add_lqr(commands: parser.Commands) -> None:
    lqr = parser.command(
        commands,
        "lqr",
        _lqr,
        "design a linear quadratic regulator; show gain, poles, residual and margins",
        example="fflin lqr canadarm2 -o gain.npz",
        common="joint velocity equilibrium inputs frame weights q r bryson sample reduce "
        "wheel-speeds output-file plot",
    )
    options.add_point(lqr)
    add_weights(lqr)
    options.add_output_file(lqr.group(parser.OUTPUT), "the gain", parser.RECORD, "Gain")
    options.add_figure(lqr, "the poles, and the loop of each input with its margins,")


def _add_export(commands: parser.Commands) -> None:
    export = parser.command(
        commands,
        "export",
        _export,
        "write C99 code of a gain, compensator or gain schedule, with a test program",
        example="fflin export gain.npz --robot servicer_7dof --limits urdf -o flight",
    )
    what = "gain, compensator or gain schedule saved by fflin: .npz, .mat or .json"
    export.add_argument("file", metavar="FILE", type=parser.input_file, help=what)
    group = export.group(parser.OUTPUT)
    folder = "folder of the code; it is made if necessary"
    group.add_argument("-o", "--output-folder", metavar="FOLDER", required=True, help=folder)
    group.add(
        "--robot",
        "robot that the design was made for: a name in `fflin robots`, a URDF or a robot.toml. By "
        "default the robot that FILE names",
        metavar="ROBOT",
        type=parser.input_name,
    )
    limits = "limit the inputs as in simulate (urdf), or not (none, default)"
    group.add("--limits", limits, choices=("urdf", "none"), default="none")
    group.add("--name", "prefix of the names in C", metavar="NAME", default="controller")
    real = "type of the numbers; double by default"
    group.add("--real", real, choices=("double", "float"), default="double")


def add_weights(command: parser.Command, *, integrated: bool = False) -> None:
    """Add the options of the cost, the sample time and the regulated states.

    If a loop is `integrated`, --dt is its integration step; otherwise it is the former --sample.
    """
    group = command.group(parser.CONTROLLER)
    group.add(
        "--weights",
        "rule that sets all weights not given by --q, --r or --bryson. `urdf` (default) keeps the "
        "inputs within the limits of the URDF for displacements of 30 deg of the base and 0.3 rad "
        "of the joints; `identity` sets every weight to 1",
        choices=("urdf", "identity"),
    )
    group.add(
        "--q",
        "weight on states: a name, a group or a pattern, such as q_m.joint_1, q_b, q_m.hinge_*",
        parser.assignment,
        "NAME=W",
        repeatable=True,
    )
    group.add(
        "--r",
        "weight on inputs: a name, a group or a pattern, such as tau_b, tau_m.hinge_*",
        parser.assignment,
        "NAME=W",
        repeatable=True,
    )
    group.add(
        "--bryson",
        "largest acceptable value of a state, an input or a group, which gets the weight "
        "1/VALUE^2. The other weights, from the rule, are scaled to match",
        parser.assignment,
        repeatable=True,
    )
    group.add(
        "--sample",
        "sample time of the controller [s]: inputs are held for H; the continuous-time cost is "
        "still minimised",
        float,
        "H",
    )
    if not integrated:
        options.add_former_name(group, "--dt", "sample")
    group.switch(
        "--reduce",
        "if momentum is conserved, regulate only the states that the inputs can control",
    )
    group.yes_or_no(
        "--wheel-speeds",
        "whether to return the speeds of reaction wheels to their values at the operating point. "
        "By default, they are returned if thrusters or a base torque can absorb the wheel torque. "
        "--wheel-speeds also returns the combinations of wheel speeds that exert no net torque on "
        "the robot (redundant wheels)",
    )


def regulated_part(lin: LinearModel, arguments: argparse.Namespace) -> LinearModel:
    """Return the model of the design; with --reduce, its controllable part."""
    if not arguments.reduce:
        return lin
    from fflin.analysis.reduction import momentum_reduction

    return momentum_reduction(lin, wheel_speeds=arguments.wheel_speeds)


def gain_of(lin: LinearModel, arguments: argparse.Namespace) -> Gain:
    """Return the regulator of the weights; warn if its margins are small."""
    from fflin.control.default_weights import rule_weights
    from fflin.control.gain import fragility
    from fflin.control.lqr import lqr, require_fixed_point

    try:
        require_fixed_point(lin)
    except EquilibriumError as error:
        # --equilibrium balances forces, but a moving base is not a fixed point.
        given = arguments.equilibrium or arguments.relative_equilibrium or lin.v.any()
        more = ", --relative-equilibrium" if lin.frame in ("lvlh", "hill") else ""
        raise EquilibriumError(str(error) if given else f"{error} (--equilibrium{more})") from None
    if arguments.sample is not None:
        lin = lin.discretize(arguments.sample)
    try:
        given = {key: once(f"--{key}", getattr(arguments, key)) for key in ("q", "r", "bryson")}
        speeds = arguments.wheel_speeds
        if any(given.values()):
            *weights, rule = rule_weights(lin, arguments.weights, given, wheel_speeds=speeds)
            gain = replace(lqr(lin, *weights, wheel_speeds=speeds), weights=rule)
        else:
            gain = lqr(lin, weights=arguments.weights, wheel_speeds=speeds)
    except StabilizabilityError as error:
        hint = " (--reduce)" if "momentum_reduction" in str(error) else ""
        raise StabilizabilityError(f"{error}{hint}") from None
    if fragile := fragility(gain):
        warnings.warn(fragile, FflinWarning, stacklevel=2)
    return gain


def _lqr(arguments: argparse.Namespace) -> Report:
    from fflin.control.gain import one_sided

    _, lin = linear_model(arguments)
    gain = gain_of(regulated_part(lin, arguments), arguments)
    if pulling := one_sided(gain):  # a simulation reports how much of it is cut
        warnings.warn(pulling, FflinWarning, stacklevel=2)
    files = {arguments.output_file: gain.save, arguments.plot: figure_of("plot_loops", gain)}
    return Report(gain.robot, gain, str(gain), files)


def _export(arguments: argparse.Namespace) -> Report:
    from fflin.commands.cli import kind_of
    from fflin.control.gain import Gain
    from fflin.control.gain_schedule import GainSchedule
    from fflin.control.kalman import Compensator
    from fflin.export.writing import write_c
    from fflin.robot.loading import load

    kinds = {kind.__name__: kind for kind in (Gain, GainSchedule, Compensator)}
    kind = kind_of(arguments.file)
    if kind not in kinds and arguments.file.is_file():
        raise FileError(
            f"{arguments.file} holds {kind or 'no result of fflin'}, expected a Gain, a "
            "GainSchedule or a Compensator"
        )
    law = kinds.get(kind, Gain).load(arguments.file)
    folder = write_c(
        law,
        arguments.output_folder,
        robot=load(arguments.robot) if arguments.robot else None,
        limits=None if arguments.limits == "none" else arguments.limits,
        name=arguments.name,
        real=arguments.real,
    )
    name, real = arguments.name, arguments.real
    test = f"cc -std=c99 -o {name}_test {name}.c {name}_test.c -lm && ./{name}_test"
    text = f"{law!r} in C99, with numbers of type {real}\nto test it in {folder}: {test}"
    return Report(law.robot, {"name": name, "real": real, "folder": str(folder)}, text)
