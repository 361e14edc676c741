"""Machine code with lags and flat plates, compared with the Python engine."""

import numpy as np
import pytest

import fflin
from tests.kernel.test_extension import (
    PLATES,
    SPIN,
    linear_controller,
    multirate,
    output_feedback,
    satellite,
    state_feedback,
)
from tests.simulation.test_compiled import both

pytestmark = pytest.mark.compiled


@pytest.mark.parametrize("lagging", [False, True])
@pytest.mark.parametrize("make", [state_feedback, output_feedback, linear_controller])
def test_laws_with_lags_fly_the_same_motion_in_both_engines(make, lagging):
    robot = satellite()
    lin = fflin.linearize(robot)
    if lagging:
        lin = lin.with_lags()
    law = make(robot, lin.discretize(0.2))
    q0 = fflin.configuration(robot, rpy=(10, -20, 30))
    v0 = fflin.velocity(robot, SPIN)
    both(robot, law, 1e-12, q0=q0, v0=v0, duration=6.0, dt=0.02)


@pytest.mark.parametrize("lag", [None, 0.3])
def test_multirate_laws_with_lags_fly_the_same_motion_in_both_engines(lag):
    robot, law = multirate(lag)
    q0 = fflin.configuration(robot, rpy=(10, -20, 30))
    both(robot, law, 1e-12, q0=q0, duration=6.0, dt=0.02)


def test_continuous_laws_with_lags_fly_the_same_motion_in_both_engines():
    robot = satellite()
    lin = fflin.linearize(robot).with_lags()
    q0 = fflin.configuration(robot, rpy=(10, -20, 30))
    for make in (state_feedback, linear_controller):
        both(robot, make(robot, lin), 1e-12, q0=q0, duration=3.0)


@pytest.mark.parametrize("engine", ["compiled", "python"])
@pytest.mark.parametrize("orbit", [None, 500e3])
def test_campaigns_draw_lags_and_plates_like_single_runs(orbit, engine):
    """Noise and bias are added after the lag of a sensor, faults after the lag of an actuator."""
    first, second = PLATES
    if orbit:
        first = {key: first[key] for key in first if key != "velocity"}
        first["density"] = 1e-9
    robot = satellite(orbit=orbit, disturbance={"plate": [first, second]})
    lin = fflin.linearize(robot).with_lags().discretize(0.2)
    law = output_feedback(robot, lin)
    spreads = {
        "base.mass": 0.1,
        "q_b": 0.02,
        "q_b.sensor": 1e-3,
        "gyroscope.noise": 1e-4,
        "tau_b.gain": 0.05,
        "plate_*.sunlight": 0.3,
        "plate_1.drag": 0.5,
    }
    options = {"duration": 3.0, "dt": 0.05, "runs": 10}
    campaigns = [
        fflin.monte_carlo(robot, law, spreads, engine=name, **options)
        for name in ("python", engine)
    ]
    expected, campaign = campaigns
    np.testing.assert_allclose(campaign.q, expected.q, atol=1e-12)
    np.testing.assert_allclose(campaign.v, expected.v, atol=1e-12)
    assert np.ptp(campaign.q, axis=0).max() > 1e-3
    assert np.array_equal(campaign.replay(9).q[-1], campaign.q[9])
