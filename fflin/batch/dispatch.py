"""Chunks of a sweep in this process, or on the workers of an executor, of which some may die."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
    wait,
)
from typing import Any, NamedTuple

from fflin.base.errors import FflinError
from fflin.base.validation import Array
from fflin.batch.chunks import ChunkResult, Parcel, pack, work
from fflin.batch.task import Span, SweepTask
from fflin.batch.workers import NoWorkers, WorkerDied

# A chunk whose worker dies is given to another, up to this many times.
_ATTEMPTS = 3

# Chunks that are submitted for each worker at a time, so that none is idle between two.
_QUEUED = 2

# How often the worker processes are checked while no chunk is finished [s].
_GLANCE = 1.0

# Assumed of an executor that does not tell how many workers it has.
_UNKNOWN_WORKERS = 16


class Done(NamedTuple):
    """A chunk that came to an end: its result, or why there is none."""

    span: Span
    result: ChunkResult | None
    reason: str


def run_here(
    task: SweepTask,
    spans: Sequence[Span],
    place: Callable[[int, int], Mapping[str, Array] | None],
    threads: int,
) -> Iterator[Done]:
    """Do chunks in this process, several at a time where the kernel does them.

    Parameters
    ----------
    task : SweepTask
    spans : sequence of Span
    place : callable
        Returns the arrays that a chunk is written to, or None for new ones.
    threads : int

    Yields
    ------
    Done
        Each span once.
    """

    def run(span: Span) -> Done:
        rows = place(*span)
        out = None if rows is None else {key: rows[key] for key in task.job.shapes}
        try:
            return Done(span, task.job.run(task.points(span), span.start, out), "")
        except FflinError as error:
            return Done(span, None, str(error))

    if threads == 1 or len(spans) == 1 or not task.job.compiled:
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


def dispatch(task: SweepTask, spans: Sequence[Span], workers: Executor) -> Iterator[Done]:
    """Do chunks on workers and yield them as they are finished.

    The job is sent with the first chunks only, and again to a worker that says it has none.

    Parameters
    ----------
    task : SweepTask
    spans : sequence of Span
    workers : Executor

    Yields
    ------
    Done
        Each span once.
    """
    state = _Dispatch(task, spans, workers)
    try:
        while state.waiting or state.running:
            state.begin()
            yield from state.finished()
            if state.broken is not None:
                yield from state.lost()
    finally:
        for future in state.running:
            future.cancel()


class _Dispatch:
    """The chunks that wait and those that run, how often each was begun, and the workers."""

    def __init__(self, task: SweepTask, spans: Sequence[Span], workers: Executor) -> None:
        self.waiting = list(reversed(spans))
        self.running: dict[Future[ChunkResult | None], Span] = {}
        self.broken: BaseException | None = None
        self._attempts: dict[Span, int] = {}
        self._task, self._parcel, self._workers = task, pack(task.job), workers
        self._ahead = _QUEUED * _count(workers)
        self._known = False

    def begin(self) -> None:
        """Submit as many chunks as the workers can take."""
        while self.waiting and len(self.running) < self._ahead and self.broken is None:
            self._submit(self.waiting.pop(), None if self._known else self._parcel.content)

    def finished(self) -> Iterator[Done]:
        """Wait for a chunk and yield what is finished."""
        if not self.running:
            return
        pool = self._workers if isinstance(self._workers, ProcessPoolExecutor) else None
        hung = False
        while not (done := wait(self.running, _GLANCE if pool else None, FIRST_COMPLETED).done):
            assert pool is not None
            if hung:
                _break(pool)
            hung = _lost_a_worker(pool)
        for future in done:
            span = self.running.pop(future)
            try:
                chunk = future.result()
            except FflinError as error:
                yield Done(span, None, str(error))
            except WorkerDied as error:
                yield from self._lost(span, str(error))
            except (BrokenExecutor, CancelledError) as error:
                self.broken = self.broken or error
                self.waiting.append(span)
            except Exception as error:
                # Executors have errors of their own, such as of a scheduler that lost a worker.
                yield from self._lost(span, f"{type(error).__name__}: {error}")
            else:
                if chunk is None:
                    self._attempts[span] -= 1
                    self._submit(span, self._parcel.content)
                else:
                    self._known = True
                    yield Done(span, chunk, "")

    def lost(self) -> Iterator[Done]:
        """Yield the chunks that an executor took with it when it died."""
        error, self.broken = self.broken, None
        running, self.running = self.running, {}
        reason = f"the executor died: {type(error).__name__}: {error}".rstrip(": ")
        if isinstance(error, NoWorkers):
            reason = str(error)
        for future, span in running.items():
            # Some were finished before it died.
            good = future.done() and not future.cancelled() and future.exception() is None
            chunk = future.result() if good else None
            yield Done(span, chunk, "" if chunk is not None else reason)
        waiting, self.waiting = self.waiting, []
        for span in reversed(waiting):
            yield Done(span, None, reason)

    def _submit(self, span: Span, content: bytes | None) -> None:
        """Begin a chunk, or put it back where the executor is dead."""
        arguments = Parcel(self._parcel.key, content), self._task.points(span), span.start
        try:
            future = self._workers.submit(work, *arguments)
        except Exception as error:  # broken, shut down, or of its own
            self.waiting.append(span)
            self.broken = error
        else:
            self._attempts[span] = self._attempts.get(span, 0) + 1
            self.running[future] = span

    def _lost(self, span: Span, reason: str) -> Iterator[Done]:
        """Put a chunk back whose worker died, or give it up."""
        if self._attempts[span] < _ATTEMPTS:
            self.waiting.append(span)
        else:
            yield Done(span, None, reason)


def _count(executor: Executor) -> int:
    """How many workers an executor has, as far as it tells."""
    for name in ("_max_workers", "num_workers"):
        count = getattr(executor, name, None)
        if isinstance(count, int) and count > 0:
            return count
    client = getattr(executor, "_client", None)
    if client is not None and hasattr(client, "nthreads"):
        return max(1, sum(client.nthreads().values()))
    return _UNKNOWN_WORKERS


def _lost_a_worker(pool: ProcessPoolExecutor) -> bool:
    """Whether a process of a pool was killed."""
    processes = list((pool._processes or {}).values())
    return any(process.exitcode not in (None, 0) for process in processes)


def _break(pool: ProcessPoolExecutor) -> None:
    """End a pool that waits for the rest of a result whose worker was killed as it sent it.

    It waits as long as anybody could still write to the pipe that all workers and this process
    share. Where nobody can, it finds itself broken, and its futures with it.
    """
    for process in list((pool._processes or {}).values()):
        process.kill()
    channel: Any = pool._result_queue
    channel._writer.close()
