"""Closed configurations of a sweep over a robot with constraints."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator

import numpy as np

from fflin.base.errors import ConstraintError, located
from fflin.base.validation import Array, Indices
from fflin.batch.configurations import Configurations, Grid, RandomConfigurations
from fflin.dynamics.closure import Closure
from fflin.linear.linearization import Linearizer

# A random configuration that cannot be closed is drawn again at most this many times.
_DRAWS = 200


def closed_points(
    linearizer: Linearizer, points: Array | Configurations
) -> tuple[Array, Array]:
    """Return closed configurations (N, nq) and their residuals (N,) [m, rad].

    The linearizer chooses its independent coordinates at the first configuration.

    - Rows of an array must be closed, see `linearize`.
    - On a grid, the joints of the grid keep their values. Newton's method starts from a closed
      neighbour on the grid.
    - Random configurations keep their independent joints. If a configuration cannot be closed, it
      is drawn again.

    Raises
    ------
    ConstraintError
        If a configuration is not closed, or cannot be closed. The message names the row.
    """
    closure = Closure(linearizer.prepared.map)
    if isinstance(points, np.ndarray):
        rows = _given(closure, points)
    elif isinstance(points, Grid):
        rows = _on_grid(closure, points)
    else:
        rows = _random(closure, linearizer, points)
    q = np.array(list(rows))
    linearizer(q[0])
    residual = [np.abs(closure.constraints.residual(row)).max() for row in q]
    return q, np.array(residual)


def _given(closure: Closure, points: Array) -> Iterator[Array]:
    for index, row in enumerate(points):
        with located(f"configuration {index}"):
            yield closure.configuration(row)


def _on_grid(closure: Closure, points: Grid) -> Iterator[Array]:
    robot = points.robot
    closure.constraints.settle(points.start)
    kept = _of_joints(closure, points.axes)
    shape = points.shape
    done = list[Array]()
    for index in range(len(points)):
        row = points.rows(index, index + 1)[0]
        pick = np.array(np.unravel_index(index, shape))
        varied = np.flatnonzero(pick)
        if len(varied):
            # the neighbour with the next lower value of the joint that varies fastest
            pick[varied[-1]] -= 1
            neighbour = done[int(np.ravel_multi_index(tuple(pick), shape))].copy()
            positions = closure.state.joint_positions(row)
            for name in points.axes:
                joint = robot.joint(name)
                joint.place(neighbour, positions[robot.joint_names.index(name)])
            robot.follow(neighbour)
            row = neighbour
        with located(f"configuration {index}"):
            done.append(closure.nearest(row, kept))
        yield done[-1]


def _random(
    closure: Closure, linearizer: Linearizer, points: RandomConfigurations
) -> Iterator[Array]:
    closure.constraints.settle(points.start)
    first = _drawn(points, 0, closure.nearest)
    independent = linearizer(first).independent or ()
    joints = [name.removeprefix("q_m.") for name in independent if "q_m." in name]
    kept = _of_joints(closure, joints)
    for index in range(len(points)):
        yield _drawn(points, index, lambda row: closure.nearest(row, kept))


def _drawn(
    points: RandomConfigurations, index: int, close: Callable[[Array], Array]
) -> Array:
    """Return a closed random configuration; its first draw is row `index` of the points."""
    row = points.rows(index, index + 1)[0]
    for attempt in range(1, _DRAWS + 1):
        try:
            return close(row)
        except ConstraintError:
            row = points.drawn_again(index, attempt)
    with located(f"configuration {index}"):
        return close(row)


def _of_joints(closure: Closure, names: Iterable[str]) -> Indices:
    """Return the indices in nu of named joints."""
    joints = closure.state.robot.joint_names
    return np.array([6 + joints.index(name) for name in names], dtype=np.intp)
