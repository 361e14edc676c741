"""Robots loaded from a file, or made from a Pinocchio model that was built by other means."""

import warnings
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin

from fflin.base.errors import FflinWarning, ModelError
from fflin.base.validation import instance, is_rotation
from fflin.base.writing import remember
from fflin.robot.catalog import find_mesh, find_robot, folders
from fflin.robot.joints import ROOT, Follower, joint_of, require_room
from fflin.robot.mass_properties import LinkMass, given_body, massless_note
from fflin.robot.robot import Robot
from fflin.robot.urdf.description import Mimic, is_impossible
from fflin.robot.urdf.reader import read_urdf
from fflin.robot.welding import Lock, locked_model, requested, welded


def load(
    robot: str | Path,
    *,
    lock: Lock | None = None,
    package_dirs: Sequence[str | Path] = (),
    **fields: object,
) -> Robot:
    """Load a robot as a free flyer, by default in zero gravity.

    Parameters
    ----------
    robot : str or Path
        Name of a bundled robot or of a robot in example-robot-data, or path of a URDF or robot
        file. A robot file is a TOML file that names a URDF and sets fields of the robot; see the
        guide. No mesh is loaded.
    lock : mapping or iterable of str, optional
        Joints to weld, as names or as {joint: value [rad|m]}. A joint given only by its name, or
        with the value None, is welded at its neutral position. A name may be a pattern such as
        ``hinge_*``. Mimic joints of a locked joint are also welded.
    package_dirs : sequence of path
        Folders to search for ``package://`` meshes when the robot is drawn. They are searched
        before the folders that contain the URDF.
    **fields
        Fields of the robot: inputs, outputs, appendages, stiffness, damping, rest, gravity, orbit,
        limits, passive, weights, point, target and start; see `Robot.replace`. Fields given here
        take precedence over the robot file. Locks, limits, springs and dampers are merged with the
        robot file: an entry given here replaces only the entry with the same name.

    Returns
    -------
    Robot

    Raises
    ------
    UnknownNameError
        If a robot, joint, frame or field does not exist.
    InputError
        If a field has a wrong value.
    FileError, UrdfError
        If the file cannot be read or is malformed.
    MissingPackageError
        If the file is written in xacro, but the package that expands xacro is not installed.
    ModelError
        If a joint has more than one degree of freedom.

    Warns
    -----
    FflinWarning
        If a part of the file is ignored, or the file contains likely errors.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> robot.joint_names
    ('joint_1', 'joint_2', 'joint_3')
    >>> fflin.load("servicer_7dof", lock={"panel_left": 0.1}, gravity=(0, 0, -9.81)).n
    8
    """
    found, dirs = find_robot(robot), folders(package_dirs)
    first = None if lock is None else requested(lock)
    later: dict[str, float | None] = {}
    file = None
    if found.path.suffix.lower() == ".toml":
        from fflin.robot.robot_files import RobotToml

        file = RobotToml(found.path, found.name)
        later, first = first or {}, None
        found, dirs = file.found, (*dirs, *file.package_dirs)
        if file.lock:
            first = {name: later.pop(name, value) for name, value in file.lock.items()}
    urdf = read_urdf(found.path)
    with file.document.located("lock") if file and first else nullcontext():
        loaded = _robot(urdf.model, found.name, first, urdf.mimics)
    dirs = (*dirs, *found.package_dirs)
    # Meshes are read only when the robot is drawn, so output files must not overwrite them.
    remember(*filter(None, (find_mesh(uri, found.path, dirs) for uri in urdf.meshes)))
    damping = {name: urdf.joints[name].damping for name in loaded.joint_names}
    # Damping of a mimic joint is added to its leader so that the dissipated power remains the
    # same.
    for joint, leader, multiplier, _ in loaded.followers:
        damping[leader.name] += multiplier**2 * urdf.joints[joint.name].damping
    loaded = replace(
        loaded,
        urdf=found.path,
        urdf_sha256=urdf.sha256,
        notes=urdf.notes,
        package_dirs=dirs,
        urdf_damping=damping,
        links={
            name: LinkMass(link.mass, link.tensor, link.com.placement)
            for name, link in urdf.links.items()
            if link.mass
        },
        file_joints=tuple(urdf.joints),
    )
    if file:
        loaded = file.applied(loaded)
    if later:
        loaded = welded(loaded, later)
    loaded = loaded.merged(fields)
    # Fields of the robot resolve some warnings, if they name all joints of the warning.
    gone = {name.rpartition("=")[0] for name in loaded.locked}
    notes = [*loaded.notes]
    for field, names, text in urdf.advice:
        said = {*getattr(loaded, field, ()), *gone}
        said |= {x.joint.name for x in loaded.followers if x.leader.name in said}
        if not {*names} <= said:
            notes.append(text)
    for note in notes:
        warnings.warn(note, FflinWarning, stacklevel=2)
    if loaded.idle_coordinates:
        # Add a note instead of a warning, because every function that inverts M raises an error
        # anyway.
        notes.append(massless_note(loaded))
    return replace(loaded, notes=tuple(notes))


