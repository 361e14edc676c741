"""What moves no mass at any configuration is found by geometry, whatever rounding makes of M."""

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.robot.mass_properties import idle_coordinates
from tests.support.messages import says
from tests.support.robots import random_tree

JOINTS = {
    "x": pin.JointModelPX,
    "y": pin.JointModelPY,
    "z": pin.JointModelPZ,
    "roll": pin.JointModelRX,
    "pitch": pin.JointModelRY,
    "yaw": pin.JointModelRZ,
}


def chain(names, *, placed, rng):
    """A free flyer without mass that carries, over these joints, all there is: an arm."""
    pin.seed(int(rng.integers(2**31)))
    model = pin.Model()
    parent = model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "root")
    for name in names:
        where = pin.SE3.Random() if placed else pin.SE3.Identity()
        parent = model.addJoint(parent, JOINTS[name](), where, name)
    for name in ("shoulder", "elbow"):
        model.appendBodyToJoint(parent, pin.Inertia.Random(), pin.SE3.Random())
        parent = model.addJoint(parent, pin.JointModelRX(), pin.SE3.Random(), name)
    model.appendBodyToJoint(parent, pin.Inertia.Random(), pin.SE3.Random())
    return fflin.from_model(model)


def test_a_massless_base_with_joints_is_refused_at_every_configuration():
    rng = np.random.default_rng(4)
    for trial in range(60):
        names = list(JOINTS)[: 1 + trial % 6]
        robot = chain(names, placed=bool(trial % 2), rng=rng)
        low = -np.ones(robot.nq)
        q = pin.randomConfiguration(robot.model, low, -low)
        for made in (robot, robot.replace(damping=0.1)):
            with pytest.raises(fflin.SingularInertiaError, match=r"base, joint .*lock"):
                fflin.linearize(made, q)
        with pytest.raises(fflin.SingularInertiaError, match="configuration"):
            fflin.simulate(robot, q0=q, duration=0.1)
        assert idle_coordinates(robot)[0] == "the base"
        assert not {"joint 'shoulder'", "joint 'elbow'"} & set(idle_coordinates(robot))


def test_a_massless_base_that_two_arms_determine_is_accepted():
    rng = np.random.default_rng(5)
    model = pin.Model()
    root = model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "root")
    pin.seed(int(rng.integers(2**31)))
    for side in ("left", "right"):
        arm = model.addJoint(root, pin.JointModelRX(), pin.SE3.Random(), side)
        model.appendBodyToJoint(arm, pin.Inertia.Random(), pin.SE3.Random())
    robot = fflin.from_model(model)
    assert idle_coordinates(robot) == ()
    assert fflin.check(robot, fflin.linearize(robot)).ok


def test_light_and_point_like_bodies_count():
    robot = random_tree(np.random.default_rng(6), 5)
    model = robot.model.copy()
    for index in (2, 4):
        model.inertias[index] = pin.Inertia(
            1e-9, np.array([0.1, 0.2, 0.3]), np.zeros((3, 3))
        )
    assert idle_coordinates(fflin.from_model(model)) == ()


def test_an_armature_counts_as_mass():
    model = pin.Model()
    model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "free")
    model.appendBodyToJoint(1, pin.Inertia.Random(), pin.SE3.Identity())
    model.addJoint(1, pin.JointModelRZ(), pin.SE3.Random(), "ghost")
    assert idle_coordinates(fflin.from_model(model)) == ("joint 'ghost'",)
    model.armature[-1:] = 1e-6
    assert idle_coordinates(fflin.from_model(model)) == ()


def test_a_mass_on_an_axis_is_named_where_it_stands_so_alone():
    model = pin.Model()
    root = model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "free")
    model.appendBodyToJoint(1, pin.Inertia.Random(), pin.SE3.Identity())
    turn = model.addJoint(root, pin.JointModelRZ(), pin.SE3.Identity(), "turn")
    slide = model.addJoint(turn, pin.JointModelPX(), pin.SE3.Identity(), "slide")
    model.appendBodyToJoint(
        slide, pin.Inertia(1.0, np.zeros(3), np.zeros((3, 3))), pin.SE3.Identity()
    )
    robot = fflin.from_model(model)
    assert idle_coordinates(robot) == ()
    with pytest.raises(fflin.SingularInertiaError, match="'turn'"):
        fflin.linearize(robot)
    fflin.linearize(robot, fflin.configuration(robot, {"slide": 0.3}))


BODY = (
    '<inertial><mass value="2"/>'
    '<inertia ixx="0.3" ixy="0" ixz="0" iyy="0.4" iyz="0" izz="0.5"/></inertial>'
)


def joint(name, kind, parent, child):
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        '<origin xyz="0.3 0.1 0"/><axis xyz="0 0 1"/></joint>'
    )


def test_a_file_with_a_massless_root_on_a_joint_says_so_and_loads_with_it_locked(
    tmp_path,
):
    path = tmp_path / "craft.urdf"
    path.write_text(
        '<robot name="craft"><link name="world"/>'
        f'<link name="hull">{BODY}</link><link name="arm">{BODY}</link>'
        f"{joint('mount', 'continuous', 'world', 'hull')}"
        f"{joint('shoulder', 'continuous', 'hull', 'arm')}</robot>"
    )
    robot = fflin.load(path)
    assert says(robot.notes[-1], "base, joint 'mount'")
    with pytest.raises(fflin.SingularInertiaError, match="'mount'"):
        fflin.linearize(robot)
    locked = fflin.load(path, lock=["mount"])
    assert not locked.notes
    assert fflin.check(locked, fflin.linearize(locked)).ok


def test_a_root_with_an_inertia_and_no_mass_is_not_a_world_to_be_dropped(tmp_path):
    path = tmp_path / "craft.urdf"
    spinning = BODY.replace('mass value="2"', 'mass value="0"')
    path.write_text(
        f'<robot name="craft"><link name="root">{spinning}</link><link name="hull">{BODY}</link>'
        f"{joint('free', 'floating', 'root', 'hull')}</robot>"
    )
    with pytest.raises(fflin.ModelError, match="'free'"):
        fflin.load(path)
