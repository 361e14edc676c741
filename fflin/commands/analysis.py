"""The command that says what inputs move, what is conserved, how it vibrates, what is seen."""

from __future__ import annotations

import argparse
import textwrap
from typing import TYPE_CHECKING

from fflin.commands import DONE
from fflin.commands.arguments import Commands, add_point, command
from fflin.commands.points import linear_model
from fflin.errors import InputError

if TYPE_CHECKING:
    from fflin.linear_model import LinearModel


def add_commands(commands: Commands) -> None:
    """Add analyze."""
    analyze = command(
        commands,
        "analyze",
        _analyze,
        "show what the inputs can move, what is conserved, the modes, and what the outputs show",
        "fflin analyze servicer_7dof --stiffness panel_left=100 --output joints",
    )
    add_point(analyze)


def _analyze(arguments: argparse.Namespace) -> int:
    from fflin.eigenmodes import modes
    from fflin.observation import observability
    from fflin.structure import controllability

    _, lin = linear_model(arguments)
    for title, text in (
        ("inputs", str(controllability(lin))),
        ("momentum", _momentum(lin)),
        ("modes", str(modes(lin))),
        ("outputs", str(observability(lin))),
    ):
        print(f"{title}\n{'-' * len(title)}\n{text}\n")
    return DONE


def _momentum(lin: LinearModel) -> str:
    from fflin.momentum import momentum_reduction
    from fflin.tables import width

    try:
        reduced = momentum_reduction(lin)
    except InputError as error:
        text = f"no reduction: {error}"
    else:
        count, left = len(reduced.momenta), len(reduced.A)
        text = "none is conserved: the inputs, springs and dampers act on all of them"
        if count:
            text = (
                f"{count} momenta are conserved whatever the inputs do; without them and what "
                f"they drive {left} states are left"
            )
        elif not lin.is_equilibrium():
            text = "none can be split off: the model is one of a point that moves on"
    return textwrap.fill(text, width())
