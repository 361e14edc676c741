"""Simulations in elliptic orbits: balance of energy, Kepler's orbits, and laws that repeat."""

import shutil

import numpy as np
import pinocchio as pin
import pytest

import fflin
from tests.support.orbits import N, in_ellipse
from tests.support.robots import free_body

BODY = (3.0, 5.0, 4.0)


@pytest.mark.parametrize("frame", ["lvlh", "hill"])
def test_the_jacobi_integral_changes_by_the_power_of_the_field(frame):
    robot = in_ellipse(fflin.load("cubesat"), 0.3, anomaly=0.7)
    rng = np.random.default_rng(0)
    place = pin.SE3(pin.exp3(0.4 * rng.normal(size=3)), rng.normal(size=3))
    start = {
        "q0": fflin.configuration(robot, base=place),
        "v0": 0.1 * rng.normal(size=6),
    }
    coarse, fine = (
        fflin.simulate(robot, **start, duration=8.0, dt=dt, frame=frame)
        for dt in (0.2, 0.1)
    )
    assert np.ptp(fine.energy) > 0.1
    assert fine.momentum_drift.max() < 1e-6
    # The method has order 4: half the step has a sixteenth of the error.
    assert fine.momentum_drift.max() < coarse.momentum_drift.max() / 8.0


def test_stored_momentum_is_part_of_the_balance():
    wheel = fflin.ReactionWheel((0, 1, 0), "base", momentum=0.05)
    robot = in_ellipse(fflin.load("cubesat", inputs=[wheel]), 0.3)
    q0 = fflin.configuration(robot, rpy=(20, 10, 5))
    motion = fflin.simulate(robot, q0=q0, duration=8.0, dt=0.05)
    # A step of 0.1 s has a drift of 6e-5.
    assert motion.momentum_drift.max() < 5e-6


@pytest.mark.exhaustive
def test_a_body_returns_after_a_period_with_the_drift_of_its_orbit():
    robot = in_ellipse(free_body(BODY), 0.3)
    period = robot.orbit.period
    along = fflin.linearize_orbit(robot, steps=40)
    total = np.eye(12)
    for factor in along._monodromy_factors():
        total = factor @ total
    q0 = robot.neutral()
    q0[0] = 1e-3
    motion = fflin.simulate(
        robot,
        lambda t, q, v: along.point(t)[2],
        q0=q0,
        duration=period,
        dt=period / 400,
    )
    # The relative motion of the translation is linear.
    expected = total[3:6, 3] * 1e-3
    assert np.allclose(motion.q[-1, :3], expected, rtol=0.0, atol=1e-9)


def test_inertial_disturbances_turn_with_the_true_anomaly():
    force = {"F_b": {"constant": (1.0, 0.0, 0.0), "axes": "inertial"}}
    robot = in_ellipse(free_body(BODY), 0.4).replace(disturbance=force)
    from fflin.dynamics.disturbance import BaseDisturbance
    from fflin.dynamics.state import StateMap

    state = StateMap(robot, frame="hill")
    acting = BaseDisturbance(robot, state.field)
    for t in (0.0, 3.0, 11.0):
        angle = robot.orbit.at(t).angle
        wrench = acting.wrench(t, robot.neutral())
        expected = (np.cos(angle), -np.sin(angle), 0.0)
        assert np.allclose(wrench[:3], expected, rtol=0.0, atol=1e-13)


STRONG = {"tau_b": 0.05, "F_b": 5e-4}


@pytest.mark.exhaustive
def test_a_periodic_schedule_repeats():
    robot = in_ellipse(free_body(BODY), 0.3)
    along = fflin.linearize_orbit(robot, steps=16)
    h = along.period / 16
    schedule = fflin.tvlqr(along, 1.0, STRONG, "periodic", sample=h)
    q0 = fflin.configuration(robot, rpy=(5, -3, 4))
    motion = fflin.simulate(
        robot, schedule, q0=q0, duration=2.5 * along.period, dt=h / 4
    )
    angle = motion.attitude_error
    # Held commands miss the change of the torque within a sample. The rest repeats, because the
    # initial error of 7 deg is multiplied by at most the largest multiplier in each period.
    assert angle[-1] < 0.3
    left = 7.2 * schedule.loop_multipliers[0]
    assert np.abs(angle[64:96] - angle[128:160]).max() < left < 1e-4
    assert str(robot.orbit)[:20] in str(motion)
    with pytest.raises(fflin.InputError, match="another orbit"):
        fflin.simulate(in_ellipse(free_body(BODY), 0.2), schedule, duration=1.0)
    policy = fflin.TrajectoryFeedback(schedule.trajectory(robot), schedule)
    with pytest.raises(fflin.InputError, match="use the same orbit"):
        fflin.simulate(free_body(BODY), policy, duration=1.0)


