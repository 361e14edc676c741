"""The linear motion beside the nonlinear one, under every policy that is linear."""

import numpy as np
import pytest

import fflin
from fflin.simulation.simulate import _affine_motion
from tests.support.measured import FELT, POSITIONS, designed, foreseen
from tests.support.motions import displaced, regulated
from tests.support.weights import unit_weights


@pytest.mark.parametrize("outputs", [POSITIONS, FELT], ids=["positions", "felt"])
def test_a_measured_feedback_is_predicted_with_its_filter(outputs):
    robot, lin, compensator = designed(outputs, stiffness=3.0)
    policy = fflin.OutputFeedback(lin, compensator)
    x0 = lin.x0 + 1e-3 * np.cos(np.arange(len(lin.x0)))
    options = {"x0": x0, "duration": 2.0, "dt": 0.01}
    seldom = fflin.simulate(robot, policy, every=5, **options)
    np.testing.assert_allclose(
        seldom.linear, foreseen(lin, compensator, x0, 40), atol=1e-12
    )
    # Of the continuous model at every row, at the samples the same.
    q = fflin.configuration(robot, {"joint_2": 0.4})
    continuous = fflin.linearize(robot, q, None, fflin.equilibrium(robot, q).u)
    often = fflin.simulate(robot, policy, linear=continuous, **options)
    assert often.linear.shape == often.x.shape
    np.testing.assert_allclose(often.linear[::5], seldom.linear, atol=1e-11)
    assert np.abs(often.linear - often.x).max() < 0.1 * np.abs(often.x - lin.x0).max()


def test_a_robot_that_nothing_drives_is_predicted():
    robot = fflin.load("ets_vii", stiffness=30.0, damping=3.0)
    lin = fflin.linearize(robot)
    x0 = lin.x0 + 1e-4 * np.cos(np.arange(len(lin.x0)))
    free = fflin.simulate(robot, x0=x0, duration=3.0, linear=lin)
    assert np.abs(free.linear - free.x).max() < 1e-7 < 1e-5 < np.abs(free.x - x0).max()


def test_a_feedback_of_a_part_is_predicted_by_the_whole_model():
    robot = fflin.load("servicer_7dof")
    robot = robot.replace(
        inputs=[item for item in robot.inputs if hasattr(item, "joint")]
    )
    lin = fflin.linearize(robot)
    part = fflin.momentum_reduction(lin)
    policy = fflin.StateFeedback(part, fflin.lqr(part, *unit_weights(part)).K)
    x0 = lin.x0.copy()
    x0[6 : 6 + robot.n] += 1e-4
    run = fflin.simulate(robot, policy, x0=x0, duration=5.0, linear=lin)
    moved = np.abs(run.x - x0).max(axis=0)
    assert np.abs(run.linear - run.x).max() < 1e-7 < 1e-5 < moved[:3].max()
    assert fflin.simulate(robot, policy, x0=x0, duration=0.1).linear is None
    with pytest.raises(fflin.InputError, match="linear="):
        fflin.simulate(robot, policy, x0=x0, duration=0.1, linear=True)


def test_a_model_about_another_point_predicts_with_the_policys_law():
    robot, lin, gain = regulated("ets_vii")
    q = fflin.configuration(robot, {"joint_1": 1e-3})
    beside = fflin.linearize(robot, q)
    policy, x0 = fflin.StateFeedback(lin, gain.K), displaced(lin, 0.05, 1e-3, 1e-3)
    point = fflin.simulate(robot, policy, x0=x0, duration=10.0)
    motion = fflin.simulate(robot, policy, x0=x0, duration=10.0, linear=beside)
    assert np.abs(motion.linear - motion.x).max() < 1e-5
    np.testing.assert_allclose(motion.linear[-1], point.linear[-1], atol=1e-5)


