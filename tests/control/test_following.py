"""Linear laws about a point that follow a trajectory: feedforward, delays, hold at the end."""

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.control.following import Following
from tests.support.following import (
    LAWS,
    SAMPLE,
    TORQUE,
    TURN,
    output_feedback,
    resting,
    satellite,
    slew,
    state_feedback,
)
from tests.support.marks import exhaustive
from tests.support.robots import free_body


@pytest.mark.parametrize(
    ("kind", "delay"),
    [
        ("state feedback", 0.35),
        ("star tracker", 0.1),
        *exhaustive(
            ("star tracker", 0.0),
            ("estimated disturbance", 0.25),
            ("integral action", 0.35),
            ("estimated disturbance", 0.0),
            ("estimated disturbance", 0.35),
            ("integral action", 0.0),
            ("state feedback", 0.25),
        ),
    ],
)
def test_a_law_follows_a_slew_without_an_error(kind, delay):
    """The robot waits for the delay, so that each planned input acts at its time."""
    robot, law = LAWS[kind](delay=delay)
    policy = law.follow(slew(robot))
    options = {"duration": TURN + 4.0, "dt": 0.05, "noise": 0.0}
    motion = fflin.simulate(robot, policy, **options)
    attitude = pin.Quaternion(motion.q[-1][3:7])
    assert np.degrees(attitude.angularDistance(pin.Quaternion.Identity())) > 15.0
    # Commands act at multiples of the sample time after the delay, at which the trajectory begins.
    # The knots, 0.5 s apart, are among these times, so each command is one planned input.
    assert np.radians(motion.attitude_error.max()) < 1e-11


def test_the_feedforward_is_the_mean_input_of_each_sample():
    robot = satellite()
    knots = np.array([0.0, 0.3, 0.7, 1.0, 1.3])
    count = len(knots)
    random = np.random.default_rng(1)
    inputs = 1e-7 * random.normal(size=(count, 3))
    still = fflin.configuration(robot)
    law = output_feedback(robot, delay=0.1)
    for hold in ("previous", "linear"):
        trajectory = fflin.Trajectory(
            robot,
            knots,
            np.tile(still, (count, 1)),
            np.zeros((count, robot.nv)),
            inputs,
            hold=hold,
        )
        policy = law.follow(trajectory)
        # A command at t acts from t + 0.1 s on, and the trajectory begins at 0.1 s.
        middles = (np.arange(100_000) + 0.5) / 100_000 * SAMPLE
        for k in range(4):
            times = k * SAMPLE + middles
            planned = np.array(
                [
                    np.interp(times, knots, column)
                    if hold == "linear"
                    else column[np.searchsorted(knots, times, side="right") - 1]
                    for column in inputs.T
                ]
            )
            expected = planned.mean(axis=1)
            result = policy.feedforward(k * SAMPLE)
            # The sum over 100,000 points resolves each jump to 1e-5 of a sample.
            assert result == pytest.approx(expected, abs=2e-5 * np.abs(inputs).max())


def test_planned_thrusts_are_followed_as_the_wrench_that_they_exert():
    thrusters = [
        item
        for item in fflin.load_inputs("cubesat")
        if isinstance(item, fflin.Thruster)
    ]
    robot = fflin.load("cubesat", inputs=thrusters)
    design = robot.replace(inputs=(fflin.BaseTorque(), fflin.BaseForce()))
    lin = fflin.linearize(design).discretize(0.5)
    law = fflin.StateFeedback(lin, fflin.lqr(lin))
    times = np.arange(4.0)
    still = np.tile(robot.neutral(), (4, 1))
    thrusts = np.random.default_rng(3).random((4, len(thrusters)))
    planned = fflin.Trajectory(robot, times, still, np.zeros((4, robot.nv)), thrusts)
    followed = law.follow(planned)
    # The arm of each thruster, by hand; the base of this robot is a single body.
    wrench = np.zeros((4, 6))
    for thrust, item in zip(thrusts.T, thrusters, strict=True):
        force = np.outer(thrust, item.direction) / np.linalg.norm(item.direction)
        wrench[:, :3] += np.cross(item.position, force)
        wrench[:, 3:] += force
    assert followed.trajectory.u == pytest.approx(wrench, abs=1e-12)
    assert np.abs(wrench).min() > 1e-4
    # One thruster does not exert what a plan of base torque needs.
    one = fflin.linearize(robot.replace(inputs=thrusters[:1])).discretize(0.5)
    alone = fflin.StateFeedback(one, np.zeros((1, 12)))
    torque = fflin.Trajectory(
        design, times, still, np.zeros((4, robot.nv)), np.ones((4, 6))
    )
    with pytest.raises(fflin.FflinError, match="lacks the input"):
        alone.follow(torque)


