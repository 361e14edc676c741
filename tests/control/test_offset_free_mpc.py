"""Model predictive control from the estimate of a filter, with estimated disturbances."""

import warnings

import numpy as np
import pytest

import fflin
from tests.support.marks import exhaustive

SAMPLE = 0.25
NOISE = {"q_b": 1e-9, "r_b": 1e-4, "gyroscope": 1e-9}
pytest.importorskip("daqp")


@pytest.fixture(scope="module")
def satellite():
    return fflin.load(
        "cubesat",
        inputs=[fflin.BaseTorque()],
        outputs=[fflin.BasePose(), fflin.Gyroscope("base")],
    )


@pytest.fixture(scope="module")
def designs(satellite):
    lin = fflin.linearize(satellite)
    model = lin.discretize(SAMPLE)
    estimator = fflin.kalman(
        model,
        {"omega_b": 1e-12},
        NOISE,
        disturbance_noise={"tau_b": 1e-11},
        bias_noise={"gyroscope": 1e-11},
        disturbance_frequency={"tau_b.x": 0.01},
    )
    return lin, model, estimator


def test_without_active_limits_it_equals_the_compensator(satellite, designs):
    lin, model, estimator = designs
    controller = fflin.mpc(
        lin, sample=SAMPLE, horizon=5, limits={"tau_b": 1.0}, disturbance=estimator
    )
    compensator = fflin.lqg(controller.gain, estimator)
    law = fflin.OutputFeedback(model, compensator)
    ours, other = (policy.bind(satellite) for policy in (controller, law))
    rng = np.random.default_rng(3)
    at = [estimator.state_names.index(name) for name in compensator.state_names]
    for k in range(200):
        q = fflin.configuration(satellite, rpy=rng.normal(size=3))
        v = 1e-3 * rng.normal(size=satellite.nv)
        u = other(k * SAMPLE, q, v)
        scale = max(np.abs(u).max(), 1e-3)
        assert np.abs(ours(k * SAMPLE, q, v) - u).max() < 1e-7 * scale
    size = np.abs(other.estimate).max()
    assert np.abs(ours.estimate[at] - other.estimate).max() < 1e-6 * size


@exhaustive
def test_a_constant_torque_leaves_no_error_within_the_limits(satellite, designs):
    """The torque is 40 % of the limit, which the slew reaches."""
    lin, _, estimator = designs
    limit, torque = 5e-5, {"tau_b.x": 2e-5}
    controller = fflin.mpc(
        lin,
        sample=SAMPLE,
        horizon=10,
        limits={"tau_b": limit},
        disturbance=estimator,
    )
    q0 = fflin.configuration(satellite, rpy=(8.0, 0.0, 0.0))
    motion = fflin.simulate(
        satellite, controller, q0=q0, duration=200.0, dt=0.05, disturbance=torque
    )
    assert np.abs(motion.u).max() == pytest.approx(limit, rel=1e-6)
    assert motion.u[-1, 0] == pytest.approx(-2e-5, rel=1e-3)
    assert motion.attitude_error[-1] < 1e-3
    without = fflin.mpc(lin, sample=SAMPLE, horizon=10, limits={"tau_b": limit})
    motion = fflin.simulate(
        satellite, without, q0=q0, duration=200.0, dt=0.05, disturbance=torque
    )
    assert motion.attitude_error[-1] > 0.05


def test_a_target_beyond_the_limits_keeps_the_inputs_within_them(satellite, designs):
    """A torque above the limit cannot be held, and the command stays at the limit."""
    lin, _, estimator = designs
    limit = 1e-5
    controller = fflin.mpc(
        lin, sample=SAMPLE, horizon=5, limits={"tau_b": limit}, disturbance=estimator
    )
    motion = fflin.simulate(
        satellite, controller, duration=20.0, dt=0.05, disturbance={"tau_b.x": 3e-5}
    )
    assert np.abs(motion.u).max() <= limit * (1.0 + 1e-12)
    assert motion.u[-1, 0] == pytest.approx(-limit)


def test_estimators_that_do_not_fit_are_refused(satellite, designs):
    lin, _, estimator = designs
    with pytest.raises(fflin.InputError, match="different models"):
        fflin.mpc(lin, sample=0.5, disturbance=estimator)
    with pytest.raises(fflin.InputError, match="expected an Estimator"):
        fflin.mpc(lin, sample=SAMPLE, disturbance={"tau_b": 1.0})
    motion = fflin.simulate(satellite, duration=1.0, every=10)
    along = fflin.linearize_trajectory(satellite, motion.trajectory())
    with pytest.raises(fflin.InputError, match="about a point"):
        fflin.mpc(along, sample=0.1, disturbance=estimator)


def test_a_model_with_delayed_inputs_is_refused(designs):
    """The prediction would leave the delay out without a message."""
    lin, _, _ = designs
    with pytest.raises(fflin.InputError, match="delays or lags"):
        fflin.mpc(lin.discretize(SAMPLE, delay=0.1), horizon=5)


def test_integrals_in_the_weights_are_ignored_with_a_warning(satellite, designs):
    robot = satellite.replace(weights={"integral": ["q_b"]})
    lin = fflin.linearize(robot)
    with pytest.warns(fflin.FflinWarning, match="mpc has no integral action"):
        fflin.mpc(lin, sample=SAMPLE, horizon=5)
    motion = fflin.simulate(robot, duration=1.0, every=10)
    along = fflin.linearize_trajectory(robot, motion.trajectory())
    with pytest.warns(fflin.FflinWarning, match="no integral action"):
        fflin.tvlqr(along, sample=0.1)
    # The filter replaces the integrals, and other weights leave them out.
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fflin.mpc(lin, sample=SAMPLE, horizon=5, disturbance=designs[2])
        fflin.mpc(lin, 1.0, 1e4, sample=SAMPLE, horizon=5)
