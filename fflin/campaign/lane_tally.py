"""A tally of eight runs side by side, which compiled code keeps."""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import copy
from typing import Any

import numpy as np
import pinocchio as pin

from fflin.base.rotation import conjugate, quaternion_product
from fflin.base.validation import Array
from fflin.campaign.tally import KINDS, Tally
from fflin.dynamics.state import StateMap
from fflin.kernel.accelerations import work_space
from fflin.kernel.compiled import kernel
from fflin.kernel.forward import Point
from fflin.kernel.tally import Marks
from fflin.kernel.tree import LANES
from fflin.simulation.plan import Plan
from fflin.simulation.report import SETTLED, THERE


class LaneTally(Tally):
    """A `Tally` of eight; `way` has the q and nu of the rows of `home`, where it has rows."""

    def __init__(
        self, plan: Plan, state: StateMap, home: Array, steps: Array, way: list[Array]
    ) -> None:
        super().__init__(plan, state, home, LANES, steps)
        robot, nx, none, joints = state.robot, state.nx, np.zeros(0), state.robot.joints
        kind = np.zeros(nx, dtype=np.intp)
        for number, part in enumerate(self._parts, 1):
            kind[part] = number
        kind[self._spun] = -1
        x, y, z = self._home[:3].tolist()
        attitude = np.array((x, y, z, math.sqrt(max(0.0, 1.0 - x * x - y * y - z * z))))
        attitude = quaternion_product(conjugate(state.origin_quaternion), attitude)
        there = np.concatenate((np.zeros(3), attitude, np.zeros(robot.nq - 7)))
        sizes = [robot.nq, nx // 2, nx, nx, len(KINDS), nx, len(plan.initial)]
        sizes += [len(KINDS)] * 2 + [len(steps) * of for of in (len(KINDS), len(plan.initial))]
        fields: list[Any] = [
            np.array([joint.idx_q for joint in joints], dtype=np.intp),
            np.array([joint.unbounded for joint in joints], dtype=bool),
            pin.SE3ToXYZQUAT(state.origin),
            np.array(state.axes),
            self._home[state.groups.q_m].copy(),
            self._home.copy(),
            *(way or (none, none)),
            *(kind, SETTLED, np.full(len(KINDS), THERE), steps.astype(np.intp)),
            Point(there, np.zeros(nx // 2), none, none, none),
            *[None] * 10,
        ]
        self._marks = Marks._make(fields)
        ends = np.cumsum(sizes).tolist()
        self._rows = [slice(end - size, end) for end, size in zip(ends, sizes, strict=True)]
        self._keep(np.zeros((sum(sizes), LANES)))
        self.outside[:], self.error_history[:] = -1.0, np.inf

    def _keep(self, values: Array) -> None:
        """Keep the marks in a space of their own, with these values."""
        self._space = space = work_space(len(values))
        space[:] = values
        q, nu, *marks = (space[part] for part in self._rows)
        at = Point(q, nu, *[self._marks.home] * 3)
        self._marks = self._marks._replace(
            at=at, **dict(zip(Marks._fields[-9:], marks, strict=True))
        )
        self.largest_x, self.largest_u, self.largest, self.outside = (x.T for x in marks[3:7])
        self.error_history, self.input_history = (
            x.reshape(len(self.steps), each, LANES).transpose(2, 0, 1)
            for x, each in zip(marks[7:], (len(KINDS), len(marks[4])), strict=True)
        )

    def copy(self) -> LaneTally:
        """Return one that goes its own way from here on."""
        other = copy(self)
        other._keep(self._space)
        return other

    def add(self, first: int, rows: Sequence[Array], raw: Any = None) -> LaneTally:
        """Take rows (steps, LANES, ..) from a step on into account, and `raw` as they came."""
        kernel("tally", "take", "statistics of eight runs")(self._marks, raw, first, len(rows[0]))
        self._last = *(each[-1] for each in rows[:3]), self._marks.x.T, self._marks.sizes.T
        return self
