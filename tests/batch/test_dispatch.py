"""Sweeps on executors: in order, the robot unpickled once, executors that fail."""

import os
import signal
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from multiprocessing import get_context

import numpy as np
import pytest

import fflin
from fflin.batch import run as dispatching
from fflin.batch.run import Execution
from fflin.batch.sweep import ChunkJob
from fflin.kernel import compiled
from tests.support.messages import any_wording
from tests.support.patience import STALL, finished, finishing
from tests.support.robots import singular_at
from tests.support.sweeps import assert_same, points


@pytest.fixture(scope="module")
def pool():
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as executor:
        yield executor


@pytest.fixture
def robot(robots):
    return robots["ets_vii"]


@pytest.mark.compiled
@pytest.mark.process
@pytest.mark.parametrize("moving", [False, True])
def test_processes_agree_with_this_process(moving, pool, robot):
    q, v, u = points(robot, 50)
    arguments = (v, u) if moving else ()
    batch = fflin.sweep(robot, q, *arguments, executor=pool, chunk=4)
    for one, other in zip(batch, fflin.sweep(robot, q, *arguments), strict=True):
        # The compiled kernel may do one and the loop the other.
        assert_same(one, other, 1e-12 * one.certificate.condition)
    assert batch[0].certificate.inertia_residual < 1e-13


@pytest.mark.process
def test_a_worker_unpickles_the_robot_once(robot, monkeypatch):
    dispatching._unpickled.cache_clear()
    made = []
    load = dispatching.pickle.loads
    monkeypatch.setattr(
        dispatching.pickle, "loads", lambda job: made.append(job) or load(job)
    )
    q, _, _ = points(robot, 60)
    with ThreadPoolExecutor(1) as executor:
        batch = fflin.sweep(robot, q, engine="python", executor=executor, chunk=2)
    assert len(made) == 1
    assert np.array_equal(batch.q, q)


def kill_at(start_to_kill, marker, original=ChunkJob.run):
    """A run that kills its worker at one chunk, as long as the marker's count lasts."""

    def run(job, points, start, out):
        if start == start_to_kill and marker.exists():
            left = int(marker.read_text()) - 1
            if left:
                marker.write_text(str(left))
            else:
                marker.unlink()
            os.kill(os.getpid(), signal.SIGKILL)
        return original(job, points, start, out)

    return run


class KillingJob(ChunkJob):
    """A job whose worker is killed at the chunk that begins at 24."""

    marker = None

    def __reduce__(self):
        return _killing, (self.marker, self._again)

    def run(self, points, start, out):
        if self.marker is not None:
            return kill_at(24, self.marker)(self, points, start, out)
        return super().run(points, start, out)


def _killing(marker, again):
    job = again()
    job.marker = marker
    return job


@pytest.fixture
def killing(monkeypatch, tmp_path):
    """A function that lets the chunk at 24 kill its worker so many times."""
    marker = tmp_path / "marker"

    def set_up(times):
        marker.write_text(str(times))
        monkeypatch.setattr(KillingJob, "marker", marker)
        monkeypatch.setattr("fflin.batch.sweep.ChunkJob", KillingJob)

    return set_up


BEGIN = """
import os, sys, time
from fflin.batch.run import Execution

def busy(_):
    print("begun", flush=True)
    while True:
        pass

if __name__ == "__main__":
    with Execution(workers=2) as how:
        workers = how.executor
        workers.submit(pow, 2, 3).result()
        {task}
        sys.stdin.read()
"""


@pytest.mark.process
@pytest.mark.parametrize(
    "task, message",
    [
        ("workers.submit(busy, 0)", "begun"),
        ("workers.submit(time.sleep, 9999); print('begun', flush=True)", "begun"),
        ("print('idle', flush=True)", "idle"),
        (
            "workers.submit(pow, 2, 4); workers.submit(pow, 2, 4); print('new', flush=True)",
            "new",
        ),
    ],
)
@pytest.mark.parametrize("end", ["kill", "return"])
def test_no_worker_outlives_its_caller(task, message, end, tmp_path):
    """It is killed, or ends the workers; these may be busy, asleep, idle or not yet there."""
    script = tmp_path / "script.py"
    script.write_text(BEGIN.format(task=task))
    with subprocess.Popen(
        [sys.executable, script],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        with finishing(process, message):
            assert process.stdout.readline() == f"{message}\n"
        if end == "kill":
            process.kill()
        # The workers have the same stdout, which ends with the last of them.
        process.communicate(timeout=STALL)


@pytest.mark.compiled
def test_there_are_no_more_workers_than_cores(robot):
    cores = compiled.available_cores()
    with (
        any_wording(),
        pytest.warns(fflin.FflinWarning, match=f"1000000 .* {cores} "),
        Execution(workers=10**6) as how,
    ):
        assert how.count(None) == cores


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="no affinity")
@pytest.mark.parametrize(
    "files, cores",
    [
        (["150000 100000\n"], 2),
        (["max 100000\n"], 8),
        (["1000 100000\n"], 1),
        (["900000 100000\n"], 8),
        (["-1\n", "100000\n"], 8),
        (["300000\n", "100000\n"], 3),
        (["what is this"], 8),
    ],
)
def test_cores_match_the_container(files, cores, tmp_path, monkeypatch):
    paths = [tmp_path / str(index) for index in range(len(files))]
    for path, text in zip(paths, files, strict=True):
        path.write_text(text)
    monkeypatch.setattr(compiled, "_QUOTAS", (("/nowhere",), tuple(map(str, paths))))
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: range(8))
    assert compiled.available_cores() == cores


