"""Assembly of robots: a copy of a robot with other fields, equipment or mass properties.

A robot is assembled from its bare robot, which has no joints of wheels and modes:

1. The wheels among the inputs and the modes of the appendages become joints (`equipped`).
2. The other fields are checked in the order of `fields.FIELDS`.
3. The conditions on several fields are checked (`_require_consistent`).

All functions return a robot of the class of their argument.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from hashlib import sha256
from typing import Any, TypeVar

import pinocchio as pin

from fflin.base.errors import InputError, require_known
from fflin.base.names import stands_for_any
from fflin.robot.disturbance import MAGNETIC, ORBITAL, plates_of, terms_of
from fflin.robot.equipment.appendages import Appendage, FlexibleAppendage, rigid_inertia
from fflin.robot.equipment.assembly import (
    Mounted,
    compare_inertia,
    mounted_modes,
    mounted_wheels,
    with_mounted,
)
from fflin.robot.fields import FIELDS, checked_inputs, checked_names
from fflin.robot.inputs import named_inputs
from fflin.robot.joints import ROOT, find_frame
from fflin.robot.mass_properties import as_inertia, dynamic_parameters, pieces_of
from fflin.robot.outputs import ConstraintForce
from fflin.robot.robot_data import RobotData, link_mass
from fflin.robot.rotors import require_free_rotors

AnyRobot = TypeVar("AnyRobot", bound=RobotData)

# Fields of a robot that have joint names as keys, possibly in nested mappings. A key may also have
# the form GROUP.JOINT, where GROUP is one of _GROUPS.
_BY_NAME = (
    *("stiffness", "damping", "rest", "urdf_damping", "limits", "weights"),
    *("point", "target", "start"),
)
_GROUPS = ("q_m", "qdot_m", "tau_m", "wheel")

# Fields that are tables {joint: value}. If a new table is given, the entries of modes stay.
_TABLES_OF_JOINTS = ("stiffness", "damping")
# Fields whose old entries all stay in `merged`, unless the new table names them.
_MERGED_TABLES = (*_TABLES_OF_JOINTS, "rest", "limits")


def replaced(robot: AnyRobot, fields: Mapping[str, object]) -> AnyRobot:
    """Return a robot with other fields; see `Robot.replace`."""
    return _with_fields(robot, fields, merged=False)


def merged(robot: AnyRobot, fields: Mapping[str, object]) -> AnyRobot:
    """Return a robot with other fields; springs and limits that are not named are unchanged."""
    if robot.passive and isinstance(given := fields.get("passive"), list | tuple):
        fields = {**fields, "passive": [*robot.passive, *given]}
    return _with_fields(robot, fields, merged=True)


def _with_fields(
    robot: AnyRobot, fields: Mapping[str, object], *, merged: bool
) -> AnyRobot:
    robot.require_unchanged()
    require_known("field of a robot", fields, FIELDS)
    if "passive" in fields:
        passive = checked_names("passive", fields["passive"], robot._bare)
        driven = [x for x in robot.inputs if getattr(x, "joint", None) not in passive]
        robot = replace(robot, passive=passive)
        fields = {"inputs": driven, **fields}
    if "wheel_joints" in fields:
        wheels = checked_names("wheel_joints", fields["wheel_joints"], robot._bare)
        robot = replace(robot, wheel_joints=wheels)
    if "inputs" in fields:
        robot = equipped(robot, inputs=fields["inputs"])
    if "appendages" in fields:
        robot = with_appendages(robot, fields["appendages"])
    robot = replace(robot, **_checked(robot, fields, merged=merged))
    _require_consistent(robot)
    return robot


def _checked(
    robot: RobotData, fields: Mapping[str, object], *, merged: bool
) -> dict[str, Any]:
    """Return the checked values of all fields that have a check in `FIELDS`."""
    checked = {}
    for name, value in fields.items():
        check = FIELDS[name]
        if check is not None:
            checked[name] = check(value, robot)
    # A given table replaces the old table. If `merged` is true, the old entries of all joints
    # that the new table does not name stay. Otherwise, only the entries of modes stay.
    modes = {joint.name for joint in robot.modes}
    for name in _MERGED_TABLES if merged else _TABLES_OF_JOINTS:
        if name not in checked:
            continue
        old = getattr(robot, name)
        kept = {key: x for key, x in old.items() if merged or key in modes}
        checked[name] = kept | checked[name]
    return checked


def _require_consistent(robot: RobotData) -> None:
    """Raise an error if fields of a robot contradict each other or its model."""
    if robot.orbit and any(robot.gravity):
        raise InputError(
            f"'{robot.name}' has both uniform gravity and an orbit, but an orbit already "
            "includes the gravity of its central body; leave one of them out"
        )
    for name, term in terms_of(robot.disturbance):
        if term.axes == ORBITAL and not robot.orbit:
            raise InputError(
                f"disturbance '{name}' is in orbital axes, but '{robot.name}' is not in orbit; "
                "give base or inertial axes, or give the robot an orbit"
            )
    for plate in plates_of(robot.disturbance):
        if plate.density and not any(plate.velocity) and not robot.orbit:
            raise InputError(
                f"disturbance 'plate' has a density, but '{robot.name}' is not in orbit; give "
                "velocity, in inertial axes, or give the robot an orbit"
            )
    in_field = robot.orbit is not None and robot.orbit.field is not None
    for name in robot.disturbance:
        if name in MAGNETIC and not in_field:
            raise InputError(
                f"disturbance '{name}' needs a magnetic field, but '{robot.name}' has none; give "
                "it an orbit with a field, such as CircularOrbit(500e3, inclination=1.7, "
                "field='dipole')"
            )
    for name in robot.used_frames:
        find_frame(robot.model, name)
    _require_two_bodies(robot)
    titles = [item.title for item in robot.constraints]
    for output in robot.outputs:
        if isinstance(output, ConstraintForce):
            require_known("constraint", [output.name], titles)
    require_free_rotors(robot)


def _require_two_bodies(robot: RobotData) -> None:
    """Raise an error if a constraint holds a body to itself, or to inertial space in orbit."""
    for item in robot.constraints:
        if item.to is None:
            if robot.orbit:
                raise InputError(
                    f"constraint '{item.title}' holds a frame in inertial space, but "
                    f"'{robot.name}' is in orbit; remove the orbit, or give the constraint a "
                    "second frame with to="
                )
            continue
        carriers = {find_frame(robot.model, name).joint for name in item.frames}
        if len(carriers) == 1:
            raise InputError(
                f"constraint '{item.title}' connects two frames of the same body; remove it, or "
                "give frames of two bodies"
            )


def equipped(
    robot: AnyRobot,
    bare: AnyRobot | None = None,
    *,
    inputs: object = None,
    appendages: Sequence[Appendage] | None = None,
) -> AnyRobot:
    """Return a robot with new inputs, new appendages or a new bare robot.

    The bare robot is the robot without the joints of wheels and modes. If an argument is omitted,
    the robot keeps the old value. Each mode becomes a joint, and so does each wheel with an
    inertia. If a joint no longer exists, its entries are removed from fields such as `stiffness`.
    """
    known = robot._bare.joint_names
    bare = bare or robot._bare
    checked = checked_inputs(
        robot.inputs if inputs is None else inputs, bare, robot.passive
    )
    items = robot.appendages if appendages is None else tuple(appendages)
    bodies = [pin.Inertia(body) for body in bare.model.inertias.tolist()]
    parts = mounted_wheels(bare.model, bodies, checked)
    parts += mounted_modes(bare.model, bodies, items)
    model, joints, followers = bare.model, bare.joints, bare.followers
    if parts:
        _require_new_names(bare.model, parts)
        model = with_mounted(bare.model, bodies, parts)
        placed = [joint.within(model) for joint in joints]
        placed += [part.joint.within(model) for part in parts]
        joints = tuple(sorted(placed, key=lambda joint: joint.idx_v))
        followers = tuple(follower.within(model) for follower in followers)
    names = [joint.name for joint in joints]
    gone = [name for name in robot.joint_names if name not in names]
    tables = {}
    if gone:
        kept = [f"{group}.{name}" for group in _GROUPS for name in names]
        # A wheel that is no longer a joint is still an input, with its limits.
        kept += [
            f"{x.GROUP}.{name}"
            for x, entries in named_inputs(checked)
            for name in entries
        ]
        tables = {key: _without(getattr(robot, key), gone, kept) for key in _BY_NAME}
    # Reset the springs of the modes only if appendages are given. Otherwise keep them, because the
    # user may have changed them.
    if appendages is not None:
        for key in _TABLES_OF_JOINTS:
            springs = tables.get(key, getattr(robot, key))
            tables[key] = _with_modes(springs, robot, items, key)
    # Remember only the names of removed wheels and modes. All other removed joints were locked.
    removed = dict.fromkeys((*robot._removed, *gone))
    changed: dict[str, Any] = {
        **tables,
        "model": model,
        "joints": joints,
        "followers": followers,
        "inputs": checked,
        "appendages": items,
        "links": bare.links,
        "urdf_sha256": bare.urdf_sha256,
    }
    return replace(
        robot,
        **changed,
        _unequipped=bare if parts else None,
        _removed=tuple(x for x in removed if x not in known and x not in names),
    )


def _require_new_names(model: pin.Model, parts: Sequence[Mounted]) -> None:
    """Raise `InputError` if a wheel or mode has the name of something else in the model."""
    taken = {*model.names, *(frame.name for frame in model.frames.tolist())}
    for part in parts:
        if part.joint.name in taken:
            raise InputError(
                f"'{part.joint.name}' has the name of another joint, frame, wheel or mode of "
                "the robot; give the wheel or the appendage another name"
            )
        taken.add(part.joint.name)


def _with_modes(
    springs: Mapping[str, Any],
    robot: RobotData,
    appendages: Sequence[Appendage],
    key: str,
) -> dict[str, Any]:
    """Return stiffness or damping {joint: value} with the modes of new appendages.

    `springs` has the values of the robot, and `key` is "stiffness" or "damping".
    """
    modes = {joint.name for joint in robot.modes}
    values = {name: value for name, value in springs.items() if name not in modes}
    for item in appendages:
        values |= item.springs[key]
    return values


def _without(
    table: Mapping[str, object], gone: list[str], kept_keys: list[str]
) -> dict[str, object]:
    """Return a mapping without the keys that match only removed joints.

    `gone` are the names of the removed joints, and `kept_keys` the keys GROUP.NAME of joints and
    inputs that still exist. Mappings inside this mapping are reduced in the same way.
    """
    removed = [f"{group}.{name}" for group in _GROUPS for name in gone]
    kept: dict[str, object] = {}
    for key, value in table.items():
        if stands_for_any(key, removed) and not stands_for_any(key, kept_keys):
            continue
        if isinstance(value, Mapping):
            kept[key] = _without(value, gone, kept_keys)
        else:
            kept[key] = value
    return kept


def with_appendages(robot: AnyRobot, appendages: object) -> AnyRobot:
    """Return a robot with new appendages (flexible or slosh), whose modes become joints."""
    given = [appendages] if isinstance(appendages, Appendage) else appendages
    if not isinstance(given, Sequence) or not all(
        isinstance(item, Appendage) for item in given
    ):
        raise InputError(
            f"appendages is {given!r}, expected a list of FlexibleAppendage and Slosh"
        )
    bare = robot._bare
    taken = set[int]()
    for item in given:
        if not isinstance(item, FlexibleAppendage) or item.inertia is None:
            continue
        # The inertia `file_inertia` is compared with `present_inertia`, or replaces it. The present
        # inertia belongs to the link `item.frame`, or to the whole body if this frame is not a
        # link.
        joint, placement = find_frame(bare.model, item.frame)
        body = bare.model.inertias[joint]
        owner = f"the body with frame '{item.frame}'"
        file_inertia = rigid_inertia(item.inertia)
        present_inertia = body
        links = bare.links
        pieces = pieces_of(bare)
        if item.frame in pieces:
            present_inertia = as_inertia(pieces[item.frame])
            owner = f"link '{item.frame}'"
        if not item.rigid:
            compare_inertia(
                item,
                item.inertia,
                present_inertia.se3Action(placement.inverse()),
                owner,
            )
            continue
        if joint in taken:
            raise InputError(
                f"'{item.title}' is the second appendage with rigid=True on its body; use "
                "rigid=True for only one appendage of each body"
            )
        taken.add(joint)
        if item.frame in links:
            links = {**links, item.frame: link_mass(file_inertia)}
        body = body - present_inertia + file_inertia.se3Action(placement)
        bare = replace(_with_inertias(bare, {joint: body}), links=links)
    items: list[Appendage] = []
    for item in given:
        if isinstance(item, FlexibleAppendage):
            items.append(replace(item, rigid=False))
        else:
            items.append(item)
    return equipped(robot, bare, appendages=items)


def with_bodies(robot: AnyRobot, bodies: Mapping[int, pin.Inertia]) -> AnyRobot:
    """Return a robot with other inertias {joint index: inertia}, which include the wheels."""
    robot.require_unchanged()
    bare = robot._bare
    other = _with_inertias(bare, bodies)
    if bare is robot:
        return other
    changed = equipped(robot, other)
    if not robot.modes:
        return changed
    # `changed` has new joints for the modes. Use the old joints instead, so that the modal
    # amplitudes in q have the same meaning as before.
    model = robot.model.copy()
    inertias = robot.model.inertias
    for joint in bodies:
        at = ROOT
        if joint > ROOT:
            at = robot.model.getJointId(bare.model.names[joint])
        mounted = bare.model.inertias[joint] - inertias[at]
        model.inertias[at] = other.model.inertias[joint] - mounted
        if model.inertias[at].mass <= 0.0:
            return changed
    return replace(changed, model=model, joints=robot.joints, followers=robot.followers)


def _with_inertias(bare: AnyRobot, bodies: Mapping[int, pin.Inertia]) -> AnyRobot:
    """Return a robot without wheels and modes with other inertias {joint index: inertia}."""
    model = bare.model.copy()
    for joint, body in bodies.items():
        model.inertias[joint] = body
    digest = bare.urdf_sha256
    masses = dynamic_parameters(model)
    if masses != dynamic_parameters(bare.model):
        digest = sha256(digest.encode() + masses).hexdigest()
    return replace(bare, model=model, urdf_sha256=digest)
