"""The first integrals of a motion: the momentum, and the line of the centre of mass."""

import dataclasses
import math

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.simulation.report import motion_report
from fflin.simulation.run import Conserved
from tests.simulation.test_simulate import displaced, free_body, regulated, tumbling
from tests.support.marks import exhaustive
from tests.support.robots import random_tree


def centers(robot, motion):
    """The centre of mass (N, 3) in the world."""
    data = robot.create_data()
    return np.array([pin.centerOfMass(robot.model, data, q).copy() for q in motion.q])


def acted_on():
    """A robot on which everything acts, and a policy and disturbance that depend on time."""
    robot = fflin.load("servicer_7dof").replace(
        inputs=[
            fflin.BaseTorque(),
            fflin.BaseForce(),
            fflin.JointTorque("joint_2"),
            fflin.Thruster("tool", (0.1, 0, 0), (0.3, 0.2, 1.0)),
            fflin.ReactionWheel((0, 1, 1), momentum=30.0),
            fflin.ReactionWheel((1, 0, 0), inertia=0.03),
        ],
        gravity=(0.0, 0.1, -0.3),
        stiffness={"panel_left": 50.0},
    )
    u = np.array([5.0, -3, 2, 10, 4, -6, 1.5, 8.0, 0.4, -0.2])
    push = np.zeros(robot.nv)
    push[:6] = 1.0, -2.0, 3.0, 0.5, -0.4, 0.2
    q0, v0 = tumbling(robot)
    return robot, {
        "policy": lambda t, q, v: u * np.cos(t),
        "disturbance": lambda t, q, v: push * np.sin(2.0 * t),
        "q0": q0,
        "v0": v0,
    }


@pytest.mark.parametrize("method", ["cf4", "semi_implicit_euler"])
def test_both_first_integrals_of_a_free_motion_are_kept_to_machine_precision(method):
    robot = random_tree(np.random.default_rng(4), 3, prismatic=False)
    q0, v0 = tumbling(robot, size=1.0)
    v0[:3] += 1.0, -0.5, 0.3
    motion = fflin.simulate(robot, q0=q0, v0=v0, duration=1.0, dt=0.01, method=method)
    size = np.abs(motion.momentum).max()
    np.testing.assert_allclose(
        motion.momentum, np.tile(motion.momentum[:1], (101, 1)), atol=1e-14 * size
    )
    com = centers(robot, motion)
    straight = com[0] + motion.t[:, None] * motion.momentum[0, 3:] / robot.mass
    np.testing.assert_allclose(com, straight, atol=3e-15)
    assert np.linalg.norm(straight[-1] - com[0]) > 0.1
    assert motion.momentum_drift.max() < 1e-14
    assert motion.com_drift.max() < 3e-15


def test_without_projection_the_centre_of_mass_drifts_by_the_reported_error():
    robot = random_tree(np.random.default_rng(4), 3, prismatic=False)
    q0, v0 = tumbling(robot, size=1.0)
    options = {"q0": q0, "v0": v0, "duration": 1.0, "dt": 0.02, "project": False}
    motion = fflin.simulate(robot, **options)
    com = centers(robot, motion)
    straight = com[0] + motion.t[:, None] * motion.momentum[0, 3:] / robot.mass
    apart = np.linalg.norm(com - straight, axis=1)
    np.testing.assert_allclose(motion.com_drift, apart, atol=1e-14)
    assert apart[-1] > 1e-9
    finer = fflin.simulate(robot, **(options | {"dt": 0.01}))
    assert math.log2(apart[-1] / finer.com_drift[-1]) == pytest.approx(4.0, abs=0.3)


@pytest.mark.parametrize("every", [1, 7])
def test_the_centre_of_mass_falls_as_gravity_and_a_constant_force_say(every):
    robot = fflin.load("canadarm2", gravity=(0.2, -0.1, -0.4))
    force = np.array([30.0, -20.0, 10.0])

    def push(t, q, v):
        # Constant in the world, at the base.
        return np.r_[pin.XYZQUATToSE3(q[:7]).rotation.T @ force, np.zeros(robot.nv - 3)]

    q0, v0 = tumbling(robot, size=0.2)
    motion = fflin.simulate(
        robot, q0=q0, v0=v0, duration=1.0, dt=0.02, every=every, disturbance=push
    )
    com, t = centers(robot, motion), motion.t[:, None]
    acceleration = np.array(robot.gravity) + force / robot.mass
    start = motion.momentum[0, 3:] / robot.mass
    np.testing.assert_allclose(
        com, com[0] + t * start + t**2 / 2.0 * acceleration, atol=1e-13
    )
    assert motion.com_drift.max() < 1e-13


