"""Self-contained HTML page of a scene: its parameters and its meshcat commands.

Wheels and thrusters are drawn at their places on the links.
"""

import base64
import json
import math
import re
from collections.abc import Callable, Iterator, Sequence
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
from fflin.robot.equipment.mounting import turned_to
from fflin.robot.inputs import Thruster, named_inputs, named_wheels
from fflin.robot.joints import ROOT, find_frame
from fflin.robot.robot import Robot
from fflin.view.scene import Drawing, Visualizer

Lowered = dict[str, Any]

# Wheels at the same point are drawn apart along their axes, at this distance in robot sizes.
_APART = 0.1

# Directions to the camera and to the sun, in world axes.
VIEWS = {"space": (1.0, -0.62, 0.50), "lab": (1.0, -0.62, 0.36)}
SUN = (0.62, -0.78, 0.62)

_SCRIPTS = (
    *("sky", "orbit", "look", "camera", "stage", "marks", "equipment", "pick", "keys"),
    *("chart", "plots", "large", "player", "live", "modes", "main"),
)


def packed(array: Array) -> str:
    """Encode an array in single precision for the function `floats` of the page."""
    return _base64(np.ascontiguousarray(array, dtype="<f4").tobytes())


def _base64(content: bytes) -> str:
    return base64.b64encode(content).decode("ascii")


def _asset(name: str) -> str:
    return files("fflin.view").joinpath("assets", name).read_text(encoding="utf-8")


@cache
def _fixed() -> dict[str, str]:
    """Return the parts of a page that are the same for all pages: its style and its scripts."""
    bundle = files("meshcat").joinpath("viewer", "dist", "main.min.js")
    meshcat = bundle.read_text(encoding="utf-8")
    body = "\n".join(_asset(f"{name}.js") for name in _SCRIPTS)
    body = re.sub(r"(?m)^ *(//.*\n)?", "", body)  # indentation and comments
    head = '"use strict";\nconst THREE = MeshCat.THREE;'
    return {
        "style": _asset("style.css"),
        "meshcat": meshcat.replace("</script", "<\\/script").replace("<!--", "<\\!--"),
        # A function scope separates the names in these scripts from the names in meshcat's bundle.
        "scripts": f"(() => {{\n{head}\n{body}\nmain();\n}})();",
    }


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


