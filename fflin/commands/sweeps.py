"""The command `sweep`: linear models about many points."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fflin.base.errors import FileError, InputError, MissingPackageError
from fflin.commands import options, parser
from fflin.commands.points import configuration_of, load_robot, once, velocity_of
from fflin.commands.results import Report

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from fflin.base.process import Progress
    from fflin.base.validation import Array
    from fflin.batch.configurations import Configurations
    from fflin.robot.robot import Robot

# Larger results [B] need --yes.
_LARGE = 10e9

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
        "workers yes output-file",
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
    work.switch("--yes", "permit results of more than 10 GB")
    what = "the models (after an interruption, the same command resumes from FILE.part)"
    options.add_output_file(sweep.group(parser.OUTPUT), what, parser.ROWS, "LinearBatch")


def _parts(text: str, form: str, example: str) -> tuple[str, list[str]]:
    """Split JOINT=A:B:... into the name and the values of the form."""
    name, _, values = text.rpartition("=")
    parts = values.split(":")
    if not name or len(parts) != len(form.split(":")):
        raise argparse.ArgumentTypeError(f"'{text}' is not of the form {form}, such as {example}")
    return name, parts


def _axis(text: str) -> tuple[str, tuple[float, float, int]]:
    name, parts = _parts(text, "JOINT=LO:HI:N", "joint_1=-1:1:21")
    low, high, count = (
        parser.number(parts[0]),
        parser.number(parts[1]),
        parser.count_of(parts[2]),
    )
    if not (low < high or (count == 1 and low == high)):
        raise argparse.ArgumentTypeError(f"'{text}' is empty; LO must be less than HI")
    return name, (low, high, count)


def _range(text: str) -> tuple[str, tuple[float, float]]:
    name, (low, high) = _parts(text, "JOINT=LO:HI", "joint_1=-1:1")
    return name, (parser.number(low), parser.number(high))


def _sweep(arguments: argparse.Namespace) -> Report:
    import pinocchio as pin

    from fflin.batch.files import output_path, part_of
    from fflin.batch.sweep import planned_bytes, sweep
    from fflin.dynamics.points import effort

    path = arguments.output_file
    if path is None:
        raise InputError("-o is missing; give a file .h5 or .npz for the models")
    robot = load_robot(arguments)
    # A file of configurations has its own velocities.
    at_rest: dict[str, Any] = {}
    v = velocity_of(
        robot, arguments, at_rest if arguments.configurations else robot.point, "velocity"
    )
    u = effort(robot, once("--effort", arguments.effort)) if arguments.effort else None
    reference = pin.SE3.Identity() if arguments.reference == "world" else None
    settings: dict[str, Any] = {"frame": arguments.frame, "reference": reference}
    said = ""

    def announce(count: int, *, at_rest: bool) -> None:
        nonlocal said
        output_path(path)  # again, when the inputs are known
        size = planned_bytes(robot, count, at_rest=at_rest, **settings)
        scale, unit = (1e9, "GB") if size >= 1e9 else (1e3, "kB")
        said = f"{count:,} points of '{robot.name}', {size / scale:,.1f} {unit}"
        if size > _LARGE and not arguments.yes:
            raise InputError(
                f"{said}: this is more than 10 GB; add --yes to permit it, or choose fewer points"
            )
        part = part_of(path)
        said += f" to {path}" + f", resuming from {part}" * part.exists()

    q, v, u = _points(robot, arguments, v, u, announce)
    with executor_of(arguments) as executor:
        print(f"fflin: {said}", file=sys.stderr)  # all options are valid
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
    robot: Robot,
    arguments: argparse.Namespace,
    v: Array | None,
    u: Array | None,
    announce: Callable[..., None],
) -> tuple[Array | Configurations, Array | None, Array | None]:
    """Return q, v and u of the points."""
    import numpy as np

    from fflin.batch.configurations import as_configurations, grid, random_configurations
    from fflin.robot.joints import by_joint

    kinds = [bool(arguments.grid), arguments.random is not None, bool(arguments.configurations)]
    if sum(kinds) != 1:
        raise InputError(
            "the points of the sweep are not defined; give exactly one of --grid, --random and "
            "--configurations"
        )
    if arguments.range and arguments.random is None:
        raise InputError("--range needs --random; --grid has its own ranges")
    if arguments.configurations:
        if arguments.joint:
            raise InputError(
                "--joint and --configurations both set joint positions; give only one of them"
            )
        if arguments.rpy or arguments.position:
            raise InputError(
                "--rpy or --position is given with --configurations, which also sets the base "
                "pose; give only one of them"
            )
        given = _given(arguments.configurations)
        for name, value in (("v", v), ("u", u)):
            if name in given and value is not None:
                raise InputError(
                    f"{arguments.configurations} contains {name}, and an option gives it too; "
                    "leave the option out"
                )
        v, u = given.get("v", v), given.get("u", u)
        announce(len(given["q"]), at_rest=v is None and u is None)
        return as_configurations(robot, given["q"]), v, u
    fixed = once("--joint", arguments.joint)
    base = _base(robot, configuration_of(robot, arguments, robot.point))
    at_rest = v is None and u is None
    if arguments.random is not None:
        ranges = once("--range", arguments.range)
        twice = sorted(set(ranges) & set(fixed))
        if twice:
            raise InputError(
                f"joint '{twice[0]}' is in --joint and in --range; give only one of them"
            )
        ranges |= {name: (value, value) for name, value in fixed.items()}
        drawn = random_configurations(
            robot, arguments.random, seed=arguments.seed, ranges=ranges, base=base
        )
        announce(arguments.random, at_rest=at_rest)
        return drawn, v, u
    axes = once("--grid", arguments.grid)
    for name in axes:
        robot.joint(name)
    # The points are counted before the grid is created.
    announce(math.prod(count for _, _, count in axes.values()), at_rest=at_rest)
    values = {name: np.linspace(*axis) for name, axis in axes.items()}
    joints = {**robot.point.get("joints", {}), **by_joint(fixed, robot.joint_names, robot.joint)}
    others = {name: x for name, x in joints.items() if name not in axes or name in fixed}
    return grid(robot, values, joints=others, base=base), v, u


def _base(robot: Robot, q: Array) -> Any:
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
