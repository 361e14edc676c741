"""A robot as nodes of a meshcat scene: one node per body, with its visual elements below."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from hashlib import sha1
from urllib.parse import quote

import numpy as np
import pinocchio as pin
import umsgpack

from fflin.base.validation import Array
from fflin.robot.joints import find_frame
from fflin.robot.robot import ROOT, Robot
from fflin.view.shapes import PLAIN, Color, Indices, Mesh, Shape, bendings, load_mesh, shapes

with warnings.catch_warnings():
    warnings.simplefilter("ignore", DeprecationWarning)  # from packages that meshcat imports
    from meshcat import Visualizer

# Cylinders are along y in three.js, and along z in URDF.
_Y_TO_Z = np.array([[1.0, 0, 0, 0], [0, 0, -1.0, 0], [0, 1.0, 0, 0], [0, 0, 0, 1.0]])

# Extension types of msgpack-lite, which the page decodes as typed arrays.
_TYPED = {"<u2": (0x14, "Uint16Array"), "<u4": (0x16, "Uint32Array"), "<f4": (0x17, "Float32Array")}

# Placeholder for a mesh that the page already has.
_ELSEWHERE: dict[str, object] = {"uuid": "elsewhere", "type": "SphereGeometry", "radius": 0.0}


def body_poses(robot: Robot, q: Array) -> Array:
    """Return the poses (.., njoints - 1, 7) of all joint frames at q (.., nq).

    The first mode of a flexible appendage has the pose of the appendage's bent frame.
    """
    data, found = robot.model.createData(), []
    for row in q.reshape(-1, robot.nq):
        pin.forwardKinematics(robot.model, data, row)
        poses = [pin.SE3ToXYZQUAT(placement) for placement in data.oMi.tolist()[ROOT:]]
        for bending in bendings(robot).values() if robot.appendages else ():
            poses[bending.node - ROOT] = pin.SE3ToXYZQUAT(bending.placement(data, row))
        found.append(poses)
    return np.array(found).reshape(*q.shape[:-1], robot.model.njoints - ROOT, 7)


class Drawing:
    """Drawing of a robot below a node of a meshcat scene, with a child node for each joint."""

    def __init__(
        self,
        robot: Robot,
        visualizer: Visualizer,
        look: str = "real",
        sent: set[str] | None = None,
        prefix: str = "",
    ) -> None:
        self.robot, self.prefix = robot, prefix
        self._visualizer = visualizer
        # Node name of each body, in the order of Pinocchio's joints from 1 on.
        self.paths = [quote(name, safe=" ") for name in list(robot.model.names)[ROOT:]]
        sent = set() if sent is None else sent  # meshes that were sent to the page, updated below
        found, self.notes = shapes(robot)  # shapes, and notes about missing drawings
        self.links = dict[str, list[float]]()  # {name: mass [kg] and pose on its joint}
        corners: dict[int, list[Array]] = {}
        for index, shape in enumerate(found):
            node = visualizer[self.paths[shape.joint - ROOT]]
            for part, (geometry, matrix, color, box) in enumerate(_pieces(shape)):
                about: dict[str, object] = {"finish": shape.finish, "color": color, "look": look}
                if look in ("real", "held"):
                    about["link"] = link = ".".join(filter(None, (prefix, shape.link)))
                    self.links.setdefault(link, _link(robot, shape))
                identity = str(geometry["uuid"])
                shown = _ELSEWHERE if identity in sent else geometry
                if geometry["type"] == "BufferGeometry":
                    about["mesh"] = identity
                    sent.add(identity)
                placed = shape.placement.homogeneous @ matrix
                # A three.js mesh; the page has its material and known geometry.
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
                self._send("set_object", node[f"{index}_{part}"], object=content)
                corners.setdefault(shape.joint, []).append(_box_corners(placed, box))
        self.bodies = list(corners)  # Pinocchio joints
        self.corners = [
            _box_corners(np.eye(4), _bounds(np.concatenate(boxes))) for boxes in corners.values()
        ]

    def place(self, poses: Array) -> None:
        """Set the poses of all bodies: (njoints - 1, 7) with x, y, z and quaternion x, y, z, w."""
        for path, pose in zip(self.paths, poses, strict=True):
            matrix = pin.XYZQUATToSE3(pose).homogeneous.T.ravel().tolist()
            self._send("set_transform", self._visualizer[path], matrix=matrix)

    def points(self, poses: Array) -> Array:
        """Return the corners (M, 3) of all bodies' bounding boxes in the world."""
        found = []
        for joint, corners in zip(self.bodies, self.corners, strict=True):
            placement = pin.XYZQUATToSE3(poses[joint - ROOT])
            found += [placement.act(corner) for corner in corners]
        return np.array(found)

    def _send(self, kind: str, node: Visualizer, **entries: object) -> None:
        node.window.record({"type": kind, "path": node.path.lower(), **entries})

    def tracks(self, t: Array, poses: Array) -> list[dict[str, object]]:
        """Return the animation of all bodies by times t (N,) and poses (N, njoints - 1, 7)."""
        times = typed(t)
        clips = []
        for index, path in enumerate(self.paths):
            tracks = [
                {"name": ".position", "type": "vector3", "values": typed(poses[:, index, :3])},
                {"name": ".quaternion", "type": "quaternion", "values": typed(poses[:, index, 3:])},
            ]
            clip = {"fps": 1, "name": path, "tracks": [{**each, "times": times} for each in tracks]}
            clips.append({"path": self._visualizer[path].path.lower(), "clip": clip})
        return clips


