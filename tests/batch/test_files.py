"""Batches on disk: exact, whole or not at all, and resumed after a crash."""

import os
import signal
import subprocess
import sys
import textwrap
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import fflin
from fflin.batch.files import FileStore, output_path
from tests.support.patience import finished, finishing
from tests.support.robots import singular_at
from tests.support.sweeps import assert_same, points

h5py = pytest.importorskip("h5py")

FORMATS = (".npz", ".h5")


@pytest.fixture
def robot(robots):
    return robots["ets_vii"]


@pytest.mark.parametrize("ending", FORMATS)
@pytest.mark.parametrize("moving", [False, True])
def test_a_batch_that_is_saved_is_read_back_to_the_last_bit(
    ending, moving, robot, tmp_path
):
    q, v, u = points(robot, 7)
    batch = fflin.sweep(robot, q, *((v, u) if moving else ()))
    batch.save(tmp_path / f"b{ending}")
    read = fflin.LinearBatch.load(tmp_path / f"b{ending}", robot)
    assert len(read) == 7 and list(tmp_path.iterdir()) == [tmp_path / f"b{ending}"]
    for one, other in zip(read, batch, strict=True):
        assert_same(one, other)
        assert np.array_equal(one.M, other.M)
    part = read[np.array([1, 4])]
    assert_same(part[1], batch[4])
    alone = fflin.LinearBatch.load(tmp_path / f"b{ending}")
    assert_same(alone[3], batch[3])
    with pytest.raises(fflin.InputError, match="LinearBatch"):
        _ = alone[3].certificate
    with pytest.raises(fflin.InputError, match="'cubesat'"):
        fflin.LinearBatch.load(tmp_path / f"b{ending}", fflin.load("cubesat"))


@pytest.mark.compiled
@pytest.mark.parametrize("ending", FORMATS)
@pytest.mark.parametrize("moving", [False, True])
def test_a_sweep_to_a_file_is_the_one_in_memory(ending, moving, robot, tmp_path):
    q, v, u = points(robot, 23)
    arguments = (v, u) if moving else ()
    path = tmp_path / f"b{ending}"
    batch = fflin.sweep(robot, q, *arguments, chunk=5, out=path)
    assert list(tmp_path.iterdir()) == [path]
    expected = fflin.sweep(robot, q, *arguments)
    for one, other in zip(batch, expected, strict=True):
        assert_same(one, other, 1e-13)
    for one, other in zip(fflin.LinearBatch.load(path, robot), batch, strict=True):
        assert_same(one, other)


def test_hdf5_is_plain(robot, tmp_path):
    """Others read it: contiguous arrays by their names."""
    q, _, _ = points(robot, 6)
    batch = fflin.sweep(robot, q, out=tmp_path / "b.h5")
    with h5py.File(tmp_path / "b.h5") as file:
        assert file["A"].shape == (24, 24)
        assert np.array_equal(file["B_lower"][:], batch.B_lower)
        assert np.array_equal(file["q"][:], q)
    assert isinstance(batch.B_lower, np.memmap) and not batch.B_lower.flags.writeable


@pytest.mark.parametrize("ending", FORMATS)
def test_an_invalid_batch_is_refused(ending, robot, tmp_path):
    path = tmp_path / f"b{ending}"
    with pytest.raises(fflin.FileError, match="No such file"):
        fflin.LinearBatch.load(path)
    path.write_bytes(b"PK\3\4 something")
    with pytest.raises(fflin.FileError, match="batch"):
        fflin.LinearBatch.load(path)
    q, _, _ = points(robot, 3)
    fflin.sweep(robot, q, out=path)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(fflin.FileError, match="batch"):
        fflin.LinearBatch.load(path)
    with pytest.raises(fflin.FileError, match=r"\.npz, \.h5"):
        fflin.sweep(robot, q, out=tmp_path / "b.mat")
    with pytest.raises(fflin.FileError, match="folder"):
        fflin.sweep(robot, q, out=tmp_path / "no" / f"b{ending}")


def interrupted(robot, q, path, after):
    """A sweep that stops after some chunks."""

    class Stop(Exception):
        pass

    def stop(done, _):
        if done >= after:
            raise Stop

    with pytest.raises(Stop):
        fflin.sweep(robot, q, chunk=16, out=path, progress=stop, threads=1)


