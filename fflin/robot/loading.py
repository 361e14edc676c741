"""Robots, loaded from a URDF or a robot file, or made from a Pinocchio model.

A robot file is a TOML file that names a URDF, and sets inputs, outputs and other fields of the
robot.
"""

import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext, suppress
from dataclasses import replace
from functools import partial
from inspect import signature
from pathlib import Path
from typing import TypeVar

import numpy as np
import pinocchio as pin

from fflin.base import record as saved
from fflin.base.errors import (
    FflinError,
    FflinWarning,
    FileError,
    InputError,
    ModelError,
    listed,
    require_known,
)
from fflin.base.toml_file import TomlFile, flat
from fflin.base.validation import by_name, instance, is_rotation, printable, rotated
from fflin.base.writing import RECORDS, read_file, remember, shown
from fflin.robot.catalog import RobotFile, find_inputs, find_mesh, find_robot, folders
from fflin.robot.constraints import FROM_FILE, Constraint
from fflin.robot.equipment.appendages import Appendage, FlexibleAppendage, Slosh
from fflin.robot.fields import FIELDS
from fflin.robot.inputs import KINDS, Input
from fflin.robot.joints import ROOT, Follower, joint_of, require_room
from fflin.robot.mass_properties import given_body, massless_note
from fflin.robot.mjcf import describe_mjcf, is_mjcf
from fflin.robot.outputs import KINDS as OUTPUTS
from fflin.robot.outputs import Output
from fflin.robot.robot import Robot
from fflin.robot.robot_data import LinkMass
from fflin.robot.urdf.description import JointElement, Mimic, is_impossible
from fflin.robot.urdf.reader import SIZE_LIMIT, Urdf, describe, ignored
from fflin.robot.welding import Lock, locked_model, requested, welded

T = TypeVar("T")

# If R^T R differs from I by more than this value, the placement was not computed in double
# precision, but has a few decimals.
_SKEWED = 1e-12

# Fields that are arrays of tables in a robot file: {field: names of the arrays}. For example, the
# tables [[input]] give the field `inputs`.
_TABLES = {
    "inputs": ("input",),
    "outputs": ("outputs", "output"),  # texts, or tables with the properties of sensors
    "appendages": ("flexible", "slosh"),
    "constraints": ("constraint",),
}

# Keys of a robot file; the guide explains them. A file without the key `urdf` contains only inputs.
KEYS = (
    "urdf",
    "package_dirs",
    "xacro",
    "lock",
    *(table for tables in _TABLES.values() for table in tables),
    *(name for name in FIELDS if name not in _TABLES),
)

_TYPES = {kind.KEY: kind for kind in KINDS}
_OUTPUT_TYPES = {kind.WORD: kind for kind in OUTPUTS}


