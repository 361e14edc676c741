"""Rotors, and the joints that are flown as reaction wheels.

A rotor is a joint whose position does not affect the dynamics, such as the joint of a balanced
wheel. At rest, a rotor may also be the last joint of an arm, whose position must be held. The angle
of a wheel, in contrast, grows without bound and is never held. Therefore a rotor is flown as a
reaction wheel only if it spins at the operating point while the other joints are at rest, or if the
robot's field `wheel_joints` names it. If other joints move, the rotor may be the wrist of a moving
arm.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple, Protocol

import numpy as np

from fflin.base.errors import InputError
from fflin.base.rotation import skew
from fflin.base.validation import Array
from fflin.robot.fields import limits_of
from fflin.robot.robot_data import RobotData

# Largest relative asymmetry of a body that counts as symmetric. Such an asymmetry results from the
# rounding of numbers in a URDF.
_ASYMMETRY = 1e-12

# Speed [rad/s] above which a rotor spins. It is above the rates that rounding or a planned motion
# leaves at a joint at rest, and far below the speeds of wheels: one turn takes ten weeks.
SPINNING = 1e-6

# Position limits count as missing if they are at least this far apart [rad]. A wheel with a speed
# of 1000 rad/s needs 30 years for this rotation.
_UNREACHABLE = 1e12


class OperatingPoint(Protocol):
    """State at an operating point, with the names of its entries, such as a `LinearModel`."""

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names (nx,) of the states."""

    @property
    def x0(self) -> Array:
        """State (nx,)."""


class FlownWheels(NamedTuple):
    """Joints that are flown as reaction wheels: `always`, or if they spin at the point."""

    always: tuple[str, ...]
    if_spinning: tuple[str, ...]

    def at(self, speeds: Mapping[str, float]) -> tuple[str, ...]:
        """Return the names of the wheels at {joint: speed [rad/s | m/s]} of all joints."""
        moving = [name for name, speed in speeds.items() if abs(speed) > SPINNING]
        rotors = {*self.always, *self.if_spinning}
        if not rotors.issuperset(moving):
            return self.always
        spun = [name for name in self.if_spinning if name in moving]
        return tuple(dict.fromkeys((*self.always, *spun)))

    def __call__(self, point: OperatingPoint) -> tuple[str, ...]:
        """Return the names of the wheels at an operating point."""
        states = zip(point.state_names, point.x0.tolist(), strict=True)
        rates = {name: value for name, value in states if name.startswith("qdot_m.")}
        return self.at(
            {name.removeprefix("qdot_m."): speed for name, speed in rates.items()}
        )


def flown_wheels(robot: RobotData, free_rotors: tuple[str, ...]) -> FlownWheels:
    """Return which joints of a robot are flown as reaction wheels, from its free rotors.

    Joints in `wheel_joints` are omitted if they are no longer rotors, for example because a changed
    inertia is not balanced.
    """
    named = tuple(name for name in robot.wheel_joints if name in free_rotors)
    return FlownWheels((*robot.reaction_wheels, *named), free_rotors)


def obstacles(robot: RobotData) -> dict[str, str]:
    """Return {joint: reason why the joint is not a rotor} for all joints that are not rotors."""
    model = robot.model
    carriers = set(model.parents.tolist())
    leaders = {follower.leader.name for follower in robot.followers}
    frames = set(robot.used_frames)
    mounted = set[int]()
    if frames:
        mounted = {frame.parentJoint for frame in model.frames if frame.name in frames}
    reasons = dict[str, str]()
    for joint in robot.joints:
        index = model.getJointId(joint.name)
        if index in carriers:
            reasons[joint.name] = "its link carries another joint"
        elif joint.name in leaders:
            reasons[joint.name] = "a mimic joint follows it"
        elif robot.stiffness.get(joint.name):
            reasons[joint.name] = "it has a spring"
        elif index in mounted:
            reasons[joint.name] = "an input or output is mounted on its link"
        elif not _is_symmetric(robot, index):
            reasons[joint.name] = "its link is not symmetric about the joint axis"
    return reasons


def rotor_names(robot: RobotData) -> tuple[str, ...]:
    """Return the names of the rotors: joints whose body is symmetric about the joint axis.

    A rotor carries no other joint, is not the leader of a mimic joint, and has no spring. No input
    or output is mounted on its body.
    """
    excluded = obstacles(robot)
    return tuple(name for name in robot.joint_names if name not in excluded)


def free_rotor_names(robot: RobotData, rotors: Sequence[str]) -> tuple[str, ...]:
    """Return the names of the rotors without position limits, which may spin forever."""
    limits = limits_of(robot)

    def is_free(name: str) -> bool:
        least, largest = limits.get(f"q_m.{name}", (-np.inf, np.inf))
        return largest - least >= _UNREACHABLE

    return tuple(name for name in rotors if is_free(name))


def require_free_rotors(robot: RobotData) -> None:
    """Raise `InputError` if a joint in the robot's field `wheel_joints` cannot spin freely."""
    if not robot.wheel_joints:
        return
    excluded = obstacles(robot)
    free = free_rotor_names(robot, rotor_names(robot))
    for name in robot.wheel_joints:
        if name not in free:
            why = excluded.get(name, "it has position limits")
            raise InputError(
                f"wheel_joints names joint '{name}', but {why}; name only joints that spin freely, "
                "with a link that is balanced and symmetric about the joint axis"
            )


def spin_inertia(robot: RobotData, name: str) -> float:
    """Return the inertia [kg m^2] of a rotor's body about the joint axis."""
    index = robot.model.getJointId(name)
    axis = spin_axis(robot, index)
    return float(axis @ robot.model.inertias[index].inertia @ axis)


def spin_axis(robot: RobotData, index: int) -> Array:
    """Return the axis (3,) of a revolute joint in the axes of its body, zeros if it translates."""
    joint = robot.model.joints[index]
    data = joint.createData()
    joint.calc(data, robot.neutral())
    linear, axis = np.split(np.asarray(data.S, dtype=float).ravel(), 2)
    if linear.any():
        return np.zeros(3)
    return axis


def motor_of(inputs: Sequence[str], joint: str) -> int | None:
    """Return the index of the torque of a wheel among the names of inputs, or None if none acts."""
    for name in (joint, f"tau_m.{joint}"):
        if name in inputs:
            return inputs.index(name)
    return None


def _is_symmetric(robot: RobotData, index: int) -> bool:
    """Return whether the body of a joint is symmetric about the joint axis."""
    axis = spin_axis(robot, index)
    if not axis.any():  # a joint that translates
        return False
    body = robot.model.inertias[index]
    axis_cross = skew(axis)
    # Derivative of the inertia with respect to a rotation about the axis; zero if symmetric.
    change = axis_cross @ body.inertia - body.inertia @ axis_cross
    uneven = float(np.abs(change).max())
    largest = float(np.abs(body.inertia).max())
    # Moment of inertia m d^2 due to the distance d of the centre of mass from the axis. The
    # tolerance applies to d, so m d^2 is compared with the square of the tolerance.
    offset = body.mass * float(np.square(axis_cross @ body.lever).sum())
    return uneven <= _ASYMMETRY * largest and offset <= _ASYMMETRY**2 * largest
