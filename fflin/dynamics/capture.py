"""A rigid grasp: the robot that carries its payload, and the velocities just after."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pinocchio as pin

from fflin.base.errors import InputError
from fflin.base.frozen import FrozenArrays
from fflin.base.tables import folded
from fflin.base.validation import Array, dimension, vector
from fflin.base.validation import placement as checked_placement
from fflin.dynamics.state import StateMap
from fflin.robot.frames import ROOT, find_frame
from fflin.robot.joined import body_alone, inertia_of, joined
from fflin.robot.robot import Robot


@dataclass(frozen=True, eq=False, repr=False)
class Capture(FrozenArrays):
    """A robot with what it has grasped, and the impact.

    Attributes
    ----------
    robot : Robot
        With the payload on it, to be linearised, regulated and simulated like any other.
    q, v : ndarray (nq,), (nv,)
        Of that robot, just after.
    impulse : ndarray (6,)
        On the robot, at the payload's frame and in its axes: force [N s], then torque [N m s].
    energy_lost : float
        [J], never negative.
    momentum : ndarray (6,)
        Linear [N s], and angular [N m s] about the world's origin, of both together before.
    momentum_after : ndarray (6,)
        The same of the one after: they differ by rounding.
    """

    robot: Robot
    q: Array
    v: Array
    impulse: Array
    energy_lost: float
    momentum: Array
    momentum_after: Array

    def __repr__(self) -> str:
        return f"Capture('{self.robot.name}', {self.energy_lost:.4g} J lost)"

    def __str__(self) -> str:
        force, torque = (np.linalg.norm(each) for each in np.split(self.impulse, 2))
        return folded(
            [
                f"{self.robot.name}: {self.robot.mass:.6g} kg, {self.robot.n} joints",
                f"the grasp pulled by {force:.4g} N s and {torque:.4g} N m s; "
                f"{self.energy_lost:.4g} J were lost",
            ]
        )


def capture(
    robot: Robot,
    frame: str,
    payload: pin.Inertia | Robot,
    *,
    q: Array | None = None,
    v: Array | None = None,
    placement: pin.SE3 | None = None,
    payload_q: Array | None = None,
    payload_v: Array | None = None,
    prefix: str = "payload",
) -> Capture:
    r"""Grasp a payload rigidly, at once and for good.

    The joints are free during the impact, since motors give finite torques. With the
    Jacobian G of both motions over that of the robot that carries its payload,
    :math:`M_+ \nu_+ = G^T \mathrm{diag}(M, M_p) (\nu_-, V_p)`: the M-orthogonal projection on what
    the weld allows, which keeps both momenta.

    Parameters
    ----------
    robot : Robot
    frame : str
        The frame that grasps.
    payload : pin.Inertia or Robot
        A body, in its own frame; or a robot, held by its base, with joints of its own, whose
        springs and dampers stay and whose motors do not.
    q, v : array_like, optional
        Of the robot just before; neutral and at rest by default.
    placement : pin.SE3, optional
        Of the payload's frame in the grasping one; the identity by default.
    payload_q : array_like (nq,), optional
        Configuration of a payload with joints; of its base nothing is taken. Neutral by default.
    payload_v : array_like (6,) or (nv,), optional
        Twist of its frame, linear [m/s] and angular [rad/s], in its own axes, as Pinocchio's LOCAL,
        and the speeds of its joints; at rest by default.
    prefix : str
        What the payload's frame is called, and its joints and links before a dot.

    Returns
    -------
    Capture

    Raises
    ------
    UnknownNameError
        If there is no such frame.
    InputError
        If a size or value is wrong, the payload is no body, its names are taken, its gravity or
        orbit is another, or a wheel of it stores momentum without an inertia.
    ModelError
        If a robot was changed after it was made.

    References
    ----------
    Y. Umetani and K. Yoshida, IEEE Trans. Robotics and Automation 5(3), 1989, for free joints; the
    impact is that of two bodies that stay together.
    """
    if not isinstance(robot, Robot):
        raise InputError(f"robot is a {type(robot).__name__}, expected a fflin.Robot")
    robot.require_unchanged()
    if isinstance(payload, pin.Inertia):
        other = body_alone(inertia_of(payload), prefix)
    elif isinstance(payload, Robot):
        payload.require_unchanged()
        other = replace(payload)  # which may be the robot's twin, the same object
    else:
        raise InputError(
            f"payload is a {type(payload).__name__}, expected a pin.Inertia or a fflin.Robot"
        )
    for field in ("gravity", "orbit") if isinstance(payload, Robot) else ():
        own, theirs = (getattr(each, field) for each in (robot, other))
        if own != theirs:
            raise InputError(f"the robot's {field} is {own}, the payload's {theirs}; give both one")
    if other.stored_momentum:
        raise InputError(
            "a wheel of the payload stores momentum and has no inertia, so that it is no joint and "
            "would be lost; give it an inertia, and its speed in payload_v"
        )
    at = pin.SE3.Identity() if placement is None else checked_placement("placement", placement)
    q = robot.neutral() if q is None else robot.checked_configuration(q)
    v = np.zeros(robot.nv) if v is None else robot.checked_velocity(v)
    whole = joined(robot, frame, other, at, prefix)
    joint, on = find_frame(robot.model, frame)
    data = robot.create_data()
    pin.forwardKinematics(robot.model, data, q)
    other_q, other_v = _beside(other, data.oMi[joint] * on * at, payload_q, payload_v)
    return _impact(whole, (robot, q, v), (other, other_q, other_v), prefix)


def _beside(other: Robot, at: pin.SE3, q: Any, v: Any) -> tuple[Array, Array]:
    """Return configuration and velocity of a payload whose base is at a placement."""
    configuration = other.neutral() if q is None else other.checked_configuration(q).copy()
    root = other.model.jointPlacements[ROOT]
    configuration[:7] = pin.SE3ToXYZQUAT(root.actInv(at))
    if v is None:
        return configuration, np.zeros(other.nv)
    if other.n and dimension("payload_v", v) == 1 and len(v) == 6:
        v = np.concatenate((vector("payload_v", v, 6, "a twist"), np.zeros(other.nv - 6)))
    expected = "the twist (linear, angular) of the payload" + ", and its joints" * bool(other.n)
    v = vector("payload_v", v, other.nv, expected)
    return configuration, other.checked_velocity(v)


def _impact(
    whole: Robot, own: tuple[Robot, Array, Array], held: tuple[Robot, Array, Array], prefix: str
) -> Capture:
    state = StateMap(whole)
    q, (robot, own_q, own_v), (other, other_q, other_v) = whole.neutral(), own, held
    q[:7] = own_q[:7]
    rows = {robot: np.zeros((robot.nv, whole.nv)), other: np.zeros((other.nv, whole.nv))}
    rows[robot][:6, :6] = np.eye(6)
    for of, values, start in ((robot, own_q, ""), (other, other_q, f"{prefix}.")):
        for index in range(ROOT + 1, of.model.njoints):
            there = whole.model.joints[whole.model.getJointId(start + of.model.names[index])]
            here = of.model.joints[index]
            q[there.idx_q : there.idx_q + there.nq] = values[here.idx_q : here.idx_q + here.nq]
            rows[of][here.idx_v, there.idx_v] = 1.0
    data, local = whole.create_data(), pin.ReferenceFrame.LOCAL
    at = whole.model.getFrameId(prefix, pin.FrameType.BODY)
    rows[other][:6] = pin.computeFrameJacobian(whole.model, data, q, at, local)
    spread = np.eye(whole.nv) if state.S is None else state.S
    G = np.vstack((rows[robot], rows[other])) @ spread
    before = np.concatenate((own_v, other_v))
    M = np.zeros((len(G), len(G)))
    M[: robot.nv, : robot.nv], M[robot.nv :, robot.nv :] = _inertia(*own[:2]), _inertia(*held[:2])
    nu = np.linalg.solve(G.T @ M @ G, G.T @ (M @ before))
    jump = before - G @ nu
    v = spread @ nu
    momentum = _momentum(robot, own_q, own_v) + _momentum(other, other_q, other_v)
    return Capture(
        robot=whole,
        q=q,
        v=v,
        impulse=(M @ jump)[robot.nv : robot.nv + 6],
        energy_lost=0.5 * float(jump @ M @ jump),
        momentum=momentum,
        momentum_after=_momentum(whole, q, v),
    )


def _inertia(robot: Robot, q: Array) -> Array:
    still = q.copy()
    M = np.triu(pin.crba(robot.model, robot.create_data(), still))
    full: Array = M + np.triu(M, 1).T
    return full


def _momentum(robot: Robot, q: Array, v: Array) -> Array:
    """Return linear and angular momentum (6,) about the world's origin, in its axes."""
    data = robot.create_data()
    pin.computeCentroidalMomentum(robot.model, data, q, v)
    linear, angular = data.hg.linear, data.hg.angular + np.cross(data.com[0], data.hg.linear)
    return np.concatenate((linear, angular))
