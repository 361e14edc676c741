"""Limits of a robot's inputs, and of the speeds and positions of its joints."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from fflin.base.errors import InputError
from fflin.base.names import state_keys
from fflin.robot.fields import Range, given_limits
from fflin.robot.inputs import JointTorque, ReactionWheel, named_inputs

if TYPE_CHECKING:
    from fflin.robot.joints import Joint
    from fflin.robot.robot import Robot

_OPEN: Range = (-math.inf, math.inf)


def limits_of(robot: Robot) -> dict[str, Range]:
    """Return {name of an input or state: (least, largest)} for all limits."""
    # Limits of the URDF come first; a limit of zero means none, as exporters write it. Limits of
    # the inputs replace them, and `Robot.limits` replaces both.
    found: dict[str, Range] = {}
    for joint in robot.joints:
        found[f"q_m.{joint.name}"] = _travel(robot, joint)
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

    The magnitude of a joint position is its whole travel, and of a one-sided input its range.
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


def _travel(robot: Robot, joint: Joint) -> Range:
    if joint.unbounded:
        return _OPEN
    low = _known(float(robot.model.lowerPositionLimit[joint.idx_q]))
    high = _known(float(robot.model.upperPositionLimit[joint.idx_q]))
    return (low, high) if low < high else _OPEN


def _either(size: float) -> Range:
    """Return the range (-size, size), or an infinite range for a size of zero."""
    return (-_known(size), _known(size)) if size > 0.0 else _OPEN


def _known(limit: float) -> float:
    # Pinocchio stores a missing limit as the largest double or as infinity.
    return limit if abs(limit) < 1e300 else math.copysign(math.inf, limit)
