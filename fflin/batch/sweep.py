"""Sweep: linear models about many points."""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Iterable, Mapping
from concurrent.futures import Executor
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin

from fflin.base import __version__
from fflin.base.record import content_digest
from fflin.base.validation import Array, frozen
from fflin.batch.chunks import ChunkJob
from fflin.batch.configurations import (
    Configurations,
    GivenConfigurations,
    as_configurations,
    content,
)
from fflin.batch.files import FileStore, MemoryStore, output_path
from fflin.batch.linear_batch import AT_ROOT, LinearBatch, fields_of_model
from fflin.batch.rows import Points, checked_inputs, checked_velocities, column
from fflin.batch.run import Progress, check_workers, executor_of, failure, run_chunks
from fflin.kernel.compiled import available_cores
from fflin.robot.joints import ROOT
from fflin.robot.robot import Robot

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from fflin.dynamics.state import Frame

# Size of a chunk's result: large enough that computing it takes much longer than sending it, and
# small enough that several of them fit in memory.
_CHUNK_BYTES, _LEAST_CHUNK_BYTES = 4 * 2**20, 2**21
_LEAST_CHUNK, _LARGEST_CHUNK = 16, 2**16

# Least number of chunks, so that all workers finish at about the same time.
_SHARES = 32

_log = logging.getLogger("fflin")


def sweep(
    robot: Robot,
    q: ArrayLike | Configurations,
    v: ArrayLike | None = None,
    u: ArrayLike | None = None,
    *,
    frame: Frame | None = None,
    reference: pin.SE3 | None = None,
    moving: bool = False,
    engine: str | None = None,
    executor: Executor | None = None,
    workers: int | None = None,
    threads: int | None = None,
    chunk: int | None = None,
    progress: Progress | None = None,
    out: str | Path | None = None,
) -> LinearBatch:
    r"""Linearise a robot about many points.

    If numba is installed (``pip install 'fflin[fast]'``), a compiled kernel processes groups of
    eight points on all threads. If the robot is at rest and no springs, gravity or other forces
    act, only :math:`B = [0;\, M^{-1}]` depends on the point, so the kernel computes nothing else.
    The kernel also supports operating points in motion. Without numba, or if the robot has outputs
    other than its state, a `Linearizer` processes the points one by one. With `executor` or
    `workers`, the points are distributed over worker processes.

    Parameters
    ----------
    robot : Robot
    q : array_like (N, nq), Grid or RandomConfigurations
        Configurations in Pinocchio's order; see `grid` and `random_configurations`.
    v : array_like (N, nv) or (nv,), optional
        Velocities in Pinocchio's order; at rest by default.
    u : array_like (N, nu) or (nu,), optional
        Inputs of the robot; zero by default.
    frame, reference, moving : optional
        See `Linearizer`. By default the reference is the base pose at each point.
    engine : {"python", "compiled"}, optional
        Engine that linearises the points. The default is "compiled" if numba is installed and the
        robot's outputs are its state; otherwise the default is "python".
    executor : concurrent.futures.Executor, optional
        Executor whose workers process the chunks: a process pool, a dask executor
        (``Client.get_executor()``) or an executor of mpi4py.futures. `sweep` does not shut down the
        executor.
    workers : int, optional
        Number of worker processes to start, at most one per core. Each worker imports the main
        module, so call `sweep` under ``if __name__ == "__main__":``.
    threads : int, optional
        Number of threads of the compiled code; by default one for each available core.
    chunk : int, optional
        Number of points in a chunk. By default, the number is chosen such that the result of a
        chunk takes about 4 MB. A resumed sweep uses the chunk size of its unfinished file.
    progress : callable, optional
        Function ``progress(done, total)``, called after every chunk with the numbers of finished
        points and of all points.
    out : str or Path, optional
        File to write, .h5 or .npz. For .h5, chunks are first written to NAME.part. After a crash,
        the same call resumes with the intact chunks in NAME.part.

    Returns
    -------
    LinearBatch
        Models in the order of q. If `out` is an .h5 file, arrays are read from the file on
        demand.

    Raises
    ------
    InputError
        If a size or value is wrong (the message names the row), or the requested compiled engine
        is not available.
    UnknownNameError
        If the engine does not exist.
    SweepError
        If a point cannot be linearised, or a worker dies. The message names the chunks;
        `SweepError.batch` or the file contains the results of the other chunks.
    FileError
        If the file cannot be written.
    MissingPackageError
        If h5py is needed and not installed.

    Warns
    -----
    FflinWarning
        If M is ill-conditioned at some points. A single warning states how many points are
        affected.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> points = fflin.grid(robot, {"joint_1": np.linspace(-1, 1, 5), "joint_2": [0.0, 0.5]})
    >>> batch = fflin.sweep(robot, points)
    >>> len(batch), batch[3].B.shape
    (10, (18, 9))
    """
    check_workers(executor, workers, threads, chunk, progress)
    path = None if out is None else output_path(out)
    points = as_configurations(robot, q)
    job = ChunkJob(
        robot,
        at_rest=v is None and u is None,
        engine=engine,
        frame=frame,
        reference=reference,
        moving=moving,
    )
    task = SweepTask(job, points, v, u)
    parallel = executor is not None or workers is not None
    threads = threads or available_cores()
    shares = (_SHARES, 1) if parallel else (4 * threads, threads)
    store = _store(task, path, chunk or _chunk_size(task, *shares))
    with closing(store), executor_of(executor, workers) as others:
        if others is None and not job.compiled:
            threads = 1
        failed = run_chunks(
            job, task.points, store, executor=others, threads=threads, progress=progress
        )
        if failed:
            raise failure(
                failed, store, "configurations", lambda kept: _in_memory(task, store)[kept]
            )
        return _finish(task, store, path)