@pytest.mark.exhaustive
def test_a_law_holds_any_attitude_as_it_holds_its_point():
    """Errors are relative to the base of the trajectory, so the motion is the same but rotated."""
    robot = satellite()
    law = output_feedback(robot)
    pose = pin.SE3(pin.exp3(np.array((1.0, -1.5, 0.8))), np.array((3.0, -1.0, 2.0)))
    error = pin.SE3(pin.exp3(np.array((0.02, 0.03, -0.01))), np.zeros(3))
    starts = {
        law: error,
        law.follow(resting(robot, pose)): pose * error,
    }
    motions = [
        fflin.simulate(
            robot,
            policy,
            q0=fflin.configuration(robot, base=start),
            duration=5.0,
            dt=0.25,
        )
        for policy, start in starts.items()
    ]
    at_point, elsewhere = motions
    assert np.abs(at_point.u).max() > 1e-6
    assert elsewhere.u == pytest.approx(at_point.u, abs=1e-12)
    for q, other in zip(at_point.q, elsewhere.q, strict=True):
        relative = pose.actInv(pin.XYZQUATToSE3(other[:7]))
        assert relative.isApprox(pin.XYZQUATToSE3(q[:7]), 1e-9)


def test_forces_on_the_base_are_in_its_axes():
    """A law of base forces in reference axes, hybrid, follows in base axes, to first order."""
    robot = fflin.load("planar_detumble", lock=["joint_*"])
    lin = fflin.linearize(robot).discretize(0.2)
    law = fflin.StateFeedback(lin, fflin.lqr(lin).K)
    assert lin.frame == "hybrid"
    pose = pin.SE3(pin.exp3(np.array((0.0, 2.0, 0.0))), np.array((3.0, -1.0, 2.0)))
    differences = []
    for size in (1e-3, 1e-4):
        step = pin.SE3(
            pin.exp3(size * np.array((1.0, -2.0, 1.0))),
            size * np.array((1.0, 2.0, -1.0)),
        )
        near, far = (
            fflin.simulate(
                robot,
                policy,
                q0=fflin.configuration(robot, base=base * step),
                duration=4.0,
                dt=0.1,
            ).u
            for policy, base in (
                (law, pin.SE3.Identity()),
                (law.follow(resting(robot, pose)), pose),
            )
        )
        differences.append(np.abs(near - far).max() / np.abs(near).max())
    # The relative difference of the commands is proportional to the size of the error.
    assert differences[0] < 0.02
    assert differences[1] < 0.2 * differences[0]


@pytest.mark.exhaustive
def test_a_constant_torque_leaves_no_error_after_the_slew():
    robot = satellite(disturbance={"tau_b": [2e-6, -1e-6, 0.0]})
    trajectory = slew(satellite())
    policy = output_feedback(satellite()).follow(trajectory)
    motion = fflin.simulate(robot, policy, duration=120.0, dt=0.25)
    assert motion.attitude_error.max() > 0.01
    assert motion.attitude_error[-1] < 1e-4


def test_wheels_keep_their_speeds_after_the_end():
    robot = satellite()
    v0 = fflin.velocity(robot, {"wheel_z": 300.0})

    def push(t, q, v):
        return np.array((0.0, 0.0, TORQUE if t < 0.999 else -TORQUE))

    trajectory = fflin.simulate(
        robot, push, v0=v0, duration=2.0, sample=1.0, dt=0.5
    ).trajectory()
    policy = output_feedback(robot).follow(trajectory)
    assert policy.reference(100.0)[1][-1] == pytest.approx(300.0, rel=1e-6)
    motion = fflin.simulate(robot, policy, duration=10.0, dt=0.125)
    assert motion.attitude_error.max() < 1e-7
    assert motion.v[-1][-1] == pytest.approx(300.0, rel=1e-6)


