"""Regulators along a flight in free fall: in falling axes, a robot moves as without gravity."""

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.base.rotation import skew

GRAVITY = np.array((0.0, 0.0, -9.81))

# Two thrusters along the x axis of the base, which cannot hold the robot against gravity.
INPUTS = [
    fflin.BaseTorque(max=2.0),
    fflin.Thruster("base", (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), max=5.0),
    fflin.Thruster("base", (0.0, 0.0, 0.0), (-1.0, 0.0, 0.0), max=5.0),
    fflin.JointTorque("*", max=2.0),
]
MOTORS = [fflin.JointTorque("*", max=2.0)]
STATE = [fflin.FullState()]


def flights(inputs, duration=0.4, outputs=STATE):
    """A free fall, the same motion in falling axes without gravity, and the axes' velocities."""
    robot = fflin.load("astrobee_arm", inputs=inputs, outputs=outputs)
    q0 = fflin.configuration(robot, dict.fromkeys(robot.joint_names, 0.4))
    v0 = np.full(robot.nv, 0.3)
    data = robot.create_data()
    pin.centerOfMass(robot.model, data, q0, v0)
    v0[:3] -= data.vcom[0]  # the centre of mass rests in falling axes
    motion = fflin.simulate(robot, q0=q0, v0=v0, duration=duration, dt=0.005, every=4)
    t = motion.t - motion.t[0]
    velocity = np.array((1.5, -0.7, 3.0))
    fall = velocity + t[:, None] * GRAVITY
    q, v = motion.q.copy(), motion.v.copy()
    q[:, :3] += t[:, None] * velocity + 0.5 * t[:, None] ** 2 * GRAVITY
    rotations = [pin.XYZQUATToSE3(row[:7]).rotation for row in motion.q]
    local = np.array([R.T @ row for R, row in zip(rotations, fall, strict=True)])
    v[:, :3] += local
    falling = robot.replace(gravity=GRAVITY)
    u = np.zeros((len(t), motion.u.shape[1]))
    along = fflin.linearize_trajectory(falling, t, q, v, u, strict=True)
    floating = fflin.linearize_trajectory(robot, t, motion.q, motion.v, u, strict=True)
    return along, floating, local


def to_floating(default):
    """Map from the errors of the fall to the errors in falling axes: dv' = dv - 2 V x e."""
    nx = 12 + 2 * 2
    T = np.tile(np.eye(nx), (len(default), 1, 1))
    T[:, 11:14, :3] = -2.0 * skew(default)
    return T


@pytest.mark.parametrize(
    "sample", [pytest.param(None, marks=pytest.mark.exhaustive), 0.04]
)
@pytest.mark.parametrize("inputs", [INPUTS, MOTORS], ids=["thrusters", "motors"])
def test_gains_in_free_fall_are_the_gains_without_gravity(inputs, sample):
    along, floating, local = flights(inputs)
    schedule, expected = (
        fflin.tvlqr(item, sample=sample) for item in (along, floating)
    )
    assert schedule.weights == expected.weights
    T = to_floating(local)
    for k, t in enumerate(along.t[:-1:2]):
        K = expected.gain(t) @ T[2 * k]
        # Both schedules interpolate P within 1e-7.
        assert schedule.gain(t) == pytest.approx(K, abs=1e-5 * np.abs(K).max())
    P = T[-1].T @ expected.P[-1] @ T[-1]
    assert schedule.P[-1] == pytest.approx(P, abs=1e-8 * np.abs(P).max())


def test_tracking_in_free_fall_returns_the_joints_and_attitude():
    along, _, _ = flights(MOTORS, duration=1.0)
    schedule = fflin.tvlqr(along, sample=0.05)
    policy = fflin.TrajectoryFeedback(along, schedule)
    q0, v0 = policy.beside({"q_m.arm_proximal": 0.02, "q_m.arm_distal": -0.02})
    motion = fflin.simulate(along.robot, policy, q0=q0, v0=v0, duration=1.0, dt=0.01)
    e = motion.x[-1, 6:8] - along[-1].q[7:9]
    assert np.abs(e).max() < 0.004


def test_a_prediction_past_the_end_of_the_fall_agrees_with_the_schedule():
    """The cost beyond the end is the terminal cost of the schedule, so both find one optimum."""
    along, _, _ = flights(INPUTS)
    policy = fflin.mpc(along, dt=0.04, horizon=4, limits=None)
    nx, nu = along.B.shape[1:]
    e = np.linspace(-1e-3, 1e-3, nx)
    for k in (6, 8, 9):  # the last two of ten samples predict past the end
        m = policy.matrices(e, 0.04 * k)
        d = np.linalg.solve(m.H, -m.g)[:nu]
        K = policy.schedule.K[k]
        assert d == pytest.approx(-K @ e, abs=1e-6 * np.abs(K @ e).max())


def test_a_filter_starts_in_free_fall():
    """The covariance in errors of the fall is the one in falling axes, mapped back."""
    # These outputs are the same in falling axes.
    outputs = [fflin.BasePose(), fflin.JointPositions()]
    along, floating, local = flights(MOTORS, outputs=outputs)
    noise = {
        "q_b": 0.0,
        "r_b": 0.0,
        "q_m": 0.0,
        "omega_b": 1e-4,
        "v_b": 1e-4,
        "qdot_m": 1e-4,
    }
    filtered, expected = (
        fflin.tvkalman(item, noise, 1e-6, sample=0.04) for item in (along, floating)
    )
    back = np.linalg.inv(to_floating(local)[0])
    P = back @ expected.P[0] @ back.T
    assert filtered.P[0] == pytest.approx(P, abs=1e-7 * np.abs(P).max())


def test_a_robot_that_neither_rests_nor_falls_names_the_missing_argument():
    robot = fflin.load("astrobee_arm", inputs=INPUTS, gravity=GRAVITY)
    u = fflin.effort(robot, {"thruster_1": 2.0})
    motion = fflin.simulate(robot, lambda t, q, v: u, duration=0.2, dt=0.01)
    along = fflin.linearize_trajectory(robot, motion.trajectory())
    with pytest.raises(fflin.EquilibriumError, match="give Q, R and Qf"):
        fflin.tvlqr(along)
