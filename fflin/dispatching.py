"""Chunks of a sweep on the workers of an executor, of which some may die."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    wait,
)
from multiprocessing import get_context
from typing import NamedTuple

from fflin.batch_chunks import Chunk, ChunkJob, Parcel, Points, packed, work
from fflin.errors import FflinError

# A chunk whose worker dies is given to others; what kills this many is not.
_ATTEMPTS = 3

# Chunks that wait at each worker, so that none stands idle.
_QUEUED = 2

# Of an executor that does not say how many workers it has.
_UNKNOWN_WORKERS = 16


class Span(NamedTuple):
    """The points of a chunk, start up to but not including stop."""

    start: int
    stop: int


class Done(NamedTuple):
    """A chunk that came to an end: its result, or why there is none."""

    span: Span
    chunk: Chunk | None
    reason: str


class OwnWorkers:
    """Processes of our own, which are replaced where one dies.

    Parameters
    ----------
    count : int
    """

    def __init__(self, count: int) -> None:
        self.count = count
        self._pool = self._start()

    def _start(self) -> ProcessPoolExecutor:
        # A fork would take a copy of locks that other threads hold.
        return ProcessPoolExecutor(self.count, mp_context=get_context("spawn"))

    @property
    def executor(self) -> ProcessPoolExecutor:
        """The pool that stands now."""
        return self._pool

    def replace(self) -> None:
        """Start the processes anew."""
        self.close()
        self._pool = self._start()

    def close(self) -> None:
        """End the processes."""
        self._pool.shutdown(wait=True, cancel_futures=True)


class _Queue:
    """What is still to be done, how often each was begun, and where it is."""

    def __init__(self, spans: Sequence[Span]) -> None:
        self.waiting = list(reversed(spans))
        self.attempts: dict[Span, int] = {}
        self.running: dict[Future[Chunk | None], Span] = {}

    def lost(self, span: Span) -> bool:
        """Put a span back whose worker died; whether it may be begun again."""
        if self.attempts[span] < _ATTEMPTS:
            self.waiting.append(span)
            return True
        return False


def dispatch(
    job: ChunkJob,
    spans: Sequence[Span],
    points: Callable[[Span], Points],
    workers: Executor | OwnWorkers,
) -> Iterator[Done]:
    """Do chunks on workers and yield them as they are finished.

    The job is sent with the first chunks only, and again to a worker that says it has none.

    Parameters
    ----------
    job : ChunkJob
    spans : sequence of Span
    points : callable
        Makes the points of a span.
    workers : Executor or OwnWorkers

    Yields
    ------
    Done
        Each span once.
    """
    parcel = packed(job)
    ahead = _QUEUED * (workers.count if isinstance(workers, OwnWorkers) else _count(workers))
    queue = _Queue(spans)
    try:
        yield from _until_empty(queue, parcel, points, workers, ahead)
    finally:
        for future in queue.running:
            future.cancel()


def _until_empty(
    queue: _Queue,
    parcel: Parcel,
    points: Callable[[Span], Points],
    workers: Executor | OwnWorkers,
    ahead: int,
) -> Iterator[Done]:
    own = workers if isinstance(workers, OwnWorkers) else None
    known = cautious = False
    while queue.waiting or queue.running:
        executor = workers.executor if isinstance(workers, OwnWorkers) else workers
        broken = None
        # Which of the running chunks killed a worker is not told: go on one at a time.
        room = 1 if cautious else ahead
        while queue.waiting and len(queue.running) < room and broken is None:
            span = queue.waiting.pop()
            sent = Parcel(parcel.key, None if known else parcel.content)
            broken = _submit(executor, queue, span, sent, points)
        finished = ()
        if queue.running:
            finished = wait(queue.running, return_when=FIRST_COMPLETED).done
        for future in finished:
            span = queue.running.pop(future)
            try:
                chunk = future.result()
            except FflinError as error:
                yield Done(span, None, str(error))
            except (BrokenExecutor, CancelledError) as error:
                broken = broken or error
                if not queue.lost(span):
                    yield Done(span, None, "its worker died each time")
            except Exception as error:
                # Of the executor's own, such as a scheduler that gave up on a worker.
                if not queue.lost(span):
                    yield Done(span, None, f"{type(error).__name__}: {error}")
            else:
                if chunk is None:
                    queue.attempts[span] -= 1
                    sent = Parcel(parcel.key, parcel.content)
                    broken = _submit(executor, queue, span, sent, points) or broken
                    continue
                known = True
                yield Done(span, chunk, "")
        cautious = cautious and any(span in queue.attempts for span in queue.waiting)
        if broken is not None and own is None:
            yield from _abandoned(queue, broken)
            return
        if broken is not None and own is not None:
            for future, span in list(queue.running.items()):
                if not queue.lost(span):
                    yield Done(span, None, "its worker died each time")
                del queue.running[future]
            own.replace()
            known, cautious = False, True


def _submit(
    executor: Executor,
    queue: _Queue,
    span: Span,
    parcel: Parcel,
    points: Callable[[Span], Points],
) -> BaseException | None:
    """Begin a chunk, or put it back and return what the executor died of."""
    try:
        future = executor.submit(work, parcel, points(span), span.start)
    except (BrokenExecutor, CancelledError) as error:
        queue.waiting.append(span)
        return error
    except RuntimeError as error:  # shut down
        queue.waiting.append(span)
        return error
    queue.attempts[span] = queue.attempts.get(span, 0) + 1
    queue.running[future] = span
    return None


def _abandoned(queue: _Queue, error: BaseException) -> Iterator[Done]:
    """Give up what an executor of the caller's had not finished when it died."""
    reason = f"the executor died: {type(error).__name__}: {error}".rstrip(": ")
    for future, span in queue.running.items():
        # Some are finished and not lost with it.
        if future.done() and not future.cancelled() and future.exception() is None:
            chunk = future.result()
            yield Done(span, chunk, "" if chunk is not None else reason)
        else:
            yield Done(span, None, reason)
    for span in reversed(queue.waiting):
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
