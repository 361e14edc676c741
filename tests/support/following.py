"""Laws about a point, and trajectories that they follow."""

import numpy as np

import fflin
from fflin.control.kalman import _problem
from fflin.control.multirate import multirate_filter
from fflin.control.sensors import SensorTiming

SAMPLE = 0.25
FAST = 0.05  # sample time of the laws with a star tracker
TORQUE = 3e-5  # N m
TURN = 16.0  # s, a multiple of the sample times
PROCESS = {"omega_b": 1e-12}
TORQUE_WALK = {"tau_b": 1e-16}


def satellite(**fields):
    """The cubesat with three wheels, which measures its attitude and its angular rate."""
    inputs = fflin.load_inputs("cubesat")
    wheels = [item for item in inputs if isinstance(item, fflin.ReactionWheel)]
    outputs = [fflin.BasePose(), fflin.Gyroscope("base")]
    return fflin.load("cubesat", inputs=wheels, outputs=outputs, **fields)


def slew(robot, axis=2, torque=TORQUE):
    """Return a slew from rest to rest by a wheel that accelerates, then brakes."""

    def bang_bang(t, q, v):
        u = np.zeros(3)
        u[axis] = torque if t < 0.5 * TURN * (1.0 - 1e-12) else -torque
        return u

    motion = fflin.simulate(robot, bang_bang, duration=TURN, sample=0.5, dt=0.5)
    return motion.trajectory()


def output_feedback(robot, *, delay=SAMPLE, integral=False, **changes):
    """Return an LQG law that integrates the attitude or estimates a constant torque."""
    lin = fflin.linearize(robot)
    model = lin.discretize(SAMPLE, delay=delay)
    gain = fflin.lqr(model, integral_action=["q_b"] if integral else None)
    variances = {"q_b": 1e-10, "r_b": 1e-8, "gyroscope": 1e-12}
    disturbance = None if integral else {"tau_b": 1e-12}
    estimator = fflin.kalman(
        model, {"omega_b": 1e-12}, variances, disturbance_noise=disturbance
    )
    return fflin.OutputFeedback(model, fflin.lqg(gain, estimator), **changes)


def state_feedback(robot, *, delay=SAMPLE):
    """Return a state feedback with integral action."""
    model = fflin.linearize(robot).discretize(SAMPLE, delay=delay)
    return fflin.StateFeedback(model, fflin.lqr(model, integral_action=["q_b"]))


def resting(robot, base):
    """Return the trajectory of a robot at rest at a base pose."""
    q = fflin.configuration(robot, base=base)
    zero = np.zeros((2, robot.nv))
    inputs = np.zeros((2, len(fflin.linearize(robot).input_names)))
    return fflin.Trajectory(robot, [0.0, 1.0], np.tile(q, (2, 1)), zero, inputs)


def with_star_tracker(sample=0.25, delay=0.2, noise=True):
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
    lin = fflin.linearize(robot).discretize(FAST, delay=delay)
    estimator = fflin.kalman(
        lin,
        PROCESS,
        {"q_b": 1e-9, "gyroscope": 1e-11},
        disturbance_noise=TORQUE_WALK,
    )
    return fflin.MultirateFeedback(lin, fflin.lqg(gain_of(lin), estimator))


def equal_rates(robot):
    """Return an ordinary law, and the same law as a law of different rates."""
    lin = fflin.linearize(robot).discretize(FAST)
    noise = {"q_b": 1e-9, "gyroscope": 1e-11}
    problem = _problem(lin, PROCESS, noise, None, None, (TORQUE_WALK, None, None))
    periodic = multirate_filter(problem, SensorTiming((1,) * 6, (0,) * 6))
    ordinary = fflin.kalman(lin, PROCESS, noise, disturbance_noise=TORQUE_WALK)
    gain = gain_of(lin)
    return (
        fflin.OutputFeedback(lin, fflin.lqg(gain, ordinary)),
        fflin.MultirateFeedback(lin, fflin.lqg(gain, periodic)),
    )


def unloading():
    """Return the robot with an external torque, and a law that unloads its wheels."""
    outputs = [*with_star_tracker().outputs, fflin.JointVelocities(("wheel_*",))]
    robot = with_star_tracker().replace(outputs=outputs)
    lin = fflin.linearize(robot).discretize(FAST)
    noise = {"q_b": 1e-9, "gyroscope": 1e-11, "qdot_m": 1e-6}
    estimator = fflin.kalman(lin, PROCESS, noise)
    law = fflin.MultirateFeedback(lin, fflin.lqg(gain_of(lin), estimator))
    design = robot.replace(inputs=[fflin.BaseTorque(), *robot.inputs])
    return design, fflin.unload_wheels(law, design, 0.04)


def of_satellite(design, **settings):
    """Return a function that returns the satellite and a law for it."""

    def made(**options):
        robot = satellite()
        return robot, design(robot, **settings, **options)

    return made


def of_star_tracker(**options):
    """Return a robot with a late star tracker, and a law that estimates a constant torque."""
    robot = with_star_tracker()
    return robot, multirate(robot, **options)


LAWS = {
    "estimated disturbance": of_satellite(output_feedback),
    "integral action": of_satellite(output_feedback, integral=True),
    "state feedback": of_satellite(state_feedback),
    "star tracker": of_star_tracker,
}
