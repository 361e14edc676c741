"""The command `sweep`: linear models about many points."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fflin.base.errors import FileError, InputError, MissingPackageError
from fflin.commands import options, parser
from fflin.commands.points import configuration_of, load_robot, once, refuse, velocity_of
from fflin.commands.results import Report

if TYPE_CHECKING:
    from concurrent.futures import Executor

    import pinocchio as pin

    from fflin.base.process import Progress
    from fflin.base.validation import Array
    from fflin.batch.configurations import Configurations
    from fflin.robot.robot import Robot

_DASK_TIMEOUT = 10  # seconds


def add_commands(commands: parser.Commands) -> None:
    """Add sweep."""
    sweep = parser.command(
        commands,
        "sweep",
        _sweep,
        "linearise about many points and save all models",
        example="fflin sweep servicer_7dof --grid joint_2=-1:1:21 --grid joint_4=-2:0:11 "
        "-o grid.h5",
        common="grid random configurations seed range joint velocity inputs output frame engine "
        "workers output-file",
    )
    points = sweep.group(
        "points",
        "give --grid, --random or --configurations. The default velocity of all points is the "
        "velocity in [point] of robot.toml, or zero",
    )
    points.add(
        "--grid",
        "N values of a joint [rad|m] from LO to HI. With several joints, the points are all "
        "combinations, and the last joint varies fastest",
        _axis,
        "JOINT=LO:HI:N",
        repeatable=True,
    )
    drawn = "N points, uniformly distributed within the joint limits"
    points.add("--random", drawn, int)
    points.add(
        "--configurations",
        "file of numpy.savez with q (N, nq) in Pinocchio's order, and optionally v (N, nv) and u "
        "(N, nu)",
        Path,
        "FILE.npz",
    )
    points.add("--seed", "random seed of --random", parser.whole, "S", default=0)
    points.add(
        "--range",
        "range of a joint [rad|m] for --random; replaces the joint limits",
        _range,
        "JOINT=LO:HI",
        repeatable=True,
    )
    point = sweep.group(parser.POINT)
    options.add_pose(point)
    point.add(
        "--effort",
        "value of an input at all points. NAME is the name of the input in u, such as "
        "tau_m.joint_1",
        parser.assignment,
        repeatable=True,
    )
    options.add_frame(point)
    options.add_reference(point)
    options.add_robot(sweep)
    options.add_system(sweep)
    work = sweep.group("computation")
    work.add(
        "--engine",
        "compute the points in compiled code or in Python. The default is compiled if numba is "
        "installed and the outputs are the state",
        choices=("compiled", "python"),
    )
    workers = "distribute the work over N processes; at most one per core"
    work.add("--workers", workers, int)
    dask = "distribute the work over the workers of a dask scheduler"
    work.add("--dask", dask, metavar="ADDRESS")
    what = "the models (after an interruption, the same command resumes from FILE.part)"
    options.add_output_file(sweep.group(parser.OUTPUT), what, parser.ROWS, required=True)


def _parts(text: str, form: str, example: str) -> tuple[str, list[str]]:
    """Split JOINT=A:B:... into the name and the values of the form."""
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
    import pinocchio as pin

    from fflin.batch.store import check_room, part_of, readable
    from fflin.batch.sweep import planned_bytes, sweep

    path = arguments.output_file
    robot = load_robot(arguments)
    reference = pin.SE3.Identity() if arguments.reference == "world" else None
    settings: dict[str, Any] = {"frame": arguments.frame, "reference": reference}
    q, v, u = _points(robot, arguments)
    size = planned_bytes(robot, len(q), at_rest=v is None and u is None, **settings)
    check_room(len(q), size, path)
    part = part_of(path)
    resuming = f", resuming from {part}" * part.exists()
    with executor_of(arguments) as executor:
        # All options are valid.
        said = f"fflin: {len(q):,} points of '{robot.name}', {readable(size)} to {path}{resuming}"
        print(said, file=sys.stderr)
        with going_on(path, "points") as progress:
            work = {name: getattr(arguments, name) for name in ("engine", "workers")}
            work |= {"executor": executor, "progress": progress}
            batch = sweep(robot, q, v, u, **settings, **work, out=path)
    states, inputs = len(batch.state_names), len(batch.input_names)
    text = f"{robot.name}: {len(batch):,} points, {states} states, {inputs} inputs"
    names = ("state_names", "state_units", "input_names", "input_units", "frame")
    result = {"points": len(batch), **{name: getattr(batch, name) for name in names}}
    return Report(robot.name, result, text, {path: None})


def _points(
    robot: Robot, arguments: argparse.Namespace
) -> tuple[Array | Configurations, Array | None, Array | None]:
    """Return q, v and u of the points."""
    import numpy as np

    from fflin.batch.configurations import as_configurations, grid, random_configurations
    from fflin.dynamics.points import effort
    from fflin.robot.joints import by_joint

    file = arguments.configurations
    if [bool(arguments.grid), arguments.random is not None, file is not None].count(True) != 1:
        raise InputError(
            "the points of the sweep are not defined; give exactly one of --grid, --random and "
            "--configurations"
        )
    if arguments.range and arguments.random is None:
        raise InputError("--range needs --random; --grid has its own ranges")
    if file:
        refuse(arguments, ("joint", "rpy", "position"), "--configurations contains q")
        given = _given(file)
        for name, option in (("v", "velocity"), ("u", "effort")):
            if name in given:
                refuse(arguments, (option,), f"{file} contains {name}")
    # A file of configurations has its own velocities.
    v = velocity_of(robot, arguments, {} if file else robot.point, "velocity")
    u = effort(robot, once("--effort", arguments.effort)) if arguments.effort else None
    if file:
        return as_configurations(robot, given["q"]), given.get("v", v), given.get("u", u)
    fixed = once("--joint", arguments.joint)
    base = _base(robot, configuration_of(robot, arguments, robot.point))
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


def _base(robot: Robot, q: Array) -> pin.SE3:
    import pinocchio as pin

    return robot.model.jointPlacements[1] * pin.XYZQUATToSE3(q[:7])


def _given(path: Path) -> dict[str, Array]:
    from fflin.base.record import decoded, reading
    from fflin.base.writing import read_file

    with reading(path, "npz file", by="numpy.savez"):
        arrays, _ = decoded(".npz", read_file(path, ".npz"))
    given: dict[str, Array] = {key: arrays[key] for key in ("q", "v", "u") if key in arrays}
    if "q" not in given:
        raise FileError(f"{path}: contains no array q; save the configurations as q (N, nq)")
    if given["q"].ndim != 2:
        raise InputError(f"{path}: q has shape {given['q'].shape}, expected (N, nq)")
    return given


@contextmanager
def going_on(path: Path | None, what: str) -> Iterator[Progress]:
    """Yield the progress bar; after Ctrl-C report the progress and the saved part."""
    from fflin.base.process import Progress
    from fflin.batch.store import part_of

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


@contextmanager
def executor_of(arguments: argparse.Namespace) -> Iterator[Executor | None]:
    """Yield the executor of a dask scheduler, or None without an address."""
    address = arguments.dask
    if address is None:
        yield None
        return
    if arguments.workers:
        raise InputError("--workers and --dask both distribute the work; give only one of them")
    try:
        from distributed import Client
    except ImportError:
        raise MissingPackageError(
            "--dask needs distributed; install it with: pip install 'fflin[dask]'"
        ) from None
    try:
        client = Client(address, timeout=_DASK_TIMEOUT)
    except (OSError, ValueError) as error:
        said = " ".join(str(error).split())
        raise InputError(f"no dask scheduler answers at '{address}': {said}") from None
    with client:
        yield client.getexecutor_of()
