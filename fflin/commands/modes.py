"""The command that shows natural modes."""

from __future__ import annotations

import argparse

from fflin.commands import DONE
from fflin.commands.arguments import Commands, add_point, command
from fflin.commands.points import linear_model


def add_commands(commands: Commands) -> None:
    """Add modes."""
    modes = command(
        commands,
        "modes",
        _modes,
        "show natural frequencies, damping ratios and time constants",
        "fflin modes servicer_7dof --stiffness panel_left=100 --stiffness panel_right=100",
    )
    add_point(modes)


def _modes(arguments: argparse.Namespace) -> int:
    from fflin.analysis.modes import modes

    _, lin = linear_model(arguments)
    print(modes(lin))
    return DONE
