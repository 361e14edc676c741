"""Linear models about many points at once, with accelerations by the compiled kernel."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from fflin.base.validation import Array
from fflin.batch.rows import Points
from fflin.dynamics.chart import SMALLEST_Q0, Chart, Standing
from fflin.dynamics.rnea import Rates
from fflin.kernel.accelerations import Mask
from fflin.kernel.tree import LANES
from fflin.linear.prepared import LARGEST, Prepared
from fflin.linear.state_equations import assemble, drift

RowNumbers: TypeAlias = NDArray[np.integer[Any]]


class BatchEquations:
    """Equations of a robot's linear models about many points, for the arrays that vary."""

    def __init__(self, prepared: Prepared, *, only_inertia: bool) -> None:
        self._prepared, self._only_inertia = prepared, only_inertia
        self._kernel = prepared.kernel()

    def write(self, points: Points, out: Mapping[str, Array]) -> RowNumbers:
        """Write the arrays that vary between points, and return the rows not computed."""
        count = len(points.q)
        if count < LANES:
            more = {key: np.empty((LANES, *array.shape[1:])) for key, array in out.items()}
            left = self.write(points.each(_filled), more)
            for key, array in out.items():
                array[:] = more[key][:count]
            return left[left < count]
        with np.errstate(all="ignore"):
            if self._only_inertia:
                judged = self._kernel.write_inverse(points.q, out["B_lower"])
                return np.flatnonzero(~self._kernel.sound(points.q, judged))
            return np.flatnonzero(~self._anywhere(points, out))

    def _anywhere(self, points: Points, out: Mapping[str, Array]) -> Mask:
        """Write A, B, f0 and x0 about any points, and return where they are sound."""
        ready, (q, v, u), A, B = self._prepared, points, out["A"], out["B_lower"]
        state, actuation, count = ready.map, ready.actuation, len(q)
        v = np.zeros((count, state.robot.nv)) if v is None else v
        u = np.zeros((count, len(actuation.names))) if u is None else u
        own = ready.own_reference
        chart: Chart = Standing(count) if own else state.charts(q)
        r_b: Array = np.zeros((count, 3)) if own else state.positions(q)
        nu, q_m = state.velocities(v), state.joint_positions(q)
        u = actuation.in_base_axes(chart, u)
        nv = nu.shape[1]
        A[:, :nv] = ready.rest["A"][:nv]
        c, judged = self._kernel.write(q, nu, q_m, u, A, B)
        rates = Rates(c, A[:, nv:], B, state.gravity(q))
        f0 = assemble(state, actuation, chart, nu, u, rates, A, moving=ready.moving)
        out["_x0"][:] = state.compose(chart, r_b, q_m, nu)
        out["f0"][:] = 0.0 if ready.moving else f0
        if ready.moving:
            out["_drift"][:] = drift(state, f0, rates.gravity)
        # NaN compares false.
        good = self._kernel.sound(q, judged) & (np.asarray(chart.q0) >= SMALLEST_Q0).ravel()
        for array in (A, B, f0):
            flat = array.reshape(count, -1)
            good &= np.vecdot(flat, flat) < LARGEST
        return good


def _filled(rows: Array) -> Array:
    """Return as many rows as lanes, the last of them repeated."""
    return np.pad(rows, ((0, LANES - len(rows)), (0, 0)), mode="edge")
