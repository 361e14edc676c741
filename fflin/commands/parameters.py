"""The commands that say what masses, springs and thrusters change, and that let them vary."""

from __future__ import annotations

import argparse
from typing import Any

from fflin.commands import DONE
from fflin.commands.arguments import (
    Commands,
    add_options,
    add_output_file,
    add_point,
    add_robot,
    add_system,
    command,
    number,
)
from fflin.commands.points import linear_model, load_robot, once, placed


def add_commands(commands: Commands) -> None:
    """Add sensitivity and uncertain."""
    sensitivity = command(
        *(commands, "sensitivity", _sensitivity),
        "show or save what masses, inertias, springs and thrusters change of A and B",
        "fflin sensitivity servicer_7dof --joint joint_2=0.6 --top 10 -o changes.mat",
    )
    add_point(sensitivity)
    add_options(
        sensitivity,
        """
        --dt H: of the model sampled, with inputs held over H [s]
        --top N = 15: the N that change most; 15 by default""",
    )
    add_output_file(sensitivity, "save dA, dB, df0 over each parameter: .npz, .mat or .json")
    uncertain = command(
        *(commands, "uncertain", _uncertain),
        "show or save the model at rest as an exact fraction of parameters in ranges",
        "fflin uncertain servicer_7dof --vary base.mass=0.2 --vary panel_left.stiffness=80:120 "
        "-o uncertain.mat",
    )
    add_robot(uncertain)
    add_options(uncertain, "--joint NAME=VALUE*: put a joint at VALUE [rad|m]; others at neutral")
    add_system(uncertain)
    vary = """--vary NAME=RANGE*: a parameter of `fflin sensitivity` or a pattern, and its range:
        0.2, a share of its value, or LEAST:LARGEST"""
    add_options(uncertain, vary, type=_range, required=True)
    add_output_file(uncertain, "save A, B1 .. D22 and the blocks: .npz, .mat or .json")


def _range(text: str) -> tuple[str, Any]:
    name, separator, value = text.rpartition("=")
    if not separator or not name or value.count(":") > 1:
        raise argparse.ArgumentTypeError(f"'{text}' is not NAME=SHARE or NAME=LEAST:LARGEST")
    ends = tuple(map(number, value.split(":")))
    return name, ends if ":" in value else ends[0]


def _sensitivity(arguments: argparse.Namespace) -> int:
    from fflin.uncertainty.sensitivity import sensitivity

    _check_output(arguments)
    _, lin = linear_model(arguments)
    found = sensitivity(lin.discretize(arguments.dt) if arguments.dt is not None else lin)
    print(found.table(arguments.top))
    if arguments.output_file:
        found.save(arguments.output_file)
        print(f"wrote {arguments.output_file}: {len(found.names)} parameters")
    return DONE


def _uncertain(arguments: argparse.Namespace) -> int:
    from fflin.uncertainty.uncertain import uncertain

    _check_output(arguments)
    robot = load_robot(arguments)
    lft = uncertain(robot, once("--vary", arguments.vary)).lft(
        placed(robot, "--joint", arguments.joint)
    )
    print(lft)
    if arguments.output_file:
        lft.save(arguments.output_file)
        print(f"wrote {arguments.output_file}")
    return DONE


def _check_output(arguments: argparse.Namespace) -> None:
    if arguments.output_file:
        from fflin.base.record import FORMATS
        from fflin.base.writing import check_place

        check_place(arguments.output_file, FORMATS)
