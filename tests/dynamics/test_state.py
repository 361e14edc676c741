"""The state map: laws of the conversion, and its behaviour where the chart ends."""

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.dynamics.coordinates import Chart
from tests.support.robots import BUNDLED, FRAMES, random_point, random_pose, random_tree


def random_state(state, rng, degrees):
    """A state whose base is turned by the given angle."""
    x = rng.normal(size=state.nx)
    axis = rng.normal(size=3)
    x[:3] = np.sin(np.deg2rad(degrees) / 2) * axis / np.linalg.norm(axis)
    return x


@pytest.mark.parametrize("degrees", [0.0, 1e-7, 30.0, 160.0, 179.9])
@pytest.mark.parametrize("frame", FRAMES)
@pytest.mark.parametrize("name", BUNDLED)
def test_round_trip_is_the_identity(robots, name, frame, degrees):
    rng = np.random.default_rng(1)
    for reference in (None, random_pose(rng, 100.0)):
        state = fflin.StateMap(robots[name], frame=frame, reference=reference)
        x = random_state(state, rng, degrees)
        x[state.groups.q_m] *= 3.0  # beyond pi
        q, v = state.to_pinocchio(x)
        # A continuous joint is an angle without turns: `near` says which turn is meant.
        assert np.abs(state.to_state(q, v, near=x) - x).max() < 1e-14 * max(
            1, np.abs(x).max()
        )
        turns = (state.to_state(q, v) - x) / (2 * np.pi)
        assert np.abs(turns - np.round(turns)).max() < 1e-14 * max(1, np.abs(x).max())


def test_roll_pitch_and_yaw_are_degrees_about_fixed_axes():
    robot = fflin.load("planar_detumble")
    angles = np.array([30.0, -20.0, 70.0])
    roll, pitch, yaw = np.diag(np.deg2rad(angles))
    rotation = pin.exp3(yaw) @ pin.exp3(pitch) @ pin.exp3(roll)
    base = pin.SE3(rotation, np.zeros(3))
    joints = {"joint_1": 0.4}
    q = fflin.configuration(robot, joints, rpy=angles)
    # Unit quaternions: a few roundings of one.
    assert np.abs(q - fflin.configuration(robot, joints, base)).max() < 1e-15
    with pytest.raises(fflin.InputError, match="base and rpy"):
        fflin.configuration(robot, base=base, rpy=angles)
    with pytest.raises(fflin.InputError, match="rpy has shape"):
        fflin.configuration(robot, rpy=(30.0, 0.0))


def test_default_reference_gives_the_inertial_attitude_and_position():
    robot = fflin.load("cubesat")
    pose = random_pose(np.random.default_rng(2), 70.0)
    x = fflin.StateMap(robot).to_state(
        fflin.configuration(robot, base=pose), np.zeros(6)
    )
    quaternion = pin.Quaternion(pose.rotation).coeffs()
    assert x[:3] == pytest.approx(quaternion[:3] * np.sign(quaternion[3]), abs=1e-15)
    assert x[3:6] == pytest.approx(pose.translation, abs=1e-15)


def test_reference_is_divided_out():
    robot = fflin.load("cubesat")
    rng = np.random.default_rng(3)
    reference, pose = random_pose(rng, 120.0), random_pose(rng, 140.0)
    q = fflin.configuration(robot, base=pose)
    x = fflin.StateMap(robot, reference=reference).to_state(q, np.zeros(6))
    relative = reference.actInv(pose)
    quaternion = pin.Quaternion(relative.rotation).coeffs()
    assert x[:3] == pytest.approx(quaternion[:3] * np.sign(quaternion[3]), abs=1e-14)
    assert x[3:6] == pytest.approx(relative.translation, abs=1e-14)


