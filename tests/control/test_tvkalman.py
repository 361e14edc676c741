"""The Kalman filter along a trajectory: closed forms, duality, what it does to covariances."""

from dataclasses import fields, replace
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
    robot = fflin.load("astrobee_arm", gravity=(0.0, 0.1, -0.2), damping=0.05, outputs=SEEN[:2])
    robot = robot.replace(outputs=[*POSES, fflin.Accelerometer("base"), fflin.Gyroscope("base")])
    return fflin.linearize_trajectory(robot, *motion(robot, knots=41))


def resting(name, duration, outputs=POSES, knots=11):
    robot = fflin.load(name, outputs=outputs)
    q = np.tile(robot.neutral(), (knots, 1))
    zero = np.zeros((knots, robot.nv))
    t = np.linspace(0.0, duration, knots)
    return robot, fflin.linearize_trajectory(robot, t, q, zero, np.zeros((knots, 6 + robot.n)))


def near(expected, relative):
    return pytest.approx(expected, rel=0.0, abs=relative * np.abs(expected).max())


def test_double_integrators_have_the_closed_form_of_kalman_and_bucy():
    """Undisturbed, the information P^-1 is carried back by e^(-A t) and adds up over [0, t]."""
    robot, traj = resting("cubesat", 5.0)
    lin = fflin.linearize(robot, moving=True)
    A, P0, V = lin.A, np.diag(np.linspace(1.0, 4.0, 12)), np.linspace(0.5, 1.0, 6)
    schedule = fflin.tvkalman(traj, 0.0, V, P0=P0)
    S = lin.C.T @ np.diag(1.0 / V) @ lin.C

    def expected(t):
        back, AS = np.eye(12) - A * t, A.T @ S
        seen = S * t - (AS + AS.T) * t**2 / 2 + AS @ A * t**3 / 3
        return np.linalg.inv(back.T @ np.linalg.inv(P0) @ back + seen)

    for t in (0.0, 0.1, 1.234, 4.9):
        P = expected(t)
        # Within the 1e-7 that interpolation is held to.
        assert schedule.covariance(t) == near(P, 3e-7)
        assert schedule(t) == near(P @ lin.C.T / V, 1e-6)
    assert schedule.P[-1] == near(expected(5.0), 1e-9)
    assert (schedule.P[0] == P0).all()
    assert schedule.residual < 1e-6


def test_it_is_the_regulator_of_the_dual_system_backwards(moving, monkeypatch):
    # Matrices that are no robot's, linear between the knots.
    def linear(traj, times):
        rows = (traj.between(float(t), traj.A, traj.B) for t in times)
        return tuple(map(np.array, zip(*rows, strict=True)))

    monkeypatch.setattr(fflin.LinearTrajectory, "matrices_at", linear)
    rng = np.random.default_rng(0)
    nx, nu = moving.B.shape[1:]
    C = rng.normal(size=(nu, nx)) + moving.t[:, None, None] * rng.normal(size=(nu, nx))
    of = {"C": C, "D": moving.D[:, :nu], "y": moving.y[:, :nu]}
    traj = replace(moving, output_names=moving.output_names[:nu], **of)
    dual = {"A": traj.A[::-1].transpose(0, 2, 1), "B": C[::-1].transpose(0, 2, 1)}
    W, V, P0 = np.linspace(1.0, 2.0, nx), np.linspace(3.0, 5.0, nu), np.linspace(1.0, 4.0, nx)
    found = fflin.tvkalman(traj, W, V, P0=P0)
    expected = fflin.tvlqr(replace(traj, **dual), W, V, P0)
    assert found.t == pytest.approx(traj.t[-1] - expected.t[::-1], abs=1e-15)
    assert found.P == near(expected.P[::-1], 1e-13)
    assert found.L == near(expected.K[::-1].transpose(0, 2, 1), 1e-13)
    assert found.gain(0.123) == near(expected.gain(0.4 - 0.123).T, 1e-12)
    assert found.residual == pytest.approx(expected.residual, rel=1e-3)


def noise_of(traj):
    """Intensities of the inputs' noise, and of the outputs'."""
    return np.linspace(0.1, 0.3, traj.B.shape[2]) ** 2, np.linspace(1e-2, 3e-2, traj.C.shape[1])


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
def test_it_solves_the_differential_equation_under_noise_of_inputs(moving):
    W, V = noise_of(moving)
    schedule = fflin.tvkalman(moving, W, V, moving.B, P0=0.1)

    def rate(t, P):
        t = min(t, moving.t[-1])
        (A, _), (B, C) = moving.matrices(t), moving.between(t, moving.B, moving.C)
        return A @ P + P @ A.T + B * W @ B.T - P @ C.T / V @ C @ P

    assert schedule.P[-1] == near(
        integrated(rate, moving.t, 0.1 * np.eye(len(schedule.A[0]))), 1e-9
    )
    assert schedule.residual < 1e-6
    named = {"tau_b": W[0], "F_b": W[3], "tau_m": W[6]}
    again = fflin.tvkalman(moving, np.r_[[W[0]] * 3, [W[3]] * 3, [W[6]] * 2], V, moving.B, 0.1)
    assert (fflin.tvkalman(moving, named, V, G=moving.B, P0=0.1).P == again.P).all()
    # Columns that stay are a matrix.
    one = fflin.tvkalman(moving, W, V, moving.B[0], 0.1)
    many = fflin.tvkalman(moving, W, V, np.tile(moving.B[0], (41, 1, 1)), 0.1)
    assert one.P[-1] == near(many.P[-1], 1e-12)