def _link(robot: Robot, shape: Shape) -> list[float]:
    """Return the mass [kg] of a shape's link, and its pose (7,) in the joint's frame."""
    model, pieces = robot.model, robot.pieces
    if not model.existFrame(shape.link, pin.FrameType.BODY):  # a body drawn as a box of its inertia
        mass, at = model.inertias[shape.joint].mass, pin.SE3.Identity()
    else:
        known = pieces.get(shape.link) or robot.links.get(shape.link)
        mass, at = known.mass if known else 0.0, find_frame(model, shape.link)[1]
        for bending in bendings(robot).values():
            if bending.node == shape.joint:
                at = bending.frame.actInv(at)
    return [mass, *pin.SE3ToXYZQUAT(at).round(6).tolist()]


def typed(array: Array | Indices, kind: str = "<f4") -> object:
    """Pack an array so that the page decodes it as a typed array."""
    return umsgpack.Ext(_TYPED[kind][0], np.ascontiguousarray(array, dtype=kind).tobytes())


def _pieces(shape: Shape) -> list[tuple[dict[str, object], Array, Color, Array]]:
    """Return geometry, matrix, colour, and two corners of the bounding box of each piece."""
    unit = np.eye(4)
    if shape.kind == "mesh":
        assert shape.mesh is not None
        scale = np.diag((*shape.size, 1.0))
        return [
            (_triangles(mesh), scale, shape.color or mesh.color or PLAIN, _bounds(mesh.vertices))
            for mesh in load_mesh(shape.mesh)
        ]
    color, found = shape.color or PLAIN, list[tuple[dict[str, object], Array, Color, Array]]()

    def add(name: str, matrix: Array, half: Sequence[float], **sizes: float) -> None:
        geometry = {"uuid": name.lower(), "type": f"{name}Geometry", **sizes}
        found.append((geometry, matrix, color, np.array([np.negative(half), half])))

    if shape.kind == "box":
        width, height, depth = shape.size
        half = [side / 2.0 for side in shape.size]
        add("Box", unit, half, width=width, height=height, depth=depth)
        return found
    radius, ends = shape.size[0], [0.0]
    if shape.kind != "sphere":
        length = shape.size[1]
        sizes = {"radiusTop": radius, "radiusBottom": radius, "height": length}
        add("Cylinder", _Y_TO_Z, (radius, length / 2.0, radius), **sizes, radialSegments=40)
        ends = [-length / 2.0, length / 2.0] if shape.kind == "capsule" else []
    for end in ends:
        lifted = pin.SE3(np.eye(3), np.array((0.0, 0.0, end))).homogeneous
        fineness = {"widthSegments": 32, "heightSegments": 20}
        add("Sphere", lifted, (radius, radius, radius), radius=radius, **fineness)
    return found


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
    """Return the corners (8, 3) of a box (2, 3) that is transformed by a matrix (4, 4)."""
    choice = np.array([[i & 1, i >> 1 & 1, i >> 2 & 1] for i in range(8)])
    corners = np.take_along_axis(box, choice, axis=0)
    return corners @ matrix[:3, :3].T + matrix[:3, 3]
