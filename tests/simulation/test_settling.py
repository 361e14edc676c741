"""A run is as long as its loop takes to settle."""

import numpy as np
import pytest

import fflin
from fflin.control.authority import thrusters_give_every_wrench
from fflin.control.margins import matrices_of_period
from fflin.simulation.plan import time_to_settle


def course(robot, policy, q):
    """Return the largest linear error of attitude, position and joints (3, N) each half second."""
    lin = policy.lin
    state = fflin.StateMap(robot, reference=lin.reference, frame=lin.frame)
    e = state.to_state(q, np.zeros(robot.nv)) - lin.x0
    values, vectors = np.linalg.eig(lin.A - lin.B @ policy.K)
    parts = np.linalg.solve(vectors, e)
    times = np.arange(0.0, 601.0, 0.5)
    x = np.abs((vectors @ (parts[:, None] * np.exp(np.outer(values, times)))).real)
    groups = (x[:3], x[3:6], x[6 : 6 + robot.n])
    return times, np.array([group.max(axis=0, initial=0.0) for group in groups])


@pytest.mark.parametrize("name", ["cubesat", "canadarm2", "servicer_7dof", "dual_arm"])
def test_it_is_the_time_after_which_the_linear_loop_stays_within_a_hundredth(name):
    springs = {"stiffness": 100.0, "damping": 1.0} if name == "servicer_7dof" else {}
    robot = fflin.load(name, **springs)
    lin = fflin.linearize(robot)
    policy = fflin.StateFeedback(lin, fflin.lqr(lin).K)
    q = fflin.configuration(robot, dict.fromkeys(robot.joint_names[:1], 0.1))
    q[3:7] = [np.sin(0.2), 0.0, 0.0, np.cos(0.2)]
    times, errors = course(robot, policy, q)
    late = (errors > 0.01 * errors.max(axis=1, keepdims=True) + 1e-15).any(axis=0)
    expected = max(60.0, 10.0 * np.ceil(times[late].max() / 10.0))
    assert time_to_settle(robot, policy, q, None) == expected


def test_sampled_loops_settle_when_their_continuous_ones_do():
    robot = fflin.load("canadarm2")
    lin = fflin.linearize(robot)
    sampled = lin.discretize(0.25)
    q = fflin.configuration(robot, {"joint_2": 0.3})
    one, two = (
        time_to_settle(robot, fflin.StateFeedback(item, fflin.lqr(item).K), q, None)
        for item in (lin, sampled)
    )
    assert abs(one - two) <= 20.0


def test_a_loop_that_takes_for_ever_is_looked_at_for_a_minute():
    robot = fflin.load("cubesat")
    lin = fflin.linearize(robot)
    K = (
        np.hstack((1e-6 * np.eye(6), 1e-3 * np.eye(6)))
        * np.abs(lin.M.diagonal())[:, None]
    )
    q = fflin.configuration(robot)
    q[:3] = 1.0
    assert time_to_settle(robot, fflin.StateFeedback(lin, K), q, None) == 60.0


def test_which_thrusters_give_every_wrench():
    inspector, cubesat = (
        fflin.load(name, inputs=fflin.load_inputs(name))
        for name in ("inspector", "cubesat")
    )
    assert thrusters_give_every_wrench(inspector) and thrusters_give_every_wrench(
        cubesat
    )
    assert not thrusters_give_every_wrench(fflin.load("cubesat"))
    fewer = [
        item
        for item in inspector.inputs
        if getattr(item, "name", "") != "top_left_front"
    ]
    assert not thrusters_give_every_wrench(inspector.replace(inputs=fewer))
    helped = [*fewer, fflin.BaseTorque(), fflin.BaseForce()]
    assert thrusters_give_every_wrench(inspector.replace(inputs=helped))


def test_states_that_are_not_fed_back_do_not_change_the_duration_of_a_run():
    wheels = [fflin.ReactionWheel(axis, inertia=1e-4) for axis in np.eye(3).tolist()]
    robot = fflin.load("cubesat", inputs=wheels)
    lin = fflin.linearize(robot)
    slow = (
        fflin.bryson(lin, {"q_b": 1.0, "omega_b": 1.0}),
        fflin.bryson(lin, {"wheel": 5e-5}),
    )
    policy = fflin.StateFeedback(lin, fflin.lqr(lin, *slow).K)
    q = fflin.configuration(robot)
    q[3:7] = [np.sin(0.2), 0.0, 0.0, np.cos(0.2)]
    beside = q.copy()
    beside[0] = 1.0  # which no wheel takes back
    time = time_to_settle(robot, policy, q, None)
    assert 60.0 < time < 600.0
    assert time_to_settle(robot, policy, beside, None) == time


@pytest.mark.exhaustive
def test_a_loop_of_sensors_with_different_sample_times_settles_as_it_is_simulated():
    sensors = [fflin.StarTracker(sample=0.5, delay=0.25), fflin.Gyroscope("base")]
    robot = fflin.load("cubesat", inputs=[fflin.BaseTorque()], outputs=sensors)
    lin = fflin.linearize(robot).discretize(0.25)
    weights = fflin.bryson(lin, {"q_b": 1.0, "omega_b": 0.1}), 1e10 * np.eye(3)
    law = fflin.lqg(fflin.lqr(lin, *weights), fflin.kalman(lin, 1e-10, 1e-8))
    policy = fflin.MultirateFeedback(lin, law)
    q = fflin.configuration(robot)
    q[3:7] = [np.sin(0.005), 0.0, 0.0, np.cos(0.005)]
    time = time_to_settle(robot, policy, q, None)
    motion = fflin.simulate(robot, policy, q0=q, duration=time + 20.0, dt=0.05)
    error = motion.attitude_error / motion.attitude_error.max()
    assert 60.0 < time < 600.0
    assert error[motion.t > time].max() < 0.01
    assert error[motion.t > time - 10.0].max() > 0.01


def test_the_matrices_of_a_period_predict_the_motion():
    """The order of three different matrices matters."""
    sensors = [fflin.StarTracker(sample=0.75, delay=0.25), fflin.Gyroscope("base")]
    robot = fflin.load("cubesat", inputs=[fflin.BaseTorque()], outputs=sensors)
    lin = fflin.linearize(robot).discretize(0.25)
    law = fflin.lqg(fflin.lqr(lin), fflin.kalman(lin, 1e-10, 1e-8))
    policy = fflin.MultirateFeedback(lin, law)
    matrices, dt = matrices_of_period(policy, lin)
    assert matrices.shape[0] == 3 and dt == 0.25
    q = fflin.configuration(robot)
    q[3:7] = [np.sin(1e-4), 0.0, 0.0, np.cos(1e-4)]
    motion = fflin.simulate(robot, policy, q0=q, duration=10.0, dt=0.05, every=5)
    state = np.zeros(matrices.shape[1])
    state[:12] = motion.x[0]
    for k, x in enumerate(motion.x[1:]):
        state = matrices[k % 3] @ state
        np.testing.assert_allclose(state[:12], x, rtol=0.0, atol=1e-9, err_msg=str(k))
