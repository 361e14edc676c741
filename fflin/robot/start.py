"""Where a robot starts, and what its regulator weighs: what a robot's user says of its use."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from fflin.base.errors import InputError, unknown
from fflin.base.names import joints_by_name, matching
from fflin.base.validation import number
from fflin.robot.inputs import three_numbers
from fflin.robot.signals import input_keys_of, rates_by_name, state_keys

if TYPE_CHECKING:
    from fflin.robot.robot import Robot

RULES = ("urdf", "identity")
_START = ("joints", "rpy", "position", "velocity")
_WEIGHTS = ("rule", "q", "r", "bryson")


def checked_start(robot: Robot, value: Any) -> dict[str, Any]:
    """Return where a robot starts: joints and rates by their full names, the base's numbers."""
    start = _parts("start", value, _START)
    if "joints" in start:
        joints = _numbers("start of joint", "start joints", start["joints"])
        start["joints"] = _of_joints(robot, joints)
    for name in ("rpy", "position"):
        if name in start:
            start[name] = three_numbers(f"start {name}", start[name])
    if "velocity" in start:
        rates = _numbers("start velocity", "start velocity", start["velocity"])
        start["velocity"] = rates_by_name(robot, rates)
    return start


def kept_start(robot: Robot, start: Mapping[str, Any]) -> dict[str, Any]:
    """Return of a start what is of this robot, where some wheels are no joints of it."""
    names = {*robot.joint_names, *state_keys(robot)}
    return {
        part: {key: x for key, x in value.items() if key in names}
        if isinstance(value, Mapping)
        else value
        for part, value in start.items()
    }


def checked_weights(robot: Robot, value: Any) -> dict[str, Any]:
    """Return the weights of a robot's regulator, whose names are those of states and inputs."""
    weights = _parts("weights", value, _WEIGHTS)
    if weights.get("rule", RULES[0]) not in RULES:
        raise unknown("rule of weights", weights["rule"], RULES)
    states, inputs = state_keys(robot), input_keys_of(robot)
    parts = {
        "q": ("state", states),
        "r": ("input", inputs),
        "bryson": ("state or input", (*states, *inputs)),
    }
    for part, (kind, names) in parts.items():
        weights[part] = _numbers(f"{part} of", part, weights.get(part, {}))
        for key, entry in weights[part].items():
            matching(kind, key, names)
            if entry < 0.0 or (part != "q" and not entry):
                least = "0 or more" if part == "q" else "more than 0"
                raise InputError(f"{part} of '{key}' is {entry:g}, expected {least}")
    for key in weights["bryson"]:
        if key in weights["q"] or key in weights["r"]:
            raise InputError(f"'{key}' has a weight and a largest value; give either")
    return {part: value for part, value in weights.items() if value}


def checked_passive(robot: Robot, value: Any) -> tuple[str, ...]:
    """Return the joints without a motor, in the order of the state."""
    keys = [value] if isinstance(value, str) else value
    if not isinstance(keys, Sequence) or not all(isinstance(key, str) for key in keys):
        raise InputError(f"passive is {value!r}, expected names of joints")
    for key in keys:
        if any(locked.rpartition("=")[0] == key for locked in robot.locked):
            raise InputError(f"joint '{key}' is locked and passive; leave one out")
    found = _of_joints(robot, dict.fromkeys(keys))
    return tuple(name for name in robot.joint_names if name in found)


def _of_joints(robot: Robot, values: Mapping[str, Any]) -> dict[str, Any]:
    names = robot.joint_names
    return joints_by_name("joint", values, names, lambda name: robot.joint(name).name)


def _parts(what: str, value: Any, known: Sequence[str]) -> dict[str, Any]:
    if not isinstance(value, Mapping):
        raise InputError(f"{what} is {value!r}, expected a mapping of {', '.join(known)}")
    for name in value:
        if name not in known:
            raise unknown(f"part of {what}", name, known)
    return dict(value)


def _numbers(what: str, part: str, value: Any) -> dict[str, float]:
    if not isinstance(value, Mapping):
        raise InputError(f"{part} is {value!r}, expected {{name: number}}")
    return {name: number(f"{what} '{name}'", entry) for name, entry in value.items()}