@pytest.mark.compiled
def test_a_run_goes_on_from_the_chunks_that_are_there_and_intact(
    robot, tmp_path, monkeypatch
):
    q, _, _ = points(robot, 80)
    path, part = tmp_path / "b.h5", tmp_path / "b.h5.part"
    interrupted(robot, q, path, 64)
    assert not path.exists() and part.exists()
    # Another request does not touch it.
    with pytest.raises(fflin.FileError, match="another call"):
        fflin.sweep(robot, q[::-1], chunk=16, out=path)
    with pytest.raises(fflin.FileError, match="another call"):
        fflin.sweep(robot, q, chunk=16, out=path, frame="world")
    # One of the chunks is damaged: that one and the one that is missing are done again.
    with h5py.File(part, "r+") as file:
        file["B_lower"][17, 3, 4] += 1e-9
    written = []
    original = FileStore.write
    monkeypatch.setattr(
        FileStore,
        "write",
        lambda store, start, *rest: (
            written.append(start),
            original(store, start, *rest),
        ),
    )
    messages = []
    batch = fflin.sweep(
        robot, q, chunk=16, out=path, progress=lambda *x: messages.append(x)
    )
    assert written == [16, 64] and messages == [(48, 80), (64, 80), (80, 80)]
    assert [entry.name for entry in tmp_path.iterdir()] == ["b.h5"]
    assert np.abs(batch.B_lower / fflin.sweep(robot, q).B_lower - 1).max() < 1e-9


def test_a_failed_run_keeps_its_finished_chunks(robot, tmp_path, monkeypatch):
    """The disk has become full since the first part of the run."""
    path, part = tmp_path / "b.h5", tmp_path / "b.h5.part"
    q = fflin.random_configurations(robot, 12)

    def stop(done, _):
        if done > 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fflin.sweep(robot, q, chunk=4, out=path, progress=stop)

    def full(*_):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(os, "posix_fallocate", full)
        with pytest.raises(fflin.FileError, match="No space left"):
            fflin.sweep(robot, q, chunk=4, out=path)
    assert part.exists()
    counts = []
    fflin.sweep(
        robot, q, chunk=4, out=path, progress=lambda done, _: counts.append(done)
    )
    assert counts == [8, 12] and path.exists() and not part.exists()


@pytest.mark.compiled
@pytest.mark.parametrize("chunk", [10, 16, 23, 80])
def test_a_run_goes_on_in_the_chunks_that_it_was_begun_in(chunk, robot, tmp_path):
    """Another number of threads or workers would choose others."""
    q, _, _ = points(robot, 80)
    path = tmp_path / "b.h5"
    interrupted(robot, q, path, 64)
    messages = []
    batch = fflin.sweep(
        robot, q, chunk=chunk, out=path, progress=lambda *x: messages.append(x)
    )
    assert messages == [(64, 80), (80, 80)]
    assert np.array_equal(batch.B_lower, fflin.sweep(robot, q, threads=1).B_lower)


@pytest.mark.compiled
@pytest.mark.process
def test_a_file_that_another_run_writes_is_left_alone(robot, tmp_path):
    q, _, _ = points(robot, 80)
    path = tmp_path / "b.h5"
    interrupted(robot, q, path, 64)
    script = "import h5py, sys; f = h5py.File(sys.argv[1], 'r+'); print(1, flush=True); input()"
    command = [sys.executable, "-c", script, f"{path}.part"]
    with (
        subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE
        ) as process,
        finishing(process),
    ):
        assert process.stdout.readline()
        with pytest.raises(fflin.FileError, match="no other run"):
            fflin.sweep(robot, q, chunk=16, out=path)
        process.communicate(b"\n")
    fflin.sweep(robot, q, chunk=16, out=path)


@pytest.mark.compiled
def test_a_damaged_unfinished_file_is_one_line_or_its_chunk_is_done_again(
    robot, tmp_path
):
    q, _, _ = points(robot, 80)
    path, part = tmp_path / "b.h5", tmp_path / "b.h5.part"
    interrupted(robot, q, path, 64)
    whole, rng = part.read_bytes(), np.random.default_rng(0)
    expected = fflin.sweep(robot, q, threads=1).B_lower
    refused = 0
    for trial in range(60):
        content = bytearray(whole)
        # Half of them in the file's own records, which are few and in front.
        content[rng.integers(0, 2500 if trial % 2 else len(whole))] ^= 0xFF
        part.write_bytes(content if trial % 10 else content[: rng.integers(len(whole))])
        try:
            assert np.array_equal(
                fflin.sweep(robot, q, out=path, threads=1).B_lower, expected
            )
        except fflin.FileError as error:
            refused += 1
            assert ".part" in str(error) and "\n" not in str(error)
            part.unlink()
    assert 5 < refused < 55


def test_where_nothing_is_finished_nothing_is_left(robot, tmp_path):
    executor = ThreadPoolExecutor(1)
    executor.shutdown()
    with pytest.raises(fflin.SweepError, match=r"after shutdown$"):
        fflin.sweep(
            robot, points(robot, 8)[0], executor=executor, out=tmp_path / "b.h5"
        )
    assert not list(tmp_path.iterdir())