class Page:
    """Page of a robot in a scene, with its drawings, and the entries that its scripts read.

    `entries` begins with the entries of the stage, which follow from the poses of the first frame.
    """

    def __init__(
        self,
        robot: Robot,
        scene: str,
        tool: str | None,
        frame: str | None,
        forward: Callable[[bytes], None] | None = None,
    ) -> None:
        self.robot, self.scene, self.tool, self.frame = robot, scene, tool, frame
        self.window, self._sent = Recorder(forward), set[str]()
        self.meshcat = Visualizer(window=self.window)
        self.drawing = self.draw(robot, "robot")
        # Path of each body's node, in the order of Pinocchio's joints from 1 on.
        self.nodes = [["meshcat", "robot", path] for path in self.drawing.paths]
        self.entries: dict[str, object] = {}
        # Name, node, position and force direction of each thruster.
        self.nozzles: list[dict[str, object]] = []
        for item, (name, *_) in named_inputs(robot.inputs):
            if isinstance(item, Thruster):
                joint, placement = find_frame(robot.model, item.frame)
                nozzle: dict[str, object] = {"name": name, "path": self.nodes[joint - ROOT]}
                nozzle["position"] = placement.act(np.array(item.position)).tolist()
                nozzle["direction"] = (placement.rotation @ np.array(item.direction)).tolist()
                self.nozzles.append(nozzle)
        self.floor = [0.0, 0.0, 0.0]  # [m] point of the floor below the robot
        self.size = 1.0  # [m] radius of the robot in the first frame

    def draw(self, robot: Robot, node: str, look: str = "real", prefix: str = "") -> Drawing:
        """Draw a robot below a node of the scene."""
        return Drawing(robot, self.meshcat[node], look, self._sent, prefix)

    def set_stage(self, poses: Array, about: str, held: Sequence[Drawing] = ()) -> None:
        """Set the entries of the stage by the poses (njoints - 1, 7) of the first frame."""
        robot, nodes = self.robot, self.nodes
        points = self.drawing.points(poses)
        low, high = points.min(axis=0), points.max(axis=0)
        centre = (low + high) / 2.0
        size = max(float(np.linalg.norm(points - centre, axis=1).max()), 1e-3)
        self.size, self.floor = size, [*centre[:2].tolist(), float(low[2])]
        sun, direction, orbit = np.array(SUN), np.array(VIEWS[self.scene]), dict[str, object]()
        field = field_of(robot, frame_of(robot, self.frame)) if self.scene == "space" else None
        if field and robot.orbit:
            # The z axis points away from the central body, and the x axis along the orbit.
            radial, along, normal = field.axes.T
            sun, direction = (along * x + normal * y + radial * z for x, y, z in (sun, direction))
            far = robot.orbit.radius / robot.orbit.body_radius
            rate = robot.orbit.mean_motion
            orbit = {
                "up": [along.tolist(), radial.tolist(), (-normal).tolist()],
                "orbit": {"body": robot.orbit.body, "distance": far, "rate": rate},
            }
        triads = [{"path": nodes[0], **_placed(pin.SE3.Identity())}]
        if self.tool:
            joint, placement = find_frame(robot.model, self.tool)
            triads.append({"path": nodes[joint - ROOT], **_placed(placement)})
        named, wheels = named_wheels(robot.inputs), list[dict[str, object]]()
        for name, wheel in named:
            joint, at = find_frame(robot.model, wheel.frame)
            axis, several = np.array(wheel.axis), [each.frame for _, each in named]
            apart = _APART * size * (several.count(wheel.frame) > 1)
            placement = at * pin.SE3(turned_to(axis), apart * axis)
            # The wheel spins with its body if its speed is a state.
            spins = nodes[robot.model.getJointId(name) - ROOT] if name in robot.wheels else None
            wheels.append({"path": nodes[joint - ROOT], "spins": spins, **_placed(placement)})
        self.entries = {
            **orbit,
            "triads": triads,
            "nozzles": self.nozzles,
            "wheels": wheels,
            "links": {k: link for each in (self.drawing, *held) for k, link in each.links.items()},
            "title": robot.name,
            "subtitle": about,
            "scene": self.scene,
            "size": size,
            "centre": centre.tolist(),
            "sun": sun.tolist(),
            "direction": direction.tolist(),
            "base": nodes[0],
        }

    def html(self, mode: str, points: Array, **entries: object) -> str:
        """Return the page, with further entries; its camera shows the points (M, 3)."""
        # A live page gets its commands from its server. Other pages open no connections.
        live, digits = mode == "live", max(4, 4 - math.floor(math.log10(self.size)))
        info = {
            **self.entries,
            "floor": self.floor,
            "mode": mode,
            "points": points.round(digits).tolist(),
            **entries,
            "commands": [] if live else [_base64(each) for each in self.window.commands()],
        }
        # In a script element, only the end tag and the start of a comment have a special meaning.
        data = json.dumps(info, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
        fields = {
            "title": escape(self.robot.name),
            "scene": self.scene,
            "mode": mode,
            "connect": "'self' ws:" if live else "'none'",
            **_fixed(),
            "data": data,
        }
        parts = _asset("page.html").split("{{")
        return parts[0] + "".join(
            fields[name] + rest for name, _, rest in (part.partition("}}") for part in parts[1:])
        )


def _placed(placement: pin.SE3) -> dict[str, list[float]]:
    x, y, z, *quaternion = pin.SE3ToXYZQUAT(placement).tolist()
    return {"position": [x, y, z], "quaternion": quaternion}
