"""Drawing of robots in a meshcat scene, and the self-contained HTML page of the scene.

Each body is a node of the scene. The visual elements of the body are child nodes of this node.
Wheels, thrusters and constraints are drawn at their positions on the links.
"""

from __future__ import annotations

import base64
import json
import math
import re
import warnings
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from hashlib import sha1
from html import escape
from importlib.resources import files
from typing import Any
from urllib.parse import quote

import numpy as np
import pinocchio as pin
import umsgpack

from fflin.base.tables import counted
from fflin.base.validation import Array
from fflin.dynamics.coordinates import frame_of
from fflin.dynamics.orbital import OrbitField
from fflin.robot.equipment.assembly import turned_to
from fflin.robot.inputs import Thruster, named_wheels
from fflin.robot.joints import ROOT, find_frame
from fflin.robot.orbit import CircularOrbit, EllipticOrbit
from fflin.robot.robot import Robot
from fflin.view.constraints import constraint_marks
from fflin.view.magnetorquers import rods
from fflin.view.shapes import (
    PLAIN,
    Color,
    Indices,
    Mesh,
    Shape,
    bendings,
    load_mesh,
    shapes,
)

with warnings.catch_warnings():
    # from packages that meshcat imports
    warnings.simplefilter("ignore", DeprecationWarning)
    from meshcat import Visualizer

Lowered = dict[str, Any]

# Wheels in the same frame would overlap. Therefore each of these wheels is moved along its axis.
# The distance is this fraction of the robot's size.
_APART = 0.1

# The axis of a cylinder is y in three.js, and z in URDF.
_Y_TO_Z = np.array([[1.0, 0, 0, 0], [0, 0, -1.0, 0], [0, 1.0, 0, 0], [0, 0, 0, 1.0]])

# {type of an array: (extension type of msgpack-lite, name of the typed array in JavaScript)}.
_TYPED = {
    "<u2": (0x14, "Uint16Array"),
    "<u4": (0x16, "Uint32Array"),
    "<f4": (0x17, "Float32Array"),
}

# Placeholder for a mesh that has already been sent to the page.
_ELSEWHERE: dict[str, object] = {
    "uuid": "elsewhere",
    "type": "SphereGeometry",
    "radius": 0.0,
}

_SCRIPTS = (
    "sky",
    "orbit",
    "look",
    "camera",
    "stage",
    "marks",
    "equipment",
    "pick",
    "keys",
    "chart",
    "raster",
    "plots",
    "large",
    "compare",
    "quality",
    "player",
    "live",
    "modes",
    "main",
)


def packed(array: Array) -> str:
    """Encode an array in single precision; the JavaScript function `floats` decodes it."""
    return encoded(np.ascontiguousarray(array, dtype="<f4").tobytes())


def encoded(content: bytes) -> str:
    """Encode bytes; the JavaScript function `decode` decodes them."""
    return base64.b64encode(content).decode("ascii")


def _asset(name: str) -> str:
    return files("fflin.view").joinpath("assets", name).read_text(encoding="utf-8")


def _bare(script: str) -> str:
    """Remove indentation and comments from a script."""
    return re.sub(r"(?m)^ *(//.*\n)?", "", script)


@cache
def _fixed() -> dict[str, str]:
    """Return the parts that all pages share: the style and the scripts."""
    bundle = files("meshcat").joinpath("viewer", "dist", "main.min.js")
    meshcat = bundle.read_text(encoding="utf-8")
    body = _bare("\n".join(_asset(f"{name}.js") for name in _SCRIPTS))
    head = '"use strict";\nconst THREE = MeshCat.THREE;'
    return {
        "style": _asset("style.css"),
        "meshcat": meshcat.replace("</script", "<\\/script").replace("<!--", "<\\!--"),
        # Put the scripts into a function, so that their names do not collide with names in
        # meshcat's bundle.
        "scripts": f"(() => {{\n{head}\n{body}\nmain();\n}})();",
        "start": _bare(_asset("start.js")),
    }


def body_poses(robot: Robot, q: Array) -> Array:
    """Return the poses (.., njoints - 1, 7) of all bodies at q (.., nq).

    The pose of a body is the pose of its joint's frame. The body of the first mode of a flexible
    appendage is an exception: its pose is the pose of the appendage's frame after bending.
    """
    data = robot.model.createData()
    all_poses = []
    for row in q.reshape(-1, robot.nq):
        pin.forwardKinematics(robot.model, data, row)
        poses = [pin.SE3ToXYZQUAT(placement) for placement in data.oMi.tolist()[ROOT:]]
        if robot.appendages:
            for bending in bendings(robot).values():
                poses[bending.node - ROOT] = pin.SE3ToXYZQUAT(
                    bending.placement(data, row)
                )
        all_poses.append(poses)
    return np.array(all_poses).reshape(*q.shape[:-1], robot.model.njoints - ROOT, 7)


