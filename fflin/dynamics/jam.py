"""A joint that jams: the robot whose joint stands still, and the velocities just after."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fflin.base.errors import InputError
from fflin.base.validation import Array
from fflin.dynamics.impact import Impact, struck
from fflin.dynamics.state import StateMap
from fflin.robot.joints import by_joint
from fflin.robot.locking import welded
from fflin.robot.robot import Robot


def jam(
    robot: Robot,
    joints: str | Sequence[str],
    *,
    q: Array | None = None,
    v: Array | None = None,
) -> Impact:
    r"""Stop joints or wheels at once and for good, where they are.

    The other joints are free during the impact: :math:`M_+ \nu_+ = G^T M \nu`, (13.1) with G of
    the robot whose joints stand still. Both momenta are kept. A joint whose motor fails and that
    goes on freely is ``robot.replace(passive=[joint])``, without an impact.

    Parameters
    ----------
    robot : Robot
    joints : str or sequence of str
        Names or patterns; what mimics a joint stops with it.
    q, v : array_like, optional
        Just before; neutral and at rest by default.

    Returns
    -------
    Impact
        Its robot has these joints welded and is without their inputs.

    Raises
    ------
    UnknownNameError
        If there is no such joint.
    InputError
        If a size or value is wrong, or no joint or no input is left to name.
    ModelError
        If the robot was changed after it was made.
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
