"""Dispersed frequencies of modes, compared with the scaling of time that they cause."""

import numpy as np
import pytest

import fflin
from tests.robot.test_appendages import beam, hub_with_rod

DURATION, STEP = 2.0, 0.01


@pytest.mark.parametrize(
    "engine", ["python", pytest.param("compiled", marks=pytest.mark.compiled)]
)
def test_a_frequency_that_is_1_plus_x_times_larger_shortens_time_by_1_plus_x(engine):
    """With the frequency times 1 + x and the same damping ratio, q(t) becomes q((1 + x) t).

    So the stiffness is multiplied by (1 + x)^2, and the damping by 1 + x. The law holds for the
    nonlinear motion from rest, and for each step of the integrator.
    """
    robot = hub_with_rod(10.0, 2.0, 1.0, 2.0).replace(
        appendages=[beam(1.0, 2.0, 5.0, 1)]
    )
    robot = robot.replace(damping={"beam_mode_1": 0.3})
    q0 = fflin.configuration(robot, {"beam_mode_1": 0.05})
    campaign = fflin.monte_carlo(
        robot,
        None,
        {"beam_mode_1.frequency": (-0.3, 0.3)},
        runs=3,
        engine=engine,
        q0=q0,
        duration=DURATION,
        dt=STEP,
    )
    for run, (change,) in enumerate(campaign.drawn):
        faster = 1.0 + change
        assert abs(change) > 1e-3
        nominal = fflin.simulate(
            robot, q0=q0, duration=faster * DURATION, dt=faster * STEP, engine="python"
        )
        assert np.abs(nominal.q[-1, 7:]).max() > 1e-3
        np.testing.assert_allclose(campaign.q[run], nominal.q[-1], atol=1e-13)
