"""Motions in orbit: closed forms, the Jacobi integral, and what regulators do there."""

import itertools

import numpy as np
import pinocchio as pin
import pytest
from scipy.special import ellipk

import fflin
from tests.support.marks import exhaustive
from tests.support.robots import free_body, random_point

N = 0.05  # [rad/s]: some revolutions take minutes
ORBIT = fflin.CircularOrbit(
    mean_motion=N, body="dwarf", mu=N**2 * 1e18, body_radius=9e5
)


def moving(name, seed=3, speed=0.3):
    """A robot in orbit and a random point of it."""
    robot = fflin.load(name)
    q, v, _ = random_point(
        robot, np.random.default_rng(seed), speed=speed, degrees=40.0
    )
    return robot.replace(orbit=ORBIT), q, v


@pytest.mark.parametrize(
    ("method", "order", "dt"),
    [("cf4", 4, 0.08), ("semi_implicit_euler", 1, 2e-3)],
)
@pytest.mark.parametrize("name", ["cubesat", *exhaustive("ets_vii")])
def test_a_free_motion_keeps_the_jacobi_integral_to_the_order(name, method, order, dt):
    robot, q, v = moving(name)
    drifts = []
    for step in (dt, dt / 2.0):
        motion = fflin.simulate(robot, q0=q, v0=v, duration=4.0, dt=step, method=method)
        drifts.append(motion.momentum_drift.max())
    assert motion.engine == "python" and not len(motion.com_drift)
    assert 1e-12 < drifts[1] < 1e-3
    assert drifts[0] / drifts[1] == pytest.approx(2.0**order, rel=0.25)


def test_the_order_of_the_motion():
    robot, q, v = moving("ets_vii")
    ends = []
    for step in (0.04, 0.02, 0.01):
        motion = fflin.simulate(robot, q0=q, v0=v, duration=2.0, dt=step)
        ends.append(np.append(motion.x[-1], motion.v[-1]))
    first, second = (np.linalg.norm(a - b) for a, b in itertools.pairwise(ends))
    assert first / second == pytest.approx(16.0, rel=0.2)


def test_a_body_flies_as_clohessy_and_wiltshire_say():
    robot = free_body((3.0, 5.0, 4.0)).replace(orbit=ORBIT)
    start, speed = np.array([4.0, -7.0, 2.0]), np.array([0.1, 0.2, -0.3])
    q0 = fflin.configuration(robot, base=pin.SE3(np.eye(3), start))
    v0 = np.concatenate((speed, np.zeros(3)))
    motion = fflin.simulate(robot, q0=q0, v0=v0, duration=200.0, dt=0.2, frame="hill")
    (x, y, z), (dx, dy, dz), t = start, speed, motion.t
    s, c = np.sin(N * t), np.cos(N * t)
    expected = np.column_stack(
        (
            (4 - 3 * c) * x + s * dx / N + 2 * (1 - c) * dy / N,
            6 * (s - N * t) * x
            + y
            - 2 * (1 - c) * dx / N
            + (4 * s - 3 * N * t) * dy / N,
            c * z + s * dz / N,
        )
    )
    assert motion.frame == "hill" and motion.orbit.mean_motion == pytest.approx(N)
    assert np.abs(motion.x[:, 3:6] - expected).max() < 1e-8 * np.abs(expected).max()
    # The same in the other frame: along, minus normal, to the body.
    R = np.array([[0.0, 1, 0], [0, 0, -1], [-1, 0, 0]])
    q0 = fflin.configuration(robot, base=pin.SE3(np.eye(3), R @ start))
    v0 = np.concatenate((R @ speed, np.zeros(3)))
    same = fflin.simulate(robot, q0=q0, v0=v0, duration=200.0, dt=0.2)
    assert same.frame == "lvlh"
    assert (
        np.abs(same.x[:, 3:6] - motion.x[:, 3:6] @ R.T).max()
        < 1e-9 * np.abs(expected).max()
    )


