"""The regulator along a trajectory: closed forms, the infinite horizon, the cost it promises."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import fflin
from fflin.control.optimal.differential_riccati import (
    solve_back,
    stepped_back,
    transitions,
)
from fflin.dynamics.integrators import GAUSS
from tests.support.messages import says
from tests.support.motions import motion


@pytest.fixture(scope="module")
def moving():
    robot = fflin.load("astrobee_arm", gravity=(0.0, 0.1, -0.2), damping=0.05)
    return fflin.linearize_trajectory(robot, *motion(robot, knots=41))


def resting(name, duration, knots=11):
    robot = fflin.load(name)
    q = np.tile(robot.neutral(), (knots, 1))
    zero = np.zeros((knots, robot.nv))
    t = np.linspace(0.0, duration, knots)
    u = np.zeros((knots, 6 + robot.n))
    return robot, fflin.linearize_trajectory(robot, t, q, zero, u)


def weights(traj):
    nx = traj.A.shape[1]
    R = 1.0 / np.array([fflin.linearize(traj.robot).M.diagonal()]).ravel() ** 2
    return np.linspace(1.0, 10.0, nx), R


def integrated(rate, knots, y):
    """The end of an initial value problem that is smooth between the knots, to 1e-12."""
    for span in pairwise(knots):
        y = solve_ivp(rate, span, y, method="DOP853", rtol=1e-13, atol=1e-15).y[:, -1]
    return y


@pytest.mark.exhaustive
def test_long_horizons_tend_to_the_regulator_and_keep_P_positive():
    robot, traj = resting("ets_vii", 300.0)
    Q, R = weights(traj)
    gain = fflin.lqr(fflin.linearize(robot, moving=True), Q, R)
    for Qf in (0.0, 1e6):
        schedule = fflin.tvlqr(traj, Q, R, Qf)
        assert schedule.P[0] == pytest.approx(
            gain.P, rel=1e-9, abs=1e-11 * np.abs(gain.P).max()
        )
        assert schedule.gain(0.0) == pytest.approx(
            gain.K, rel=1e-8, abs=1e-9 * gain.K.max()
        )
        assert schedule.residual < 1e-6
        for P in schedule.P:
            values = np.linalg.eigvalsh(P)
            assert values[0] >= -1e-12 * values[-1]


def test_double_integrators_have_the_closed_form():
    """With Q = 0, P^-1 is a polynomial of the time to go s:
    P^-1 = e^(-A s) Qf^-1 e^(-A' s) + the integral of e^(-A r) B R^-1 B' e^(-A' r) over [0, s]."""
    robot, traj = resting("cubesat", 5.0)
    lin = fflin.linearize(robot, moving=True)
    Qf, R = np.diag(np.linspace(1.0, 4.0, 12)), np.diag(lin.M.diagonal() ** -2.0)
    schedule = fflin.tvlqr(traj, 0.0, R, Qf)
    S = lin.B @ np.linalg.solve(R, lin.B.T)
    for t in (0.0, 1.234, 4.9):
        s = 5.0 - t
        back = np.eye(12) - lin.A * s
        AS = lin.A @ S
        gramian = S * s - (AS + AS.T) * s**2 / 2 + AS @ lin.A.T * s**3 / 3
        expected = np.linalg.inv(back @ np.linalg.inv(Qf) @ back.T + gramian)
        # Within the 1e-7 that interpolation is held to.
        assert schedule.cost_to_go(t) == pytest.approx(
            expected, abs=3e-7 * np.abs(expected).max()
        )
        K = np.linalg.solve(R, lin.B.T @ expected)
        assert schedule.gain(t) == pytest.approx(K, abs=1e-6 * np.abs(K).max())
    assert schedule.P[0] == pytest.approx(
        np.linalg.inv(
            (np.eye(12) - 5 * lin.A) @ np.linalg.inv(Qf) @ (np.eye(12) - 5 * lin.A).T
            + S * 5
            - (lin.A @ S + S @ lin.A.T) * 12.5
            + lin.A @ S @ lin.A.T * 125 / 3
        ),
        rel=1e-9,
        abs=1e-11,
    )


@pytest.mark.exhaustive
def test_cost_to_go_is_the_cost_of_the_loop(moving):
    Q, R = weights(moving)
    schedule = fflin.tvlqr(moving, Q, R, 3.0)
    e = np.random.default_rng(0).normal(size=len(Q))

    def rate(t, y):
        A, B = moving.matrices(t)
        u = -schedule.gain(t) @ y[:-1]
        return np.append(A @ y[:-1] + B @ u, y[:-1] @ (Q * y[:-1]) + u @ (R * u))

    y = integrated(rate, schedule.t, np.append(e, 0.0))
    assert y[-1] + 3.0 * y[:-1] @ y[:-1] == pytest.approx(
        e @ schedule.P[0] @ e, rel=1e-10
    )
    assert schedule.residual < 1e-6


def test_it_solves_the_differential_equation(moving):
    Q, R = weights(moving)
    schedule = fflin.tvlqr(moving, Q, R, 1.0)
    nx = len(Q)

    def rate(t, p):
        P = p.reshape(nx, nx)
        A, B = moving.matrices(t)
        return -(A.T @ P + P @ A - P @ B / R @ B.T @ P + np.diag(Q)).ravel()

    expected = integrated(rate, moving.t[::-1], np.eye(nx).ravel()).reshape(nx, nx)
    assert schedule.P[0] == pytest.approx(
        expected, rel=0.0, abs=1e-9 * np.abs(expected).max()
    )


def test_a_step_is_of_order_four():
    rng = np.random.default_rng(5)
    A0, A1, B0, B1 = (
        rng.normal(size=shape) for shape in ((4, 4), (4, 4), (4, 2), (4, 2))
    )
    nodes = 0.5 + np.array([-1.0, 1.0]) * 3.0**0.5 / 6.0

    def at(t):
        t = np.asarray(t)[:, None, None]
        B = (1 - t) * B0 + t * B1
        return np.array(
            ((1 - t) * A0 + t * A1, B @ B.mT, np.tile(np.eye(4), (len(t), 1, 1)))
        )

    def solved(steps):
        P, h = np.eye(4), 1.0 / steps
        for k in range(steps, 0, -1):
            early, late = (at([(k - 1 + c) * h]) for c in nodes)
            P = stepped_back(transitions(early, late, np.array([h]))[:, 0], P)
        return P

    exact = solved(256)
    errors = [np.abs(solved(n) - exact).max() for n in (8, 16, 32)]
    slopes = np.log2(np.divide(errors[:-1], errors[1:]))
    assert slopes == pytest.approx([4.0, 4.0], abs=0.25)


def test_inputs_that_soon_reach_less_are_solved_in_shorter_steps():
    """Over one interval the weight of a node, which is negative, makes S negative at first."""

    def at(t):
        S = np.exp(12.0 * (1.0 - t))[:, None, None]
        return np.array((0.0 * S, S, 0.0 * S + 1e-6))

    times, values = solve_back(at, np.array([0.0, 1.0]), 1e3 * np.eye(1))
    result = solve_ivp(
        lambda t, P: np.exp(12.0 * (1.0 - t)) * P * P - 1e-6,
        (1.0, 0.0),
        [1e3],
        method="LSODA",
        rtol=1e-10,
        atol=1e-14,
    )
    single = transitions(*(at(np.array([c])) for c in GAUSS), np.ones(1))[:, 0]
    assert (
        np.abs(stepped_back(single, 1e3 * np.eye(1)) / result.y[0, -1] - 1.0).max()
        > 0.1
    )
    assert times[0] == 0.0
    assert values[0, 0, 0] == pytest.approx(result.y[0, -1], rel=1e-5)


def test_schedules_are_kept_and_bad_input_is_reported(moving, tmp_path):
    Q, R = weights(moving)
    schedule = fflin.tvlqr(moving, Q, R, {"q_b": 5.0})
    for ending in ("npz", "mat", "json"):
        schedule.save(tmp_path / f"schedule.{ending}")
        back = fflin.GainSchedule.load(tmp_path / f"schedule.{ending}")
        assert (back.P == schedule.P).all() and (back.t == schedule.t).all()
        assert (back.gain(0.1) == schedule.gain(0.1)).all()
    with pytest.raises(fflin.InputError, match=r"9 s.* 0\.4 s"):
        schedule.gain(9.0)
    with pytest.raises(fflin.InputError, match="LinearTraj"):
        fflin.tvlqr(fflin.linearize(moving.robot), 1, 1, 1)
    with pytest.raises(fflin.InputError, match="Qf"):
        fflin.tvlqr(moving, Q, R, -1.0)
    with pytest.raises(fflin.InputError, match=r"\bP\b"):
        fflin.tvlqr(replace(moving, A=moving.A * 1e12), Q, R, 1.0)


@pytest.fixture(scope="module")
def tumbling():
    """A tumbling robot under inputs that change at every knot, and its linear model."""
    robot = fflin.load("planar_detumble")
    rng = np.random.default_rng(3)
    u = rng.normal(size=(8, 9)) * np.r_[np.ones(6), 0.02 * np.ones(3)]
    run = fflin.simulate(
        *(robot, lambda t, q, v: u[min(int(t / 0.25 + 1e-9), 7)]),
        v0=fflin.velocity(robot, {"omega_b.z": 0.3, "omega_b.x": 0.1, "joint_1": 0.4}),
        **{"duration": 2.0, "dt": 0.005, "sample": 0.25, "every": 10, "frame": "local"},
    )
    traj = fflin.linearize_trajectory(robot, run.trajectory(), strict=True)
    assert traj.hold == "previous"
    return robot, traj


@pytest.mark.exhaustive
def test_held_inputs_have_the_cost_that_is_promised_and_no_other_is_less(tumbling):
    robot, traj = tumbling
    Q, R = weights(traj)
    schedule = fflin.tvlqr(traj, Q, R, 3.0, sample=0.1)
    assert (schedule.dt, len(schedule.t), schedule.residual < 1e-12) == (0.1, 21, True)
    linearizer = fflin.Linearizer(robot, moving=True)
    e = np.random.default_rng(0).normal(size=len(Q))

    def cost(gain):
        y = np.append(e, 0.0)
        for k, (start, end) in enumerate(pairwise(schedule.t)):
            u = -gain(k) @ y[:-1]

            def rate(t, y, u=u):
                lin = linearizer(*traj.point(t))
                return np.append(
                    lin.A @ y[:-1] + lin.B @ u, y[:-1] @ (Q * y[:-1]) + u @ (R * u)
                )

            late = end - 1e-13
            cuts = [
                start,
                *traj.t[(traj.t > start + 1e-9) & (traj.t < end - 1e-9)],
                end,
            ]
            y = integrated(lambda t, y, late=late: rate(min(t, late), y), cuts, y)
        return y[-1] + 3.0 * y[:-1] @ y[:-1]

    promised = e @ schedule.P[0] @ e
    assert cost(lambda k: schedule.gain(float(schedule.t[k]))) == pytest.approx(
        promised, rel=1e-7
    )
    rng = np.random.default_rng(1)
    for size in (1e-2, 1e-1):
        other = schedule.K * (1.0 + size * rng.normal(size=schedule.K.shape))
        assert cost(lambda k, other=other: other[k]) > promised
    for k, t in enumerate(schedule.t[:-1]):
        for late in (0.0, 0.03, 0.0999):
            assert (schedule.gain(t + late) == schedule.K[k]).all()
            assert (schedule.cost_to_go(t + late) == schedule.P[k]).all()
        # A clock that is a rounding early is not a sample late.
        assert (schedule.gain(float(t) + 0.1 - 1e-13) == schedule.K[k + 1]).all()
    assert (schedule.gain(2.0) == schedule.K[-2]).all()


@pytest.mark.exhaustive
def test_held_inputs_at_rest_match_the_sampled_regulator():
    robot, traj = resting("ets_vii", 200.0)
    Q, R = weights(traj)
    lin = fflin.linearize(robot, moving=True)
    gain = fflin.lqr(lin.discretize(0.5), *fflin.sampled_cost(lin, 0.5, Q, R))
    schedule = fflin.tvlqr(traj, Q, R, 0.0, sample=0.5)
    assert schedule.gain(0.0) == pytest.approx(
        gain.K, rel=1e-8, abs=1e-9 * gain.K.max()
    )
    steady = fflin.tvlqr(traj, Q, R, "steady", sample=0.5)
    assert np.abs(steady.K - gain.K).max() < 1e-8 * gain.K.max()
    with pytest.raises(fflin.InputError, match=r"0\.3 s.*200 s"):
        fflin.tvlqr(traj, Q, R, 0.0, sample=0.3)


@pytest.mark.exhaustive
def test_a_steady_end_goes_on_as_the_regulator_does(tumbling):
    robot, traj = resting("ets_vii", 5.0)
    Q, R = weights(traj)
    gain = fflin.lqr(fflin.linearize(robot, moving=True), Q, R)
    schedule = fflin.tvlqr(traj, Q, R)
    assert np.abs(schedule.K - gain.K).max() < 1e-8 * gain.K.max()
    # Where the motion does not end steadily: at rest in its last configuration.
    robot, traj = tumbling
    Q, R = weights(traj)
    at_rest = fflin.lqr(fflin.linearize(robot, traj.q[-1], moving=True), Q, R)
    assert fflin.tvlqr(traj, Q, R, "steady").P[-1] == pytest.approx(at_rest.P)
    # No input holds the spring, and the robot does not fall freely.
    sprung = robot.replace(inputs=robot.inputs[:2], stiffness={"joint_1": 5.0})
    base_alone = fflin.linearize_trajectory(
        sprung, traj.t, traj.q, traj.v, traj.u[:, :6]
    )
    with pytest.raises(fflin.EquilibriumError, match="Qf"):
        fflin.tvlqr(base_alone, Q, R[:6])


def test_at_a_steady_end_wheels_spin_on():
    wheel = fflin.ReactionWheel((0, 0, 1), inertia=1e-4)
    robot = fflin.load("cubesat", inputs=[fflin.BaseTorque(), fflin.BaseForce(), wheel])
    v0 = fflin.velocity(robot, {"omega_b.x": 0.1, "omega_b.y": 0.05, "wheel_1": 500.0})
    run = fflin.simulate(robot, v0=v0, duration=1.0, dt=0.01, every=5, frame="local")
    traj = fflin.linearize_trajectory(robot, run.trajectory())
    schedule = fflin.tvlqr(traj, 1.0, 1.0)
    rest = np.r_[np.zeros(6), traj.v[-1, 6]]
    lin = fflin.linearize(robot, traj.q[-1], rest, moving=True)
    assert schedule.P[-1] == pytest.approx(fflin.lqr(lin, 1.0, 1.0).P)
    after = fflin.TrajectoryFeedback(traj, schedule).reference(2.0)
    assert after[1] == pytest.approx(rest)


@pytest.mark.exhaustive
@pytest.mark.filterwarnings("ignore:t, q, v, u are not a motion")
def test_a_steady_end_omits_states_that_inputs_cannot_hold(tumbling):
    robot, traj = tumbling
    robot = robot.replace(inputs=robot.inputs[2:])
    traj = fflin.linearize_trajectory(robot, traj.t, traj.q, traj.v, traj.u[:, 6:])
    Q, R = weights(traj)
    part = fflin.momentum_reduction(fflin.linearize(robot, traj.q[-1], moving=True))
    for sample in (None, 0.1):
        schedule = fflin.tvlqr(traj, Q, R[6:], sample=sample)
        cost, lin = (part.T.T @ np.diag(Q) @ part.T, R[6:]), part
        if sample:
            cost, lin = fflin.sampled_cost(part, sample, *cost), part.discretize(sample)
        held = fflin.lqr(lin, *cost).P
        assert part.T.T @ schedule.P[-1] @ part.T == pytest.approx(held, rel=1e-9)
        # Of what the joints do not hold nothing is asked at the end.
        values = np.linalg.eigvalsh(schedule.P[-1])
        assert (np.abs(values) > 1e-9 * values[-1]).sum() == 6


@pytest.mark.exhaustive
def test_weights_match_lqr(tumbling):
    _, traj = tumbling
    with pytest.raises(fflin.InputError, match="Q and R"):
        fflin.tvlqr(traj, 1.0)
    with pytest.raises(fflin.InputError, match="'stedy'"):
        fflin.tvlqr(traj, 1.0, 1.0, "stedy")
    with pytest.raises(fflin.UnknownNameError, match="'none'"):
        fflin.tvlqr(traj, weights="none")
    with pytest.raises(fflin.UnknownNameError, match="q_x"):
        fflin.tvlqr(traj, {"q_x": 1.0}, 1.0)
    end = fflin.linearize(traj.robot, traj.q[-1], moving=True)
    # Their rule, of a loop that fits into the trajectory, from a tenth of the displacements.
    pace = min(max(15.0 / (traj.t[-1] - traj.t[0]), 0.2), 1.5)
    along, about = fflin.tvlqr(traj), fflin.lqr(end)
    assert says(along.weights, "3 deg")
    assert says(along.weights, f"{pace:.3g} rad/s")
    assert np.diag(along.Q) == pytest.approx(np.diag(about.Q), rel=0.05)
    assert np.diag(along.R) * pace**4 == pytest.approx(
        np.diag(about.R) * 0.2**4, rel=0.05
    )
    long = resting("ets_vii", 100.0)[1]
    assert says(fflin.tvlqr(long).weights, "0.2 rad/s")  # as at a point, no slower
    slow, quick = (fflin.tvlqr(traj, sample=dt).R.max() for dt in (1.0, 0.25))
    assert slow > 10.0 * quick
    assert (fflin.tvlqr(traj, weights="identity").R == np.eye(9)).all()
    named = fflin.tvlqr(
        traj, {"q_b": 2.0, "q_m.joint_*": 3.0}, {"tau_b": 1.0, "*.*": 2.0}, 1.0
    )
    assert named.Q.diagonal().tolist() == [2.0] * 3 + [0.0] * 3 + [3.0] * 3 + [0.0] * 9


def test_a_schedule_keeps_its_trajectory(tumbling, tmp_path):
    robot, traj = tumbling
    schedule = fflin.tvlqr(traj, 1.0, 1.0, 1.0, sample=0.5)
    schedule.save(tmp_path / "schedule.mat")
    again = fflin.GainSchedule.load(tmp_path / "schedule.mat")
    assert (again.gain(0.7) == schedule.gain(0.7)).all()
    motion = again.trajectory(robot)
    assert (motion.q == traj.q).all()
    assert (motion.u == traj.u).all()
    assert (motion.hold, motion.frame, again.dt) == ("previous", "local", 0.5)


@pytest.mark.parametrize("sample", [None, 0.1])
def test_models_between_knots_are_computed_in_batches(moving, monkeypatch, sample):
    calls = []
    for name in ("__call__", "along"):
        whole = getattr(fflin.Linearizer, name)

        def counted(*given, whole=whole, **options):
            calls.append(len(given))
            return whole(*given, **options)

        monkeypatch.setattr(fflin.Linearizer, name, counted)
    Q, R = weights(moving)
    fflin.tvlqr(moving, Q, R, 1.0, sample=sample)
    assert 2 <= len(calls) < len(moving.t)


def test_asking_for_a_gain_solves_nothing(moving, monkeypatch):
    Q, R = weights(moving)
    schedule = fflin.tvlqr(moving, Q, R, 1.0)
    asked = np.linspace(0.0, 0.4, 57)
    expected = [
        np.linalg.solve(np.diag(R), moving.matrices(t)[1].T @ schedule.cost_to_go(t))
        for t in asked
    ]
    schedule.gain(0.0)
    monkeypatch.setattr(np.linalg, "solve", None)
    for t, K in zip(asked, expected, strict=True):
        assert schedule.gain(t) == pytest.approx(K, rel=0.0, abs=1e-7 * np.abs(K).max())
    for odd in (None, "x", np.nan, -1.0, 1j):
        with pytest.raises(fflin.InputError, match=r"\bt\b"):
            schedule.gain(odd)


@pytest.mark.exhaustive
def test_knots_need_not_be_close_for_the_motion_between_them():
    """What a quarter of the knots give is what all give: between them the motion is linearised."""
    robot = fflin.load("planar_detumble")
    t, u = np.linspace(0.0, 1.0, 41), np.zeros((41, 9))
    u[:, 6:] = np.outer(np.sin(np.pi * t) ** 2, (4.0, -2.0, 1.0))
    u = np.array([np.interp(t, t[::4], item) for item in u[::4].T]).T
    run = fflin.simulate(
        *(robot, lambda time, q, v: [np.interp(time, t, item) for item in u.T]),
        v0=fflin.velocity(robot, {"omega_b.y": 0.3, "joint_1": 0.4, "joint_3": -0.5}),
        **{"duration": 1.0, "dt": 0.0125, "every": 2},
    )
    fine = fflin.linearize_trajectory(robot, t, run.q, run.v, u)
    coarse = fflin.linearize_trajectory(robot, t[::4], run.q[::4], run.v[::4], u[::4])
    Q, R = weights(fine)
    all_, few = (fflin.tvlqr(item, Q, R, 1.0) for item in (fine, coarse))
    assert few.P[0] == pytest.approx(
        all_.P[0], rel=0.0, abs=1e-5 * np.abs(all_.P[0]).max()
    )
