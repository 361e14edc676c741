"""What flies many runs of a robot in orbit, or refuses to."""

import numpy as np
import pinocchio as pin
import pytest

import fflin
from tests.support.orbits import in_orbit


@pytest.fixture(scope="module")
def regulated():
    robot = in_orbit(fflin.load("planar_detumble"))
    lin = fflin.linearize(robot, u=fflin.equilibrium(robot).u)
    return robot, lin, fflin.lqr(lin)


def test_a_campaign_flies_as_simulate_does(regulated):
    robot, lin, gain = regulated
    policy = fflin.StateFeedback(lin, gain.K)
    dispersions = {"q_b": 0.05, "base.mass": 0.1}
    flown = fflin.monte_carlo(
        robot, policy, dispersions, runs=3, duration=0.5, engine="python"
    )
    motion = flown.replay(1)
    assert motion.orbit == robot.orbit and motion.frame == "lvlh"
    assert motion.momentum_drift.max() < 1e-6
    free = fflin.simulate(robot.replace(orbit=None), q0=motion.q[0], duration=0.5)
    assert np.abs(free.x[-1] - motion.x[-1]).max() > 1e-3
    for name in ("q", "v", "u"):
        assert np.array_equal(getattr(motion, name)[-1], getattr(flown, name)[1])
    # Other code computes x from them, see `Campaign.replay`.
    assert np.abs(motion.x[-1] - flown.x[1]).max() < 1e-15


@pytest.mark.exhaustive
def test_a_loop_in_orbit_settles(regulated):
    result = fflin.validity(*regulated, samples=1, attitude=20.0)
    assert result.outcomes == ("settled",)


@pytest.mark.compiled
def test_compiled_campaigns_agree_with_the_python_engine(regulated):
    robot, lin, gain = regulated
    policy = fflin.StateFeedback(lin, gain.K)
    spread = {"q_b": 0.05, "base.mass": 0.1, "*.com": 0.01, "r_b": 0.2}
    options = {"runs": 3, "duration": 0.5, "seed": 2}
    one, other = (
        fflin.monte_carlo(robot, policy, spread, engine=engine, **options)
        for engine in ("compiled", "python")
    )
    for name in ("q", "v", "u", "x"):
        expected = getattr(other, name)
        # Rounding errors of all steps, relative to the largest entry.
        size = np.maximum(1.0, np.abs(expected).max())
        assert np.abs(getattr(one, name) - expected).max() < 1e-12 * size, name


@pytest.mark.compiled
def test_validity_in_orbit_is_compiled(regulated):
    robot, lin, gain = regulated
    result = fflin.validity(robot, lin, gain, samples=2, attitude=20.0)
    assert result.outcomes == ("settled", "settled")
    assert not result.notes


def test_refused(regulated):
    robot, lin, gain = regulated
    free = robot.replace(orbit=None)
    along = fflin.simulate(free, duration=0.1).trajectory()
    schedule = fflin.tvlqr(fflin.linearize_trajectory(free, along), 1.0, 1.0, 1.0)
    free_model = fflin.linearize(free)
    policy = fflin.StateFeedback(free_model, fflin.lqr(free_model).K)
    for refused in (
        lambda: fflin.funnel(robot, schedule, goal={"attitude": 1.0}),
        lambda: fflin.simulate(robot, schedule),
    ):
        with pytest.raises(fflin.InputError, match="another orbit"):
            refused()
    with pytest.raises(fflin.InputError, match="'hybrid'"):
        fflin.simulate(robot, policy, duration=0.1)
    with pytest.raises(fflin.InputError, match="'lvlh'"):
        fflin.simulate(free, fflin.StateFeedback(lin, gain.K), duration=0.1)


def test_a_capture_stays_in_orbit():
    robot = in_orbit(fflin.load("cubesat", inputs=fflin.load_inputs("cubesat")))
    body = fflin.from_model(fflin.load("cubesat").model)
    caught = fflin.capture(
        robot, "base", pin.Inertia(1.0, np.zeros(3), 0.01 * np.eye(3))
    )
    assert robot.wheels and caught.robot.orbit == robot.orbit
    with pytest.raises(fflin.InputError, match="orbit"):
        fflin.capture(robot, "base", body)
