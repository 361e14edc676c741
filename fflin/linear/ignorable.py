"""Ignorable coordinates: states on which no term of a robot's linear model depends."""

import numpy as np

from fflin.base.rotation import skew
from fflin.linear.model import LinearModel
from fflin.robot.joints import Joint
from fflin.robot.robot import Robot

# What the rounding of a URDF's own numbers leaves of an exact symmetry, relative.
_ROUNDING = 1e-12


def ignorable_states(robot: Robot, lin: LinearModel) -> tuple[str, ...]:
    """Return the names of the ignorable coordinates of a linear model of this robot."""
    # Found on the robot and not at a point: uniform gravity is the same everywhere, and without it
    # error dynamics do not depend on the attitude either. In an orbit all of it matters.
    if robot.orbit:
        return tuple(f"q_m.{name}" for name in rotor_names(robot))
    groups = ["r_b"] if any(robot.gravity) or not lin.moving else ["q_b", "r_b"]
    base = [f"{group}.{axis}" for group in groups for axis in "xyz"]
    return (*base, *(f"q_m.{name}" for name in rotor_names(robot)))


def rotor_names(robot: Robot) -> tuple[str, ...]:
    """Return the names of the joints that are rotors, as `ignorable_states` says."""
    model = robot.model
    index_of = {joint.name: model.getJointId(joint.name) for joint in robot.joints}
    named = set(robot.used_frames)
    # What carries another joint, leads one, has a spring, or has something fixed on it.
    busy = set(model.parents.tolist())
    busy |= {index_of[follower.leader.name] for follower in robot.followers}
    busy |= {index_of[name] for name, stiffness in robot.stiffness.items() if stiffness}
    if named:
        busy |= {frame.parentJoint for frame in model.frames if frame.name in named}
    free = (joint for joint in robot.joints if index_of[joint.name] not in busy)
    return tuple(joint.name for joint in free if _is_symmetric(robot, joint, index_of[joint.name]))


def _is_symmetric(robot: Robot, joint: Joint, index: int) -> bool:
    """Whether the body behind a joint stays as it is when the joint turns."""
    if joint.prismatic:
        return False
    pin_joint = robot.model.joints[index]
    data = pin_joint.createData()
    pin_joint.calc(data, robot.neutral())
    linear, axis = np.split(np.asarray(data.S).ravel(), 2)
    if linear.any():  # a screw
        return False
    body, turn = robot.model.inertias[index], skew(axis)
    inertia = body.inertia
    uneven = float(np.abs(turn @ inertia - inertia @ turn).max())
    largest = float(np.abs(inertia).max())
    offset = body.mass * float(np.square(turn @ body.lever).sum())
    return uneven <= _ROUNDING * largest and offset <= _ROUNDING**2 * largest
