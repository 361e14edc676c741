"""The error budget of `fflin simulate`, and the errors of its sensors."""

import json

import numpy as np
import pytest

import fflin
from fflin.commands.cli import main
from tests.support.commands import refused, run

FILE = """urdf = "cubesat"
[disturbance]
tau_b = [2e-7, 0, 0]
"""


@pytest.fixture
def satellite(tmp_path, monkeypatch):
    """Write a robot file with a disturbance into the working directory; return its name."""
    monkeypatch.chdir(tmp_path)
    inputs = '[[input]]\ntype = "base_torque"\nmax = 1e-3\n'
    text = FILE + inputs
    (tmp_path / "satellite.toml").write_text(text)
    return "satellite.toml"


LOOP = ("--sample", 0.5, "--duration", 60, "--dt", 0.25)


def test_simulate_reports_the_errors_by_cause(satellite, capsys):
    options = [*map(str, LOOP), "--noise", "q_b=1e-6", "--bias", "omega_b.y=1e-6"]
    assert main(["simulate", satellite, *options, "--budget", "--json"]) == 0
    budget = json.loads(capsys.readouterr().out)["budget"]
    causes = [part["cause"] for part in budget["contributions"]]
    assert causes == [
        "noise of q_b",
        "bias of omega_b.y",
        "constant tau_b",
        "simulated minus superposed",
    ]
    robot = fflin.load(satellite)
    lin = fflin.linearize(robot).discretize(0.5)
    policy = fflin.StateFeedback(lin, fflin.lqr(lin))
    given = {"noise": {"q_b": 1e-6}, "bias": {"omega_b.y": 1e-6}, "robot": robot}
    expected = fflin.error_budget(policy, lin, **given)
    for part, found in zip(
        expected.contributions, budget["contributions"], strict=False
    ):
        np.testing.assert_allclose(found["size"], part.size, rtol=1e-12)
    # The simulation contains the bias and the torque, so that its mean shows both.
    mean = np.abs(budget["simulated_mean"])
    np.testing.assert_allclose(mean[:2], expected.constant[:2], rtol=0.1)
    assert budget["simulated_deviation"][2] > 0.2 * expected.deviation[2]


def test_both_tables_count_the_errors_from_the_same_time_on(satellite, capsys):
    options = [*map(str, LOOP), "--noise", "q_b=1e-6", "--rpy", "1", "0", "0"]
    options += ["--pointing", "5", "--accuracy", "0.05", "--budget"]
    assert main(["simulate", satellite, *options]) == 0
    report = " ".join(capsys.readouterr().out.split())
    start = report.split("pointing errors from ")[1].split(" s on")[0]
    assert float(start) not in (0.0, 30.0)  # the time at which the motion has settled
    assert f"simulated: errors of the motion from {start} s on" in report


def test_what_has_no_budget_is_refused(satellite, tmp_path):
    for options in (("--free",), ("--mpc", "--sample", 0.5, "--horizon", 4)):
        message = refused(
            *("simulate", satellite, *options, "--duration", 2, "--budget"),
            cwd=tmp_path,
        )
        assert "linear regulator about a point" in message
    for options in (("--noise", "q_b=1e-6"), ("--free", "--bias", "q_b=1e-6")):
        refused("simulate", satellite, *options, "--duration", 2, cwd=tmp_path)
    code, _, err = run(
        *("simulate", satellite, *LOOP, "--noise", "gyro=1"), cwd=tmp_path
    )
    assert code == 2 and "gyro" in err


SENSORS = """
[[output]]
type = "star_tracker"
noise = 1e-5
[[output]]
type = "gyroscope"
frame = "base"
noise = 1e-6
"""


def test_a_budget_contains_the_noise_that_outputs_declare(satellite, tmp_path):
    (tmp_path / "measured.toml").write_text(
        (tmp_path / "satellite.toml").read_text() + SENSORS
    )
    robot = fflin.load("measured.toml")
    lin = fflin.linearize(robot).discretize(0.5)
    compensator = fflin.lqg(fflin.lqr(lin), fflin.kalman(lin, 1e-10))
    policy = fflin.OutputFeedback(lin, compensator)
    declared = {part.cause: part for part in budget_of(policy, lin, robot)}
    by_hand = fflin.error_budget(
        policy, lin, noise={"q_b": 1e-5, "base.gyroscope.*": 1e-6}
    )
    for part in by_hand.contributions:
        np.testing.assert_allclose(declared[part.cause].size, part.size, rtol=1e-12)
    assert len(declared) == 3
    none = budget_of(policy, lin, robot, noise={})
    assert [part.cause for part in none] == ["constant tau_b"]


def budget_of(policy, lin, robot, **given):
    return fflin.error_budget(policy, lin, robot=robot, **given).contributions


@pytest.mark.compiled
def test_a_campaign_reports_the_budget_of_the_nominal_robot(satellite, tmp_path):
    (tmp_path / "u.toml").write_text('[dispersions]\n"omega_b.z" = 1e-4\n')
    options = ("--runs", 3, *LOOP)
    command = ("montecarlo", satellite, "u.toml", *options, "--budget", "--json")
    code, out, _ = run(*command, cwd=tmp_path)
    assert code == 0
    (cause,) = json.loads(out)["budget"]["contributions"]
    assert cause["cause"] == "constant tau_b"
    refused("montecarlo", satellite, "u.toml", "--free", "--budget", cwd=tmp_path)
