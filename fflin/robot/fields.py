"""Checks of the robot's fields that the user may set, and the limits of a robot."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, TypeAlias

from fflin.base.errors import InputError, require_known
from fflin.base.names import by_name, matching, rates_by_name, stands_for_any, state_keys
from fflin.base.validation import dimension, number, numbers
from fflin.robot import inputs as kinds
from fflin.robot.inputs import (
    Input,
    JointTorque,
    ReactionWheel,
    named_inputs,
    named_wheels,
    three_numbers,
)
from fflin.robot.joints import Find, by_joint
from fflin.robot.orbit import checked_orbit
from fflin.robot.outputs import Output, parse_output

if TYPE_CHECKING:
    import pinocchio as pin

    from fflin.robot.joints import Joint
    from fflin.robot.robot import Robot

# Least and largest value; infinite without a limit.
Range: TypeAlias = tuple[float, float]

_OF_JOINTS = ("q_m", "qdot_m")

RULES = ("urdf", "identity")
_STATE = ("joints", "rpy", "position", "velocity")
_WEIGHTS = ("rule", "q", "r", "bryson")


def checked_fields(fields: Mapping[str, object], robot: Robot) -> dict[str, Any]:
    """Return the checked fields of `Robot.replace`, except for passive joints and inputs."""
    require_known("field of a robot", fields, FIELDS)
    return {name: FIELDS[name](value, robot) for name, value in fields.items()}


def checked_inputs(
    value: object, find: Find, joints: Sequence[str], passive: Sequence[str]
) -> tuple[Input, ...]:
    """Check inputs, and return them with one joint torque for each joint of a pattern."""
    if isinstance(value, str) or not isinstance(value, Sequence) or not value:
        raise InputError(f"inputs is {value!r}, expected a sequence of at least one input")
    for item in value:
        if not isinstance(item, Input):
            known = ", ".join(kind.__name__ for kind in kinds.KINDS)
            raise InputError(f"{item!r} is not an input; expected {known}")
    value = [one for item in value for one in _spread(item, find, joints, passive)]
    if not value:
        raise InputError("all inputs are torques of passive joints; add an input that is not")
    names = [name for item, own in named_inputs(value) for name in own]
    for each in names:
        if names.count(each) > 1:
            raise InputError(f"input '{each}' is given twice; remove one of them")
    return tuple(value)


def _spread(item: Input, find: Find, joints: Sequence[str], passive: Sequence[str]) -> list[Input]:
    """Return a joint torque for each joint with a motor that matches the name or pattern."""
    if not isinstance(item, JointTorque):
        return [item]
    found = by_joint({str(item.joint): None}, joints, find)
    if item.joint in found and item.joint in passive:
        raise InputError(
            f"joint '{item.joint}' is passive, but a joint torque acts on it; remove the joint "
            "from passive, or the torque from the inputs"
        )
    return [replace(item, joint=name) for name in found if name not in passive]


def _input_keys(inputs: Sequence[Input]) -> tuple[str, ...]:
    """Return input names with groups, such as "thrust.NAME"; see `fflin.base.names.input_keys`."""
    pairs = ((item.GROUP, name) for item, names in named_inputs(inputs) for name in names)
    return tuple(name if name.startswith(f"{of}.") else f"{of}.{name}" for of, name in pairs)


def given_limits(inputs: Sequence[Input], joints: Sequence[str], given: object) -> dict[str, Range]:
    """Convert limits by name, or one for all inputs, to {input or state: (least, largest)}."""
    keys, states, named = _input_keys(inputs), state_keys(joints), named_inputs(inputs)
    names = [*(name for _, own in named for name in own), *states]
    floors = [0.0 if not item.PULLS else -math.inf for item, own in named for _ in own]
    floors += [-math.inf] * len(states)
    if not isinstance(given, Mapping):
        given = dict.fromkeys(dict.fromkeys(item.GROUP for item in inputs), given)
    ranges = {str(key): range_of(key, value) for key, value in given.items()}
    of_inputs = {key: ranges[key] for key in ranges if stands_for_any(key, keys)}
    of_states = {key: ranges[key] for key in ranges if key not in of_inputs}
    # A limit for all joints does not apply to wheels, because wheels are much faster.
    wheels = {f"{group}.{name}" for group in _OF_JOINTS for name, _ in named_wheels(inputs)}
    whole = {key: of_states.pop(key) for key in _OF_JOINTS if key in of_states}
    found = by_name("input or state", whole, (*keys, *states))
    found = {i: limits for i, limits in found.items() if names[i] not in wheels}
    found |= by_name("input or state", of_states, (*keys, *states))
    found |= by_name("input", of_inputs, keys)
    return {
        names[i]: (max(low, floors[i]), max(high, floors[i])) for i, (low, high) in found.items()
    }


def _outputs(value: object, _: Robot) -> tuple[Output, ...]:
    """Return outputs from `Output` objects or from texts as on the command line."""
    given = [value] if isinstance(value, str) else value
    if not isinstance(given, Sequence) or not given:
        raise InputError(f"outputs is {value!r}, expected a sequence of at least one output")
    found: list[Output] = []
    for item in given:
        if not isinstance(item, str | Output):
            raise InputError(f"{item!r} is not an output; expected one such as FramePose('tool')")
        found += parse_output(item) if isinstance(item, str) else [item]
    return tuple(found)


def _rest(value: object, robot: Robot) -> dict[str, float]:
    return by_joint(numbers("rest", value, "joint", "rest of joint"), robot.own_joints, robot.joint)


def _stiffness(value: object, robot: Robot, what: str = "stiffness") -> dict[str, float]:
    """Return {joint: value} from a mapping, or from one value for all joints except wheels."""
    if not isinstance(value, Mapping):
        value = dict.fromkeys(robot.own_joints, value)
    checked = numbers(what, value, "joint", f"{what} of joint")
    for name, entry in checked.items():
        if entry < 0.0:
            raise InputError(f"{what} of joint '{name}' is {entry:g}, expected 0 or more")
    return by_joint(checked, robot.own_joints, robot.joint)


def _damping(value: object, robot: Robot) -> dict[str, float]:
    if not isinstance(value, str):
        return _stiffness(value, robot, "damping")
    if value != "urdf":
        raise InputError(f"damping is '{value}', expected 'urdf', a number or {{joint: damping}}")
    return dict(robot.urdf_damping)


def range_of(name: str, value: Any) -> Range:
    """Return (least, largest) from this pair or from one magnitude."""
    if dimension(f"limit of '{name}'", value) == 1 and len(value) == 2:
        least, largest = (number(f"limit of '{name}'", x) for x in value)
    else:
        largest = number(f"limit of '{name}'", value)
        least = -largest
    if least > largest:
        raise InputError(
            f"limit of '{name}' is {value}, expected a largest magnitude of at least 0, or bounds "
            "(least, largest)"
        )
    return least, largest


def _state(what: str, value: object, robot: Robot) -> dict[str, Any]:
    """Check a point, start or target of a robot, and replace patterns by the names of joints."""
    state = _parts(what, value, _STATE)
    if "joints" in state:
        values = numbers(f"{what} joints", state["joints"], "joint", f"{what} of joint")
        state["joints"] = by_joint(values, robot.joint_names, robot.joint)
    for name in ("rpy", "position"):
        if name in state:
            state[name] = three_numbers(f"{what} {name}", state[name])
    if "velocity" in state:
        rates = numbers(f"{what} velocity", state["velocity"], "name", f"{what} velocity")
        state["velocity"] = rates_by_name(robot.joint_names, rates)
    return state


def _weights(value: object, robot: Robot) -> dict[str, Any]:
    """Check the weights of a robot's regulator; the keys are names of states and inputs."""
    weights = _parts("weights", value, _WEIGHTS)
    require_known("rule of weights", [str(weights.get("rule", RULES[0]))], RULES)
    states, keys = state_keys(robot.joint_names), _input_keys(robot.inputs)
    parts = {
        "q": ("state", states),
        "r": ("input", keys),
        "bryson": ("state or input", (*states, *keys)),
    }
    for part, (kind, names) in parts.items():
        weights[part] = numbers(part, weights.get(part, {}), "name", f"{part} of")
        for key, entry in weights[part].items():
            matching(kind, key, names)
            if entry < 0.0 or (part != "q" and not entry):
                least = "0 or more" if part == "q" else "more than 0"
                raise InputError(f"{part} of '{key}' is {entry:g}, expected {least}")
    for key in weights["bryson"].keys() & (weights["q"].keys() | weights["r"].keys()):
        raise InputError(f"'{key}' has both a weight and a largest value; give only one of them")
    return {part: value for part, value in weights.items() if value}


