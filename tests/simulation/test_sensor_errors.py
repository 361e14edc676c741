"""Noise and drifting biases that outputs declare act in simulations and campaigns."""

import numpy as np
import pytest

import fflin
from fflin.control.data_sheet import declared_deviations
from fflin.control.sensor_errors import SensorErrors
from tests.support.marks import exhaustive

LATE = {"sample": 0.5, "delay": 0.25}


def designed(law="multirate", noise=1e-4, drift=1e-5):
    """Return a satellite whose sensors declare errors, and a law of its outputs."""
    late = LATE if law == "multirate" else {}
    outputs = [
        fflin.StarTracker(noise=noise, **late),
        fflin.Gyroscope("base", noise=noise, bias=drift),
    ]
    robot = fflin.load("cubesat", inputs=[fflin.BaseTorque()], outputs=outputs)
    lin = fflin.linearize(robot).discretize(0.25)
    compensator = fflin.lqg(fflin.lqr(lin), fflin.kalman(lin, {"omega_b": 1e-10}))
    if law == "multirate":
        return robot, fflin.MultirateFeedback(lin, compensator)
    return robot, fflin.OutputFeedback(lin, compensator)


def test_figures_of_data_sheets_are_deviations_of_a_sample_and_of_a_second():
    gyroscope = fflin.Gyroscope(
        "base", noise={"angle_random_walk": 0.6}, bias={"bias_instability": 36.0}
    )
    tracker = fflin.StarTracker(sample=0.5, noise={"noise_equivalent_angle": 10.0})
    sizes = declared_deviations(
        ("rate", "q", "other"),
        ("rad/s", "1", "m"),
        {"rate": gyroscope, "q": tracker},
        0.25,
    )
    # 0.6 deg in one hour are 0.01 deg/sqrt(s).
    assert sizes.noise[0] == pytest.approx(np.radians(0.01) / np.sqrt(0.25))
    assert sizes.noise[1] == pytest.approx(0.5 * np.radians(10.0 / 3600.0))
    # 36 deg/h in one hour.
    assert sizes.drift[0] == pytest.approx(np.radians(0.01) / 60.0)
    assert sizes.noise[2] == sizes.drift[1] == sizes.drift[2] == 0.0


def test_errors_have_the_declared_deviations_and_repeat():
    steps = np.array([0.0, 2.0])
    errors = SensorErrors(np.zeros(2), np.array([3.0, 0.0]), steps, 5)
    first = np.array([errors(0.1 * k) for k in range(4000)])
    again = np.array([errors(0.1 * k) for k in range(4000)])
    assert (first == again).all()
    # The standard error of a deviation of 4,000 samples is 1.1 %.
    assert first[:, 0].std() == pytest.approx(3.0, rel=0.04)
    assert first[0, 1] == 0.0
    assert np.diff(first[:, 1]).std() == pytest.approx(2.0, rel=0.04)
    other = SensorErrors(np.zeros(2), np.array([3.0, 0.0]), steps, 6)
    assert other(0.0)[0] != first[0, 0]


@pytest.mark.parametrize("law", ["multirate", *exhaustive("ordinary")])
def test_declared_errors_act_and_can_be_left_out(law):
    robot, policy = designed(law)
    noisy, same, other, quiet = (
        fflin.simulate(robot, policy, duration=5.0, dt=0.05, **options)
        for options in ({}, {}, {"seed": 1}, {"noise": 0.0})
    )
    assert (noisy.u == same.u).all() and not (noisy.u == other.u).all()
    assert not quiet.u.any() and noisy.u.any()
    notes = [note for note in noisy.notes if "the outputs declare" in note]
    assert notes == [
        "measurements contain the noise of q_b, base.gyroscope and the drifting bias of "
        "base.gyroscope that the outputs declare (seed 0; noise=0 leaves them out)"
    ]
    assert not any("declare" in note for note in quiet.notes)
    with pytest.raises(fflin.InputError, match="noise is -1, expected a factor"):
        fflin.simulate(robot, policy, duration=1.0, noise=-1.0)


def test_the_noise_of_a_law_replaces_that_of_its_outputs():
    robot, policy = designed()
    silent = fflin.MultirateFeedback(
        policy.lin, policy.compensator, noise=lambda t: np.zeros(6)
    )
    assert not fflin.simulate(robot, silent, duration=2.0).u.any()


def test_each_run_of_a_campaign_draws_its_own_errors():
    robot, policy = designed()
    spreads = {"q_b": 0.0}
    options = {"runs": 3, "duration": 5.0, "dt": 0.05, "engine": "python"}
    runs = fflin.monte_carlo(robot, policy, spreads, **options)
    assert {"q_b.x.noise", "base.gyroscope.z.drift"} <= set(runs.names)
    motions = [runs.replay(k) for k in range(2)]
    assert motions[0].u.any() and not np.allclose(motions[0].u, motions[1].u)
    quiet = fflin.monte_carlo(robot, policy, spreads, **options, noise=0.0)
    assert not any("noise" in name or "drift" in name for name in quiet.names)
    assert not quiet.replay(0).u.any()
    given = fflin.monte_carlo(
        robot, policy, {"q_b.x.noise": 0.5, "base.gyroscope.x.drift": 0.0}, **options
    )
    at = given.names.index("q_b.x.noise")
    assert (given.drawn[:, at] == 0.5).all()


@pytest.mark.exhaustive
@pytest.mark.compiled
@pytest.mark.parametrize("law", ["multirate", "ordinary"])
def test_both_engines_draw_the_same_errors(law):
    robot, policy = designed(law)
    options = {"duration": 60.0, "dt": 0.05}
    python, compiled = (
        fflin.simulate(robot, policy, engine=engine, **options)
        for engine in ("python", "compiled")
    )
    assert np.abs(python.x).max() > 1e-5
    assert compiled.x == pytest.approx(python.x, rel=1e-9, abs=1e-13)
    campaigns = [
        fflin.monte_carlo(
            robot, policy, {"omega_b": 1e-4}, runs=9, engine=engine, **options
        )
        for engine in ("python", "compiled")
    ]
    ends = [campaign.x for campaign in campaigns]
    assert ends[1] == pytest.approx(ends[0], rel=1e-9, abs=1e-13)