class Drawing:
    """Drawing of a robot at a node of a page's scene, with a child node for each body.

    If `coarse` is true, meshes are drawn with few triangles.

    The constructor adds notes about missing drawings to `page.notes`. If `look` is "real" or
    "held", the constructor also adds the links of the robot to `page.links`.
    """

    def __init__(
        self,
        page: Page,
        robot: Robot,
        node: str,
        look: str = "real",
        prefix: str = "",
        *,
        coarse: bool = False,
    ) -> None:
        self.prefix = prefix
        self._visualizer = page.meshcat[node]
        # Name of each body's node, in the order of Pinocchio's joints (without the universe).
        self.paths = [quote(name, safe=" ") for name in list(robot.model.names)[ROOT:]]
        drawn_shapes, notes = shapes(robot)
        # boxes are the normal drawing of a payload without a URDF
        if robot.urdf or not prefix:
            page.notes |= dict.fromkeys(notes)
        corners: dict[int, list[Array]] = {}
        for index, shape in enumerate(drawn_shapes):
            body = self._visualizer[self.paths[shape.joint - ROOT]]
            pieces = _pieces(shape, coarse)
            for part, (geometry, matrix, color, box) in enumerate(pieces):
                about: dict[str, object] = {
                    "finish": shape.finish,
                    "color": color,
                    "look": look,
                }
                if look in ("real", "held"):
                    about["link"] = link = ".".join(filter(None, (prefix, shape.link)))
                    page.links[link] = _link(robot, shape)
                identity = str(geometry["uuid"])
                shown = _ELSEWHERE if identity in page.sent else geometry
                if geometry["type"] == "BufferGeometry":
                    about["mesh"] = identity
                    if look == "real":
                        # drawn instead while frames are slow, if the page contains it
                        assert shape.mesh is not None
                        few = load_mesh(shape.mesh, coarse=True)[part]
                        about["coarse"] = _triangles(few)["uuid"]
                    page.sent.add(identity)
                placed = shape.placement.homogeneous @ matrix
                # `content` describes a three.js mesh. The material is a placeholder, which the page
                # replaces. If the geometry is the placeholder _ELSEWHERE, the page uses the
                # geometry that was sent earlier with the same `identity`.
                content = {
                    "metadata": {"version": 4.5, "type": "Object"},
                    "geometries": [shown],
                    "materials": [{"uuid": "material", "type": "MeshStandardMaterial"}],
                    "object": {
                        "uuid": "object",
                        "type": "Mesh",
                        "geometry": shown["uuid"],
                        "material": "material",
                        "matrix": placed.T.ravel().tolist(),
                        "userData": about,
                    },
                }
                self._send("set_object", body[f"{index}_{part}"], object=content)
                corners.setdefault(shape.joint, []).append(_box_corners(placed, box))
        # {Pinocchio joint: corners (8, 3) of its body's bounding box, in the frame of this body}
        self.corners = {
            joint: _box_corners(np.eye(4), _bounds(np.concatenate(boxes)))
            for joint, boxes in corners.items()
        }

    def place(self, poses: Array) -> None:
        """Set the poses (njoints - 1, 7) of all bodies: position, then quaternion x, y, z, w."""
        for path, pose in zip(self.paths, poses, strict=True):
            matrix = pin.XYZQUATToSE3(pose).homogeneous.T.ravel().tolist()
            self._send("set_transform", self._visualizer[path], matrix=matrix)

    def points(self, poses: Array) -> Array:
        """Return the corners (M, 3), in the world, of the bounding boxes of all bodies."""
        world_corners = []
        for joint, corners in self.corners.items():
            placement = pin.XYZQUATToSE3(poses[joint - ROOT])
            world_corners += [placement.act(corner) for corner in corners]
        return np.array(world_corners)

    def _send(self, kind: str, node: Visualizer, **entries: object) -> None:
        node.window.record({"type": kind, "path": node.path.lower(), **entries})

    def tracks(self, t: Array, poses: Array) -> list[dict[str, object]]:
        """Return the animation of all bodies, given times t (N,) and poses (N, njoints - 1, 7)."""
        times = typed(t)
        clips = []
        for index, path in enumerate(self.paths):
            tracks = [
                {
                    "name": ".position",
                    "type": "vector3",
                    "values": typed(poses[:, index, :3]),
                },
                {
                    "name": ".quaternion",
                    "type": "quaternion",
                    "values": typed(poses[:, index, 3:]),
                },
            ]
            clip = {
                "fps": 1,
                "name": path,
                "tracks": [{**track, "times": times} for track in tracks],
            }
            clips.append({"path": self._visualizer[path].path.lower(), "clip": clip})
        return clips