def from_model(
    model: pin.Model, *, name: str | None = None, lock: Lock | None = None, **fields: object
) -> Robot:
    """Make a robot from a Pinocchio model that was built from MJCF, SDF or code.

    Parameters
    ----------
    model : pin.Model
        Model whose only root joint is a free-flyer. The robot contains a copy of the model with
        zero gravity.
    name : str, optional
        Name of the robot; the model's name by default.
    lock : mapping or iterable of str, optional
        Joints to weld, as in `load`.
    **fields
        Fields of the robot, as in `load`. With damping="urdf", the ``damping`` of the model is
        used.

    Returns
    -------
    Robot

    Raises
    ------
    ModelError
        If one of these conditions is true:

        - the root is not a single free-flyer;
        - a joint has more than one degree of freedom;
        - the joints are not in depth-first order, in which case the inertia matrix of Pinocchio's
          CRBA would be wrong without an error;
        - a placement, the inertia of a body or an armature is not physically realisable.

    Examples
    --------
    >>> import pinocchio as pin
    >>> model = pin.buildSampleModelHumanoidRandom()  # on a free-flyer
    >>> fflin.from_model(model, name="random").n
    26
    """
    if not isinstance(model, pin.Model):
        raise ModelError(f"the model has type {type(model).__name__}, expected a pin.Model")
    instance("name", name, (str, type(None)), "a string")
    copy = model.copy()
    copy.gravity.setZero()
    name = name or model.name or "model"
    _check_model(copy, name)
    robot = _robot(copy, name, lock, {})
    own = {joint.name: float(robot.model.damping[joint.idx_v]) for joint in robot.joints}
    robot = replace(robot, urdf_damping=own)
    return robot.replace(**fields) if fields else robot


def _robot(model: pin.Model, name: str, lock: Lock | None, mimics: Mapping[str, Mimic]) -> Robot:
    """Make a robot of a model, which must be one depth-first tree on one free-flyer."""
    root = model.joints[ROOT].shortname() if model.njoints > ROOT else "none"
    if root != "JointModelFreeFlyer":
        raise ModelError(
            f"'{name}': the root joint is {root}, expected JointModelFreeFlyer; build the model "
            "with pin.JointModelFreeFlyer() as its root joint"
        )
    fixed = [model.names[i] for i in range(ROOT + 1, model.njoints) if model.parents[i] == 0]
    if fixed:
        raise ModelError(
            f"'{name}': joint '{fixed[0]}' is attached to the world, not to the free-flyer; "
            "connect every moving link to the base"
        )
    require_room(model, name)
    locked: tuple[str, ...] = ()
    if lock is not None:
        model, mimics, locked = locked_model(model, lock, mimics)
    all_joints = [joint_of(model, index) for index in range(ROOT + 1, model.njoints)]
    by_name = {joint.name: joint for joint in all_joints}
    joints = tuple(joint for joint in all_joints if joint.name not in mimics)
    followers = tuple(
        Follower(by_name[joint], by_name[mimic.leader], mimic.multiplier, mimic.offset)
        for joint, mimic in mimics.items()
    )
    above: list[int] = []
    for joint, parent in enumerate(model.parents.tolist()):
        while above and above[-1] != parent:
            above.pop()
        if joint and not above:
            raise ModelError(
                f"'{name}': the joints are not in depth-first order, for which Pinocchio's CRBA "
                "gives wrong results; add all joints of one branch before the joints of the "
                "next branch"
            )
        above.append(joint)
    return Robot(model, name, None, "", joints, followers, locked=locked)


def _check_model(model: pin.Model, name: str) -> None:
    """Raise `ModelError` if a joint or body has physically impossible numbers."""
    for index in range(ROOT, model.njoints):
        body, joint, parent = model.inertias[index], model.joints[index], model.parents[index]
        armature = model.armature[joint.idx_v : joint.idx_v + joint.nv]
        moments = np.linalg.eigvalsh(np.nan_to_num(body.inertia)).tolist()
        shown = ", ".join(f"{moment:.3g}" for moment in moments)
        finite = np.isfinite([body.mass, *body.lever, *body.inertia.ravel(), *armature]).all()
        faults = {
            f"the parent {parent}, expected a joint before {index}": parent >= index,
            "a placement that is not finite, or whose matrix R is not a rotation": not (
                is_rotation(model.jointPlacements[index].rotation)
                and np.isfinite(model.jointPlacements[index].translation).all()
            ),
            "a mass, centre of mass, inertia or armature that is not finite": not finite,
            f"a link with a mass of {body.mass:g} kg, expected 0 or more": body.mass < 0.0,
            f"a link with principal moments of inertia of {shown} kg m^2, expected 0 or more": (
                is_impossible(body.mass, moments)
            ),
            f"an armature of {armature.tolist()}, expected 0 or more": (armature < 0.0).any(),
        }
        for fault in (fault for fault, found in faults.items() if found):
            raise ModelError(f"'{name}': joint '{model.names[index]}' has {fault}; correct it")


def body_alone(payload: pin.Inertia, name: str) -> Robot:
    """Return a robot that consists of one body without joints; the body must have a mass."""
    inertia = given_body("payload", payload, payload)
    model = pin.Model()
    model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "root_joint")
    model.appendBodyToJoint(1, inertia, pin.SE3.Identity())
    model.addJointFrame(1)
    return from_model(model, name=name)
