"""Impacts: what a robot becomes at once, and the velocities just after."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pinocchio as pin

from fflin.base.frozen import FrozenArrays
from fflin.base.tables import folded
from fflin.base.validation import Array
from fflin.robot.robot import Robot


@dataclass(frozen=True, eq=False, repr=False)
class Impact(FrozenArrays):
    """What a robot has become at once, and the impact; `Motion.then` goes on with it.

    Attributes
    ----------
    robot : Robot
        From then on, to be linearised, regulated and simulated like any other.
    q, v : ndarray (nq,), (nv,)
        Of that robot, just after.
    impulse : ndarray (k,)
        Of `jam` on each joint, torque [N m s] or force [N s]; of `capture` see `Capture`.
    energy_lost : float
        [J], never negative.
    momentum : ndarray (6,)
        Linear [N s], and angular [N m s] about the world's origin, of all together before.
    momentum_after : ndarray (6,)
        The same after: they differ by rounding.
    event : str
        What happened, in words.
    """

    robot: Robot
    q: Array
    v: Array
    impulse: Array
    energy_lost: float
    momentum: Array
    momentum_after: Array
    event: str
    # Of the robot that it was, just before.
    _before: tuple[Robot, Array, Array] = field(kw_only=True)

    def __repr__(self) -> str:
        return f"{type(self).__name__}('{self.robot.name}', {self.energy_lost:.4g} J lost)"

    def __str__(self) -> str:
        return folded([f"{self.robot.name}, {self.robot.n} joints: {self.told}"])

    @property
    def told(self) -> str:
        """What happened and what it took, in a line."""
        felt = f"impulse {np.abs(self.impulse).max(initial=0.0):.4g}"
        return f"{self.event}: {felt}, {self.energy_lost:.4g} J lost"


def projected(M: Array, G: Array, before: Array) -> tuple[Array, Array]:
    r"""Return the velocities after an impact and the jump, M-orthogonal to what G allows (13.1)."""
    after = np.linalg.solve(G.T @ M @ G, G.T @ (M @ before))
    return after, before - G @ after


def inertia_at(robot: Robot, q: Array) -> Array:
    """Return M (nv, nv) over Pinocchio's v."""
    M = np.triu(pin.crba(robot.model, robot.create_data(), q.copy()))
    full: Array = M + np.triu(M, 1).T
    return full


def momentum_of(robot: Robot, q: Array, v: Array) -> Array:
    """Return linear and angular momentum (6,) about the world's origin, in its axes."""
    data = robot.create_data()
    pin.computeCentroidalMomentum(robot.model, data, q, v)
    linear, angular = data.hg.linear, data.hg.angular + np.cross(data.com[0], data.hg.linear)
    return np.concatenate((linear, angular))


def joint_called(robot: Robot, name: str) -> Any:
    """Return the joint of Pinocchio's model of that name."""
    return robot.model.joints[robot.model.getJointId(name)]
