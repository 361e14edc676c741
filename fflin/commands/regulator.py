"""The command that designs a regulator."""

from __future__ import annotations

import argparse
from contextlib import suppress
from typing import TYPE_CHECKING

from fflin.base.errors import EquilibriumError, InputError, StabilizabilityError, unknown
from fflin.commands import DONE
from fflin.commands.arguments import (
    Commands,
    add_output_file,
    add_point,
    add_values,
    command,
    number,
)
from fflin.commands.points import linear_model, once

if TYPE_CHECKING:
    from fflin.base.validation import Array
    from fflin.control.gain import Gain
    from fflin.linear.model import LinearModel


def add_commands(commands: Commands) -> None:
    """Add lqr."""
    lqr = command(
        commands,
        "lqr",
        _lqr,
        "design the linear quadratic regulator: gain, poles, residual, margins",
        "fflin lqr ets_vii --bryson q_b=0.05 --bryson tau_m=5 -o gain.npz",
    )
    add_point(lqr)
    add_weights(lqr)
    add_output_file(lqr, "save the gain to FILE: .npz, .mat or .json")


def add_weights(command: argparse.ArgumentParser) -> None:
    """Add what is regulated and at which cost: --q, --r, --bryson, --dt and --reduce."""
    add_values(
        command,
        "--q",
        "weight on a state or a group of them, such as q_b or q_m.joint_1; 1 by default; without "
        "any weight the cost is on states and accelerations, 1 on each",
        metavar="NAME=W",
    )
    add_values(
        command,
        "--r",
        "weight on an input or a group of them, such as tau_b; by default the squares of the "
        "accelerations that a unit of it gives the coordinates, each taken alone",
        metavar="NAME=W",
    )
    add_values(
        command,
        "--bryson",
        "largest acceptable value of a state, an input or a group: its weight is 1/VALUE^2",
    )
    command.add_argument(
        "--dt",
        metavar="H",
        type=number,
        help="design for inputs held over H [s]; the cost stays the continuous one",
    )
    command.add_argument(
        "--reduce",
        action="store_true",
        help="regulate the part that the inputs can hold where momentum is conserved",
    )


def regulated_part(lin: LinearModel, arguments: argparse.Namespace) -> LinearModel:
    """Return the model that a regulator is designed for: with --reduce, the part it can hold."""
    if not arguments.reduce:
        return lin
    from fflin.analysis.momentum import momentum_reduction

    return momentum_reduction(lin)


def gain_of(lin: LinearModel, arguments: argparse.Namespace) -> Gain:
    """Return the regulator that the weights say.

    Without any, a model of double integrators, as a driven robot at rest is, gets the cost on
    accelerations: its poles are of the order of 1/s whatever the robot weighs.
    """
    from fflin.control.acceleration_lqr import acceleration_lqr
    from fflin.control.lqr import lqr, require_fixed_point
    from fflin.control.sampled_cost import sampled_cost

    try:
        require_fixed_point(lin)
    except EquilibriumError as error:
        # It balances forces; a base that moves stays no fixed point.
        hint = "" if arguments.equilibrium or lin.v.any() else " (--equilibrium)"
        raise EquilibriumError(f"{error}{hint}") from None
    if not (arguments.q or arguments.r or arguments.bryson):
        with suppress(InputError, StabilizabilityError):
            return acceleration_lqr(lin, 1.0, 1.0, 1.0, dt=arguments.dt)
    Q, R = _weights(lin, arguments)
    try:
        if arguments.dt is None:
            return lqr(lin, Q, R)
        return lqr(lin.discretize(arguments.dt), *sampled_cost(lin, arguments.dt, Q, R))
    except StabilizabilityError as error:
        hint = " (--reduce)" if "momentum_reduction" in str(error) else ""
        raise StabilizabilityError(f"{error}{hint}") from None


def _weights(lin: LinearModel, arguments: argparse.Namespace) -> tuple[Array, Array]:
    """Return the diagonals of Q and R."""
    from fflin.control.weights import default_weights, inverse_square, named_weights

    values = {key: once(f"--{key}", getattr(arguments, key)) for key in ("q", "r", "bryson")}
    squares = {}
    for name, value in values["bryson"].items():
        squares[name] = inverse_square(f"largest value of '{name}' (--bryson)", value)
    known, states = (
        dict.fromkeys((*(name.partition(".")[0] for name in names), *names))
        for names in (lin.input_names, lin.state_names)
    )
    for name in squares:
        if name not in known and name not in states:
            raise unknown("state or input", name, (*states, *known))
    of_inputs = {name: value for name, value in squares.items() if name in known}
    of_states = {name: value for name, value in squares.items() if name not in known}
    both = [*(set(values["q"]) & set(of_states)), *(set(values["r"]) & set(of_inputs))]
    if both:
        raise InputError(f"'{both[0]}' has a weight and a largest value; give either")
    Q, R = default_weights(lin)
    return (
        named_weights("state", values["q"] | of_states, lin.state_names, Q),
        named_weights("input", values["r"] | of_inputs, lin.input_names, R),
    )


def _lqr(arguments: argparse.Namespace) -> int:
    _, lin = linear_model(arguments)
    if arguments.output_file:
        from fflin.base.record import FORMATS
        from fflin.base.writing import check_place

        check_place(arguments.output_file, FORMATS)
    gain = gain_of(regulated_part(lin, arguments), arguments)
    if arguments.output_file:
        gain.save(arguments.output_file)
    print(gain)
    if arguments.output_file:
        print(f"\nwrote {arguments.output_file}")
    return DONE
