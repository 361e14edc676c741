"""Sets of configurations: a given array, a grid, or random rows generated on demand."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import pinocchio as pin

from fflin.base.errors import InputError
from fflin.base.validation import Array, as_double, instance, number, whole
from fflin.batch.rows import checked_configurations, follow_rows
from fflin.dynamics.points import configuration
from fflin.robot.fields import travel_of
from fflin.robot.joints import Joint, by_joint
from fflin.robot.robot import Robot

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

# Random rows are drawn in blocks of this size, each with its own seed. A row therefore does not
# depend on the chunk in which it is read.
_DRAWN = 4096

# Range of a revolute joint without limits [rad].
_TURN = (-math.pi, math.pi)


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
            name: axis[pick] for (name, axis), pick in zip(self.axes.items(), picks, strict=True)
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
        low, high = np.array(list(self.ranges.values())).reshape(-1, 2).T
        first = start // _DRAWN
        blocks = [np.empty((0, len(low)))] + [
            np.random.default_rng([self.seed, block]).uniform(low, high, (_DRAWN, len(low)))
            for block in range(first, -(-stop // _DRAWN))
        ]
        drawn = np.concatenate(blocks)[start - first * _DRAWN : stop - first * _DRAWN]
        values = dict(zip(self.ranges, drawn.T, strict=True))
        return _placed(self.robot, self.start, stop - start, values)


@dataclass(frozen=True, eq=False)
class GivenConfigurations:
    """Array (N, nq) of valid configurations."""

    q: Array

    def __len__(self) -> int:
        return len(self.q)

    def rows(self, start: int, stop: int) -> Array:
        """Return configurations start to stop - 1 as rows of an array (stop - start, nq)."""
        return self.q[start:stop]


# Configurations of a sweep; the rows of a grid and random rows are generated on demand.
Configurations: TypeAlias = Grid | RandomConfigurations | GivenConfigurations


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
        raise InputError(f"the axes of the grid are {axes!r}, expected a mapping {{joint: values}}")
    checked: dict[str, Array] = {}
    for name, values in axes.items():
        robot.joint(name)
        if joints and name in joints:
            raise InputError(
                f"joint '{name}' is on the grid and in joints=; give it in only one of the two"
            )
        axis = as_double(f"grid of joint '{name}'", values)
        if axis.ndim != 1 or not axis.size:
            raise InputError(f"grid of joint '{name}' has shape {axis.shape}, expected (k,), k > 0")
        if not np.isfinite(axis).all() or (np.diff(axis) <= 0.0).any():
            raise InputError(
                f"grid of joint '{name}' has values that are not finite or do not increase, "
                "expected increasing finite numbers"
            )
        axis.setflags(write=False)
        checked[name] = axis
    count = math.prod(map(len, checked.values()))
    if count > sys.maxsize:
        raise InputError(f"the grid has {count:,} points, too many to index; give fewer values")
    start.setflags(write=False)
    return Grid(robot, checked, start)


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
    count, seed = whole("count", count, 1), whole("seed", seed, 0)
    start = configuration(robot, base=base)
    ranges = {} if ranges is None else ranges
    given = instance("ranges", ranges, Mapping, "a mapping {joint: (low, high)}")
    given = by_joint(given, robot.joint_names, robot.joint)
    checked = {joint.name: _range(robot, joint, given.get(joint.name)) for joint in robot.joints}
    start.setflags(write=False)
    return RandomConfigurations(robot, count, seed, checked, start)


def as_configurations(robot: Robot, q: ArrayLike | Configurations) -> Configurations:
    """Return the points of a sweep as configurations of this robot."""
    instance("robot", robot, Robot, "a fflin.Robot")
    if isinstance(q, GivenConfigurations):  # checked already
        return q
    if not isinstance(q, Grid | RandomConfigurations):
        return GivenConfigurations(checked_configurations(robot, q))
    # The robot may have other inputs or outputs, but its joints must be the same.
    if q.robot.joints != robot.joints:
        raise InputError(
            f"q was made for '{q.robot.name}', whose joints differ from the joints of "
            f"'{robot.name}'; make q for the robot that is swept"
        )
    return replace(q, robot=robot)


def content(configurations: Configurations) -> dict[str, object]:
    """Return all values that determine the rows, by name and in order."""
    values = {item.name: getattr(configurations, item.name) for item in fields(configurations)}
    of_joints = values.pop("axes", None) or values.pop("ranges", {})
    values.pop("robot", None)
    named = {f"{at} {name}": value for at, (name, value) in enumerate(of_joints.items())}
    return {"of": type(configurations).__name__, **values, **named}


def _range(robot: Robot, joint: Joint, given: tuple[float, float] | None) -> tuple[float, float]:
    if given is not None:
        what = f"range of '{joint.name}'"
        try:
            low, high = given
        except (TypeError, ValueError):
            raise InputError(f"{what} is {given!r}, expected (low, high)") from None
        low, high = number(what, low), number("its end", high)
        if not 0.0 <= high - low < math.inf:
            said = f"{what} is {low:g} to {high:g}"
            raise InputError(f"{said}, expected low <= high with a width that does not overflow")
        return low, high
    low, high = travel_of(robot.model, joint)
    if not joint.prismatic:
        low, high = max(low, 2 * _TURN[0]), min(high, 2 * _TURN[1])
        return (low, high) if low <= high and high - low < 4 * math.pi else _TURN
    if not (low <= high and abs(low) < 1e6 and abs(high) < 1e6):
        raise InputError(
            f"prismatic joint '{joint.name}' has no limits to draw from; give its range in ranges="
        )
    return low, high


def _placed(robot: Robot, start: Array, count: int, values: Mapping[str, Any]) -> Array:
    """Return copies (count, nq) of `start` with other values of the named joints."""
    q = np.tile(start, (count, 1))
    for name, column in values.items():
        robot.joint(name).place(q.T, column)
    follow_rows(robot, q)
    return q
