"""Welding of joints at given values, in a model that is read or for a joint that jams."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import pinocchio as pin

from fflin.base.errors import InputError, unknown
from fflin.base.names import joints_by_name
from fflin.base.validation import Array, number
from fflin.robot.frames import ROOT
from fflin.robot.inputs import ReactionWheel, named_inputs
from fflin.robot.model_checks import joint_of
from fflin.robot.outputs import JointOutput
from fflin.robot.robot import Robot
from fflin.robot.urdf.joints import Mimic
from fflin.robot.wheels import with_inputs

_GROUPS = ("", "q_m.", "qdot_m.", "tau_m.", "wheel.")

Lock = Mapping[str, float | None] | Iterable[str]


def welded(robot: Robot, values: Mapping[str, float]) -> Robot:
    """Return a robot with joints welded at values, and wheels to what carries them."""
    bare, gone = robot._bare, {*values}
    mimics = {f.joint.name: Mimic(f.leader.name, *f[2:]) for f in bare.followers}
    at = {name: x for name, x in values.items() if name not in robot.wheels}
    model, left, locked = locked_model(bare.model, [at], mimics)
    inputs = [
        replace(item, name=names[0]) if isinstance(item, ReactionWheel) else item
        for item, names in named_inputs(robot.inputs)
        if getattr(item, "joint", names[0]) not in gone
    ]
    if not inputs:
        raise InputError(
            f"without {', '.join(values)} the robot has no input; a model needs at least one"
        )
    outputs = [
        replace(each, joints=tuple(x for x in each.joints if x not in gone))
        if isinstance(each, JointOutput) and each.joints
        else each
        for each in robot.outputs
    ]
    per_joint = ("urdf_damping", "limits", "weights")
    fields: dict[str, Any] = {name: _without(getattr(robot, name), gone) for name in per_joint}
    whole = replace(
        robot,
        **{"model": model, "locked": (*robot.locked, *locked), "_wheelless": None},
        joints=tuple(joint.within(model) for joint in bare.joints if joint.name not in gone),
        followers=tuple(
            f._replace(joint=f.joint.within(model), leader=f.leader.within(model))
            for f in bare.followers
            if f.joint.name in left
        ),
        passive=tuple(name for name in robot.passive if name not in gone),
        outputs=tuple(x for x in outputs if getattr(x, "joints", None) != ()),
        **fields,
    )
    return with_inputs(whole, inputs)


def _without(of: Any, gone: set[str]) -> Any:
    """Return a mapping, and those in it, without what is named NAME or GROUP.NAME."""
    if not isinstance(of, Mapping):
        return of
    named = {f"{group}{name}" for name in gone for group in _GROUPS}
    return {name: _without(value, gone) for name, value in of.items() if name not in named}


def locked_model(
    model: pin.Model, locks: Sequence[Lock | None], mimics: Mapping[str, Mimic]
) -> tuple[pin.Model, dict[str, Mimic], tuple[str, ...]]:
    """Weld joints and what mimics them; return the model, the mimics left, and what was welded."""
    movable = list(model.names)[ROOT + 1 :]

    def found(name: str) -> str:
        if name not in movable:
            raise unknown("joint to lock", name, movable)
        return name

    given: dict[str, float | None] = {}
    for lock in locks:
        if lock is not None:
            given |= joints_by_name("joint to lock", _asked(lock), movable, found)
    values = {n: None if x is None else number(f"lock '{n}'", x) for n, x in given.items()}
    for name, mimic in mimics.items():
        leader_value = values.get(mimic.leader, 0.0) or 0.0
        if mimic.leader in values or values.get(name, 0.0) is None:
            values.setdefault(name, None)
            if values[name] is None:
                values[name] = mimic.multiplier * leader_value + mimic.offset
    q, indices, locked = pin.neutral(model), [], []
    for name, value in values.items():
        index = model.getJointId(name)
        indices.append(index)
        locked.append(f"{name}={0.0 if value is None else value!r}")
        if value is not None:
            joint_of(model, index).place(q, value)
        # Without a frame for the joint, which models built in code may lack, Pinocchio crashes.
        if not model.existFrame(name, pin.FrameType.JOINT):
            model.addJointFrame(index)
    left = {name: mimic for name, mimic in mimics.items() if name not in values}
    return _reduced(model, indices, q), left, tuple(locked)


def _asked(lock: Any) -> dict[str, float | None]:
    """Return {joint or pattern: value, or None at neutral} of what a caller locks."""
    try:
        names = [lock] if isinstance(lock, str) else list(lock)
    except TypeError:
        names = [None]
    if not all(isinstance(name, str) for name in names):
        raise InputError(
            f"lock is a {type(lock).__name__}, expected {{joint: value}} or names of joints"
        )
    return dict(lock) if isinstance(lock, Mapping) else dict.fromkeys(names)


def _reduced(model: pin.Model, indices: Sequence[int], q: Array) -> pin.Model:
    """Weld joints at q (nq,)."""
    # Pinocchio looks frames up by name, which links and joints may share: joints keep theirs.
    names = Counter(frame.name for frame in model.frames.tolist())
    shared: dict[str, str] = {}
    for index, frame in enumerate(model.frames):
        if index and frame.type != pin.FrameType.JOINT and names[frame.name] > 1:
            alias = f"{index}/{frame.name}"
            while alias in names:
                alias += "/"
            shared[alias], frame.name = frame.name, alias
    reduced = pin.buildReducedModel(model, indices, q)
    for frame in reduced.frames:
        frame.name = shared.get(frame.name, frame.name)
    return reduced
