"""Points of sweeps: configurations, velocities and inputs.

Configurations are given as an array, or generated on demand by a grid or a random generator.
"""

import math
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
import pinocchio as pin

from fflin.base import validation
from fflin.base.errors import InputError, located
from fflin.base.validation import Array, ArrayLike, frozen
from fflin.dynamics.points import configuration
from fflin.robot.fields import travel_of, warn_of_degrees
from fflin.robot.joints import Joint, by_joint
from fflin.robot.robot import Robot

# Rows are checked in blocks of this size, which limits the memory for intermediate results.
_BLOCK = 2048

# Random rows are drawn in blocks of this size, each with its own seed. A row therefore does not
# depend on the chunk in which it is read.
_DRAWN = 4096


@dataclass(frozen=True, eq=False)
class Grid:
    """Grid of configurations: all combinations of joint values; see `grid`.

    The values of the last joint vary fastest.

    Attributes
    ----------
    robot : Robot
    axes : mapping
        Values of each varied joint, {joint: values (k,) [rad|m]}.
    start : ndarray (nq,)
        Configuration that contains the base pose and the positions of the joints that the grid does
        not vary.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> points = fflin.grid(robot, {"joint_1": [-0.5, 0.5]}, joints={"joint_3": 0.2})
    >>> points.shape, sorted(points.axes)
    ((2,), ['joint_1'])
    """

    robot: Robot
    axes: Mapping[str, Array]
    start: Array

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of values of each joint in `axes`."""
        return tuple(len(values) for values in self.axes.values())

    def __len__(self) -> int:
        return math.prod(self.shape)

    def rows(self, start: int, stop: int) -> Array:
        """Return configurations start to stop - 1 as rows of an array (stop - start, nq)."""
        picks = np.unravel_index(np.arange(start, stop), self.shape)
        values = {
            name: axis[pick]
            for (name, axis), pick in zip(self.axes.items(), picks, strict=True)
        }
        return _placed(self.robot, self.start, stop - start, values)


@dataclass(frozen=True, eq=False)
class RandomConfigurations:
    """Random configurations, uniform within joint ranges; see `random_configurations`.

    Attributes
    ----------
    robot : Robot
    count, seed : int
        Number of configurations, and seed of the draws.
    ranges : mapping
        Range of each joint, {joint: (low, high) [rad|m]}.
    start : ndarray (nq,)
        Configuration that contains the base pose; random values replace its joint positions.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> points = fflin.random_configurations(robot, 4, ranges={"joint_1": (0.1, 0.2)})
    >>> len(points), sorted(points.ranges)[0]
    (4, 'joint_1')
    """

    robot: Robot
    count: int
    seed: int
    ranges: Mapping[str, tuple[float, float]]
    start: Array

    def __len__(self) -> int:
        return self.count

    def rows(self, start: int, stop: int) -> Array:
        """Return configurations start to stop - 1 as rows of an array (stop - start, nq)."""
        low, high = self._limits()
        first = start // _DRAWN
        blocks = [np.empty((0, len(low)))] + [
            np.random.default_rng([self.seed, block]).uniform(
                low, high, (_DRAWN, len(low))
            )
            for block in range(first, -(-stop // _DRAWN))
        ]
        drawn = np.concatenate(blocks)[start - first * _DRAWN : stop - first * _DRAWN]
        values = dict(zip(self.ranges, drawn.T, strict=True))
        return _placed(self.robot, self.start, stop - start, values)

    def drawn_again(self, index: int, attempt: int) -> Array:
        """Return another draw (nq,) for a configuration, with the number `attempt` from 1."""
        seed = [self.seed, index, attempt]
        values = np.random.default_rng(seed).uniform(*self._limits())
        columns = dict(zip(self.ranges, values[:, None], strict=True))
        row: Array = _placed(self.robot, self.start, 1, columns)[0]
        return row

    def _limits(self) -> tuple[Array, Array]:
        """Return the lower and upper limits of all joints."""
        low, high = np.array(list(self.ranges.values())).reshape(-1, 2).T
        return low, high


# Configurations of a sweep that are generated on demand.
Configurations: TypeAlias = Grid | RandomConfigurations


def grid(
    robot: Robot,
    axes: Mapping[str, ArrayLike],
    *,
    joints: Mapping[str, float] | None = None,
    base: pin.SE3 | None = None,
) -> Grid:
    """Return a grid of configurations over joint values, for `sweep`.

    Parameters
    ----------
    robot : Robot
    axes : mapping
        Values of each varied joint in increasing order, {joint: values (k,) [rad|m]}. The last
        joint varies fastest.
    joints, base : optional
        Values of the other joints and pose of the base, as in `configuration`.

    Returns
    -------
    Grid

    Raises
    ------
    UnknownNameError
        If a joint does not exist.
    InputError
        If no axis is given, or the values of an axis are empty, not finite or not increasing.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> points = fflin.grid(robot, {"joint_1": [-0.5, 0.0, 0.5], "joint_2": [0.0, 1.0]})
    >>> len(points)
    6
    """
    start = configuration(robot, joints, base)
    if not isinstance(axes, Mapping) or not axes:
        raise InputError(
            f"the axes of the grid are {axes!r}, expected a mapping {{joint: values}}"
        )
    checked: dict[str, Array] = {}
    for name, values in axes.items():
        robot.joint(name)
        if joints and name in joints:
            raise InputError(
                f"joint '{name}' is on the grid and in joints=; give it in only one of the two"
            )
        label = f"grid of joint '{name}'"
        axis = validation.as_double(label, values)
        validation.vector(
            label, axis, max(1, axis.size), "increasing values (k,), k > 0"
        )
        if (np.diff(axis) <= 0.0).any():
            raise InputError(
                f"{label} has values that do not increase, expected increasing numbers"
            )
        checked[name] = frozen(axis)
    largest = {f"q_m.{name}": float(max(x, key=abs)) for name, x in checked.items()}
    warn_of_degrees(robot, largest)
    count = math.prod(map(len, checked.values()))
    if count > sys.maxsize:
        raise InputError(
            f"the grid has {count:,} points, too many to index; give fewer values"
        )
    return Grid(robot, checked, frozen(start))


def random_configurations(
    robot: Robot,
    count: int,
    *,
    seed: int = 0,
    ranges: Mapping[str, tuple[float, float]] | None = None,
    base: pin.SE3 | None = None,
) -> RandomConfigurations:
    """Return random configurations, uniformly distributed within joint limits, for `sweep`.

    Parameters
    ----------
    robot : Robot
    count : int
        Number of configurations.
    seed : int
        Random seed. The same seed gives the same configurations.
    ranges : mapping, optional
        Ranges {joint or pattern: (low, high) [rad|m]} that replace the joint limits. The angle of a
        revolute joint with neither limits nor a range is drawn from one full turn.
    base : pin.SE3, optional
        Pose of the base; the identity by default.

    Returns
    -------
    RandomConfigurations

    Raises
    ------
    UnknownNameError
        If a joint does not exist.
    InputError
        If the count or seed is not a whole number, a range is empty, or a prismatic joint has
        neither limits nor a range.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> points = fflin.random_configurations(robot, 4, seed=1)
    >>> len(fflin.sweep(robot, points))
    4
    """
    count, seed = validation.whole("count", count, 1), validation.whole("seed", seed, 0)
    start = configuration(robot, base=base)
    ranges = {} if ranges is None else ranges
    given = validation.instance(
        "ranges", ranges, Mapping, "a mapping {joint: (low, high)}"
    )
    given = by_joint(given, robot.joint_names, robot.joint)
    checked = {
        joint.name: _range(robot, joint, given.get(joint.name))
        for joint in robot.joints
    }
    largest = {f"q_m.{name}": max(checked[name], key=abs) for name in given}
    warn_of_degrees(robot, largest)
    return RandomConfigurations(robot, count, seed, checked, frozen(start))


def _range(
    robot: Robot, joint: Joint, given: tuple[float, float] | None
) -> tuple[float, float]:
    if given is not None:
        label = f"range of '{joint.name}'"
        low, high = validation.vector(label, given, 2, "(low, high)").tolist()
        if not 0.0 <= high - low < math.inf:
            message = f"{label} is {low:g} to {high:g}"
            raise InputError(
                f"{message}, expected low <= high with a width that does not overflow"
            )
        return low, high
    low, high = travel_of(robot.model, joint)
    if not joint.prismatic:
        if high - low < 4.0 * math.pi:
            return low, high
        # Two revolutions or more: choose the revolution within the limits that is nearest to zero.
        middle = min(max(0.0, low + math.pi), high - math.pi)
        return middle - math.pi, middle + math.pi
    if not (low <= high and abs(low) < 1e6 and abs(high) < 1e6):
        raise InputError(
            f"prismatic joint '{joint.name}' has no limits to draw from; give its range in ranges="
        )
    return low, high


def _placed(
    robot: Robot, start: Array, count: int, values: Mapping[str, Array]
) -> Array:
    """Return copies (count, nq) of `start`, in which the named joints have the given `values`."""
    q = np.tile(start, (count, 1))
    for name, column in values.items():
        robot.joint(name).place(q.T, column)
    robot.follow(q.T)
    return q


def checked_points(
    robot: Robot, q: ArrayLike | Configurations
) -> Array | Configurations:
    """Return checked configurations of a robot: a new array, a grid or random configurations.

    Each row of an array (N, nq) is checked and corrected as in `Robot.checked_configuration`.
    """
    if isinstance(q, Grid | RandomConfigurations):
        # The points may have been made for another robot, for example one with other inputs. Both
        # robots must have the same joints.
        if q.robot.joints != robot.joints:
            raise InputError(
                f"q was made for '{q.robot.name}', whose joints differ from the joints of "
                f"'{robot.name}'; make q for the robot that is swept"
            )
        return replace(q, robot=robot)
    rows = _rows("q", q, robot.nq, "one configuration in Pinocchio's order per row")
    for start in range(0, len(rows), _BLOCK):
        block = rows[start : start + _BLOCK]
        with np.errstate(all="ignore"):
            excess = np.abs(np.einsum("ij,ij->i", block[:, 3:7], block[:, 3:7]) - 1.0)
            for at in robot.unbounded:
                excess = np.maximum(
                    excess, np.abs(block[:, at] ** 2 + block[:, at + 1] ** 2 - 1.0)
                )
        # Rows that may be invalid. They include rows with NaN, because comparisons with NaN are
        # false.
        doubtful = ~((excess <= validation.ROUND_OFF) & np.isfinite(block).all(axis=1))
        if robot.followers:
            followed = block.copy()
            robot.follow(followed.T)
            doubtful |= ~(np.abs(followed - block) <= validation.NORM_TOLERANCE).all(
                axis=1
            )
        for row in np.flatnonzero(doubtful).tolist():
            with located(f"configuration {start + row}"):
                block[row] = robot.checked_configuration(block[row])
        if robot.followers:
            robot.follow(block.T)
    return frozen(rows)


def checked_rows(
    name: str,
    given: ArrayLike,
    size: int,
    check: Callable[[ArrayLike], Array],
    count: int,
    *,
    every: bool = False,
) -> Array:
    """Return a read-only array (count, size) with one row for each point.

    The argument `given` is an array (count, size), or a single row (size,) for all points. The
    function `check` must raise an error for an invalid row. A single row is always checked. The
    rows of an array are checked if they have an entry that is not finite, or if `every` is true.
    """
    if validation.dimension(name, given) == 1:
        return np.broadcast_to(check(given).copy(), (count, size))
    rows = _rows(name, given, size, "one row for each point", count)
    for row in np.flatnonzero(~np.isfinite(rows).all(axis=1) | every).tolist():
        with located(f"row {row}"):
            check(rows[row])
    return frozen(rows)


def _rows(
    name: str, value: ArrayLike, size: int, of_what: str, count: int | None = None
) -> Array:
    array = validation.as_double(name, value)
    rows = "N" if count is None else count
    expected = f"({rows}, {size})"
    if (
        array.ndim != 2
        or array.shape[1] != size
        or (count is not None and len(array) != count)
    ):
        raise InputError(
            f"{name} has shape {array.shape}, expected {expected}: {of_what}"
        )
    if not len(array):
        raise InputError(f"{name} has no rows; give at least one row")
    return np.ascontiguousarray(array)
