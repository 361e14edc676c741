"""Marks fixed to the bodies of a robot: axes, thrusters, wheels, and links that can be selected."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin

from fflin.base.validation import Array
from fflin.dynamics.actuation import Actuation
from fflin.dynamics.state import StateMap
from fflin.robot.equipment.mounting import turned_to
from fflin.robot.inputs import Thruster, named_wheels
from fflin.robot.joints import ROOT, find_frame
from fflin.robot.robot import Robot
from fflin.view.scene import Drawing, body_paths

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

# Distance between wheels at one point, which are drawn apart along their axes, in robot sizes.
_APART = 0.1


def equipment(
    robot: Robot, drawings: list[Drawing], tool: str | None, size: float
) -> dict[str, object]:
    """Return the marks of a page: axes at base and tool, nozzles, wheels and selectable links."""
    paths = body_paths(robot)
    found = [(paths[0], pin.SE3.Identity(), 0.3)]
    if tool:
        joint, placement = find_frame(robot.model, tool)
        found.append((paths[joint - ROOT], placement, 0.12))
    return {
        "triads": [
            {"path": _node(path), "length": share * size, **_placed(placement)}
            for path, placement, share in found
        ],
        "nozzles": [
            {
                "path": _node(paths[joint - ROOT]),
                "position": position.tolist(),
                "direction": direction.tolist(),
            }
            for _, joint, position, direction in thrusters(robot)
        ],
        "wheels": _wheels(robot, size),
        "links": {name: link for drawing in drawings for name, link in drawing.links.items()},
    }


def thrusters(robot: Robot) -> list[tuple[str, int, Array, Array]]:
    """Return name, joint, and position and force direction in the joint's frame, per thruster."""
    found: list[tuple[str, int, Array, Array]] = []
    actuation = Actuation(StateMap(robot))
    names = [actuation.names[index] for index in actuation.groups.get("thrust", ())]
    for item in robot.inputs:
        if isinstance(item, Thruster):
            joint, placement = find_frame(robot.model, item.frame)
            position = placement.act(np.array(item.position))
            direction = placement.rotation @ np.array(item.direction)
            found.append((names[len(found)], joint, position, direction))
    return found


def _wheels(robot: Robot, size: float) -> Sequence[Mapping[str, object]]:
    """Return the wheels at their frames, with the spinning body if the wheel's speed is a state."""
    named, paths = named_wheels(robot.inputs), body_paths(robot)
    frames = [wheel.frame for _, wheel in named]
    found = []
    for name, wheel in named:
        joint, frame = find_frame(robot.model, wheel.frame)
        axis = np.array(wheel.axis)
        apart = _APART * size * (frames.count(wheel.frame) > 1)
        placement = frame * pin.SE3(turned_to(axis), apart * axis)
        rotor = robot.model.getJointId(name) - ROOT if name in robot.wheels else None
        found.append(
            {
                "path": _node(paths[joint - ROOT]),
                "spins": None if rotor is None else _node(paths[rotor]),
                **_placed(placement),
            }
        )
    return found


def _node(path: str) -> list[str]:
    return ["meshcat", "robot", path]


def _placed(placement: pin.SE3) -> dict[str, list[float]]:
    x, y, z, *quaternion = pin.SE3ToXYZQUAT(placement).tolist()
    return {"position": [x, y, z], "quaternion": quaternion}