def _link(robot: Robot, shape: Shape) -> list[float]:
    """Return the mass [kg] of a shape's link, then the link's pose (7,) in the body's frame."""
    known = robot.pieces.get(shape.link) or robot.links.get(shape.link)
    mass = known.mass if known else 0.0
    if not robot.model.existFrame(shape.link, pin.FrameType.BODY):  # an inertia box
        mass = robot.model.inertias[shape.joint].mass
    return [mass, *pin.SE3ToXYZQUAT(shape.at).round(6).tolist()]


def typed(array: Array | Indices, kind: str = "<f4") -> object:
    """Pack an array so that the page decodes it as a typed array."""
    return umsgpack.Ext(
        _TYPED[kind][0], np.ascontiguousarray(array, dtype=kind).tobytes()
    )


def _pieces(
    shape: Shape, coarse: bool
) -> list[tuple[dict[str, object], Array, Color, Array]]:
    """Return the geometry, matrix, colour and bounding box of each three.js mesh of a shape.

    A bounding box is given by two opposite corners (2, 3), before the transform by the matrix
    (4, 4). A capsule has three meshes: a cylinder and two spheres.
    """
    unit = np.eye(4)
    if shape.kind == "mesh":
        assert shape.mesh is not None
        scale = np.diag((*shape.size, 1.0))
        return [
            (
                _triangles(mesh),
                scale,
                shape.color or mesh.color or PLAIN,
                _bounds(mesh.vertices),
            )
            for mesh in load_mesh(shape.mesh, coarse=coarse)
        ]
    color = shape.color or PLAIN
    pieces = list[tuple[dict[str, object], Array, Color, Array]]()

    def add(name: str, matrix: Array, half: Sequence[float], **sizes: float) -> None:
        geometry = {"uuid": name.lower(), "type": f"{name}Geometry", **sizes}
        pieces.append((geometry, matrix, color, np.array([np.negative(half), half])))

    if shape.kind == "box":
        width, height, depth = shape.size
        half = [side / 2.0 for side in shape.size]
        add("Box", unit, half, width=width, height=height, depth=depth)
        return pieces
    radius = shape.size[0]
    ends = [0.0]
    if shape.kind != "sphere":
        length = shape.size[1]
        sizes = {"radiusTop": radius, "radiusBottom": radius, "height": length}
        add(
            "Cylinder",
            _Y_TO_Z,
            (radius, length / 2.0, radius),
            **sizes,
            radialSegments=40,
        )
        ends = []
        if shape.kind == "capsule":
            ends = [-length / 2.0, length / 2.0]
    for end in ends:
        lifted = pin.SE3(np.eye(3), np.array((0.0, 0.0, end))).homogeneous
        fineness = {"widthSegments": 32, "heightSegments": 20}
        add("Sphere", lifted, (radius, radius, radius), radius=radius, **fineness)
    return pieces


def _triangles(mesh: Mesh) -> dict[str, object]:
    kind = "<u2" if len(mesh.vertices) < 2**16 else "<u4"
    digest = sha1(mesh.vertices.tobytes() + mesh.faces.tobytes(), usedforsecurity=False)
    corners = {"itemSize": 3, "type": "Float32Array", "array": typed(mesh.vertices)}
    return {
        "uuid": digest.hexdigest(),
        "type": "BufferGeometry",
        "data": {
            "index": {"type": _TYPED[kind][1], "array": typed(mesh.faces, kind)},
            "attributes": {"position": {**corners, "normalized": False}},
        },
    }


def _bounds(points: Array) -> Array:
    return np.stack((points.min(axis=0), points.max(axis=0)))


def _box_corners(matrix: Array, box: Array) -> Array:
    """Return the corners (8, 3) of a box after a transform (4, 4).

    `box` (2, 3) contains the least and the largest coordinates before the transform.
    """
    choice = np.array([[i & 1, i >> 1 & 1, i >> 2 & 1] for i in range(8)])
    corners = np.take_along_axis(box, choice, axis=0)
    return corners @ matrix[:3, :3].T + matrix[:3, 3]


