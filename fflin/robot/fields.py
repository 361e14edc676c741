"""What of a robot its user may set: inputs, passive joints, gravity; checked once."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, TypeAlias

from fflin.base.errors import InputError, ModelError, UnknownNameError, unknown
from fflin.base.names import by_name, joints_by_name, matching
from fflin.base.validation import dimension, number
from fflin.robot.inputs import (
    KINDS,
    BaseForce,
    BaseTorque,
    Input,
    JointTorque,
    Thruster,
    named_inputs,
    named_wheels,
    three_numbers,
)
from fflin.robot.joints import Joint
from fflin.robot.outputs import Output
from fflin.robot.signals import input_keys_of, state_keys

# The least and the largest value; infinite where there is no limit.
Range: TypeAlias = tuple[float, float]

_OF_JOINTS = ("q_m", "qdot_m")

FIELDS = (
    *("inputs", "outputs", "stiffness", "damping", "rest", "gravity", "limits"),
    *("passive", "weights", "start"),
)


def validated_fields(
    fields: Mapping[str, Any],
    find: Callable[[str], Joint],
    joints: Sequence[str],
    urdf_damping: Mapping[str, float],
) -> dict[str, Any]:
    """Return the fields as a robot holds them.

    Parameters
    ----------
    fields : mapping
        As `Robot.replace` takes them, but for inputs and limits.
    find : callable
        Returns the joint of a name or raises.
    joints : sequence of str
        What one value for all stands for.
    urdf_damping : mapping
        What damping="urdf" stands for.

    Returns
    -------
    dict
    """
    checked: dict[str, Any] = {}
    for name, value in fields.items():
        if name == "friction":
            raise ModelError(
                "dry friction is not differentiable at rest, so that no linear model has it; use "
                "damping, or simulate with it"
            )
        if name not in FIELDS:
            raise unknown("field of a robot", name, FIELDS)
        if name == "outputs":
            checked[name] = _outputs(value)
        elif name == "gravity":
            checked[name] = three_numbers("gravity", value)
        elif name == "damping" and isinstance(value, str):
            if value != "urdf":
                raise InputError(f"damping is '{value}', expected 'urdf', a number or a mapping")
            checked[name] = dict(urdf_damping)
        else:
            checked[name] = _by_joint(name, value, find, joints)
    return checked


def validated_inputs(
    value: Any, find: Callable[[str], Joint], joints: Sequence[str], passive: Sequence[str]
) -> tuple[Input, ...]:
    """Return the inputs as a robot holds them; `find` returns the joint of a name or raises."""
    if isinstance(value, str) or not isinstance(value, Sequence):
        raise InputError(f"inputs is a {type(value).__name__}, expected a sequence of inputs")
    if not value:
        raise InputError("inputs is empty; a model needs at least one")
    for item in value:
        if not isinstance(item, Input):
            raise InputError(
                f"{item!r} is not an input; expected {', '.join(kind.__name__ for kind in KINDS)}"
            )
    value = [one for item in value for one in _spread(item, find, joints, passive)]
    if not value:
        raise InputError("inputs are torques of joints that all are passive; name another input")
    names = [item.name for item in value if isinstance(item, Thruster) and item.name]
    names += [name for name, _ in named_wheels(value)]
    kinds = BaseTorque | BaseForce | JointTorque
    plain = [replace(x, min=None, max=None) for x in value if isinstance(x, kinds)]
    twice = [str(x) for x in (*names, *plain) if (*names, *plain).count(x) > 1]
    if twice:
        raise InputError(f"input {twice[0]} stands there twice")
    return tuple(value)


def _spread(
    item: Input, find: Callable[[str], Joint], joints: Sequence[str], passive: Sequence[str]
) -> list[Input]:
    """Return a joint torque for each joint with a motor that its name, or pattern, stands for."""
    if not isinstance(item, JointTorque):
        return [item]
    found = joints_by_name("joint", {str(item.joint): None}, joints, lambda name: find(name).name)
    if item.joint in found and item.joint in passive:
        raise InputError(f"joint '{item.joint}' is passive and has a joint torque; leave one out")
    return [replace(item, joint=name) for name in found if name not in passive]


def given_limits(inputs: Sequence[Input], joints: Sequence[str], given: Any) -> dict[str, Range]:
    """Return {name of an input or state: (least, largest)} of what a caller gives.

    Which is the largest magnitude of all inputs, or {name, group or pattern of inputs or states:
    largest magnitude, or (least, largest)}. A thruster never pulls.
    """
    keys = input_keys_of(inputs)
    names: list[str] = []
    floors: list[float] = []
    for item, own in named_inputs(inputs):
        names += own
        floors += [-math.inf if item.PULLS else 0.0] * len(own)
    if not isinstance(given, Mapping):
        given = dict.fromkeys(dict.fromkeys(item.GROUP for item in inputs), given)
    ranges = {str(key): _range(key, value) for key, value in given.items()}
    of_states: dict[str, Range] = {}
    for key in list(ranges):
        try:
            matching("input", key, keys)
        except UnknownNameError:
            of_states[key] = ranges.pop(key)
    states = state_keys(joints)
    names, floors = [*names, *states], floors + [-math.inf] * len(states)
    # The group of all joints leaves wheels out, whose speeds are of another size.
    wheels = {f"{group}.{name}" for group in _OF_JOINTS for name, _ in named_wheels(inputs)}
    whole = {key: of_states.pop(key) for key in list(of_states) if key in _OF_JOINTS}
    found = by_name("input or state", whole, (*keys, *states))
    found = {i: limits for i, limits in found.items() if names[i] not in wheels}
    found |= by_name("input or state", of_states, (*keys, *states))
    found |= by_name("input", ranges, keys)
    return {
        names[i]: (max(low, floors[i]), max(high, floors[i])) for i, (low, high) in found.items()
    }


def _outputs(value: Any) -> tuple[Output, ...]:
    if isinstance(value, str) or not isinstance(value, Sequence) or not value:
        raise InputError(f"outputs is {value!r}, expected a sequence of at least one output")
    for item in value:
        if not isinstance(item, Output):
            raise InputError(f"{item!r} is not an output, as FramePose('tool') would be")
    return tuple(value)


def _by_joint(
    what: str, value: Any, find: Callable[[str], Joint], joints: Sequence[str]
) -> dict[str, float]:
    if not isinstance(value, Mapping):
        if what == "rest":
            raise InputError(f"rest is {value!r}, expected a mapping {{joint: position}}")
        value = dict.fromkeys(joints, value)
    checked = {name: number(f"{what} of joint '{name}'", entry) for name, entry in value.items()}
    for name, entry in checked.items():
        if what != "rest" and entry < 0.0:
            raise InputError(f"{what} of joint '{name}' is {entry:g}, expected 0 or more")
    return joints_by_name("joint", checked, joints, lambda name: find(name).name)


def _range(name: str, value: Any) -> Range:
    if dimension(f"limit of '{name}'", value) == 1 and len(value) == 2:
        least, largest = (number(f"limit of '{name}'", x) for x in value)
    else:
        largest = number(f"limit of '{name}'", value)
        least = -largest
    if least > largest:
        raise InputError(
            f"limit of '{name}' is {value}, expected a magnitude of 0 or more, or (least, largest)"
        )
    return least, largest
