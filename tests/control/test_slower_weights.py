"""Default weights of loops with delays and lags: a disk margin of 2/3, which is 6 dB."""

import re

import numpy as np
import pytest

import fflin
from fflin.control.slower_weights import LEAST_DISK, Slowed, slowed
from tests.control.test_multirate import W, designed


def satellite(lag=None, **sensor):
    outputs = [fflin.BasePose(**sensor), fflin.Gyroscope("base")]
    return fflin.load("cubesat", inputs=[fflin.BaseTorque(lag=lag)], outputs=outputs)


def slow_filter(model):
    return fflin.kalman(
        model, {"omega_b": 1e-7}, {"q_b": 1e-5, "gyroscope": 1e-2, "r_b": 1.0}
    )


def factor_of(text):
    return float(re.search(r"made ([\d.]+) times slower", text)[1])


@pytest.mark.exhaustive
def test_a_lag_that_the_model_lacks_makes_default_weights_slower():
    lin = fflin.linearize(satellite(lag=3.0))
    model = lin.discretize(0.5, delay=0.25)
    gain = fflin.lqr(model)
    plain = fflin.lqr(fflin.linearize(satellite()).discretize(0.5, delay=0.25))
    with pytest.warns(fflin.FflinWarning, match="not designed"):
        disk = fflin.margins(gain, model).disk
    assert LEAST_DISK <= disk < 1.021 * LEAST_DISK
    assert f"to {disk:.3g} (gain" in gain.weights
    # a double integrator: K scales like the square of the bandwidth
    factor = factor_of(gain.weights)
    assert factor > 1.2
    ratio = plain.K[0, 0] / gain.K[0, 0]
    assert ratio == pytest.approx(factor**2, rel=0.1)


@pytest.mark.exhaustive
@pytest.mark.parametrize("integral", [None, ["q_b"]])
def test_a_compensator_with_delay_has_the_margin(integral):
    model = fflin.linearize(satellite()).discretize(0.5, delay=0.5)
    gain = fflin.lqr(model, integral_action=integral)
    compensator = fflin.lqg(gain, slow_filter(model))
    disk = fflin.margins(fflin.OutputFeedback(model, compensator), model).disk
    assert LEAST_DISK <= disk < 1.021 * LEAST_DISK
    assert "made" not in gain.weights
    assert compensator.pace in " ".join(str(compensator).split())
    assert f"to {disk:.3g} (gain" in compensator.pace
    factor = factor_of(compensator.pace)
    feedback = -compensator.C[0, 0]
    assert gain.K[0, 0] / feedback == pytest.approx(factor**2, rel=0.2)


@pytest.mark.exhaustive
def test_a_loop_with_a_late_star_tracker_has_the_margin():
    _, model, given = designed()
    estimator = fflin.kalman(model, W, disturbance_noise={"tau_b": 1e-16})
    compensator = fflin.lqg(fflin.lqr(model), estimator)
    assert given.pace == ""
    disk = fflin.margins(fflin.MultirateFeedback(model, compensator), model).disk
    assert LEAST_DISK <= disk < 1.021 * LEAST_DISK
    before = fflin.margins(fflin.MultirateFeedback(model, given), model).disk
    assert f"from {before:.3g} to {disk:.3g} (gain" in compensator.pace
    assert compensator.pace in " ".join(str(compensator).split())


@pytest.mark.exhaustive
def test_weights_from_the_user_are_not_changed():
    model = fflin.linearize(satellite(lag=8.0)).discretize(0.5, delay=0.5)
    default = fflin.lqr(model)
    for gain in (
        fflin.lqr(model, default.Q, default.R, default.N),
        fflin.lqr(model, weights={"bryson": {"tau_b": 1e-3}}),
        fflin.lqr(model, weights="identity"),
    ):
        assert "slower" not in gain.weights
        compensator = fflin.lqg(gain, slow_filter(model))
        assert compensator.pace == ""


def test_loops_without_delay_and_lag_are_not_changed():
    model = fflin.linearize(satellite()).discretize(3.0)
    gain = fflin.lqr(model)
    compensator = fflin.lqg(gain, slow_filter(model))
    disk = fflin.margins(fflin.OutputFeedback(model, compensator), model).disk
    assert disk < LEAST_DISK
    assert compensator.pace == ""
    columns = [model.state_names.index(name) for name in compensator.state_names]
    np.testing.assert_array_equal(compensator.C, -gain.K[:, columns])


def test_the_search_returns_the_fastest_design_with_the_margin():
    design, change = slowed(1.0, lambda factor: factor, lambda factor: 0.2 * factor)
    assert LEAST_DISK / 0.2 <= design <= 1.02 * LEAST_DISK / 0.2
    assert change == Slowed(design, 0.2, 0.2 * design)
    assert slowed(1.0, None, lambda _: LEAST_DISK) == (1.0, None)
    assert slowed(1.0, None, lambda _: None) == (1.0, None)


def test_a_margin_that_no_pace_reaches_is_reported():
    design, change = slowed(1.0, lambda factor: factor, lambda _: 0.5)
    assert design == 1.0
    assert str(change) == (
        "the disk margin 0.5 (gain 0.6 to 1.67) is below 0.667 (6 dB), and a loop that is 4 times "
        "slower does not reach it"
    )


def test_a_gain_that_cannot_be_designed_ends_the_search():
    def fail(_):
        raise fflin.StabilizabilityError("no gain")

    design, change = slowed(1.0, fail, lambda _: 0.5)
    assert design == 1.0
    assert change.disk == 0.5


@pytest.mark.exhaustive
def test_a_lag_of_redundant_wheels_leaves_the_margins():
    axes = [(1, 0, 1), (-1, 0, 1), (0, 1, 1), (0, -1, 1)]
    wheels = [fflin.ReactionWheel(axis, inertia=1e-5, lag=0.5) for axis in axes]
    lin = fflin.linearize(fflin.load("cubesat", inputs=wheels)).with_lags()
    for dt in (0.5, 1.0):
        model = lin.discretize(dt, delay=0.25)
        gain = fflin.lqr(model, {"q_b": 1.0}, {"wheel": 1e6})
        assert fflin.margins(gain, model).disk == pytest.approx(
            gain.margins.disk, rel=1e-4
        )


def test_a_filter_that_limits_the_margin_is_named():
    model = fflin.linearize(satellite()).discretize(0.25, delay=0.25)
    noise = {"q_b": 1e-9, "gyroscope": 1e-9, "r_b": 1e-4}
    estimator = fflin.kalman(
        model, {"omega_b": 1e-12}, noise, disturbance_noise={"tau_b": 1e-10}
    )
    gain = fflin.lqr(model)
    compensator = fflin.lqg(gain, estimator)
    disk = fflin.margins(fflin.OutputFeedback(model, compensator), model).disk
    assert disk < LEAST_DISK
    assert f"the disk margin {disk:.3g} (gain" in compensator.pace
    assert compensator.pace.endswith("smaller disturbance_noise of kalman may raise it")
    columns = [
        model.state_names.index(name)
        for name in gain.regulated
        if not name.startswith("past")
    ]
    assert np.abs(compensator.C[:, : len(columns)] + gain.K[:, columns]).max() < 1e-12
