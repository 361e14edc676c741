"""Sums over the bodies at many rows, compared with Pinocchio's at each row."""

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.dynamics.integrals import integrals
from tests.support.robots import random_tree


def moved_root():
    model = fflin.load("planar_detumble").model.copy()
    model.jointPlacements[1] = pin.SE3(
        pin.exp3(np.array([0.3, -0.8, 0.5])), np.array([1.0, 2, 3])
    )
    return fflin.from_model(model)


def every_kind():
    """Screws about every axis, a continuous joint, and a joint that is not a screw."""
    offset = pin.JointModelComposite(1)
    offset.addJoint(pin.JointModelRX(), pin.SE3(np.eye(3), np.array([0.1, 0.4, -0.3])))
    axis = np.array([0.48, -0.6, 0.64])
    kinds = [
        pin.JointModelRZ(),
        pin.JointModelRUBY(),
        pin.JointModelPX(),
        pin.JointModelHelicalUnaligned(axis, 0.3),
        offset,
        pin.JointModelPrismaticUnaligned(axis),
        pin.JointModelRevoluteUnaligned(axis),
    ]
    rng = np.random.default_rng(5)
    model = pin.Model()
    model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "free")
    model.appendBodyToJoint(1, pin.Inertia.Random(), pin.SE3.Identity())
    for index, kind in enumerate(kinds):
        place = pin.SE3(pin.exp3(rng.normal(size=3)), rng.normal(size=3))
        parent = 1 if index == 4 else index + 1  # two branches
        joint = model.addJoint(parent, kind, place, f"joint_{index}")
        body = pin.Inertia(2.0, rng.normal(size=3), np.diag([0.3, 0.4, 0.5]))
        model.appendBodyToJoint(joint, body, pin.SE3.Identity())
    model.armature[6:] = rng.uniform(0.1, 1.0, model.nv - 6)
    return fflin.from_model(model)


def with_stored_momentum():
    wheels = [
        fflin.ReactionWheel((0.6, 0.0, 0.8), momentum=3.0),
        fflin.ReactionWheel((0.0, 1.0, 0.0), frame="link_2", momentum=-2.0),
    ]
    return fflin.load("planar_detumble", inputs=wheels)


ROBOTS = {
    "cubesat": lambda: fflin.load("cubesat"),
    "canadarm2": lambda: fflin.load("canadarm2"),
    "tree": lambda: random_tree(np.random.default_rng(2), 9),
    "moved root": moved_root,
    "every kind of joint": every_kind,
    "stored momentum": with_stored_momentum,
}


def rows_of(robot, count, seed=0):
    rng = np.random.default_rng(seed)
    bound = np.ones(robot.nq)
    pin.seed(seed)
    q = np.array(
        [pin.randomConfiguration(robot.model, -bound, bound) for _ in range(count)]
    )
    return q, rng.normal(size=(count, robot.nv))


@pytest.mark.parametrize("name", ROBOTS)
def test_sums_match_pinocchio(name):
    robot = ROBOTS[name]()
    model, data = robot.model, robot.create_data()
    q, v = rows_of(robot, 20)
    result = integrals(robot, q, v)
    # Each sum has at most some hundred terms, whose rounding errors add up to far less than this.
    tolerance = 1e-13
    for i in range(len(q)):
        # `pin.computeKineticEnergy` omits the armature of a composite joint, but its CRBA does not.
        M = np.triu(pin.crba(model, data, q[i]))
        energy = 0.5 * v[i] @ (M + np.triu(M, 1).T) @ v[i]
        pin.ccrba(model, data, q[i], v[i])
        momentum = pin.computeCentroidalMomentum(model, data, q[i], v[i]).vector.copy()
        for joint, stored in robot.stored_momentum:
            momentum[3:] += data.oMi[joint].rotation @ stored
        center = data.com[0]
        polar = 0.5 * np.trace(data.Ig.inertia) + robot.mass * center @ center
        assert result.energy[i] == pytest.approx(energy, rel=tolerance)
        size = np.sqrt(2.0 * energy * robot.mass) * (1.0 + np.sqrt(polar / robot.mass))
        assert np.abs(result.momentum[i] - momentum).max() < tolerance * size
        assert np.abs(result.center[i] - center).max() < tolerance * np.sqrt(
            polar / robot.mass
        )
        assert result.polar[i] == pytest.approx(polar, rel=tolerance)


@pytest.mark.parametrize("name", ["canadarm2", "every kind of joint"])
def test_a_row_does_not_depend_on_the_others(name):
    """So the rows of a run are the same bit for bit, however many of them are recorded."""
    robot = ROBOTS[name]()
    q, v = rows_of(robot, 37)
    whole = integrals(robot, q, v)
    parts = integrals(robot, q[::9], v[::9]), integrals(robot, q[5:6], v[5:6])
    for of_all, some, single in zip(whole, *parts, strict=True):
        assert np.array_equal(of_all[::9], some)
        assert np.array_equal(of_all[5:6], single)


def test_rows_beyond_a_chunk_are_computed_too(monkeypatch):
    robot = fflin.load("canadarm2")
    q, v = rows_of(robot, 11)
    whole = integrals(robot, q, v)
    monkeypatch.setattr("fflin.dynamics.integrals._ROWS", 4)
    for one, other in zip(whole, integrals(robot, q, v), strict=True):
        assert np.array_equal(one, other)


def test_a_planar_robot_keeps_to_its_plane_exactly():
    robot = fflin.load("planar_detumble")
    q = robot.neutral()[None]
    v = fflin.velocity(robot, {"omega_b.z": 0.05})[None]
    momentum = integrals(robot, q, v).momentum[0]
    assert momentum[5] > 0.0
    assert not momentum[[2, 3, 4]].any()
