"""Run a job on chunks of rows, and save the results in a store.

Chunks are computed by threads of this process, by worker processes that `Execution` starts, or by
the workers of a given executor. The job defines the content of the rows and of the results. Chunks
that the store contains from an earlier call are not computed again.
"""

from __future__ import annotations

import os
import pickle
import signal
import warnings
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from concurrent import futures
from contextlib import ExitStack, contextmanager
from functools import lru_cache, partial
from multiprocessing import get_context, parent_process
from threading import Lock, Thread, local
from typing import ParamSpec, Protocol, TypeAlias, TypeVar

import numpy as np

from fflin.base.errors import FflinError, FflinWarning, InputError, SweepError, listed
from fflin.base.process import Progress as ProgressBar
from fflin.base.process import on_terminal
from fflin.base.tables import counted
from fflin.base.validation import Array, whole
from fflin.batch.files import FileStore, MemoryStore
from fflin.kernel.compiled import available_cores

P = ParamSpec("P")
T = TypeVar("T")

# Largest number of submitted chunks per worker. With two, the next chunk of a worker is ready when
# the worker finishes a chunk.
_QUEUED = 2

# Assumed number of workers if an executor does not report how many it has.
_UNKNOWN_WORKERS = 16

Progress: TypeAlias = Callable[[int, int], object]

# Rows: {name: array}; the arrays have equal numbers of rows. RowsOf: function f(start, stop) that
# returns the rows start to stop - 1.
Rows: TypeAlias = Mapping[str, Array]
RowsOf: TypeAlias = Callable[[int, int], Rows]

# Span: (start, stop) of a chunk, whose rows are start to stop - 1. Result: computed arrays
# {name: array} of a chunk, and the warnings of the computation.
Span: TypeAlias = tuple[int, int]
Result: TypeAlias = tuple[Mapping[str, Array], list[str]]


class Job(Protocol):
    """Computation on rows. Workers receive a pickled job, and each worker unpickles it once."""

    shapes: dict[str, tuple[int, ...]]  # {name of a result array: shape of one row}
    threaded: bool  # whether threads of this process can compute chunks in parallel

    def run(self, rows: Rows, start: int, out: Mapping[str, Array], /) -> list[str]:
        """Write the results of the chunk that begins at row `start` into `out`; return warnings."""


class Execution(ExitStack):
    """Threads or executor that compute the chunks of jobs.

    The object is a context manager; on exit, it ends the worker processes that it started. The
    arguments are described in `sweep`. `InputError` is raised for an invalid argument.
    """

    def __init__(
        self,
        executor: futures.Executor | None = None,
        workers: int | None = None,
        threads: int | None = None,
        chunk: int | None = None,
        progress: Progress | None = None,
    ) -> None:
        if executor is not None and workers is not None:
            raise InputError(
                "executor and workers are both given; give only one of them"
            )
        if executor is not None and not hasattr(executor, "submit"):
            kind = type(executor).__name__
            raise InputError(
                f"executor has type {kind}, expected a concurrent.futures.Executor"
            )
        for name, value in (
            ("workers", workers),
            ("threads", threads),
            ("chunk", chunk),
        ):
            if value is not None:
                whole(name, value, 1)
        if progress is not None and not callable(progress):
            raise InputError(
                f"progress is {progress!r}, expected a function progress(done, total)"
            )
        super().__init__()
        self.progress = progress
        if progress is None and on_terminal():
            bar = ProgressBar()
            self.progress = bar
            self.callback(bar.close)
        self.executor = executor
        self._threads = threads or available_cores()
        if workers is not None:
            self.executor = self.enter_context(OwnWorkers(workers))

    def count(self, job: Job) -> int:
        """Return how many chunks of a job are computed in parallel."""
        if self.executor is None:
            if job.threaded:
                return self._threads
            return 1
        for name in ("_max_workers", "num_workers"):
            count = getattr(self.executor, name, None)
            if isinstance(count, int) and count > 0:
                return count
        threads = self._dask_threads()
        if threads is not None:
            return max(1, sum(threads.values()))
        return _UNKNOWN_WORKERS

    def workers(self) -> set[str]:
        """Return the addresses of the workers, if the executor is a Dask client's.

        Dask replaces lost workers and computes their chunks again without a message. Other
        executors raise an error.
        """
        return set(self._dask_threads() or {})

    def _dask_threads(self) -> dict[str, int] | None:
        """Return {address of a worker: number of threads}, or None if there is no Dask client."""
        client = getattr(self.executor, "_client", None)
        if client is None or not hasattr(client, "nthreads"):
            return None
        threads: dict[str, int] = client.nthreads()
        return threads


