"""A rigid grasp: the robot that carries its payload, and the velocities just after."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pinocchio as pin

from fflin.base.errors import InputError
from fflin.base.validation import Array, dimension, instance, vector
from fflin.base.validation import placement as checked_placement
from fflin.dynamics.impact import Impact, struck
from fflin.robot.frames import ROOT, find_frame
from fflin.robot.joined import body_alone, inertia_of, joined
from fflin.robot.robot import Robot


@dataclass(frozen=True, eq=False, repr=False)
class Capture(Impact):
    """A robot with what it has grasped, and the impact; see also `Impact`.

    Attributes
    ----------
    impulse : ndarray (6,)
        On the robot, at the payload's frame and in its axes: force [N s], then torque [N m s].
    payload : Robot
        What was grasped, as a robot; its configuration and velocity just before are
        ``payload_q`` (nq,) and ``payload_v`` (nv,).
    prefix : str
        What its frame is called in the robot that carries it.

    Examples
    --------
    >>> import pinocchio as pin
    >>> robot = fflin.load("planar_detumble")
    >>> ballast = pin.Inertia.FromSphere(5.0, 0.1)
    >>> caught = fflin.capture(robot, "hand", ballast, payload_v=[0.1, 0, 0, 0, 0, 0])
    >>> bool(abs(caught.momentum_after - caught.momentum).max() < 1e-9)
    True
    """

    payload: Robot
    payload_q: Array
    payload_v: Array
    prefix: str

    @property
    def told(self) -> str:
        """What happened and what it took, in a line."""
        force, torque = (np.linalg.norm(each) for each in np.split(self.impulse, 2))
        return (
            f"{self.event}: the grasp pulled by {force:.4g} N s and {torque:.4g} N m s; "
            f"{self.energy_lost:.4g} J were lost"
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

    Examples
    --------
    >>> import pinocchio as pin
    >>> robot = fflin.load("planar_detumble")
    >>> ball = pin.Inertia.FromSphere(5.0, 0.1)
    >>> caught = fflin.capture(robot, "hand", ball, payload_v=[0.01, 0, 0, 0, 0, 0.02])
    >>> caught.robot.n, caught.energy_lost > 0
    (3, True)
    """
    instance("robot", robot, Robot, "a fflin.Robot").require_unchanged()
    if isinstance(payload, pin.Inertia):
        alone = body_alone(inertia_of(payload), prefix)
        other = replace(alone, gravity=robot.gravity, orbit=robot.orbit)
    else:
        instance("payload", payload, Robot, "a pin.Inertia or a fflin.Robot").require_unchanged()
        other = replace(payload)  # which may be the robot's twin, the same object
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
    parts = [(robot, q, v), (other, other_q, other_v)]
    said, impulse = struck(whole, parts, prefix, f"{prefix} of {other.mass:.6g} kg caught")
    said |= {"payload": other, "payload_q": other_q, "payload_v": other_v, "prefix": prefix}
    return Capture(impulse=impulse[robot.nv : robot.nv + 6], **said)


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
