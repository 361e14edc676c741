"""Robots and points that several test files share."""

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.robot.catalog import bundled_directory

BUNDLED = tuple(sorted(path.stem for path in bundled_directory().glob("*.urdf")))
FRAMES = ("hybrid", "local", "world")
WING_MODES = {"translation": [[0], [0], [2.2]], "damping": 0.005}


def mostly(names, *quick):
    """Return test parameters for names, of which all but the quick ones are exhaustive."""
    assert set(quick) <= set(names)
    marks = pytest.mark.exhaustive
    return [
        name if name in quick else pytest.param(name, marks=marks) for name in names
    ]


def random_pose(rng, degrees):
    """A placement turned by the given angle about a random axis."""
    axis = rng.normal(size=3)
    rotation = pin.exp3(np.deg2rad(degrees) * axis / np.linalg.norm(axis))
    return pin.SE3(rotation, rng.normal(size=3))


def random_point(robot, rng, *, degrees=None, speed=1.0):
    """A random (q, v, u); the base turned by up to `degrees` from the identity."""
    angle = rng.uniform(0.0, 160.0) if degrees is None else degrees
    joints = {joint.name: rng.uniform(-2.5, 2.5) for joint in robot.joints}
    q = fflin.configuration(robot, joints, random_pose(rng, angle))
    # Inputs that accelerate what they act on alone by about 1.
    inertia = np.abs(fflin.linearize(robot, q).M.diagonal())
    v = fflin.StateMap(robot).spread(speed * rng.normal(size=6 + robot.n))
    return q, v, speed * inertia * rng.normal(size=6 + robot.n)


def random_tree(rng, n, *, prismatic=True):
    """A robot of n joints on a random tree, of every joint type that has one degree of freedom."""
    pin.seed(int(rng.integers(2**31)))  # of SE3.Random and Inertia.Random
    model = pin.Model()
    model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "free")
    model.appendBodyToJoint(1, pin.Inertia.Random(), pin.SE3.Random())
    axes = rng.normal(size=(n, 3))
    kinds = [
        pin.JointModelRX,
        pin.JointModelRZ,
        pin.JointModelRUBY,
        lambda: pin.JointModelRevoluteUnaligned(axes[0] / np.linalg.norm(axes[0])),
        lambda: pin.JointModelHX(0.1),
    ]
    if prismatic:
        kinds += [pin.JointModelPX, pin.JointModelPZ]
    # Depth first: a new joint hangs on the last one or on one of its ancestors.
    branch = [1]
    for index in range(n):
        del branch[rng.integers(1, len(branch) + 1) :]
        joint = kinds[index % len(kinds)]()
        branch.append(
            model.addJoint(branch[-1], joint, pin.SE3.Random(), f"joint_{index}")
        )
        model.appendBodyToJoint(branch[-1], pin.Inertia.Random(), pin.SE3.Random())
    return fflin.from_model(model, name=f"tree_{n}")


def free_body(inertia, name="body"):
    """A body that floats free, as a robot without joints."""
    model = pin.Model()
    root = model.addJoint(
        0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "root_joint"
    )
    model.addJointFrame(root)
    body = pin.Inertia(50.0, np.zeros(3), np.diag(inertia))
    model.appendBodyToJoint(root, body, pin.SE3.Identity())
    model.addBodyFrame("base", root, pin.SE3.Identity(), -1)
    return fflin.from_model(model, name=name)


def panels(damping):
    """Return a hub with two equal panels on springs, whose hinges h1 and h2 have no motors."""
    hub = pin.Inertia(100.0, np.zeros(3), np.diag((20.0, 25.0, 30.0)))
    model = pin.Model()
    model.name = "panels"
    base = model.addJoint(
        0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "root_joint"
    )
    model.addJointFrame(base)
    model.appendBodyToJoint(base, hub, pin.SE3.Identity())
    model.addBodyFrame("base", base, pin.SE3.Identity(), -1)
    for name, side in (("h1", 1.0), ("h2", -1.0)):
        place = pin.SE3(np.eye(3), np.array((0.0, 0.5 * side, 0.0)))
        joint = model.addJoint(base, pin.JointModelRX(), place, name)
        panel = pin.Inertia(
            4.0, np.array((0.0, 0.8 * side, 0.0)), np.diag((0.5, 0.1, 0.5))
        )
        model.appendBodyToJoint(joint, panel, pin.SE3.Identity())
    robot = fflin.from_model(model)
    return robot.replace(inputs=[fflin.BaseTorque()], stiffness=30.0, damping=damping)


def singular_at(value):
    """A robot whose M is singular where its last joint is at a value: a point mass on its axis."""
    model = pin.Model()
    model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "free")
    model.appendBodyToJoint(
        1, pin.Inertia(5.0, np.zeros(3), np.eye(3)), pin.SE3.Identity()
    )
    joint = model.addJoint(1, pin.JointModelRZ(), pin.SE3.Identity(), "turn")
    slide = model.addJoint(joint, pin.JointModelPX(), pin.SE3.Identity(), "slide")
    model.appendBodyToJoint(
        slide,
        pin.Inertia(1.0, np.array([-value, 0.0, 0.0]), np.zeros((3, 3))),
        pin.SE3.Identity(),
    )
    return fflin.from_model(model, name="singular")


# A gripper to be filled in: LINKS, types of its joints a and b, parent of b, what a mimics.
MIMIC = """<robot name="gripper">
  <link name="base"><inertial><mass value="3"/>
    <inertia ixx="1" ixy="0" ixz="0" iyy="1.1" iyz="0" izz="1.2"/></inertial></link>
  {links}
  <joint name="a" type="{a}"><parent link="base"/><child link="la"/><origin xyz="0 .1 0"/>
    <axis xyz="0 1 0"/><limit lower="-9" upper="9" effort="1" velocity="1"/>{mimic}</joint>
  <joint name="b" type="{b}"><parent link="{parent}"/><child link="lb"/>
    <origin xyz=".2 -.1 .3" rpy=".3 .2 .1"/><axis xyz="0 0 1"/>
    <limit lower="-9" upper="9" effort="1" velocity="1"/></joint>
</robot>"""
LINKS = "".join(
    f"""<link name="{name}"><inertial><origin xyz=".1 .2 .05"/><mass value="{mass}"/>
    <inertia ixx=".1" ixy="0" ixz="0" iyy=".1" iyz="0" izz=".1"/></inertial></link>"""
    for name, mass in (("la", 1.5), ("lb", 0.7))
)


def winged_satellite(tmp_path, frequency=0.35, modes=WING_MODES):
    """Return a satellite of 180 kg with two wings and four wheels; rigid with frequency=None."""
    urdf = tmp_path / "satellite.urdf"
    urdf.write_text(
        '<robot name="satellite"><link name="base"><inertial><mass value="180"/>'
        '<inertia ixx="60" iyy="35" izz="70" ixy="0" ixz="0" iyz="0"/>'
        "</inertial></link></robot>"
    )
    wings = []
    if frequency is not None:
        wings = [
            fflin.FlexibleAppendage(
                "base",
                frequency=[frequency],
                rotation=[[sign * 3.5], [0], [0]],
                name=name,
                **modes,
            )
            for name, sign in (("left", 1), ("right", -1))
        ]
    wheels = [
        fflin.ReactionWheel(axis=axis, inertia=0.02, max=0.1, max_speed=600)
        for axis in ((1, 0, 1), (-1, 0, 1), (0, 1, 1), (0, -1, 1))
    ]
    return fflin.load(urdf, inputs=wheels, appendages=wings)
