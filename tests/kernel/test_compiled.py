"""The compiled kernel on disk: made once, told once, and never from older sources."""

import io
import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from concurrent.futures import TimeoutError as StillWaits
from dataclasses import replace
from pathlib import Path
from threading import Barrier, Event
from types import SimpleNamespace

import numpy as np
import pytest

import fflin
from fflin.base import process
from fflin.kernel import compiled as kernel_code
from tests.support.policies import JETS, POLICIES, between_gains, plain
from tests.support.robots import BUNDLED

pytest.importorskip("numba")


@pytest.fixture
def signatures():
    """The signatures that `compiled` was compiled for."""
    return []


@pytest.fixture
def compiled(monkeypatch, tmp_path, signatures):
    """A function of the kernel that keeps its code in a folder of its own."""
    from fflin.kernel import machine_code

    new = SimpleNamespace(
        stats=SimpleNamespace(cache_path=tmp_path), compile=signatures.append
    )
    monkeypatch.setattr(machine_code, "translated", lambda function, how: new)
    kernel_code._prepared.cache_clear()
    yield new
    kernel_code._prepared.cache_clear()


@pytest.mark.compiled
def test_compilation_is_announced_once_for_all_threads(
    compiled, caplog, tmp_path, signatures
):
    ready = Barrier(4)

    def ask():
        ready.wait()
        return kernel_code.kernel("derivatives", "derive")

    with ThreadPoolExecutor(4) as threads:
        result = [threads.submit(ask) for _ in range(4)]
    assert all(item.result() is compiled for item in result)
    assert not caplog.records
    compiled.compile("double")
    (tmp_path / f"derivatives.derive-1.{kernel_code.VERSION}.nbi").write_bytes(b"")
    compiled.compile("long")
    assert signatures == ["double", "long"]
    assert [record.message for record in caplog.records] == [
        f"fflin: compiling the batch kernel; this happens only once, because the "
        f"code is stored in {tmp_path}"
    ]


@pytest.mark.compiled
def test_a_thread_that_waits_for_another_names_no_process(
    compiled, caplog, tmp_path, monkeypatch
):
    began, messages, asked = Event(), Event(), []

    def compile(signature):
        asked.append(signature)
        began.set()
        assert messages.wait(5.0)

    monkeypatch.setattr(kernel_code, "_SILENCE", 0.01)
    compiled.compile = compile
    made = kernel_code.kernel("derivatives", "derive")
    with ThreadPoolExecutor(2) as threads:
        first = threads.submit(made.compile, "double")
        assert began.wait(5.0)
        second = threads.submit(made.compile, "long")
        with pytest.raises(StillWaits):
            second.result(0.2)
        messages.set()
        first.result(), second.result()
    assert asked == ["double", "long"]
    assert not any("waiting" in record.message for record in caplog.records)


@pytest.mark.compiled
@pytest.mark.parametrize("older", [False, True])
def test_code_that_is_older_than_any_source_is_not_taken(
    compiled, caplog, tmp_path, older
):
    kept = tmp_path / f"derivatives.derive-1.{kernel_code.VERSION}.nbi"
    kept.write_bytes(b"")
    sources = Path(kernel_code.__file__).parent.glob("*.py")
    newest = max(file.stat().st_mtime for file in sources)
    os.utime(kept, (newest, newest + (-1.0 if older else 1.0)))
    kernel_code.kernel("derivatives", "derive").compile("double")
    assert kept.exists() is not older
    assert bool(caplog.records) is older


@pytest.mark.compiled
def test_a_function_that_is_asked_for_twice_does_not_wait_for_itself(
    compiled, caplog, monkeypatch, signatures
):
    pytest.importorskip("filelock")
    monkeypatch.setattr(kernel_code, "_SILENCE", 0.05)
    monkeypatch.setattr(kernel_code, "_LONGEST_WAIT", 0.05)
    for _ in range(2):
        assert kernel_code.kernel("derivatives", "derive") is compiled
    compiled.compile("double")
    assert signatures == ["double"]
    assert not any("waiting" in record.message for record in caplog.records)


def test_machine_code_is_found_where_numba_keeps_it(monkeypatch, tmp_path):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    assert not kernel_code.is_kept("loop", "advance")
    (tmp_path / "kernel_0").mkdir()
    (tmp_path / "kernel_0" / f"loop.advance-1.{kernel_code.VERSION}.nbi").write_bytes(
        b""
    )
    assert kernel_code.is_kept("loop", "advance")
    assert not kernel_code.is_kept("loop", "another")
    monkeypatch.setattr(kernel_code, "VERSION", "py39")
    assert not kernel_code.is_kept("loop", "advance")


WAITER = """
import logging, sys, time
from pathlib import Path
from fflin.kernel import compiled
logging.basicConfig(stream=sys.stdout, format="%(message)s", level=logging.WARNING)
compiled._SILENCE = 0.05
with compiled._between_processes(Path(sys.argv[1]) / "loop.lock"):
    print("held", flush=True)
    if len(sys.argv) > 2:
        sys.stdin.read()
"""


