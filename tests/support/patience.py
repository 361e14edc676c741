"""Waiting that ends soon if nothing happens, and that no load of the machine cuts short.

A process that computes, or would if it were given a processor, may take long on a busy machine.
Processes that sleep for a minute wait for something that does not come.
"""

import contextlib
import os
import shlex
import subprocess
import threading
import time

import psutil

STALL = 60.0  # [s] without progress after which a wait fails
LIMIT = 300.0  # [s] of processor time after which a wait fails
# [s] of processor time that is no progress: clocks have steps, and polling takes some
IDLE = 0.6


class Family:
    """A process and all that it started, some of which may outlive it."""

    def __init__(self, pid):
        self._pid, self._seen = pid, set()

    def processor_time(self):
        """Return the processor time [s] of all of them, without this thread."""
        with contextlib.suppress(psutil.Error):
            process = psutil.Process(self._pid)
            self._seen |= {process, *process.children(recursive=True)}
        total = -time.thread_time() if self._pid == os.getpid() else 0.0
        for item in self._seen:
            with contextlib.suppress(psutil.Error):
                total += sum(item.cpu_times()[:4])  # own and of children that ended
        return total

    def busy(self):
        """Return whether one of them computes, or waits for a processor or a disk."""
        states = (psutil.STATUS_RUNNING, psutil.STATUS_DISK_SLEEP)
        for item in self._seen:
            with contextlib.suppress(psutil.Error):
                if item.pid != os.getpid() and item.status() in states:
                    return True
        return False

    def kill(self):
        """Kill those that have been seen."""
        for item in self._seen:
            with contextlib.suppress(psutil.Error):
                item.kill()


class Patience:
    """Decide whether a wait for what a family of processes does is in vain."""

    def __init__(self, what, limit, stall, family, clock=time.monotonic):
        self._what, self._limit, self._stall = what, limit, stall
        self._family, self._clock = family, clock
        self._start = self._before = family.processor_time()
        self._since = clock()

    def out(self):
        """Return why it is in vain, or an empty string."""
        taken, now = self._family.processor_time(), self._clock()
        if abs(taken - self._before) > IDLE or self._family.busy():
            self._before, self._since = taken, now
        if now - self._since > self._stall:
            return f"nothing happened for {self._stall:g} s, waiting for {self._what}"
        if taken - self._start > self._limit:
            return (
                f"{self._limit:g} s of processor time were not enough for {self._what}"
            )
        return ""


def wait_until(done, what, *, limit=LIMIT, stall=STALL):
    """Wait for a condition that this process or one that it started brings about."""
    if done():
        return
    patience = Patience(what, limit, stall, Family(os.getpid()))
    look = time.monotonic()
    while not done():
        time.sleep(0.02)
        if time.monotonic() > look:
            look = time.monotonic() + 0.05 * stall
            assert not (reason := patience.out()), reason


@contextlib.contextmanager
def finishing(process, what="", *, limit=LIMIT, stall=STALL):
    """Kill a process and all that it started when waiting for it is in vain, and say so."""
    what = what or shlex.join(map(str, process.args))
    family = Family(process.pid)
    patience = Patience(what, limit, stall, family)
    ended, reason = threading.Event(), []

    def watch():
        while not ended.wait(min(1.0, 0.05 * stall)):
            if message := patience.out():
                reason.append(message)
                family.kill()
                return

    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    try:
        yield process
    finally:
        ended.set()
        watcher.join()
        assert not reason, reason[0]


@contextlib.contextmanager
def in_own_session(command, folder, *, stdout=subprocess.PIPE):
    """Start a command whose whole group of processes Ctrl-C can reach; see `finishing`."""
    with (
        subprocess.Popen(
            command,
            cwd=folder,
            stdout=stdout,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        ) as process,
        finishing(process),
    ):
        yield process


def finished(
    command, *, input=None, capture_output=False, check=False, watch=(), **options
):
    """Run a command as `subprocess.run` does, and kill it when waiting for it is in vain."""
    if capture_output:
        options |= {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    if input is not None:
        options["stdin"] = subprocess.PIPE
    with (
        subprocess.Popen(command, **options) as process,
        finishing(process, **dict(watch)),
    ):
        out, err = process.communicate(input)
    done = subprocess.CompletedProcess(command, process.returncode, out, err)
    if check:
        assert done.returncode == 0, err
    return done
