"""Flexible appendages and slosh in the compiled engine: the same motion and the same points."""

import numpy as np
import pytest

import fflin
from tests.robot.test_appendages import displaced, full, servicer
from tests.robot.test_modal_forces import array_on_a_drive

pytestmark = pytest.mark.compiled


@pytest.fixture(scope="module")
def robot():
    return full()


def test_both_engines_fly_the_same_motion(robot):
    q, v = displaced(robot, size=0.02)
    motions = [
        fflin.simulate(robot, q0=q, v0=v, duration=50.0, dt=0.05, engine=engine)
        for engine in ("python", "compiled")
    ]
    scale = np.abs(motions[0].x).max(axis=0) + 1e-3
    assert (np.abs(motions[0].x - motions[1].x) / scale).max() < 1e-11


def test_feedback_reads_modal_amplitudes_alike(robot):
    # A pendulum without gravity cannot be stabilised.
    robot = robot.replace(gravity=(0, 0, 0), appendages=robot.appendages[:-1])
    lin = fflin.linearize(robot)
    policy = fflin.StateFeedback(lin, fflin.lqr(lin).K)
    q, v = displaced(robot, size=0.01)
    motions = [
        fflin.simulate(robot, policy, q0=q, v0=v, duration=10.0, dt=0.05, engine=engine)
        for engine in ("python", "compiled")
    ]
    assert (
        np.abs(motions[0].u - motions[1].u).max() < 1e-10 * np.abs(motions[0].u).max()
    )


def test_a_sweep_is_the_models_one_by_one(robot):
    q = np.array([displaced(robot, seed)[0] for seed in range(3)])
    v = np.array([displaced(robot, seed)[1] for seed in range(3)])
    batch = fflin.sweep(robot, q, v=v)
    for index in range(3):
        lin = fflin.linearize(robot, q=q[index], v=v[index])
        assert np.abs(batch.A[index] - lin.A).max() < 1e-12 * np.abs(lin.A).max()
        assert np.abs(batch.B[index] - lin.B).max() < 1e-12 * np.abs(lin.B).max()
        assert batch.joint_positions[index] == pytest.approx(
            lin.x0[6 : 6 + robot.n], rel=1e-13, abs=1e-15
        )


@pytest.fixture(scope="module")
def undamped():
    """Servicer whose joints have springs, with two appendages and a tank, all without damping."""
    # Without springs the arm tumbles, and a rounding error grows to the size of the motion.
    rigid, appendages = servicer()
    inertia = fflin.linearize(rigid).M.diagonal()[6:]
    rigid = rigid.replace(stiffness=dict(zip(rigid.joint_names, inertia, strict=True)))
    tank = fflin.Slosh("base", 30.0, (0.1, 0.0, 0.3), frequency=0.2, name="tank")
    robot = rigid.replace(appendages=[*appendages, tank])
    return robot.replace(damping=dict.fromkeys(robot.joint_names, 0.0))


@pytest.mark.exhaustive
def test_momentum_and_energy_are_kept_over_a_thousand_seconds(undamped):
    q, v = displaced(undamped, size=0.01)
    motions = [
        fflin.simulate(undamped, q0=q, v0=v, duration=1000.0, dt=dt, engine="compiled")
        for dt in (0.02, 0.01)
    ]
    for motion in motions:
        largest = np.abs(motion.momentum).max()
        assert np.abs(motion.momentum - motion.momentum[0]).max() < 1e-13 * largest
    drifts = [np.abs(motion.energy - motion.energy[0]).max() for motion in motions]
    # Of fourth order: halving the step divides the energy's periodic error by 16, its loss by 32.
    assert 16.0 < drifts[0] / drifts[1] < 32.0
    assert drifts[1] < 1e-4 * motions[1].energy[0]


@pytest.mark.exhaustive
def test_both_engines_fly_the_same_thousand_seconds(undamped):
    q, v = displaced(undamped, size=0.01)
    motions = [
        fflin.simulate(undamped, q0=q, v0=v, duration=1000.0, dt=0.05, engine=engine)
        for engine in ("python", "compiled")
    ]
    scale = np.abs(motions[0].x).max(axis=0) + 1e-3
    assert (np.abs(motions[0].x - motions[1].x) / scale).max() < 1e-11


@pytest.mark.parametrize("noise", [1e-13, 1e-9])
def test_both_engines_agree_on_an_array_with_noise_in_place_of_zero(noise):
    # Noise of 1e-9 becomes screws with pitches of about 1e9 m.
    rigid, array = array_on_a_drive(noise)
    noisy = rigid.replace(appendages=[array])
    points = [displaced(noisy, seed, size=0.2) for seed in range(3)]
    q, v = (np.array(values) for values in zip(*points, strict=True))
    batch = fflin.sweep(noisy, q, v=v)
    for index, point in enumerate(points):
        lin = fflin.linearize(noisy, *point)
        assert fflin.check(noisy, lin).ok
        for key in ("A", "B", "f0"):
            expected = getattr(lin, key)
            result = getattr(batch, key)[index]
            assert np.abs(result - expected).max() < 1e-12 * np.abs(expected).max()
    motions = [
        fflin.simulate(noisy, q0=q[0], v0=v[0], duration=20.0, dt=0.05, engine=engine)
        for engine in ("python", "compiled")
    ]
    scale = np.abs(motions[0].x).max(axis=0) + 1e-3
    assert (np.abs(motions[0].x - motions[1].x) / scale).max() < 1e-11
