"""Joints and frames of a model, found by name, and checks of configurations and velocities."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from operator import attrgetter
from typing import NamedTuple, TypeAlias, TypeVar

import numpy as np
import pinocchio as pin

from fflin.base.errors import InputError, ModelError, unknown
from fflin.base.names import joints_by_name
from fflin.base.validation import (
    NORM_TOLERANCE,
    ROUND_OFF,
    Array,
    ArrayLike,
    normalised,
    vector,
)

ROOT = 1  # index of the free-flyer among Pinocchio's joints; 0 is the universe

# A `pin.Data` takes about 32 nv^3 bytes, because it contains four tensors with nv^3 entries each.
_DATA_BYTES_PER_NV3 = 32
_DATA_LIMIT = 2**30

T = TypeVar("T")


class Joint(NamedTuple):
    """Joint with one degree of freedom."""

    name: str  # name in the model
    idx_q: int = 0  # index of its first entry in Pinocchio's q
    idx_v: int = 0  # index of its entry in Pinocchio's v
    # continuous: two entries (cos, sin) of q, but one angle in the state
    unbounded: bool = False
    prismatic: bool = False  # its entry of q is a length [m] instead of an angle [rad]
    # "joint", "slosh" for a coordinate of a sloshing mass, or "modal" for a modal amplitude.
    kind: str = "joint"
    scale: float = 1.0  # entry of q per unit of q_m; 1 except for modal amplitudes
    # Generalised inertia of a mode while its link is fixed in space; 1 for a modal amplitude.
    inertia: float = 1.0
    # Upper bound of the rotation [rad] of the appendage or slosh mass per unit of the mode's
    # coordinate; 0 if the mode causes no rotation.
    rotation: float = 0.0

    @property
    def unit(self) -> str:
        """Unit of the joint's position; the joint's rate has this unit per second."""
        if self.kind == "modal":
            return "kg^0.5 m"
        return "m" if self.prismatic else "rad"

    @property
    def force_unit(self) -> str:
        """Unit of the joint's force or torque."""
        if self.kind == "modal":
            return "kg^0.5 m/s^2"
        return "N" if self.prismatic else "N m"

    @property
    def mode(self) -> bool:
        """Whether the joint is a degree of freedom of a flexible appendage or of slosh."""
        return self.kind != "joint"

    def oscillation(self, stiffness: float, damping: float) -> tuple[float, float]:
        """Return a mode's frequency [rad/s] and damping ratio while its link is fixed in space."""
        omega = math.sqrt(stiffness / self.inertia)
        return omega, 0.5 * damping / (self.inertia * omega)

    def place(self, q: Array, value: float | Array) -> None:
        """Write this joint's value [rad|m|kg^0.5 m] into configurations q (nq, ..)."""
        if self.unbounded:
            q[self.idx_q : self.idx_q + 2] = np.cos(value), np.sin(value)
        else:
            q[self.idx_q] = self.scale * value

    def value(self, q: Array) -> float:
        """Return this joint's value [rad|m|kg^0.5 m]; a continuous angle is in (-pi, pi]."""
        return float(self.values(q))

    def values(self, q: Array) -> Array:
        """Return this joint's values (..) at configurations q (nq, ..); see `value`."""
        at: Array = q[self.idx_q]
        values: Array = at / self.scale
        if self.unbounded:
            values = np.arctan2(q[self.idx_q + 1], at)
        return values

    def within(self, model: pin.Model) -> Joint:
        """Return this joint with its indices in `model`, which has a joint of the same name."""
        joint = model.joints[model.getJointId(self.name)]
        return self._replace(idx_q=joint.idx_q, idx_v=joint.idx_v)


class Follower(NamedTuple):
    """Mimic joint, whose position is ``multiplier * leader's position + offset``."""

    joint: Joint
    leader: Joint
    multiplier: float
    offset: float

    def within(self, model: pin.Model) -> Follower:
        """Return this mimic joint with its own indices and its leader's indices in `model`."""
        return self._replace(
            joint=self.joint.within(model), leader=self.leader.within(model)
        )


# Function that returns the joint with a given name, or raises an error that explains the problem.
Find: TypeAlias = Callable[[str], Joint]


def by_joint(
    values: Mapping[str, T], joints: Sequence[str], find: Find
) -> dict[str, T]:
    """Return {joint: value} from {joint or pattern: value}; the key ``q_m`` means all joints."""
    return joints_by_name("joint", values, joints, find)


class Carried(NamedTuple):
    """Location of a frame: index of the joint that carries it, and placement on this joint."""

    joint: int
    placement: pin.SE3


