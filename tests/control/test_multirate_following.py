"""Laws of sensors with their own sample times and delays follow a trajectory."""

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.control.kalman import _problem
from fflin.control.multirate import multirate_filter
from fflin.control.sensors import SensorTiming
from tests.control.test_following import TURN, resting, slew
from tests.support.marks import exhaustive

SAMPLE = 0.05
PROCESS = {"omega_b": 1e-12}
TORQUE = {"tau_b": 1e-16}


def satellite(sample=0.25, delay=0.2, noise=True):
    """Return the cubesat with three wheels, a star tracker and a gyroscope.

    The star tracker has its own sample time and its own delay [s].
    """
    inputs = fflin.load_inputs("cubesat")
    wheels = [item for item in inputs if isinstance(item, fflin.ReactionWheel)]
    tracker = fflin.StarTracker(
        sample=sample,
        delay=delay,
        noise={"noise_equivalent_angle": 10.0} if noise else None,
    )
    gyroscope = fflin.Gyroscope(
        "base", noise={"angle_random_walk": 0.1} if noise else None
    )
    return fflin.load("cubesat", inputs=wheels, outputs=[tracker, gyroscope])


def gain_of(lin):
    """Return the regulator with the default weights, which are not made slower."""
    default = fflin.lqr(lin)
    return fflin.lqr(lin, default.Q, default.R, default.N)


def multirate(robot, delay=0.0):
    """Return the law of the sensors of a robot, which rejects a constant torque."""
    lin = fflin.linearize(robot).discretize(SAMPLE, delay=delay)
    estimator = fflin.kalman(
        lin,
        PROCESS,
        {"q_b": 1e-9, "gyroscope": 1e-11},
        disturbance_noise=TORQUE,
    )
    return fflin.MultirateFeedback(lin, fflin.lqg(gain_of(lin), estimator))


def test_a_trajectory_at_rest_gives_the_motion_of_the_law_about_its_point():
    robot = satellite()
    law = multirate(robot)
    policy = law.follow(resting(robot, pin.SE3.Identity()))
    options = {
        "q0": fflin.configuration(robot, rpy=(3, -1, 2)),
        "duration": 2.5,
        "dt": SAMPLE,
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


@pytest.mark.parametrize("delay", [0.1, *exhaustive(0.0)])
def test_a_slew_is_followed_without_an_error(delay):
    robot = satellite(noise=False)
    policy = multirate(robot, delay).follow(slew(robot))
    options = {"duration": TURN + 2.0, "dt": SAMPLE}
    motion = fflin.simulate(robot, policy, **options)
    attitude = pin.Quaternion(motion.q[-1][3:7])
    assert np.degrees(attitude.angularDistance(pin.Quaternion.Identity())) > 15.0
    assert np.radians(motion.attitude_error.max()) < 1e-11


def equal_rates(robot):
    """Return an ordinary law, and the same law as a law of different rates."""
    lin = fflin.linearize(robot).discretize(SAMPLE)
    noise = {"q_b": 1e-9, "gyroscope": 1e-11}
    problem = _problem(lin, PROCESS, noise, None, None, (TORQUE, None, None))
    periodic = multirate_filter(problem, SensorTiming((1,) * 6, (0,) * 6))
    ordinary = fflin.kalman(lin, PROCESS, noise, disturbance_noise=TORQUE)
    gain = gain_of(lin)
    return (
        fflin.OutputFeedback(lin, fflin.lqg(gain, ordinary)),
        fflin.MultirateFeedback(lin, fflin.lqg(gain, periodic)),
    )


def test_equal_rates_follow_as_an_output_feedback_does():
    robot = satellite(sample=None, delay=0.0)
    trajectory = slew(robot)
    options = {
        "q0": fflin.configuration(robot, rpy=(1, 2, -1)),
        "duration": 4.0,
        "dt": SAMPLE,
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
    robot = satellite(delay=0.25)
    law = multirate(robot, delay=SAMPLE)
    policy = law.follow(planned(satellite(), 30.0))
    options = {"duration": 80.0, "dt": SAMPLE}
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
    robot = satellite(sample=0.2, delay=0.1, noise=False)
    plain = satellite(sample=None, delay=0.0, noise=False)
    law, _ = equal_rates(plain)
    policy = law.follow(slew(plain))
    motion = fflin.simulate(robot, policy, duration=TURN + 2.0, dt=SAMPLE)
    assert np.radians(motion.attitude_error.max()) < 1e-11
    q0 = fflin.configuration(robot, rpy=(0.1, 0, 0))
    still = law.follow(resting(plain, pin.SE3.Identity()))
    options = {"q0": q0, "duration": 3.0, "dt": SAMPLE}
    following, expected = (
        fflin.simulate(robot, each, **options) for each in (still, law)
    )
    size = np.abs(expected.u).max()
    assert size > 1e-7
    assert np.abs(following.u - expected.u).max() < 1e-11 * size


def test_other_sensors_than_those_of_the_design_are_refused():
    robot = satellite()
    policy = multirate(robot).follow(slew(robot))
    with pytest.raises(fflin.InputError, match="have other sample times or delays"):
        fflin.simulate(satellite(delay=0.1), policy, duration=1.0)


def unloading():
    """Return the robot with an external torque, and a law that unloads its wheels."""
    outputs = [*satellite().outputs, fflin.JointVelocities(("wheel_*",))]
    robot = satellite().replace(outputs=outputs)
    lin = fflin.linearize(robot).discretize(SAMPLE)
    noise = {"q_b": 1e-9, "gyroscope": 1e-11, "qdot_m": 1e-6}
    estimator = fflin.kalman(lin, PROCESS, noise)
    law = fflin.MultirateFeedback(lin, fflin.lqg(gain_of(lin), estimator))
    design = robot.replace(inputs=[fflin.BaseTorque(), *robot.inputs])
    return design, fflin.unload_wheels(law, design, 0.04)


def test_a_law_that_unloads_follows_a_slew():
    design, law = unloading()
    policy = law.follow(slew(satellite()))
    # The momentum is parallel to the axis of the slew.
    v0 = fflin.velocity(design, {"wheel_z": 50.0})
    motion = fflin.simulate(design, policy, v0=v0, duration=4.0, dt=SAMPLE, noise=0.0)
    plan = policy.reference(4.0)[1][-1]
    assert motion.v[-1, -1] - plan == pytest.approx(50.0 * np.exp(-0.16), rel=0.02)
    assert motion.attitude_error.max() < 1e-6


@pytest.mark.compiled
@pytest.mark.exhaustive
@pytest.mark.parametrize("duration", [5.0, TURN + 7.0])
def test_compiled_code_follows_as_python_does(duration):
    """The pattern of arrivals repeats after the end of the slew, too."""
    robot = satellite()
    policy = multirate(robot, delay=0.1).follow(slew(robot))
    options = {
        "q0": fflin.configuration(robot, rpy=(2, -1, 3)),
        "duration": duration,
        "dt": SAMPLE,
    }
    python, compiled = (
        fflin.simulate(robot, policy, engine=engine, **options)
        for engine in ("python", "compiled")
    )
    assert python.attitude_error[0] > 2.0
    assert compiled.q == pytest.approx(python.q, abs=1e-11)
    assert compiled.u == pytest.approx(python.u, abs=1e-13)
    runs = [
        fflin.monte_carlo(
            robot, policy, {"q_b": 0.01}, runs=9, engine=engine, **options
        ).x
        for engine in ("python", "compiled")
    ]
    assert runs[1] == pytest.approx(runs[0], rel=1e-8, abs=1e-11)
