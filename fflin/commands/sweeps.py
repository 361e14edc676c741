"""Command `sweep`: linear models about many points."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fflin.base.errors import InputError
from fflin.commands import options, parser
from fflin.commands.points import configuration_of, load_robot, once, velocity_of
from fflin.commands.results import Report

if TYPE_CHECKING:
    from fflin.base.process import Progress
    from fflin.base.validation import Array
    from fflin.batch.configurations import Configurations
    from fflin.robot.robot import Robot


def add_commands(commands: parser.Commands) -> None:
    """Add sweep."""
    sweep = parser.command(
        commands,
        _sweep,
        "grid random seed range joint velocity inputs output frame engine workers output-file",
    )
    points = sweep.group(
        "points",
        "give --grid or --random. By default, all points have the velocity in [point] of "
        "robot.toml or, if there is none, zero velocity",
    )
    points.add(
        "--grid",
        "N values of a joint [rad|m] from LO to HI. With several joints, the points are all "
        "combinations, and the last joint varies fastest",
        _axis,
        "JOINT=LO:HI:N",
        repeatable=True,
    )
    drawn = "number of random points, uniformly distributed within the joint limits"
    points.add("--random", drawn, int)
    points.add("--seed", "random seed of --random", parser.whole, "S", default=0)
    points.add(
        "--range",
        "range of a joint [rad|m] for --random, in place of its joint limits",
        _range,
        "JOINT=LO:HI",
        repeatable=True,
    )
    point = sweep.group(parser.POINT)
    options.add_pose(point)
    options.add_effort(point, "at all points")
    options.add_frame(point)
    options.add_reference(point)
    options.add_robot(sweep)
    options.add_system(sweep)
    work = sweep.group("computation")
    work.add(
        "--engine",
        "compute the points in compiled code or in Python. By default, the code is compiled if "
        "numba is installed and the outputs are the state",
        choices=("compiled", "python"),
    )
    workers = "distribute the work over N processes; at most one per core"
    work.add("--workers", workers, int)
    what = "the models (with .h5, the same command resumes after an interruption)"
    options.add_output_file(
        sweep.group(parser.OUTPUT), what, parser.ROWS, "LinearBatch", required=True
    )


def _parts(text: str, form: str, example: str) -> tuple[str, list[str]]:
    """Split JOINT=A:B:... into the name and its values; `form` has the same number of values."""
    name, _, values = text.rpartition("=")
    parts = values.split(":")
    if not name or len(parts) != len(form.split(":")):
        raise argparse.ArgumentTypeError(f"'{text}' is not of the form {form}, such as {example}")
    return name, parts


def _axis(text: str) -> tuple[str, tuple[float, float, int]]:
    name, parts = _parts(text, "JOINT=LO:HI:N", "joint_1=-1:1:21")
    low, high, count = *map(parser.number, parts[:2]), parser.count_of(parts[2])
    if not (low < high or (count == 1 and low == high)):
        raise argparse.ArgumentTypeError(f"'{text}' is empty; LO must be less than HI")
    return name, (low, high, count)


def _range(text: str) -> tuple[str, tuple[float, float]]:
    name, (low, high) = _parts(text, "JOINT=LO:HI", "joint_1=-1:1")
    return name, (parser.number(low), parser.number(high))


def _sweep(arguments: argparse.Namespace) -> Report:
    """Linearise about many points and save all models.

    example: fflin sweep servicer_7dof --grid joint_2=-1:1:21 --grid joint_4=-2:0:11 -o grid.h5
    """
    import pinocchio as pin

    from fflin.batch.files import part_of
    from fflin.batch.sweep import planned_bytes, sweep

    path = arguments.output_file
    robot = load_robot(arguments)
    reference = pin.SE3.Identity() if arguments.reference == "world" else None
    settings: dict[str, Any] = {"frame": arguments.frame, "reference": reference}
    q, v, u = _points(robot, arguments)
    size = planned_bytes(robot, len(q), at_rest=v is None and u is None, **settings)
    part = part_of(path)
    resuming = f", resuming from {part}" * part.exists()
    needs = f"{size / 1e9:,.1f} GB" if size >= 1e9 else f"{size / 1e3:,.1f} kB"
    said = f"linearising '{robot.name}' about {len(q):,} points; {path} takes {needs}{resuming}"
    print(f"fflin: {said}", file=sys.stderr)  # all options are valid
    with going_on(path, "points") as progress:
        work = {"engine": arguments.engine, "workers": arguments.workers, "progress": progress}
        batch = sweep(robot, q, v, u, **settings, **work, out=path)
    states, inputs = len(batch.state_names), len(batch.input_names)
    text = f"{robot.name}: {len(batch):,} points, {states} states, {inputs} inputs"
    names = ("state_names", "state_units", "input_names", "input_units", "frame")
    result = {"points": len(batch), **{name: getattr(batch, name) for name in names}}
    return Report(robot.name, result, text, {path: None})


def _points(
    robot: Robot, arguments: argparse.Namespace
) -> tuple[Configurations, Array | None, Array | None]:
    """Return q, v and u of the points of a sweep."""
    import numpy as np
    import pinocchio as pin

    from fflin.batch.configurations import grid, random_configurations
    from fflin.dynamics.points import effort
    from fflin.robot.joints import by_joint

    if bool(arguments.grid) == (arguments.random is not None):
        raise InputError("a sweep needs exactly one of --grid and --random; give one of them")
    if arguments.range and arguments.random is None:
        raise InputError("--range needs --random; --grid has its own ranges")
    v = velocity_of(robot, arguments, robot.point, "velocity")
    u = effort(robot, once("--effort", arguments.effort)) if arguments.effort else None
    fixed = once("--joint", arguments.joint)
    q = configuration_of(robot, arguments, robot.point)
    base = robot.model.jointPlacements[1] * pin.XYZQUATToSE3(q[:7])
    if arguments.random is not None:
        ranges = once("--range", arguments.range)
        ranges |= {name: (value, value) for name, value in fixed.items()}
        drawn = {"seed": arguments.seed, "ranges": ranges, "base": base}
        return random_configurations(robot, arguments.random, **drawn), v, u
    axes = once("--grid", arguments.grid)
    for name in axes:
        robot.joint(name)
    values = {name: np.linspace(*axis) for name, axis in axes.items()}
    joints = {**robot.point.get("joints", {}), **by_joint(fixed, robot.joint_names, robot.joint)}
    others = {name: x for name, x in joints.items() if name not in axes or name in fixed}
    return grid(robot, values, joints=others, base=base), v, u


@contextmanager
def going_on(path: Path | None, what: str) -> Iterator[Progress]:
    """Show a progress bar; after Ctrl-C, report the progress and the file that can be resumed."""
    from fflin.base.process import Progress
    from fflin.batch.files import part_of

    bar = Progress()
    try:
        yield bar
    except KeyboardInterrupt:
        said = f"stopped at {bar.done:,} of {bar.total:,} {what}" if bar.total else "stopped"
        if not path:
            said += "; nothing is saved without -o FILE"
        elif part_of(path).exists():
            said += f"; the same command resumes from {part_of(path)}"
        raise KeyboardInterrupt(said) from None
    finally:
        bar.close()