def frame_index(model: pin.Model, name: str) -> int:
    """Return the index of a frame; if a link and a joint share a name, return the link's frame."""
    # Do not use Pinocchio's `getFrameId`: it refuses a name that a link and a joint share, and
    # mistakes a link named "universe" for the world.
    frames = {
        i: f for i, f in enumerate(model.frames.tolist()) if f.parentJoint >= ROOT
    }
    # Check the type of `name` first. If `name` were an array, the comparison would give an array.
    indices = [i for i, f in frames.items() if isinstance(name, str) and f.name == name]
    if not indices:
        raise unknown("frame", str(name), [frame.name for frame in frames.values()])
    return next(
        (i for i in indices if frames[i].type == pin.FrameType.BODY), indices[0]
    )


def find_frame(model: pin.Model, name: str | None) -> Carried:
    """Return the location of a frame; the name None stands for the frame of the root joint."""
    if name is None:
        return Carried(ROOT, pin.SE3.Identity())
    frame = model.frames[frame_index(model, name)]
    return Carried(frame.parentJoint, pin.SE3(frame.placement))


def find_joint(model: pin.Model, name: str) -> Carried:
    """Return the location of the frame of a joint, which may be welded."""
    if model.existJointName(name):
        return Carried(model.getJointId(name), pin.SE3.Identity())
    frame = model.frames[model.getFrameId(name, pin.FrameType.FIXED_JOINT)]
    return Carried(frame.parentJoint, pin.SE3(frame.placement))


@dataclass(frozen=True, eq=False, repr=False)
class Coordinates:
    """Coordinates of a robot, and checks of given configurations q and velocities v."""

    model: pin.Model
    name: str
    joints: tuple[Joint, ...]
    followers: tuple[Follower, ...] = ()
    # Names of wheels and modes that no longer exist, because inputs or appendages were replaced.
    _removed: tuple[str, ...] = ()
    # The model, and a copy of it from the time when the robot was made. If the two differ, the
    # model was changed later.
    _as_made: tuple[pin.Model, pin.Model] | None = None

    @cached_property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the n independent joints, in state order."""
        return tuple(map(attrgetter("name"), self.joints))

    @cached_property
    def n(self) -> int:
        """Number of independent joints."""
        return len(self.joints)

    @cached_property
    def nq(self) -> int:
        """Size of Pinocchio's configuration vector q."""
        return int(self.model.nq)

    @cached_property
    def nv(self) -> int:
        """Size of Pinocchio's velocity vector v: 6 + n, plus one for each mimic joint."""
        return int(self.model.nv)

    @cached_property
    def unbounded(self) -> dict[int, str]:
        """Continuous joints as {index of the cosine in q: joint name}."""
        joints = (*self.joints, *(follower.joint for follower in self.followers))
        return {joint.idx_q: joint.name for joint in joints if joint.unbounded}

    def neutral(self) -> Array:
        """Return the neutral configuration (nq,), in which mimic joints follow their leaders."""
        q: Array = pin.neutral(self.model)
        self.follow(q)
        return q

    def follow(self, q: Array) -> None:
        """Set mimic joints in q (nq, ..) to the values that follow from their leaders."""
        for joint, leader, multiplier, offset in self.followers:
            joint.place(q, multiplier * leader.values(q) + offset)

    def checked_configuration(self, q: ArrayLike) -> Array:
        """Return q (nq,) with small errors corrected; raise `InputError` for larger errors.

        The base quaternion and each pair (cos, sin) are scaled to length 1 if the length differs
        from 1 by at most 1e-5. Mimic joints that deviate by at most 1e-5 are corrected to the
        positions that follow from their leaders.
        """
        corrected = self._sized("q", q, self.nq, "a configuration in Pinocchio's order")
        if not pin.isNormalized(self.model, corrected, ROUND_OFF):
            # `normalised` only checks the lengths here. `pin.normalize` scales all parts at once.
            normalised("the base quaternion (x, y, z, w) q[3:7]", corrected[3:7])
            for at, name in self.unbounded.items():
                label = f"(cos, sin) of continuous joint '{name}', q[{at}:{at + 2}],"
                normalised(label, corrected[at : at + 2])
            corrected = pin.normalize(self.model, corrected)
        if self.followers:
            corrected = self._followed(corrected)
        return corrected

    def checked_velocity(self, v: ArrayLike) -> Array:
        """Return a velocity v (nv,) unchanged if it is valid, or raise `InputError`."""
        v = self._sized("v", v, self.nv, "a velocity in Pinocchio's order")
        for joint, leader, multiplier, _ in self.followers:
            expected = multiplier * v[leader.idx_v]
            if abs(v[joint.idx_v] - expected) > NORM_TOLERANCE * max(
                1.0, abs(expected)
            ):
                raise InputError(
                    f"v[{joint.idx_v}] of joint '{joint.name}' is {v[joint.idx_v]:.9g}, but it "
                    f"mimics '{leader.name}', which requires {expected:.9g}"
                )
        return v

    def _sized(self, name: str, value: ArrayLike, size: int, of_what: str) -> Array:
        """Return a vector (size,); the error for a longer vector names removed wheels and modes."""
        if self._removed and np.size(value) > size:
            gone = ", ".join(self._removed)
            of_what += (
                f"; the coordinates {gone} were removed with the replaced inputs "
                "or appendages"
            )
        return vector(name, value, size, of_what)

    def _followed(self, q: Array) -> Array:
        """Return a copy of q (nq,) in which each mimic joint follows its leader exactly.

        Raise `InputError` if a mimic joint in q deviates by more than 1e-5.
        """
        placed = q.copy()
        self.follow(placed)
        for joint, leader, *_ in self.followers:
            part = slice(joint.idx_q, joint.idx_q + 1 + joint.unbounded)
            error = np.abs(placed[part] - q[part]).max()
            if error > NORM_TOLERANCE * max(1.0, np.abs(placed[part]).max()):
                raise InputError(
                    f"joint '{joint.name}' is at {joint.value(q):.9g}, but it mimics "
                    f"'{leader.name}', which puts it at {joint.value(placed):.9g}; "
                    "use fflin.configuration, which sets mimic joints"
                )
        return placed

    def require_unchanged(self) -> None:
        """Raise `ModelError` if the model was changed in place after the robot was made."""
        made = self._as_made[1] if self._as_made else self.model
        # Comparing the models takes a microsecond. `change_in` is slower, so call it only if they
        # differ.
        if self.model != made and (change := change_in(self.model, made)):
            raise ModelError(
                f"the model of '{self.name}' was changed after the robot was made: {change}; make "
                "a new robot from it with fflin.from_model(model)"
            )

    def create_data(self) -> pin.Data:
        """Return a new pin.Data for this robot, or raise `ModelError` if it exceeds 1 GiB."""
        require_room(self.model, self.name)
        return self.model.createData()


