"""Constraints between two frames of a robot, or between a frame and inertial space."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass, replace
from typing import ClassVar

import numpy as np
import pinocchio as pin

from fflin.base.errors import InputError
from fflin.base.validation import Array, placement
from fflin.robot.inputs import Vector3, three_numbers, unit_vector


@dataclass(frozen=True, eq=False)
class Constraint:
    """Base class of constraints between a frame of the robot and another frame.

    The fields are described in `Weld`.
    """

    # Word in robot files, such as type = "weld".
    KEY: ClassVar[str]

    frame: str
    to: str | None = None
    _: KW_ONLY
    placement: pin.SE3 | None = None
    name: str | None = None

    def __post_init__(self) -> None:
        for key in ("frame", "to", "name"):
            value = getattr(self, key)
            if value is None and key != "frame":
                continue
            if not isinstance(value, str) or not value.strip():
                raise InputError(f"{key} of a constraint is {value!r}, expected a name")
        if self.frame == self.to:
            raise InputError(
                f"constraint '{self.title}' connects frame '{self.frame}' to itself; give two "
                "frames"
            )
        if self.placement is not None:
            label = f"placement of constraint '{self.title}'"
            object.__setattr__(self, "placement", placement(label, self.placement))

    @property
    def title(self) -> str:
        """Name of the constraint; by default the names of its frames, as in "tool/target"."""
        if self.name is not None:
            return self.name
        return "/".join(filter(None, (self.frame, self.to)))

    @property
    def frames(self) -> tuple[str, ...]:
        """Names of the frames of the robot that are connected."""
        return tuple(filter(None, (self.frame, self.to)))

    @property
    def rows(self) -> Array:
        """Rows (k, 6) of the relative twist that the constraint sets to zero.

        The twist is linear velocity (3,), then angular velocity (3,), of `frame` relative to `to`.
        """
        raise NotImplementedError

    def store(self, pose: pin.SE3) -> None:
        """Store the placement of a constraint that was given without one."""
        if self.placement is None:
            object.__setattr__(self, "placement", pin.SE3(pose))

    def __str__(self) -> str:
        to = f"frame '{self.to}'" if self.to else "inertial space"
        where = "placement not yet stored"
        if self.placement is not None:
            rpy = np.rad2deg(pin.rpy.matrixToRpy(self.placement.rotation)).tolist()
            position = self.placement.translation.tolist()
            numbers = [
                ", ".join(f"{x + 0.0:.6g}" for x in values)
                for values in (position, rpy)
            ]
            where = f"position ({numbers[0]}) m, rpy ({numbers[1]}) deg"
        return f"{self.KEY} '{self.title}': frame '{self.frame}' to {to}, {where}"


@dataclass(frozen=True, eq=False)
class Weld(Constraint):
    """Constraint that fixes a frame to another frame or to inertial space: 6 rows.

    Parameters
    ----------
    frame : str
        Frame of the robot that is held.
    to : str, optional
        Frame of the robot to which it is held; by default inertial space, which is Pinocchio's
        world.
    placement : pin.SE3, optional
        Pose of `frame` in `to`. By default, the pose at the first configuration at which the
        constraint is used. The robot then stores this pose.
    name : str, optional
        Name of the constraint; by default "FRAME" or "FRAME/TO".

    Raises
    ------
    InputError
        If a name is not a string, or the placement is not a pin.SE3.

    Examples
    --------
    >>> robot = fflin.load("ets_vii").replace(constraints=[fflin.Weld("base")])
    >>> lin = fflin.linearize(robot)
    >>> len(lin.state_names), lin.rank
    (12, 6)
    """

    KEY = "weld"

    @property
    def rows(self) -> Array:
        """Rows (6, 6) of the relative twist: all."""
        return np.eye(6)


@dataclass(frozen=True, eq=False)
class Hinge(Constraint):
    """Constraint that leaves only the rotation about an axis free: 5 rows.

    Parameters
    ----------
    frame, to, placement, name
        See `Weld`. The placement is the pose of `frame` in `to` at the angle zero of the hinge.
    axis : sequence of float (3,)
        Axis of the hinge through the origin of `frame`, in the axes of `frame`.

    Raises
    ------
    InputError
        If a name is not a string, the placement is not a pin.SE3, or the axis is zero.

    Examples
    --------
    >>> robot = fflin.load("ets_vii").replace(constraints=[fflin.Hinge("base")])
    >>> fflin.linearize(robot).rank
    5
    """

    KEY = "hinge"

    axis: Vector3 = (0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        axis = unit_vector(f"axis of constraint '{self.title}'", self.axis)
        object.__setattr__(self, "axis", axis)

    @property
    def rows(self) -> Array:
        """Rows (5, 6): the linear velocity, and the rotation across the axis."""
        axis = np.array(self.axis)
        across = np.eye(3)[np.argmin(np.abs(axis))]
        first = np.cross(axis, across)
        first /= np.linalg.norm(first)
        rows = np.zeros((5, 6))
        rows[:3, :3] = np.eye(3)
        rows[3, 3:] = first
        rows[4, 3:] = np.cross(axis, first)
        return rows


@dataclass(frozen=True, eq=False)
class Spherical(Constraint):
    """Constraint that holds the origin of a frame at a point, free to rotate: 3 rows.

    Parameters
    ----------
    frame, to, placement, name
        See `Weld`. Only the translation of the placement has an effect.

    Raises
    ------
    InputError
        If a name is not a string, or the placement is not a pin.SE3.

    Examples
    --------
    >>> robot = fflin.load("ets_vii").replace(constraints=[fflin.Spherical("base")])
    >>> fflin.linearize(robot).rank
    3
    """

    KEY = "spherical"

    @property
    def rows(self) -> Array:
        """Rows (3, 6) of the relative twist: the linear velocity."""
        return np.eye(3, 6)


CONSTRAINTS: dict[str, type[Constraint]] = {
    kind.KEY: kind for kind in (Weld, Hinge, Spherical)
}


def checked_constraints(
    value: object, name: str = "constraints"
) -> tuple[Constraint, ...]:
    """Return copies of the constraints of an argument `name`; their own names must differ."""
    given = [value] if isinstance(value, Constraint) else value
    if given is None:
        given = []
    if not isinstance(given, Sequence) or not all(
        isinstance(item, Constraint) for item in given
    ):
        raise InputError(
            f"{name} is {value!r}, expected a list of Weld, Hinge and Spherical"
        )
    titles = [item.title for item in given]
    for title in titles:
        if titles.count(title) > 1:
            raise InputError(
                f"two constraints are named '{title}'; give one of them another name"
            )
    # The copies belong to the new robot, which stores missing placements in them.
    return tuple(replace(item) for item in given)


def checked_independent(value: object) -> tuple[str, ...]:
    """Return the names of independent coordinates; a single string is refused."""
    if value is None:
        return ()
    if (
        isinstance(value, str)
        or not isinstance(value, Sequence)
        or not all(isinstance(name, str) for name in value)
    ):
        raise InputError(
            f"independent is {value!r}, expected a list of coordinates, such as ['q_b', 'left_1']"
        )
    return tuple(value)


def weld_at(
    frame: str,
    to: str | None = None,
    rpy: Sequence[float] | None = None,
    position: Sequence[float] | None = None,
    name: str | None = None,
) -> Weld:
    """Return the weld of a table in a robot file."""
    return Weld(frame, to, placement=_pose(rpy, position), name=name)


def hinge_at(
    frame: str,
    to: str | None = None,
    axis: Vector3 = (0.0, 0.0, 1.0),
    rpy: Sequence[float] | None = None,
    position: Sequence[float] | None = None,
    name: str | None = None,
) -> Hinge:
    """Return the hinge of a table in a robot file."""
    return Hinge(frame, to, axis=axis, placement=_pose(rpy, position), name=name)


def spherical_at(
    frame: str,
    to: str | None = None,
    position: Sequence[float] | None = None,
    name: str | None = None,
) -> Spherical:
    """Return the spherical constraint of a table in a robot file."""
    return Spherical(frame, to, placement=_pose(None, position), name=name)


# {type in a robot file: function that makes the constraint from the keys of its table}
FROM_FILE: dict[str, Callable[..., Constraint]] = {
    "weld": weld_at,
    "hinge": hinge_at,
    "spherical": spherical_at,
}


def _pose(
    rpy: Sequence[float] | None, position: Sequence[float] | None
) -> pin.SE3 | None:
    """Return the placement from `rpy` [deg] and `position` [m], or None if both are omitted."""
    if rpy is None and position is None:
        return None
    angles = three_numbers("rpy", (0.0, 0.0, 0.0) if rpy is None else rpy)
    point = three_numbers("position", (0.0, 0.0, 0.0) if position is None else position)
    rotation = pin.rpy.rpyToMatrix(*np.deg2rad(angles).tolist())
    return pin.SE3(rotation, np.array(point))