def run_chunks(
    job: Job,
    rows: RowsOf,
    store: FileStore | MemoryStore,
    how: Execution,
    progress: Progress | None = None,
    *,
    of_what: str = "rows",
    made: Callable[[dict[str, Array]], object] | None = None,
    upto: int | None = None,
) -> int:
    """Compute the missing chunks of a store, save the results, and return the number of kept rows.

    Kept rows are rows that the store contained before this call.

    The store saves the rows and results for which it has arrays. If `upto` is given, only chunks
    that begin before row `upto` are computed.

    If `made` is None, the first chunk that fails ends the call with `FflinError`. If `made` is
    given, the other chunks are still computed, and `SweepError` is raised at the end. For a store
    in memory, the attribute `batch` of this error is the result of ``made(arrays)``, where `arrays`
    contains the rows and results of the other chunks. If all chunks fail, `batch` is None.
    """
    left = list[Span]()
    done = 0
    for start in range(0, store.count, store.chunk):
        stop = min(start + store.chunk, store.count)
        if store.finished(start, stop):
            done += stop - start
        elif upto is None or start < upto:
            left.append((start, stop))
    kept = done
    if progress and done:
        progress(done, store.count)
    workers = how.workers()
    failed, notes = list[tuple[int, int, str]](), list[str]()
    for (start, stop), result in _results(job, rows, store, left, how):
        if isinstance(result, str):
            failed.append((start, stop, result))
        else:
            store.write(start, stop, {**rows(start, stop), **result[0]})
            notes += result[1]
        if failed and not made:
            raise FflinError(failed[0][2])
        done += stop - start
        if progress:
            progress(done, store.count)
    if notes:
        more = f" (and {len(notes) - 1} more such warnings)" if len(notes) > 1 else ""
        warnings.warn(notes[0] + more, FflinWarning, stacklevel=3)
    lost = workers - how.workers()
    if lost:
        warnings.warn(
            f"{counted(len(lost), 'worker')} of the executor ended during the call: "
            f"{listed(sorted(lost))}; other workers computed the chunks again",
            FflinWarning,
            stacklevel=3,
        )
    if failed and made:
        raise _failure(sorted(failed), store, of_what, made)
    return kept


