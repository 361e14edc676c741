"""The joints of many configurations at once, by where they stand in q."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from fflin.base.validation import Array

if TYPE_CHECKING:
    from fflin.robot.robot import Robot

# Where a joint stands in q: (index, -1), or, where it is stored so, those of (cos, sin).
Columns: TypeAlias = tuple[tuple[int, int], ...]


def joint_columns(robot: Robot) -> Columns:
    """Return where each independent joint stands in q."""
    return tuple(
        (joint.idx_q, joint.idx_q + 1 if joint.unbounded else -1) for joint in robot.joints
    )


def positions(q: Array, columns: Columns) -> Array:
    """Return the angles and lengths (N, joints) at configurations (N, nq)."""
    found = [
        np.arctan2(q[:, second], q[:, first]) if second >= 0 else q[:, first]
        for first, second in columns
    ]
    return np.column_stack(found) if found else np.empty((len(q), 0))


def away(q: Array, column: tuple[int, int], value: float) -> Array:
    """Return how far a joint is from a value (N,), the short way round where it has no stop."""
    distance = positions(q, (column,))[:, 0] - value
    if column[1] >= 0:
        distance -= 2.0 * np.pi * np.round(distance / (2.0 * np.pi))
    return np.abs(distance)
