"""Loops along a trajectory, closed over what is measured."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

import fflin
from fflin.dynamics.state_rows import moving_error

OUTPUTS = (
    *(fflin.BasePose(), fflin.JointPositions(), fflin.FramePose("link_3")),
    *(fflin.Gyroscope("base"), fflin.Accelerometer("base")),
)
SAMPLE, STEP = 0.1, 0.0125


def flown(robot, knots=16, strength=1.0):
    """A robot that tumbles under inputs that change from sample to sample."""
    rng = np.random.default_rng(3)
    size = strength * np.r_[np.ones(6), 0.02 * np.ones(robot.n)]
    u = rng.normal(size=(knots, 6 + robot.n)) * size
    return fflin.simulate(
        *(robot, lambda t, q, v: u[min(int(t / SAMPLE + 1e-9), knots - 1)]),
        v0=fflin.velocity(robot, {"omega_b.z": 0.3, "omega_b.x": 0.1, "joint_1": 0.4}),
        **{"duration": knots * SAMPLE, "dt": STEP, "sample": SAMPLE, "frame": "local"},
        every=round(SAMPLE / STEP),
    ).trajectory()


def pair(robot, traj, V=1e-4, W=1e-3, P0=1e-4):
    along = fflin.linearize_trajectory(robot, traj, strict=True)
    R = along[0].M.diagonal() ** -2.0
    gains = fflin.tvlqr(along, 1.0, R, sample=SAMPLE)
    return along, gains, fflin.tvkalman(along, W, V, P0=P0, sample=SAMPLE)


@pytest.fixture(scope="module")
def loop():
    robot = fflin.load("planar_detumble", outputs=OUTPUTS)
    return robot, *pair(robot, flown(robot))


def start(robot, along, e):
    """Where a robot is whose error from the first knot is e."""
    lin = along[0]
    near = fflin.StateMap(robot, reference=lin.reference, frame="local")
    return near.to_pinocchio(lin.x0 + e)


def error(robot, along, t, q, v):
    state = fflin.StateMap(robot, frame="local")
    return moving_error(state, *along.point(min(t, along.t[-1]))[:2], q, v)


def fly(robot, along, policy, e, **options):
    """The errors at the samples, and the estimates of them."""
    bound, rows, estimates = policy.bind(robot), [], []

    def asked(t, q, v):
        rows.append(error(robot, along, t, q, v))
        estimates.append(bound.estimate)
        return bound(t, q, v)

    q0, v0 = start(robot, along, e)
    options = {"duration": float(along.t[-1]), **options}
    fflin.simulate(
        *(robot, asked),
        **{
            "q0": q0,
            "v0": v0,
            "dt": STEP,
            "sample": SAMPLE,
            "frame": "local",
            **options,
        },
    )
    return np.array(rows), np.array(estimates)


def test_the_linear_loop_predicts_it_to_second_order(loop):
    robot, along, gains, seen = loop
    assert seen.D.any() and np.ptp(seen.C, axis=0).max() > 0.1
    policy, apart = fflin.TrajectoryOutputFeedback(along, gains, seen), []
    for size in (2e-4, 1e-4):
        e = first = size * np.cos(np.arange(len(along.state_names)))
        z, rows, expected = np.zeros_like(e), [], []
        for k in range(len(seen.A)):
            rows.append(e)
            expected.append(z)
            du = -gains.K[k] @ z
            y = seen.C[k] @ e + seen.D[k] @ du
            innovation = y - seen.C[k] @ z - seen.D[k] @ du
            z = seen.A[k] @ z + seen.B[k] @ du + seen.L[k] @ innovation
            e = seen.A[k] @ e + seen.B[k] @ du
        errors, estimates = fly(robot, along, policy, first)
        apart.append([np.abs(errors - rows).max(), np.abs(estimates - expected).max()])
    assert np.max(apart[0]) < 0.05 * 2e-4
    # What is left is of second order.
    assert np.divide(*apart) == pytest.approx([4.0, 4.0], abs=0.2)


@pytest.mark.exhaustive
def test_the_errors_of_the_estimate_are_as_large_as_the_filter_says():
    """NEES: e' P^-1 e of the estimate's error e has nx degrees of freedom (Bar-Shalom et al.)."""
    robot = fflin.load("planar_detumble", outputs=OUTPUTS)
    noise = 3e-4 * np.r_[np.ones(6), 2.0 * np.ones(3), np.ones(6), 3.0 * np.ones(6)]
    push = np.r_[0.02 * np.ones(6), 1e-3 * np.ones(robot.n)]  # roots of intensities
    along = fflin.linearize_trajectory(robot, flown(robot), strict=True)
    gains = fflin.tvlqr(along, 1.0, along[0].M.diagonal() ** -2.0, 1.0, sample=SAMPLE)
    seen = fflin.tvkalman(along, push**2, noise**2, along.B, 2e-3**2, sample=SAMPLE)
    state, runs, nx = fflin.StateMap(robot, frame="local"), 40, len(seen.state_names)
    # What is estimated is worth the measuring.
    assert (
        seen.P[-1].diagonal() < 0.2 * (seen.A[0] @ seen.P[0] @ seen.A[0].T).diagonal()
    ).sum() > 6

    def nees(seed):
        rng = np.random.default_rng(seed)
        pushes = rng.normal(size=(200, len(push))) * push / STEP**0.5
        e, z = fly(
            *(robot, along),
            fflin.TrajectoryOutputFeedback(
                along, gains, seen, lambda t: noise * rng.normal(size=len(noise))
            ),
            2e-3 * rng.normal(size=nx),
            disturbance=lambda t, q, v: state.lift(pushes[int(t / STEP + 1e-6)]),
        )
        off = (e - z)[..., None]
        return (off * np.linalg.solve(seen.P[:-1], off)).sum(axis=(1, 2))

    result = np.sum([nees(seed) for seed in range(runs)], axis=0)
    low, high = chi2.ppf((1e-3, 1.0 - 1e-3), runs * nx)
    assert low < result.min() and result.max() < high
    assert result.mean() == pytest.approx(runs * nx, rel=0.05)


@pytest.mark.exhaustive
def test_it_goes_on_at_rest_where_the_trajectory_ends(loop):
    robot, along, gains, seen = loop
    policy = fflin.TrajectoryOutputFeedback(along, gains, seen)
    flown = fflin.simulate(robot, policy, dt=STEP)
    # On its trajectory, at the knots nothing but rounding.
    assert np.abs(flown.error[::8]).max() < 1e-12
    apart = []
    for size in (1e-3, 5e-4):
        q0, v0 = start(robot, along, size * np.cos(np.arange(len(seen.state_names))))
        flown = fflin.simulate(robot, policy, q0=q0, v0=v0, dt=STEP)
        assert flown.t[-1] == pytest.approx(1.6)
        # The linear loop from sample to sample: the error e, and its estimate z.
        e, z, rows = flown.error[0], np.zeros(len(seen.state_names)), [flown.error[0]]
        for k, (A, B, C, D) in enumerate(
            zip(gains.A, gains.B, seen.C, seen.D, strict=False)
        ):
            terms = policy.terms(k * SAMPLE)
            u = terms.C @ z
            z = terms.A @ z + terms.B @ (C @ e + D @ u)
            e = A @ e + B @ u
            rows.append(e)
        apart.append(np.abs(flown.error[::8] - rows).max() / size)
    # Matrices that are linear between knots leave this of it.
    assert max(apart) < 0.02
    # From the motion at the end, which is none of rest, to rest.
    on = fflin.simulate(robot, policy, dt=STEP, duration=40.0)
    # From the motion at the end, which is none of rest, to rest.
    assert np.abs(on.v[128]).max() > 0.3
    assert np.abs(on.error[-1]).max() < 1e-3
    jump = policy.terms(policy.duration).jump
    moved = fflin.StateMap(robot, frame="local").velocities(on.v[128])
    np.testing.assert_allclose(jump[len(jump) // 2 :], moved, atol=1e-9)


def test_held_inputs_follow_linear_ones_by_their_mean(monkeypatch):
    robot = fflin.load("planar_detumble", outputs=OUTPUTS)
    t = np.linspace(0.0, 2.0, 11)
    u = np.outer(np.sin(2.0 * t), [1.0, 0.0, 2.0, 5.0, 5.0, 0.0, 0.1, 0.1, 0.1])
    flown = fflin.simulate(
        *(robot, lambda time, q, v: [np.interp(time, t, x) for x in u.T]),
        **{"duration": 2.0, "dt": 0.005, "frame": "local", "every": 40},
    )
    traj = fflin.Trajectory(robot, t, flown.q, flown.v, u)
    along, gains, seen = pair(robot, traj)
    run = fflin.simulate(
        robot, fflin.TrajectoryOutputFeedback(along, gains, seen), dt=STEP
    )
    at = round(SAMPLE / STEP)
    seen_state = fflin.simulate(robot, fflin.TrajectoryFeedback(along, gains), dt=STEP)
    # By their value at the sample it is off by half a sample, of first order.
    monkeypatch.setattr(fflin.TrajectoryFeedback, "ahead", 0.0)
    late = fflin.simulate(robot, fflin.TrajectoryFeedback(along, gains), dt=STEP)
    for item in (run, seen_state):
        assert np.abs(item.error[::at]).max() < 0.5 * np.abs(late.error[::at]).max()


@pytest.mark.exhaustive
def test_a_mismatched_argument_is_refused(loop):
    robot, along, gains, seen = loop
    make = fflin.TrajectoryOutputFeedback
    with pytest.raises(fflin.InputError, match="FilterSchedule"):
        make(along, gains, np.eye(3))
    continuous = fflin.tvlqr(along, 1.0, 1.0, 1.0)
    with pytest.raises(fflin.InputError, match=r"0 s.*0\.1 s"):
        make(along, continuous, seen)
    with pytest.raises(fflin.InputError, match="trajectory"):
        make(along, gains, replace(seen, A=2.0 * seen.A))
    policy = make(along, gains, seen)
    with pytest.raises(fflin.InputError, match="outputs"):
        fflin.simulate(robot.replace(outputs=[fflin.BasePose()]), policy, dt=STEP)
    with pytest.raises(fflin.InputError, match=r"0\.2 s"):
        fflin.simulate(robot, policy, dt=STEP, sample=0.2)
    short = make(along, gains, seen, lambda t: np.zeros(3))
    with pytest.raises(fflin.InputError, match="output"):
        fflin.simulate(robot, short, dt=STEP)
