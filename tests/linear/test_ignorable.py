"""Relative equilibria: what may move while the linear model stays as it is."""

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.base.rotation import skew
from tests.support.robots import FRAMES, random_pose

WHEEL = np.diag([0.05, 0.05, 0.09])
HOME = ("r_b.x", "r_b.y", "r_b.z")


def wheeled(inertia=WHEEL, lever=(0.0, 0.0, 0.2), joint=None, tip=False, **fields):
    """A lopsided hub, a wheel about the z axis of a tilted mount, and an arm of one joint."""
    rng = np.random.default_rng(1)
    model = pin.Model()
    model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "free")
    hub = pin.Inertia(20.0, np.array([0.1, -0.2, 0.05]), np.diag([2.0, 3.0, 4.0]))
    model.appendBodyToJoint(1, hub, pin.SE3.Identity())
    mount = random_pose(rng, 50.0)
    wheel = model.addJoint(1, joint or pin.JointModelRUBZ(), mount, "wheel")
    body = pin.Inertia(1.5, np.array(lever), np.array(inertia))
    model.appendBodyToJoint(wheel, body, pin.SE3.Identity())
    if tip:
        on = model.addJoint(wheel, pin.JointModelRX(), random_pose(rng, 20.0), "tip")
        model.appendBodyToJoint(
            on, pin.Inertia(0.1, np.ones(3), 0.01 * np.eye(3)), mount
        )
    arm = model.addJoint(1, pin.JointModelRX(), random_pose(rng, 30.0), "arm")
    link = pin.Inertia(2.0, np.array([0.0, 0.3, 0.1]), 0.1 * np.eye(3))
    model.appendBodyToJoint(arm, link, pin.SE3.Identity())
    for name, index in (("hub", 1), ("rim", wheel), ("link", arm)):
        place = pin.SE3(np.eye(3), np.array([0.3, 0.0, 0.0]))
        model.addFrame(pin.Frame(name, index, 0, place, pin.FrameType.OP_FRAME))
    return fflin.from_model(model, **fields)


def at_angle(robot, angle, base=None):
    return fflin.configuration(robot, {"wheel": angle, "arm": 0.7}, base)


def differs(one, other):
    """Largest difference of A and B, relative."""
    return max(
        np.abs(getattr(one, key) - getattr(other, key)).max()
        / np.abs(getattr(one, key)).max()
        for key in "AB"
    )


@pytest.mark.parametrize("frame", FRAMES)
def test_a_spinning_wheel_is_a_relative_equilibrium(frame):
    robot = wheeled(stiffness={"arm": 4.0}, rest={"arm": 0.7}, damping=0.3)
    q, v = at_angle(robot, 0.2), fflin.velocity(robot, {"wheel": 50.0, "v_b.y": 3.0})
    u = fflin.equilibrium(robot, q, v=v).u
    # The motor makes up for the drag, and nothing else is needed.
    assert dict(zip(fflin.linearize(robot).input_names, u, strict=True))[
        "tau_m.wheel"
    ] == pytest.approx(15.0, rel=1e-12)
    assert np.count_nonzero(np.abs(u) > 1e-9) == 1
    lin = fflin.linearize(robot, q, v, u, frame=frame)
    assert lin.ignorable == (*HOME, "q_m.wheel")
    assert lin.is_equilibrium(1e-9) and np.abs(lin.f0).max() == pytest.approx(50.0)
    # it slows down
    assert not fflin.linearize(robot, q, v, frame=frame).is_equilibrium()
    later = fflin.linearize(robot, at_angle(robot, 1.9), v, u, frame=frame)
    assert differs(lin, later) < 1e-12
    # The gyroscopic block: M omega' = -omega x h, with the arm and the wheel's angle free.
    h = lin.M[:3, 6 + robot.joint_names.index("wheel")] * 50.0
    free = fflin.linearize(robot, q, fflin.velocity(robot, {"v_b.y": 3.0}), frame=frame)
    assert (lin.M @ gyro(lin) - free.M @ gyro(free))[:3] == pytest.approx(
        skew(h), abs=1e-9
    )