@pytest.mark.exhaustive
@pytest.mark.parametrize("G", [None, "B"])
def test_of_samples_it_promises_the_covariance_and_no_other_gain_has_less(moving, G):
    W, V = noise_of(moving)
    nx = moving.B.shape[1]
    W = W if G else np.linspace(0.01, 0.02, nx)
    by = moving.B if G else np.tile(np.eye(nx), (41, 1, 1))
    schedule = fflin.tvkalman(moving, W, V, moving.B if G else None, 0.1, sample=0.1)
    assert (schedule.dt, len(schedule.t), schedule.residual < 1e-13) == (0.1, 5, True)
    linearizer = fflin.Linearizer(moving.robot, moving=True)
    sampled = moving.discretize(0.1)
    assert (sampled.A == schedule.A).all() and (sampled.B == schedule.B).all()
    assert (sampled.C == schedule.C).all() and (sampled.y == schedule.y).all()

    def rate(t, P):
        t = min(t, moving.t[-1])
        (through,) = moving.between(t, by)
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
        assert np.linalg.eigvalsh(after(others) - promised)[0] > -1e-6 * np.abs(promised).max()
        assert np.trace(after(others)) > np.trace(promised)
    for k, t in enumerate(schedule.t[:-1]):
        for late in (0.0, 0.0999):
            assert (schedule.gain(t + late) == schedule.L[k]).all()
            assert (schedule.covariance(t + late) == schedule.P[k]).all()


@pytest.mark.exhaustive
def test_samples_tend_to_what_is_measured_all_the_time(moving):
    W, V = noise_of(moving)
    whole = fflin.tvkalman(moving, W, V, moving.B, 0.1)
    apart = []
    for count in (80, 160):
        h = 0.4 / count
        # So many samples of covariance V/h say as much as an intensity V.
        sampled = fflin.tvkalman(moving, W, V / h, moving.B, 0.1, sample=h)
        apart.append(np.abs(sampled.P[-1] - whole.P[-1]).max() / np.abs(whole.P[-1]).max())
        # A sample's own correction is of first order in h.
        assert np.abs(sampled.L[count // 2] / h - whole.gain(0.2)).max() < 40 * h * whole.L.max()
    assert apart[0] < 0.1
    assert apart[0] / apart[1] == pytest.approx(2.0, abs=0.1)


@pytest.mark.exhaustive
@pytest.mark.parametrize("sample", [None, 0.5])
def test_at_rest_it_tends_to_the_steady_filter_and_stays_positive(sample):
    robot, traj = resting("ets_vii", 300.0, SEEN[:2])
    W, V = noise_of(traj)
    lin = fflin.linearize(robot, moving=True)
    W = W * lin.M.diagonal() ** 2
    if sample:
        h, Q = sample, lin.B * W @ lin.B.T
        AQ = lin.A @ Q
        Q = Q * h + (AQ + AQ.T) * h**2 / 2 + AQ @ lin.A.T * h**3 / 3
        steady = fflin.kalman(lin.discretize(h), Q, V)
    else:
        steady = fflin.kalman(lin, W, V, lin.B)
    for P0 in (0.0, 1e4):
        schedule = fflin.tvkalman(traj, W, V, traj.B, P0, sample)
        assert schedule.P[-1] == near(steady.P, 1e-8)
        assert schedule.L[-1] == near(steady.L, 1e-7)
        for P in schedule.P:
            values = np.linalg.eigvalsh(P)
            assert values[0] >= -1e-12 * values[-1]
    begun = fflin.tvkalman(traj, W, V, traj.B, sample=sample)
    assert np.abs(begun.L - steady.L).max() < 1e-7 * np.abs(steady.L).max()


@pytest.mark.parametrize("ending", ["npz", *exhaustive("mat", "json")])
def test_filters_are_kept(moving, tmp_path, ending):
    for sample in (None, 0.2):
        schedule = fflin.tvkalman(moving, 0.1, 0.1, P0=0.1, sample=sample)
        schedule.save(tmp_path / f"filter.{ending}")
        back = fflin.FilterSchedule.load(tmp_path / f"filter.{ending}")
        for item in fields(schedule):
            assert np.array_equal(getattr(schedule, item.name), getattr(back, item.name)), item.name
        assert (back.gain(0.1) == schedule.gain(0.1)).all()
    assert repr(schedule).startswith("FilterSchedule('astrobee_arm', 3 knots, 0 to 0.4 s, dt=0.2")
    assert "nx=16, ny=14, residual=" in repr(schedule)


def test_what_is_wrong_is_told(moving):
    for words, arguments in {
        "LinearTraj": (moving[0], 1, 1),
        "sampled": (moving.discretize(0.1), 1, 1),
        "'stedy'": (moving, 1, 1, None, "stedy"),
        "P0": (moving, 1, 1, None, -1.0),
        "V .*positive definite": (moving, 1, 0),
        "'tau'": (moving, {"tau": 1.0}, 1, moving.B),
        r"\(3,\)": (moving, 1, 1, np.ones(3)),
        "41": (moving, 1, 1, np.ones((2, 16, 1))),
        r"0\.3 s": (moving, 1, 1, None, 1.0, 0.3),
        r"\bP\b": (replace(moving, A=moving.A * 1e12), 1, 1, None, 1),
    }.items():
        with pytest.raises(fflin.FflinError, match=words):
            fflin.tvkalman(*arguments)
    _, traj = resting("cubesat", 1.0, [fflin.Gyroscope("base")])
    with pytest.raises(fflin.DetectabilityError, match=r"q_b\.x.*P0"):
        fflin.tvkalman(traj, 1, 1)
    # Over a finite time it needs not be seen.
    assert fflin.tvkalman(traj, 1, 1, P0=1.0).P[-1, 3, 3] > 1.0
