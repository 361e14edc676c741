"""Run statistics of eight parallel runs, updated by compiled code."""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import copy
from typing import Any

import numpy as np

from fflin.base.rotation import conjugate, quaternion_product
from fflin.base.validation import Array
from fflin.campaign.tally import KINDS, Tally
from fflin.kernel.accelerations import work_space
from fflin.kernel.arguments import LANED, empty, laid_out, words_of
from fflin.kernel.compiled import kernel
from fflin.kernel.tally import MARKS, Marks
from fflin.kernel.tree import LANES, batch_tree
from fflin.simulation.packing import mechanics_of, no_law
from fflin.simulation.plan import Plan
from fflin.simulation.plant import Plant
from fflin.simulation.report import SETTLED, THERE

_FIRST = Marks._fields.index("sizes")  # of what changes


class LaneTally(Tally):
    """A `Tally` of eight; `way` has the q and nu of the rows of `home`, where it has rows."""

    def __init__(
        self, plan: Plan, plant: Plant, home: Array, steps: Array, way: list[Array]
    ) -> None:
        state, tree = plant.state, batch_tree(plant.robot)
        assert tree is not None
        super().__init__(plan, state, home, LANES, steps)
        kind = np.zeros(state.nx, dtype=np.intp)
        for number, part in enumerate(self._parts, 1):
            kind[part] = number
        kind[self._spun] = -1
        x, y, z = self._home[:3].tolist()
        attitude = np.array((x, y, z, math.sqrt(max(0.0, 1.0 - x * x - y * y - z * z))))
        attitude = quaternion_product(conjugate(state.origin_quaternion), attitude)
        law, kinds = no_law(state, plan.initial), len(KINDS)
        law.path.point.q[3:7] = attitude
        marks, none = empty(MARKS), np.zeros(0)
        fields = marks._replace(
            robot=mechanics_of(plant, tree),
            law=law._replace(near=self._home[state.groups.q_m]),
            path=law.path,
            home=self._home,
            **dict(zip(("way", "speed"), way or (none, none), strict=True)),
            kind=kind,
            settled=SETTLED,
            there=np.full(kinds, THERE),
            steps=steps,
            at=marks.at._replace(q=np.zeros(state.robot.nq), nu=np.zeros(state.nx // 2)),
            sizes=np.zeros(kinds),
            largest_x=np.zeros(state.nx),
            largest_u=np.zeros(len(plan.initial)),
            largest=np.zeros(kinds),
            outside=np.full(kinds, -1.0),
            errors=np.full(len(steps) * kinds, np.inf),
            inputs=np.zeros(len(steps) * len(plan.initial)),
        )
        # What changes from here on comes last.
        self._marks = laid_out(fields, MARKS)
        self._shared = words_of(self._marks, MARKS)[: MARKS.places[Marks._fields[_FIRST]]]
        self._keep(self._marks[_FIRST:])

    def _keep(self, values: Sequence[Array]) -> None:
        """Keep the marks in arrays of their own, with these values."""
        names = Marks._fields[_FIRST:]
        own = [work_space(len(each)) for each in values]
        for array, each in zip(own, values, strict=True):
            array[:] = each
        self._marks = marks = self._marks._replace(**dict(zip(names, own, strict=True)))
        words = [word for each in own for word in words_of(each, LANED)]
        self._words = np.array([*self._shared, *words], dtype=np.int64)
        self.largest_x, self.largest_u, self.largest, self.outside = (
            each.T for each in (marks.largest_x, marks.largest_u, marks.largest, marks.outside)
        )
        self.error_history, self.input_history = (
            each.reshape(len(self.steps), size, LANES).transpose(2, 0, 1)
            for each, size in ((marks.errors, len(KINDS)), (marks.inputs, len(marks.largest_u)))
        )

    def copy(self) -> LaneTally:
        """Return one that goes its own way from here on."""
        other = copy(self)
        other._keep(self._marks[_FIRST:])
        return other

    def add(self, first: int, rows: Sequence[Array], raw: Any = None) -> LaneTally:
        """Take rows (steps, LANES, ..) from a step on into account, and `raw` as they came."""
        take = kernel("tally", "take", "the run statistics")
        take(self._words, raw, first, len(rows[0]))
        self._last = *(each[-1] for each in rows[:3]), self._marks.law.x.T, self._marks.sizes.T
        return self