def test_an_accelerometer_is_compared_with_the_planned_acceleration():
    outputs = [fflin.BasePose(), fflin.Gyroscope("base"), fflin.Accelerometer("base")]
    robot = free_body((4.0, 5.0, 6.0)).replace(outputs=outputs)

    def push(t, q, v):
        u = np.zeros(6)
        u[3:] = 2.0 if t < 0.999 else -2.0
        return u

    trajectory = fflin.simulate(robot, push, duration=2.0, sample=1.0, dt=0.5)
    lin = fflin.linearize(robot).discretize(0.5)
    estimator = fflin.kalman(lin, {"omega_b": 1e-6, "v_b": 1e-6}, 1e-6)
    law = fflin.OutputFeedback(lin, fflin.lqg(fflin.lqr(lin), estimator))
    policy = law.follow(trajectory.trajectory())
    motion = fflin.simulate(robot, policy, duration=4.0, dt=0.25)
    planned = np.array([policy.reference(t)[0][:3] for t in motion.t])
    assert motion.q[:, :3] == pytest.approx(planned, abs=1e-9)
    assert np.abs(motion.q[-1][:3]).max() > 1e-3
    assert np.abs(motion.u[0, 3:]) == pytest.approx(2.0 * np.ones(3))


@pytest.mark.exhaustive
def test_a_campaign_follows_with_errors_of_its_sensors():
    robot = satellite()
    for law in (output_feedback(robot), state_feedback(robot)):
        policy = law.follow(slew(robot))
        options = {"duration": 2.0, "dt": 0.25, "engine": "python", "runs": 2}
        campaign = fflin.monte_carlo(robot, policy, {"q_b.noise": 1e-4}, **options)
        assert campaign.quantile("worst attitude", 0.5).value > 1e-5


def test_the_trajectory_may_lack_inputs_of_the_law():
    """A plan for wheels is followed by a law for wheels and a base torque, which stays zero."""
    robot = satellite()
    design = robot.replace(inputs=[fflin.BaseTorque(), *robot.inputs])
    model = fflin.linearize(design).discretize(SAMPLE)
    law = fflin.StateFeedback(model, fflin.lqr(model, wheel_speeds=False).K)
    motion = fflin.simulate(design, law.follow(slew(robot)), duration=TURN, dt=0.25)
    assert motion.attitude_error.max() < 1e-9
    assert np.abs(motion.u[:, :3]).max() < 1e-12


def test_laws_and_trajectories_that_do_not_fit_are_refused():
    robot = satellite()
    trajectory = slew(robot)
    lin = fflin.linearize(robot)
    continuous = fflin.StateFeedback(lin, fflin.lqr(lin).K)
    with pytest.raises(fflin.InputError, match="continuous, expected a sampled law"):
        continuous.follow(trajectory)
    law = output_feedback(robot)
    with pytest.raises(fflin.InputError, match="trajectory has type ndarray"):
        law.follow(trajectory.q)
    turned = fflin.linearize(
        robot,
        fflin.configuration(robot, rpy=(5, 0, 0)),
        reference=pin.SE3.Identity(),
    ).discretize(SAMPLE)
    displaced = fflin.StateFeedback(turned, fflin.lqr(turned).K)
    with pytest.raises(fflin.InputError, match="displaced from the reference"):
        displaced.follow(trajectory)
    other = fflin.load("planar_detumble")
    v0 = fflin.velocity(other, {"joint_1": 0.1})
    foreign = fflin.simulate(other, v0=v0, duration=1.0).trajectory()
    with pytest.raises(fflin.InputError, match="the model was made for 'cubesat'"):
        law.follow(foreign)
    spinning = fflin.velocity(robot, {"omega_b.z": 0.01})
    moving = fflin.simulate(robot, v0=spinning, duration=1.0).trajectory()
    with pytest.raises(fflin.InputError, match="the base moves at the start"):
        law.follow(moving)
    assert isinstance(output_feedback(robot, delay=0.0).follow(moving), Following)


def test_an_end_that_no_input_holds_is_named():
    robot = fflin.load("planar_detumble", gravity=(0.0, 0.0, -9.81))
    weak = robot.replace(inputs=[fflin.BaseTorque(), fflin.JointTorque("*")])
    falling = fflin.simulate(weak, duration=1.0, dt=0.1).trajectory()
    free = weak.replace(gravity=(0.0, 0.0, 0.0))
    lin = fflin.linearize(free).discretize(0.1)
    K = np.zeros(lin.B.shape[::-1])
    policy = fflin.StateFeedback(lin, K).follow(falling)
    with pytest.raises(fflin.InputError, match="at the end of the trajectory"):
        fflin.simulate(weak, policy, duration=2.0, dt=0.1)


