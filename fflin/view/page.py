"""Self-contained HTML page of a scene: its parameters and its meshcat commands."""

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
from fflin.robot.joints import ROOT
from fflin.robot.robot import Robot
from fflin.view.equipment import equipment
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
    """Build the page from `info` for its scripts and from the commands of a `Recorder`.

    The page may open connections only to `connect`.
    """
    info = {**info, "commands": [_base64(command) for command in commands]}
    # In a script element, only its end tag and the start of a comment are special.
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
    # A function scope separates these names from the names in meshcat's bundle.
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
        """Record and forward a meshcat command."""
        lowered = command.lower()
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
            self._forward(_message(lowered))

    def commands(self) -> Iterator[bytes]:
        """Yield the messages with which meshcat's page builds the recorded scene."""
        for node in list(self._nodes.values()):
            # An object replaces the previous object, so it comes before its properties.
            for key in sorted(node, key=lambda key: key != "set_object "):
                yield _message(node[key])
        if self._animation:
            yield _message(self._animation)

    def wait(self) -> None:
        """Do nothing, because no browser has to connect."""

    def close(self) -> None:
        """Do nothing, because nothing is open."""


def _message(lowered: Lowered) -> bytes:
    packed: bytes = umsgpack.packb(lowered)
    return packed


def subtitle(robot: Robot) -> str:
    """Return the text below a robot's name on the page."""
    wheels = len(robot.wheels)
    parts = [counted(robot.n - wheels, "joint"), *[counted(wheels, "wheel")] * bool(wheels)]
    orbit = [f"{robot.orbit.altitude / 1e3:.6g} km over {robot.orbit.body}"] if robot.orbit else []
    return ", ".join([*parts, f"{robot.mass:.4g} kg", *orbit])


def rounded(points: Array, size: float) -> list[list[float]]:
    """Round points (M, 3) to the digits that a robot of that size [m] needs."""
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
        # z is away from the central body, and x along the orbit.
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