def test_where_nothing_can_be_predicted_the_reason_is_reported():
    robot, lin, gain = regulated("planar_detumble")
    feedback = fflin.StateFeedback(lin, gain.K)
    batch = fflin.sweep(robot, fflin.grid(robot, {"joint_1": [0.0, 1.0]}))
    policies = (
        fflin.Allocation(feedback, robot),
        fflin.ScheduledFeedback(lin, fflin.lqr_batch(batch, 1.0, 1.0)),
        feedback.bind(robot),
    )
    for policy in policies:
        for linear in (lin, True):
            why = (
                f"cannot predict a motion with a policy of type {type(policy).__name__}"
            )
            with pytest.raises(fflin.InputError, match=why) as caught:
                fflin.simulate(robot, policy, duration=0.1, linear=linear)
            assert "\n" not in str(caught.value)
        assert fflin.simulate(robot, policy, duration=0.02, sample=0.02).linear is None


def test_a_model_in_another_reference_predicts_nothing():
    robot, lin, gain = regulated("ets_vii")
    moved = fflin.configuration(robot, {}, fflin.linearize(robot).reference)
    moved[0] += 1.0
    other = fflin.linearize(robot, moved)
    policy = fflin.StateFeedback(lin, gain.K)
    with pytest.raises(fflin.InputError, match="frame"):
        fflin.simulate(robot, policy, duration=0.1, linear=other)


def test_a_continuous_controller_is_predicted_from_another_point_and_with_accelerometers():
    outputs = [fflin.BasePose(), fflin.JointPositions(), fflin.Accelerometer("base")]
    robot = fflin.load("ets_vii", outputs=outputs, stiffness=3.0, damping=1.0)
    lin = fflin.linearize(robot)
    (nu, nx), ny = lin.B.T.shape, len(lin.y0)
    rng = np.random.default_rng(2)
    B, C = rng.normal(size=(2, ny)), rng.normal(size=(nu, 2))
    D = np.zeros((nu, ny))
    D[:, :6] = rng.normal(size=(nu, 6))
    policy = fflin.LinearController((-np.eye(2), B, C, D), lin)
    q = fflin.configuration(robot, {"joint_1": 0.02})
    beside = fflin.linearize(robot, q, u=fflin.equilibrium(robot, q).u)
    x0 = lin.x0 + 1e-4 * np.cos(np.arange(nx))
    for linear in (True, beside):
        run = fflin.simulate(robot, policy, x0=x0, duration=2.0, dt=0.01, linear=linear)
        moved = np.abs(run.x - x0).max()
        assert np.abs(run.linear - run.x).max() < 1e-3 * moved


@pytest.mark.parametrize(
    "steps, every",
    [
        (1, 1),
        (64, 1),
        (100, 7),
        (98, 7),
        (5, 9),
        (255, 1),
        (256, 1),
        (700, 7),
        (1030, 300),
    ],
)
def test_the_motion_of_a_linear_loop_matches_its_single_steps(steps, every):
    rng = np.random.default_rng(4)
    A = 0.99 * np.linalg.qr(rng.normal(size=(5, 5)))[0]
    f0, e = rng.normal(size=(2, 5))
    expected = [e]
    for _ in range(steps):
        expected.append(A @ expected[-1] + f0)
    rows = [*expected[:-1:every], expected[-1]]
    result = _affine_motion(A, f0, e, steps, every)
    # Each of 100 steps adds a rounding error of a few EPS, and none grows.
    assert np.abs(result - rows).max() < 1e-12 * np.abs(rows).max()


def test_a_prediction_survives_powers_that_overflow():
    """A motion at rest in an unstable equilibrium is predicted, whose powers exceed all numbers."""
    robot = fflin.load("planar_detumble")
    lin = fflin.linearize(robot)
    K = np.zeros(lin.B.T.shape)
    K[:, :9] = -300.0 * np.linalg.inv(lin.B[9:])
    policy = fflin.StateFeedback(lin, K)
    motion = fflin.simulate(robot, policy, duration=100.0, dt=0.05, every=800)
    assert motion.prediction.shape == motion.x.shape
    assert not motion.prediction.any()
