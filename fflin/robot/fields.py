"""Checks of the fields that a user may set on a robot, and limits of its inputs and states."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from fflin.base.errors import FflinWarning, InputError, listed, require_known
from fflin.base.names import (
    by_name,
    matching,
    rates_by_name,
    stands_for_any,
    state_keys,
)
from fflin.base.validation import (
    ONE_ROTATION,
    Array,
    dimension,
    looks_like_degrees,
    number,
    numbers,
    whole,
)
from fflin.robot.constraints import checked_constraints, checked_independent
from fflin.robot.disturbance import checked_disturbance
from fflin.robot.inputs import (
    KINDS,
    BaseForce,
    BaseTorque,
    Input,
    JointTorque,
    Magnetorquer,
    Range,
    ReactionWheel,
    Thruster,
    named_inputs,
    three_numbers,
)
from fflin.robot.joints import Joint, by_joint
from fflin.robot.orbit import checked_orbit
from fflin.robot.outputs import Output, parse_output
from fflin.robot.robot_data import RobotData

if TYPE_CHECKING:
    import pinocchio as pin

RULES = ("urdf", "identity")


def input_keys_of(robot: RobotData) -> tuple[str, ...]:
    """Return the name GROUP.ENTRY of each input, such as "thrust.NAME"; see `names.input_keys`."""
    return _keys_of(robot.named_inputs)


def _keys_of(named: Iterable[tuple[Input, tuple[str, ...]]]) -> tuple[str, ...]:
    """Return the name GROUP.ENTRY of each named input."""
    pairs = ((item.GROUP, name) for item, names in named for name in names)
    keys = []
    for group, name in pairs:
        key = name if name.startswith(f"{group}.") else f"{group}.{name}"
        keys.append(key)
    return tuple(keys)


def _given_limits(
    given: object, robot: RobotData, wheels: Iterable[str] | None = None
) -> dict[str, Range]:
    """Return limits as {input or state: (least, largest)}.

    `given` contains limits by name, or is one limit for all inputs. `wheels` are the joints that
    are flown as wheels, by default the wheels of the robot. Limits of thrusters are raised
    to at least 0, because a thruster never pulls.
    """
    named = robot.named_inputs
    keys, states = input_keys_of(robot), state_keys(robot.joint_names)
    names = [*(name for _, entries in named for name in entries), *states]
    floors = []
    for item, entries in named:
        floor = -math.inf if item.PULLS else 0.0
        floors += [floor] * len(entries)
    floors += [-math.inf] * len(states)
    if not isinstance(given, Mapping):
        given = dict.fromkeys((item.GROUP for item in robot.inputs), given)
    ranges = {str(key): range_of(key, value) for key, value in given.items()}
    of_inputs = {key: ranges[key] for key in ranges if stands_for_any(key, keys)}
    of_states = {key: ranges[key] for key in ranges if key not in of_inputs}
    # A limit of the whole group q_m or qdot_m does not apply to wheels, because wheels have
    # unbounded angles, and rotate much faster than joints.
    groups: Sequence[str] = ("q_m", "qdot_m")
    mounted = [entries[0] for item, entries in named if item.GROUP == "wheel"]
    spun = robot.wheel_joints if wheels is None else wheels
    excluded = {f"{x}.{name}" for name in (*mounted, *spun) for x in groups}
    whole = {group: of_states.pop(group) for group in groups if group in of_states}
    limits_of_index = by_name("input or state", whole, (*keys, *states))
    limits_of_index = {
        i: limits for i, limits in limits_of_index.items() if names[i] not in excluded
    }
    limits_of_index |= by_name("input or state", of_states, (*keys, *states))
    limits_of_index |= by_name("input", of_inputs, keys)
    sizes = {names[i]: max(map(abs, limits)) for i, limits in limits_of_index.items()}
    warn_of_degrees(robot, sizes)
    return {
        names[i]: (max(low, floors[i]), max(up, floors[i]))
        for i, (low, up) in limits_of_index.items()
    }


def checked_inputs(
    value: object, bare: RobotData, passive: Sequence[str]
) -> tuple[Input, ...]:
    """Return checked inputs.

    A `JointTorque` whose joint is a pattern is replaced by one torque for each matching joint that
    is not in `passive`. `bare` is the robot without the joints of wheels and modes.
    """
    if isinstance(value, str) or not isinstance(value, Sequence):
        raise InputError(f"inputs is {value!r}, expected a sequence of inputs")
    inputs: list[Input] = []
    for item in value:
        if not isinstance(item, Input):
            known = ", ".join(kind.__name__ for kind in KINDS)
            raise InputError(f"{item!r} is not an input; expected {known}")
        if not isinstance(item, JointTorque):
            inputs.append(item)
            continue
        joints = by_joint({str(item.joint): None}, bare.joint_names, bare.joint)
        if item.joint in joints and item.joint in passive:
            raise InputError(
                f"joint '{item.joint}' is passive, but a joint torque acts on it; remove the joint "
                "from passive, or the torque from the inputs"
            )
        inputs += [replace(item, joint=name) for name in joints if name not in passive]
    if not inputs:
        raise InputError(
            f"inputs is {value!r}, expected at least one input that is not the torque of a passive "
            "joint"
        )
    names = [name for _, entries in named_inputs(inputs) for name in entries]
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"input '{name}' is given twice; remove one of them")
    return tuple(inputs)


def _outputs(value: object, _: RobotData) -> tuple[Output, ...]:
    """Return outputs; `value` contains `Output` objects, or text such as "pose:tool"."""
    given = [value] if isinstance(value, str) else value
    if not isinstance(given, Sequence) or not given:
        raise InputError(
            f"outputs is {value!r}, expected a sequence of at least one output"
        )
    for item in given:
        if not isinstance(item, str | Output):
            raise InputError(
                f"{item!r} is not an output; expected one such as FramePose('tool')"
            )
    outputs: list[Output] = []
    for item in given:
        if isinstance(item, str):
            outputs += parse_output(item)
        else:
            outputs.append(item)
    return tuple(outputs)


def _of_joints(what: str, value: object, robot: RobotData) -> dict[str, float]:
    """Return the field `what` (stiffness, damping or rest) as {joint: value}.

    A single value of stiffness or damping applies to all joints except wheels and modes. Patterns
    do not match wheels and modes either; these must be named exactly. The damping "urdf" stands
    for the damping in the URDF.
    """
    if what == "damping" and isinstance(value, str):
        if value != "urdf":
            raise InputError(
                f"damping is '{value}', expected 'urdf', a number or {{joint: damping}}"
            )
        return dict(robot.urdf_damping)
    joints = [
        name for name in robot._bare.joint_names if name not in robot.wheel_joints
    ]
    if what != "rest" and not isinstance(value, Mapping):
        value = dict.fromkeys(joints, value)
    values = numbers(what, value, "joint", f"{what} of joint")
    value_of_joint = by_joint(values, joints, robot.joint)
    for name, entry in value_of_joint.items():
        if what != "rest" and entry < 0.0:
            raise InputError(
                f"{what} of joint '{name}' is {entry:g}, expected 0 or more"
            )
    return value_of_joint


def require_chart(what: str, size: float) -> None:
    """Raise `InputError` if a value of q_b, the vector part of a unit quaternion, exceeds 1."""
    if size > 1.0:
        raise InputError(
            f"{what} is {size:g}, expected at most 1, because q_b is the vector part of a "
            "quaternion: a rotation by x rad has |q_b| = sin(x / 2), so 5 deg is 0.0436"
        )


def warn_of_degrees(robot: RobotData, values: Mapping[str, float]) -> None:
    """Warn of positions and rates of revolute joints that look like degrees.

    `values` is {name of a state: value}. States other than q_m and qdot_m are ignored, and so are
    wheels and continuous joints, which may have any angle. One warning names all such values; see
    `looks_like_degrees` for the rule.
    """
    wheels = {names[0] for item, names in robot.named_inputs if item.GROUP == "wheel"}
    suspicious = dict[str, float]()
    for joint in robot.joints:
        if joint.unit != "rad" or joint.name in {*wheels, *robot.wheel_joints}:
            continue
        if joint.unbounded:  # it may turn any number of times
            continue
        low, high = travel_of(robot.model, joint)
        if not math.isfinite(high - low) or low == high:
            low, high = -ONE_ROTATION, ONE_ROTATION
        rates = _either(float(robot.model.velocityLimit[joint.idx_v]))
        ranges = {f"q_m.{joint.name}": (low, high), f"qdot_m.{joint.name}": rates}
        for name, (least, largest) in ranges.items():
            value = values.get(name, 0.0)
            if looks_like_degrees(value, least, largest):
                suspicious[name] = value
    if not suspicious:
        return
    shown = listed([f"{name} = {value:g}" for name, value in suspicious.items()])
    first = next(iter(suspicious.values()))
    warnings.warn(
        "values look like degrees, because they exceed one rotation and the limits of the joint: "
        f"{shown}; give radians, such as {math.radians(first):.3g} for {first:g} deg",
        FflinWarning,
        stacklevel=3,
    )


def _bound(what: str, value: object) -> float:
    """Return one side of a limit, which may be infinite: the signal is then free on this side."""
    if isinstance(value, float | np.floating) and math.isinf(value):
        return float(value)
    return number(what, value)


def range_of(name: str, value: object) -> Range:
    """Return a limit as (least, largest); one number x stands for (-x, x)."""
    label = f"limit of '{name}'"
    bounds = []
    if isinstance(value, Iterable) and dimension(label, value) == 1:
        bounds = [*value]
    if len(bounds) == 2:
        least, largest = (_bound(label, x) for x in bounds)
    else:
        largest = number(label, value)
        least = -largest
    if name.startswith("q_b") and math.isfinite(size := max(abs(least), abs(largest))):
        require_chart(label, size)
    if not least <= largest or least == math.inf or largest == -math.inf:
        raise InputError(
            f"{label} is {value}, expected a largest magnitude of at least 0, or bounds (least, "
            "largest)"
        )
    return least, largest


def _state(what: str, value: object, robot: RobotData) -> dict[str, object]:
    """Return the checked `point`, `start` or `target`, with patterns replaced by joint names."""
    state = _parts(what, value, ("joints", "rpy", "position", "velocity"))
    if "joints" in state:
        values = numbers(f"{what} joints", state["joints"], "joint", f"{what} of joint")
        state["joints"] = by_joint(values, robot.joint_names, robot.joint)
    for name in ("rpy", "position"):
        if name in state:
            state[name] = three_numbers(f"{what} {name}", state[name])
    if "velocity" in state:
        rates = numbers(
            f"{what} velocity", state["velocity"], "name", f"{what} velocity"
        )
        state["velocity"] = rates_by_name(robot.joint_names, rates)
    return state


def _weights(value: object, robot: RobotData) -> dict[str, object]:
    """Return the checked weights of `lqr`: the rule, the mappings q, r and bryson, and `integral`.

    The keys of the mappings are names, groups or patterns of states and inputs. `integral` contains
    names of states or outputs, or a mapping {name: weight of the integral}.
    """
    states, inputs = state_keys(robot.joint_names), _weighted_inputs(robot)
    both = (*states, *inputs)
    kinds = {
        "q": ("state", states),
        "r": ("input", inputs),
        "bryson": ("state or input", both),
    }
    given = _parts("weights", value, ("rule", *kinds, "integral"))
    require_known("rule of weights", [str(given.get("rule", RULES[0]))], RULES)
    weights: dict[str, dict[str, float]] = {}
    for part, (kind, names) in kinds.items():
        weights[part] = numbers(part, given.get(part, {}), "name", f"{part} of")
        for key, entry in weights[part].items():
            matching(kind, key, names)
            if part == "bryson" and key.startswith("q_b"):
                require_chart(f"bryson of '{key}'", entry)
            if entry < 0.0 or (part != "q" and not entry):
                least = "0 or more" if part == "q" else "more than 0"
                raise InputError(f"{part} of '{key}' is {entry:g}, expected {least}")
            if part == "bryson" and (key in weights["q"] or key in weights["r"]):
                message = f"'{key}' has both a weight and a largest value; give only one of them"
                raise InputError(message)
    indices = by_name("state or input", weights["bryson"], both)
    warn_of_degrees(robot, {both[i]: size for i, size in indices.items()})
    checked: dict[str, object] = {}
    if "rule" in given:
        checked["rule"] = given["rule"]
    checked |= {part: entries for part, entries in weights.items() if entries}
    if given.get("integral"):
        checked["integral"] = _integrated(given["integral"])
    return checked


# Keys of the field `tune`: laws and goals, ranges, and numbers.
TUNE = ("law", "goal", "vary", "sample", "delay", "starts", "steps", "seed")


def _tune(value: object, robot: RobotData) -> dict[str, object]:
    """Return the checked settings of `fflin tune`, which checks the laws and goals itself."""
    given = _parts("tune", value, TUNE)
    for key in ("law", "goal"):
        tables = given.get(key, [])
        if not isinstance(tables, list | tuple) or not all(
            isinstance(table, Mapping) for table in tables
        ):
            raise InputError(
                f"{key} of tune is {tables!r}, expected tables [[tune.{key}]]"
            )
    if not isinstance(given.get("vary", {}), Mapping):
        raise InputError(
            f"vary of tune is {given['vary']!r}, expected {{parameter: range}}"
        )
    for key in ("sample", "delay"):
        if key in given:
            given[key] = number(f"{key} of tune", given[key])
    for key in ("starts", "steps", "seed"):
        if key in given:
            given[key] = whole(f"{key} of tune", given[key], 0)
    return given


def _weighted_inputs(robot: RobotData) -> tuple[str, ...]:
    """Return the names and groups of the inputs that may have weights.

    The commands of a design with base torque and force may be allocated to thrusters and
    magnetorquers, so a robot with such inputs may have weights of the base torque and force.
    """
    keys = input_keys_of(robot)
    if not any(isinstance(item, Thruster | Magnetorquer) for item in robot.inputs):
        return keys
    of_base = _keys_of(named_inputs((BaseTorque(), BaseForce())))
    return tuple(dict.fromkeys((*keys, *of_base)))


def _integrated(value: object) -> object:
    """Return the signals that `lqr` integrates: a tuple of names, or a mapping {name: weight}.

    The names are checked by `lqr`, because the outputs of a robot may have any names.
    """
    if isinstance(value, Mapping):
        weights = numbers("integral", value, "name", "weight of the integral of")
        for name, weight in weights.items():
            if weight <= 0.0:
                raise InputError(
                    f"weight of the integral of '{name}' is {weight:g}, expected more than 0"
                )
        return weights
    names = (value,) if isinstance(value, str) else value
    if not isinstance(names, Sequence) or not all(isinstance(x, str) for x in names):
        raise InputError(
            f"integral in weights is {value!r}, expected names such as ['q_b'], or {{name: weight}}"
        )
    return tuple(names)


def checked_names(what: str, value: object, bare: RobotData) -> tuple[str, ...]:
    """Return the names of joints in state order from the field `what`, names or patterns."""
    keys = [value] if isinstance(value, str) else value
    if not isinstance(keys, Sequence) or not all(isinstance(key, str) for key in keys):
        raise InputError(f"{what} is {value!r}, expected names of joints")
    chosen = by_joint(dict.fromkeys(keys), bare.joint_names, bare.joint)
    return tuple(name for name in bare.joint_names if name in chosen)


def _parts(what: str, value: object, known: Sequence[str]) -> dict[str, object]:
    if not isinstance(value, Mapping):
        raise InputError(
            f"{what} is {value!r}, expected a table with the keys {', '.join(known)}"
        )
    require_known(f"part of {what}", value, known)
    return dict(value)


# Checks of the fields, in the order in which the fields of a robot file are applied. Inputs come
# before the fields that refer to inputs by name. The first four fields have no check here, because
# `robot.builder` checks them itself.
FIELDS: dict[str, Callable[[object, RobotData], Any] | None] = {
    **dict.fromkeys(("passive", "wheel_joints", "inputs", "appendages")),
    "constraints": lambda value, _: checked_constraints(value),
    "independent": lambda value, _: checked_independent(value),
    "outputs": _outputs,
    **{name: partial(_of_joints, name) for name in ("stiffness", "damping", "rest")},
    "gravity": lambda value, _: three_numbers("gravity", value),
    "orbit": lambda value, _: checked_orbit(value),
    "disturbance": lambda value, _: checked_disturbance(value),
    "limits": _given_limits,
    "weights": _weights,
    "tune": _tune,
    **{name: partial(_state, name) for name in ("point", "target", "start")},
}


_OPEN: Range = (-math.inf, math.inf)


def limits_of(robot: RobotData) -> dict[str, Range]:
    """Return {name of an input or state: (least, largest)} for all limits."""
    # Start with the limits of the URDF. Equal lower and upper limits, such as 0 and 0, count as no
    # limit, because exporters write 0 for unknown limits. Limits of the inputs replace limits of
    # the URDF, and `Robot.limits` replaces limits of the URDF and of the inputs.
    limits_by_name: dict[str, Range] = {}
    for joint in robot.joints:
        low, high = travel_of(robot.model, joint)
        limits_by_name[f"q_m.{joint.name}"] = _OPEN
        if low < high:
            limits_by_name[f"q_m.{joint.name}"] = (low, high)
        limits_by_name[f"qdot_m.{joint.name}"] = _either(
            float(robot.model.velocityLimit[joint.idx_v])
        )
    index = {joint.name: joint.idx_v for joint in robot.joints}
    for item, names in robot.named_inputs:
        limits_by_name |= dict(zip(names, item.ranges, strict=True))
        if isinstance(item, JointTorque) and item.max is None:
            low, high = _either(float(robot.model.effortLimit[index[item.joint]]))
            least = low if item.min is None else item.ranges[0][0]
            limits_by_name[names[0]] = (least, high)
        if isinstance(item, ReactionWheel) and item.max_speed is not None:
            limits_by_name[f"qdot_m.{names[0]}"] = _either(item.max_speed)
    known = {*limits_by_name, *state_keys(robot.joint_names)}
    limits_by_name |= {
        name: limits for name, limits in robot.limits.items() if name in known
    }
    return {name: limits for name, limits in limits_by_name.items() if limits != _OPEN}


def input_limits(robot: RobotData, limits: Mapping[str, Range]) -> tuple[Array, Array]:
    """Return the lower and the upper limits (nu,) of the inputs; a missing limit is infinite.

    The lower limit of a thruster is at least 0. The upper limit of a pulsed thruster is at most its
    own `max`.
    """
    ranges: list[Range] = []
    for item, names in robot.named_inputs:
        for name in names:
            least, largest = limits.get(name, _OPEN)
            if len(ranges) in robot.pulsed_thrusters:
                largest = min(largest, item.ranges[0][1])
            if not item.PULLS:
                least = max(least, 0.0)
            if least > largest:
                raise InputError(
                    f"the lower limit of {name} is {least:g}, above its upper limit {largest:g}; "
                    "correct limits= or the limits of the input"
                )
            ranges.append((least, largest))
    low, high = np.array(ranges).T
    return low, high


def magnitudes_of(robot: RobotData) -> dict[str, float]:
    """Return {input or state: magnitude} for all limits whose magnitude is finite and positive.

    The magnitude of limits (least, largest) is

    - for a joint position, or if least is not negative: the range largest - least;
    - otherwise: the smaller of -least and largest.
    """
    sizes = {}
    for name, (least, largest) in limits_of(robot).items():
        if name.startswith("q_m.") or least >= 0.0:
            sizes[name] = largest - least
        else:
            sizes[name] = min(-least, largest)
    return {name: size for name, size in sizes.items() if 0.0 < size < math.inf}


def chosen_limits(
    robot: RobotData, limits: object, wheels: Iterable[str] | None = None
) -> dict[str, Range]:
    """Return the limits that the argument `limits` selects.

    Limits of all joints, such as ``{"qdot_m": 0.1}``, do not apply to `wheels`, the joints that are
    flown as wheels. By default, these are the wheels of the robot.

    `limits` is None, "urdf", one limit for all inputs, limits by name, or a list of these that
    contains "urdf" or mappings. The text "urdf" selects all limits of the robot. A limit given in
    `limits` replaces the robot's limit of the same input or state.
    """
    robot_limits, given = dict[str, Range](), dict[str, Range]()
    parts: Sequence[object] = [limits]
    if isinstance(limits, list | tuple) and any(
        isinstance(x, str | Mapping) for x in limits
    ):
        parts = limits
    for part in parts:
        if isinstance(part, str):
            if part != "urdf":
                raise InputError(
                    f"limits is '{part}', expected 'urdf', a largest magnitude, {{input: "
                    "magnitude}, or ['urdf', {input: magnitude}]"
                )
            robot_limits = limits_of(robot)
        elif part is not None:
            given |= _given_limits(part, robot, wheels)
    return robot_limits | given


def travel_of(model: pin.Model, joint: Joint) -> Range:
    """Return the position limits of a joint from the model; a missing limit is infinite."""
    if joint.unbounded:
        return _OPEN
    lower, upper = model.lowerPositionLimit, model.upperPositionLimit
    return _known(float(lower[joint.idx_q])), _known(float(upper[joint.idx_q]))


def _either(size: float) -> Range:
    """Return the range (-size, size), or an infinite range if the size is not positive."""
    if size > 0.0:
        return -_known(size), _known(size)
    return _OPEN


def _known(limit: float) -> float:
    # Pinocchio stores a missing limit as the largest double or as infinity.
    if abs(limit) < 1e300:
        return limit
    return math.copysign(math.inf, limit)
