"""Executor of worker processes, each connected by a separate pipe."""

from __future__ import annotations

import os
import signal
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, Executor, Future, ThreadPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context, parent_process
from multiprocessing.connection import Connection
from threading import Lock, Thread, local
from typing import TYPE_CHECKING, Any

from fflin.base.errors import FflinWarning
from fflin.kernel.compiled import available_cores

if TYPE_CHECKING:
    from multiprocessing.process import BaseProcess

# Time for a terminated process to end before it is killed [s].
_PATIENCE = 5.0


class WorkerDied(BrokenExecutor):
    """Error for a task whose worker process died; other workers continue."""


class NoWorkers(BrokenExecutor):
    """Error for worker processes that cannot be started."""


class OwnWorkers(Executor):
    """Executor with worker processes; if one dies, its task fails and another one starts."""

    def __init__(self, count: int) -> None:
        cores = available_cores()
        if count > cores:
            said = f"{count} workers requested, but only {cores} cores are available; using {cores}"
            warnings.warn(said, FflinWarning, stacklevel=4)
            count = cores
        self._max_workers = count
        # With fork, a process would inherit locks that other threads hold, and could wait for them
        # forever.
        self._context = get_context("spawn")
        self._threads = ThreadPoolExecutor(count)
        self._mine = local()
        self._lock, self._closed = Lock(), False
        self._processes: dict[BaseProcess, Connection] = {}

    def submit(self, fn: Callable[..., object], /, *args: object, **kwargs: object) -> Future[Any]:
        """Call a function in a worker process; raise `WorkerDied` if the process dies."""
        return self._threads.submit(self._do, (fn, args, kwargs))

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End the processes, even in the middle of a task."""
        with self._lock:
            self._closed = True
            for process in self._processes:
                process.terminate()
        # Do not join the threads; they end with their processes. If Ctrl-C interrupts a wait
        # for a future, the future remains locked. A thread that must set the result of this future
        # would never end.
        self._threads.shutdown(wait=False, cancel_futures=True)
        for process in list(self._processes):
            self._end(process)

    def _do(self, task: object) -> Any:
        process = getattr(self._mine, "process", None) or self._start()
        pipe = self._processes[process]
        try:
            pipe.send(task)
            error, result = pipe.recv()
        except (EOFError, OSError):
            self._mine.process = None
            self._end(process)
            raise WorkerDied(
                "a worker process died, for example because the memory was full"
            ) from None
        if error is not None:
            raise error
        return result

    def _start(self) -> BaseProcess:
        """Start a process for this thread and wait until it is ready."""
        ours, theirs = self._context.Pipe()
        process = self._context.Process(target=_serve, args=(theirs,), daemon=True)
        with self._lock:
            if self._closed:
                raise NoWorkers("the workers have been shut down")
            try:
                with _isolated(), _deaf_to_ctrl_c():
                    process.start()
            except OSError as error:
                raise NoWorkers(f"no worker process can be started: {error}") from None
            self._processes[process] = ours
        theirs.close()
        try:
            ours.recv()
        except (EOFError, OSError):
            self._end(process)
            raise NoWorkers(
                'a worker process did not start; make the call under `if __name__ == "__main__":`'
            ) from None
        self._mine.process = process
        return process

    def _end(self, process: BaseProcess) -> None:
        pipe = self._processes.pop(process, None)
        if pipe is None:  # another thread is already ending it
            return
        pipe.close()
        process.join(_PATIENCE)
        if process.is_alive():
            process.kill()
            process.join()
        process.close()


# Threads start workers one at a time, because `_isolated` changes a module that all threads share.
_STARTING = Lock()


@contextmanager
def _isolated() -> Iterator[None]:
    """Start processes that import nothing from the working folder.

    By default, a process that multiprocessing starts imports from the working folder first, until
    it has copied `sys.path` from its parent process.
    """
    from multiprocessing import util

    module: Any = util
    with _STARTING:
        usual = module._args_from_interpreter_flags
        module._args_from_interpreter_flags = lambda: ["-I", *usual()]
        try:
            yield
        finally:
            module._args_from_interpreter_flags = usual


@contextmanager
def _deaf_to_ctrl_c() -> Iterator[None]:
    """Start processes that ignore Ctrl-C, because their parent receives it too and ends them."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    from multiprocessing import resource_tracker

    # Start the resource tracker first. If it were started together with a process, it would unblock
    # the signal.
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _serve(pipe: Connection) -> None:
    """Run tasks until the parent closes the pipe or ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    Thread(target=_end_with_the_caller, daemon=True).start()
    try:
        pipe.send(None)
        while True:
            function, args, kwargs = pipe.recv()
            answer: tuple[Exception | None, object]
            try:
                answer = None, function(*args, **kwargs)
            except Exception as error:
                answer = error, None
            pipe.send(answer)
    except (EOFError, OSError):
        return


def _end_with_the_caller() -> None:
    """End this process when its parent process ends, even in the middle of a task."""
    caller = parent_process()
    assert caller is not None
    caller.join()
    os._exit(1)