def planned_bytes(robot: Robot, count: int, **options: Any) -> int:
    """Return the size [bytes] of a sweep's result over `count` points; see `ChunkJob`."""
    return count * _row_bytes(ChunkJob(robot, moving=False, **options))


def _row_bytes(job: ChunkJob) -> int:
    return 8 * (job.linearizer.robot.nq + sum(map(math.prod, job.shapes.values())))


def _chunk_size(task: SweepTask, shares: int, threads: int) -> int:
    """Return the number of points per chunk that gives all threads equally many chunks."""
    row = _row_bytes(task.job)
    size = min(_CHUNK_BYTES, max(_LEAST_CHUNK_BYTES, row * task.count // shares)) // row
    size = min(max(size, _LEAST_CHUNK), _LARGEST_CHUNK)
    chunks = math.ceil(math.ceil(task.count / size) / threads) * threads
    return math.ceil(task.count / chunks / _LEAST_CHUNK) * _LEAST_CHUNK


def _store(task: SweepTask, path: Path | None, size: int) -> FileStore | MemoryStore:
    given, shapes = task.given(), {**task.job.shapes, "q": (task.robot.nq,)}
    if path is None or path.suffix == ".npz":
        held = {key: shape for key, shape in shapes.items() if key not in given}
        return MemoryStore(task.count, size, held)
    shapes |= {key: rows.shape[1:] for key, rows in given.items()}
    constants = task.constants(shapes)
    texts = task.texts(constants)
    store = FileStore(path, task.request, task.count, size, shapes, constants, texts)
    if store.resumed:
        _log.info("resuming from %s", store.part)
    return store


def _finish(task: SweepTask, store: FileStore | MemoryStore, path: Path | None) -> LinearBatch:
    if isinstance(store, FileStore):
        store.complete()
        # This call has just written the file, so its checksums are not verified.
        return replace(LinearBatch.load(store.path, task.robot, verify=False), verified=True)
    batch = _in_memory(task, store)
    if path is not None:
        batch.save(path)
    return batch


def _in_memory(task: SweepTask, store: FileStore | MemoryStore) -> LinearBatch:
    assert isinstance(store, MemoryStore)
    return task.batch(task.given() | store.arrays)


# Attributes that identify a robot, in addition to its model and its mappings.
_OF_THE_ROBOT = (
    *("name", "urdf_sha256", "locked", "joints", "followers"),
    *("inputs", "outputs", "gravity", "orbit"),
)


class SweepTask:
    """Points of a sweep, and the arrays of its result that are the same at all points."""

    def __init__(
        self,
        job: ChunkJob,
        configurations: Configurations,
        v: ArrayLike | None,
        u: ArrayLike | None,
    ) -> None:
        self.job, self.robot = job, job.linearizer.robot
        self.configurations, self.count = configurations, len(configurations)
        names = job.linearizer.prepared.actuation.names
        self.v = None if v is None else checked_velocities(self.robot, v, self.count)
        self.u = None if u is None else checked_inputs(names, u, self.count)

    def points(self, start: int, stop: int) -> Points:
        """Return points start to stop - 1."""
        v, u = (None if rows is None else rows[start:stop] for rows in (self.v, self.u))
        return Points(self.configurations.rows(start, stop), v, u)

    def given(self) -> dict[str, Array]:
        """Return the arrays that vary between points and are known before the sweep."""
        rows = {"v": self.v, "u0": self.u}
        if isinstance(self.configurations, GivenConfigurations):
            rows["q"] = self.configurations.q
        return {key: x for key, x in rows.items() if x is not None and x.strides[0] != 0}

    def constants(self, varying: Iterable[str]) -> dict[str, Array]:
        """Return one row of each array that is the same at all points."""
        prepared, root = self.job.linearizer.prepared, self.robot.model.jointPlacements[ROOT]
        rows: dict[str, Array] = {
            **prepared.rest,
            "C": prepared.common["C"],
            "D": prepared.common["D"],
            "_root": AT_ROOT if root.isIdentity(0.0) else pin.SE3ToXYZQUAT(root),
        }
        if self.u is not None:
            rows["u0"] = self.u[0]
        if self.v is not None:
            rows["v"] = self.v[0]
        if not prepared.own_reference:
            rows["_reference"] = prepared.reference
        return {key: value for key, value in rows.items() if key not in varying}

    def batch(self, arrays: Mapping[str, Array]) -> LinearBatch:
        """Assemble a batch from the arrays that vary between points."""
        count = len(arrays["q"])
        rows: dict[str, Any] = dict.fromkeys(("_x0", "_y0", "_reference", "_drift"))
        for key, value in self.constants(arrays).items():
            rows[key] = np.broadcast_to(value, (count, *value.shape))
        for key, value in arrays.items():
            rows[key] = frozen(value.view())
        common = dict(self.job.linearizer.prepared.common)
        asked = fields_of_model(common)
        texts = {
            key: value for key, value in common.items() if key not in asked.keys() | {"C", "D"}
        }
        columns = tuple(map(column, self.robot.joints))
        return LinearBatch(**texts, **rows, columns=columns, _asked=asked)

    def texts(self, constants: Iterable[str]) -> dict[str, str]:
        """Return the strings that a file of the batch contains."""
        one = {key: np.empty((1, *shape)) for key, shape in self.job.shapes.items()}
        example = self.batch(one | {"q": self.points(0, 1).q})
        return {**example.header(self.count), "constant": json.dumps(list(constants))}

    @property
    def request(self) -> str:
        """Digest of everything on which the result depends."""
        robot, prepared = self.robot, self.job.linearizer.prepared
        inertias = [inertia.toDynamicParameters() for inertia in robot.model.inertias]
        placements = [placement.homogeneous for placement in robot.model.jointPlacements]
        settings = [getattr(robot, key) for key in _OF_THE_ROBOT]
        settings += [dict(getattr(robot, key)) for key in ("stiffness", "damping", "rest")]
        settings += [prepared.map.frame, prepared.moving, prepared.own_reference]
        settings += [self.job.only_inertia, __version__, pin.__version__, self.count]
        rows = {"v": self.v, "u": self.u}
        return content_digest(
            {
                "robot": repr(settings),
                "model": np.concatenate([np.ravel(each) for each in (*inertias, *placements)]),
                "reference": prepared.reference,
                **{key: "none" if value is None else value for key, value in rows.items()},
                **{f"of q: {key}": value for key, value in content(self.configurations).items()},
            }
        )
