"""The part of a sweep that a worker does: the models about the points of one chunk."""

from __future__ import annotations

import hashlib
import pickle
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import cached_property
from threading import Lock
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pinocchio as pin

from fflin.base.errors import FflinError, FflinWarning
from fflin.base.validation import Array
from fflin.batch.inertia import BatchInertia, Rows
from fflin.kernel.compiled import pays
from fflin.linear.linearization import Linearizer
from fflin.robot.robot import Robot

if TYPE_CHECKING:
    from fflin.batch.equations import BatchEquations
    from fflin.dynamics.state import Frame


# Of a linear model, by the names that a batch has for them.
_ATTRIBUTES = {"_x0": "x0", "_y0": "y0"}


class Points(NamedTuple):
    """Points of one chunk, checked; v and u (rows, ..) or None for rest and no input."""

    q: Array
    v: Array | None
    u: Array | None


class Chunk(NamedTuple):
    """What a chunk came to: its arrays by name, and what was warned of."""

    arrays: dict[str, Array]
    notes: list[str]


class ChunkJob:
    """Linearises chunks; is sent to every worker once.

    Parameters
    ----------
    robot : Robot
    frame, reference, moving : optional
        As `Linearizer` takes them.
    at_rest : bool
        Whether all points have neither velocity nor input.
    count : int
        Points of all chunks.
    """

    def __init__(
        self,
        robot: Robot,
        *,
        frame: Frame | None,
        reference: pin.SE3 | None,
        moving: bool,
        at_rest: bool,
        count: int,
    ) -> None:
        self._arguments = (robot, frame, reference, moving, at_rest, count)
        self._count = count
        self.linearizer = Linearizer(robot, frame=frame, reference=reference, moving=moving)
        # There all but M^-1 is known beforehand.
        self.only_inertia = at_rest and reference is None and self.linearizer.prepared.free

    def __reduce__(self) -> tuple[Any, ...]:
        return _rebuilt, self._arguments

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

    def run(self, points: Points, start: int, out: Mapping[str, Array] | None = None) -> Chunk:
        """Linearise about the points of a chunk; threads may share a job.

        Parameters
        ----------
        points : Points
        start : int
            Number of its first point, for messages.
        out : mapping, optional
            Arrays to write to; new ones by default.

        Raises
        ------
        FflinError
            If there is no model about one of them; the message names it.
        """
        if out is None:
            out = {key: np.empty((len(points.q), *shape)) for key, shape in self.shapes.items()}
        if self.only_inertia:
            return Chunk(dict(out), self._at_rest(points.q, start, out["B_lower"]))
        return Chunk(dict(out), self._anywhere(points, start, out))

    def _at_rest(self, q: Array, start: int, out: Array) -> list[str]:
        actuation, nv = self.linearizer.prepared.actuation, 6 + self.linearizer.robot.n
        inverse = out
        if not actuation.default:
            inverse = np.empty((len(q), nv, nv))
        # Without joints M is the same everywhere.
        rigid = not self.linearizer.robot.n
        left: Rows = np.arange(1) if rigid else self._inertia.compiled(q, inverse)
        notes: list[warnings.WarningMessage] = []
        if len(left):
            try:
                with _caught() as notes:
                    self._inertia.loop(q, inverse, left)
            except FflinError as error:
                raise _renumbered(error, start) from None
        if rigid:
            inverse[1:] = inverse[0]
        if inverse is not out and not actuation.carried:
            np.matmul(inverse, actuation.fixed, out=out)
        elif inverse is not out:
            data = self.linearizer.robot.create_data()
            for row, point in enumerate(q):
                # What pushes depends on no base position, and would lose digits to it.
                still = point.copy()
                still[:3] = 0.0
                np.matmul(inverse[row], actuation.columns(data, still), out=out[row])
        return [str(note.message) for note in notes]

    def _anywhere(self, points: Points, start: int, out: Mapping[str, Array]) -> list[str]:
        nv = 6 + self.linearizer.robot.n
        left: Rows = np.arange(len(points.q))
        if self._equations is not None:
            left = self._equations.write(*points, out)
        if not len(left):
            return []
        with _caught() as notes:
            for row in left.tolist():
                q, v, u = (None if rows is None else rows[row] for rows in points)
                try:
                    lin = self.linearizer(q, v, u)
                except FflinError as error:
                    raise type(error)(f"configuration {start + row}: {error}") from None
                for key, array in out.items():
                    array[row] = (
                        lin.B[nv:] if key == "B_lower" else getattr(lin, _ATTRIBUTES.get(key, key))
                    )
        return [str(note.message) for note in notes]

    @property
    def parallel(self) -> bool:
        """Whether threads do chunks at the same time."""
        return self.only_inertia or self._equations is not None

    @cached_property
    def _equations(self) -> BatchEquations | None:
        from fflin.batch.equations import BatchEquations

        if not (pays(self._count) and BatchEquations.possible(self.linearizer)):
            return None
        return BatchEquations(self.linearizer)

    @cached_property
    def _inertia(self) -> BatchInertia:
        return BatchInertia(self.linearizer.robot, compiled=pays(self._count))


# Python's filters of warnings are the whole process's, so that threads take turns.
_TURN = Lock()


@contextmanager
def _caught() -> Iterator[list[warnings.WarningMessage]]:
    """Collect what is warned of."""
    with _TURN, warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", FflinWarning)
        yield caught


def _renumbered(error: FflinError, start: int) -> FflinError:
    number, _, rest = str(error).removeprefix("configuration ").partition(":")
    return type(error)(f"configuration {start + int(number)}:{rest}")


def _rebuilt(
    robot: Robot,
    frame: Frame | None,
    reference: pin.SE3 | None,
    moving: bool,
    at_rest: bool,
    count: int,
) -> ChunkJob:
    return ChunkJob(
        robot, frame=frame, reference=reference, moving=moving, at_rest=at_rest, count=count
    )


class Parcel(NamedTuple):
    """A job as it is sent: under a key, and its content only where a worker may not have it."""

    key: str
    content: bytes | None


def packed(job: ChunkJob) -> Parcel:
    """Return a job as it is sent."""
    content = pickle.dumps(job)
    return Parcel(hashlib.sha256(content).hexdigest(), content)


# What this worker was sent; the least recent goes first.
_JOBS: dict[str, ChunkJob] = {}
_KEPT = 4


def work(parcel: Parcel, points: Points, start: int) -> Chunk | None:
    """Do a chunk in a worker, or return None where the worker does not have the job."""
    job = _JOBS.get(parcel.key)
    if job is None:
        if parcel.content is None:
            return None
        job = pickle.loads(parcel.content)
        while len(_JOBS) >= _KEPT:
            _JOBS.pop(next(iter(_JOBS)), None)
        _JOBS[parcel.key] = job
    return job.run(points, start)