def require_room(model: pin.Model, name: str) -> None:
    """Raise `ModelError` if a pin.Data of a model would exceed 1 GiB."""
    size = _DATA_BYTES_PER_NV3 * int(model.nv) ** 3
    if size > _DATA_LIMIT:
        raise ModelError(
            f"'{name}' has {model.njoints - 2} joints, for which Pinocchio's Data takes about "
            f"{size / 2**30:.1f} GiB, more than the limit of 1 GiB; lock unimportant joints"
        )


def change_in(model: pin.Model, made: pin.Model) -> str:
    """Return text that names a difference between `model` and `made`, or an empty text.

    Only properties that affect A, B or C are compared. Changed limits and new frames are ignored.
    """
    of_joints = {
        "joints": "axis",
        "jointPlacements": "placement",
        "inertias": "inertia",
    }
    for name in ("names", "parents", *of_joints, "armature", "frames"):
        now, before = list(getattr(model, name)), list(getattr(made, name))
        if name == "frames":
            now = now[: len(before)]
        if now != before:
            at = next((i for i, x in enumerate(before) if now[i : i + 1] != [x]), 0)
            if name in of_joints:
                return f"the {of_joints[name]} of joint '{made.names[at]}'"
            if name == "frames":
                return f"the frame '{made.frames[at].name}'"
            return f"its {name}"
    if model.gravity != made.gravity:
        return "its gravity"
    return ""


def joint_of(model: pin.Model, index: int) -> Joint:
    """Return joint `index` of a model; raise `ModelError` unless it has one degree of freedom."""
    joint, name = model.joints[index], model.names[index]
    kind = joint.shortname()
    if kind == "JointModelMimic":
        raise ModelError(
            f"joint '{name}' is a JointModelMimic, for which Pinocchio has no derivatives; load "
            "the URDF with fflin.load, or build the model with mimic=False"
        )
    if joint.nv != 1 or joint.nq not in (1, 2):
        raise ModelError(
            f"joint '{name}' is a {kind.removeprefix('JointModel')} of {joint.nv} "
            f"degrees of freedom, expected 1; lock it with lock=['{name}']"
        )
    return Joint(
        name, joint.idx_q, joint.idx_v, joint.nq == 2, kind.startswith("JointModelP")
    )
