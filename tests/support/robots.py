"""Robots and points that several test files share."""

import numpy as np
import pinocchio as pin

import fflin
from fflin.robot.catalog import bundled_directory

BUNDLED = tuple(sorted(path.stem for path in bundled_directory().glob("*.urdf")))
FRAMES = ("hybrid", "local", "world")


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
        branch.append(model.addJoint(branch[-1], joint, pin.SE3.Random(), f"joint_{index}"))
        model.appendBodyToJoint(branch[-1], pin.Inertia.Random(), pin.SE3.Random())
    return fflin.from_model(model, name=f"tree_{n}")
