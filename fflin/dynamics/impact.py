"""Impacts: instant changes of a robot, such as a jammed joint, and the velocities just after."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pinocchio as pin

from fflin.base.errors import InputError
from fflin.base.frozen import FrozenArrays
from fflin.base.tables import folded
from fflin.base.validation import Array
from fflin.dynamics.state import StateMap
from fflin.robot.joints import by_joint
from fflin.robot.locking import welded
from fflin.robot.robot import ROOT, Robot


@dataclass(frozen=True, eq=False, repr=False)
class Impact(FrozenArrays):
    """Robot just after an instantaneous impact; pass it to `Motion.then` to continue a motion.

    Attributes
    ----------
    robot : Robot
        The robot after the impact, to be linearised, controlled and simulated like any other.
    q, v : ndarray (nq,), (nv,)
        Configuration and velocity of this robot just after the impact.
    impulse : ndarray (k,)
        For `jam`, the impulse on each jammed joint: [N m s] if it is revolute, [N s] if it is
        prismatic. For `capture`, see `Capture`.
    energy_lost : float
        Kinetic energy lost in the impact [J], never negative.
    momentum : ndarray (6,)
        Total momentum before the impact: linear [N s], then angular [N m s] about the world's
        origin.
    momentum_after : ndarray (6,)
        Total momentum after the impact, equal to `momentum` to machine precision.
    event : str
        Short description of the event.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> spin = fflin.velocity(robot, {"joint_1": 0.2})
    >>> jammed = fflin.jam(robot, "joint_1", v=spin)
    >>> bool(abs(jammed.momentum_after - jammed.momentum).max() < 1e-12), jammed.event
    (True, 'joint_1 jammed')
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
        """Event, impulse and lost energy, in one line."""
        felt = f"largest impulse {np.abs(self.impulse).max(initial=0.0):.4g}"
        return f"{self.event}: {felt}, {self.energy_lost:.4g} J lost"


def jam(
    robot: Robot,
    joints: str | Sequence[str],
    *,
    q: Array | None = None,
    v: Array | None = None,
) -> Impact:
    r"""Stop joints or wheels instantly and permanently at their present positions.

    The other joints are free during the impact. Immediately after the impact, the velocity
    satisfies :math:`M_+ \nu_+ = G^T M \nu` (13.1), where G is the Jacobian of the robot with the
    jammed joints fixed. Linear and angular momentum are conserved. If a motor fails but its joint
    still moves freely, use ``robot.replace(passive=[joint])`` instead; there is then no impact.

    Parameters
    ----------
    robot : Robot
    joints : str or sequence of str
        Names or patterns of joints; the mimic joints of a joint stop with it.
    q, v : array_like (nq,), (nv,), optional
        Configuration and velocity just before the impact; neutral and at rest by default.

    Returns
    -------
    Impact
        Result of the impact. In its robot, these joints are welded and have no inputs.

    Raises
    ------
    UnknownNameError
        If there is no such joint.
    InputError
        If a size or value is wrong, no joint is named, or the robot would have no input left.
    ModelError
        If the robot was changed after it was made.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> spin = fflin.velocity(robot, {"joint_1": 0.2})
    >>> jammed = fflin.jam(robot, "joint_1", v=spin)
    >>> jammed.robot.joint_names, jammed.energy_lost > 0
    (('joint_2', 'joint_3'), True)
    """
    state = StateMap(robot)
    keys = [joints] if isinstance(joints, str) else joints
    if not isinstance(keys, Sequence) or not keys or not all(isinstance(k, str) for k in keys):
        raise InputError(f"joints is {joints!r}, expected names of joints")
    named = by_joint(dict.fromkeys(keys), robot.joint_names, robot.joint)
    q = robot.neutral() if q is None else robot.checked_configuration(q)
    v = np.zeros(robot.nv) if v is None else robot.checked_velocity(v)
    at = {name: robot.joint(name).value(q) for name in named}
    left = welded(robot, at)
    said, impulse = struck(left, [(robot, q, v)], "", f"{', '.join(at)} jammed")
    stopped = [6 + robot.joint_names.index(name) for name in at]
    return Impact(impulse=-state.forces(impulse)[stopped], **said)


def struck(
    whole: Robot, parts: Sequence[tuple[Robot, Array, Array]], prefix: str, event: str
) -> tuple[dict[str, Any], Array]:
    """Return the fields of `Impact` for robots at q, v that become one (13.1), and the impulses."""
    state, q, local = StateMap(whole), whole.neutral(), pin.ReferenceFrame.LOCAL
    sizes = [robot.nv for robot, *_ in parts]
    G, M = np.zeros((sum(sizes), whole.nv)), np.zeros((sum(sizes), sum(sizes)))
    q[:7], at = parts[0][1][:7], 0
    for robot, own_q, _ in parts:
        rows, start = G[at : at + robot.nv], f"{prefix}." if at else ""
        M[at : at + robot.nv, at : at + robot.nv] = inertia_at(robot, own_q)
        for name in list(robot.model.names)[ROOT + 1 :]:
            if whole.model.existJointName(start + name):
                here, there = joint_called(robot, name), joint_called(whole, start + name)
                q[there.idx_q : there.idx_q + there.nq] = own_q[here.idx_q :][: here.nq]
                rows[here.idx_v, there.idx_v] = 1.0
        rows[:6, :6] = np.eye(6)
        if at:
            frame = whole.model.getFrameId(prefix, pin.FrameType.BODY)
            data = whole.create_data()
            rows[:6] = pin.computeFrameJacobian(whole.model, data, q, frame, local)
        at += robot.nv
    spread = np.eye(whole.nv) if state.S is None else state.S
    G, before = G @ spread, np.concatenate([own_v for *_, own_v in parts])
    nu = np.linalg.solve(G.T @ M @ G, G.T @ (M @ before))
    jump, v = before - G @ nu, spread @ nu
    said = {"robot": whole, "q": q, "v": v, "event": event, "_before": parts[0]}
    return said | {
        "energy_lost": 0.5 * float(jump @ M @ jump),
        "momentum": sum(momentum_of(*part) for part in parts),
        "momentum_after": momentum_of(whole, q, v),
    }, M @ jump


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
