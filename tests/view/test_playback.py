"""What is computed for a film, against first principles."""

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.robot.joints import ROOT, find_frame
from fflin.view.page import Page
from fflin.view.pages import moved, play_back
from tests.support.robots import random_point, random_pose

FRAMES = ("hybrid", "local", "world")


@pytest.mark.parametrize("frame", FRAMES)
def test_arrows_are_the_wrench_that_acts_on_the_base(robots, frame):
    """Force and torque as drawn, put back on the robot, do what u does: M a = S^T wrench."""
    rng = np.random.default_rng(3)
    robot = robots["servicer_7dof"]
    robot = robot.replace(inputs=[fflin.BaseTorque(), fflin.BaseForce()])
    q, _, _ = random_point(robot, rng)
    reference = random_pose(rng, 40.0)
    u = rng.normal(size=6)
    state = fflin.StateMap(robot, reference=reference, frame=frame)
    film = play_back(state, q[None], u[None])
    lin = fflin.linearize(
        robot, q, np.zeros(robot.nv), u, frame=frame, reference=reference
    )
    # f0 has the accelerations of the base: d omega/dt and d v/dt in the frame's axes.
    base = pin.XYZQUATToSE3(film.poses[0, 0])
    local = np.concatenate(
        (base.rotation.T @ film.force[0], base.rotation.T @ film.torque[0])
    )
    data = robot.model.createData()
    tau = np.zeros(robot.nv)
    tau[:6] = local
    acceleration = pin.aba(robot.model, data, q, np.zeros(robot.nv), tau)
    turn, shift = acceleration[3:6], acceleration[:3]
    if frame == "world":
        turn = reference.rotation.T @ base.rotation @ turn
    if frame != "local":
        shift = reference.rotation.T @ base.rotation @ shift
    rows = state.groups
    np.testing.assert_allclose(lin.f0[rows.omega_b], turn, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(lin.f0[rows.v_b], shift, rtol=1e-9, atol=1e-12)


def test_the_centre_of_mass_moves_straight_when_nothing_pushes(robots):
    """Points of a free motion lie on a line, that of the momentum."""
    robot = robots["ets_vii"]
    rng = np.random.default_rng(0)
    model, data = robot.model, robot.model.createData()
    q, v, _ = random_point(robot, rng, speed=0.3)
    qs, dt = [q], 1e-3
    for _ in range(400):
        a = pin.aba(model, data, q, v, np.zeros(robot.nv))
        middle = v + 0.5 * dt * a
        half = pin.integrate(model, q, 0.5 * dt * v)
        v = v + dt * pin.aba(model, data, half, middle, np.zeros(robot.nv))
        q = pin.integrate(model, q, dt * middle)
        qs.append(q)
    count = len(qs)
    u = np.zeros((count, 6 + robot.n))
    state = fflin.StateMap(robot)
    film = play_back(state, np.array(qs), u)
    way = film.com - film.com[0]
    direction = way[-1] / np.linalg.norm(way[-1])
    off = way - np.outer(way @ direction, direction)
    assert np.abs(off).max() < 1e-6 < 1e-3 < np.linalg.norm(way[-1])
    joint, at = find_frame(model, "tool")
    tools = moved(film.poses[:, joint - ROOT], at.translation)
    bend = tools - tools[0]
    bend -= np.outer(bend @ bend[-1], bend[-1]) / (bend[-1] @ bend[-1])
    assert np.abs(bend).max() > 1e-4  # which the tool does not
    pin.framesForwardKinematics(model, data, qs[-1])
    tool = data.oMf[model.getFrameId("tool")].translation
    np.testing.assert_allclose(tools[-1], tool, atol=1e-12)
    for index, pose in enumerate(film.poses[-1]):
        assert pin.XYZQUATToSE3(pose).isApprox(data.oMi[ROOT + index], 1e-12)


def test_plumes_stand_where_thrusters_push(robots):
    thruster = fflin.Thruster("tool", (0.1, -0.2, 0.3), (0, 3, 4))
    robot = robots["servicer_7dof"].replace(
        inputs=[fflin.JointTorque("joint_1"), thruster]
    )
    rng = np.random.default_rng(1)
    q, _, u = random_point(robots["servicer_7dof"], rng)
    (nozzle,) = Page(robot, q, "space", None, None).nozzles
    name, path, position, direction = (
        nozzle[k] for k in ("name", "path", "position", "direction")
    )
    assert name == fflin.linearize(robot).input_names[1]
    joint = robot.model.getJointId(path[-1])
    position, direction = np.array(position), np.array(direction)
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, q)
    tool = data.oMf[robot.model.getFrameId("tool")]
    np.testing.assert_allclose(
        data.oMi[joint].act(position), tool.act(np.array([0.1, -0.2, 0.3]))
    )
    np.testing.assert_allclose(
        data.oMi[joint].rotation @ direction, tool.rotation @ [0, 0.6, 0.8]
    )
    state = fflin.StateMap(robot)
    film = play_back(state, q[None], u[None, :2])
    assert film.thrust.tolist() == [[u[1]]]
