"""The compiled loop in elliptic orbits, and with laws that repeat, equals the engine in Python."""

import numpy as np
import pytest

import fflin
from tests.support.orbits import in_ellipse
from tests.support.robots import free_body, random_point

pytestmark = pytest.mark.compiled

BODY = (3.0, 5.0, 4.0)


def require_equal(robot, policy=None, **options):
    """Compare the motions of both engines, relative to the largest entry of each quantity."""
    one, other = (
        fflin.simulate(robot, policy, engine=engine, **options)
        for engine in ("compiled", "python")
    )
    assert one.engine == "compiled" and other.engine == "python"
    for name in ("q", "v", "u", "energy"):
        expected = getattr(other, name)
        apart = np.abs(getattr(one, name) - expected).max()
        assert apart < 1e-12 * max(1.0, np.abs(expected).max()), name
    assert one.momentum_drift.max() < 10.0 * other.momentum_drift.max() + 1e-12
    return one


@pytest.mark.parametrize("anomaly", [0.0, 2.5])
def test_a_robot_with_joints_moves_alike(anomaly):
    orbit = fflin.EllipticOrbit(perigee=500e3, eccentricity=0.3, anomaly=anomaly)
    robot = fflin.load("planar_detumble", orbit=orbit)
    q, v, _ = random_point(robot, np.random.default_rng(2), speed=1e-3, degrees=40.0)
    require_equal(robot, q0=q, v0=v, duration=3000.0, dt=5.0)


@pytest.mark.parametrize("hold", ["sampled", "continuous"])
def test_periodic_regulators_repeat_alike(hold):
    robot = in_ellipse(free_body(BODY), 0.1)
    along = fflin.linearize_orbit(robot, steps=8)
    T = along.period
    sample = T / 16 if hold == "sampled" else None
    law = fflin.tvlqr(along, 1.0, 1e8, "periodic", sample=sample)
    q0 = along.q[0].copy()
    q0[3:7] = fflin.configuration(robot, rpy=(5, -3, 4))[3:7]
    require_equal(robot, law, q0=q0, duration=1.25 * T, dt=T / 64)


def test_periodic_output_feedback_repeats_alike():
    sensors = [fflin.BasePose(), fflin.Gyroscope("base")]
    robot = in_ellipse(free_body(BODY), 0.1)
    robot = robot.replace(outputs=sensors)
    along = fflin.linearize_orbit(robot, steps=8)
    h = along.period / 16
    law = fflin.tvlqr(along, 1.0, 1e8, "periodic", sample=h)
    seen = fflin.tvkalman(along, 1e-12, 1e-8, P0="periodic", sample=h)
    policy = fflin.TrajectoryOutputFeedback(along, law, seen)
    q0 = along.q[0].copy()
    q0[3:7] = fflin.configuration(robot, rpy=(1, -2, 1))[3:7]
    require_equal(robot, policy, q0=q0, duration=20 * h, dt=h / 4)


def test_campaigns_in_an_ellipse_are_compiled():
    robot = in_ellipse(free_body(BODY), 0.1)
    spread = {"q_b": 0.05, "base.mass": 0.05}
    # Three revolutions: a tumbling body in an ellipse is chaotic, which enlarges rounding errors.
    options = {"runs": 3, "duration": 63.0, "dt": 0.5, "seed": 4}
    one, other = (
        fflin.monte_carlo(robot, None, spread, engine=engine, **options)
        for engine in ("compiled", "python")
    )
    for name in ("q", "v"):
        expected = getattr(other, name)
        size = max(1.0, np.abs(expected).max())
        assert np.abs(getattr(one, name) - expected).max() < 1e-12 * size, name