def checked_passive(value: object, find: Find, joints: Sequence[str]) -> tuple[str, ...]:
    """Return the joints without a motor, in the order of the state."""
    keys = [value] if isinstance(value, str) else value
    if not isinstance(keys, Sequence) or not all(isinstance(key, str) for key in keys):
        raise InputError(f"passive is {value!r}, expected names of joints")
    found = by_joint(dict.fromkeys(keys), joints, find)
    return tuple(name for name in joints if name in found)


def _parts(what: str, value: object, known: Sequence[str]) -> dict[str, Any]:
    if not isinstance(value, Mapping):
        raise InputError(f"{what} is {value!r}, expected a table with the keys {', '.join(known)}")
    require_known(f"part of {what}", value, known)
    return dict(value)


# Checks of the fields, in the order in which a file applies them: inputs come before the fields
# that refer to their names.
FIELDS: dict[str, Callable[[Any, Robot], object]] = {
    **dict.fromkeys(("passive", "inputs", "appendages"), lambda value, _: value),
    "outputs": _outputs,
    "stiffness": _stiffness,
    "damping": _damping,
    "rest": _rest,
    "gravity": lambda value, _: three_numbers("gravity", value),
    "orbit": lambda value, _: checked_orbit(value),
    "limits": lambda value, robot: given_limits(robot.inputs, robot.joint_names, value),
    "weights": _weights,
    "point": partial(_state, "point"),
    "target": partial(_state, "target"),
    "start": partial(_state, "start"),
}


