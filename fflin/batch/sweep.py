"""Sweep: linear models about many points."""

from __future__ import annotations

import logging
import math
from concurrent.futures import Executor
from contextlib import closing, nullcontext
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pinocchio as pin

from fflin.base.errors import FileError
from fflin.base.record import NoRoomError
from fflin.batch.chunks import ChunkJob
from fflin.batch.configurations import Configurations, as_configurations
from fflin.batch.linear_batch import LinearBatch
from fflin.batch.run import Progress, check_workers, failure, run_chunks
from fflin.batch.store import FileStore, MemoryStore, check_room, output_path
from fflin.batch.task import SweepTask
from fflin.batch.workers import OwnWorkers
from fflin.kernel.compiled import available_cores
from fflin.robot.robot import Robot

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from fflin.dynamics.state import Frame

# Size of a chunk's result: large enough that sending it costs little beside computing it, small
# enough that a handful of them fit in memory.
_CHUNK_BYTES, _LEAST_CHUNK_BYTES = 4 * 2**20, 2**21
_LEAST_CHUNK, _LARGEST_CHUNK = 16, 2**16

# Number of chunks that workers share, so that all workers end at about the same time.
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
    eight points on all threads. At rest M depends only on the joint positions, and
    :math:`B = [0;\, M^{-1}]`. The kernel also supports operating points in motion. Without numba,
    or if the robot has outputs other than its state, a `Linearizer` processes the points one by
    one. These points can be distributed over worker processes.

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
        Compiled by default if numba is installed and the outputs are the state.
    executor : concurrent.futures.Executor, optional
        Executor whose workers process the chunks: processes, dask (``Client.get_executor()``) or
        mpi4py.futures. The robot is sent to each worker once. The executor is not shut down.
    workers : int, optional
        Number of worker processes to start, at most one per core. A process that dies is replaced.
        With workers, call `sweep` under ``if __name__ == "__main__":``.
    threads : int, optional
        Number of threads of the compiled code; by default one for each available core.
    chunk : int, optional
        Number of points in a chunk. By default the result of a chunk takes about 4 MB. A resumed
        sweep uses the chunk size of its unfinished file.
    progress : callable, optional
        Function ``progress(done, total)``, called after every chunk with the number of finished
        points and the number of all points.
    out : str or Path, optional
        File to write, .h5 or .npz. Chunks are first written to NAME.part. After a crash, repeat
        the same call: it resumes with the intact chunks of that file.

    Returns
    -------
    LinearBatch
        Models in the order of q. If `out` is an .h5 file, arrays are read from it on demand.

    Raises
    ------
    InputError
        If a size or value is wrong; the message names the row. Also if the compiled engine is
        requested and not available.
    UnknownNameError
        If the engine does not exist.
    SweepError
        If a point cannot be linearised, or a worker dies repeatedly. The message names the chunk;
        `SweepError.batch` or the file holds the other chunks.
    FileError, MissingPackageError
        If the file cannot be written.

    Warns
    -----
    FflinWarning
        If M is ill-conditioned; one warning states at how many points.

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
    options: Any = {"frame": frame, "reference": reference, "moving": moving}
    job = ChunkJob(robot, at_rest=v is None and u is None, engine=engine, **options)
    check_room(len(points), len(points) * _row_bytes(job), path)
    task = SweepTask(job, points, v, u)
    parallel = executor is not None or workers is not None
    threads = threads or available_cores()
    shares = (_SHARES, 1) if parallel else (4 * threads, threads)
    store = _store(task, path, chunk or _chunk_size(task, *shares))
    with closing(store), OwnWorkers(int(workers)) if workers else nullcontext(executor) as others:
        if others is None and not (job.compiled and robot.n):
            threads = 1  # without joints there is but one M
        failed = run_chunks(
            job, task.points, store, executor=others, threads=threads, progress=progress
        )
        if failed:
            raise failure(
                failed, store, "configurations", lambda kept: _in_memory(task, store)[kept]
            )
        return _finish(task, store, path)


def planned_bytes(
    robot: Robot,
    count: int,
    *,
    at_rest: bool,
    frame: Frame | None = None,
    reference: pin.SE3 | None = None,
) -> int:
    """Return how large the result of a sweep over so many points is [bytes]."""
    options: Any = {"frame": frame, "reference": reference, "moving": False}
    return count * _row_bytes(ChunkJob(robot, at_rest=at_rest, **options))


def _row_bytes(job: ChunkJob) -> int:
    return 8 * (job.linearizer.robot.nq + sum(map(math.prod, job.shapes.values())))


def _chunk_size(task: SweepTask, shares: int, threads: int) -> int:
    """Return how many points a chunk has, so that all threads have as many chunks."""
    row = _row_bytes(task.job)
    size = min(_CHUNK_BYTES, max(_LEAST_CHUNK_BYTES, row * task.count // shares)) // row
    size = min(max(size, _LEAST_CHUNK), _LARGEST_CHUNK)
    chunks = math.ceil(math.ceil(task.count / size) / threads) * threads
    return math.ceil(task.count / chunks / _LEAST_CHUNK) * _LEAST_CHUNK


def _store(task: SweepTask, path: Path | None, size: int) -> FileStore | MemoryStore:
    given, shapes = task.given(), {**task.job.shapes, "q": (task.robot.nq,)}
    if path is None or (path.suffix == ".npz" and find_spec("h5py") is None):
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
    if isinstance(store, MemoryStore):
        batch = _in_memory(task, store)
        if path is not None:
            batch.save(path)
        return batch
    store.complete()
    if store.path.suffix != ".npz":
        return _written(store.path, task)
    try:
        _written(store.part, task).save(store.path)
        batch = _written(store.path, task)
    except (MemoryError, NoRoomError):
        raise FileError(
            f"{store.path}: not enough memory to write .npz; the complete result is in "
            f"{store.part}, an HDF5 file: rename it to end in .h5, and give out= an .h5 file next "
            "time"
        ) from None
    store.part.unlink()
    return batch


def _in_memory(task: SweepTask, store: FileStore | MemoryStore) -> LinearBatch:
    assert isinstance(store, MemoryStore)
    return task.batch(task.given() | store.arrays)


def _written(path: Path, task: SweepTask) -> LinearBatch:
    """Read what was written here, which need not be held against its hashes."""
    return replace(LinearBatch.load(path, task.robot, verify=False), verified=True)
