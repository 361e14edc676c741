"""Run a job on rows, chunk by chunk, into a store that may already contain chunks.

Chunks run on threads of this process, or on the workers of an executor. The job defines the meaning
of the rows and the results.
"""

from __future__ import annotations

import pickle
import warnings
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import (
    FIRST_COMPLETED,
    Executor,
    Future,
    ThreadPoolExecutor,
    wait,
)
from contextlib import AbstractContextManager, nullcontext
from functools import lru_cache
from typing import Any, NamedTuple, Protocol, TypeVar

import numpy as np

from fflin.base.errors import FflinError, FflinWarning, InputError, SweepError, listed
from fflin.base.validation import Array, Mask, whole
from fflin.batch.files import FileStore, MemoryStore
from fflin.batch.workers import NoWorkers, OwnWorkers, WorkerDied

# Chunks submitted per worker at a time, so that a worker never waits for its next chunk.
_QUEUED = 2

# Number of workers assumed if an executor does not report it.
_UNKNOWN_WORKERS = 16

Progress = Callable[[int, int], object]


class Rows(Protocol):
    """Arrays of equal length in a named tuple."""

    def _asdict(self) -> dict[str, Any]: ...


R_contra = TypeVar("R_contra", bound=Rows, contravariant=True)


class Span(NamedTuple):
    """Rows of a chunk, from start to stop - 1."""

    start: int
    stop: int


class ChunkResult(NamedTuple):
    """Result of a chunk: its arrays by name, and its warnings."""

    arrays: dict[str, Array]
    notes: list[str]


class Job(Protocol[R_contra]):
    """Computation on rows; it is pickled, and each worker unpickles it once."""

    @property
    def shapes(self) -> Mapping[str, tuple[int, ...]]:
        """Shape per row of each array that the job returns."""

    def run(
        self, rows: R_contra, start: int, out: Mapping[str, Array] | None = None, /
    ) -> ChunkResult:
        """Process the rows from `start` on into `out` or new arrays; may run on any thread."""


class Done(NamedTuple):
    """Finished chunk: its result, or the reason why it failed."""

    span: Span
    result: ChunkResult | None
    reason: str


def check_workers(
    executor: object, workers: object, threads: object, chunk: object, progress: object
) -> None:
    """Raise `InputError` if an option for the execution of the chunks is wrong."""
    if executor is not None and workers is not None:
        raise InputError("executor and workers are both given; give only one of them")
    if executor is not None and not hasattr(executor, "submit"):
        raise InputError(
            f"executor has type {type(executor).__name__}, expected a concurrent.futures.Executor"
        )
    for name, value in (("workers", workers), ("threads", threads), ("chunk", chunk)):
        if value is not None:
            whole(name, value, 1)
    if progress is not None and not callable(progress):
        raise InputError(f"progress is {progress!r}, expected a function progress(done, total)")


def run_chunks(
    job: Job[R_contra],
    rows: Callable[[int, int], R_contra],
    store: FileStore | MemoryStore,
    *,
    executor: Executor | None = None,
    threads: int = 1,
    progress: Progress | None = None,
    upto: int | None = None,
    all_needed: bool = False,
) -> list[Done]:
    """Compute the missing chunks of a store, save the results, and return failed chunks."""
    # `rows(start, stop)` returns a named tuple; the store saves the fields for which it has arrays.
    # Only chunks that begin before `upto` are computed. Without an executor, the chunks run on
    # `threads` threads of this process. If all chunks are needed, the run ends at the first
    # failure.
    size = store.chunk
    spans = [Span(at, min(at + size, store.count)) for at in range(0, store.count, size)]
    left = [span for span in spans if not store.finished(*span)]
    count = store.count - sum(stop - start for start, stop in left)
    left = [span for span in left if upto is None or span.start < upto]
    if progress and count:
        progress(count, store.count)
    failed: list[Done] = []
    notes: list[str] = []
    for done in (
        _run_here(job, rows, store, left, threads)
        if executor is None
        else _run_on_workers(job, rows, left, executor)
    ):
        if done.result is None:
            failed.append(done)
            if all_needed:
                break
        else:
            store.write(*done.span, {**rows(*done.span)._asdict(), **done.result.arrays})
            notes += done.result.notes
        count += done.span.stop - done.span.start
        if progress:
            progress(count, store.count)
    if notes:
        more = f" (and {len(notes) - 1} more such warnings)" if len(notes) > 1 else ""
        warnings.warn(notes[0] + more, FflinWarning, stacklevel=3)
    return sorted(failed)


