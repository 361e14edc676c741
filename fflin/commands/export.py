"""The command `export`, which writes C code of a control law."""

from __future__ import annotations

import argparse

from fflin.base.errors import FileError
from fflin.commands import parser
from fflin.commands.results import Report


def add_commands(commands: parser.Commands) -> None:
    """Add export."""
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