def gyro(lin):
    """Slopes of the accelerations over omega_b."""
    first = len(lin.M)
    return lin.A[first:, first : first + 3]


@pytest.mark.parametrize(
    "changes",
    [
        {"inertia": np.diag([0.05, 0.06, 0.09])},
        {"inertia": WHEEL + 0.001 * np.array([[0, 0, 1], [0, 0, 0], [1, 0, 0]])},
        {"lever": (1e-3, 0.0, 0.2)},
        {"stiffness": {"wheel": 1.0}},
        {"inputs": [fflin.BaseTorque(), fflin.Thruster("rim", (0, 0, 0), (0, 1, 0))]},
        {"outputs": [fflin.FramePose("rim")]},
        {"joint": pin.JointModelPZ()},
        {"joint": pin.JointModelHZ(0.1)},
        {"joint": pin.JointModelRX()},
    ],
    ids=lambda changes: next(iter(changes)),
)
def test_a_joint_that_is_not_a_rotor_is_not_treated_as_one(changes):
    robot = wheeled(**changes)
    assert fflin.linearize(robot).ignorable == HOME
    v = fflin.velocity(robot, {"wheel": 2.0})
    assert not fflin.linearize(robot, None, v).is_equilibrium()
    assert not fflin.linearize(robot, None, v, moving=True).is_equilibrium()


def test_rotors_of_other_kinds():
    assert fflin.linearize(wheeled(joint=pin.JointModelRZ())).ignorable == (
        *HOME,
        "q_m.wheel",
    )
    tilted = np.array([0.6, 0.0, 0.8])
    turned = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), tilted).matrix()
    robot = wheeled(
        joint=pin.JointModelRevoluteUnaligned(tilted),
        inertia=turned @ WHEEL @ turned.T,
        lever=0.2 * tilted,
        outputs=[fflin.FramePose("link")],
        inputs=[
            fflin.Thruster("link", (0, 0, 0), (0, 1, 0)),
            fflin.JointTorque("wheel"),
        ],
    )
    assert fflin.linearize(robot).ignorable == (*HOME, "q_m.wheel")
    # What it carries turns with it.
    assert fflin.linearize(wheeled(tip=True)).ignorable == HOME


MIMIC = """<robot name="r"><link name="base"><inertial><mass value="9"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
{joints}</robot>"""
JOINT = """<link name="l{k}"><inertial><mass value="1"/>
<inertia ixx="0.1" iyy="0.1" izz="0.2" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="j{k}" type="revolute"><parent link="base"/><child link="l{k}"/>
<origin xyz="{k} 0 0"/><axis xyz="0 0 1"/>
<limit lower="-3" upper="3" effort="1" velocity="1"/>{mimic}</joint>"""


def test_a_leader_turns_its_followers(tmp_path):
    for mimic, names in (
        ('<mimic joint="j1"/>', HOME),
        ("", (*HOME, "q_m.j1", "q_m.j2")),
    ):
        joints = JOINT.format(k=1, mimic="") + JOINT.format(k=2, mimic=mimic)
        (tmp_path / "r.urdf").write_text(MIMIC.format(joints=joints))
        robot = fflin.load(tmp_path / "r.urdf")
        assert fflin.linearize(robot).ignorable == names


def test_a_translating_base_is_unchanged_and_a_rotating_base_is_not():
    robot = wheeled()
    q = at_angle(robot, 0.0)
    drifting = fflin.velocity(robot, {"v_b.x": 2.0, "v_b.z": -1.0})
    turning = fflin.velocity(robot, {"omega_b.z": 0.1})
    swinging = fflin.velocity(robot, {"arm": 0.1})
    for moving in (False, True):
        lin = fflin.linearize(robot, q, drifting, moving=moving)
        assert lin.is_equilibrium()
        later = fflin.linearize(
            robot, pin.integrate(robot.model, q, drifting), drifting, moving=moving
        )
        assert differs(lin, later) < 1e-12
        for v in (turning, swinging):
            assert not fflin.linearize(robot, q, v, moving=moving).is_equilibrium()
    # Sampled, it is the same.
    assert fflin.linearize(robot, q, drifting).discretize(0.1).is_equilibrium()
    assert not fflin.linearize(robot, q, swinging).discretize(0.1).is_equilibrium()