@pytest.mark.process
def test_workers_that_cannot_start_are_one_line(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(
        "import fflin\nrobot = fflin.load('ets_vii')\n"
        "try:\n"
        "    fflin.sweep(robot, fflin.random_configurations(robot, 40), workers=2)\n"
        "except fflin.SweepError as error:\n"
        "    print(error)\n"
        "    raise SystemExit(3)\n"
    )
    command = [sys.executable, "-W", "ignore", script]
    done = finished(command, capture_output=True, text=True)
    assert done.returncode == 3
    assert 'if __name__ == "__main__":' in done.stdout


@pytest.mark.compiled
@pytest.mark.process
def test_a_failed_executor_gives_a_one_line_error_and_keeps_finished_chunks(
    robot, killing, tmp_path
):
    pytest.importorskip("h5py")
    q, _, _ = points(robot, 80)
    killing(1)
    path = tmp_path / "b.h5"
    with (
        ProcessPoolExecutor(1, mp_context=get_context("spawn")) as doomed,
        any_wording(),
        pytest.raises(fflin.SweepError, match="BrokenProcessPool") as caught,
    ):
        fflin.sweep(robot, q, executor=doomed, chunk=8, out=path)
    assert (24, 32) in [failure[:2] for failure in caught.value.failed]
    messages = []
    batch = fflin.sweep(
        robot,
        q,
        executor=None,
        chunk=8,
        out=path,
        progress=lambda done, _: messages.append(done),
    )
    assert messages[0] == 24
    assert np.abs(batch.B_lower - fflin.sweep(robot, q).B_lower).max() < 1e-13


def test_an_object_that_only_submits_is_an_executor(robot):
    class Submitting:
        def __init__(self, pool):
            self.submit = pool.submit

    q = np.tile(robot.neutral(), (4, 1))
    with ThreadPoolExecutor(1) as pool:
        batch = fflin.sweep(
            robot, q, engine="python", executor=Submitting(pool), chunk=2
        )
    np.testing.assert_array_equal(batch.A, fflin.sweep(robot, q, engine="python").A)
    with pytest.raises(fflin.InputError, match="executor has type int"):
        fflin.sweep(robot, q, executor=3)


def test_an_executor_that_is_shut_down_is_one_line(robot):
    executor = ThreadPoolExecutor(1)
    executor.shutdown()
    q, _, _ = points(robot, 8)
    with pytest.raises(fflin.SweepError, match="shutdown"):
        fflin.sweep(robot, q, executor=executor)


@pytest.mark.compiled
def test_an_executor_that_takes_no_more_is_one_line(robot):
    class Full(ThreadPoolExecutor):
        def submit(self, *arguments):
            if len(taken) == 2:
                raise ValueError("no slots")
            taken.append(arguments)
            return super().submit(*arguments)

    taken = []
    q, _, _ = points(robot, 32)
    with (
        Full(1) as executor,
        pytest.raises(fflin.SweepError, match="no slots") as caught,
    ):
        fflin.sweep(robot, q, executor=executor, chunk=8)
    assert len(caught.value.batch) == 16


@pytest.mark.process
def test_a_singular_configuration_is_named_by_processes_too(pool):
    robot = singular_at(0.5)
    configurations = fflin.grid(robot, {"slide": np.arange(64) / 64.0})
    with pytest.raises(fflin.SweepError, match=r"32.*'singular'"):
        fflin.sweep(robot, configurations, chunk=10, executor=pool, engine="python")


@pytest.mark.compiled
@pytest.mark.process
def test_dask(robot):
    """A local cluster of two processes, of which one is killed on the way."""
    distributed = pytest.importorskip("distributed")
    import dask

    waits = ("connect", "tcp")
    with (
        dask.config.set(
            {f"distributed.comm.timeouts.{wait}": f"{STALL} s" for wait in waits}
        ),
        distributed.LocalCluster(
            n_workers=2,
            threads_per_worker=1,
            processes=True,
            dashboard_address="127.0.0.1:0",
        ) as cluster,
        distributed.Client(cluster) as client,
    ):
        assert Execution(client.get_executor()).count(None) == 2
        configurations = fflin.random_configurations(robot, 400, seed=1)
        expected = fflin.sweep(robot, configurations)
        q, v, u = points(robot, 30)
        moving = fflin.sweep(robot, q, v, u, executor=client.get_executor(), chunk=7)
        matrices = fflin.sweep(robot, q, v, u).A
        assert np.abs(moving.A - matrices).max() < 1e-12 * np.abs(matrices).max()
        worker = next(iter(client.scheduler_info()["workers"].values()))["id"]
        pid = next(
            nanny.pid for name, nanny in cluster.workers.items() if name == worker
        )
        killed = []

        def kill(done, _):
            if not killed:
                killed.append(done)
                os.kill(pid, signal.SIGKILL)

        batch = fflin.sweep(
            robot,
            configurations,
            executor=client.get_executor(),
            chunk=10,
            progress=kill,
        )
    assert killed
    assert np.array_equal(batch.q, expected.q)
    assert np.abs(batch.B_lower - expected.B_lower).max() < 1e-13
