"""The estimated time of campaigns and of `validity`, with a clock that counts steps."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import fflin
from fflin.base.process import Progress
from fflin.batch import run as batch_run
from fflin.batch.run import Execution
from fflin.campaign import runs as runs_module
from fflin.campaign.runs import CampaignJob
from fflin.commands import cli
from fflin.kernel import limits

STEP = 1e-3  # seconds of a step of one run


class Told(Progress):
    """A bar that keeps what it is told."""

    def expect(self, seconds, cores, faster=""):
        self.told = seconds, cores


@pytest.fixture
def clock(monkeypatch):
    """Let a run take a millisecond for each step and 20 ms at its start."""
    now, done, flown = [0.0], CampaignJob.run, runs_module._recorded

    def timed(job, rows, start, out):
        now[0] += len(rows["drawn"]) * 20.0 * STEP
        return done(job, rows, start, out)

    def stepped(plan, every):
        result = flown(plan, every)
        now[0] += result.steps * STEP  # a run may end early
        return result

    monkeypatch.setattr(CampaignJob, "run", timed)
    monkeypatch.setattr(runs_module, "_recorded", stepped)
    monkeypatch.setattr(runs_module, "perf_counter", lambda: now[0])
    return now


def loop_of(robot):
    lin = fflin.linearize(robot)
    gain = fflin.lqr(lin)
    return lin, gain, fflin.StateFeedback(lin, gain.K)


@pytest.mark.exhaustive
def test_a_campaign_and_validity_estimate_their_duration(clock):
    robot = fflin.load("cubesat")
    lin, gain, policy = loop_of(robot)
    bar, options = Told(), {"duration": 10.0, "dt": 0.1, "engine": "python"}
    campaign = fflin.monte_carlo(
        robot, policy, {"q_b": 0.1}, runs=3, progress=bar, **options
    )
    assert bar.told == (pytest.approx(3 * 120 * STEP), 1)
    work = [(campaign._job, campaign._job.dispersions.drawn(0, 1), 3)]
    runs_module.expect(bar, work, Execution(ThreadPoolExecutor(2)))
    assert bar.told == (pytest.approx(1.5 * 120 * STEP), 2)
    runs_module.expect(bar, work, Execution(ThreadPoolExecutor(20)))
    assert bar.told == (pytest.approx(120 * STEP), 3)
    silent = fflin.monte_carlo(robot, policy, {"q_b": 0.1}, runs=3, **options)
    assert (silent.q == campaign.q).all()  # the estimate changes no run
    before = clock[0]
    fflin.validity(robot, lin, gain, samples=30, engine="python", progress=bar)
    seconds, cores = bar.told
    # The clock also counts the runs of the estimate.
    assert cores == 1 and 0.5 < seconds / (clock[0] - before) < 2.0


@pytest.mark.parametrize(
    ("seconds", "cores", "message"),
    [
        (9.0, 1, ""),
        (41.4, 2, "fflin: about 41 s on 2 cores\n"),
        (119.0, 1, "fflin: about 120 s on 1 core\n"),
        (1260.0, 8, "fflin: about 21 min on 8 cores\n"),
        (9000.0, 8, "fflin: about 2.5 h on 8 cores\n"),
    ],
)
def test_an_estimate_is_a_line_on_stderr(capsys, seconds, cores, message):
    Progress().expect(seconds, cores)
    assert capsys.readouterr() == ("", message)


@pytest.mark.parametrize(
    ("seconds", "missing", "advice"),
    [(590.0, True, False), (700.0, True, True), (700.0, False, False)],
)
def test_a_long_estimate_names_the_missing_package(
    seconds, missing, advice, monkeypatch, capsys
):
    monkeypatch.setattr(limits, "numba_is_missing", lambda: missing)
    monkeypatch.setattr(CampaignJob, "seconds", lambda *_: seconds)
    robot = fflin.load("planar_detumble")
    options = {"duration": 1.0, "dt": 0.5, "engine": "python"}
    job = CampaignJob(robot, None, {"q_b": 0.1}, 0, options.pop("engine"), options)
    work = [(job, job.dispersions.drawn(0, 1), 3)]
    runs_module.expect(Progress(), work, Execution(ThreadPoolExecutor(1)))
    error = capsys.readouterr().err
    assert error.startswith("fflin: about ") and len(error) <= 80
    assert ("; faster: pip install 'fflin[fast]'" in error) == advice


def test_numba_does_not_help_where_something_else_prevents_compilation(monkeypatch):
    monkeypatch.setattr(limits, "numba_is_missing", lambda: True)
    robot = fflin.load("planar_detumble")
    assert limits.lacks_numba(limits.Task(robots=(robot,)))
    assert not limits.lacks_numba(limits.Task(robots=(robot,), events=True))


@pytest.mark.parametrize(
    "command",
    ["validity cubesat --samples 2", "montecarlo cubesat u.toml --runs 2 --duration 1"],
)
def test_commands_print_it_before_they_begin(command, tmp_path, monkeypatch, capsys):
    (tmp_path / "u.toml").write_text("[dispersions]\nq_b = 0.1\n")
    monkeypatch.setattr(CampaignJob, "seconds", lambda *_: np.float64(1000.0))
    monkeypatch.setattr(batch_run, "available_cores", lambda: 1)
    monkeypatch.chdir(tmp_path)
    assert cli.main(command.split()) == 0
    err = capsys.readouterr().err
    about, _, _ = err.splitlines()[0].partition(";")
    assert about in (
        "fflin: about 17 min on 1 core",
        "fflin: about 33 min on 1 core",
    )