def _results(
    job: Job,
    rows: RowsOf,
    store: FileStore | MemoryStore,
    spans: list[Span],
    how: Execution,
) -> Iterator[tuple[Span, Result | str]]:
    """Yield each chunk with its result, or with the reason why it failed."""

    def compute(start: int, stop: int) -> Result | str:
        out = store.view(start, stop, job.shapes)
        try:
            return out, job.run(rows(start, stop), start, out)
        except FflinError as error:
            return str(error)

    count = how.count(job)
    inside = how.executor is None
    if inside and (count == 1 or len(spans) == 1):
        for span in spans:
            yield span, compute(*span)
        return
    pool = how.executor or futures.ThreadPoolExecutor(count)
    pickled = b"" if inside else pickle.dumps(job)

    def submit(start: int, stop: int) -> futures.Future[Result | str]:
        if inside:
            return pool.submit(compute, start, stop)
        return pool.submit(work, pickled, rows(start, stop), start, stop)

    waiting, running = deque(spans), dict[futures.Future[Result | str], Span]()
    try:
        while waiting or running:
            # Submit only a few chunks at a time, because their results stay in memory until they
            # are saved.
            while waiting and len(running) < _QUEUED * count:
                span = waiting.popleft()
                try:
                    running[submit(*span)] = span
                except Exception as error:
                    # The pool is broken or shut down, or the executor raises its own exception
                    # type.
                    yield span, _reason(error)
            # threads: wait for the chunk that was submitted first
            ready = list(running)[:1]
            if not inside:
                ready = list(
                    futures.wait(running, return_when=futures.FIRST_COMPLETED).done
                )
            for future in ready:
                span = running.pop(future)
                try:
                    result = future.result()
                except (
                    Exception
                ) as error:  # each executor raises its own exception types
                    if inside:
                        raise
                    result = _reason(error)
                yield span, result
    finally:
        for future in running:
            future.cancel()
        if inside:
            # Do not wait for the threads, so that Ctrl-C ends the call even while a thread is
            # compiling the kernel.
            pool.shutdown(wait=False, cancel_futures=True)


def _reason(error: Exception) -> str:
    """Return the reason why a chunk failed."""
    if isinstance(error, FflinError):
        return str(error)
    return f"the executor failed: {type(error).__name__}: {error}".rstrip(": ")


def work(pickled: bytes, rows: Rows, start: int, stop: int) -> Result:
    """Run a pickled job on one chunk in a worker, and return the result of the chunk."""
    job = _unpickled(pickled)
    out = {key: np.empty((stop - start, *shape)) for key, shape in job.shapes.items()}
    return out, job.run(rows, start, out)


@lru_cache(maxsize=4)
def _unpickled(job: bytes) -> Job:
    """Unpickle a job. The cache keeps the job, so that a worker prepares each job only once."""
    # Only one thread at a time may change the warning filters, because all threads share them.
    with _TURN, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the caller has received these warnings
        result: Job = pickle.loads(job)
    return result


def _failure(
    failed: list[tuple[int, int, str]],
    store: FileStore | MemoryStore,
    of_what: str,
    made: Callable[[dict[str, Array]], object],
) -> SweepError:
    """Return a `SweepError` that lists the failed chunks; see `run_chunks`."""
    kept = np.zeros(store.count, dtype=bool)
    for start in range(0, store.count, store.chunk):
        stop = start + store.chunk
        kept[start:stop] = store.finished(start, min(stop, store.count))
    numbers = listed(f"{start} to {stop - 1}" for start, stop, _ in failed)
    verb = "has" if len(failed) == 1 else "have"
    message = (
        f"{len(failed)} of {-(-store.count // store.chunk)} chunks {verb} failed, {of_what} "
        f"{numbers}: {failed[0][2]}"
    )
    batch = None
    if not kept.any():
        store.discard()
    elif store.part is not None:
        message += (
            f"; the results of the other chunks are in {store.part}, and the same call resumes "
            "from this file"
        )
    else:
        batch = made({key: rows[kept] for key, rows in store.read(store.count).items()})
        message += (
            "; the results of the other chunks are in the attribute `batch` of this error. With "
            "out='NAME.h5' (-o NAME.h5), the results would be saved, and the same call would "
            "resume"
        )
    return SweepError(message, tuple(failed), batch)


