"""Rigid grasp of a payload: the combined robot, and its velocities just after the impact."""

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
    """Robot with a grasped payload, and the impact of the grasp; see also `Impact`.

    Attributes
    ----------
    impulse : ndarray (6,)
        Impulse on the robot, about the origin of the payload's frame and in its axes: linear [N s],
        then angular [N m s].
    payload : Robot
        The grasped payload as a robot. Its configuration and velocity just before the impact are
        ``payload_q`` (nq,) and ``payload_v`` (nv,).
    prefix : str
        Name of the payload's frame in the combined robot.

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
        """Event, impulse and lost energy, in one line."""
        force, torque = (np.linalg.norm(each) for each in np.split(self.impulse, 2))
        return (
            f"{self.event}: impulse at the grasp {force:.4g} N s and {torque:.4g} N m s, "
            f"{self.energy_lost:.4g} J lost"
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
    r"""Grasp a payload rigidly, instantly and permanently.

    The joints are free during the impact, because motors give only finite torques. The velocity
    just after the impact solves :math:`M_+ \nu_+ = G^T \mathrm{diag}(M, M_p) (\nu_-, V_p)`. Here G
    is the Jacobian of the velocities of robot and payload with respect to the velocity of the
    combined robot. The solution is the M-orthogonal projection onto the motions that the weld
    allows. It conserves linear and angular momentum.

    Parameters
    ----------
    robot : Robot
    frame : str
        Name of the grasping frame.
    payload : pin.Inertia or Robot
        A rigid body, in its own frame, or a robot, grasped at its base. The joints of a payload
        robot keep their springs and dampers and lose their motors.
    q, v : array_like (nq,), (nv,), optional
        Configuration and velocity of the robot just before the impact; neutral and at rest by
        default.
    placement : pin.SE3, optional
        Placement of the payload's frame in the grasping frame; the identity by default.
    payload_q : array_like (nq,), optional
        Configuration of a payload with joints, neutral by default. Its base pose is ignored.
    payload_v : array_like (6,) or (nv,), optional
        Twist of the payload's frame in its own axes (Pinocchio's LOCAL), linear [m/s], then
        angular [rad/s], followed by the joint rates; at rest by default.
    prefix : str
        Name of the payload's frame. The payload's joints and links are named PREFIX.NAME.

    Returns
    -------
    Capture

    Raises
    ------
    UnknownNameError
        If there is no such frame.
    InputError
        If one of these holds:

        - a size or value is wrong;
        - the payload's inertia is not physically realisable;
        - the robot already has names with this prefix;
        - robot and payload have different gravity or orbits;
        - a wheel of the payload has momentum but no inertia.
    ModelError
        If a robot was changed after it was made.

    References
    ----------
    Y. Umetani and K. Yoshida, IEEE Trans. Robotics and Automation 5(3), 1989, for free joints. The
    impact is the perfectly inelastic collision of two bodies.

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
            raise InputError(
                f"the robot's {field} is {own}, but the payload's is {theirs}; give both the same "
                f"{field}"
            )
    if other.stored_momentum:
        raise InputError(
            "a wheel of the payload has momentum but no inertia, so its momentum would be lost; "
            "give the wheel an inertia, and its speed in payload_v"
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
