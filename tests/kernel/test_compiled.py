"""The compiled kernel on disk: made once, told once, and never from older sources."""

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from threading import Barrier
from types import SimpleNamespace

import pytest

from fflin.kernel import compiled as kernel_code

pytest.importorskip("numba")


@pytest.fixture
def signatures():
    """The signatures that `compiled` was compiled for."""
    return []


@pytest.fixture
def compiled(monkeypatch, tmp_path, signatures):
    """A function of the kernel that keeps its code in a folder of its own."""
    from fflin.kernel import derivatives as batch_kernel

    new = SimpleNamespace(stats=SimpleNamespace(cache_path=tmp_path), compile=signatures.append)
    monkeypatch.setattr(batch_kernel, "derive", new)
    kernel_code._prepared.cache_clear()
    yield new
    kernel_code._prepared.cache_clear()


@pytest.mark.compiled
def test_compilation_is_announced_once_for_all_threads(compiled, caplog, tmp_path, signatures):
    ready = Barrier(4)

    def ask():
        ready.wait()
        return kernel_code.kernel("derivatives", "derive")

    with ThreadPoolExecutor(4) as threads:
        found = [threads.submit(ask) for _ in range(4)]
    assert all(each.result() is compiled for each in found)
    assert not caplog.records
    compiled.compile("double")
    (tmp_path / "derivatives.derive-1.nbi").write_bytes(b"")
    compiled.compile("long")
    assert signatures == ["double", "long"]
    assert [record.message for record in caplog.records] == [
        f"fflin: compiling the batch kernel, once; it is kept in {tmp_path}"
    ]


@pytest.mark.compiled
@pytest.mark.parametrize("older", [False, True])
def test_code_that_is_older_than_any_source_is_not_taken(compiled, caplog, tmp_path, older):
    kept = tmp_path / "derivatives.derive-1.nbi"
    kept.write_bytes(b"")
    newest = max(file.stat().st_mtime for file in kernel_code._sources())
    os.utime(kept, (newest, newest + (-1.0 if older else 1.0)))
    kernel_code.kernel("derivatives", "derive").compile("double")
    assert kept.exists() is not older
    assert bool(caplog.records) is older


@pytest.mark.parametrize("kept", [False, True])
@pytest.mark.parametrize("loaded", [False, True])
def test_a_short_run_waits_for_no_compiler(monkeypatch, tmp_path, kept, loaded):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    there = SimpleNamespace(__spec__="numba")
    monkeypatch.setattr(kernel_code.sys, "modules", {"numba": there} if loaded else {})
    monkeypatch.setattr(kernel_code, "find_spec", lambda name: there)
    if kept:
        (tmp_path / "kernel_0").mkdir()
        (tmp_path / "kernel_0" / "loop.advance-1.nbi").write_bytes(b"")
    least = (100 if loaded else 4000) if kept else 20_000
    assert not kernel_code.loop_pays(least - 1)
    assert kernel_code.loop_pays(least)
    monkeypatch.setattr(kernel_code, "find_spec", lambda name: None)
    assert not kernel_code.loop_pays(10**6)


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
