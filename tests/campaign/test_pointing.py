"""Pointing errors of campaigns equal those of their runs, and have exact confidence intervals."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

import fflin
from fflin.base import intervals
from fflin.base.errors import InputError, UnknownNameError
from fflin.base.process import Progress
from fflin.commands.cli import main

SPREADS = {"q_b": 0.05, "*.mass": 0.02, "q_b.noise": 1e-4}


@pytest.fixture(scope="module")
def satellite():
    """Return a satellite with wheels, and its sampled law."""
    robot = fflin.load("cubesat", inputs=fflin.load_inputs("cubesat"))
    wheels = [item for item in robot.inputs if isinstance(item, fflin.ReactionWheel)]
    robot = robot.replace(inputs=wheels)
    lin = fflin.linearize(robot).discretize(0.5)
    return robot, fflin.StateFeedback(lin, fflin.lqr(lin).K)


@pytest.fixture(scope="module")
def campaign(satellite):
    """Return a campaign that was simulated in Python."""
    options = {"duration": 40.0, "dt": 0.25, "engine": "python", "seed": 2}
    return fflin.monte_carlo(*satellite, SPREADS, runs=9, **options)


def test_the_figures_are_those_of_every_run(campaign):
    how = {"accuracy": 0.5, "apart": 3.0, "after": 20.0}
    errors = campaign.pointing(4.0, **how)
    for run in (0, 4, 8):
        one = campaign.replay(run).pointing(4.0, **how)
        for kind in ("absolute", "mean", "relative", "drift"):
            for values, expected in zip(
                getattr(errors, kind), getattr(one, kind), strict=True
            ):
                assert np.array_equal(values[run], expected)
        settled = np.inf if one.settled is None else one.settled
        assert errors.settled[run] == settled
        assert errors.momentum_used["wheel_x"][run] == one.momentum_used["wheel_x"]
        assert errors.torque_used["wheel_x"][run] == one.torque_used["wheel_x"]
    assert errors.absolute.largest[:, 3].std() > 0.0
    assert len(errors) == 9 and errors.stopped == 0


def test_quantiles_and_fractions_have_the_intervals_of_order_statistics(campaign):
    errors = campaign.pointing(4.0, accuracy=0.5)
    angles = errors.absolute.largest[:, 3]
    assert errors.quantile("absolute angle", 0.5) == intervals.quantile(
        angles, 0.5, 0.95
    )
    limit = float(np.sort(angles)[5])
    condition = f"absolute angle < {3600.0 * limit * 1.0001} arcsec"
    assert errors.fraction(condition) == intervals.clopper_pearson(6, 9, 0.95)
    narrow = errors.fraction(condition, confidence=0.5)
    assert narrow == intervals.clopper_pearson(6, 9, 0.5)
    settled = errors.fraction("settled < 1000 s").value
    assert settled == pytest.approx(np.isfinite(errors.settled).mean())
    rates = errors.values("relative z p95"), errors.relative.p95[:, 2]
    assert np.array_equal(*rates)
    shares = np.max(list(errors.torque_used.values()), axis=0)
    assert np.array_equal(errors.values("wheel torque"), shares)
    with pytest.raises(UnknownNameError, match="figure"):
        errors.values("absolute angel")


def test_a_stopped_run_meets_no_condition(campaign):
    stop = np.zeros(9)
    stop[[1, 7]] = 1.0
    lost = replace(campaign, stop=stop)
    errors = lost.pointing(4.0)
    assert np.isinf(errors.absolute.largest[[1, 7]]).all() and errors.stopped == 2
    assert errors.fraction("absolute angle < 180 deg").value == pytest.approx(7 / 9)
    whole = campaign.pointing(4.0)
    kept = [0, 2, 3, 4, 5, 6, 8]
    assert np.array_equal(errors.relative.rms[kept], whole.relative.rms[kept])
    with pytest.raises(InputError, match="all runs were stopped"):
        replace(campaign, stop=np.ones(9)).pointing(4.0)


def test_a_line_of_sight_and_a_loaded_campaign(campaign, satellite, tmp_path):
    robot, law = satellite
    path = tmp_path / "runs.npz"
    campaign.save(path)
    loaded = fflin.Campaign.load(path)
    sight = {"line_of_sight": (1, 0, 0)}
    errors = loaded.pointing(4.0, **sight, robot=robot, policy=law)
    assert errors.axes == ("line of sight",)
    expected = campaign.pointing(4.0, **sight).absolute.largest
    assert np.array_equal(errors.absolute.largest, expected)
    assert errors.quantile("absolute line of sight", 0.5).value > 0.0
    with pytest.raises(InputError, match="loaded from a file"):
        loaded.pointing(4.0)


def test_the_report_states_the_interval_and_fits_the_screen(campaign):
    errors = campaign.pointing(4.0, accuracy=0.5)
    text = str(errors)
    assert max(map(len, text.splitlines())) <= 80
    value = errors.quantile("absolute angle", 0.95).value
    assert f"{value:.3g}" in text and "at 95 % confidence" in text
    assert "count from the settling of each run on" in " ".join(text.split())
    assert math.isinf(errors.quantile("absolute angle", 0.95).high)
    assert "fewer than 72 runs" in text
    for runs in (71, 72):
        bound = intervals.quantile(np.arange(1.0 * runs), 0.95, 0.95).high
        assert math.isinf(bound) == (runs < 72)
    card = errors._repr_html_()
    assert f"{value:.3g}" in card and "cubesat" in card


def test_thrusters_report_pulses_and_propellant():
    inputs = fflin.load_inputs("cubesat")
    thrusters = [item for item in inputs if isinstance(item, fflin.Thruster)]
    robot = fflin.load("cubesat", inputs=thrusters)
    design = robot.replace(inputs=[fflin.BaseTorque(), fflin.BaseForce()])
    lin = fflin.linearize(design).discretize(0.5)
    law = fflin.Allocation(fflin.StateFeedback(lin, fflin.lqr(lin).K), design)
    options = {"duration": 20.0, "dt": 0.25, "engine": "python"}
    runs = fflin.monte_carlo(robot, law, {"q_b": 0.05}, runs=3, **options)
    errors = runs.pointing(4.0)
    for run in range(3):
        firings = runs.replay(run).pointing(4.0).firings
        assert errors.thrusters["impulse"][run] == firings.impulse > 0.0
    assert "impulse of the thrusters" in str(errors)
    assert f"errors count from {errors.after[0]:.4g} s on" in str(errors)


@pytest.mark.compiled
def test_compiled_runs_have_the_figures_of_their_replays(satellite):
    # More runs than the compiled loop simulates at once.
    options = {"duration": 10.0, "dt": 0.25, "engine": "compiled"}
    runs = fflin.monte_carlo(*satellite, SPREADS, runs=11, **options)
    errors = runs.pointing(2.0)
    for run in (0, 7, 8, 10):
        one = runs.replay(run).pointing(2.0)
        assert np.array_equal(errors.absolute.p95[run], one.absolute.p95)
        assert np.array_equal(errors.relative.largest[run], one.relative.largest)


@pytest.mark.compiled
def test_a_stopped_lane_keeps_its_own_rows(satellite):
    # Some runs diverge at once, and their lanes then repeat another run.
    options = {"duration": 10.0, "dt": 0.25, "engine": "compiled"}
    runs = fflin.monte_carlo(*satellite, {"omega_b.x": [0.0, 1e7]}, runs=9, **options)
    assert 0 < runs.stopped.sum() < 9
    drawn = np.array(runs.drawn)
    motions = [*runs._job.replays(drawn[:8]), *runs._job.replays(drawn[8:])]
    for run, motion in enumerate(motions):
        expected = runs.replay(run)
        assert np.array_equal(motion.q, expected.q)
        assert np.array_equal(motion.t, expected.t)


def test_the_duration_of_pointing_errors_is_announced(campaign, capsys, monkeypatch):
    now = iter([0.0, 20.0])
    monkeypatch.setattr("fflin.campaign.pointing.monotonic", lambda: next(now))
    steps = []

    class Bar(Progress):
        def __call__(self, done, total, what="", hint=""):
            steps.append((done, total))

    campaign.pointing(4.0, progress=Bar())
    assert capsys.readouterr().err == (
        "fflin: pointing errors: about 2.7 min on 1 core\n"
    )
    assert steps == [(run + 1, 9) for run in range(9)]


@pytest.mark.exhaustive
def test_commands_report_pointing_errors(tmp_path, capsys):
    loop = ["planar_detumble", "--rpy", "0", "0", "10", "--duration", "30", "--dt"]
    loop += ["0.1", "--pointing", "5"]
    assert main(["simulate", *loop, "--accuracy", "1", "--json"]) == 0
    record = json.loads(capsys.readouterr().out)["pointing"]
    assert record["axes"][-1] == "angle" and record["window"] == 5.0
    assert record["settled"] > 0.0
    assert main(["simulate", *loop]) == 0
    assert "pointing errors" in capsys.readouterr().out
    spreads = tmp_path / "spreads.toml"
    spreads.write_text('[dispersions]\n"q_b" = 0.01\n')
    loop.insert(1, str(spreads))
    assert main(["montecarlo", *loop, "--runs", "4", "--json"]) == 0
    record = json.loads(capsys.readouterr().out)["pointing"]
    value, low, _ = record["quantiles"]["absolute angle"]["0.5"]
    assert value > 0.0 and record["units"]["absolute angle"] == "deg"
    assert low is None or low <= value
    assert main(["simulate", "planar_detumble", "--accuracy", "1"]) == 2
    assert "--accuracy needs --pointing" in capsys.readouterr().err