def test_root_joint_placed_in_the_world_is_part_of_the_pose():
    model = fflin.load("cubesat").model.copy()
    rng = np.random.default_rng(4)
    model.jointPlacements[1] = random_pose(rng, 50.0)
    robot = fflin.from_model(model)
    pose = random_pose(rng, 80.0)
    q = fflin.configuration(robot, base=pose)
    data = robot.model.createData()
    pin.forwardKinematics(robot.model, data, q)
    assert data.oMi[1].isApprox(pose, 1e-14)
    x = fflin.StateMap(robot).to_state(q, np.zeros(6))
    assert x[3:6] == pytest.approx(pose.translation, abs=1e-14)
    lin = fflin.linearize(robot, q)
    assert lin.reference.isApprox(pose, 1e-14)
    assert fflin.check(robot, lin).ok


@pytest.mark.parametrize("frame", FRAMES)
def test_velocity_frames_agree_with_their_definitions(frame):
    robot = fflin.load("astrobee_arm")
    rng = np.random.default_rng(5)
    reference = random_pose(rng, 60.0)
    q, v, _ = random_point(robot, rng, degrees=130.0)
    state = fflin.StateMap(robot, frame=frame, reference=reference)
    x = state.to_state(q, v)
    data = robot.model.createData()
    pin.forwardKinematics(robot.model, data, q, v)
    world = pin.getVelocity(
        robot.model, data, 1, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
    )
    in_reference = {
        "omega_b": reference.rotation.T @ world.angular,
        "v_b": reference.rotation.T @ world.linear,
    }
    in_base = {"omega_b": v[3:6], "v_b": v[:3]}
    expected = {
        "hybrid": (in_base["omega_b"], in_reference["v_b"]),
        "local": (in_base["omega_b"], in_base["v_b"]),
        "world": (in_reference["omega_b"], in_reference["v_b"]),
    }[frame]
    assert x[state.groups.omega_b] == pytest.approx(expected[0], abs=1e-14)
    assert x[state.groups.v_b] == pytest.approx(expected[1], abs=1e-14)


def test_names_and_units_follow_pinocchios_joint_order():
    model = pin.Model()
    model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "free")
    model.addJoint(1, pin.JointModelPX(), pin.SE3.Identity(), "slide")
    model.addJoint(2, pin.JointModelRUBZ(), pin.SE3.Identity(), "spin")
    for index in (1, 2, 3):
        model.appendBodyToJoint(index, pin.Inertia.Random(), pin.SE3.Identity())
    robot = fflin.from_model(model)
    state = fflin.StateMap(robot)
    assert state.nx == 16
    assert state.names[6:8] == ("q_m.slide", "q_m.spin")
    assert state.names[:1] + state.names[8:9] == ("q_b.x", "omega_b.x")
    assert state.units[3:14] == (
        *("m", "m", "m", "m", "rad", "rad/s", "rad/s", "rad/s"),
        *("m/s", "m/s", "m/s"),
    )
    assert state.units[14:] == ("m/s", "rad/s")
    lin = fflin.linearize(robot)
    assert lin.input_units[3:] == ("N", "N", "N", "N", "N m")


def test_a_rotation_of_exactly_pi_is_refused_with_the_reason():
    robot = fflin.load("cubesat")
    q = np.array([0, 0, 0, 1.0, 0, 0, 0])
    state = fflin.StateMap(robot)
    with pytest.raises(fflin.ChartError, match="180 deg"):
        state.to_state(q, np.zeros(6))
    for length in (1.0, 1.5):
        with pytest.raises(fflin.ChartError, match="less than 1"):
            state.to_pinocchio(np.array([length, *np.zeros(11)]))
    # The default reference of a model is the base's own pose, so pi from the world is no trouble.
    assert fflin.check(robot, fflin.linearize(robot, q)).ok
    with pytest.raises(fflin.ChartError):
        fflin.linearize(robot, q, reference=pin.SE3.Identity())
    with pytest.raises(fflin.ChartError):
        fflin.simulate(robot, target=fflin.linearize(robot, q), duration=1.0)


def test_sign_of_the_quaternion_does_not_matter():
    robot = fflin.load("cubesat")
    q, v, _ = random_point(robot, np.random.default_rng(6), degrees=100.0)
    flipped = q.copy()
    flipped[3:7] *= -1.0
    state = fflin.StateMap(robot)
    assert (state.to_state(q, v) == state.to_state(flipped, v)).all()


