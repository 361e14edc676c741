"""Self-contained HTML page of a scene: its parameters and its meshcat commands.

Wheels and thrusters are drawn at their places on the links.
"""

from __future__ import annotations

import base64
import json
import math
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cache
from html import escape
from importlib.resources import files
from typing import Any

import numpy as np
import pinocchio as pin
import umsgpack

from fflin.base.tables import counted
from fflin.base.validation import Array
from fflin.dynamics.coordinates import frame_of
from fflin.dynamics.orbital import field_of
from fflin.dynamics.state import Actuation, StateMap
from fflin.robot.equipment.mounting import turned_to
from fflin.robot.inputs import Thruster, named_wheels
from fflin.robot.joints import ROOT, find_frame
from fflin.robot.robot import Robot
from fflin.view.scene import Drawing, body_paths

Lowered = dict[str, Any]

# Directions to the camera and to the sun, in world axes.
VIEWS = {"space": (1.0, -0.62, 0.50), "lab": (1.0, -0.62, 0.36)}
SUN = (0.62, -0.78, 0.62)

_SCRIPTS = (
    *("sky", "orbit", "look", "camera", "stage", "marks", "equipment", "pick", "keys"),
    *("chart", "plots", "large", "player", "live", "modes", "main"),
)


def build_page(info: dict[str, Any], commands: Iterable[bytes] = (), connect: str = "") -> str:
    """Build the page from `info`, which its scripts read, and from the commands of a `Recorder`.

    The page may open connections only to `connect`.
    """
    info = {**info, "commands": [_base64(command) for command in commands]}
    # In a script element, only the end tag and the start of a comment have a special meaning.
    data = json.dumps(info, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    fields = {
        "title": escape(info["title"]),
        "scene": info["scene"],
        "mode": info["mode"],
        "connect": connect or "'none'",
        "style": _asset("style.css"),
        "meshcat": _meshcat(),
        "scripts": _scripts(),
        "data": data,
    }
    parts = _asset("page.html").split("{{")
    return parts[0] + "".join(
        fields[name] + rest for name, _, rest in (part.partition("}}") for part in parts[1:])
    )


def packed(array: Array) -> str:
    """Encode an array in single precision for the function `floats` of the page."""
    return _base64(np.ascontiguousarray(array, dtype="<f4").tobytes())


def _base64(content: bytes) -> str:
    return base64.b64encode(content).decode("ascii")


@cache
def _asset(name: str) -> str:
    return files("fflin.view").joinpath("assets", name).read_text(encoding="utf-8")


@cache
def _scripts() -> str:
    body = "\n".join(_asset(f"{name}.js") for name in _SCRIPTS)
    body = re.sub(r"(?m)^ *(//.*\n)?", "", body)  # indentation and comments
    # A function scope separates the names in these scripts from the names in meshcat's bundle.
    return f'(() => {{\n"use strict";\nconst THREE = MeshCat.THREE;\n{body}\nmain();\n}})();'


@cache
def _meshcat() -> str:
    bundle = files("meshcat").joinpath("viewer", "dist", "main.min.js")
    script = bundle.read_text(encoding="utf-8")
    return script.replace("</script", "<\\/script").replace("<!--", "<\\!--")


class Recorder:
    """Window for a meshcat.Visualizer that records the scene and forwards each command."""

    def __init__(self, forward: Callable[[bytes], None] | None = None) -> None:
        self.web_url = ""
        self._forward = forward
        # {path: {"set_object": ..., "set_transform": ..., "set_property visible": ...}}
        self._nodes: dict[str, dict[str, Lowered]] = {}
        self._animation: Lowered | None = None

    def send(self, command: Any) -> None:
        """Record and forward a command of meshcat."""
        self.record(command.lower())

    def record(self, lowered: Lowered) -> None:
        """Record and forward a command in the form that is sent."""
        kind, path = lowered["type"], lowered.get("path", "")
        # The browser ignores empty parts of a path.
        path = "/" + "/".join(part for part in path.split("/") if part)
        if kind == "delete":
            below = path.rstrip("/") + "/"
            for other in [p for p in self._nodes if p == path or p.startswith(below)]:
                del self._nodes[other]
        elif kind == "set_animation":
            self._animation = lowered
        elif kind != "capture_image":
            key = f"{kind} {lowered.get('property', '')}"
            self._nodes.setdefault(path, {})[key] = lowered
        if self._forward:
            self._forward(umsgpack.packb(lowered))

    def commands(self) -> Iterator[bytes]:
        """Yield the messages with which meshcat's page builds the recorded scene."""
        for node in list(self._nodes.values()):
            # An object replaces the previous object, so it comes before its properties.
            for key in sorted(node, key=lambda key: key != "set_object "):
                yield umsgpack.packb(node[key])
        if self._animation:
            yield umsgpack.packb(self._animation)

    def wait(self) -> None:
        """Do nothing: a recorder does not wait for a browser."""

    def close(self) -> None:
        """Do nothing: a recorder has no open connection."""


def subtitle(robot: Robot) -> str:
    """Return the text below a robot's name on the page."""
    wheels = len(robot.wheels)
    parts = [counted(robot.n - wheels, "joint"), *[counted(wheels, "wheel")] * bool(wheels)]
    orbit = [f"{robot.orbit.altitude / 1e3:.6g} km over {robot.orbit.body}"] if robot.orbit else []
    return ", ".join([*parts, f"{robot.mass:.4g} kg", *orbit])


def rounded(points: Array, size: float) -> list[list[float]]:
    """Round points (M, 3) to the digits that a robot of the given size [m] needs."""
    digits = max(4, 4 - math.floor(math.log10(size)))
    found: list[list[float]] = points.round(digits).tolist()
    return found


def corner_points(drawing: Drawing, poses: Array) -> Array:
    """Return the corners (M, 3) of all bodies' bounding boxes in the world."""
    return np.concatenate(
        [
            np.array([placement.act(corner) for corner in corners])
            for joint, corners in zip(drawing.bodies, drawing.corners, strict=True)
            for placement in [pin.XYZQUATToSE3(poses[joint - ROOT])]
        ]
    )


def stage_info(
    robot: Robot,
    drawing: Drawing,
    poses: Array,
    *,
    scene: str,
    subtitle: str,
    tool: str | None,
    frame: str | None = None,
    held: Sequence[Drawing] = (),
) -> dict[str, Any]:
    """Return the page's stage parameters from the poses (njoints - 1, 7) of the first frame."""
    points = corner_points(drawing, poses)
    low, high = points.min(axis=0), points.max(axis=0)
    centre = (low + high) / 2.0
    size = max(float(np.linalg.norm(points - centre, axis=1).max()), 1e-3)
    sun, direction, orbit = np.array(SUN), np.array(VIEWS[scene]), dict[str, object]()
    field = field_of(robot, frame_of(robot, frame)) if scene == "space" else None
    if field and robot.orbit:
        # The z axis points away from the central body, and the x axis along the orbit.
        radial, along, normal = field.axes.T
        sun, direction = (along * x + normal * y + radial * z for x, y, z in (sun, direction))
        far = robot.orbit.radius / robot.orbit.body_radius
        orbit = {
            "up": [along.tolist(), radial.tolist(), (-normal).tolist()],
            "orbit": {"body": robot.orbit.body, "distance": far, "rate": robot.orbit.mean_motion},
        }
    return {
        **orbit,
        **equipment(robot, [drawing, *held], tool, size),
        "title": robot.name,
        "subtitle": subtitle,
        "scene": scene,
        "size": size,
        "centre": centre.tolist(),
        "floor": [*centre[:2].tolist(), float(low[2])],
        "sun": sun.tolist(),
        "direction": direction.tolist(),
        "base": ["meshcat", "robot", body_paths(robot)[0]],
    }


# Wheels at the same point are drawn apart along their axes, at this distance in robot sizes.
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
    """Return each thruster's name, joint, and position and force direction in the joint's frame."""
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


def _wheels(robot: Robot, size: float) -> list[dict[str, Any]]:
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