@pytest.mark.parametrize("degrees", [60.0, *exhaustive(20.0, 85.0)])
@pytest.mark.exhaustive
def test_pitch_swings_with_the_period_of_the_elliptic_integral(degrees):
    """theta'' = -(3 n^2 / 2) k sin 2 theta, k = (I_x - I_z)/I_y in lvlh: a pendulum of 2 theta."""
    roll, pitch, yaw = 5.0, 4.5, 2.0
    robot = free_body((roll, pitch, yaw)).replace(orbit=ORBIT)
    rate = N * np.sqrt(3.0 * (roll - yaw) / pitch)
    period = 4.0 * ellipk(np.sin(np.radians(degrees)) ** 2) / rate
    tilted = pin.SE3(pin.rpy.rpyToMatrix(0.0, np.radians(degrees), 0.0), np.zeros(3))
    q0 = fflin.configuration(robot, base=tilted)
    motion = fflin.simulate(robot, q0=q0, duration=2.0 * period, dt=period / 1000.0)
    assert (
        np.abs(motion.q[[500, 1000, 2000], 3:7] - q0[3:7] * [1, -1, 1, 1]).max() > 0.1
    )
    assert np.abs(motion.q[[1000, 2000]] - q0).max() < 1e-7
    assert np.abs(motion.q[500, 3:7] - q0[3:7] * [1, -1, 1, 1]).max() < 1e-7
    assert motion.momentum_drift.max() < 1e-8


def test_work_is_counted():
    robot, q, v = moving("ets_vii")
    robot = robot.replace(damping=0.5, stiffness=2.0)

    def policy(t, q, v):
        return np.sin(t + np.arange(6 + robot.n))

    def push(t, q, v):
        return 0.3 * np.cos(t) * np.ones(robot.nv)

    drifts = []
    for dt in (0.04, 0.02):
        motion = fflin.simulate(
            robot, policy, q0=q, v0=v, duration=2.0, dt=dt, disturbance=push
        )
        drifts.append(motion.momentum_drift.max())
    assert np.ptp(motion.energy) > 0.1
    assert drifts[1] < 1e-6 and drifts[0] / drifts[1] == pytest.approx(16.0, rel=0.4)


def test_files_and_words(tmp_path):
    robot, q, v = moving("cubesat")
    motion = fflin.simulate(robot, q0=q, v0=v, duration=0.2)
    for ending in ("npz", "mat", "json"):
        motion.save(tmp_path / f"motion.{ending}")
        read = fflin.Motion.load(tmp_path / f"motion.{ending}")
        assert read.orbit == motion.orbit and read.frame == "lvlh"
    assert motion.orbit.radius == pytest.approx(1e6)
    assert "Jacobi integral drift" in str(motion) and "Jacobi integral drift" in repr(
        motion
    )
    assert "100 km over dwarf" in str(motion)
    assert fflin.simulate(robot.replace(orbit=None), duration=0.1).orbit is None


@pytest.mark.compiled
def test_the_compiled_loop_agrees_with_the_python_engine():
    robot, q, v = moving("ets_vii")
    robot = robot.replace(damping=0.5, stiffness=2.0)
    options = {"q0": q, "v0": v, "duration": 2.0, "dt": 0.02}
    one, other = (
        fflin.simulate(robot, engine=engine, **options)
        for engine in ("compiled", "python")
    )
    assert (one.engine, other.engine) == ("compiled", "python")
    # Rounding errors of 100 steps, relative to the largest entry.
    for name in ("q", "v", "energy"):
        expected = getattr(other, name)
        size = np.maximum(1.0, np.abs(expected).max())
        assert np.abs(getattr(one, name) - expected).max() < 1e-12 * size
    # Both drifts are errors of the integration, and must be the same, apart from rounding.
    assert one.momentum_drift == pytest.approx(other.momentum_drift, abs=1e-12)
    assert other.momentum_drift.max() > 1e-10


def test_refused():
    robot, q, v = moving("cubesat")
    with pytest.raises(fflin.InputError, match="lvlh or hill"):
        fflin.simulate(robot, q0=q, v0=v, duration=0.1, frame="world")


def test_a_target_in_the_other_frame_is_not_a_target():
    robot = fflin.load("cubesat", orbit=8e5)
    target = fflin.linearize(robot, frame="hill")
    with pytest.raises(fflin.InputError, match=r"'hill'.*'lvlh'"):
        fflin.simulate(robot, target=target, duration=0.1)
    assert (
        fflin.simulate(robot, target=target, duration=0.1, frame="hill").frame == "hill"
    )


def test_the_jacobi_integral_includes_stored_momentum():
    robot, q, v = moving("cubesat")
    robot = robot.replace(inputs=[fflin.ReactionWheel([1.0, 2.0, -1.0], momentum=0.02)])
    motion = fflin.simulate(robot, q0=q, v0=v, duration=4.0, dt=0.02)
    assert motion.engine == "python" and motion.momentum_drift.max() < 1e-8
