"""Where a robot starts, and what its regulator weighs: what a robot's user says of its use."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from fflin.base.errors import InputError, unknown
from fflin.base.names import joints_by_name, matching
from fflin.base.validation import number
from fflin.robot.inputs import Input, three_numbers
from fflin.robot.joints import Joint
from fflin.robot.signals import input_keys_of, rates_by_name, state_keys

RULES = ("urdf", "identity")
_START = ("joints", "rpy", "position", "velocity")
_WEIGHTS = ("rule", "q", "r", "bryson")


def checked_start(
    value: Any, find: Callable[[str], Joint], joints: Sequence[str]
) -> dict[str, Any]:
    """Return where a robot starts, with joints and rates by their full names."""
    start = _parts("start", value, _START)
    if "joints" in start:
        values = _numbers("start of joint", "start joints", start["joints"])
        start["joints"] = joints_by_name("joint", values, joints, lambda name: find(name).name)
    for name in ("rpy", "position"):
        if name in start:
            start[name] = three_numbers(f"start {name}", start[name])
    if "velocity" in start:
        rates = _numbers("start velocity", "start velocity", start["velocity"])
        start["velocity"] = rates_by_name(joints, rates)
    return start


def kept_start(start: Mapping[str, Any], joints: Sequence[str]) -> dict[str, Any]:
    """Return of a start what is of these joints, of which some wheels are none."""
    names = {*joints, *state_keys(joints)}
    return {
        part: {key: x for key, x in value.items() if key in names}
        if isinstance(value, Mapping)
        else value
        for part, value in start.items()
    }


def checked_weights(value: Any, joints: Sequence[str], inputs: Sequence[Input]) -> dict[str, Any]:
    """Return the weights of a robot's regulator, whose names are those of states and inputs."""
    weights = _parts("weights", value, _WEIGHTS)
    if str(weights.get("rule", RULES[0])) not in RULES:
        raise unknown("rule of weights", weights["rule"], RULES)
    states, keys = state_keys(joints), input_keys_of(inputs)
    parts = {
        "q": ("state", states),
        "r": ("input", keys),
        "bryson": ("state or input", (*states, *keys)),
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


def checked_passive(
    value: Any, find: Callable[[str], Joint], joints: Sequence[str], locked: Sequence[str]
) -> tuple[str, ...]:
    """Return the joints without a motor, in the order of the state."""
    keys = [value] if isinstance(value, str) else value
    if not isinstance(keys, Sequence) or not all(isinstance(key, str) for key in keys):
        raise InputError(f"passive is {value!r}, expected names of joints")
    for key in keys:
        if any(each.rpartition("=")[0] == key for each in locked):
            raise InputError(f"joint '{key}' is locked and passive; leave one out")
    asked = dict.fromkeys(keys)
    found = joints_by_name("joint", asked, joints, lambda name: find(name).name)
    return tuple(name for name in joints if name in found)


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
