"""Any rows through any job: drawn by a seed, on threads or workers, into a file that goes on."""

import os
import sys
import textwrap
from contextlib import closing

import numpy as np
import pytest

import fflin
from fflin.batch.files import FileStore, MemoryStore, read_rows
from fflin.batch.run import Execution, run_chunks
from tests.support.marks import exhaustive
from tests.support.messages import any_wording
from tests.support.patience import finished

COUNT, CHUNK = 50, 8
ALONE = Execution(threads=1)
STORED = {"seed": (), "walk": (3,)}


class Walks:
    """Random walks; that of one seed has no end."""

    shapes = {"walk": (3,)}  # noqa: RUF012
    threaded = True

    def __init__(self, endless=-1):
        self.endless = endless

    def run(self, rows, start, out):
        for at, seed in enumerate(rows["seed"].astype(int)):
            if seed == self.endless:
                raise fflin.FflinError(f"walk {start + at} has no end")
            out["walk"][at] = (
                np.random.default_rng(seed).normal(size=(9, 3)).sum(axis=0)
            )
        return ["tired"] * (start == 0)


def seeds(start, stop):
    return {"seed": np.arange(start, stop, dtype=float)}


@pytest.fixture(scope="module")
def expected():
    store = MemoryStore(COUNT, COUNT, STORED)
    with pytest.warns(fflin.FflinWarning, match="tired"):
        run_chunks(Walks(), seeds, store, ALONE)
    return store.arrays


@pytest.mark.filterwarnings("ignore:tired")
@pytest.mark.parametrize("threads, workers", [(1, 0), (3, 0), *exhaustive((1, 2))])
def test_a_file_goes_on_where_a_run_ended_and_is_the_same_on_any_workers(
    threads, workers, expected, tmp_path
):
    pytest.importorskip("h5py")
    path, messages = tmp_path / "walks.h5", []

    def run(job):
        texts = {"kind": "walks"}
        pace = {"pace": np.array([1.5])}
        with (
            closing(
                FileStore(path, "request", COUNT, CHUNK, STORED, pace, texts)
            ) as store,
            Execution(workers=workers or None, threads=threads) as how,
        ):
            tell = lambda done, _: messages.append(done)  # noqa: E731
            run_chunks(job, seeds, store, how, tell, of_what="walks", made=list)
            store.complete()

    with pytest.raises(fflin.SweepError, match=r"1 of 7.*16 to 23.*20"):
        run(Walks(endless=20))
    messages.clear()
    run(Walks())
    assert messages == [42, 50]
    arrays, constant, texts, verified = read_rows(path, verify=True)
    assert verified and constant == ["pace"] and texts["kind"] == "walks"
    assert np.array_equal(arrays["pace"], [1.5])
    for key, value in expected.items():
        assert np.array_equal(arrays[key], value)


@pytest.mark.filterwarnings("ignore:tired")
def test_where_all_chunks_are_needed_the_first_that_fails_is_the_last():
    messages, store = [], MemoryStore(COUNT, CHUNK, STORED)
    tell = lambda done, _: messages.append(done)  # noqa: E731
    with any_wording(), pytest.raises(fflin.FflinError, match="walk 20 has no end"):
        run_chunks(Walks(endless=20), seeds, store, ALONE, tell)
    assert messages == [8, 16]


def test_an_error_in_memory_carries_the_partial_result():
    store = MemoryStore(COUNT, CHUNK, STORED)
    with (
        pytest.warns(fflin.FflinWarning, match="tired"),
        any_wording(),
        pytest.raises(fflin.SweepError) as caught,
    ):
        run_chunks(
            Walks(endless=20), seeds, store, ALONE, made=lambda rows: rows["seed"]
        )
    error = caught.value
    assert error.failed == ((16, 24, "walk 20 has no end"),)
    assert np.array_equal(error.batch, np.r_[0:16, 24:50])


class CountedWalks(Walks):
    """Walks that count the chunks that are computed."""

    def __init__(self, endless=-1):
        super().__init__(endless)
        self.starts = []

    def run(self, rows, start, out):
        self.starts.append(start)
        return super().run(rows, start, out)[:0]


def test_a_second_call_in_memory_computes_only_the_missing_rows(expected):
    job, store = CountedWalks(), MemoryStore(COUNT, CHUNK, STORED)
    run_chunks(job, seeds, store, ALONE, upto=20)
    assert job.starts == [0, 8, 16]
    run_chunks(job, seeds, store, ALONE)
    assert job.starts == [0, 8, 16, 24, 32, 40, 48]
    assert np.array_equal(store.arrays["walk"], expected["walk"])


def test_the_error_of_a_part_has_no_rows_that_were_not_computed():
    job, store = CountedWalks(endless=4), MemoryStore(COUNT, CHUNK, STORED)
    with any_wording(), pytest.raises(fflin.SweepError) as caught:
        run_chunks(job, seeds, store, ALONE, made=lambda rows: rows["seed"], upto=20)
    assert np.array_equal(caught.value.batch, np.r_[8:24])


# The worker sends the length of a result, and dies before it sends the result.
DYING = """
    import os, struct, sys
    from fflin.base.errors import FflinError
    from fflin.batch.run import OwnWorkers
    def half():
        frame = sys._getframe()
        while "result_queue" not in frame.f_locals:
            frame = frame.f_back
        os.write(frame.f_locals["result_queue"]._writer.fileno(), struct.pack("!i", 1000))
        os._exit(1)
    if __name__ == "__main__":
        with OwnWorkers(1) as workers:
            try:
                workers.submit(half).result()
            except FflinError as error:
                print(error)
            print(workers.submit(int).result())
"""


@pytest.mark.process
def test_a_worker_that_dies_while_it_sends_a_result_is_replaced(tmp_path):
    script = tmp_path / "dying.py"
    script.write_text(textwrap.dedent(DYING))
    done = finished(
        [sys.executable, script],
        capture_output=True,
        text=True,
        env=os.environ,
        check=True,
    )
    assert "a worker process died" in done.stdout
    assert done.stdout.splitlines()[-1] == "0"