@pytest.mark.parametrize(
    ("method", "order"), [("cf4", 4.0), ("semi_implicit_euler", 1.0)]
)
def test_the_line_of_the_centre_of_mass_is_of_the_order_of_the_method(method, order):
    # A force cos(3 t) in the world: r = (1 - cos 3 t) / (9 m).
    robot = free_body((20.0, 30.0, 40.0))

    def push(t, q, v):
        force = np.array([0.0, 50.0 * math.cos(3.0 * t), 0.0])
        return np.r_[pin.XYZQUATToSE3(q[:7]).rotation.T @ force, np.zeros(3)]

    errors = []
    for dt in (0.04, 0.02, 0.01):
        motion = fflin.simulate(
            robot,
            v0=[0, 0, 0, 0.3, 0.2, 0.1],
            duration=2.0,
            dt=dt,
            disturbance=push,
            method=method,
        )
        assert motion.com_drift.max() < 1e-14
        errors.append(abs(motion.q[-1, 1] - (1.0 - math.cos(6.0)) / 9.0))
    assert -np.diff(np.log2(errors))[-1] == pytest.approx(order, abs=0.1)


SAMPLED = {"sample": 0.1, "delay": 0.05}


@pytest.mark.parametrize(
    ("frame", "options"),
    [
        ("hybrid", {}),
        ("local", SAMPLED),
        *exhaustive(
            ("hybrid", SAMPLED), ("local", {}), ("world", {}), ("world", SAMPLED)
        ),
    ],
)
def test_the_line_is_kept_where_everything_acts_and_the_order_too(frame, options):
    robot, acting = acted_on()

    def motion(dt, project=True):
        return fflin.simulate(
            robot,
            **acting,
            **options,
            duration=0.4,
            dt=dt,
            frame=frame,
            reference=pin.SE3(
                pin.exp3(np.array([0.3, -0.2, 0.5])), np.array([1.0, 2.0, 3.0])
            ),
            project=project,
        )

    kept = motion(0.025)
    assert kept.momentum_drift.max() < 1e-13
    assert kept.com_drift.max() < 1e-14
    # An independent reference: the bare method at a step fine enough.
    exact = motion(0.0025, False)

    def error(result):
        apart = pin.difference(robot.model, exact.q[-1], result.q[-1])
        return np.linalg.norm(np.r_[apart, result.v[-1] - exact.v[-1]])

    assert math.log2(error(kept) / error(motion(0.0125))) == pytest.approx(4.0, abs=0.4)
    assert error(kept) < 2.0 * error(motion(0.025, False))


def test_the_root_may_be_placed_and_the_robot_far_away():
    model = fflin.load("canadarm2").model.copy()
    turned = pin.SE3(pin.exp3(np.array([0.4, -0.7, 0.2])), np.array([2.0, -1.0, 0.5]))
    model.jointPlacements[1] = turned
    robot = fflin.from_model(model, gravity=(0.0, 0.0, -0.2))
    q0, v0 = tumbling(robot, size=0.2)
    motion = fflin.simulate(robot, q0=q0, v0=v0, duration=1.0, dt=0.02)
    com, t = centers(robot, motion), motion.t[:, None]
    start = motion.momentum[0, 3:] / robot.mass
    fall = t**2 / 2.0 * np.array(robot.gravity)
    np.testing.assert_allclose(com, com[0] + t * start + fall, atol=1e-13)
    q0[:3] += 7e6, 1e6, -2e6
    assert (
        fflin.simulate(robot, q0=q0, v0=v0, duration=1.0, dt=0.02).com_drift.max()
        < 1e-8
    )


def test_events_and_a_regulator_see_the_robot_on_its_line():
    robot, lin, gain = regulated("ets_vii")
    seen = []

    def fence(t, q, v):
        seen.append(q)
        return 0.305 - t

    policy = fflin.StateFeedback(lin, gain.K)
    motion = fflin.simulate(
        robot, policy, x0=displaced(lin), duration=1.0, events=[fence]
    )
    assert motion.stopped == "fence at t = 0.31 s"
    np.testing.assert_array_equal(motion.q[1:], seen)
    assert motion.com_drift.max() < 1e-14