class Recorder:
    """Replacement for the window of a `meshcat.Visualizer`, to record and forward commands."""

    def __init__(self, forward: Callable[[bytes], None] | None = None) -> None:
        self.web_url = ""
        self.forward = forward
        # Last command of each kind for each node: {path: {"TYPE PROPERTY": command}}. The property
        # is empty for commands without a property, such as "set_object ".
        self._nodes: dict[str, dict[str, Lowered]] = {}
        self._animation: Lowered | None = None

    def send(self, command: Any) -> None:
        """Record and forward a command of meshcat."""
        self.record(command.lower())

    def record(self, lowered: Lowered) -> None:
        """Record and forward a command that is already in the form of a dictionary."""
        kind = lowered["type"]
        path = lowered.get("path", "")
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
        if self.forward:
            self.forward(umsgpack.packb(lowered))

    def commands(self) -> Iterator[bytes]:
        """Yield the messages with which meshcat's page builds the recorded scene."""
        for node in list(self._nodes.values()):
            # "set_object" resets the properties of a node, so this command is sent before the
            # commands that set these properties.
            for key in sorted(node, key=lambda key: key != "set_object "):
                yield umsgpack.packb(node[key])
        if self._animation:
            yield umsgpack.packb(self._animation)

    def wait(self) -> None:
        """Do nothing, because a recorder has no browser to wait for."""

    def close(self) -> None:
        """Do nothing, because a recorder has no connection to close."""


def subtitle(robot: Robot) -> str:
    """Return the text below a robot's name on the page."""
    wheels = len(robot.wheels)
    parts = [counted(robot.n - wheels, "joint")]
    if wheels:
        parts.append(counted(wheels, "wheel"))
    parts.append(f"{robot.mass:.4g} kg")
    if robot.orbit:
        height = str(robot.orbit).partition(",")[0]
        if isinstance(robot.orbit, CircularOrbit):
            height = f"{robot.orbit.altitude / 1e3:.6g} km over {robot.orbit.body}"
        parts.append(height)
    return ", ".join(parts)