def test_an_empty_batch_is_not_saved(robot, tmp_path):
    batch = fflin.sweep(robot, points(robot, 8)[0])
    for ending in FORMATS:
        with pytest.raises(fflin.InputError, match="points"):
            batch[:0].save(tmp_path / f"b{ending}")
    with pytest.raises(fflin.InputError, match="points"):
        fflin.lqr_batch(batch[:0], 1.0, 1.0)
    assert not list(tmp_path.iterdir())


@pytest.mark.compiled
@pytest.mark.process
def test_a_killed_run_goes_on(robot, tmp_path):
    """SIGKILL in the middle of it, as a cluster does it."""
    script = textwrap.dedent("""
        import os, signal, sys, fflin
        def progress(done, total):
            if done >= 240:
                os.kill(os.getpid(), signal.SIGKILL)
        robot = fflin.load("ets_vii")
        points = fflin.random_configurations(robot, 4000, seed=3)
        fflin.sweep(robot, points, chunk=80, out=sys.argv[1], threads=1, progress=progress)
    """)
    path, part = tmp_path / "b.h5", tmp_path / "b.h5.part"
    command = [sys.executable, "-c", script, str(path)]
    assert finished(command).returncode == -signal.SIGKILL
    assert part.exists() and not path.exists()
    messages = []
    points = fflin.random_configurations(robot, 4000, seed=3)
    batch = fflin.sweep(
        robot,
        points,
        chunk=80,
        out=path,
        progress=lambda *counts: messages.append(counts[0]),
    )
    assert 240 <= messages[0] < 4000, "some chunks were kept"
    expected = fflin.sweep(robot, points)
    assert (
        np.abs(batch.B_lower - expected.B_lower).max()
        <= 1e-13 * np.abs(batch.B_lower).max()
    )
    assert np.array_equal(batch.q, expected.q)


@pytest.mark.compiled
def test_a_failed_chunk_leaves_the_others_in_the_file(tmp_path):
    robot = singular_at(0.5)
    configurations = fflin.grid(robot, {"slide": np.arange(64) / 64.0})
    for _ in range(2):
        with pytest.raises(fflin.SweepError, match=r"b\.h5\.part"):
            fflin.sweep(robot, configurations, chunk=10, out=tmp_path / "b.h5")
    assert [entry.name for entry in tmp_path.iterdir()] == ["b.h5.part"]


def test_without_h5py_the_error_names_the_package(tmp_path, monkeypatch):
    path = tmp_path / "b.h5"
    path.write_bytes(b"0" * 100)
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(fflin.MissingPackageError, match="h5py"):
        fflin.LinearBatch.load(path)


@pytest.mark.compiled
def test_an_empty_unfinished_file_does_not_stop_the_next_run(robot, tmp_path):
    q, _, _ = points(robot, 8)
    path = tmp_path / "b.h5"
    (tmp_path / "b.h5.part").touch()
    assert len(fflin.sweep(robot, q, out=path, threads=1)) == 8
    assert [entry.name for entry in tmp_path.iterdir()] == ["b.h5"]


class Killed(BaseException):
    """The process ends here."""


def store(path, request="a"):
    return FileStore(path, request, 8, 4, {"x": (2,)}, {}, {})


@pytest.mark.parametrize("step", ["_begin", "_name"])
def test_a_run_that_ends_before_it_begins_leaves_no_unfinished_file(
    step, tmp_path, monkeypatch
):
    def killed(*_):
        raise Killed

    path = tmp_path / "b.h5"
    with monkeypatch.context() as patched:
        patched.setattr(FileStore, step, killed)
        with pytest.raises(Killed):
            store(path)
    assert not (tmp_path / "b.h5.part").exists()
    store(path).discard()


def test_of_runs_that_begin_one_file_at_once_exactly_one_goes_on(tmp_path, monkeypatch):
    path = tmp_path / "b.h5"
    begun, original = [], FileStore._name

    def late(self, new):
        # Two other runs begin the file while this one prepares its own.
        if not begun:
            begun.append(self)
            begun.append(store(path))
            with pytest.raises(fflin.FileError):
                store(path, "b")
        original(self, new)

    monkeypatch.setattr(FileStore, "_name", late)
    with pytest.raises(fflin.FileError, match="at the same time"):
        store(path)
    _, first = begun
    rows = {"x": np.ones((4, 2))}
    for start in (0, 4):
        first.write(start, start + 4, rows)
    assert (first.complete()["x"] == 1.0).all()
    assert [entry.name for entry in tmp_path.iterdir()] == ["b.h5"]


def test_an_unfinished_file_is_not_written_through_a_link(tmp_path):
    target, path = tmp_path / "other", tmp_path / "b.h5"
    (tmp_path / "b.h5.part").symlink_to(target)
    for content in (None, b"kept"):
        if content:
            target.write_bytes(content)
        with pytest.raises(fflin.FileError, match="is a link"):
            output_path(path)
    assert target.read_bytes() == b"kept"
    target.unlink()
    with pytest.raises(fflin.FileError):
        store(path)
    assert not target.exists()
