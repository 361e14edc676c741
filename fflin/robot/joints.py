"""Joints of one degree of freedom, independent or following another."""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, TypeAlias, TypeVar

import numpy as np
import pinocchio as pin

from fflin.base.names import joints_by_name
from fflin.base.validation import Array

T = TypeVar("T")


class Joint(NamedTuple):
    """Joint with one degree of freedom."""

    name: str  # in the model
    idx_q: int  # where it begins in Pinocchio's q, and in v
    idx_v: int
    unbounded: bool  # stored as (cos, sin), two entries of q; one angle in the state
    prismatic: bool  # a length in metres; otherwise an angle in radians

    @property
    def unit(self) -> str:
        """Unit of the joint's position; the unit of its rate is this per second."""
        return "m" if self.prismatic else "rad"

    @property
    def force_unit(self) -> str:
        """Unit of the joint's force or torque."""
        return "N" if self.prismatic else "N m"

    def place(self, q: Array, value: float) -> None:
        """Write this joint's angle [rad] or length [m] into a configuration q (nq,)."""
        if self.unbounded:
            q[self.idx_q : self.idx_q + 2] = np.cos(value), np.sin(value)
        else:
            q[self.idx_q] = value

    def value(self, q: Array) -> float:
        """Return this joint's angle [rad] or length [m]; continuous joints are in (-pi, pi]."""
        if self.unbounded:
            return float(np.arctan2(q[self.idx_q + 1], q[self.idx_q]))
        return float(q[self.idx_q])

    def within(self, model: pin.Model) -> "Joint":
        """Return the joint of the same name with its offsets in another model."""
        joint = model.joints[model.getJointId(self.name)]
        return self._replace(idx_q=joint.idx_q, idx_v=joint.idx_v)


class Follower(NamedTuple):
    """Mimic joint, with value = multiplier * leader's value + offset."""

    joint: Joint
    leader: Joint
    multiplier: float
    offset: float

    def place(self, q: Array) -> None:
        """Place the mimic joint by its leader's value in the configuration q (nq,)."""
        self.joint.place(q, self.multiplier * self.leader.value(q) + self.offset)


# Returns the joint of a name, or raises what is wrong with it.
Find: TypeAlias = Callable[[str], Joint]


def by_joint(values: Mapping[str, T], joints: Sequence[str], find: Find) -> dict[str, T]:
    """Return {joint: value} of {joint or pattern: value}; the group ``q_m`` is all joints."""
    return joints_by_name("joint", values, joints, lambda name: find(name).name)
