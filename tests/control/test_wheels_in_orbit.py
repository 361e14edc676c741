"""Attitude control by wheels in orbit, whose momentum the orbital rate couples to the attitude."""

import numpy as np
import pytest
from scipy.linalg import expm

import fflin

PERIOD, ORBIT = 0.25, 550e3
WHEEL = 1e-5
AXES = "xyz"
THREE = (1, 0, 0), (0, 1, 0), (0, 0, 1)
PYRAMID = (1, 0, 0.7), (-1, 0, 0.7), (0, 1, 0.7), (0, -1, 0.7)


def satellite(orbit=ORBIT, axes=THREE, more=()):
    wheels = [fflin.ReactionWheel(axis, inertia=WHEEL) for axis in axes]
    sensors = [
        fflin.StarTracker(),
        fflin.Gyroscope("base"),
        fflin.JointVelocities(["wheel_*"]),
    ]
    options = {} if orbit is None else {"orbit": orbit}
    return fflin.load("cubesat", inputs=[*wheels, *more], outputs=sensors, **options)


def skew(x):
    return np.cross(np.eye(3), x)


def attitude_equations(inertia, n):
    """Return A and B of 2 q_b and of the rate relative to the LVLH axes, at a constant momentum."""
    orbital, nadir = np.array([0.0, -n, 0.0]), np.array([0.0, 0.0, 1.0])
    without_wheels = inertia - WHEEL * np.eye(3)
    # Changes of the angular velocity and of the vertical in base axes, by an angle and a rate.
    by_angle = np.hstack((skew(orbital), np.zeros((3, 3))))
    velocity = by_angle + np.hstack((np.zeros((3, 3)), np.eye(3)))
    vertical = np.hstack((skew(nadir), np.zeros((3, 3))))
    gradient = 3.0 * n**2 * (skew(nadir) @ inertia - skew(inertia @ nadir)) @ vertical
    gyroscopic = (skew(orbital) @ inertia - skew(inertia @ orbital)) @ velocity
    rate = np.linalg.solve(without_wheels, gradient - gyroscopic)
    # The derivative of the rate in the turning axes.
    rate[:, 3:] -= skew(orbital)
    angle = np.hstack((np.zeros((3, 3)), np.eye(3)))
    B = np.vstack((np.zeros((3, 3)), -np.linalg.inv(without_wheels)))
    return np.vstack((angle, rate)), B


def sampled(A, B):
    block = np.zeros((9, 9))
    block[:6] = np.hstack((A, B))
    whole = expm(block * PERIOD)
    return whole[:6, :6], whole[:6, 6:]


def test_the_margins_in_orbit_are_those_of_the_regulated_attitude():
    lin = fflin.linearize(satellite())
    late = lin.discretize(PERIOD, delay=PERIOD)
    gain = fflin.lqr(late)
    A, B = sampled(*attitude_equations(lin.M[:3, :3], lin.mean_motion))
    names = [f"{group}.{axis}" for group in ("q_b", "omega_b") for axis in AXES]
    K = gain.K[:, [gain.state_names.index(name) for name in names]]
    K[:, :3] /= 2.0  # q_b is half of the angle
    memory = gain.K[:, [gain.state_names.index(f"past_1.wheel_{i}") for i in (1, 2, 3)]]

    def sensitivities(w):
        z = np.exp(1j * w * PERIOD)
        law = np.linalg.solve(np.eye(3) + memory / z, K)
        loop = law @ np.linalg.solve(z * np.eye(6) - A, B) / z
        S = np.linalg.inv(np.eye(3) + loop)
        return S - 0.5 * np.eye(3)

    margins = fflin.margins(gain, late)
    assert margins.stable
    assert [channel.name for channel in margins.channels] == list(late.input_names)
    grid = np.geomspace(1e-3, np.pi / PERIOD, 400)
    sizes = np.array([np.abs(np.diagonal(sensitivities(w))) for w in grid])
    for index, channel in enumerate(margins.channels):
        peak = abs(sensitivities(channel.disk_frequency)[index, index])
        assert channel.disk == pytest.approx(1.0 / peak, rel=1e-9)
        # The search for the peak is accurate to 1e-5.
        assert sizes[:, index].max() <= peak * (1.0 + 1e-5)
    least = min(1.0 / np.linalg.norm(sensitivities(w), 2) for w in grid)
    assert least * (1.0 - 1e-6) <= margins.disk
    assert margins.disk <= min(channel.disk for channel in margins.channels) + 1e-9