@pytest.mark.compiled
@pytest.mark.parametrize(
    ("kind", "duration"),
    [
        ("estimated disturbance", TURN + 4.0),
        ("integral action", TURN + 4.0),
        ("state feedback", TURN + 4.0),
        *exhaustive(("star tracker", 5.0), ("star tracker", TURN + 7.0)),
    ],
)
def test_compiled_code_follows_as_python_does(kind, duration):
    """The pattern of arrivals repeats after the end of the slew, too."""
    robot, law = LAWS[kind](delay=0.35)
    policy = law.follow(slew(robot))
    q0 = fflin.configuration(robot, rpy=(2, -1, 3))
    options = {"q0": q0, "duration": duration, "dt": 0.05}
    python, compiled = (
        fflin.simulate(robot, policy, engine=engine, **options)
        for engine in ("python", "compiled")
    )
    assert python.attitude_error[0] > 2.0
    assert compiled.q == pytest.approx(python.q, abs=1e-11)
    assert compiled.u == pytest.approx(python.u, abs=1e-13)


@pytest.mark.compiled
@pytest.mark.exhaustive
@pytest.mark.parametrize("kind", ["estimated disturbance", "star tracker"])
def test_a_compiled_campaign_follows_as_python_does(kind):
    robot, law = LAWS[kind]()
    policy = law.follow(slew(robot))
    spreads = {"q_b": 0.01, "*.mass": 0.05, "q_b.noise": 1e-5}
    options = {"runs": 9, "duration": 5.0, "dt": 0.05}
    python, compiled = (
        fflin.monte_carlo(robot, policy, spreads, engine=engine, **options)
        for engine in ("python", "compiled")
    )
    assert compiled.x == pytest.approx(python.x, rel=1e-7, abs=1e-10)
    for name in ("attitude", "worst attitude"):
        value = python.quantile(name, 0.5).value
        assert value > 1e-4
        assert compiled.quantile(name, 0.5).value == pytest.approx(value, rel=1e-6)


@pytest.mark.exhaustive
def test_a_planned_slew_with_spinning_wheels_is_followed_and_held():
    """Wheels are inputs of the plan and end at the speeds that the momentum determines."""
    pytest.importorskip("piqp")
    robot = satellite()
    v0 = fflin.velocity(robot, {"wheel_x": 60.0, "wheel_y": -40.0})
    goal = fflin.configuration(robot, rpy=(0, 0, 40))
    trajectory = fflin.plan(
        robot, (goal, None), 60.0, v0=v0, knots=31, free=["r_b", "v_b"]
    )
    final = trajectory.v[-1]
    assert np.abs(final[3:6]).max() < 1e-7
    # The momentum of the wheels is constant in inertial axes.
    turned = pin.XYZQUATToSE3(goal[:7]).rotation
    assert turned @ final[6:] == pytest.approx(v0[6:], abs=1e-3)
    motion = fflin.simulate(
        robot, output_feedback(robot).follow(trajectory), duration=100.0
    )
    assert motion.attitude_error.max() < 0.02
    assert motion.attitude_error[-1] < 1e-3


def test_a_law_about_a_point_does_not_follow_a_periodic_trajectory():
    robot = fflin.load("cubesat", inputs=[fflin.BaseTorque()], orbit=600e3)
    model = fflin.linearize(robot).discretize(10.0)
    law = fflin.StateFeedback(model, np.zeros((3, 12)))
    along = fflin.linearize_orbit(robot, steps=8)
    with pytest.raises(fflin.InputError, match="follows needs a trajectory that ends"):
        law.follow(along)


def test_a_delayed_sensor_is_compared_with_the_reference_of_its_measurement():
    robot = fflin.load(
        "cubesat",
        inputs=[fflin.BaseTorque()],
        outputs=[fflin.StarTracker(delay=SAMPLE)],
    )
    lin = fflin.linearize(robot)
    law = fflin.PD("q_b", "tau_b", shared=True)
    tuned = fflin.tune(lin, law, fflin.Margin(0.8), dt=SAMPLE, starts=1, steps=3)

    def bang_bang(t, q, v):
        torque = 1e-4 if t < 0.5 * TURN * (1.0 - 1e-12) else -1e-4
        return np.array([0.0, 0.0, torque])

    trajectory = fflin.simulate(
        robot, bang_bang, duration=TURN, sample=0.5, dt=0.5
    ).trajectory()
    policy = tuned.follow(trajectory)
    motion = fflin.simulate(robot, policy, duration=TURN + 4.0, dt=0.125)
    assert np.abs(motion.q[-1] - motion.q[0]).max() > 0.01
    assert motion.attitude_error.max() < 1e-6
