"""Least squares within bounds: what thrusters that only push, and the rest, can give."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fflin.base.validation import Array
from fflin.dynamics.actuation import Actuation
from fflin.dynamics.state import StateMap
from fflin.robot.robot import Robot

# The added rows choose the least of what does the same; their effect is below rounding.
_LEAST = 1e-7


def nearest(A: Array, b: Array, least: Array, most: Array) -> Array:
    """Return u (k,) within its bounds (k,) that makes A u nearest to b, the least of these."""
    size, unit = float(np.linalg.norm(b)), float(np.linalg.norm(A))
    if size == 0.0 or unit == 0.0:
        return np.clip(np.zeros(len(least)), least, most)
    # Scaled to 1, as the solvers stop at absolute figures.
    rows = np.vstack((A / unit, _LEAST * np.eye(len(least))))
    wanted = np.concatenate((b / size, np.zeros(len(least))))
    low, high = least * (unit / size), most * (unit / size)
    high = np.maximum(high, low + 1e-15)  # the solver takes no bounds that are equal
    # The rounding of what cannot be given would drown the added rows: the second time it is gone.
    for _ in range(2):
        given = _solved(rows, wanted, low, high, least == 0.0)
        wanted[: len(b)] = rows[: len(b)] @ given
    return np.clip(given * (size / unit), least, most)


def _solved(
    rows: Array, wanted: Array, low: Array, high: Array, pushing: NDArray[np.bool_]
) -> Array:
    from scipy.optimize import lsq_linear, nnls

    free, given = rows[:, ~pushing], np.zeros(len(low))
    # Most often no other bound is met: thrusts without a largest one, the others without any.
    Q, R = np.linalg.qr(free)
    apart = rows[:, pushing] - Q @ (Q.T @ rows[:, pushing])
    if pushing.any():
        given[pushing] = nnls(apart, wanted - Q @ (Q.T @ wanted))[0]
    given[~pushing] = np.linalg.solve(R, Q.T @ (wanted - rows[:, pushing] @ given[pushing]))
    if (given < low).any() or (given > high).any():
        solved: Array = lsq_linear(rows, wanted, (low, high), method="bvls", tol=1e-20).x
        return solved
    return given


def pushes_every_way(W: Array, pushing: NDArray[np.bool_]) -> bool:
    """Whether columns W (6, k), of which some only push, together give every wrench.

    They do where the rank is 6 and some thrusts, all of them positive, cancel one another.
    """
    from scipy.optimize import nnls

    size = np.linalg.norm(W, axis=0)
    W, pushing = W[:, size > 0.0] / size[size > 0.0], pushing[size > 0.0]
    if np.linalg.matrix_rank(W, tol=1e-6) < len(W):
        return False
    if not pushing.any():
        return True
    both = np.hstack((W[:, pushing], W[:, ~pushing], -W[:, ~pushing]))
    return bool(nnls(both, -both.sum(axis=1))[1] < 1e-9)


def thrusters_push_every_way(robot: Robot) -> bool:
    """Whether a robot has thrusters that, with what else acts on its base, push it every way."""
    actuation = Actuation(StateMap(robot))
    thrusters = actuation.groups.get("thrust")
    if thrusters is None:
        return False
    W = actuation.columns(robot.create_data(), robot.neutral())[:6]
    pushing = np.isin(np.arange(W.shape[1]), thrusters)
    return pushes_every_way(W, pushing)
