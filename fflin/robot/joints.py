"""Joints of one degree of freedom, independent or following another."""

from typing import NamedTuple

import numpy as np
import pinocchio as pin

from fflin.base.validation import Array


class Joint(NamedTuple):
    """One joint of one degree of freedom.

    Attributes
    ----------
    name : str
        Its name in the model.
    idx_q, idx_v : int
        Where it begins in Pinocchio's q and v.
    unbounded : bool
        Stored as (cos, sin), two entries of q; one angle in the state.
    prismatic : bool
        A length in metres; otherwise an angle in radians.
    """

    name: str
    idx_q: int
    idx_v: int
    unbounded: bool
    prismatic: bool

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
