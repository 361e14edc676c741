"""The Kalman filter along a trajectory: closed forms, duality, what it does to covariances."""

from dataclasses import fields
from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import fflin
from tests.support.marks import exhaustive
from tests.support.motions import motion

POSES = (fflin.BasePose(), fflin.JointPositions())
SEEN = (*POSES, fflin.FramePose("tool"), fflin.Gyroscope("base"))


@pytest.fixture(scope="module")
def moving():
    robot = fflin.load(
        "astrobee_arm", gravity=(0.0, 0.1, -0.2), damping=0.05, outputs=SEEN[:2]
    )
    robot = robot.replace(
        outputs=[*POSES, fflin.Accelerometer("base"), fflin.Gyroscope("base")]
    )
    return fflin.linearize_trajectory(robot, *motion(robot, knots=41))


def resting(name, duration, outputs=POSES, knots=11):
    robot = fflin.load(name, outputs=outputs)
    q = np.tile(robot.neutral(), (knots, 1))
    zero = np.zeros((knots, robot.nv))
    t = np.linspace(0.0, duration, knots)
    return robot, fflin.linearize_trajectory(
        robot, t, q, zero, np.zeros((knots, 6 + robot.n))
    )


def near(expected, relative):
    return pytest.approx(expected, rel=0.0, abs=relative * np.abs(expected).max())


def noise_of(traj):
    """Intensities of the inputs' noise, and of the outputs'."""
    return np.linspace(0.1, 0.3, traj.B.shape[2]) ** 2, np.linspace(
        1e-2, 3e-2, traj.C.shape[1]
    )


def integrated(rate, knots, P):
    """A covariance at the end of an equation that is smooth between the knots, to 1e-12."""
    shape, y = P.shape, P.ravel()
    for span in pairwise(knots):
        y = solve_ivp(
            lambda t, y: rate(t, y.reshape(shape)).ravel(),
            *(span, y),
            **{"method": "DOP853", "rtol": 1e-12, "atol": 1e-15},
        ).y[:, -1]
    return y.reshape(shape)


@pytest.mark.exhaustive
@pytest.mark.parametrize("G", [None, "B"])
def test_of_samples_it_promises_the_covariance_and_no_other_gain_has_less(moving, G):
    W, V = noise_of(moving)
    nx = moving.B.shape[1]
    W = W if G else np.linspace(0.01, 0.02, nx)
    input_matrices = moving.B if G else np.tile(np.eye(nx), (41, 1, 1))
    schedule = fflin.tvkalman(moving, W, V, moving.B if G else None, 0.1, sample=0.1)
    assert (schedule.dt, len(schedule.t), schedule.residual < 1e-13) == (0.1, 5, True)
    linearizer = fflin.Linearizer(moving.robot, moving=True)
    sampled = moving.discretize(0.1)
    assert (sampled.A == schedule.A).all() and (sampled.B == schedule.B).all()
    assert (sampled.C == schedule.C).all() and (sampled.y == schedule.y).all()

    def rate(t, P):
        t = min(t, moving.t[-1])
        (through,) = moving.between(t, input_matrices)
        change = linearizer(*moving.point(t)).A @ P
        return change + change.T + through * W @ through.T

    def after(gains):
        P = 0.1 * np.eye(nx)
        for k, (start, end) in enumerate(pairwise(schedule.t)):
            # L = A L_update.
            update = np.linalg.solve(schedule.A[k], gains[k])
            kept = np.eye(nx) - update @ schedule.C[k]
            P = kept @ P @ kept.T + update * V @ update.T
            inner = moving.t[(moving.t > start + 1e-9) & (moving.t < end - 1e-9)]
            P = integrated(rate, [start, *inner, end], P)
        return P

    promised = schedule.P[-1]
    assert after(schedule.L) == near(promised, 1e-7)
    rng = np.random.default_rng(1)
    for size in (1e-1, 1.0):
        others = schedule.L * (1.0 + size * rng.normal(size=schedule.L.shape))
        assert (
            np.linalg.eigvalsh(after(others) - promised)[0]
            > -1e-6 * np.abs(promised).max()
        )
        assert np.trace(after(others)) > np.trace(promised)
    for k, t in enumerate(schedule.t[:-1]):
        for late in (0.0, 0.0999):
            assert (schedule.gain(t + late) == schedule.L[k]).all()
            assert (schedule.covariance(t + late) == schedule.P[k]).all()


