"""The command `init`: write a first robot file."""

from __future__ import annotations

import argparse
import os
import warnings
from pathlib import Path

from fflin.base.errors import FileError, InputError
from fflin.commands import DONE
from fflin.commands.arguments import (
    Commands,
    add_options,
    add_output_file,
    command,
    input_name,
)


def add_commands(commands: Commands) -> None:
    """Add init."""
    init = command(
        *(commands, "init", _init),
        "write a first robot.toml from a URDF: inputs, limits, joints without a motor",
        "fflin init my.urdf && fflin simulate my.toml",
    )
    init.add_argument(
        "robot",
        metavar="URDF",
        type=input_name,
        help="path of a URDF, or name of a robot in `fflin robots`",
    )
    add_output_file(init, "output file; by default the name of the URDF with .toml, in this folder")
    add_options(init, "--force: replace an existing file")


def _init(arguments: argparse.Namespace) -> int:
    from fflin.base.writing import check_place, write_whole
    from fflin.robot.catalog import find_robot
    from fflin.robot.draft import draft
    from fflin.robot.loading import load

    found = find_robot(arguments.robot)
    if found.path.suffix.lower() == ".toml":
        raise InputError(f"{found.path} is already a robot file; give a URDF")
    target = arguments.output_file or Path(f"{found.name}.toml")
    check_place(target, (".toml",))
    if target.exists() and not arguments.force:
        raise FileError(f"{target} already exists; give another name with -o, or add --force")
    urdf = found.name
    if found.origin == "file":
        urdf = os.path.relpath(os.path.realpath(found.path), os.path.realpath(target.parent))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        robot = load(arguments.robot)
    write_whole({target: draft(robot, urdf).encode()})
    load(target)  # warns of settings that the file leaves open
    print(f"init: wrote {target}; try: fflin simulate {target}")
    return DONE