def test_a_tumbling_base_is_one_only_in_its_own_axes():
    robot = fflin.load("cubesat")
    com = robot.model.inertias[1].lever
    body = robot.model.inertias[1]
    axes = np.linalg.eigh(body.inertia)[1]
    for axis, steady in ((axes[:, 0], True), (axes[:, 0] + axes[:, 2], False)):
        w = 0.4 * axis
        v = np.concatenate((-np.cross(w, com), w))  # about the centre of mass
        q = fflin.configuration(
            robot, None, random_pose(np.random.default_rng(2), 40.0)
        )
        lin = fflin.linearize(robot, q, v, moving=True)
        assert lin.is_equilibrium() == steady and not lin.f0.any()
        assert lin.ignorable == ("q_b.x", "q_b.y", "q_b.z", *HOME)
        # Wherever the motion takes it, the error dynamics are the same, or they are not.
        a = pin.aba(robot.model, robot.create_data(), q, v, np.zeros(6))
        h = 0.5
        ahead = fflin.linearize(
            robot, pin.integrate(robot.model, q, h * v), v + h * a, moving=True
        )
        assert (differs(lin, ahead) < 1e-12) == steady
        static = fflin.linearize(robot, q, v)
        assert not static.is_equilibrium() and static.ignorable == HOME


def test_gravity_lets_a_base_turn_about_the_vertical_only():
    up = np.array([0.0, 0.0, 1.0])
    robot = fflin.load("cubesat", gravity=-9.81 * up)
    v = fflin.velocity(robot, {"omega_b.z": 0.3, "v_b.z": 1.0})
    u = fflin.equilibrium(robot, v=v).u
    lin = fflin.linearize(robot, None, v, u, moving=True)
    assert lin.ignorable == HOME and lin.is_equilibrium()
    tilted = fflin.configuration(
        robot, None, random_pose(np.random.default_rng(3), 40.0)
    )
    free = fflin.linearize(robot, tilted, v, moving=True)
    # Whatever balances its velocities, gravity turns against it.
    u = free.M @ -free.drift[6:]
    held = fflin.linearize(robot, tilted, v, u, moving=True)
    assert np.abs(held.drift[6:]).max() < 1e-12 and not held.is_equilibrium()
    later = pin.integrate(robot.model, tilted, v)
    assert differs(held, fflin.linearize(robot, later, v, u, moving=True)) > 1e-3


@pytest.mark.parametrize("ending", [".npz", ".mat", ".json"])
@pytest.mark.parametrize("moving", [False, True])
def test_files_keep_the_ignorable_states(ending, moving, tmp_path):
    robot = wheeled()
    spinning = fflin.velocity(robot, {"wheel": 5.0})
    swinging = fflin.velocity(robot, {"arm": 5.0})
    for v, steady in ((spinning, True), (swinging, False)):
        lin = fflin.linearize(robot, None, v, moving=moving)
        lin.save(tmp_path / f"m{ending}")
        loaded = fflin.LinearModel.load(tmp_path / f"m{ending}")
        assert loaded.ignorable == lin.ignorable
        assert loaded.is_equilibrium() == lin.is_equilibrium() == steady
        if moving:
            assert (loaded.drift == lin.drift).all()
        else:
            assert loaded.drift is None


@pytest.mark.parametrize("reverse", [False, True])
def test_a_rotor_that_is_looked_from_or_at_is_not_ignorable(reverse):
    robot = wheeled()
    frames = ["rim", "hub"][:: -1 if reverse else 1]
    model = robot.model.copy()
    for name, joint in (("rim", model.getJointId("wheel")), ("hub", 1)):
        model.addFrame(
            pin.Frame(name, joint, pin.SE3.Identity(), pin.FrameType.OP_FRAME)
        )
    robot = fflin.from_model(model)
    assert "q_m.wheel" in fflin.linearize(robot).ignorable
    seen = robot.replace(outputs=[fflin.RelativePose(*frames)])
    assert "q_m.wheel" not in fflin.linearize(seen).ignorable
