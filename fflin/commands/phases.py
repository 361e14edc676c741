"""Phases on the command line: a simulation that starts at the end of a saved motion."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

import fflin
from fflin.base.validation import Array
from fflin.dynamics.constraints import Constraints
from fflin.dynamics.impact import Impact
from fflin.dynamics.state import StateMap
from fflin.linear.fit import require_same

# Largest rate [m/s or rad/s] of the frames of a constraint that is already closed.
_CLOSED = 1e-9


class PhaseStart(NamedTuple):
    """Start of a phase: q (nq,), v (nv,), and the impact of closing constraints, or None."""

    q: Array
    v: Array
    impact: Impact | None


def start_after(robot: fflin.Robot, path: Path) -> PhaseStart:
    """Return the start of a phase of a robot at the end of the motion in a file.

    If the frames of a constraint move relative to each other at this time, all constraints of the
    robot close in an impact, as in `latch`. Constraints without a placement hold their frames in
    the pose that they have at this time.
    """
    q, v = last_state(robot, path)
    if not robot.constraints:
        return PhaseStart(q, v, None)
    rows = Constraints(robot)
    rows.settle(q)
    if np.abs(rows.jacobian(q) @ v).max() <= _CLOSED:
        return PhaseStart(q, v, None)
    free = robot.replace(constraints=[], independent=[])
    impact = fflin.latch(free, robot.constraints, q=q, v=v)
    return PhaseStart(impact.q, impact.v, impact)


def last_state(robot: fflin.Robot, path: Path) -> tuple[Array, Array]:
    """Return q (nq,) and v (nv,) in the last row of the motion in a file, for a robot."""
    motion = fflin.Motion.load(path)
    made = f"{path} was made for '{motion.robot}'"
    names, units = motion.state_names, motion.state_units
    require_same(made, StateMap(robot), "state", names, units)
    return motion.q[-1], motion.v[-1]
