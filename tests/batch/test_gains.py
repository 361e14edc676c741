"""Regulators about many points: each is the one that `lqr` makes."""

import numpy as np
import pytest

import fflin
from tests.support.robots import BUNDLED, mostly
from tests.support.sweeps import points


@pytest.mark.parametrize(
    "name", mostly(BUNDLED, "cubesat", "planar_detumble", "ets_vii")
)
def test_every_gain_matches_lqr(name, robots):
    robot = robots[name]
    batch = fflin.sweep(robot, points(robot, 6)[0])
    rng = np.random.default_rng(3)
    nx, nu = 2 * batch.B_lower.shape[1], batch.B_lower.shape[2]
    root = rng.normal(size=(nx, nx))
    for Q, R in (
        (1.0, 1.0),
        (rng.uniform(0.1, 9.0, nx), rng.uniform(0.1, 9.0, nu)),
        # odd powers: left to lqr
        (root @ root.T, np.eye(nu) + 0.1 * np.ones((nu, nu))),
    ):
        gains = fflin.lqr_batch(batch, Q, R)
        assert gains.residual.max() < 1e-8
        for index, lin in enumerate(batch):
            gain = fflin.lqr(lin, Q, R)
            assert gains.K[index] == pytest.approx(
                gain.K, rel=1e-6, abs=1e-7 * np.abs(gain.K).max()
            )
            slowest = -np.linalg.eigvals(lin.A - lin.B @ gains.K[index]).real.max()
            assert gains.margin[index] == pytest.approx(slowest, rel=1e-9)


def test_closed_form_of_a_single_body(robots):
    """Yang 2012: K_q = sqrt(Q/R), K_w = R^-1/2 (Q_w + J R^1/2 Q_q^1/2)^1/2 for a diagonal J."""
    robot = robots["cubesat"]
    batch = fflin.sweep(robot, np.tile(robot.neutral(), (3, 1)))
    gains = fflin.lqr_batch(batch, 5.0, 8.0)
    J = np.linalg.inv(batch.B_lower[0])[:3, :3]
    if np.abs(J - np.diag(J.diagonal())).max() < 1e-12 * J.max():
        # q_b is half the angle.
        expected = np.sqrt((5.0 + J.diagonal() * np.sqrt(8.0 * 5.0)) / 8.0)
        assert gains.K[2][:3, 6:9].diagonal() == pytest.approx(expected, rel=1e-9)
    assert gains.K[1][:3, :3].diagonal() == pytest.approx(
        np.full(3, np.sqrt(5 / 8)), rel=1e-9
    )


def test_many_inputs_and_few(robots):
    robot = robots["ets_vii"]
    thruster = fflin.Thruster("base", (0.5, 0.0, 0.1), (0.0, 1.0, 0.0))
    q = points(robot, 4)[0]
    for inputs in ([*robot.inputs, thruster], [fflin.BaseTorque()]):
        batch = fflin.sweep(robot.replace(inputs=inputs), q)
        if len(inputs) == 1:
            with pytest.raises(fflin.StabilizabilityError, match="point 0"):
                fflin.lqr_batch(batch, 1.0, 1.0)
        else:
            gains = fflin.lqr_batch(batch, 1.0, 1.0)
            for index, lin in enumerate(batch):
                K = fflin.lqr(lin, 1.0, 1.0).K
                assert gains.K[index] == pytest.approx(K, rel=1e-8, abs=1e-9)


def test_at_rest_none_is_left_to_the_solver_of_one(robots, monkeypatch):
    """All poles of the servicer, light joints beside a heavy base, and weights apart by 1e8."""
    monkeypatch.setattr("fflin.batch.gains.regulator", None)
    for name in BUNDLED:
        batch = fflin.sweep(robots[name], points(robots[name], 8)[0])
        for R in (1.0, 1e4, 1e-4):
            assert fflin.lqr_batch(batch, 1.0, R).residual.max() < 1e-11


@pytest.mark.compiled
def test_gains_between_the_points(robots, tmp_path):
    robot = robots["ets_vii"]
    values = np.linspace(-1.0, 1.0, 9)
    batch = fflin.sweep(
        robot, fflin.grid(robot, {"joint_2": values, "joint_4": values[::4]})
    )
    gains = fflin.lqr_batch(batch, 1.0, 1.0)
    assert list(gains.grid) == ["joint_2", "joint_4"]
    assert gains.gain(batch.joint_positions[10]) == pytest.approx(
        gains.K[10], rel=1e-12
    )
    # Of second order between the points, held beyond them.
    joints = batch.joint_positions[10].copy()
    joints[1] += 0.125
    exact = fflin.lqr(
        fflin.linearize(
            robot,
            fflin.configuration(
                robot, dict(zip(robot.joint_names, joints, strict=True))
            ),
        ),
        1.0,
        1.0,
    ).K
    error = np.abs(gains.gain(joints) - exact).max() / np.abs(exact).max()
    assert error < 0.05 * np.abs(gains.K[13] - gains.K[10]).max() / np.abs(exact).max()
    beyond = joints.copy()
    beyond[1] = 7.0
    joints[1] = 1.0
    assert np.array_equal(gains.gain(beyond), gains.gain(joints))
    shuffled = fflin.lqr_batch(
        batch[np.random.default_rng(1).permutation(len(batch))], 1.0, 1.0
    )
    assert shuffled.gain(joints) == pytest.approx(
        gains.gain(joints), rel=1e-9, abs=1e-12
    )
    for wrong in (joints[:2], np.full(6, np.nan), {"joint_2": 0.0}):
        with pytest.raises(fflin.InputError, match="joints"):
            gains.gain(wrong)
    gains.save(tmp_path / "g.npz")
    assert np.array_equal(
        fflin.GainBatch.load(tmp_path / "g.npz").gain(joints), gains.gain(joints)
    )
    scattered = fflin.lqr_batch(batch[[0, 4, 5]], 1.0, 1.0)
    with pytest.raises(fflin.InputError, match="grid"):
        scattered.gain(joints)
    with pytest.raises(fflin.InputError, match="same"):
        fflin.lqr_batch(batch[:1], 1.0, 1.0).gain(joints)


@pytest.mark.compiled
def test_a_scheduled_feedback_brings_the_robot_to_the_target(robots):
    robot = robots["ets_vii"]
    values = np.linspace(-1.2, 1.2, 7)
    batch = fflin.sweep(
        robot, fflin.grid(robot, {"joint_2": values, "joint_4": values})
    )
    # Of the order of the accelerations, so that all poles are of the order of 1/s.
    gains = fflin.lqr_batch(batch, 1.0, 10.0 * batch.B_lower[24].diagonal() ** 2)
    target = fflin.linearize(robot, fflin.configuration(robot, {"joint_2": 0.3}))
    start = fflin.configuration(robot, {"joint_2": -0.6, "joint_4": 0.8})
    policy = fflin.ScheduledFeedback(target, gains)
    motion = fflin.simulate(robot, policy, q0=start, duration=40.0, dt=0.01)
    assert fflin.StateMap(robot).to_state(motion.q[-1], motion.v[-1])[
        6:12
    ] == pytest.approx(target.x0[6:12], abs=1e-3)
    with pytest.raises(fflin.InputError, match="frame"):
        fflin.ScheduledFeedback(fflin.linearize(robot, frame="world"), gains)
    with pytest.raises(fflin.InputError, match="GainBatch"):
        fflin.ScheduledFeedback(target, fflin.lqr(target, 1.0, 1.0))
    with pytest.raises(fflin.InputError):
        policy.bind(fflin.load("cubesat"))
