"""Latches: constraints that close in motion, and the new velocities."""

from collections.abc import Sequence

import numpy as np

from fflin.base.errors import InputError
from fflin.base.validation import Array, instance
from fflin.dynamics.closure import Closure
from fflin.dynamics.impact import (
    Impact,
    impulses_of,
    inertia_at,
    momentum_of,
    state_before,
)
from fflin.dynamics.state import StateMap
from fflin.robot.constraints import Constraint, Weld, checked_constraints
from fflin.robot.robot import Robot

# Unit of each component of the impulse on a constraint's frame.
_UNITS = ("N s",) * 3 + ("N m s",) * 3


def latch(
    robot: Robot,
    constraints: Constraint | Sequence[Constraint],
    *,
    q: Array | None = None,
    v: Array | None = None,
) -> Impact:
    r"""Close constraints in motion, instantly: a second grasp, a latch or a berthing.

    The joints are free during the impact. The velocity just after the impact is the velocity that
    all constraints permit and that is nearest to the velocity before, in kinetic energy:

    .. math:: \nu_+ = \nu - M^{-1} J^T (J M^{-1} J^T)^+ J \nu

    If the constraints connect frames of the robot, linear and angular momentum are conserved. If
    one of them holds a frame in inertial space, its impulse changes the momentum.

    To open constraints again, simulate the robot without them from the last row of a motion, with
    ``robot.replace(constraints=[])``, and join both motions by `Motion.then`.

    Parameters
    ----------
    robot : Robot
        Robot before the impact. Its own constraints remain closed.
    constraints : Weld, Hinge, Spherical, or a sequence of them
        Constraints that close. A constraint without a placement holds its frames in the pose that
        they have at q.
    q, v : array_like (nq,), (nv,), optional
        Configuration and velocity just before the impact; neutral and at rest by default. With a
        placement, the frames must be within 1e-6 m and rad of it.

    Returns
    -------
    Impact
        Result of the impact. `Impact.robot` has all constraints. `Impact.impulse` contains, for
        each closed constraint, the impulse on its `frame`: linear (3,) [N s], then angular (3,)
        [N m s], in the axes of its placement. If constraints are redundant, it is the smallest one.

    Raises
    ------
    ConstraintError
        If the frames are too far from the placement, or the constraints of the robot are violated.
    InputError
        If an argument has a wrong size or value, no constraint is given, or a `Weld` of the robot
        already holds the frames of a given constraint.

    Examples
    --------
    >>> robot = fflin.load("dual_arm")
    >>> spin = fflin.velocity(robot, {"left_1": 0.1})
    >>> latched = fflin.latch(robot, fflin.Weld("tool_left", "tool_right"), v=spin)
    >>> bool(abs(latched.momentum_after - latched.momentum).max() < 1e-12)
    True
    >>> latched.event, latched.energy_lost > 0
    ('tool_left/tool_right latched', True)
    """
    instance("robot", robot, Robot, "a fflin.Robot").require_unchanged()
    closing = checked_constraints(constraints)
    if not closing:
        raise InputError(
            "no constraint is given, expected Weld, Hinge or Spherical objects that close"
        )
    for item in closing:
        _require_open(robot, item)
    q, v = state_before(robot, q, v)
    before = (robot, q, v)
    whole = robot.replace(constraints=[*robot.constraints, *closing], independent=[])
    closure = Closure(StateMap(whole))
    q = closure.configuration(q)
    after, forces = closure.after_impact(q, v)
    impulses = impulses_of(closure, forces)[-len(closing) :]
    titles = ", ".join(item.title for item in closing)
    jump = v - after
    return Impact(
        robot=whole,
        q=q,
        v=after,
        impulse=np.concatenate(impulses),
        energy_lost=0.5 * float(jump @ inertia_at(whole, q) @ jump),
        momentum=momentum_of(*before),
        momentum_after=momentum_of(whole, q, after),
        event=f"{titles} latched",
        _before=before,
        _units=_UNITS * len(closing),
    )


def _require_open(robot: Robot, constraint: Constraint) -> None:
    """Raise `InputError` if the robot already welds the frames of a constraint."""
    frames = {constraint.frame, constraint.to}
    for weld in robot.constraints:
        if isinstance(weld, Weld) and {weld.frame, weld.to} == frames:
            to = "inertial space" if constraint.to is None else f"'{constraint.to}'"
            raise InputError(
                f"'{constraint.frame}' is already welded to {to} by the constraint "
                f"'{weld.title}' of the robot; leave out this constraint"
            )
