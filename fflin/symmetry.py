"""Ignorable coordinates: those that nothing in a linear model of a robot depends on."""

import numpy as np
import pinocchio as pin

from fflin.joints import Joint
from fflin.model import Robot
from fflin.rotation import skew

# What the rounding of a URDF's own numbers leaves of an exact symmetry, relative.
_ROUNDING = 1e-12


def ignorable_states(robot: Robot, *, moving: bool) -> tuple[str, ...]:
    """Return the names of the ignorable coordinates, found on the robot and not at a point.

    Where the base is (uniform gravity is the same everywhere); of error dynamics, without
    gravity, how it is turned too; and the angle of each rotor: a revolute joint at the end of
    its branch whose body is symmetric about its axis, and that has no spring, no mimic joint,
    and no input or output fixed on its body.

    Parameters
    ----------
    robot : Robot
    moving : bool
        Whether the states are errors from a moving reference, in its own axes.

    Returns
    -------
    tuple of str
    """
    groups = ["r_b"] if any(robot.gravity) or not moving else ["q_b", "r_b"]
    base = [f"{group}.{axis}" for group in groups for axis in "xyz"]
    return (*base, *(f"q_m.{joint.name}" for joint in robot.joints if _is_rotor(robot, joint)))


def _is_rotor(robot: Robot, joint: Joint) -> bool:
    model = robot.model
    index = model.getJointId(joint.name)
    if joint.prismatic or robot.stiffness.get(joint.name) or len(model.subtrees[index]) > 1:
        return False
    if any(joint.name == follower.leader.name for follower in robot.followers):
        return False
    body = model.inertias[index]
    jacobian = pin.computeJointJacobian(model, model.createData(), robot.neutral(), index)
    linear, axis = np.split(jacobian[:, joint.idx_v], 2)
    if linear.any():  # a screw
        return False
    turn, inertia = skew(axis), body.inertia
    uneven = float(np.abs(turn @ inertia - inertia @ turn).max())
    largest = float(np.abs(inertia).max())
    offset = body.mass * float(np.square(turn @ body.lever).sum())
    if uneven > _ROUNDING * largest or offset > _ROUNDING**2 * largest:
        return False
    named = {getattr(item, "frame", None) for item in (*robot.inputs, *robot.outputs)} - {None}
    return not any(f.parentJoint == index and f.name in named for f in model.frames if named)