@pytest.mark.parametrize("degrees", [1e-7, 40.0, 160.0, 179.0])
def test_chart_matrices(degrees):
    """Q^T Q = E - q q^T, det Q = q0 (the source has it inverted), J = 2 Q^-1."""
    rng = np.random.default_rng(7)
    robot = fflin.load("cubesat")
    chart = fflin.StateMap(robot).chart(
        fflin.configuration(robot, base=random_pose(rng, degrees))
    )
    assert isinstance(chart, Chart)
    E = np.eye(3)
    Q = 2.0 * chart.N
    assert Q.T @ Q == pytest.approx(E - np.outer(chart.q_b, chart.q_b), abs=1e-15)
    assert np.linalg.det(Q) == pytest.approx(chart.q0, rel=1e-12)
    assert Q @ chart.J == pytest.approx(2 * E, abs=1e-12)


@pytest.mark.parametrize("frame", FRAMES)
def test_state_rate_is_along_the_motion(frame):
    """d q_b/dt = Q omega / 2 and d r_b/dt = v_b, against a motion of the robot."""
    rng = np.random.default_rng(8)
    robot = fflin.load("dual_arm")
    reference = random_pose(rng, 60.0)
    q, v, _ = random_point(robot, rng, degrees=30.0)
    state = fflin.StateMap(robot, frame=frame, reference=reference)
    h = 1e-5
    ahead = state.to_state(pin.integrate(robot.model, q, h * v), v)
    behind = state.to_state(pin.integrate(robot.model, q, -h * v), v)
    rate = (ahead - behind)[: 6 + robot.n] / (2 * h)
    lin = fflin.linearize(robot, q, v, frame=frame, reference=reference)
    # Central differences: h^2/6 times the third derivative, which is of order 1.
    assert rate == pytest.approx(lin.f0[: 6 + robot.n], abs=1e-9)


def test_random_trees_round_trip():
    rng = np.random.default_rng(9)
    for n in (1, 4, 9):
        robot = random_tree(rng, n)
        q, v, _ = random_point(robot, rng)
        state = fflin.StateMap(robot)
        q_again, v_again = state.to_pinocchio(state.to_state(q, v))
        if q_again[3:7] @ q[3:7] < 0:
            q_again[3:7] *= -1
        assert q_again == pytest.approx(q, abs=1e-14)
        assert v_again == pytest.approx(v, abs=1e-14)


def test_repr_names_the_robot():
    shown = repr(fflin.StateMap(fflin.load("cubesat"), frame="world"))
    assert shown == "StateMap('cubesat', nx=12, frame='world')"


def test_invalid_arguments_are_named_in_the_error():
    robot = fflin.load("ets_vii")
    state = fflin.StateMap(robot)
    q = fflin.configuration(robot)
    with pytest.raises(fflin.InputError, match="'body'"):
        fflin.StateMap(robot, frame="body")
    with pytest.raises(fflin.InputError, match=r"pin\.SE3"):
        fflin.StateMap(robot, reference=np.eye(4))
    with pytest.raises(fflin.InputError, match=r"\(3,\)"):
        state.to_pinocchio(np.zeros(3))
    with pytest.raises(fflin.InputError, match=r"\(13,\)"):
        state.to_state(q, np.zeros(13))
    bad = q.copy()
    bad[2] = np.nan
    with pytest.raises(fflin.InputError, match=r"q\[2\]"):
        state.to_state(bad, np.zeros(12))
    bad = q.copy()
    bad[3:7] *= 1.1
    with pytest.raises(fflin.InputError, match=r"q\[3:7\].*1\.1"):
        state.to_state(bad, np.zeros(12))
    bad = q.copy()
    bad[7:9] = 0.5
    with pytest.raises(fflin.InputError, match=r"'joint_1'.*q\[7:9\]"):
        state.to_state(bad, np.zeros(12))