def test_the_drift_of_a_balanced_spin_is_rounding():
    """About the centre of mass the momenta of base and joints are rounding, which is no scale."""
    model = free_body((10.0, 20.0, 15.0)).model.copy()
    for name, hinge, center in (("left", 0.6, 0.7), ("right", -0.4, -0.9)):
        place = pin.SE3(np.eye(3), np.array([hinge, 0.0, 0.0]))
        panel = model.addJoint(1, pin.JointModelRX(), place, name)
        inertia = pin.Inertia(
            7.0, np.array([center, 0.0, 0.0]), np.diag([1.0, 2.0, 1.5])
        )
        model.appendBodyToJoint(panel, inertia, pin.SE3.Identity())
    motion = fflin.simulate(
        fflin.from_model(model),
        v0=[0, 0, 0, 0.3, 0.2, 0.1, 0, 0],
        duration=5.0,
        dt=0.05,
    )
    assert 0.0 < np.abs(motion.momentum[:, 3:]).max() < 1e-14
    assert motion.momentum_drift.max() < 1e-14


def test_a_motion_at_rest_has_no_drift():
    motion = fflin.simulate(free_body((20.0, 30.0, 40.0)), duration=0.1)
    np.testing.assert_array_equal(motion.momentum_drift, 0.0)


@pytest.mark.parametrize("part", [slice(0, 3), slice(3, 6)])
def test_conservation_errors_are_relative_to_mass_speed_and_extent(part, monkeypatch):
    """Dynamics that hear of a wrench of which the impulse is not told lose all that it gives."""
    robot = fflin.load("canadarm2")
    q0, v0 = tumbling(robot, size=0.1)
    push = np.zeros(robot.nv)
    push[part] = 5.0, -3.0, 2.0
    options = {"q0": q0, "v0": v0, "duration": 1.0, "dt": 0.02, "project": False}
    monkeypatch.setattr(Conserved, "wrench", lambda *_: np.zeros(6))
    motion = fflin.simulate(robot, disturbance=lambda t, q, v: push, **options)
    data = robot.create_data()
    speed, extent, about = [], [], []
    for q, v, p in zip(motion.q, motion.v, motion.momentum, strict=True):
        pin.ccrba(robot.model, data, q, v)
        kinetic = pin.computeKineticEnergy(robot.model, data, q, v)
        speed.append(math.sqrt(2.0 * kinetic / robot.mass))
        c = data.com[0] - q0[:3]
        # The polar moment of inertia is half the trace, of the centre of mass moved by Steiner.
        extent.append(math.sqrt(np.trace(data.Ig.inertia) / 2.0 / robot.mass + c @ c))
        about.append(p[:3] + np.cross(c, p[3:]))
    p, h = motion.momentum[:, 3:], np.array(about)
    momenta = robot.mass * np.array(speed)
    linear = np.linalg.norm(p - p[0], axis=1) / momenta.max()
    angular = np.linalg.norm(h - h[0], axis=1) / (momenta * extent).max()
    np.testing.assert_allclose(
        motion.momentum_drift, np.maximum(linear, angular), atol=1e-13
    )
    assert motion.momentum_drift[-1] > 1e-4


@pytest.mark.parametrize("suffix", [".npz", ".mat", ".json"])
def test_the_drift_is_saved_loaded_and_shown(tmp_path, suffix):
    robot = fflin.load("canadarm2")
    q0, v0 = tumbling(robot)
    motion = fflin.simulate(robot, q0=q0, v0=v0, duration=0.2, project=False)
    path = tmp_path / f"m{suffix}"
    motion.save(path)
    loaded = fflin.Motion.load(path)
    np.testing.assert_array_equal(loaded.com_drift, motion.com_drift)
    shown = f"centre of mass from its predicted path: {motion.com_drift.max():.1e} m"
    assert shown in motion_text(loaded)
    assert f"com drift {motion.com_drift.max():.1e} m" in repr(loaded)


def motion_text(motion):
    return motion_report(motion)


def test_a_motion_without_the_drift_is_saved_and_shown_without_it(tmp_path):
    motion = fflin.simulate(free_body((20.0, 30.0, 40.0)), duration=0.1)
    dataclasses.replace(motion, com_drift=np.zeros(0)).save(tmp_path / "m.mat")
    loaded = fflin.Motion.load(tmp_path / "m.mat")
    assert loaded.com_drift.shape == (0,)
    assert "centre of mass" not in motion_text(loaded)
    np.testing.assert_array_equal(loaded.momentum_drift, motion.momentum_drift)