_OPEN: Range = (-math.inf, math.inf)


def limits_of(robot: Robot) -> dict[str, Range]:
    """Return {name of an input or state: (least, largest)} for all limits."""
    # Start with the limits of the URDF, where exporters write zero for no limit. Limits of the
    # inputs replace them, and `Robot.limits` replaces both.
    found: dict[str, Range] = {}
    for joint in robot.joints:
        low, high = travel_of(robot.model, joint)
        found[f"q_m.{joint.name}"] = (low, high) if low < high else _OPEN
        found[f"qdot_m.{joint.name}"] = _either(float(robot.model.velocityLimit[joint.idx_v]))
    for item, names in named_inputs(robot.inputs):
        found |= dict(zip(names, item.ranges, strict=True))
        if isinstance(item, JointTorque) and item.max is None:
            low, high = _either(float(robot.model.effortLimit[robot.joint(item.joint).idx_v]))
            found[names[0]] = (low if item.min is None else item.ranges[0][0], high)
        if isinstance(item, ReactionWheel) and item.max_speed is not None:
            found[f"qdot_m.{names[0]}"] = _either(item.max_speed)
    known = {*found, *state_keys(robot.joint_names)}
    found |= {name: limits for name, limits in robot.limits.items() if name in known}
    return {name: limits for name, limits in found.items() if limits != _OPEN}


def magnitudes_of(robot: Robot) -> dict[str, float]:
    """Return {input or state: magnitude} of all finite limits.

    For a joint position the magnitude is the whole travel, and for a one-sided input the range.
    """
    sizes = {
        name: largest - least if name.startswith("q_m.") or least >= 0.0 else min(-least, largest)
        for name, (least, largest) in limits_of(robot).items()
    }
    return {name: size for name, size in sizes.items() if 0.0 < size < math.inf}


def chosen_limits(robot: Robot, limits: Any) -> tuple[dict[str, Range], dict[str, Range]]:
    """Return the saturation limits of the inputs for `simulate`, and all known limits."""
    own, cutting = limits_of(robot), dict[str, Range]()
    given: dict[str, Range] = {}
    several = isinstance(limits, list | tuple) and any(isinstance(x, str) for x in limits)
    for part in limits if several else [limits]:
        if isinstance(part, str):
            if part != "urdf":
                raise InputError(
                    f"limits is '{part}', expected 'urdf', a largest magnitude, {{input: "
                    "magnitude}, or ['urdf', {input: magnitude}]"
                )
            cutting = own
        elif part is not None:
            given |= given_limits(robot.inputs, robot.joint_names, part)
    return cutting | given, own | given


def travel_of(model: pin.Model, joint: Joint) -> Range:
    """Return the position limits of a joint in its model, infinite without limits."""
    if joint.unbounded:
        return _OPEN
    lower, upper = model.lowerPositionLimit, model.upperPositionLimit
    return _known(float(lower[joint.idx_q])), _known(float(upper[joint.idx_q]))


def _either(size: float) -> Range:
    """Return the range (-size, size), or an infinite range for a size of zero."""
    return (-_known(size), _known(size)) if size > 0.0 else _OPEN


def _known(limit: float) -> float:
    # Pinocchio stores a missing limit as the largest double or as infinity.
    return limit if abs(limit) < 1e300 else math.copysign(math.inf, limit)