@pytest.mark.exhaustive
def test_a_continuous_periodic_schedule_holds_the_motion():
    robot = in_ellipse(free_body(BODY), 0.3)
    along = fflin.linearize_orbit(robot, steps=40)
    schedule = fflin.tvlqr(along, 1.0, STRONG, "periodic")
    q0 = fflin.configuration(robot, rpy=(5, -3, 4))
    motion = fflin.simulate(
        robot, schedule, q0=q0, duration=1.5 * along.period, dt=along.period / 200
    )
    assert motion.attitude_error[-1] < 1e-3


@pytest.mark.exhaustive
def test_output_feedback_repeats():
    sensors = [fflin.BasePose(), fflin.Gyroscope("base")]
    robot = in_ellipse(free_body(BODY), 0.3).replace(outputs=sensors)
    along = fflin.linearize_orbit(robot, steps=40)
    h = along.period / 40
    schedule = fflin.tvlqr(along, 1.0, STRONG, "periodic", sample=h)
    filtered = fflin.tvkalman(along, 1e-3, 1e-4, P0="periodic", sample=h)
    policy = fflin.TrajectoryOutputFeedback(along, schedule, filtered)
    q0 = fflin.configuration(robot, rpy=(5, -3, 4))
    motion = fflin.simulate(robot, policy, q0=q0, duration=2.5 * along.period, dt=h / 4)
    angle = motion.attitude_error
    assert angle[-1] < 0.1
    assert np.allclose(angle[160:240], angle[320:400], rtol=0.0, atol=1e-2)


@pytest.mark.exhaustive
@pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")
def test_c_code_of_a_periodic_schedule_repeats(tmp_path):
    robot = in_ellipse(free_body(BODY), 0.3)
    along = fflin.linearize_orbit(robot, steps=8)
    h = along.period / 16
    schedule = fflin.tvlqr(along, 1.0, STRONG, "periodic", sample=h)
    folder = fflin.write_c(schedule, tmp_path, robot=robot)
    assert "the rows repeat after 16 samples" in (tmp_path / "controller.h").read_text()
    law = fflin.CLaw(folder)
    start = {"q0": fflin.configuration(robot, rpy=(5, -3, 4)), "dt": h / 2}
    duration = 2.25 * along.period
    inertial = fflin.simulate(robot, schedule, duration=duration, **start)
    in_c = fflin.simulate(robot, law, duration=duration, **start)
    assert np.allclose(in_c.q, inertial.q, rtol=0.0, atol=1e-9)
    measured = robot.replace(outputs=[fflin.BasePose()])
    along = fflin.linearize_orbit(measured, steps=8)
    policy = fflin.TrajectoryOutputFeedback(
        along,
        fflin.tvlqr(along, 1.0, STRONG, "periodic", sample=h),
        fflin.tvkalman(along, 1e-3, 1e-4, P0="periodic", sample=h),
    )
    with pytest.raises(fflin.InputError, match="C code of output feedback"):
        fflin.write_c(policy, tmp_path, robot=measured)


@pytest.mark.exhaustive
def test_campaigns_run_in_python():
    robot = in_ellipse(free_body(BODY), 0.3)
    along = fflin.linearize_orbit(robot, steps=16)
    h = along.period / 16
    schedule = fflin.tvlqr(along, 1.0, STRONG, "periodic", sample=h)
    found = fflin.monte_carlo(
        robot, schedule, {"q_b": 0.02}, runs=2, duration=18 * h, dt=h / 2
    )
    assert found.engine == "python"
    assert "2 completed; none stopped early" in str(found)


def test_a_file_keeps_the_orbit_of_a_motion(tmp_path):
    robot = in_ellipse(free_body(BODY), 0.3)
    motion = fflin.simulate(robot, duration=0.5, dt=0.1)
    assert motion.orbit == robot.orbit
    motion.save(tmp_path / "motion.npz")
    assert fflin.Motion.load(tmp_path / "motion.npz").orbit == robot.orbit
    page = fflin.visualize(robot, motion, html=tmp_path / "motion.html", open=False)
    assert "elliptic orbit" in page.read_text()
    assert N == 0.3
