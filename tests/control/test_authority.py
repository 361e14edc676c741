"""Mass properties, wheels and thrusters at a point, against closed forms and linear programs."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from scipy.optimize import linprog

import fflin
from fflin.control.authority import least_reach, point_properties, thruster_authority


def thrusters_at(robot, center):
    return str(thruster_authority(robot, robot.neutral(), center))


def wheels_at(robot, q, v):
    return point_properties(robot, q, v).wheel_momentum


def tilted(robot, **joints):
    return fflin.configuration(robot, joints, pin.SE3.Random())


def test_mass_properties_match_the_bodies_in_base_axes():
    robot = fflin.load("servicer_7dof")
    q = tilted(robot, joint_2=0.7, joint_4=-1.1)
    data = robot.create_data()
    pin.forwardKinematics(robot.model, data, q)
    base = data.oMi[1]
    total = pin.Inertia.Zero()
    for place, body in zip(
        data.oMi.tolist()[1:], robot.model.inertias.tolist()[1:], strict=True
    ):
        total += base.actInv(place).act(body)
    center, inertia, *_ = point_properties(robot, q, np.zeros(robot.nv))
    np.testing.assert_allclose(center, total.lever, atol=1e-12)
    np.testing.assert_allclose(inertia, total.inertia, rtol=1e-12, atol=1e-9)


@pytest.mark.exhaustive
@pytest.mark.parametrize("m", [3, 6])
def test_the_least_reach_matches_linear_programs(m):
    rng = np.random.default_rng(m)
    W = rng.normal(size=(m, 3 * m)) * np.logspace(-1, 2, m)[:, None]
    # so that thrusts can cancel one another
    W = np.hstack((W, -W.sum(axis=1, keepdims=True)))
    low, high = np.zeros(W.shape[1]), rng.uniform(0.5, 2.0, W.shape[1])
    kept = np.eye(m)[:, -3:]
    least = least_reach(W, low, high, kept)
    assert least > 0.0

    def reach(direction):
        equal = np.column_stack((W, -kept @ direction))
        bounds = [*zip(low, high, strict=True), (0, None)]
        cost = -np.eye(W.shape[1] + 1)[-1]
        return -linprog(cost, A_eq=equal, b_eq=np.zeros(m), bounds=bounds).fun

    directions = rng.normal(size=(300, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    result = np.array([reach(item) for item in directions])
    assert result.min() >= least * (1.0 - 1e-7)
    # Towards the nearest facet the reach is the least itself.
    nearest = directions[result.argmin()]
    for step in np.logspace(-0.5, -6, 60):
        tried = nearest + step * rng.normal(size=(6, 3))
        for item in tried / np.linalg.norm(tried, axis=1, keepdims=True):
            if (value := reach(item)) < result.min():
                result, nearest = np.array([value]), item
    assert result.min() == pytest.approx(least, rel=1e-3)


def test_a_box_of_thrusters_has_the_force_and_torque_of_its_pairs():
    """Two thrusters along each axis both ways, at a lever of 0.5 m, of 2 N each."""
    nozzles = []
    for axis in range(3):
        lever, along = np.eye(3)[(axis + 1) % 3], np.eye(3)[axis]
        nozzles += [
            fflin.Thruster(
                "base", tuple(side * 0.5 * lever), tuple(way * along), max=2.0
            )
            for side in (1, -1)
            for way in (1, -1)
        ]
    robot = fflin.load("cubesat", inputs=nozzles)
    # A force needs one pair, which gives 4 N; so does a torque, of 2 N m.
    report = thrusters_at(robot, np.zeros(3))
    assert "least 4 N\n  without" in report and "2 N m without" in report
    reports = [
        str(point_properties(robot, q, np.zeros(robot.nv)).thruster_authority)
        for q in (robot.neutral(), tilted(robot))
    ]
    assert reports[0] == reports[1]
    # It is the centre of mass that counts.
    center = np.array([0.2, -0.3, 0.1])
    moved = [
        replace(nozzle, position=tuple(nozzle.position + center)) for nozzle in nozzles
    ]
    moved = robot.replace(inputs=moved)
    assert thrusters_at(moved, center) == report
    assert thrusters_at(moved, np.zeros(3)) != report
    few = robot.replace(inputs=nozzles[:-1])
    message = thrusters_at(few, np.zeros(3))
    assert "cannot produce a force and a torque in every direction" in message
    free = robot.replace(
        inputs=[fflin.Thruster("base", x.position, x.direction) for x in nozzles]
    )
    assert "limit" in thrusters_at(free, np.zeros(3))


def test_wheels_add_up_in_base_axes():
    wheels = [
        fflin.ReactionWheel((1, 0, 0), inertia=0.01, name="a", max_speed=100.0),
        fflin.ReactionWheel((0, 0, 1), "link_1", name="b", momentum=3.0),
    ]
    robot = fflin.load("ets_vii", inputs=[fflin.BaseTorque(), *wheels])
    q, v = tilted(robot, joint_1=0.3), fflin.velocity(robot, {"a": 50.0})
    data = robot.create_data()
    pin.framesForwardKinematics(robot.model, data, q)
    frame = data.oMf[robot.model.getFrameId("link_1")].rotation
    expected = [0.5, 0, 0] + data.oMi[1].rotation.T @ frame @ [0, 0, 3.0]
    result = wheels_at(robot, q, v)
    np.testing.assert_allclose(result.total, expected, atol=1e-12)
    assert result.axes == 2 and result.least is None
    assert "only two" in str(result)
    three = [
        fflin.ReactionWheel(x, inertia=1e-5, max_speed=300.0)
        for x in np.eye(3).tolist()
    ]
    cubesat = fflin.load("cubesat", inputs=three)
    report = str(wheels_at(cubesat, cubesat.neutral(), np.zeros(cubesat.nv)))
    assert "three axes" in report and "least 0.003 N m s" in report
    unlimited = cubesat.replace(inputs=[*three[:2], replace(three[2], max_speed=None)])
    assert wheels_at(unlimited, cubesat.neutral(), np.zeros(cubesat.nv)).least is None


@pytest.mark.parametrize("name", ["cubesat", "planar_detumble", "dual_arm"])
def test_the_report_fits_a_page(name):
    robot = fflin.load(name)
    report = str(point_properties(robot, robot.neutral(), np.zeros(robot.nv)))
    assert max(map(len, report.splitlines())) <= 80 and "wheel" not in report
