"""How long a run has to be for its loop to settle."""

from __future__ import annotations

import math

import numpy as np

from fflin.base.validation import Array
from fflin.control.policies import StateFeedback, fed_back
from fflin.dynamics.state import StateMap
from fflin.linear.sampling import held_exponential
from fflin.robot.robot import Robot

# Of a run whose duration is not given [s], and between looks at the linear loop.
SHORTEST, LONGEST, _LOOK = 60.0, 600.0, 0.5


def time_to_settle(robot: Robot, policy: StateFeedback, q: Array, v: Array | None) -> float:
    """Return when [s] the linear loop stays within 1 % of each error; in tens of seconds."""
    lin = policy.lin
    state = StateMap(robot, reference=lin.reference, frame=lin.frame)
    start = state.read(q, np.zeros(robot.nv) if v is None else v, near=state.read(lin.q, lin.v))
    e = start[[state.names.index(name) for name in lin.state_names]] - lin.x0
    step = lin.dt or _LOOK
    loop: Array = lin.A - lin.B @ policy.K
    if not lin.dt:
        loop = held_exponential(loop, np.zeros((len(loop), 0)), step)[0]
    places = [f"q_m.{name}" for name in robot.joint_names if name not in robot.wheels]
    kinds = [[f"{group}.{axis}" for axis in "xyz"] for group in ("q_b", "r_b")] + [places]
    fed = {*fed_back(policy)}
    rows = [[i for i, name in enumerate(lin.state_names) if name in fed & {*k}] for k in kinds]
    course = [e]
    for _ in range(math.ceil(LONGEST / step)):
        course.append(loop @ course[-1])
    errors = np.array([np.abs(np.array(course)[:, of]).max(axis=1, initial=0.0) for of in rows])
    away = (errors > 0.01 * errors.max(axis=1, keepdims=True)).any(axis=0)
    last = float(np.flatnonzero(away).max(initial=0)) * step
    return max(SHORTEST, 10.0 * math.ceil(last / 10.0)) if last < 0.99 * LONGEST else SHORTEST
