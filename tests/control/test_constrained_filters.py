"""Kalman filters along trajectories of robots with constraints."""

import numpy as np
import pytest
from scipy.linalg import expm

import fflin
from tests.support.constrained import parallelogram

SAMPLE, NOISE, V = 0.1, 0.04, 1e-4


@pytest.fixture(scope="module")
def resting():
    """Models along a resting trajectory of a hanging parallelogram that measures one crank."""
    robot = parallelogram(0.6, 1.5, 0.8, 1.1).replace(
        outputs=[fflin.JointPositions(("left",))], damping={"left": 0.5}
    )
    q = fflin.closed(robot, robot.neutral())
    motion = fflin.simulate(robot, q0=q, duration=0.3, dt=0.01, every=10)
    along = fflin.linearize_trajectory(robot, motion.trajectory(), independent=["left"])
    return robot, q, along


@pytest.fixture(scope="module")
def schedule(resting):
    """The filter along the resting trajectory, from its steady covariance."""
    _, _, along = resting
    return fflin.tvkalman(along, NOISE, V, sample=SAMPLE)


@pytest.mark.exhaustive
def test_the_covariance_is_the_exact_discrete_one(resting):
    """For constant A: the disturbance over a sample by Van Loan's matrix exponential."""
    robot, q, along = resting
    assert along.state_names == ("q_m.left", "qdot_m.left")
    P0 = np.diag((0.02, 0.05))
    seen = fflin.tvkalman(along, NOISE, V, P0=P0, sample=SAMPLE)
    lin = fflin.linearize(robot, q, independent=["left"])
    nx = len(lin.A)
    whole = np.zeros((2 * nx, 2 * nx))
    whole[:nx, :nx], whole[:nx, nx:] = -lin.A, NOISE * np.eye(nx)
    whole[nx:, nx:] = lin.A.T
    exponential = expm(SAMPLE * whole)
    transition = exponential[nx:, nx:].T
    W = transition @ exponential[:nx, nx:]
    P = P0
    for k, given in enumerate(seen.P):
        np.testing.assert_allclose(given, P, rtol=1e-9, atol=1e-13, err_msg=str(k))
        S = lin.C @ P @ lin.C.T + V
        P = P - P @ lin.C.T @ np.linalg.solve(S, lin.C @ P)
        P = transition @ P @ transition.T + W


@pytest.mark.exhaustive
def test_on_a_resting_trajectory_the_filter_is_the_time_invariant_one(
    resting, schedule
):
    robot, q, _ = resting
    lin = fflin.linearize(robot, q, independent=["left"]).discretize(SAMPLE)
    W = schedule.W[0]
    for L in schedule.L:
        expected = fflin.kalman(lin, W, V).L
        np.testing.assert_allclose(L, expected, rtol=1e-8)


@pytest.mark.exhaustive
def test_output_feedback_along_a_resting_trajectory_is_the_time_invariant_law(
    resting, schedule
):
    """Both laws regulate the same initial error, also after the end of the trajectory."""
    robot, q, along = resting
    gains = fflin.tvlqr(along, sample=SAMPLE)
    moving = fflin.TrajectoryOutputFeedback(along, gains, schedule)
    lin = fflin.linearize(robot, q, independent=["left"])
    sampled = lin.discretize(SAMPLE)
    K = gains.K[0]
    np.testing.assert_allclose(gains.K, np.broadcast_to(K, gains.K.shape), atol=1e-9)
    L = fflin.kalman(sampled, schedule.W[0], V).L
    guess = {"left": 0.1, "bar": -0.1, "right": 0.1}
    q0 = fflin.closed(robot, fflin.configuration(robot, guess))
    # the estimate, by hand: predicted with the measured angle of the crank
    run = fflin.simulate(
        robot, moving, q0=q0, duration=1.0, dt=0.01, every=10, engine="python"
    )
    A, B, C = sampled.A, sampled.B, sampled.C
    estimate = np.zeros(2)
    index = robot.joint("left").idx_q
    for k in range(10):
        u = -K @ estimate
        np.testing.assert_allclose(run.u[k], u + lin.u0, atol=1e-6)
        y = run.q[k, index]
        estimate = A @ estimate + B @ u + L @ (np.array((y,)) - C @ estimate)
    assert np.abs(run.u).max() > 1e-2
