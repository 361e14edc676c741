"""Worst loops with lags, compared with the matrices of `with_lags` at the vertices of the set."""

import itertools
import warnings

import numpy as np
import pytest

import fflin
from fflin.uncertainty.lagging import with_lags_of_loop

RANGES = {"base.inertia.xx": 0.2, "base.inertia.zz": 0.3}


def satellite(lag=0.4, sensor_lag=0.3):
    """Return a satellite whose torques, and whose attitude sensor, may have lags."""
    outputs = [fflin.BasePose(lag=sensor_lag), fflin.Gyroscope("base")]
    return fflin.load("cubesat", inputs=[fflin.BaseTorque(lag=lag)], outputs=outputs)


def state_law(lin):
    return fflin.StateFeedback(lin, fflin.lqr(lin))


def output_law(lin):
    noise = {"q_b": 1e-9, "r_b": 1e-4, "gyroscope": 1e-9}
    estimator = fflin.kalman(lin, {"omega_b": 1e-9}, noise)
    return fflin.LinearController(fflin.lqg(fflin.lqr(lin), estimator), lin)


def integral_gain(lin):
    return fflin.lqr(lin, integral_action=["q_b"])


def loop_of(law, lin):
    """Return the closed-loop matrix of a law, or of a gain, and a model with lags."""
    if isinstance(law, fflin.Gain):
        law = fflin.StateFeedback(law._lin, law)
    return law.loop_with(lin)


def least_damping(matrix, dt):
    """Return the least damping ratio of all poles but those of the uncontrolled translation."""
    poles = np.linalg.eigvals(matrix)
    if dt:
        poles = np.log(poles[np.abs(poles) > 1e-300].astype(complex)) / dt
    poles = poles[np.abs(poles) > 1e-5]
    return float((-poles.real / np.abs(poles)).min())


def test_the_lagging_lft_is_the_lagging_model_of_each_robot():
    robot = satellite()
    model = fflin.uncertain(robot, RANGES)
    law = output_law(fflin.linearize(robot).with_lags())
    lft = with_lags_of_loop(model.lft(), robot, law)
    for delta in itertools.product((-1.0, 0.3, 1.0), repeat=2):
        values = model.values(np.array(delta))
        plant = fflin.linearize(model.at(values)).with_lags()
        assert lft.state_names == plant.state_names
        matrices = plant.A, plant.B, plant.C, plant.D
        for matrix, expected in zip(lft.at(values), matrices, strict=True):
            np.testing.assert_allclose(matrix, expected, rtol=1e-12, atol=1e-13)


@pytest.mark.exhaustive
@pytest.mark.parametrize("dt", [0.0, 0.5])
@pytest.mark.parametrize("lagging", [True, False], ids=["aware", "blind"])
@pytest.mark.parametrize("design", [state_law, output_law, fflin.lqr, integral_gain])
def test_the_worst_loop_is_that_of_the_lagging_model_at_a_vertex(design, lagging, dt):
    robot = satellite()
    lin = fflin.linearize(robot)
    if lagging:
        lin = lin.with_lags()
    if dt:
        lin = lin.discretize(dt, delay=0.2)
    law = design(lin)
    model = fflin.uncertain(robot, RANGES)
    worst = model.worst(law, samples=4)
    values = []
    for signs in itertools.product((0.0, -1.0, 1.0), repeat=2):
        at = model.at(model.values(np.array(signs)))
        plant = fflin.linearize(at).with_lags()
        if dt:
            plant = plant.discretize(dt, delay=0.2)
        values.append(least_damping(loop_of(law, plant), dt))
    at = model.at(worst.damping.parameters)
    plant = fflin.linearize(at).with_lags()
    if dt:
        plant = plant.discretize(dt, delay=0.2)
    damping = least_damping(loop_of(law, plant), dt)
    assert worst.damping.value == pytest.approx(damping, abs=1e-7)
    assert worst.damping.value <= min(values) + 1e-7
    plant = fflin.linearize(model.at(worst.margin.parameters)).with_lags()
    delay = 0.2 if dt else None
    at_vertex = fflin.margins(law, plant, delay=delay).disk
    if isinstance(law, fflin.Gain) and not dt:
        # Of a continuous gain, the scaling by R gives a lower bound.
        assert worst.margin.value <= at_vertex * (1.0 + 1e-6)
    else:
        assert worst.margin.value == pytest.approx(at_vertex, rel=1e-6)


@pytest.mark.exhaustive
def test_lags_for_which_the_law_was_not_designed_are_said_once():
    robot = satellite()
    lin = fflin.linearize(robot)
    model = fflin.uncertain(robot, RANGES)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        aware = model.worst(state_law(lin.with_lags()), samples=2)
    assert not caught
    with pytest.warns(fflin.FflinWarning, match=r"tau_b\.x \(0\.4 s\)") as caught:
        blind = model.worst(state_law(lin), samples=2)
    assert len(caught) == 1
    assert blind.damping.value < aware.damping.value


@pytest.mark.exhaustive
def test_lags_of_the_model_act_if_the_robot_has_none():
    robot = satellite(lag=None, sensor_lag=None)
    lin = fflin.linearize(robot)
    law = state_law(lin.with_lags({"tau_b": 0.4}))
    lagging = state_law(fflin.linearize(satellite()).with_lags())
    model = fflin.uncertain(robot, RANGES)
    worst = model.worst(law, samples=2)
    expected = fflin.uncertain(satellite(), RANGES).worst(lagging, samples=2)
    assert worst.damping.value == pytest.approx(expected.damping.value, rel=1e-9)
