"""Many configurations: given, on a grid, or random; made as they are needed."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, TypeAlias

import numpy as np
import pinocchio as pin

from fflin.base.errors import InputError
from fflin.base.names import joints_by_name
from fflin.base.validation import Array, as_double, number, whole
from fflin.batch.rows import checked_configurations, follow_rows
from fflin.dynamics.points import configuration
from fflin.robot.joints import Joint
from fflin.robot.robot import Robot

# Random rows are drawn in blocks of this size, each with a seed of its own, so that a row does not
# depend on the chunk that it is read in.
_DRAWN = 4096

# Range of a joint that turns without limits [rad].
_TURN = (-math.pi, math.pi)


@dataclass(frozen=True, eq=False)
class Grid:
    """All combinations of joint values, the last joint's varying fastest; see `grid`.

    Attributes
    ----------
    robot : Robot
    axes : mapping
        {joint: values (k,) [rad|m]}.
    start : ndarray (nq,)
        What the base and the other joints are at.

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
        """Number of values of each joint."""
        return tuple(len(values) for values in self.axes.values())

    def __len__(self) -> int:
        return math.prod(self.shape)

    def rows(self, start: int, stop: int) -> Array:
        """Return the configurations (stop - start, nq)."""
        picks = np.unravel_index(np.arange(start, stop), self.shape)
        values = {
            name: axis[pick] for (name, axis), pick in zip(self.axes.items(), picks, strict=True)
        }
        return _placed(self.robot, self.start, stop - start, values)