class Page:
    """Page that shows a robot in a scene: the drawing, and the data for the scripts of the page.

    The first frame shows the configuration `q` (nq,).
    """

    def __init__(
        self, robot: Robot, q: Array, scene: str, tool: str | None, frame: str | None
    ) -> None:
        self.robot, self.scene, self.tool, self.frame = robot, scene, tool, frame
        self.window, self.sent = Recorder(), set[str]()  # `sent`: uuids of sent meshes
        self.meshcat = Visualizer(window=self.window)
        self.notes = dict[str, None]()  # notes about missing drawings
        # {link: mass [kg], pose (7,) on its body}
        self.links = dict[str, list[float]]()
        self.drawing = Drawing(self, robot, "robot")
        # Path of each body's node, in the order of Pinocchio's joints (without the universe).
        self.nodes = [["meshcat", "robot", path] for path in self.drawing.paths]
        # For each thruster: its name, the path of the node of the body that carries the thruster,
        # and the position [m] and direction of the force in the frame of this body's joint.
        self.nozzles: list[dict[str, object]] = []
        for item, (name, *_) in robot.named_inputs:
            if isinstance(item, Thruster):
                joint, placement = find_frame(robot.model, item.frame)
                nozzle: dict[str, object] = {
                    "name": name,
                    "path": self.nodes[joint - ROOT],
                }
                nozzle["position"] = placement.act(np.array(item.position)).tolist()
                nozzle["direction"] = (
                    placement.rotation @ np.array(item.direction)
                ).tolist()
                self.nozzles.append(nozzle)
        # In the first frame: corners of the bounding boxes of all bodies, centre and radius of the
        # robot, and the point of the floor below the centre. All are in m.
        self.points = self.drawing.points(body_poses(robot, q))
        low, high = self.points.min(axis=0), self.points.max(axis=0)
        self.centre = (low + high) / 2.0
        self.size = max(
            float(np.linalg.norm(self.points - self.centre, axis=1).max()), 1e-3
        )
        self.floor = np.array([*self.centre[:2], low[2]])

    def html(
        self,
        mode: str,
        points: Array,
        times: Sequence[float] = (0.0,),
        **entries: object,
    ) -> str:
        """Return the HTML of the page, with a camera that shows all points (M, 3).

        `times` are those of the frames of a motion [s]. `entries` are added to the data that the
        scripts of the page read.
        """
        robot = self.robot
        nodes = self.nodes
        orbit = dict[str, object]()
        if self.scene == "space" and robot.orbit:
            field = OrbitField(robot, frame_of(robot, self.frame))
            # The rows of "up" are the axes of the page in the orbital frame: x along the orbit, y
            # (upwards) away from the central body, and z opposite to the orbit normal.
            radial, along, normal = field.axes.T
            orbit = {
                "up": [along.tolist(), radial.tolist(), (-normal).tolist()],
                "orbit": _orbit(robot.orbit, times),
            }
        triads = [{"path": nodes[0], **_placed(pin.SE3.Identity())}]
        if self.tool:
            joint, placement = find_frame(robot.model, self.tool)
            triads.append({"path": nodes[joint - ROOT], **_placed(placement)})
        named, wheels = named_wheels(robot.inputs), list[dict[str, object]]()
        for name, wheel in named:
            joint, at = find_frame(robot.model, wheel.frame)
            axis = np.array(wheel.axis)
            frames = [item.frame for _, item in named]
            apart = 0.0
            if frames.count(wheel.frame) > 1:
                apart = _APART * self.size
            placement = at * pin.SE3(turned_to(axis), apart * axis)
            # If the speed of a wheel is a state, the drawn wheel rotates with the node of the
            # wheel's joint.
            spins = (
                nodes[robot.model.getJointId(name) - ROOT]
                if name in robot.wheels
                else None
            )
            wheels.append(
                {"path": nodes[joint - ROOT], "spins": spins, **_placed(placement)}
            )
        # A live page receives the meshcat commands from the server. Other pages contain these
        # commands and open no connection.
        connect = "'self' ws:"
        commands = list[str]()
        if mode != "live":
            connect = "'none'"
            commands = [encoded(command) for command in self.window.commands()]
        digits = max(4, 4 - math.floor(math.log10(self.size)))
        info = {
            **orbit,
            "triads": triads,
            "nozzles": self.nozzles,
            "wheels": wheels,
            "rods": rods(robot, nodes),
            "constraints": constraint_marks(robot, nodes, robot.constraints),
            "links": self.links,
            "title": robot.name,
            "subtitle": subtitle(robot),
            "verdict": "",
            "notes": list(self.notes),
            "scene": self.scene,
            "size": self.size,
            "centre": self.centre.tolist(),
            "base": nodes[0],
            "bodies": nodes,
            "floor": self.floor.tolist(),
            "mode": mode,
            "points": points.round(digits).tolist(),
            **entries,
            "commands": commands,
        }
        # In a script element, only an end tag or the start of a comment has a special meaning. Both
        # begin with "<", which is therefore escaped.
        data = json.dumps(info, allow_nan=False, separators=(",", ":")).replace(
            "<", "\\u003c"
        )
        fields = {
            "title": escape(robot.name),
            "subtitle": escape(str(info["subtitle"])),
            "verdict": escape(str(info["verdict"])),
            "notes": escape("; ".join(self.notes)),
            "scene": self.scene,
            "mode": mode,
            "connect": connect,
            **_fixed(),
            "data": data,
        }
        return re.sub(r"{{(\w+)}}", lambda field: fields[field[1]], _asset("page.html"))


def _orbit(
    orbit: CircularOrbit | EllipticOrbit, t: Sequence[float]
) -> dict[str, object]:
    """Return the central body and, at times t (N,) [s], its direction and distance.

    Distances are relative to the radius of the body. `angles` [rad] are those by which the orbital
    frame has rotated since t = 0. A circular orbit has a constant rate [rad/s] instead.
    """
    if isinstance(orbit, CircularOrbit):
        far = orbit.radius / orbit.body_radius
        return {"body": orbit.body, "distance": far, "rate": orbit.mean_motion}
    states = [orbit.at(time) for time in t]
    start = orbit.at(0.0).angle
    distances = np.array([state.radius for state in states]) / orbit.body_radius
    angles = np.array([state.angle - start for state in states])
    return {
        "body": orbit.body,
        "distance": float(distances[0]),
        "farthest": float(distances.max()),
        "distances": packed(distances),
        "angles": packed(angles),
    }


def _placed(placement: pin.SE3) -> dict[str, list[float]]:
    x, y, z, *quaternion = pin.SE3ToXYZQUAT(placement).tolist()
    return {"position": [x, y, z], "quaternion": quaternion}
