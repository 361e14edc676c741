"""Run of a job over rows, chunk by chunk, into a store that may already hold some chunks.

This module is independent of the meaning of the rows and of the job's results.
"""

from __future__ import annotations

import warnings
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from typing import Any

import numpy as np

from fflin.base.errors import FflinError, FflinWarning, InputError, SweepError, listed
from fflin.base.validation import whole
from fflin.batch.dispatch import Dispatch, Done, Job, Rows, Span
from fflin.batch.store import FileStore, MemoryStore

Progress = Callable[[int, int], object]


def check_workers(executor: Any, workers: Any, threads: Any, chunk: Any, progress: Any) -> None:
    """Raise `InputError` if an option for the execution of the chunks is wrong."""
    if executor is not None and workers is not None:
        raise InputError("executor and workers are both given; give only one of them")
    if executor is not None and not hasattr(executor, "submit"):
        raise InputError(
            f"executor is a {type(executor).__name__}, expected a concurrent.futures.Executor"
        )
    for name, value in (("workers", workers), ("threads", threads), ("chunk", chunk)):
        if value is not None:
            whole(name, value, 1)
    if progress is not None and not callable(progress):
        raise InputError(f"progress is {progress!r}, expected a function progress(done, total)")


def run_chunks(
    job: Job,
    rows: Rows,
    store: FileStore | MemoryStore,
    *,
    executor: Executor | None = None,
    threads: int = 1,
    progress: Progress | None = None,
    upto: int | None = None,
) -> list[Done]:
    """Do the chunks that a store has not yet, keep what comes of them, return those that failed."""
    # `rows(start, stop)` is a named tuple, which the store keeps of what it has a name for. Only
    # chunks that begin before `upto` are done; threads are of this process, without an executor.
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
        else Dispatch(job, rows, left, executor)
    ):
        if done.result is None:
            failed.append(done)
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
    made: Callable[[Any], Any],
) -> SweepError:
    """Return the error that names the chunks that failed."""
    kept = np.ones(store.count, dtype=bool)
    for (start, stop), *_ in failed:
        kept[start:stop] = False
    numbers = listed(f"{start} to {stop - 1}" for (start, stop), *_ in failed)
    said = (
        f"{len(failed)} of {-(-store.count // store.chunk)} chunks "
        f"{'has' if len(failed) == 1 else 'have'} failed, {of_what} {numbers}: "
        f"{failed[0].reason}"
    )
    batch = None
    if not kept.any():
        store.discard()
    elif store.part is not None:
        said += f"; the other chunks are in {store.part}, and the same call resumes from them"
    else:
        batch = made(kept)
        said += "; the other chunks are in the `batch` of this error"
    return SweepError(said, tuple((*span, reason) for span, _, reason in failed), batch)


def _run_here(
    job: Job, rows: Rows, store: FileStore | MemoryStore, spans: list[Span], threads: int
) -> Iterator[Done]:
    def run(span: Span) -> Done:
        place = store.place(*span)
        out = None if place is None else {key: place[key] for key in job.shapes}
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
            # Results that nobody has taken yet would fill the memory.
            if len(begun) > threads:
                yield begun.popleft().result()
        while begun:
            yield begun.popleft().result()
    finally:
        # Without waiting, so that Ctrl-C ends a compilation too.
        pool.shutdown(wait=False, cancel_futures=True)