class OwnWorkers(futures.ThreadPoolExecutor):
    """Executor with worker processes; if a process dies, its task fails and a new process starts.

    Each thread of the executor has its own pool of one process, because the death of a process
    stops all processes of its pool.
    """

    def __init__(self, count: int) -> None:
        cores = available_cores()
        if count > cores:
            message = (
                f"{count} workers requested, but only {cores} cores are available; "
                f"using {cores}"
            )
            warnings.warn(message, FflinWarning, stacklevel=4)
        super().__init__(min(count, cores))
        self._mine, self._lock = local(), Lock()
        self._pools: list[futures.ProcessPoolExecutor] = []
        self._ended = ""  # reason why no further process can start

    def submit(
        self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs
    ) -> futures.Future[T]:
        """Call a function in a worker process.

        If the process dies, the returned future raises `FflinError`.
        """
        return super().submit(self._do, partial(fn, *args, **kwargs))

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End the processes, even in the middle of a task."""
        # Do not join the threads, because a join could block forever. If Ctrl-C interrupts a wait
        # for a future, the future can stay locked. The thread that sets the result of this future
        # then never ends. All other threads end when their processes end.
        super().shutdown(wait=False, cancel_futures=cancel_futures)
        with self._lock:
            self._ended = "the workers have been shut down"
        for pool in self._pools:
            for process in list((pool._processes or {}).values()):
                process.terminate()
            pool.shutdown(wait)

    def _do(self, task: Callable[[], T]) -> T:
        pool = getattr(self._mine, "pool", None) or self._start()
        try:
            return pool.submit(task).result()
        except futures.BrokenExecutor:
            self._mine.pool = None
            raise FflinError(
                "a worker process died, for example because the memory was full"
            ) from None

    def _start(self) -> futures.ProcessPoolExecutor:
        """Start a process for this thread and wait until it is ready."""
        try:
            with self._lock:
                if self._ended:
                    raise FflinError(self._ended)
                with _starting():
                    # A forked process would inherit locks that other threads hold, and could wait
                    # for these locks forever.
                    pool = futures.ProcessPoolExecutor(
                        1, get_context("spawn"), _prepare
                    )
                    ready = pool.submit(int)
                self._pools.append(pool)
            ready.result()
            # Close the write end of the result pipe in this process; only the worker writes to the
            # pipe. If the worker dies while it sends a result, the read then fails immediately.
            # With an open write end, the read would wait forever for the rest of the result.
            pool._result_queue._writer.close()  # type: ignore[attr-defined]  # typeshed omits it
        except OSError as error:
            self._ended = f"no worker process can be started: {error}"
        except futures.BrokenExecutor:
            self._ended = (
                "a worker process did not start; make the call under "
                '`if __name__ == "__main__":`'
            )
        else:
            self._mine.pool = pool
            return pool
        raise FflinError(self._ended)


# Lock for `_starting` and `_unpickled`, which only one thread at a time may execute. `_starting`
# replaces a function of multiprocessing, and `_unpickled` changes the warning filters. Both changes
# affect all threads.
_TURN = Lock()


@contextmanager
def _starting() -> Iterator[None]:
    """Return a context in which new processes start isolated (``python -I``), with Ctrl-C blocked.

    Without ``-I``, a new process of multiprocessing searches the working folder for modules first,
    until it copies `sys.path` from its parent process. Worker processes may ignore Ctrl-C, because
    Ctrl-C also reaches the parent process, which then ends its workers.
    """
    from multiprocessing import resource_tracker, util

    names = vars(util)
    key = "_args_from_interpreter_flags"
    with _TURN:
        usual = names[key]
        names[key] = lambda: ["-I", *usual()]
        masked = getattr(signal, "pthread_sigmask", None)  # None on Windows
        if masked:
            # Start the resource tracker first, because its start unblocks SIGINT.
            resource_tracker.ensure_running()
            before = masked(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            yield
        finally:
            names[key] = usual
            if masked:
                masked(signal.SIG_SETMASK, before)


def _prepare() -> None:
    """Make a worker process ignore Ctrl-C, and end when its parent process ends."""
    caller = parent_process()
    assert caller is not None

    def end_with_the_caller() -> None:  # even in the middle of a task
        caller.join()
        os._exit(1)

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    Thread(target=end_with_the_caller, daemon=True).start()