@pytest.mark.process
def test_processes_compile_one_at_a_time_and_a_killed_one_leaves_no_lock(tmp_path):
    command = [sys.executable, "-c", WAITER, str(tmp_path)]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen([*command, "stay"], **pipes) as first:
        assert first.stdout.readline() == "held\n"
        with subprocess.Popen(command, **pipes) as second:
            assert "waiting for another process" in second.stdout.readline()
            first.kill()
            assert second.stdout.readline() == "held\n"


@pytest.mark.compiled
@pytest.mark.parametrize("name", BUNDLED)
def test_one_set_of_machine_code_serves_every_robot_policy_and_option(robots, name):
    """Motions and campaigns under every policy, with limits, wheels, pulses, samples and faults."""
    advance = kernel_code.kernel("loop", "advance")
    take = kernel_code.kernel("loop", "take")

    for make in POLICIES:
        if make is between_gains and not robots[name].n:
            continue
        robot, policy, options = make(plain(robots[name]))
        options = (
            {"dt": 0.05, "engine": "compiled"}
            | options
            | {"duration": 0.1, "linear": False}
        )
        for most in (None, 0.5):
            fflin.simulate(robot, policy, **options, limits=most)
    wheel = fflin.ReactionWheel(
        (0, 0, 1), name="w", inertia=1e-4, max_speed=30.0, max=0.5
    )
    jets = [replace(jet, on_off=True, max=0.3) for jet in JETS]
    robot = robots[name].replace(inputs=[*jets, wheel], gravity=(0.0, 0.1, 0.0))
    lin = fflin.linearize(robot)
    law = fflin.StateFeedback(lin, np.zeros(lin.B.shape[::-1]))
    given = {"*.mass": 0.1, "q_b.sensor": 1e-3, "*.noise": 1e-3, "delay": [0.0, 0.1]}
    options = {
        "runs": 9,
        "duration": 0.4,
        "dt": 0.05,
        "sample": 0.1,
        "engine": "compiled",
    }
    fflin.monte_carlo(robot, law, given, limits="urdf", **options, threads=1)
    fflin.monte_carlo(
        robots[name], None, {"q_b": 0.1}, runs=1, duration=0.1, engine="compiled"
    )
    assert [len(item.signatures) for item in (advance, take)] == [1, 1]


def test_a_terminal_shows_the_seconds_of_a_compilation(monkeypatch):
    class Terminal(io.StringIO):
        def isatty(self):
            return True

    monkeypatch.setattr(kernel_code, "_INTERVAL", 0.01)
    monkeypatch.setattr(process, "_PATIENCE", 0.0)
    for stderr, shown in ((Terminal(), True), (io.StringIO(), False)):
        monkeypatch.setattr(sys, "stderr", stderr)
        with kernel_code._seconds_shown("the loop"):
            time.sleep(0.1)
        assert ("compiling the loop: 0 s " in stderr.getvalue()) == shown
        assert stderr.getvalue().endswith("\r\x1b[2K") == shown


@pytest.mark.compiled
def test_code_that_cannot_be_stored_is_compiled_and_told_once(
    compiled, caplog, signatures
):
    compiled.stats.cache_path = None
    kernel_code._warned_unstored.clear()
    result = kernel_code.kernel("derivatives", "derive")
    result.compile("double")
    result.compile("long")
    kernel_code._warned_unstored.clear()
    assert signatures == ["double", "long"]
    (record,) = caplog.records
    assert "NUMBA_CACHE_DIR" in record.message


@pytest.mark.compiled
def test_numba_without_a_writable_folder_compiles_without_storing(monkeypatch):
    from numba.core import caching

    from fflin.kernel import derivatives, machine_code

    # So numba finds no folder, as if it were installed read-only and without a home.
    monkeypatch.setattr(caching.CompileResultCacheImpl, "_locator_classes", [])
    machine_code.translated.cache_clear()
    try:
        result = machine_code.translated(derivatives.derive, "compiled")
    finally:
        machine_code.translated.cache_clear()
    assert result.stats.cache_path is None


@pytest.mark.parametrize("engine", [None, "compiled"])
def test_numba_that_is_switched_off_is_not_used(engine, monkeypatch):
    monkeypatch.setenv("NUMBA_DISABLE_JIT", "1")
    robot = fflin.load("cubesat")
    if engine:
        for call in (
            lambda: fflin.sweep(robot, [robot.neutral()], engine=engine),
            lambda: fflin.simulate(robot, duration=0.02, engine=engine),
        ):
            with pytest.raises(fflin.InputError, match="NUMBA_DISABLE_JIT"):
                call()
        return
    assert not kernel_code.numba_is_there()
    assert len(fflin.sweep(robot, [robot.neutral()], threads=1)) == 1
    monkeypatch.setenv("NUMBA_DISABLE_JIT", "0")
    assert "not installed" in kernel_code.without_numba()
