"""Job of a sweep: linear models about the points of one chunk."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from functools import cached_property, partial
from threading import Lock
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from fflin.base.errors import FflinWarning, InputError, located
from fflin.base.validation import Array
from fflin.batch.rows import Points
from fflin.batch.run import ChunkResult
from fflin.dynamics.coordinates import SMALLEST_Q0, Chart, Standing
from fflin.dynamics.rnea import AccelerationDerivatives, Inertia
from fflin.kernel.compiled import checked_engine
from fflin.kernel.tree import LANES
from fflin.linear.linearization import LARGEST, Linearizer, Prepared
from fflin.linear.state_equations import assemble, drift
from fflin.robot.robot import Robot

if TYPE_CHECKING:
    from fflin.kernel.derivatives import Mask

RowNumbers: TypeAlias = NDArray[np.integer[Any]]

# Warning filters belong to the whole process, so only one thread at a time changes them.
_TURN = Lock()


class ChunkJob:
    """Job that linearises chunks of points with `Linearizer`; `at_rest` means zero velocity."""

    def __init__(
        self, robot: Robot, *, at_rest: bool, engine: str | None = None, **options: Any
    ) -> None:
        self._again = partial(type(self), robot, at_rest=at_rest, engine=engine, **options)
        self._engine = checked_engine(engine)
        self.linearizer = Linearizer(robot, **options)
        prepared = self.linearizer.prepared
        if engine == "compiled":
            if prepared.sensing is not None:
                raise InputError(
                    "engine='compiled' is not possible, because the outputs are not the state; "
                    "leave engine out"
                )
            prepared.kernel()  # raises an error if there is none
        # If a free robot is at rest about its own reference, A and f0 are constant, so only B is
        # computed.
        self.only_inertia = at_rest and prepared.own_reference and prepared.free

    def __reduce__(self) -> tuple[Any, ...]:
        # Only the arguments are pickled, because each worker needs its own work space.
        return self._again, ()

    @cached_property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Shape per point of each array that varies between points."""
        prepared = self.linearizer.prepared
        nx, nu = prepared.map.nx, len(prepared.actuation.names)
        ny = len(prepared.common["output_names"])
        shapes: dict[str, tuple[int, ...]] = {"B_lower": (nx // 2, nu)}
        if not self.only_inertia:
            shapes |= {"A": (nx, nx), "f0": (nx,), "_x0": (nx,)}
            if prepared.moving:
                shapes["_drift"] = (nx,)
            if prepared.sensing is not None:
                shapes |= {"C": (ny, nx), "D": (ny, nu), "_y0": (ny,)}
        return shapes

    def run(
        self, points: Points, start: int, out: Mapping[str, Array] | None = None
    ) -> ChunkResult:
        """Linearise about the points of a chunk; see `Job`."""
        count = len(points.q)
        if out is None:
            out = {key: np.empty((count, *shape)) for key, shape in self.shapes.items()}
        left = self.compiled.write(points, out) if self.compiled else np.arange(count)
        if not len(left):
            return ChunkResult(dict(out), [])
        with _TURN, warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", FflinWarning)
            for row in left.tolist():
                with located(f"configuration {start + row}"):
                    if self.only_inertia:
                        self._write_at_rest(points.q[row], out["B_lower"][row])
                    else:
                        self._write(row, points, out)
        return ChunkResult(dict(out), [str(note.message) for note in caught])

    def _write(self, row: int, points: Points, out: Mapping[str, Array]) -> None:
        lin = self.linearizer(*points.each(lambda rows: rows[row]))
        for key, array in out.items():
            lower = key == "B_lower"
            array[row] = lin.B[len(lin.B) // 2 :] if lower else getattr(lin, key.removeprefix("_"))

    def _write_at_rest(self, q: Array, B_lower: Array) -> None:
        (inertia, data), actuation = self._inertia, self.linearizer.prepared.actuation
        nv = len(B_lower)
        inverse = B_lower if actuation.default else np.empty((nv, nv))
        inertia.invert(q, inverse)
        if actuation.default:
            return
        # The columns do not depend on the base position, so the base is moved to the origin to
        # avoid rounding errors.
        base_centred = q.copy()
        base_centred[:3] = 0.0
        np.matmul(inverse, actuation.columns(data, base_centred), out=B_lower)

    @cached_property
    def compiled(self) -> BatchEquations | None:
        """Compiled equations for many points at once, or None if the robot cannot be compiled."""
        prepared = self.linearizer.prepared
        if self._engine == "python" or prepared.sensing is not None or prepared.not_compilable:
            return None
        return BatchEquations(prepared, only_inertia=self.only_inertia)

    @cached_property
    def _inertia(self) -> tuple[Inertia, pin.Data]:
        data = self.linearizer.robot.create_data()
        return Inertia(self.linearizer.prepared.map, data), data


class BatchEquations:
    """Compiled equations for the arrays of linear models that vary between points."""

    def __init__(self, prepared: Prepared, *, only_inertia: bool) -> None:
        self._prepared, self._only_inertia = prepared, only_inertia
        self._kernel = prepared.kernel()

    def write(self, points: Points, out: Mapping[str, Array]) -> RowNumbers:
        """Write the arrays that vary between points, and return the rows that were not computed."""
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
        """Write A, B, f0 and x0 about any points, and return which rows are valid."""
        ready, (q, v, u), A, B = self._prepared, points, out["A"], out["B_lower"]
        state, actuation, count = ready.map, ready.actuation, len(q)
        own = ready.own_reference
        chart: Chart = Standing(count) if own else state.charts(q)
        v = np.zeros((count, state.robot.nv)) if v is None else v
        no_inputs: Array = np.zeros((count, len(actuation.names)))
        u = no_inputs if u is None else actuation.in_base_axes(chart, u)
        r_b: Array = np.zeros((count, 3)) if own else state.positions(q)
        nu, q_m = state.velocities(v), state.joint_positions(q)
        nv = nu.shape[1]
        A[:, :nv] = ready.rest["A"][:nv]
        c, judged = self._kernel.write(q, nu, q_m, u, A, B)
        rates = AccelerationDerivatives(c, A[:, nv:], B, state.gravity(q))
        f0 = assemble(state, actuation, chart, nu, u, rates, A, moving=ready.moving)
        out["_x0"][:] = state.compose(chart, r_b, q_m, nu)
        out["f0"][:] = 0.0 if ready.moving else f0
        if ready.moving:
            out["_drift"][:] = drift(state, f0, rates.gravity)
        # Comparisons with NaN are false, so rows with NaN are not valid. The upper half of A is not
        # checked, because it is finite if q0 and f0 are valid.
        good = self._kernel.sound(q, judged) & (np.asarray(chart.q0) >= SMALLEST_Q0).ravel()
        for rows in (A.reshape(count, -1)[:, A[0].size // 2 :], B.reshape(count, -1), f0):
            good &= np.vecdot(rows, rows) < LARGEST
        return good


def _filled(rows: Array) -> Array:
    """Fill rows up to the number of SIMD lanes by repeating the last row."""
    return np.pad(rows, ((0, LANES - len(rows)), (0, 0)), mode="edge")
