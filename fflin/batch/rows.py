"""Checks of the rows of q, v and u that a caller passes in, many at a time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from fflin.base.errors import FflinError, InputError
from fflin.base.validation import NORM_TOLERANCE, Array, as_double, dimension
from fflin.batch.configurations import follow_rows
from fflin.robot.robot import ROUND_OFF, Robot

_BLOCK = 2048  # rows that are checked at once, so that what that takes is small


def checked_configurations(robot: Robot, q: Any) -> Array:
    """Return a copy of configurations (N, nq), each as `Robot.checked_configuration` has it.

    Raises
    ------
    InputError
        If the shape is wrong or a row is no configuration; the message names it.
    """
    rows = _rows("q", q, robot.nq, "a configuration in Pinocchio's order each")
    unbounded = list(robot.unbounded)
    for start in range(0, len(rows), _BLOCK):
        block = rows[start : start + _BLOCK]
        with np.errstate(all="ignore"):
            excess = np.abs(np.einsum("ij,ij->i", block[:, 3:7], block[:, 3:7]) - 1.0)
            for at in unbounded:
                excess = np.maximum(excess, np.abs(block[:, at] ** 2 + block[:, at + 1] ** 2 - 1.0))
            # The sum tells at once where all are finite.
            finite = np.isfinite(block.sum()) or np.isfinite(block).all(axis=1)
        # Written so that NaN is among them.
        doubtful = ~((excess <= ROUND_OFF) & finite)
        if robot.followers:
            followed = block.copy()
            follow_rows(robot, followed)
            doubtful |= ~(np.abs(followed - block) <= NORM_TOLERANCE).all(axis=1)
        for row in np.flatnonzero(doubtful).tolist():
            block[row] = _named(
                robot.checked_configuration, "configuration", start + row, block[row]
            )
        if robot.followers:
            follow_rows(robot, block)
    rows.setflags(write=False)
    return rows


def checked_velocities(robot: Robot, v: Any, count: int) -> Array:
    """Return velocities (N, nv) of an array (N, nv), or (nv,) for all; read-only.

    Raises
    ------
    InputError
        If the shape is wrong or a row is no velocity; the message names it.
    """
    if dimension("v", v) == 1:
        return np.broadcast_to(robot.checked_velocity(v).copy(), (count, robot.nv))
    rows = _rows("v", v, robot.nv, "a velocity in Pinocchio's order each", count)
    doubtful = ~np.isfinite(rows).all(axis=1) | bool(robot.followers)
    for row in np.flatnonzero(doubtful).tolist():
        _named(robot.checked_velocity, "velocity", row, rows[row])
    rows.setflags(write=False)
    return rows


def checked_inputs(names: tuple[str, ...], u: Any, count: int) -> Array:
    """Return inputs (N, nu) of an array (N, nu), or (nu,) for all; read-only.

    Raises
    ------
    InputError
        If the shape is wrong or an entry is not finite.
    """
    one = dimension("u", u) == 1
    rows = _rows(
        "u",
        as_double("u", u)[None] if one else u,
        len(names),
        "the robot's inputs each",
        1 if one else count,
    )
    for row in np.flatnonzero(~np.isfinite(rows).all(axis=1)).tolist():
        index = int(np.flatnonzero(~np.isfinite(rows[row]))[0])
        raise InputError(f"u[{row}, {index}] is {rows[row, index]}; every entry must be finite")
    rows.setflags(write=False)
    return np.broadcast_to(rows[0], (count, len(names))) if one else rows


def _rows(name: str, value: Any, size: int, of_what: str, count: int | None = None) -> Array:
    array = as_double(name, value)
    expected = f"({'N' if count is None else count}, {size})"
    if array.ndim != 2 or array.shape[1] != size or (count is not None and len(array) != count):
        raise InputError(f"{name} has shape {array.shape}, expected {expected}: {of_what}")
    if not len(array):
        raise InputError(f"{name} has no rows; give at least one")
    return np.ascontiguousarray(array)


def _named(check: Callable[[Array], Array], what: str, row: int, value: Array) -> Array:
    try:
        return check(value)
    except FflinError as error:
        raise type(error)(f"{what} {row}: {error}") from None
