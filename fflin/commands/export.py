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
    folder = "folder for the code; a missing folder is created"
    group.add_argument("-o", "--output-folder", metavar="FOLDER", required=True, help=folder)
    group.add(
        "--robot",
        "robot of the design: a name listed by `fflin robots`, or the path of a URDF or "
        "robot.toml. The default is the robot named in FILE",
        metavar="ROBOT",
        type=parser.input_name,
    )
    limits = (
        "urdf: saturate the inputs at the limits of the robot, as `fflin simulate` does; none "
        "(default): do not saturate the inputs"
    )
    group.add("--limits", limits, choices=("urdf", "none"), default="none")
    group.add("--name", "prefix of all names in the C code", metavar="NAME", default="controller")
    real = "floating-point type in the C code; double by default"
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
            f"{arguments.file} contains {kind or 'no result of fflin'}, expected a Gain, a "
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
