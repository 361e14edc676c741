"""The robot that every other call speaks of: a free-flyer root and n one-degree joints."""

import warnings
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from fflin.errors import FflinWarning, InputError, ModelError, unknown
from fflin.reader import read_urdf
from fflin.robots import find_robot
from fflin.urdf_joints import Mimic
from fflin.validation import NORM_TOLERANCE, Array, number, vector

ROOT = 1  # index of the free-flyer among Pinocchio's joints; 0 is the universe

# Data holds a third-order tensor of nv^3 entries among others: about 32 nv^3 bytes in all.
_DATA_BYTES_PER_NV3 = 32
_DATA_LIMIT = 2**30


class Joint(NamedTuple):
    """One independent joint of one degree of freedom.

    Attributes
    ----------
    name : str
        Its name in the model.
    idx_q, idx_v : int
        Where it begins in Pinocchio's q and v.
    unbounded : bool
        Stored as (cos, sin), two entries of q; one angle in the state.
    prismatic : bool
        A length in metres; otherwise an angle in radians.
    """

    name: str
    idx_q: int
    idx_v: int
    unbounded: bool
    prismatic: bool

    def place(self, q: Array, value: float) -> None:
        """Write this joint's angle [rad] or length [m] into a configuration."""
        if self.unbounded:
            q[self.idx_q : self.idx_q + 2] = np.cos(value), np.sin(value)
        else:
            q[self.idx_q] = value


