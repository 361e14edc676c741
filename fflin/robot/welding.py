"""Functions that weld joints at given positions, or the base of a robot to another robot."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from hashlib import sha256
from typing import Any, cast

import pinocchio as pin

from fflin.base.errors import InputError, require_known
from fflin.base.names import joints_by_name
from fflin.base.validation import Array, number, printable
from fflin.robot.builder import equipped
from fflin.robot.equipment.assembly import (
    carry_over,
    restore_names,
    with_marked_frames,
)
from fflin.robot.inputs import Input, ReactionWheel
from fflin.robot.joints import ROOT, Follower, Joint, find_frame, frame_index, joint_of
from fflin.robot.mass_properties import dynamic_parameters
from fflin.robot.outputs import JointOutput, Output
from fflin.robot.robot import Robot
from fflin.robot.robot_data import link_mass
from fflin.robot.urdf.description import Mimic

Lock = Mapping[str, float | None] | Iterable[str]


def welded(robot: Robot, lock: Lock) -> Robot:
    """Return a robot with joints and wheels welded; `lock` gives their names and positions."""
    bare = robot._bare
    asked = requested(lock)
    wheels = {name for name in asked if name in robot.reaction_wheels}
    at = {name: value for name, value in asked.items() if name not in wheels}
    mimics = {f.joint.name: Mimic(f.leader.name, *f[2:]) for f in bare.followers}
    model, left, locked = locked_model(bare.model, at, mimics)
    gone = wheels | {entry.rpartition("=")[0] for entry in locked}
    inputs: list[Input] = []
    for item, names in robot.named_inputs:
        if getattr(item, "joint", names[0]) in gone:
            continue
        if isinstance(item, ReactionWheel):
            inputs.append(replace(item, name=names[0]))
        else:
            inputs.append(item)
    if not inputs:
        raise InputError(
            f"without {', '.join(sorted(gone))}, the robot has no input, but a model needs at "
            "least one input"
        )
    outputs: list[Output] = []
    for output in robot.outputs:
        if isinstance(output, JointOutput) and output.joints:
            left_joints = tuple(name for name in output.joints if name not in gone)
            outputs.append(replace(output, joints=left_joints))
        else:
            outputs.append(output)
    locked = (*robot.locked, *locked)
    passive = tuple(name for name in robot.passive if name not in gone)
    spun = tuple(name for name in robot.wheel_joints if name not in gone)
    kept = tuple(x for x in outputs if getattr(x, "joints", None) != ())
    joints = tuple(
        joint.within(model) for joint in bare.joints if joint.name not in gone
    )
    followers = tuple(f.within(model) for f in bare.followers if f.joint.name in left)
    bare = replace(bare, model=model, joints=joints, followers=followers, locked=locked)
    robot = replace(
        robot, locked=locked, passive=passive, wheel_joints=spun, outputs=kept
    )
    return equipped(robot, bare, inputs=inputs)


def locked_model(
    model: pin.Model, lock: Lock, mimics: Mapping[str, Mimic]
) -> tuple[pin.Model, dict[str, Mimic], tuple[str, ...]]:
    """Weld joints and their mimic joints.

    Return the model, the remaining mimic joints, and the text "NAME=VALUE" for each welded joint.
    """
    movable = list(model.names)[ROOT + 1 :]

    def find(name: str) -> None:
        require_known("joint to lock", [name], movable)

    given = joints_by_name("joint to lock", requested(lock), movable, find)
    values: dict[str, float | None] = {}
    for name, position in given.items():
        values[name] = None if position is None else number(f"lock '{name}'", position)
    for name, mimic in mimics.items():
        if values.get(name) is None and (name in values or mimic.leader in values):
            values[name] = (
                mimic.multiplier * (values.get(mimic.leader) or 0.0) + mimic.offset
            )
    q = pin.neutral(model)
    indices = []
    locked = []
    for name, value in values.items():
        index = model.getJointId(name)
        indices.append(index)
        position = 0.0 if value is None else value
        locked.append(f"{name}={position!r}")
        if value is not None:
            joint_of(model, index).place(q, value)
    left = {name: mimic for name, mimic in mimics.items() if name not in values}
    return _reduced(model, indices, q), left, tuple(locked)


def requested(lock: object) -> dict[str, float | None]:
    """Return locks as {joint or pattern: position}; None stands for the neutral position."""
    lock = () if lock is None else lock
    try:
        names: list[object] = (
            [lock] if isinstance(lock, str) else [*cast("Iterable[object]", lock)]
        )
    except TypeError:  # not iterable
        names = [None]
    if not all(isinstance(name, str) for name in names):
        raise InputError(
            f"lock is {lock!r}, expected {{joint: value}} or names of joints"
        )
    if isinstance(lock, Mapping):
        return dict(lock)
    return dict.fromkeys(map(str, names))


def _reduced(model: pin.Model, indices: Sequence[int], q: Array) -> pin.Model:
    """Return a model in which the joints with the given indices are welded at q (nq,)."""
    model, names = with_marked_frames(model)
    # A model that was built in code may lack the frame of a joint. Without this frame,
    # `buildReducedModel` crashes.
    for index in indices:
        if not model.existFrame(model.names[index], pin.FrameType.JOINT):
            model.addJointFrame(index)
    reduced = pin.buildReducedModel(model, indices, q)
    restore_names(reduced, names)
    return reduced


def joined(
    robot: Robot, frame: str, other: Robot, placement: pin.SE3, prefix: str
) -> Robot:
    """Return `robot` with the base of `other` welded to the frame `frame` of `robot`.

    `placement` is the placement of this base in the frame. The joints and frames of `other` get the
    names PREFIX.NAME. No inputs act on its joints.
    """
    bare = robot._bare
    if "." in printable("prefix", prefix):
        raise InputError(
            f"prefix is {prefix!r}, expected a word without dots, such as 'payload'"
        )
    taken = {*robot.model.names, *(frame.name for frame in robot.model.frames.tolist())}
    if any(name == prefix or name.startswith(f"{prefix}.") for name in taken):
        raise InputError(
            f"'{robot.name}' has a joint or frame '{prefix}'; give another prefix"
        )
    model = _appended(bare.model, frame, other.model, placement, prefix)

    def renamed(joint: Joint) -> Joint:
        return joint._replace(name=f"{prefix}.{joint.name}")

    joints = [
        joint.within(model) for joint in (*bare.joints, *map(renamed, other.joints))
    ]
    theirs = (
        Follower(renamed(f.joint), renamed(f.leader), *f[2:]) for f in other.followers
    )
    both: dict[str, Any] = {
        name: getattr(robot, name)
        | {f"{prefix}.{key}": value for key, value in getattr(other, name).items()}
        for name in ("stiffness", "damping", "rest", "urdf_damping", "links")
    }
    # If `other` was not read from a URDF, its base becomes a link with the name `prefix`. A robot
    # that was not read from a URDF has no links, so that a link would stand for a whole body.
    if not robot.links:
        both["links"] = {}
    elif not other.links:
        both["links"][prefix] = link_mass(other.model.inertias[ROOT])
    identity = f"{robot.urdf_sha256} {other.urdf_sha256} {frame} {placement} {prefix}"
    bare = replace(
        bare,
        model=model,
        urdf_sha256=sha256(identity.encode() + dynamic_parameters(model)).hexdigest(),
        joints=tuple(sorted(joints, key=lambda joint: joint.idx_v)),
        followers=tuple(joint.within(model) for joint in (*bare.followers, *theirs)),
        links=both.pop("links"),
    )
    name = f"{robot.name}+{other.name}"
    attached = (*robot.attached, (prefix, other))
    return equipped(replace(robot, name=name, attached=attached, **both), bare)


def _appended(
    model: pin.Model, frame: str, other: pin.Model, placement: pin.SE3, prefix: str
) -> pin.Model:
    """Return a model with another model welded to a frame.

    In the order of the indices, the joints of the other model come after all joints that are
    already on the body with the frame.
    """
    joint, at = find_frame(model, frame)
    other = other.copy()
    other.jointPlacements[ROOT] = pin.SE3.Identity()
    added = _reduced(other, [ROOT], pin.neutral(other))
    for index, name in enumerate(added.names.tolist()[1:], start=1):
        added.names[index] = f"{prefix}.{name}"
    for index, added_frame in enumerate(added.frames):
        if index:
            added_frame.name = f"{prefix}.{added_frame.name}"
    marked_model, names = with_marked_frames(model)
    theirs, their_names = with_marked_frames(added, prefix)
    new = pin.appendModel(marked_model, theirs, frame_index(model, frame), placement)
    restore_names(new, names | their_names)
    new.name, new.gravity = model.name, model.gravity
    for part in (model, added):
        carry_over(part, new)
    on = new.getJointId(model.names[joint])
    new.addFrame(pin.Frame(prefix, on, at * placement, pin.FrameType.BODY), False)
    return new