@pytest.mark.parametrize("delay", [0.0, PERIOD])
def test_the_margin_in_a_slow_orbit_is_the_margin_without_an_orbit(delay):
    disks = []
    for orbit in (None, fflin.CircularOrbit(mean_motion=1e-9)):
        late = fflin.linearize(satellite(orbit)).discretize(PERIOD, delay=delay)
        disks.append(fflin.margins(fflin.lqr(late), late).disk)
    assert disks[0] > 0.5
    assert disks[1] == pytest.approx(disks[0], rel=1e-6)


def test_a_continuous_law_in_orbit_is_stable():
    lin = fflin.linearize(satellite())
    gain = fflin.lqr(lin)
    assert "qdot_m.wheel_1" not in gain.regulated
    margins = fflin.margins(gain, lin, delay=0.1)
    assert margins.stable
    assert margins.disk > 0.5


def test_a_law_with_the_wrong_sign_is_unstable_in_orbit():
    lin = fflin.linearize(satellite())
    late = lin.discretize(PERIOD)
    assert not fflin.margins(fflin.StateFeedback(late, -fflin.lqr(late).K), late).stable


@pytest.mark.parametrize(("factor", "stable"), [(1.0, True), (0.0, False)])
def test_a_law_of_the_rate_alone_leaves_the_unstable_yaw_unstable(factor, stable):
    # The gravity gradient at this attitude has a negative stiffness about z.
    lin = fflin.linearize(satellite())
    assert (
        lin.A[lin.state_names.index("omega_b.z"), lin.state_names.index("q_b.z")] > 0.0
    )
    K = fflin.lqr(lin).K.copy()
    K[:, [lin.state_names.index(f"q_b.{axis}") for axis in AXES]] *= factor
    assert fflin.margins(fflin.StateFeedback(lin, K), lin).stable == stable


@pytest.mark.parametrize(("sign", "stable"), [(1.0, True), (-1.0, False)])
def test_a_law_that_regulates_wheel_speeds_must_stabilise_them(sign, stable):
    lin = fflin.linearize(satellite(more=[fflin.BaseTorque()]))
    gain = fflin.lqr(lin)
    K = gain.K.copy()
    speeds = [lin.state_names.index(f"qdot_m.wheel_{i}") for i in (1, 2, 3)]
    assert K[:, speeds].any(axis=0).all()
    K[:, speeds] *= sign
    assert fflin.margins(fflin.StateFeedback(lin, K), lin).stable == stable


@pytest.mark.parametrize("dt", [0.0, PERIOD])
def test_the_slowest_decay_is_computed_from_the_loop(dt):
    lin = fflin.linearize(satellite())
    gain = fflin.lqr(lin.discretize(dt) if dt else lin, wheel_speeds=True)
    rates = np.log(np.abs(gain.poles)) / dt if dt else gain.poles.real
    # Only the orbital rate couples the wheel speeds to the body, so they hardly decay.
    assert 0.0 < -rates.max() < 1e-4
    assert gain.weights.endswith(
        f"slowest mode of the loop decays at {-rates.max():.3g} 1/s"
    )


def test_the_momentum_of_wheels_turns_with_the_orbit():
    # If the attitude is held, the momentum is constant in inertial axes. A constant torque in base
    # axes then adds momentum without limit about the orbit normal alone.
    lin = fflin.linearize(satellite())
    names = list(lin.state_names)
    rates = [names.index(f"omega_b.{axis}") for axis in AXES]
    speeds = [names.index(f"qdot_m.wheel_{i}") for i in (1, 2, 3)]
    held = np.linalg.solve(lin.B[rates], lin.A[np.ix_(rates, speeds)])
    turning = lin.A[np.ix_(speeds, speeds)] - lin.B[speeds] @ held
    n = lin.mean_motion
    np.testing.assert_allclose(turning, skew([0.0, n, 0.0]), atol=1e-9 * n)


@pytest.mark.exhaustive
@pytest.mark.parametrize("disturbance", [f"tau_b.{axis}" for axis in AXES])
@pytest.mark.parametrize("axes", [THREE, PYRAMID], ids=["3", "4"])
def test_wheels_in_orbit_reject_a_constant_torque(axes, disturbance):
    late = fflin.linearize(satellite(axes=axes)).discretize(PERIOD, delay=PERIOD)
    noise = {"q_b": 1e-9, "gyroscope": 1e-10, "qdot_m": 1e-2}
    estimator = fflin.kalman(
        late,
        {"omega_b": 1e-11},
        noise,
        disturbance_noise={disturbance: 1e-12},
    )
    compensator = fflin.lqg(fflin.lqr(late), estimator)
    assert np.abs(compensator.poles).max() < 1.0
    assert fflin.margins(fflin.OutputFeedback(late, compensator), late).disk > 0.1