@pytest.mark.exhaustive
def test_at_rest_it_tends_to_the_steady_filter_and_stays_positive():
    robot, traj = resting("ets_vii", 300.0, SEEN[:2])
    W, V = noise_of(traj)
    lin = fflin.linearize(robot, moving=True)
    W = W * lin.M.diagonal() ** 2
    h, Q = 0.5, lin.B * W @ lin.B.T
    AQ = lin.A @ Q
    Q = Q * h + (AQ + AQ.T) * h**2 / 2 + AQ @ lin.A.T * h**3 / 3
    steady = fflin.kalman(lin.discretize(h), Q, V)
    for P0 in (0.0, 1e4):
        schedule = fflin.tvkalman(traj, W, V, traj.B, P0, sample=h)
        assert schedule.P[-1] == near(steady.P, 1e-8)
        assert schedule.L[-1] == near(steady.L, 1e-7)
        for P in schedule.P:
            values = np.linalg.eigvalsh(P)
            assert values[0] >= -1e-12 * values[-1]
    begun = fflin.tvkalman(traj, W, V, traj.B, sample=h)
    assert np.abs(begun.L - steady.L).max() < 1e-7 * np.abs(steady.L).max()


def test_noise_of_the_inputs_is_noise_of_the_states_with_the_covariance_b_w_bt():
    _, traj = resting("cubesat", 0.4, knots=3)
    W, V = noise_of(traj)
    B = traj.B[0]
    of_inputs = fflin.tvkalman(traj, W, V, traj.B, 0.1, sample=0.2)
    of_states = fflin.tvkalman(traj, B * W @ B.T, V, None, 0.1, sample=0.2)
    assert of_inputs.P == near(of_states.P, 1e-12)
    assert of_inputs.L == near(of_states.L, 1e-12)


def test_a_declared_bias_is_no_state_of_the_filter():
    """The filter equals the filter without the bias, at each sample and after the end."""
    schedules, gains = [], []
    for bias in (None, 1e-6):
        outputs = [fflin.BasePose(), fflin.Gyroscope("base", bias=bias)]
        _, traj = resting("cubesat", 1.0, outputs, knots=3)
        schedule = fflin.tvkalman(traj, 1e-6, 1e-8, sample=0.5)
        regulator = fflin.tvlqr(traj, sample=0.5)
        policy = fflin.TrajectoryOutputFeedback(traj, regulator, schedule)
        schedules.append(schedule)
        gains.append(policy.terms(5.0).B)
    without, biased = schedules
    assert (biased.L == without.L).all() and (biased.P == without.P).all()
    assert (gains[0] == gains[1]).all() and gains[0].any()


@pytest.mark.parametrize("ending", ["npz", *exhaustive("mat", "json")])
def test_filters_are_kept(moving, tmp_path, ending):
    schedule = fflin.tvkalman(moving, 0.1, 0.1, P0=0.1, sample=0.2)
    schedule.save(tmp_path / f"filter.{ending}")
    back = fflin.FilterSchedule.load(tmp_path / f"filter.{ending}")
    for item in fields(schedule):
        assert np.array_equal(getattr(schedule, item.name), getattr(back, item.name)), (
            item.name
        )
    assert (back.gain(0.1) == schedule.gain(0.1)).all()
    start = "FilterSchedule('astrobee_arm', knots=3, nx=16, nu=8, ny=14, dt=0.2 s, residual="
    assert repr(schedule).startswith(start)


def test_errors_are_reported(moving):
    for words, (traj, *arguments), sample in (
        ("LinearTraj", (moving[0], 1, 1), 0.1),
        ("sampled", (moving.discretize(0.1), 1, 1), 0.1),
        ("'stedy'", (moving, 1, 1, None, "stedy"), 0.1),
        ("P0", (moving, 1, 1, None, -1.0), 0.1),
        ("V .*positive definite", (moving, 1, 0), 0.1),
        ("'tau'", (moving, {"tau": 1.0}, 1, moving.B), 0.1),
        (r"\(3,\)", (moving, 1, 1, np.ones(3)), 0.1),
        ("41", (moving, 1, 1, np.ones((2, 16, 1))), 0.1),
        (r"0\.3 s", (moving, 1, 1, None, 1.0), 0.3),
        (r"\bP\b", (moving, 1e308, 1, None, 1e308), 0.1),
    ):
        with pytest.raises(fflin.FflinError, match=words):
            fflin.tvkalman(traj, *arguments, sample=sample)
    _, traj = resting("cubesat", 1.0, [fflin.Gyroscope("base")])
    with pytest.raises(fflin.DetectabilityError, match=r"P0.*q_b\.x"):
        fflin.tvkalman(traj, 1, 1, sample=0.1)
    # Over a finite time it needs not be seen.
    assert fflin.tvkalman(traj, 1, 1, P0=1.0, sample=0.1).P[-1, 3, 3] > 1.0
