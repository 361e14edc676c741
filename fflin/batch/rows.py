"""Arrays with one configuration, velocity or input per row: joint values and checks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np

from fflin.base.errors import InputError, located
from fflin.base.validation import NORM_TOLERANCE, Array, as_double, dimension, vector
from fflin.robot.joints import ROUND_OFF, Joint
from fflin.robot.robot import Robot

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

# Two indices of a joint in q, and a factor. A continuous joint has the indices of (cos, sin); any
# other joint has -1 as its second index. The factor is the entry of q for a joint value of 1.
Column: TypeAlias = tuple[int, int, float]

# Number of rows that are checked together, which limits the memory for intermediate results.
_BLOCK = 2048


class Points(NamedTuple):
    """Valid configurations, velocities and inputs; v None means rest, u0 None means zero."""

    q: Array
    v: Array | None
    u0: Array | None

    def each(self, change: Callable[[Array], Array]) -> Points:
        """Return the points with a function applied to each array."""
        v, u0 = (None if rows is None else change(rows) for rows in self[1:])
        return Points(change(self.q), v, u0)


def column(joint: Joint) -> Column:
    """Return the `Column` of a joint: its indices in q and its factor."""
    return joint.idx_q, joint.idx_q + 1 if joint.unbounded else -1, joint.scale


def values(q: Array, column: Column) -> Array:
    """Return a joint's angle or length (N,) at configurations (N, nq)."""
    first, second, scale = column
    at: Array = q[:, first] if second < 0 else np.arctan2(q[:, second], q[:, first])
    return at / scale


def positions(q: Array, columns: Sequence[Column]) -> Array:
    """Return the angles and lengths (N, joints) at configurations (N, nq)."""
    found = [values(q, column) for column in columns]
    return np.column_stack(found) if found else np.empty((len(q), 0))


def away(q: Array, column: Column, value: float) -> Array:
    """Return distances (N,) of a joint from a value; a continuous joint uses the shorter arc."""
    distance = values(q, column) - value
    if column[1] >= 0:
        distance -= 2.0 * np.pi * np.round(distance / (2.0 * np.pi))
    return np.abs(distance)


def follow_rows(robot: Robot, q: Array) -> None:
    """Set the mimic joints of configurations (N, nq) from the joints that they follow."""
    for joint, leader, multiplier, offset in robot.followers:
        at: Any = multiplier * values(q, column(leader)) + offset
        joint.place(q.T, at)


def checked_configurations(robot: Robot, q: ArrayLike) -> Array:
    """Return a copy of configurations (N, nq) after `Robot.checked_configuration` of each row."""
    rows = _rows("q", q, robot.nq, "one configuration in Pinocchio's order per row")
    for start in range(0, len(rows), _BLOCK):
        block = rows[start : start + _BLOCK]
        with np.errstate(all="ignore"):
            excess = np.abs(np.einsum("ij,ij->i", block[:, 3:7], block[:, 3:7]) - 1.0)
            for at in robot.unbounded:
                excess = np.maximum(excess, np.abs(block[:, at] ** 2 + block[:, at + 1] ** 2 - 1.0))
            # A finite sum shows that all entries are finite.
            finite = np.isfinite(block.sum()) or np.isfinite(block).all(axis=1)
        # Comparisons with NaN are false, so rows with NaN count as doubtful.
        doubtful = ~((excess <= ROUND_OFF) & finite)
        if robot.followers:
            followed = block.copy()
            follow_rows(robot, followed)
            doubtful |= ~(np.abs(followed - block) <= NORM_TOLERANCE).all(axis=1)
        for row in np.flatnonzero(doubtful).tolist():
            with located(f"configuration {start + row}"):
                block[row] = robot.checked_configuration(block[row])
        if robot.followers:
            follow_rows(robot, block)
    rows.setflags(write=False)
    return rows


def checked_velocities(robot: Robot, v: Any, count: int) -> Array:
    """Return read-only velocities (N, nv) from an array (N, nv), or (nv,) for all points."""
    if dimension("v", v) == 1:
        return np.broadcast_to(robot.checked_velocity(v).copy(), (count, robot.nv))
    rows = _rows("v", v, robot.nv, "one velocity in Pinocchio's order per row", count)
    for row in range(count) if robot.followers else _not_finite(rows):
        with located(f"velocity {row}"):
            robot.checked_velocity(rows[row])
    rows.setflags(write=False)
    return rows


def checked_inputs(names: tuple[str, ...], u: ArrayLike, count: int) -> Array:
    """Return read-only inputs (N, nu) from an array (N, nu), or (nu,) for all points."""
    nu = len(names)
    if dimension("u", u) == 1:
        return np.broadcast_to(vector("u", u, nu, "the robot's inputs").copy(), (count, nu))
    rows = _rows("u", u, nu, "the robot's inputs in each row", count)
    for row in _not_finite(rows):
        index = int(np.isfinite(rows[row]).argmin())
        raise InputError(f"u[{row}, {index}] is {rows[row, index]}, expected finite numbers")
    rows.setflags(write=False)
    return rows


def _not_finite(rows: Array) -> list[int]:
    """Return the indices of the rows with an entry that is not finite."""
    with np.errstate(all="ignore"):
        if np.isfinite(rows.sum()):
            return []
    rows_left: list[int] = np.flatnonzero(~np.isfinite(rows).all(axis=1)).tolist()
    return rows_left


def _rows(name: str, value: ArrayLike, size: int, of_what: str, count: int | None = None) -> Array:
    array = as_double(name, value)
    expected = f"({'N' if count is None else count}, {size})"
    if array.ndim != 2 or array.shape[1] != size or (count is not None and len(array) != count):
        raise InputError(f"{name} has shape {array.shape}, expected {expected}: {of_what}")
    if not len(array):
        raise InputError(f"{name} has no rows; give at least one row")
    return np.ascontiguousarray(array)
