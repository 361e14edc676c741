"""The robots and points that every peer is measured at, and the one URDF they all load."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pinocchio as pin

import fflin

Array = np.ndarray
NAMES = ("cubesat", "ets_vii", "ur5", "panda", "servicer_7dof", "talos")
BASE = "base"


@dataclass(frozen=True)
class Point:
    """A robot at a random point; its base at the origin of the world, unturned.

    There velocities and wrenches have the same components in every frame, so that all peers get
    the same numbers; what differs between frames are their derivatives.

    Attributes
    ----------
    q_m : ndarray (n,)
        Joint positions in state order.
    nu, u : ndarray (6 + n,)
        Velocities and inputs: angular, linear, joints.
    q, v : ndarray (nq,), (nv,)
        The same in Pinocchio's order.
    """

    robot: fflin.Robot
    q_m: Array
    nu: Array
    u: Array

    @cached_property
    def q(self) -> Array:
        joints = dict(zip(self.robot.joint_names, self.q_m.tolist(), strict=True))
        return fflin.configuration(self.robot, joints)

    @cached_property
    def v(self) -> Array:
        return fflin.StateMap(self.robot).spread(self.nu)

    @cached_property
    def order(self) -> Array:
        """Index in Pinocchio's v of each velocity of state order."""
        return np.array(
            [3, 4, 5, 0, 1, 2, *(joint.idx_v for joint in self.robot.joints)]
        )


def load(name: str) -> fflin.Robot:
    """Return a robot by name; joints that mimic others are free, for the peers know none."""
    robot = fflin.load(name)
    return fflin.from_model(robot.model, name=robot.name) if robot.followers else robot


def random_point(robot: fflin.Robot, seed: int = 0) -> Point:
    """Return a random point, where inputs accelerate each coordinate alone by about 1."""
    rng = np.random.default_rng(seed)
    q_m, nu, a = rng.uniform(-1.0, 1.0, robot.n), *rng.normal(size=(2, 6 + robot.n))
    rest = Point(robot, q_m, 0.0 * nu, 0.0 * nu)
    return Point(robot, q_m, nu, a * fflin.linearize(robot, rest.q).M.diagonal())


def generated(kind: str, n: int) -> fflin.Robot:
    """Return a chain or a tree of `n` revolute joints; in a tree two hang on every link."""
    model, rng = pin.Model(), np.random.default_rng(n)
    base = pin.Inertia(500.0, np.array([0.05, 0.0, 0.1]), np.diag([80.0, 90.0, 100.0]))
    link = pin.Inertia(4.0, np.array([0.05, 0.01, 0.02]), np.diag([0.02, 0.06, 0.07]))
    root = model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "free")
    model.appendBodyToJoint(root, base, pin.SE3.Identity())
    kinds = (pin.JointModelRZ, pin.JointModelRY, pin.JointModelRX)
    # Depth first: what is to hang on which joint, the next one last.
    waiting = [(root, n)]
    while waiting:
        parent, count = waiting.pop()
        if not count:
            continue
        place = pin.SE3(pin.exp3(0.3 * rng.normal(size=3)), np.array([0.1, 0.0, 0.0]))
        index = model.njoints - 2
        joint = model.addJoint(parent, kinds[index % 3](), place, f"joint_{index}")
        model.appendBodyToJoint(joint, link, pin.SE3.Identity())
        aside = (count - 1) // 2 if kind == "tree" else 0
        waiting += [(joint, aside), (joint, count - 1 - aside)]
    return fflin.from_model(model, name=f"{kind}_{n}")


def is_rigid(robot: fflin.Robot) -> bool:
    """Whether no principal moment of any body is more than the sum of the others."""
    moments = [
        np.linalg.eigvalsh(item.inertia) for item in robot.model.inertias.tolist()[1:]
    ]
    return all(2.0 * each.max() <= each.sum() * (1.0 + 1e-9) for each in moments)


def plain_urdf(robot: fflin.Robot) -> str:
    """Return a URDF of the bodies that move alone: no meshes, limits, damping or `world` link."""
    model, data = robot.model, robot.create_data()
    pin.computeJointJacobians(model, data, pin.neutral(model))
    lines = [f'<robot name="{robot.name}">', link_urdf(BASE, model.inertias[1])]
    for joint in robot.joints:
        index, kind = (
            model.getJointId(joint.name),
            "prismatic" if joint.prismatic else "continuous",
        )
        axis = pin.getJointJacobian(model, data, index, pin.LOCAL)[:, joint.idx_v]
        axis = axis[:3] if joint.prismatic else axis[3:]
        parent = model.parents[index]
        above = BASE if parent == 1 else f"link {model.names[parent]}"
        lines += [
            link_urdf(f"link {joint.name}", model.inertias[index]),
            f'<joint name="{joint.name}" type="{kind}">',
            f'<parent link="{above}"/>',
            f'<child link="link {joint.name}"/>{_origin(model.jointPlacements[index])}',
            f'<axis xyz="{_text(axis)}"/>',
            '<limit effort="1e9" velocity="1e9" lower="-1e9" upper="1e9"/></joint>',
        ]
    return "\n".join([*lines, "</robot>"])


def link_urdf(name: str, inertia: pin.Inertia) -> str:
    """Return the URDF of one body."""
    moments = zip(
        ("ixx", "ixy", "ixz", "iyy", "iyz", "izz"),
        inertia.inertia[np.triu_indices(3)].tolist(),
        strict=True,
    )
    attributes = " ".join(f'{key}="{value!r}"' for key, value in moments)
    return (
        f'<link name="{name}"><inertial><origin xyz="{_text(inertia.lever)}"/>'
        f'<mass value="{inertia.mass!r}"/><inertia {attributes}/></inertial></link>'
    )


def _origin(place: pin.SE3) -> str:
    angles = pin.rpy.matrixToRpy(place.rotation)
    return f'<origin xyz="{_text(place.translation)}" rpy="{_text(angles)}"/>'


def _text(vector: Array) -> str:
    return " ".join(repr(value) for value in vector.tolist())