def failure(
    failed: list[Done],
    store: FileStore | MemoryStore,
    of_what: str,
    made: Callable[[Mask], object],
) -> SweepError:
    """Return the error that lists the failed chunks."""
    kept = np.ones(store.count, dtype=bool)
    for (start, stop), *_ in failed:
        kept[start:stop] = False
    numbers = listed(f"{start} to {stop - 1}" for (start, stop), *_ in failed)
    message = (
        f"{len(failed)} of {-(-store.count // store.chunk)} chunks "
        f"{'has' if len(failed) == 1 else 'have'} failed, {of_what} {numbers}: "
        f"{failed[0].reason}"
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
        batch = made(kept)
        message += (
            "; the results of the other chunks are in the attribute `batch` of this error. With "
            "out='NAME.h5' (-o NAME.h5), the results would be saved, and the same call would "
            "resume"
        )
    return SweepError(message, tuple((*span, reason) for span, _, reason in failed), batch)


def _run_here(
    job: Job[R_contra],
    rows: Callable[[int, int], R_contra],
    store: FileStore | MemoryStore,
    spans: list[Span],
    threads: int,
) -> Iterator[Done]:
    def run(span: Span) -> Done:
        view = store.view(*span)
        out = None if view is None else {key: view[key] for key in job.shapes}
        try:
            return Done(span, job.run(rows(*span), span.start, out), "")
        except FflinError as error:
            return Done(span, None, str(error))

    if threads == 1 or len(spans) == 1:
        yield from map(run, spans)
        return
    pool, begun = ThreadPoolExecutor(threads), deque[Future[Done]]()
    try:
        for span in spans:
            begun.append(pool.submit(run, span))
            # Results wait in memory until they are consumed, so their number is limited.
            if len(begun) > threads:
                yield begun.popleft().result()
        while begun:
            yield begun.popleft().result()
    finally:
        # Do not wait for the threads, so that Ctrl-C can also interrupt a compilation.
        pool.shutdown(wait=False, cancel_futures=True)


def _run_on_workers(
    job: Job[R_contra], rows: Callable[[int, int], R_contra], spans: list[Span], executor: Executor
) -> Iterator[Done]:
    pickled, ahead = pickle.dumps(job), _QUEUED * worker_count(executor)
    waiting, running = deque(spans), dict[Future[ChunkResult], Span]()
    try:
        while waiting or running:
            while waiting and len(running) < ahead:
                span = waiting.popleft()
                try:
                    future = executor.submit(work, pickled, rows(*span), span.start)
                except Exception as error:  # broken, shut down, or specific to the executor
                    yield Done(span, None, _reason(error))
                else:
                    running[future] = span
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                span = running.pop(future)
                try:
                    done = Done(span, future.result(), "")
                except Exception as error:  # each executor raises its own types
                    done = Done(span, None, _reason(error))
                    if isinstance(error, NoWorkers):
                        yield from (Done(each, None, done.reason) for each in waiting)
                        waiting.clear()
                yield done
    finally:
        for future in running:
            future.cancel()


def _reason(error: Exception) -> str:
    """Return the reason why a chunk failed."""
    if isinstance(error, FflinError | WorkerDied | NoWorkers):
        return str(error)
    return f"the executor failed: {type(error).__name__}: {error}".rstrip(": ")


def executor_of(
    executor: Executor | None, workers: int | None
) -> AbstractContextManager[Executor | None]:
    """Return a context with the given executor, or with an executor whose processes end with it."""
    return OwnWorkers(workers) if workers else nullcontext(executor)


def work(job: bytes, rows: Rows, start: int) -> ChunkResult:
    """Run a pickled job on one chunk; called in a worker."""
    return _unpickled(job).run(rows, start)


@lru_cache(maxsize=4)
def _unpickled(job: bytes) -> Job[Rows]:
    """Return an unpickled job, cached in each worker so that the job is prepared once."""
    result: Job[Rows] = pickle.loads(job)
    return result


def worker_count(executor: Executor) -> int:
    """Return the number of workers of an executor, or a default if the number is unknown."""
    for name in ("_max_workers", "num_workers"):
        count = getattr(executor, name, None)
        if isinstance(count, int) and count > 0:
            return count
    client = getattr(executor, "_client", None)
    if client is not None and hasattr(client, "nthreads"):
        return max(1, sum(client.nthreads().values()))
    return _UNKNOWN_WORKERS
