"""Job of a sweep's workers: linear models about the points of one chunk."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from functools import cached_property, partial
from threading import Lock
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin

from fflin.base.errors import FflinError, FflinWarning, InputError
from fflin.base.validation import Array
from fflin.batch.dispatch import ChunkResult
from fflin.batch.rows import Points
from fflin.dynamics.inertia import Inertia
from fflin.kernel.compiled import checked_engine
from fflin.linear.linearization import Linearizer
from fflin.robot.robot import Robot

if TYPE_CHECKING:
    from fflin.batch.equations import BatchEquations


# Python has one set of warning filters for the whole process, so that threads take turns.
_TURN = Lock()


class ChunkJob:
    """Linearises chunks of points, `at_rest` all, as `Linearizer` does."""

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
                    "engine='compiled' cannot run this: sweeps of other outputs than the state go "
                    "point by point; leave it out"
                )
            prepared.kernel()  # which says where there is none
        # There every field of a model but B is known without computing it.
        self.only_inertia = at_rest and prepared.own_reference and prepared.free

    def __reduce__(self) -> tuple[Any, ...]:
        # A worker makes a work space of its own.
        return self._again, ()

    @cached_property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Shape of each array that differs from point to point, for one point."""
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
        if self.only_inertia and not self.linearizer.robot.n and count > 1:
            # Without joints M is the same everywhere.
            one = self.run(Points(points.q[:1], None, None), start)
            out["B_lower"][:] = one.arrays["B_lower"]
            return ChunkResult(dict(out), one.notes)
        left = self.compiled.write(points, out) if self.compiled else np.arange(count)
        if not len(left):
            return ChunkResult(dict(out), [])
        with _TURN, warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", FflinWarning)
            for row in left.tolist():
                try:
                    if self.only_inertia:
                        self._write_at_rest(points.q[row], out["B_lower"][row])
                    else:
                        self._write(row, points, out)
                except FflinError as error:
                    raise type(error)(f"configuration {start + row}: {error}") from None
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
        # The columns do not depend on the base's position, and would lose digits to it.
        still = q.copy()
        still[:3] = 0.0
        np.matmul(inverse, actuation.columns(data, still), out=B_lower)

    @cached_property
    def compiled(self) -> BatchEquations | None:
        """The kernel's equations, unless it does not know the robot; threads do them together."""
        prepared = self.linearizer.prepared
        if self._engine == "python" or prepared.sensing is not None or prepared.not_compilable:
            return None
        from fflin.batch.equations import BatchEquations

        return BatchEquations(prepared, only_inertia=self.only_inertia)

    @cached_property
    def _inertia(self) -> tuple[Inertia, pin.Data]:
        data = self.linearizer.robot.create_data()
        return Inertia(self.linearizer.prepared.map, data), data
