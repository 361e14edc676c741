"""Laws of sensors with their own sample times and delays follow a trajectory."""

import numpy as np
import pinocchio as pin
import pytest

import fflin
from tests.support.following import (
    FAST,
    TURN,
    equal_rates,
    multirate,
    resting,
    slew,
    unloading,
    with_star_tracker,
)


def test_a_trajectory_at_rest_gives_the_motion_of_the_law_about_its_point():
    robot = with_star_tracker()
    law = multirate(robot)
    policy = law.follow(resting(robot, pin.SE3.Identity()))
    options = {
        "q0": fflin.configuration(robot, rpy=(3, -1, 2)),
        "duration": 2.5,
        "dt": FAST,
    }
    plain, following = (
        fflin.simulate(robot, each, **options) for each in (law, policy)
    )
    assert np.abs(plain.u).max() > 1e-6
    # The sensors are states of the law that follows. The sums have another order.
    size = np.abs(plain.u).max()
    assert np.abs(following.u - plain.u).max() < 1e-11 * size
    assert np.abs(following.q - plain.q).max() < 1e-12
    assert following.notes[:1] == plain.notes[:1]


def test_equal_rates_follow_as_an_output_feedback_does():
    robot = with_star_tracker(sample=None, delay=0.0)
    trajectory = slew(robot)
    options = {
        "q0": fflin.configuration(robot, rpy=(1, 2, -1)),
        "duration": 4.0,
        "dt": FAST,
    }
    ordinary, periodic = (
        fflin.simulate(robot, law.follow(trajectory), **options)
        for law in equal_rates(robot)
    )
    size = np.abs(ordinary.u).max()
    # The two filters are equal to 1e-10, see test_multirate.
    assert np.abs(periodic.u - ordinary.u).max() < 1e-8 * size
    assert np.abs(periodic.q - ordinary.q).max() < 1e-8


def planned(robot, degrees):
    """Return a slew of 60 s about z by a torque that accelerates, then brakes."""
    lin = fflin.linearize(robot)
    row = lin.state_names.index("omega_b.z")
    column = lin.input_names.index("wheel_z")
    torque = np.radians(degrees) / 30.0**2 / lin.B[row, column]

    def bang_bang(t, q, v):
        u = np.zeros(3)
        u[2] = torque if t < 29.999 else -torque
        return u

    return fflin.simulate(
        robot, bang_bang, duration=60.0, sample=1.0, dt=0.5
    ).trajectory()


@pytest.mark.exhaustive
def test_a_slew_of_30_degrees_with_a_late_star_tracker():
    """The error is the noise of the law at rest, because errors are relative to the slew."""
    robot = with_star_tracker(delay=0.25)
    law = multirate(robot, delay=FAST)
    policy = law.follow(planned(with_star_tracker(), 30.0))
    options = {"duration": 80.0, "dt": FAST}
    quiet = fflin.simulate(robot, policy, noise=0.0, **options)
    attitude = pin.Quaternion(quiet.q[-1][3:7])
    angle = np.degrees(attitude.angularDistance(pin.Quaternion.Identity()))
    assert angle == pytest.approx(30.0, abs=0.05)
    assert np.radians(quiet.attitude_error.max()) < 1e-11
    noisy, still = (fflin.simulate(robot, each, **options) for each in (policy, law))
    assert 0.01 < still.attitude_error.max() < 0.05
    # The same noise acts on both. The rotation of the slew changes its effect.
    assert noisy.attitude_error.max() == pytest.approx(
        still.attitude_error.max(), rel=0.2
    )
    assert noisy.attitude_error[-1] < 0.05


@pytest.mark.exhaustive
def test_a_slow_sensor_follows_a_trajectory():
    """A slow value is compared with the reference at the time of its measurement."""
    robot = with_star_tracker(sample=0.2, delay=0.1, noise=False)
    plain = with_star_tracker(sample=None, delay=0.0, noise=False)
    law, _ = equal_rates(plain)
    policy = law.follow(slew(plain))
    motion = fflin.simulate(robot, policy, duration=TURN + 2.0, dt=FAST)
    assert np.radians(motion.attitude_error.max()) < 1e-11
    q0 = fflin.configuration(robot, rpy=(0.1, 0, 0))
    still = law.follow(resting(plain, pin.SE3.Identity()))
    options = {"q0": q0, "duration": 3.0, "dt": FAST}
    following, expected = (
        fflin.simulate(robot, each, **options) for each in (still, law)
    )
    size = np.abs(expected.u).max()
    assert size > 1e-7
    assert np.abs(following.u - expected.u).max() < 1e-11 * size


def test_other_sensors_than_those_of_the_design_are_refused():
    robot = with_star_tracker()
    policy = multirate(robot).follow(slew(robot))
    with pytest.raises(fflin.InputError, match="have other sample times or delays"):
        fflin.simulate(with_star_tracker(delay=0.1), policy, duration=1.0)


def test_a_law_that_unloads_follows_a_slew():
    design, law = unloading()
    policy = law.follow(slew(with_star_tracker()))
    # The momentum is parallel to the axis of the slew.
    v0 = fflin.velocity(design, {"wheel_z": 50.0})
    motion = fflin.simulate(design, policy, v0=v0, duration=4.0, dt=FAST, noise=0.0)
    plan = policy.reference(4.0)[1][-1]
    assert motion.v[-1, -1] - plan == pytest.approx(50.0 * np.exp(-0.16), rel=0.02)
    assert motion.attitude_error.max() < 1e-6
