"""What is computed for a film, against first principles."""

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.robot.robot import ROOT
from fflin.view.motion_page import subtitle
from fflin.view.panel import errors, panel
from fflin.view.playback import play_back, thrusters
from tests.support.robots import random_point, random_pose, random_tree

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
    film = play_back(robot, state, np.zeros(1), q[None], u[None], "tool")
    lin = fflin.linearize(robot, q, np.zeros(robot.nv), u, frame=frame, reference=reference)
    # f0 has the accelerations of the base: d omega/dt and d v/dt in the frame's axes.
    base = pin.XYZQUATToSE3(film.poses[0, 0])
    local = np.concatenate((base.rotation.T @ film.force[0], base.rotation.T @ film.torque[0]))
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
    film = play_back(robot, state, dt * np.arange(count), np.array(qs), u, "tool")
    way = film.com - film.com[0]
    direction = way[-1] / np.linalg.norm(way[-1])
    off = way - np.outer(way @ direction, direction)
    assert np.abs(off).max() < 1e-6 < 1e-3 < np.linalg.norm(way[-1])
    bend = film.tool - film.tool[0]
    bend -= np.outer(bend @ bend[-1], bend[-1]) / (bend[-1] @ bend[-1])
    assert np.abs(bend).max() > 1e-4  # which the tool does not
    pin.framesForwardKinematics(model, data, qs[-1])
    tool = data.oMf[model.getFrameId("tool")].translation
    np.testing.assert_allclose(film.tool[-1], tool, atol=1e-12)
    for index, pose in enumerate(film.poses[-1]):
        assert pin.XYZQUATToSE3(pose).isApprox(data.oMi[ROOT + index], 1e-12)


def test_plumes_stand_where_thrusters_push(robots):
    thruster = fflin.Thruster("tool", (0.1, -0.2, 0.3), (0, 3, 4))
    robot = robots["servicer_7dof"].replace(inputs=[fflin.JointTorque("joint_1"), thruster])
    rng = np.random.default_rng(1)
    q, _, u = random_point(robots["servicer_7dof"], rng)
    ((joint, position, direction),) = thrusters(robot)
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, q)
    tool = data.oMf[robot.model.getFrameId("tool")]
    np.testing.assert_allclose(data.oMi[joint].act(position), tool.act(np.array([0.1, -0.2, 0.3])))
    np.testing.assert_allclose(data.oMi[joint].rotation @ direction, tool.rotation @ [0, 0.6, 0.8])
    state = fflin.StateMap(robot)
    film = play_back(robot, state, np.zeros(1), q[None], u[None, :2], "tool")
    assert film.thrust.tolist() == [[u[1]]]


def test_errors_are_those_of_the_pose(robots):
    rng = np.random.default_rng(2)
    robot = robots["ets_vii"]  # its joints are continuous
    turns = dict(zip(robot.joint_names, (0.3, 3.0, -1.0, 0.0, 1.0, -3.0), strict=True))
    target = fflin.configuration(robot, turns, random_pose(rng, 50.0))
    step = np.concatenate((rng.normal(size=3), np.radians(37.0) * np.array([0.6, 0, 0.8])))
    v = np.concatenate((np.zeros(6), [0.1, 0.7, 0.2, 0, 0, -1.1]))
    q = pin.integrate(robot.model, target, v)
    base = pin.XYZQUATToSE3(target[:7]) * pin.SE3(pin.exp3(step[3:]), step[:3])
    q[:7] = pin.SE3ToXYZQUAT(base)
    found = errors(robot, np.array([target, q]), target)
    np.testing.assert_allclose(found["attitude"], [0, 37.0], atol=1e-6)
    np.testing.assert_allclose(found["position"], [0, np.linalg.norm(step[:3])], atol=1e-12)
    np.testing.assert_allclose(found["turns"], np.degrees([0, 1.1]), atol=1e-7)
    assert not found["slides"].any()


def test_metres_are_not_taken_for_degrees_nor_wheels_for_joints():
    robot = fflin.load("panda")  # its fingers slide
    robot = robot.replace(inputs=[*robot.inputs, fflin.ReactionWheel((0, 0, 1), inertia=1e-3)])
    target = robot.neutral()
    q = fflin.configuration(robot, {"panda_joint2": -0.1, "panda_finger_joint1": 0.03})
    robot.joint("wheel_1").place(q, 2.0)
    found = errors(robot, np.array([q]), target)
    assert found["turns"] == pytest.approx(np.degrees(0.1))
    assert found["slides"] == pytest.approx(0.03)
    state = fflin.StateMap(robot)
    u = np.zeros((1, len(robot.joint_names) + 6))
    u[0, -1] = 3.0
    shown = panel(robot, state, q[None], u, target, np.zeros(1))
    labels = {each["label"]: each["unit"] for each in shown["readouts"]}
    assert labels["largest joint error"] == "°" and labels["largest slide error"] == "m"
    assert [each["title"] for each in shown["plots"]][2:] == ["wheel torques"]
    assert subtitle(robot) == f"{robot.n - 1} joints, 1 wheel, 17.45 kg"


def test_a_free_flyer_alone_has_no_joint_error(robots):
    robot = fflin.load("cubesat").replace(inputs=fflin.load_inputs("cubesat"))
    q = robot.neutral()
    shown = panel(robot, fflin.StateMap(robot), q[None], np.zeros((1, 15)), q, np.zeros(1))
    assert not any("joint" in each["label"] for each in shown["readouts"])
    assert subtitle(robot) == "0 joints, 3 wheels, 3.5 kg"


def test_plots_of_inputs_have_the_units_of_the_model():
    """Sliding joints are pushed, turning ones turned: never on one axis."""
    robot = random_tree(np.random.default_rng(2), 6)
    assert {joint.prismatic for joint in robot.joints} == {True, False}
    state = fflin.StateMap(robot)
    q, u = robot.neutral()[None].repeat(2, axis=0), np.ones((2, 12))
    shown = panel(robot, state, q, u, q[0], np.zeros(2))["plots"]
    expected = {("base torque", "N m"), ("base force", "N")}
    expected |= {("joint torques", "N m"), ("joint forces", "N")}
    assert {(plot["title"], plot["unit"]) for plot in shown[2:]} == expected
    lines = {plot["title"]: len(plot["lines"]) for plot in shown}
    assert lines["joint forces"] == sum(joint.prismatic for joint in robot.joints)