def load(
    robot: str | Path,
    *,
    lock: Lock | None = None,
    package_dirs: Sequence[str | Path] = (),
    xacro: Mapping[str, object] | None = None,
    **fields: object,
) -> Robot:
    """Load a robot as a free flyer, by default in zero gravity.

    Parameters
    ----------
    robot : str or Path
        Name of a bundled robot or of a robot in example-robot-data, or path of a URDF, an MJCF file
        of MuJoCo (``.xml``) or a robot file. A robot file is a TOML file that names a URDF or MJCF
        file and sets fields of the robot; see the guide. No mesh is loaded.
    lock : mapping or iterable of str, optional
        Joints to weld, as names or as {joint: value [rad|m]}. A joint given only by its name, or
        with the value None, is welded at its neutral position. A name may be a pattern such as
        ``hinge_*``. Mimic joints of a locked joint are also welded.
    package_dirs : sequence of path
        Folders to search for ``package://`` meshes when the robot is drawn. They are searched
        before the folders that contain the URDF.
    xacro : mapping, optional
        Arguments of a xacro file, as {name: value}: the values of its ``<xacro:arg>``. They take
        precedence over the table ``[xacro]`` of the robot file.
    **fields
        Fields of the robot: inputs, outputs, appendages, constraints, stiffness, damping, rest,
        gravity, orbit, disturbance, limits, passive, weights, tune, point, target and start; see
        `Robot.replace`. Fields
        given here take precedence over the robot file. Locks, limits, springs and dampers are
        merged with the robot file: an entry given here replaces only the entry with the same name.

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
    robot_file, dirs, locks = find_robot(robot), folders(package_dirs), requested(lock)
    arguments = _xacro_arguments(xacro)
    document = None
    later = dict[str, float | None]()
    file_fields = dict[str, object]()
    if robot_file.path.suffix.lower() == ".toml":
        document, robot_file, file_fields = _read_robot_file(robot_file)
        with document.located("lock"):
            file_locks = requested(file_fields.pop("lock", ()))
        with document.located("xacro"):
            arguments = _xacro_arguments(file_fields.pop("xacro", None)) | arguments
        later = locks
        locks = {name: locks.pop(name, value) for name, value in file_locks.items()}
    _refuse_result(robot_file.path)
    content = read_file(robot_file.path, "URDF", SIZE_LIMIT)
    location = document.located("lock") if document else nullcontext()
    dirs = (*dirs, *robot_file.package_dirs)
    joints: Mapping[str, JointElement] = {}
    if is_mjcf(content, robot_file.path):
        with location:
            loaded = _from_mjcf(content, robot_file, locks)
    else:
        urdf = describe(content, robot_file.path, arguments)
        joints = urdf.joints
        with location:
            loaded = _robot(urdf.model, robot_file.name, locks, urdf.mimics)
        loaded = _of_urdf(loaded, urdf, robot_file.path, dirs, arguments)
    for key, value in file_fields.items():
        assert document is not None
        tables = _TABLES.get(key, (key,))
        with document.located(next(x for x in tables if x in document.record)):
            loaded = loaded.replace(**{key: value})
    if later:
        loaded = welded(loaded, later)
    loaded = loaded.merged(fields)
    # Omit a warning if each of its joints is locked, is named in the robot's field `field`, or
    # mimics such a joint.
    gone = {name.rpartition("=")[0] for name in loaded.locked}
    notes = [*loaded.notes]
    for field, names, text in ignored(joints, robot_file.path.stem):
        named_joints = {*getattr(loaded, field, ()), *gone}
        named_joints |= {
            x.joint.name for x in loaded.followers if x.leader.name in named_joints
        }
        if not {*names} <= named_joints:
            notes.append(text)
    for note in notes:
        warnings.warn(note, FflinWarning, stacklevel=2)
    if loaded.idle_coordinates:
        # Add a note that M is singular. Do not warn, because every function that inverts M raises
        # an error.
        notes.append(massless_note(loaded, loaded.idle_coordinates))
    return replace(loaded, notes=tuple(notes))


def _of_urdf(
    robot: Robot,
    urdf: Urdf,
    path: Path,
    dirs: tuple[Path, ...],
    arguments: Mapping[str, str],
) -> Robot:
    """Add the fields that describe the URDF at a path to a robot."""
    # Register the mesh files now, so that no output file can overwrite them. The meshes are read
    # only later, when the robot is drawn.
    remember(*filter(None, (find_mesh(uri, path, dirs) for uri in urdf.meshes)))
    return replace(
        robot,
        urdf=path,
        urdf_sha256=urdf.sha256,
        notes=urdf.notes,
        package_dirs=dirs,
        xacro=arguments,
        links={
            name: LinkMass(link.mass, link.inertia, link.com.placement)
            for name, link in urdf.links.items()
            if link.mass
        },
        file_joints=tuple(urdf.joints),
    )


def _from_mjcf(content: bytes, robot_file: RobotFile, locks: Lock) -> Robot:
    """Make a robot from an MJCF file, with its constraints, springs, gravity and motors."""
    mjcf = describe_mjcf(content, robot_file.path)
    _check_model(mjcf.model, robot_file.name)
    _normalise_placements(mjcf.model)
    robot = _robot(mjcf.model, robot_file.name, {}, {})
    robot = robot.replace(**mjcf.fields)
    robot = replace(robot, notes=mjcf.notes)
    if locks:
        robot = welded(robot, locks)
    return robot


def from_model(
    model: pin.Model,
    *,
    name: str | None = None,
    lock: Lock | None = None,
    **fields: object,
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
        raise ModelError(
            f"the model has type {type(model).__name__}, expected a pin.Model"
        )
    if instance("name", name, (str, type(None)), "a string"):
        printable("name", name)
    copy = model.copy()
    copy.gravity.setZero()
    name = name or model.name or "model"
    _check_model(copy, name)
    _normalise_placements(copy)
    robot = _robot(copy, name, requested(lock), {})
    if fields:
        robot = robot.replace(**fields)
    return robot


def _robot(
    model: pin.Model, name: str, lock: Lock, mimics: Mapping[str, Mimic]
) -> Robot:
    """Make a robot from a model of one tree on a free-flyer, with joints in depth-first order.

    Raise `ModelError` for any other model.
    """
    root = model.joints[ROOT].shortname() if model.njoints > ROOT else "none"
    if root != "JointModelFreeFlyer":
        raise ModelError(
            f"'{name}': the root joint is {root}, expected JointModelFreeFlyer; build the model "
            "with pin.JointModelFreeFlyer() as its root joint"
        )
    fixed = [
        model.names[i] for i in range(ROOT + 1, model.njoints) if model.parents[i] == 0
    ]
    if fixed:
        raise ModelError(
            f"'{name}': joint '{fixed[0]}' is attached to the world, not to the free-flyer; "
            "connect every moving link to the base"
        )
    require_room(model, name)
    locked: tuple[str, ...] = ()
    if lock:
        model, mimics, locked = locked_model(model, lock, mimics)
    by_name = {
        model.names[i]: joint_of(model, i) for i in range(ROOT + 1, model.njoints)
    }
    joints = tuple(joint for name, joint in by_name.items() if name not in mimics)
    followers = tuple(
        Follower(by_name[x], by_name[m.leader], *m[1:]) for x, m in mimics.items()
    )
    # In depth-first order, the joint indices of each subtree are consecutive: the last index
    # exceeds the first by the number of joints minus 1.
    if any(
        subtree[len(subtree) - 1] - subtree[0] > len(subtree) - 1
        for subtree in model.subtrees
    ):
        raise ModelError(
            f"'{name}': the joints are not in depth-first order, for which Pinocchio's CRBA gives "
            "wrong results; add all joints of one branch before the joints of the next branch"
        )
    damping = {joint.name: float(model.damping[joint.idx_v]) for joint in joints}
    # Add the damping of each mimic joint to its leader. The factor multiplier^2 keeps the
    # dissipated power the same.
    for follower, leader, multiplier, _ in followers:
        damping[leader.name] += multiplier**2 * float(model.damping[follower.idx_v])
    return Robot(model, name, joints, followers, locked=locked, urdf_damping=damping)


def _check_model(model: pin.Model, name: str) -> None:
    """Raise `ModelError` if a value of a joint or body is infinite, NaN or unphysical."""
    for index in range(ROOT, model.njoints):
        body = model.inertias[index]
        joint = model.joints[index]
        parent = model.parents[index]
        armature = model.armature[joint.idx_v : joint.idx_v + joint.nv]
        moments = np.linalg.eigvalsh(np.nan_to_num(body.inertia)).tolist()
        shown = ", ".join(f"{moment:.3g}" for moment in moments)
        finite = np.isfinite(
            [body.mass, *body.lever, *body.inertia.ravel(), *armature]
        ).all()
        faults = {
            f"the parent {parent}, expected a joint before {index}": parent >= index,
            "a placement that is not finite, or whose matrix R is not a rotation": not (
                is_rotation(model.jointPlacements[index].rotation)
                and np.isfinite(model.jointPlacements[index].translation).all()
            ),
            "a mass, centre of mass, inertia or armature that is not finite": not finite,
            f"a link with a mass of {body.mass:g} kg, expected 0 or more": body.mass
            < 0.0,
            f"a link with principal moments of inertia of {shown} kg m^2, expected 0 or more": (
                is_impossible(body.mass, moments)
            ),
            f"an armature of {armature.tolist()}, expected 0 or more": (
                armature < 0.0
            ).any(),
        }
        for fault in (fault for fault, present in faults.items() if present):
            raise ModelError(
                f"'{name}': joint '{model.names[index]}' has {fault}; correct it"
            )


def _normalise_placements(model: pin.Model) -> None:
    """Replace the matrices R of joints and frames that are rotations only to a few decimals."""
    for index in range(ROOT, model.njoints):
        model.jointPlacements[index] = _normalised(model.jointPlacements[index])
    for frame in model.frames:
        frame.placement = _normalised(frame.placement)


def _normalised(given: pin.SE3) -> pin.SE3:
    error = np.abs(given.rotation.T @ given.rotation - np.eye(3)).max()
    if error > _SKEWED and is_rotation(given.rotation):
        return rotated(given)
    return given


def body_alone(payload: pin.Inertia, name: str) -> Robot:
    """Return a robot without joints, whose only body is `payload`; the mass must be positive."""
    inertia = given_body("payload", payload, payload)
    model = pin.Model()
    model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "root_joint")
    model.appendBodyToJoint(1, inertia, pin.SE3.Identity())
    model.addJointFrame(1)
    return from_model(model, name=name)


def load_inputs(path: str | Path) -> tuple[Input, ...]:
    """Read the inputs of a robot from a TOML file.

    The file is an array of tables ``[[input]]``, one table per input, in the order of u. In each
    table, ``type`` selects the class of the input. The other keys are the parameters of this class:

    ==================  ===============  =========================================
    ``type``            class            keys
    ==================  ===============  =========================================
    ``base_torque``     `BaseTorque`     no other keys
    ``base_force``      `BaseForce`      no other keys
    ``joint_torque``    `JointTorque`    ``joint``
    ``thruster``        `Thruster`       ``frame``, ``position`` [m] and
                                         ``direction``; optional: ``name``,
                                         ``on_off``, ``least_impulse`` [N s],
                                         ``torque`` [N m per N],
                                         ``isp`` [s]
    ``reaction_wheel``  `ReactionWheel`  ``axis``; optional: ``frame``, ``name``,
                                         and either ``inertia`` [kg m^2] with
                                         ``max_speed`` [rad/s], or ``momentum``
                                         [N m s]
    ``magnetorquer``    `Magnetorquer`   ``axis``; optional: ``frame``, ``name``
    ==================  ===============  =========================================

    Every type also accepts ``max`` and ``min`` [N m | N | A m^2], the largest and the smallest
    value of the input. For base inputs, each limit is one number, or three numbers. If ``min`` is
    omitted, it is -max, or 0 for a thruster. With ``on_off = true``, a thruster fires in pulses of
    ``max``. Every type accepts ``lag`` [s], the time constant of the actuator.

    Parameters
    ----------
    path : str or Path
        Path of the file, or the name of a bundled file: ``"cubesat"`` or ``"servicer_7dof"``.

    Returns
    -------
    tuple of Input

    Raises
    ------
    FileError
        If the path is not a regular file, or the file cannot be read or is too large.
    UnknownNameError
        If a type or key is unknown; the message names the file and line.
    InputError
        If the file is not TOML, a key is missing or a value is wrong; the message names the file
        and line.

    Examples
    --------
    A file with this content ::

        [[input]]
        type = "joint_torque"
        joint = "joint_1"

        [[input]]
        type = "thruster"
        name = "nozzle"
        frame = "base"
        position = [-0.9, 0.0, 0.65]
        direction = [1, 0, 0]

    gives the inputs
    ``(JointTorque("joint_1"), Thruster("base", (-0.9, 0, 0.65), (1, 0, 0), "nozzle"))``.

    >>> inputs = fflin.load_inputs("cubesat")  # bundled
    >>> len(inputs), inputs[-1].name
    (15, 'wheel_z')
    """
    return _read_inputs(_document(find_inputs(path)))


def _document(path: Path) -> TomlFile:
    """Read a robot file or a file of inputs; raise `UnknownNameError` for an unknown key."""
    document = TomlFile(path)
    with document.located():
        require_known("key of a robot file", document.record, KEYS)
    return document


def _refuse_result(path: Path) -> None:
    """Raise `FileError` if a path has the ending of a saved result, such as a law."""
    if path.suffix not in RECORDS:
        return
    content = f"a {path.suffix} file"
    with suppress(FflinError), saved.reading(path, "result"):
        record, _ = saved.read_record(path)
        kind, robot = saved.text(record["kind"]), saved.text(record["robot"])
        content = f"a result of the kind {kind} for the robot '{robot}'"
    raise FileError(
        f"{shown(path)}: {content}, expected a robot; give the name of a robot, or the path of a "
        "URDF, an MJCF file (.xml) or a robot file (.toml)"
    )


def _read_robot_file(file: RobotFile) -> tuple[TomlFile, RobotFile, dict[str, object]]:
    """Read a robot file; return its document, the location of its URDF, and its values.

    The values are {key: value}: the locks, then the fields in the order of `FIELDS`.
    """
    document = _document(file.path)
    record, folder = document.record, file.path.parent
    if "urdf" not in record:
        raise InputError(
            f'{file.path}: the key `urdf` is missing; add urdf = "my.urdf", or pass a file that '
            "contains only inputs with --inputs or fflin.load_inputs"
        )
    with document.located("urdf"):
        urdf_file = find_robot(record["urdf"], folder)
        if urdf_file.path.suffix.lower() == ".toml":
            raise InputError(
                f"urdf is {urdf_file.path}, expected a URDF or a robot's name"
            )
    with document.located("package_dirs"):
        dirs = (
            *folders(record.get("package_dirs", ()), folder),
            *urdf_file.package_dirs,
        )
    # Nested tables become keys with dots. Only the tables directly below weights, point, target and
    # start, such as point.joints, remain tables.
    values = {key: flat(value) for key, value in record.items()}
    for key in ("weights", "point", "target", "start"):
        if isinstance(table := record.get(key), dict):
            values[key] = {part: flat(value) for part, value in table.items()}
    if isinstance(table := record.get("tune"), dict):
        values["tune"] = table | {"vary": _ranges(table.get("vary", {}))}
    if "input" in record:
        values["inputs"] = _read_inputs(document)
    if "output" in record:
        if "outputs" in record:
            raise document.error(
                "the file has both outputs and [[output]]; write all outputs as [[output]]",
                "output",
            )
        values["outputs"] = _built(document, "output", _output_type)
    of_nastran, of_tank = FlexibleAppendage.from_nastran, Slosh.cylinder
    appendages = _built(
        document, "flexible", partial(_maker, FlexibleAppendage, of_nastran)
    )
    if appendages := appendages + _built(
        document, "slosh", partial(_maker, Slosh, of_tank)
    ):
        values["appendages"] = appendages
    if constraints := _built(document, "constraint", _constraint_type):
        values["constraints"] = constraints
    # The robot is named after the TOML file, not after the URDF.
    urdf_file = urdf_file._replace(name=file.name, package_dirs=dirs)
    keys = ("lock", "xacro", *FIELDS)
    return document, urdf_file, {key: values[key] for key in keys if key in values}


def _ranges(table: object) -> object:
    """Return the ranges {parameter: range} of a table whose names may contain dots."""
    if not isinstance(table, dict):
        return table
    ranges: dict[str, object] = {}
    for key, value in table.items():
        if isinstance(value, dict) and "range" not in value:
            inner = _ranges(value)
            assert isinstance(inner, dict)
            ranges |= {f"{key}.{below}": entry for below, entry in inner.items()}
        else:
            ranges[key] = value
    return ranges


def _xacro_arguments(given: object) -> dict[str, str]:
    """Return the arguments {name: text} of a xacro file, as ROS writes them on a command line."""
    texts = dict[str, str]()
    arguments = {} if given is None else given
    for name, value in by_name("xacro", arguments, "argument").items():
        if not isinstance(value, str | bool | int | float):
            raise InputError(
                f"xacro argument '{name}' is {value!r}, expected a text, a number or a boolean"
            )
        texts[name] = str(value)
        if isinstance(value, bool):
            texts[name] = texts[name].lower()
    return texts


def _read_inputs(document: TomlFile) -> tuple[Input, ...]:
    """Return the inputs of a file; see `load_inputs`."""
    inputs = tuple(_built(document, "input", _input_type))
    if not inputs:
        raise document.error(
            "the file contains no inputs; add a table [[input]] with its type"
        )
    return inputs


def _type_of(values: dict[str, object], known: Mapping[str, T]) -> T:
    """Remove the key `type` from the values of a table, and return what `known` has for it."""
    if "type" not in values:
        raise InputError(
            f"the key 'type' is missing; set 'type' to one of {', '.join(known)}"
        )
    kind = str(values.pop("type"))
    require_known("valid 'type'", [kind], known)
    return known[kind]


def _constraint_type(values: dict[str, object]) -> Callable[..., Constraint]:
    """Remove the key `type` from the values of a constraint, and return its constructor."""
    return _type_of(values, FROM_FILE)


def _input_type(values: dict[str, object]) -> type[Input]:
    """Remove the key `type` from the values of an input, and return the class of this type."""
    return _type_of(values, _TYPES)


def _output_type(values: dict[str, object]) -> type[Output]:
    """Remove the key `type` from the values of an output, and return the class of this type."""
    if "type" not in values:
        raise InputError(
            f"the key 'type' is missing; set 'type' to one of {', '.join(_OUTPUT_TYPES)}"
        )
    kind = str(values.pop("type"))
    require_known("valid 'type'", [kind], _OUTPUT_TYPES)
    if isinstance(joints := values.get("joints"), list):
        values["joints"] = tuple(joints)
    return _OUTPUT_TYPES[kind]


def _maker(
    make: Callable[..., Appendage],
    special: Callable[..., Appendage],
    values: Mapping[str, object],
) -> Callable[..., Appendage]:
    """Return `special` if `values` contains a key that only `special` accepts, or else `make`.

    `special` makes an appendage from a Nastran file, or slosh from the size of a cylindrical tank.
    """
    alone = set(signature(special).parameters) - set(signature(make).parameters)
    if alone & set(values):
        return special
    return make


def _built(
    document: TomlFile,
    key: str,
    choose: Callable[[dict[str, object]], Callable[..., T]],
) -> list[T]:
    """Build an object from each table of the array `key`; messages begin with file and line.

    From the values of a table, `choose` selects the class or function that builds the object.
    """
    tables = document.record.get(key, [])
    if not isinstance(tables, list) or not all(isinstance(x, dict) for x in tables):
        raise document.error(f"{key} is not an array of tables; write [[{key}]]", key)
    built = []
    for index, table in enumerate(tables):
        values = {**table}
        name = table.get("name")
        label = f"{key} {index + 1}"
        if isinstance(name, str):
            label += f" ('{name}')"
        with document.located(key, index, of=f"{label}: "):
            build = choose(values)
            parameters = dict(signature(build).parameters)
            # these parameters come only from Nastran files
            if build is FlexibleAppendage:
                del parameters["inertia"], parameters["rigid"]
            require_known(f"key of {key}", values, parameters)
            missing = [
                name
                for name, parameter in parameters.items()
                if parameter.default is parameter.empty and name not in values
            ]
            if missing:
                raise _missing_keys(missing)
            for file in {"op4", "asm"} & set(values):
                values[file] = document.path.parent / str(values[file])
            built.append(build(**values))
    return built


def _missing_keys(names: list[str]) -> InputError:
    """Return the error that names the missing keys of a table."""
    message = f"the key '{names[0]}' is missing; add this key"
    if len(names) > 1:
        message = f"the keys {listed(names)} are missing; add these keys"
    if "position" in names:
        message += "; position = [0, 0, 0] is the origin of the frame"
    return InputError(message)
