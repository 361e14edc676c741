"""Laws that were not designed for the lags or the constraints of the robot that they control."""

import warnings

import numpy as np
import pytest

import fflin
from fflin.control.margins import delayed_model

INPUT_LAG, OUTPUT_LAG = 0.3, 0.2


def satellite(lag=INPUT_LAG, output_lag=OUTPUT_LAG):
    inputs = [fflin.BaseTorque(lag=lag), fflin.BaseForce()]
    outputs = [fflin.BasePose(lag=output_lag), fflin.Gyroscope("base")]
    return fflin.load("cubesat", inputs=inputs, outputs=outputs)


def state_law(lin):
    return fflin.StateFeedback(lin, fflin.lqr(lin))


def output_law(lin):
    estimator = fflin.kalman(lin, 1e-6, 1e-6)
    return fflin.LinearController(fflin.lqg(fflin.lqr(lin), estimator), lin)


def same_model(model, expected):
    assert model.state_names == expected.state_names
    for name in ("A", "B", "C", "D"):
        value, other = getattr(model, name), getattr(expected, name)
        np.testing.assert_allclose(value, other, rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("make", [state_law, output_law])
@pytest.mark.parametrize("dt", [0.2, 0.0])
def test_the_loop_of_a_blind_law_contains_the_lags_of_the_robot(make, dt):
    plain, robot = fflin.linearize(satellite(None, None)), satellite()
    lin = fflin.linearize(robot)
    lagging = lin.with_lags(None if make is output_law else {"tau_b": INPUT_LAG})
    if dt:
        plain, lin, lagging = (x.discretize(dt) for x in (plain, lin, lagging))
    for law in (make(plain), make(lin)):
        same_model(delayed_model(law, lin, None)[0], lagging)
        same_model(delayed_model(law, plain, None)[0], plain)


@pytest.mark.parametrize("make", [state_law, output_law])
def test_the_loop_of_an_aware_law_needs_no_other_model(make):
    lin = fflin.linearize(satellite())
    lags = None if make is output_law else {"tau_b": INPUT_LAG}
    aware = lin.with_lags(lags).discretize(0.2, delay=0.1)
    law = make(aware)
    for model in (lin, lin.discretize(0.2, delay=0.1), aware):
        same_model(delayed_model(law, model, None)[0], aware)


@pytest.mark.exhaustive
def test_margins_say_once_that_a_law_was_not_designed_for_lags():
    lin = fflin.linearize(satellite())
    blind, aware = state_law(lin), state_law(lin.with_lags())
    with pytest.warns(fflin.FflinWarning, match="for which the law was not") as warned:
        margins = fflin.margins(blind, lin)
    assert len(warned) == 1
    assert margins.disk == pytest.approx(fflin.margins(blind, lin.with_lags()).disk)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert margins.disk < fflin.margins(aware, lin).disk


def test_a_motion_says_once_that_a_law_does_not_know_the_lags():
    robot = satellite()
    lin = fflin.linearize(robot)
    options = {"duration": 0.4, "dt": 0.1, "engine": "python"}
    for design, count in ((lin, 1), (lin.with_lags(), 0)):
        law = state_law(design.discretize(0.2))
        notes = fflin.simulate(robot, law, **options).notes
        found = [note for note in notes if "the motion contains lags" in note]
        assert len(found) == count
    campaign = fflin.monte_carlo(
        robot, state_law(lin.discretize(0.2)), {"q_b": 0.01}, runs=2, **options
    )
    assert sum("tau_b.x (0.3 s)" in note for note in campaign.notes) == 1
    law = state_law(lin.with_lags().discretize(0.2))
    free = satellite(None, None)
    notes = fflin.simulate(free, law, **options).notes
    assert sum("the motion lacks lags" in note for note in notes) == 1


def test_a_gain_of_constrained_robots_does_not_fly_on_the_free_robot_or_vice_versa():
    weld = fflin.Weld("tool_left", "tool_right")
    held, free = fflin.load("dual_arm", constraints=[weld]), fflin.load("dual_arm")
    q = fflin.closed(held, free.neutral())
    constrained, plain = fflin.linearize(held, q), fflin.linearize(free, q)
    laws = {
        robot: fflin.StateFeedback(lin, np.zeros(lin.B.T.shape))
        for robot, lin in ((free, constrained), (held, plain))
    }
    with pytest.raises(fflin.InputError, match="has no constraints"):
        fflin.simulate(free, laws[free], q0=q, duration=0.1)
    with pytest.raises(fflin.InputError, match="fewer independent states"):
        fflin.simulate(held, laws[held], q0=q, duration=0.1)
