"""Joints of one degree of freedom, independent or following another."""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, TypeAlias, TypeVar

import numpy as np
import pinocchio as pin

from fflin.base.errors import InputError
from fflin.base.names import joints_by_name
from fflin.base.validation import NORM_TOLERANCE, Array

T = TypeVar("T")


class Joint(NamedTuple):
    """One joint of one degree of freedom."""

    name: str  # in the model
    idx_q: int  # where it begins in Pinocchio's q, and in v
    idx_v: int
    unbounded: bool  # stored as (cos, sin), two entries of q; one angle in the state
    prismatic: bool  # a length in metres; otherwise an angle in radians

    @property
    def unit(self) -> str:
        """Unit of its position; its rate has this per second."""
        return "m" if self.prismatic else "rad"

    @property
    def force_unit(self) -> str:
        """Unit of the force or torque that moves it."""
        return "N" if self.prismatic else "N m"

    def place(self, q: Array, value: float) -> None:
        """Write this joint's angle [rad] or length [m] into a configuration."""
        if self.unbounded:
            q[self.idx_q : self.idx_q + 2] = np.cos(value), np.sin(value)
        else:
            q[self.idx_q] = value

    def value(self, q: Array) -> float:
        """Return this joint's angle [rad], of a continuous joint in (-pi, pi], or length [m]."""
        if self.unbounded:
            return float(np.arctan2(q[self.idx_q + 1], q[self.idx_q]))
        return float(q[self.idx_q])

    def within(self, model: pin.Model) -> "Joint":
        """Return the joint of this name where it begins in another model."""
        joint = model.joints[model.getJointId(self.name)]
        return self._replace(idx_q=joint.idx_q, idx_v=joint.idx_v)


class Follower(NamedTuple):
    """A joint that mimics an independent one: value = multiplier * leader's value + offset."""

    joint: Joint
    leader: Joint
    multiplier: float
    offset: float

    def place(self, q: Array) -> None:
        """Put it where its leader in this configuration says."""
        self.joint.place(q, self.multiplier * self.leader.value(q) + self.offset)


# Returns the joint of a name, or raises what is wrong with it.
Find: TypeAlias = Callable[[str], Joint]


def by_joint(values: Mapping[str, T], joints: Sequence[str], find: Find) -> dict[str, T]:
    """Return {joint: value} of {joint or pattern: value}; the group ``q_m`` is all joints."""
    return joints_by_name("joint", values, joints, lambda name: find(name).name)


def followed(followers: Sequence[Follower], q: Array) -> Array:
    """Return a copy of q (nq,) with the followers put right where they are within 1e-6."""
    placed = q.copy()
    for follower in followers:
        follower.place(placed)
    for joint, leader, *_ in followers:
        part = slice(joint.idx_q, joint.idx_q + 1 + joint.unbounded)
        error = np.abs(placed[part] - q[part]).max()
        if error > NORM_TOLERANCE * max(1.0, np.abs(placed[part]).max()):
            raise InputError(
                f"joint '{joint.name}' is at {joint.value(q):.9g}, but it mimics '{leader.name}', "
                f"which puts it at {joint.value(placed):.9g}; `configuration` places mimic joints"
            )
    return placed


def check_followers_rates(followers: Sequence[Follower], v: Array) -> None:
    """Refuse a velocity (nv,) in which a joint does not move as its leader makes it."""
    for joint, leader, multiplier, _ in followers:
        expected = multiplier * v[leader.idx_v]
        if abs(v[joint.idx_v] - expected) > NORM_TOLERANCE * max(1.0, abs(expected)):
            raise InputError(
                f"v[{joint.idx_v}] of joint '{joint.name}' is {v[joint.idx_v]:.9g}, but it mimics "
                f"'{leader.name}', which makes it {expected:.9g}"
            )
