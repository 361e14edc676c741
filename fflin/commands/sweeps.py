"""The command that linearises about many points."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fflin.base.errors import FileError, InputError, MissingPackageError
from fflin.commands import DONE
from fflin.commands.arguments import (
    Commands,
    add_options,
    add_output_file,
    add_pose,
    add_reference,
    add_robot,
    add_system,
    command,
    count_of,
    number,
)
from fflin.commands.points import configuration_of, load_robot, once, velocity_of

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from fflin.base.validation import Array
    from fflin.batch.configurations import Configurations
    from fflin.robot.robot import Robot

# Beyond this the user is asked whether it is meant.
_LARGE = 10e9

_DASK_TIMEOUT = 10  # seconds


def add_commands(commands: Commands) -> None:
    """Add sweep."""
    sweep = command(
        *(commands, "sweep", _sweep),
        "linearise about many points and save them all",
        "fflin sweep servicer_7dof --grid joint_2=-1:1:21 --grid joint_4=-2:0:11 -o grid.h5",
    )
    add_robot(sweep)
    points = sweep.add_argument_group("points", "one of these; at rest, unless --velocity says so")
    add_options(
        points,
        """--grid JOINT=LO:HI:N*: N values of a joint [rad|m] from LO to HI; of several joints all
            combinations, the last one varies fastest""",
        type=_axis,
    )
    add_options(
        points,
        """
        --random N: N points drawn evenly from the joints' limits
        --configurations FILE.npz: q (N, nq) in Pinocchio's order, as numpy.savez writes it, and if
            it has them v (N, nv) and u (N, nu)
        --seed S = 0: of --random; 0 by default""",
    )
    ranges = "--range JOINT=LO:HI*: of --random: range of a joint in place of its limits"
    add_options(points, ranges, type=_range)
    add_pose(sweep)
    add_options(
        sweep,
        "--effort NAME=VALUE*: an input at all points, by its name in u, such as tau_m.joint_1",
    )
    add_system(sweep)
    add_reference(sweep)
    add_options(
        sweep,
        """
        --workers N: share the work among N processes, at most one for each core
        --dask ADDRESS: share it among the workers of a dask scheduler
        --yes: do not stop at results of more than 10 GB""",
    )
    add_output_file(
        sweep,
        "save to FILE: .h5 (HDF5) or .npz; it grows as FILE.part, and the same command goes on "
        "from what is there",
        "LinearBatch",
    )


def _parts(text: str, form: str, example: str) -> tuple[str, list[str]]:
    """Split JOINT=A:B:... into its name and as many values as its form has."""
    name, _, values = text.rpartition("=")
    parts = values.split(":")
    if not name or len(parts) != len(form.split(":")):
        raise argparse.ArgumentTypeError(f"'{text}' is not {form}, as in {example}")
    return name, parts


def _axis(text: str) -> tuple[str, tuple[float, float, int]]:
    name, parts = _parts(text, "JOINT=LO:HI:N", "joint_1=-1:1:21")
    low, high, count = number(parts[0]), number(parts[1]), count_of(parts[2])
    if not (low < high or (count == 1 and low == high)):
        raise argparse.ArgumentTypeError(f"'{text}' is empty: LO must be less than HI")
    return name, (low, high, count)


def _range(text: str) -> tuple[str, tuple[float, float]]:
    name, (low, high) = _parts(text, "JOINT=LO:HI", "joint_1=-1:1")
    return name, (number(low), number(high))


def _sweep(arguments: argparse.Namespace) -> int:
    import pinocchio as pin

    from fflin.batch.store import check_room, output_path, part_of, readable
    from fflin.batch.sweep import planned_bytes, sweep
    from fflin.dynamics.points import effort

    path = arguments.output_file
    if path is None:
        raise InputError("-o says where the models go: a file .h5 or .npz")
    output_path(path)
    robot = load_robot(arguments)
    v = velocity_of(robot, arguments)
    u = effort(robot, once("--effort", arguments.effort)) if arguments.effort else None
    reference = pin.SE3.Identity() if arguments.reference == "world" else None
    options: dict[str, Any] = {"frame": arguments.frame, "reference": reference}
    said = ""

    def announce(count: int, *, at_rest: bool) -> None:
        nonlocal said
        output_path(path)  # once more, when the inputs are known
        size = planned_bytes(robot, count, at_rest=at_rest, **options)
        said = f"{count:,} points of '{robot.name}', {readable(size)}"
        if size > _LARGE and not arguments.yes:
            raise InputError(f"{said}: add --yes where it is meant, or choose fewer points")
        check_room(count, size, path)
        part = part_of(path)
        said += f" to {path}" + f", going on from {part}" * part.exists()

    q, v, u = _points(robot, arguments, v, u, announce)
    with executor_of(arguments) as executor:
        print(f"fflin: {said}", file=sys.stderr)  # all that was asked for is found good
        with going_on(path, "points") as progress:
            work = {"executor": executor, "workers": arguments.workers, "progress": progress}
            batch = sweep(robot, q, v, u, **options, **work, out=path)
    states, inputs = len(batch.state_names), len(batch.input_names)
    print(f"wrote {path}: {len(batch):,} points, {states} states, {inputs} inputs")
    return DONE


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

    kinds = [bool(arguments.grid), arguments.random is not None, bool(arguments.configurations)]
    if sum(kinds) != 1:
        raise InputError("give the points by one of --grid, --random and --configurations")
    if arguments.range and arguments.random is None:
        raise InputError("--range is of --random; a grid has its own")
    if arguments.configurations:
        if arguments.joint:
            raise InputError("--joint and --configurations both place joints; give either")
        if arguments.rpy or arguments.position:
            raise InputError("--rpy, --position and --configurations all place the base; give one")
        given = _given(arguments.configurations)
        for name, value in (("v", v), ("u", u)):
            if name in given and value is not None:
                raise InputError(f"{arguments.configurations} has {name}, which an option says too")
        v, u = given.get("v", v), given.get("u", u)
        announce(len(given["q"]), at_rest=v is None and u is None)
        return as_configurations(robot, given["q"]), v, u
    start = configuration_of(robot, arguments)
    fixed = once("--joint", arguments.joint)
    base = _base(robot, start)
    at_rest = v is None and u is None
    if arguments.random is not None:
        ranges = once("--range", arguments.range)
        twice = sorted(set(ranges) & set(fixed))
        if twice:
            raise InputError(f"joint '{twice[0]}' is in --joint and in --range; give either")
        ranges |= {name: (value, value) for name, value in fixed.items()}
        drawn = random_configurations(
            robot, arguments.random, seed=arguments.seed, ranges=ranges, base=base
        )
        announce(arguments.random, at_rest=at_rest)
        return drawn, v, u
    axes = once("--grid", arguments.grid)
    for name in axes:
        robot.joint(name)
    # Counted before it is made.
    announce(math.prod(count for _, _, count in axes.values()), at_rest=at_rest)
    values = {name: np.linspace(*axis) for name, axis in axes.items()}
    return grid(robot, values, joints=fixed, base=base), v, u


def _base(robot: Robot, q: Array) -> Any:
    import pinocchio as pin

    return robot.model.jointPlacements[1] * pin.XYZQUATToSE3(q[:7])


def _given(path: Path) -> dict[str, Array]:
    import io
    import warnings

    import numpy as np

    from fflin.base.writing import read_file, reason

    content = io.BytesIO(read_file(path, ".npz"))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of headers that damage makes look old
            with np.load(content, allow_pickle=False) as file:
                given = {key: file[key] for key in ("q", "v", "u") if key in file.files}
    except Exception as error:  # each decoder of what may stand in a zip archive has its own
        raise FileError(
            f"{path}: not an npz file as numpy.savez writes it ({reason(error)})"
        ) from None
    if "q" not in given:
        raise FileError(f"{path}: has no array named q, the configurations (N, nq)")
    if given["q"].ndim != 2:
        raise InputError(f"{path}: q has shape {given['q'].shape}, expected (N, nq)")
    return given


@contextmanager
def going_on(path: Path | None, what: str) -> Iterator[Callable[[int, int], None]]:
    """Yield what shows the progress to a file; say of Ctrl-C how far it came and what is kept."""
    from fflin.base.progress import Progress
    from fflin.batch.store import part_of

    bar, reached = Progress(), [0, 0]

    def update(done: int, total: int) -> None:
        reached[:] = done, total
        bar.update(done, total)

    try:
        yield update
    except KeyboardInterrupt:
        said = "stopped" if not reached[1] else "stopped at {:,} of {:,} ".format(*reached) + what
        if not path:
            said += "; nothing is kept, which -o FILE would do"
        elif part_of(path).exists():
            said += f"; the same command goes on from {part_of(path)}"
        raise KeyboardInterrupt(said) from None
    finally:
        bar.close()


@contextmanager
def executor_of(arguments: argparse.Namespace) -> Iterator[Executor | None]:
    """Yield the executor of a dask scheduler, or None where there is no address."""
    address = arguments.dask
    if address is None:
        yield None
        return
    if arguments.workers:
        raise InputError("--workers and --dask both share the work; give either")
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
