"""Robots with constraints whose linear models are known in closed form."""

import numpy as np
import pinocchio as pin

import fflin
from tests.support.robots import random_pose, random_tree


def at(x=0.0, y=0.0, z=0.0):
    """A placement without rotation."""
    return pin.SE3(np.eye(3), np.array((x, y, z)))


def rod(mass, length):
    """Inertia of a slender rod from the origin along x, with a small roll inertia."""
    across = mass * length**2 / 12.0
    roll = 1e-3 * mass * length**2
    return pin.Inertia(
        mass, np.array((length / 2.0, 0.0, 0.0)), np.diag((roll, across, across))
    )


class Build:
    """A model that is built body by body, with a frame for every point that is named."""

    def __init__(self, inertia):
        self.model = pin.Model()
        self.base = self.add(0, pin.JointModelFreeFlyer(), at(), "base", inertia)

    def add(self, parent, joint, placement, name, inertia):
        """Add a joint with its body, and return its index."""
        index = self.model.addJoint(parent, joint, placement, f"{name}")
        self.model.addJointFrame(index)
        self.model.appendBodyToJoint(index, inertia, pin.SE3.Identity())
        return index

    def frame(self, name, joint, placement):
        """Add a frame to a joint."""
        parent = self.model.getFrameId(self.model.names[joint])
        kind = pin.FrameType.OP_FRAME
        self.model.addFrame(pin.Frame(name, joint, parent, placement, kind))

    def robot(self, name, **fields):
        """Return the robot."""
        return fflin.from_model(self.model, name=name, **fields)


def pendulum(mass, inertia, length, gravity=9.81):
    """A body whose centre of mass hangs below the point that is held."""
    build = Build(pin.Inertia(mass, np.zeros(3), np.diag(inertia)))
    build.frame("tip", build.base, at(z=length))
    return build.robot(
        "pendulum",
        constraints=[fflin.Spherical("tip")],
        gravity=(0.0, 0.0, -gravity),
    )


def parallelogram(crank, coupler, length, width, gravity=9.81):
    """A four-bar linkage with two parallel cranks and masses `crank` and `coupler`.

    The ground link is welded to inertial space. The cranks are along -y at the angle zero.
    """
    build = Build(pin.Inertia(5.0, np.zeros(3), np.eye(3)))
    down = pin.SE3(pin.rpy.rpyToMatrix(0.0, 0.0, -np.pi / 2.0), np.zeros(3))
    left = build.add(1, pin.JointModelRZ(), down, "left", rod(crank, length))
    level = pin.SE3(
        pin.rpy.rpyToMatrix(0.0, 0.0, np.pi / 2.0), np.array((length, 0, 0))
    )
    bar = build.add(left, pin.JointModelRZ(), level, "bar", rod(coupler, width))
    build.frame("bar_end", bar, at(x=width))
    right = build.add(
        1, pin.JointModelRZ(), at(x=width) * down, "right", rod(crank, length)
    )
    build.frame("right_end", right, at(x=length))
    return build.robot(
        "parallelogram",
        constraints=[
            fflin.Weld("base", placement=at()),
            fflin.Hinge("bar_end", "right_end", placement=down.inverse()),
        ],
        gravity=(0.0, -gravity, 0.0),
    )


def hinged_rods(mass, length):
    """The model of two rods in line, which a slider can press."""
    build = Build(rod(mass, length))
    build.frame("foot", build.base, at())
    small = pin.Inertia(0.1, np.zeros(3), 0.01 * np.eye(3))
    knee = build.add(1, pin.JointModelRZ(), at(x=length), "knee", rod(mass, length))
    shoe = build.add(knee, pin.JointModelRZ(), at(x=length), "shoe", small)
    build.add(shoe, pin.JointModelPX(), at(), "slide", small)
    return build


def strut(mass, length, stiffness):
    """Two rods in line, with a spring between them, hinged at both ends and pressed by a slider."""
    build = hinged_rods(mass, length)
    return build.robot(
        "strut",
        constraints=[fflin.Hinge("foot"), fflin.Weld("slide")],
        stiffness={"knee": stiffness},
    )


KINDS = (fflin.Weld, fflin.Hinge, fflin.Spherical)


def random_constraints(rng, *, count, joints=9, loads=True):
    """A random tree with random closed constraints and a point on its manifold."""
    tree = random_tree(rng, joints)
    model = tree.model.copy()
    for index in range(1, model.njoints):
        model.addJointFrame(index)
    robot = fflin.from_model(model, name=tree.name)
    names = list(model.names)[1:]
    items = []
    for index in range(count):
        kind = KINDS[rng.integers(3)]
        frame, to = rng.choice(len(names), 2, replace=False)
        axis = {"axis": rng.normal(size=3)} if kind is fflin.Hinge else {}
        loop = rng.random() < 0.6
        to_name = names[to] if loop else None
        items.append(kind(names[frame], to_name, name=f"held_{index}", **axis))
        if rng.random() < 0.3:  # redundant: some of the same rows again
            items.append(fflin.Spherical(names[frame], to_name, name=f"again_{index}"))
    fields = {"stiffness": 2.0, "damping": 0.3, "gravity": (1.0, 2.0, -4.0)}
    robot = robot.replace(constraints=items, **(fields if loads else {}))
    values = {joint.name: rng.uniform(-1.5, 1.5) for joint in robot.joints}
    q = fflin.configuration(robot, values, random_pose(rng, rng.uniform(0.0, 120.0)))
    v = rng.normal(size=robot.nv)
    if items:
        q, v = fflin.closed(robot, q, v)
    return robot, q, v, rng.normal(size=6 + robot.n)