@dataclass(frozen=True, eq=False)
class RandomConfigurations:
    """Joint values drawn evenly from ranges; see `random_configurations`.

    Attributes
    ----------
    robot : Robot
    count, seed : int
    ranges : mapping
        {joint: (low, high) [rad|m]}.
    start : ndarray (nq,)
        What the base is at.

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
        """Return the configurations (stop - start, nq)."""
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
    """An array of valid configurations (N, nq)."""

    q: Array

    def __len__(self) -> int:
        return len(self.q)

    def rows(self, start: int, stop: int) -> Array:
        """Return the configurations (stop - start, nq)."""
        return self.q[start:stop]


# What `sweep` takes in place of an array: rows that are made when they are asked for.
Configurations: TypeAlias = Grid | RandomConfigurations | GivenConfigurations


def grid(
    robot: Robot,
    axes: Mapping[str, Any],
    *,
    joints: Mapping[str, float] | None = None,
    base: pin.SE3 | None = None,
) -> Grid:
    """Lay a grid over joint values.

    Parameters
    ----------
    robot : Robot
    axes : mapping
        {joint: increasing values (k,) [rad|m]}, the last varying fastest.
    joints, base : optional
        Of the other joints and the base, as `configuration` takes them.

    Returns
    -------
    Grid
        For `sweep`.

    Raises
    ------
    UnknownNameError
        If there is no such joint.
    InputError
        If there is no axis, or its values are none, not finite or do not increase.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> points = fflin.grid(robot, {"joint_1": [-0.5, 0.0, 0.5], "joint_2": [0.0, 1.0]})
    >>> len(points)
    6
    """
    start = configuration(robot, joints, base)
    if not isinstance(axes, Mapping) or not axes:
        raise InputError(f"the axes of the grid are {axes!r}, expected {{joint: values}}")
    checked: dict[str, Array] = {}
    for name, values in axes.items():
        robot.joint(name)
        if joints and name in joints:
            raise InputError(f"joint '{name}' is on the grid and in joints; give either")
        axis = as_double(f"grid of joint '{name}'", values)
        if axis.ndim != 1 or not axis.size:
            raise InputError(f"grid of joint '{name}' has shape {axis.shape}, expected (k,), k > 0")
        if not np.isfinite(axis).all() or (np.diff(axis) <= 0.0).any():
            raise InputError(f"grid of joint '{name}' must be finite numbers that increase")
        axis.setflags(write=False)
        checked[name] = axis
    count = math.prod(map(len, checked.values()))
    if count > sys.maxsize:
        raise InputError(f"{count:,} points are too many; choose fewer")
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
    """Draw configurations evenly from the joints' limits.

    Parameters
    ----------
    robot : Robot
    count : int
        How many.
    seed : int
        The same seed gives the same configurations.
    ranges : mapping, optional
        {joint or pattern: (low, high) [rad|m]} in place of its limits. What turns without limits
        is drawn from one turn.
    base : pin.SE3, optional
        Placement of the base; the identity by default.

    Returns
    -------
    RandomConfigurations
        For `sweep`.

    Raises
    ------
    UnknownNameError
        If there is no such joint.
    InputError
        If the count or seed is no whole number, a range is empty, or a joint that slides has no
        limits and no range.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> points = fflin.random_configurations(robot, 4, seed=1)
    >>> len(fflin.sweep(robot, points))
    4
    """
    count, seed = whole("count", count, 1), whole("seed", seed, 0)
    start = configuration(robot, base=base)
    if not (ranges is None or isinstance(ranges, Mapping)):
        raise InputError(f"ranges is {ranges!r}, expected {{joint: (low, high)}}")
    names = robot.joint_names
    given = joints_by_name("joint", ranges or {}, names, lambda name: robot.joint(name).name)
    checked = {joint.name: _range(robot, joint, given.get(joint.name)) for joint in robot.joints}
    start.setflags(write=False)
    return RandomConfigurations(robot, count, seed, checked, start)


def as_configurations(robot: Robot, q: Any) -> Configurations:
    """Return the points that `sweep` is given as rows of this robot."""
    if not isinstance(robot, Robot):
        raise InputError(f"robot is a {type(robot).__name__}, expected a fflin.Robot")
    if isinstance(q, GivenConfigurations):  # checked already
        return q
    if not isinstance(q, Grid | RandomConfigurations):
        return GivenConfigurations(checked_configurations(robot, q))
    # The same robot with other inputs or outputs will do.
    if q.robot.joints != robot.joints:
        raise InputError(
            f"q is of '{q.robot.name}', whose joints are others than those of '{robot.name}'"
        )
    return replace(q, robot=robot)


def content(configurations: Configurations) -> dict[str, Any]:
    """Return what all rows are made of, by names in their order."""
    values = {item.name: getattr(configurations, item.name) for item in fields(configurations)}
    of_joints = values.pop("axes", None) or values.pop("ranges", {})
    values.pop("robot", None)
    named = {f"{at} {name}": value for at, (name, value) in enumerate(of_joints.items())}
    return {"of": type(configurations).__name__, **values, **named}


def _range(robot: Robot, joint: Joint, given: Any) -> tuple[float, float]:
    if given is not None:
        what = f"range of '{joint.name}'"
        try:
            low, high = given
        except (TypeError, ValueError):
            raise InputError(f"{what} is {given!r}, expected (low, high)") from None
        low, high = number(what, low), number("its end", high)
        if not low <= high:
            raise InputError(f"{what} is {low:g} to {high:g}, expected low to high")
        if math.isinf(high - low):
            raise InputError(f"{what} is {low:g} to {high:g}, wider than all numbers; narrow it")
        return low, high
    if joint.unbounded:
        return _TURN
    low = float(robot.model.lowerPositionLimit[joint.idx_q])
    high = float(robot.model.upperPositionLimit[joint.idx_q])
    if not joint.prismatic:
        low, high = max(low, 2 * _TURN[0]), min(high, 2 * _TURN[1])
        return (low, high) if low <= high and high - low < 4 * math.pi else _TURN
    if not (low <= high and abs(low) < 1e6 and abs(high) < 1e6):
        raise InputError(f"joint '{joint.name}' slides without limits; give it a range")
    return low, high


def _placed(robot: Robot, start: Array, count: int, values: Mapping[str, Any]) -> Array:
    """Return rows (count, nq) that differ from `start` in the joints that are named."""
    q = np.tile(start, (count, 1))
    for name, column in values.items():
        robot.joint(name).place(q.T, column)
    follow_rows(robot, q)
    return q
