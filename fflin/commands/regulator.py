"""The command that designs a regulator."""

from __future__ import annotations

import argparse
import warnings
from dataclasses import replace
from typing import TYPE_CHECKING

from fflin.base.errors import EquilibriumError, FflinWarning, StabilizabilityError
from fflin.commands import DONE
from fflin.commands.arguments import (
    Commands,
    Container,
    add_options,
    add_output_file,
    add_point,
    command,
)
from fflin.commands.points import linear_model, once
from fflin.commands.visual import add_figure, check_figure, draw

if TYPE_CHECKING:
    from fflin.control.gain import Gain
    from fflin.linear.model import LinearModel


def add_commands(commands: Commands) -> None:
    """Add lqr."""
    lqr = command(
        *(commands, "lqr", _lqr),
        "design the linear quadratic regulator: gain, poles, residual, margins",
        "fflin lqr canadarm2 -o gain.npz",
    )
    add_point(lqr)
    add_weights(lqr)
    add_output_file(lqr, "save the gain to FILE: .npz, .mat or .json", "Gain")
    add_figure(lqr, "draw the loop of each input with its margins, and the poles,")


def add_weights(command: Container) -> None:
    """Add what is regulated and at which cost: --q, --r, --bryson, --dt, --reduce and so on."""
    add_options(
        command,
        """
        --weights urdf|identity: what weighs what is not named: `urdf` (default), with which the
            inputs keep within the limits of the URDF where the base is turned by 30 deg and the
            joints by 0.3 rad, or `identity`, 1 on each
        --q NAME=W*: weight on states: a name, a group or a pattern, such as q_m.joint_1, q_b,
            q_m.hinge_*
        --r NAME=W*: weight on inputs: a name, a group or a pattern, such as tau_b, tau_m.hinge_*
        --bryson NAME=VALUE*: largest acceptable value of a state, an input or a group: its weight
            is 1/VALUE^2, and those of the rule are scaled alike
        --dt H: design for inputs held over H [s]; the cost stays the continuous one
        --reduce: regulate the part that the inputs can hold where momentum is conserved
        --[no-]wheel-speeds: bring the speeds of reaction wheels back to the point's: by default
            where thrusters or a torque on the base can make them; also those that turn nothing
            else, or none""",
    )


def regulated_part(lin: LinearModel, arguments: argparse.Namespace) -> LinearModel:
    """Return the model that a regulator is designed for: with --reduce, the part it can hold."""
    if not arguments.reduce:
        return lin
    from fflin.analysis.momentum import momentum_reduction

    return momentum_reduction(lin, wheel_speeds=arguments.wheel_speeds)


def gain_of(lin: LinearModel, arguments: argparse.Namespace) -> Gain:
    """Return the regulator that the weights say, and warn of one that bears little."""
    from fflin.control.gain import fragility
    from fflin.control.lqr import lqr, require_fixed_point
    from fflin.control.weight_rules import rule_weights

    try:
        require_fixed_point(lin)
    except EquilibriumError as error:
        # It balances forces; a base that moves stays no fixed point.
        given = arguments.equilibrium or arguments.relative_equilibrium or lin.v.any()
        more = ", --relative-equilibrium" if lin.frame in ("lvlh", "hill") else ""
        raise EquilibriumError(str(error) if given else f"{error} (--equilibrium{more})") from None
    if arguments.dt is not None:
        lin = lin.discretize(arguments.dt)
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


def _lqr(arguments: argparse.Namespace) -> int:
    check_figure(arguments.plot)
    _, lin = linear_model(arguments)
    if arguments.output_file:
        from fflin.base.record import FORMATS
        from fflin.base.writing import check_place

        check_place(arguments.output_file, FORMATS)
    from fflin.control.gain import one_sided

    gain = gain_of(regulated_part(lin, arguments), arguments)
    if pulling := one_sided(gain):  # a simulation says how much of it is cut
        warnings.warn(pulling, FflinWarning, stacklevel=2)
    if arguments.output_file:
        gain.save(arguments.output_file)
    print(gain)
    if arguments.output_file:
        print(f"\nwrote {arguments.output_file}")
    draw(arguments.plot, "plot_loops", gain)
    return DONE