@dataclass(frozen=True, eq=False, repr=False)
class Robot:
    """A robot floating free; made by `load` or `from_model`.

    Attributes
    ----------
    model : pin.Model
        Free-flyer root joint, zero gravity.
    name : str
        Name or file stem it was loaded by.
    urdf : Path or None
        The file it was read from.
    urdf_sha256 : str
        Hash of that file; empty where there is none.
    joints : tuple of Joint
        The n independent joints in state order, which is Pinocchio's.
    notes : tuple of str
        What was warned of when it was read.
    mimics : mapping
        {joint: Mimic} of the joints that follow another.
    """

    model: pin.Model
    name: str
    urdf: Path | None
    urdf_sha256: str
    joints: tuple[Joint, ...]
    notes: tuple[str, ...] = ()
    mimics: Mapping[str, Mimic] = field(default_factory=dict)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the n independent joints in state order."""
        return tuple(joint.name for joint in self.joints)

    @property
    def n(self) -> int:
        """Number of independent joints."""
        return len(self.joints)

    @property
    def mass(self) -> float:
        """Total mass in kg."""
        return float(sum(inertia.mass for inertia in self.model.inertias.tolist()[ROOT:]))

    def __repr__(self) -> str:
        return f"Robot('{self.name}', n={self.n}, mass={self.mass:.6g} kg)"

    def joint(self, name: str) -> Joint:
        """Return the joint of that name, or raise `UnknownNameError` with the near names."""
        for joint in self.joints:
            if joint.name == name:
                return joint
        raise unknown("joint", name, self.joint_names)

    def checked_configuration(self, q: Array) -> Array:
        """Return `q` as a valid configuration of this robot.

        Parameters
        ----------
        q : array_like (nq,)
            Configuration in Pinocchio's order. Its quaternion, and the (cos, sin) of every
            continuous joint, are renormalised where they are within 1e-6 of unit length.

        Returns
        -------
        ndarray (nq,)
            `q` itself where nothing was to be done, never modified.

        Raises
        ------
        InputError
            If the size is wrong, an entry is not finite, or a part is not of unit length.
        """
        q = vector("q", q, self.model.nq, f"a configuration of '{self.name}'")
        _, _, _, x, y, z, w, *joints = q.tolist()
        excess = x * x + y * y + z * z + w * w - 1.0
        worst = abs(excess)
        if worst > NORM_TOLERANCE:
            raise InputError(
                f"the base quaternion q[3:7] has length {np.sqrt(excess + 1.0):.9g}, expected 1; "
                "normalise it (x, y, z, w)"
            )
        for joint in self.joints:
            if joint.unbounded:
                c, s = joints[joint.idx_q - 7 : joint.idx_q - 5]
                excess = c * c + s * s - 1.0
                if abs(excess) > NORM_TOLERANCE:
                    raise InputError(
                        f"(cos, sin) of continuous joint '{joint.name}', "
                        f"q[{joint.idx_q}:{joint.idx_q + 2}], has length "
                        f"{np.sqrt(excess + 1.0):.9g}, expected 1"
                    )
                worst = max(worst, abs(excess))
        # Two ulp of unity: below it there is nothing to renormalise.
        return q if worst <= 2 * np.finfo(float).eps else pin.normalize(self.model, q)

    def create_data(self) -> pin.Data:
        """Make Pinocchio's work space for this robot.

        Raises
        ------
        ModelError
            If it would take more than 1 GiB.
        """
        size = _DATA_BYTES_PER_NV3 * self.model.nv**3
        if size > _DATA_LIMIT:
            raise ModelError(
                f"'{self.name}' has {self.n} joints, for which Pinocchio's Data takes about "
                f"{size / 2**30:.1f} GiB (limit 1 GiB); lock joints that do not matter"
            )
        return self.model.createData()


def load(
    robot: str | Path,
    *,
    lock: Mapping[str, float | None] | Iterable[str] | None = None,
) -> Robot:
    """Load a robot as a free flyer in zero gravity.

    Parameters
    ----------
    robot : str or Path
        Bundled name, example-robot-data name, or path to a URDF. No mesh is loaded.
    lock : mapping or iterable of str, optional
        {joint: value [rad|m]} welded at that value (None: at neutral), or names.

    Returns
    -------
    Robot

    Raises
    ------
    UnknownNameError
        If there is no such robot or joint to lock.
    FileError, UrdfError
        If the file cannot be read or is malformed.
    MissingPackageError
        If it is a xacro and the package that expands it is not installed.
    ModelError
        If a joint has more than one degree of freedom.

    Warns
    -----
    FflinWarning
        Of what the file holds and the model does not, and of what cannot be quite right in it.
    """
    found = find_robot(robot)
    description = read_urdf(found.path, found.prune)
    loaded = _robot(description.model, found.name, found.path, description.sha256, lock)
    for note in description.notes:
        warnings.warn(note, FflinWarning, stacklevel=2)
    return replace(loaded, notes=description.notes, mimics=description.mimics)


def from_model(
    model: pin.Model,
    *,
    name: str | None = None,
    lock: Mapping[str, float | None] | Iterable[str] | None = None,
) -> Robot:
    """Take a Pinocchio model built by other means (MJCF, SDF, code).

    Parameters
    ----------
    model : pin.Model
        Model whose one root joint is a free-flyer. It is copied; gravity of the copy is zero.
    name : str, optional
        Name of the robot; the model's own by default.
    lock : mapping or iterable of str, optional
        As in `load`.

    Returns
    -------
    Robot

    Raises
    ------
    ModelError
        If the root is not one free-flyer, a joint has more than one degree of freedom, or the
        joints are not in depth-first order, in which CRBA would be silently wrong.
    """
    copy = model.copy()
    copy.gravity.setZero()
    return _robot(copy, name or model.name or "model", None, "", lock)


def configuration(
    robot: Robot,
    joints: Mapping[str, float] | None = None,
    base: pin.SE3 | None = None,
) -> Array:
    """Build a Pinocchio configuration.

    Parameters
    ----------
    robot : Robot
    joints : mapping, optional
        {joint: value [rad|m]}; the others stay at neutral.
    base : pin.SE3, optional
        Placement of the base in the world; the identity by default.

    Returns
    -------
    ndarray (nq,)

    Raises
    ------
    UnknownNameError
        If there is no such joint.
    InputError
        If a value is not a finite number.
    """
    q = pin.neutral(robot.model)
    if base is not None:
        q[:7] = pin.SE3ToXYZQUAT(robot.model.jointPlacements[ROOT].actInv(base))
    for name, value in (joints or {}).items():
        robot.joint(name).place(q, number(f"joint '{name}'", value))
    return robot.checked_configuration(q)


def _robot(
    model: pin.Model,
    name: str,
    urdf: Path | None,
    sha256: str,
    lock: Mapping[str, float | None] | Iterable[str] | None,
) -> Robot:
    _check_root(model, name)
    if lock:
        model = _lock(model, lock)
    joints = tuple(_joint(model, index) for index in range(ROOT + 1, model.njoints))
    robot = Robot(model, name, urdf, sha256, joints)
    if not model.check(robot.create_data()):
        raise ModelError(
            f"'{name}': the joints are not in depth-first order, in which Pinocchio's CRBA is "
            "wrong; add the joints of one branch before those of the next"
        )
    return robot


def _check_root(model: pin.Model, name: str) -> None:
    root = model.joints[ROOT].shortname() if model.njoints > ROOT else "none"
    if root != "JointModelFreeFlyer":
        raise ModelError(
            f"'{name}': the root joint is {root}, expected JointModelFreeFlyer; build the model "
            "with pin.JointModelFreeFlyer() as its root joint"
        )
    fixed = [model.names[i] for i in range(ROOT + 1, model.njoints) if model.parents[i] == 0]
    if fixed:
        raise ModelError(
            f"'{name}': joint '{fixed[0]}' hangs on the world beside the free-flyer; "
            "everything that moves must hang on one base"
        )


def _lock(model: pin.Model, lock: Mapping[str, float | None] | Iterable[str]) -> pin.Model:
    names = [lock] if isinstance(lock, str) else list(lock)
    values = lock if isinstance(lock, Mapping) else {}
    movable = list(model.names)[ROOT + 1 :]
    q = pin.neutral(model)
    for name in names:
        if name not in movable:
            raise unknown("joint to lock", name, movable)
        value = values.get(name)
        if value is not None:
            _joint(model, model.getJointId(name)).place(q, number(f"lock '{name}'", value))
    return pin.buildReducedModel(model, [model.getJointId(name) for name in names], q)


def _joint(model: pin.Model, index: int) -> Joint:
    joint = model.joints[index]
    kind = joint.shortname()
    if joint.nv != 1 or joint.nq not in (1, 2):
        raise ModelError(
            f"joint '{model.names[index]}' is a {kind.removeprefix('JointModel')} of {joint.nv} "
            f"degrees of freedom, expected one; lock it (lock=['{model.names[index]}'])"
        )
    prismatic = kind.startswith("JointModelP")
    return Joint(model.names[index], joint.idx_q, joint.idx_v, joint.nq == 2, prismatic)
