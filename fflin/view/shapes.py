"""Visible shapes of a robot, from its URDF or from its inertias.

Meshes are read from their files and simplified.
"""

from __future__ import annotations

import json
import math
import os
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias
from urllib.parse import unquote
from xml.parsers.expat import ExpatError, ParserCreate

import numpy as np
import pinocchio as pin

from fflin.base.errors import FflinError
from fflin.base.validation import Array
from fflin.base.writing import read_file, reason, require_regular, shown
from fflin.robot.catalog import find_mesh
from fflin.robot.equipment.appendages import FlexibleAppendage, Slosh
from fflin.robot.joints import ROOT, Carried, find_frame, find_joint
from fflin.robot.mass_properties import equivalent_box
from fflin.robot.robot import Robot
from fflin.robot.urdf.description import read_pose
from fflin.robot.urdf.reader import SIZE_LIMIT, plain_root
from fflin.robot.urdf.xml import Element, named

# Colour of a shape without a colour in the URDF.
PLAIN: Color = (0.72, 0.74, 0.77, 1.0)

_DENSITY = 1000.0  # [kg/m^3] density of a ball that represents a mass

# Tables of structural programs contain rounding errors in place of zeros. For the drawing, a
# participation counts as zero up to this fraction of the largest one, with m as unit of length.
_NOISE = 1e-9


@dataclass(frozen=True)
class Shape:
    """Visual geometry that is rigidly fixed to a body of a robot.

    The body's frame is the frame of `joint`. For links on a flexible appendage, `joint` is the
    joint of the first mode, and the body's frame is the appendage's frame after bending.
    """

    joint: int  # Pinocchio joint that moves the shape
    kind: str  # "box", "sphere", "cylinder", "capsule" or "mesh"
    size: tuple[float, ...]  # [m] sides, radius, or radius and length; scale of a mesh
    placement: pin.SE3  # in the body's frame; the axis of a cylinder is z
    # red, green, blue, opacity; None for the colours of a mesh file
    color: Color | None = PLAIN
    finish: str = ""  # name of the material, which decides how metallic the shape looks
    mesh: Path | None = None
    link: str = ""  # name of the link, or of the body if its inertia is drawn
    # link's pose in the body's frame
    at: pin.SE3 = field(default_factory=pin.SE3.Identity)


def shapes(robot: Robot) -> tuple[tuple[Shape, ...], tuple[str, ...]]:
    """Return the shapes of a robot, and notes about visual elements that are not drawn."""
    notes: list[str] = []
    drawn = list[Shape]()
    if robot.urdf:
        drawn = list(_visuals(robot, notes))
    if not drawn:
        notes.append(
            f"{robot.name}: no visual geometry; boxes with the links' inertias are drawn instead"
        )
        return tuple(_inertia_boxes(robot)), tuple(notes)
    for prefix, other in robot.attached:
        theirs, their_notes = shapes(other)
        notes += their_notes
        carriers = carriers_of(robot, prefix, other)
        for shape in theirs:
            joint, held = carriers[shape.joint - ROOT]
            placement = held * shape.placement
            link = f"{prefix}.{shape.link}"
            at = held * shape.at
            drawn.append(
                replace(shape, joint=joint, placement=placement, link=link, at=at)
            )
    return tuple(drawn), tuple(notes)


def carriers_of(robot: Robot, prefix: str, payload: Robot) -> list[Carried]:
    """Return where the base and the joints of an attached payload are on the robot.

    Each entry belongs to the base or to a joint of the payload. It contains the joint of the robot
    that carries this frame of the payload, and the placement of the frame on that joint.
    """
    names = [f"{prefix}.{name}" for name in list(payload.model.names)[ROOT + 1 :]]
    return [
        find_frame(robot.model, prefix),
        *(find_joint(robot.model, name) for name in names),
    ]


def _visuals(robot: Robot, notes: list[str]) -> Iterator[Shape]:
    path = robot.urdf
    assert path is not None
    try:
        root, _ = plain_root(read_file(path, "URDF", SIZE_LIMIT), path, robot.xacro)
    except FflinError as error:
        notes.append(f"no visual geometry: {error}")
        return
    colors = {
        element.attributes["name"]: color
        for element in root.find_all("material")
        if "name" in element.attributes and (color := _color(element)) is not None
    }
    bent = bent_links(robot, root)
    missing, unreadable, odd = list[str](), list[str](), list[str]()
    for link in root.find_all("link"):
        frame_id = robot.model.getFrameId(
            link.attributes.get("name", ""), pin.FrameType.BODY
        )
        if frame_id >= robot.model.nframes:
            continue  # the link is not in the model
        frame = robot.model.frames[frame_id]
        if frame.parentJoint < ROOT:
            continue
        joint = frame.parentJoint
        at = frame.placement
        if bending := bent.get(frame.name):
            joint = bending.node
            at = bending.frame.actInv(frame.placement)
        for visual in link.find_all("visual"):
            try:
                kind, size, mesh = _geometry(visual)
                placement = at * read_pose(visual).placement
                color, finish = _material(visual, colors, kind)
            except (ValueError, LookupError):
                odd.append(str(visual.line))
                continue
            file = None if mesh is None else find_mesh(mesh, path, robot.package_dirs)
            if mesh is not None and file is None:
                missing.append(f"{shown(mesh)} (link {frame.name})")
                continue
            if file is not None:
                try:
                    load_mesh(file)
                except ValueError:
                    unreadable.append(f"{file.name} (link {frame.name})")
                    continue
            yield Shape(
                joint, kind, size, placement, color, finish, file, frame.name, at
            )
    yield from _balls(robot, bent)
    notes += _not_drawn(robot, path, missing, unreadable, odd)


def _not_drawn(
    robot: Robot, path: Path, missing: list[str], unreadable: list[str], odd: list[str]
) -> Iterator[str]:
    """Yield notes about mesh files, and about lines of visual elements, that are not drawn."""
    if missing:
        where = ", ".join(str(folder) for folder in robot.package_dirs) or path.parent
        yield (
            f"{robot.name}: {named('mesh file', missing)} not found below {where} and not "
            "drawn; give the folders of the meshes in package_dirs of fflin.load"
        )
    if unreadable:
        yield f"{robot.name}: {named('mesh file', unreadable)} cannot be read and not drawn"
    if odd:
        lines = ", ".join(odd[:6])
        if len(odd) > 6:
            lines += ", ..."
        yield f"{path.name}: <visual> in line {lines} is malformed and not drawn"


def _geometry(visual: Element) -> tuple[str, tuple[float, ...], str | None]:
    (geometry,) = visual.find_all("geometry")
    (shape,) = geometry.children
    if shape.tag == "box":
        return "box", shape.vector("size", 3), None
    if shape.tag == "sphere":
        return "sphere", (shape.number("radius"),), None
    if shape.tag in ("cylinder", "capsule"):
        return shape.tag, (shape.number("radius"), shape.number("length")), None
    if shape.tag == "mesh":
        scale: tuple[float, ...] = (1.0, 1.0, 1.0)
        if "scale" in shape.attributes:
            scale = shape.vector("scale", 3)
        return "mesh", scale, shape.text("filename")
    raise ValueError(shape.tag)


def _material(
    visual: Element, colors: Mapping[str, Color], kind: str
) -> tuple[Color | None, str]:
    none = None if kind == "mesh" else PLAIN
    for material in visual.find_all("material"):
        name = material.attributes.get("name", "")
        return _color(material) or colors.get(name, none), name
    return none, ""


def _color(material: Element) -> Color | None:
    for element in material.find_all("color"):
        r, g, b, a = (min(max(x, 0.0), 1.0) for x in element.vector("rgba", 4))
        return r, g, b, a
    return None


def _inertia_boxes(robot: Robot) -> Iterator[Shape]:
    for joint, inertia in enumerate(robot.model.inertias.tolist()):
        if joint < ROOT or inertia.mass <= 0.0:
            continue
        sides, placement = equivalent_box(inertia)
        link = "base" if joint == ROOT else robot.model.names[joint]
        yield Shape(
            joint, "box", tuple(sides.tolist()), placement, finish="inertia", link=link
        )


class Bending(NamedTuple):
    """Linear map from an appendage's modal amplitudes to a rotation or displacement for drawing.

    The links of the appendage are drawn as a rigid body, rotated about the origin of the
    appendage's frame. The rotation theta is the least-squares solution of L^T theta = eta, with the
    rotational participation L (3, k) and the modal amplitudes eta (k,). If L is zero, the links are
    displaced instead. The displacement follows from the same equation, in which L is replaced by
    the translational participation.
    """

    node: int  # Pinocchio joint of the first mode; its scene node carries the links
    carrier: int  # Pinocchio joint that carries the appendage
    frame: pin.SE3  # placement of the appendage's frame on the carrier
    modes: list[int]  # indices of the modal amplitudes in q
    twist: Array  # (6, k) per unit of q: translation before rotation
    # (3,) centre of the first mode's ball, which represents the links, in `frame`
    center: Array

    def placement(self, data: pin.Data, q: Array) -> pin.SE3:
        """Return the placement, in the world, of the appendage's frame after bending."""
        shift, turn = np.split(self.twist @ q[self.modes], 2)
        return data.oMi[self.carrier] * self.frame * pin.SE3(pin.exp3(turn), shift)


@lru_cache(maxsize=4)
def bendings(robot: Robot) -> dict[str, Bending]:
    """Return {title: bending} for the flexible appendages of a robot."""
    bending_of = {}
    for item in robot.appendages:
        if isinstance(item, FlexibleAppendage):
            joints = [robot.joint(name) for name in item.modes]
            scale = np.array([joint.scale for joint in joints])
            turn = shift = np.zeros((3, len(joints)))
            if np.abs(item.rotation).max() > _NOISE * np.abs(item.translation).max():
                turn = np.linalg.pinv(item.rotation, rcond=_NOISE).T
            else:
                shift = np.linalg.pinv(item.translation, rcond=_NOISE).T
            node = robot.model.getJointId(joints[0].name)
            carrier, frame = find_frame(robot.model, item.frame)
            ball = robot.model.jointPlacements[node] * robot.model.inertias[node].lever
            bending_of[item.title] = Bending(
                node,
                carrier,
                frame,
                [joint.idx_q for joint in joints],
                np.vstack((shift, turn)) / scale,
                frame.actInv(ball),
            )
    return bending_of


def bent_links(robot: Robot, root: Element) -> dict[str, Bending]:
    """Return {link: bending} for all links of a URDF that are fixed to an appendage's frame."""
    children: dict[str, list[str]] = {}
    for joint in root.find_all("joint"):
        ends = [joint.find_all(end) for end in ("parent", "child")]
        if all(ends):
            parent, child = (end[0].attributes.get("link", "") for end in ends)
            children.setdefault(parent, []).append(child)
    carried = {child for links in children.values() for child in links}
    bending_of_link: dict[str, Bending] = {}
    for item in robot.appendages:
        # excludes the root link
        if isinstance(item, FlexibleAppendage) and item.frame in carried:
            bending = bendings(robot)[item.title]
            links = [item.frame]
            for link in links:
                if robot.model.existFrame(link) and (
                    find_frame(robot.model, link).joint == bending.carrier
                ):
                    bending_of_link[link] = bending
                    links += children.get(link, [])
    return bending_of_link


def _balls(robot: Robot, bent: dict[str, Bending]) -> Iterator[Shape]:
    """Yield shapes that represent appendages without visual elements."""
    for item in robot.appendages:
        if isinstance(item, Slosh):
            joint = robot.model.getJointId(item.modes[1])
            lever = robot.model.inertias[joint].lever
            yield Shape(
                joint, "sphere", (_radius(item.mass),), pin.SE3(np.eye(3), lever)
            )
        elif item.frame not in bent:
            bending = bendings(robot)[item.title]
            t, r = np.split(item.participation[:, 0], 2)
            only_rotates = np.abs(t).max() <= _NOISE * np.abs(r).max()
            mass = 0.0 if only_rotates else float(t @ t)
            size = _radius(mass or 1.0)
            # An appendage without modal mass only rotates. It is drawn as a box, because the
            # rotation of a sphere would not be visible.
            placement = pin.SE3(np.eye(3), bending.center)
            if mass:
                yield Shape(bending.node, "sphere", (size,), placement)
            else:
                yield Shape(bending.node, "box", (size, size, size), placement)


def _radius(mass: float) -> float:
    radius: float = (0.75 * mass / (math.pi * _DENSITY)) ** (1.0 / 3.0)
    return radius


Color = tuple[float, float, float, float]
Indices: TypeAlias = "np.ndarray[Any, np.dtype[np.integer[Any]]]"

# Details smaller than this fraction of a mesh's extent are dropped. This halves the number of
# triangles of most CAD meshes.
_RESOLUTION = 1.0 / 400.0

# Desired largest number of triangles for a mesh file. Vertices in the same cell of a grid are
# merged. The grid is made coarser until at most this number of triangles remain, or until the cells
# are larger than 2 % of the largest extent of the file's meshes.
_LARGEST = 20_000

# The same for a coarse mesh, whose cells are at most _COARSEST of the extent. Translucent robots
# are drawn so, because without a graphics card the triangles decide the frames per second.
_LARGEST_COARSE, _COARSEST = 1_500, 0.06


@dataclass(frozen=True)
class Mesh:
    """Triangles of one colour."""

    vertices: Array  # (V, 3) of float32
    faces: Indices  # (F, 3) of uint32
    color: Color | None  # None without a colour in the file


def load_mesh(path: Path, *, coarse: bool = False) -> tuple[Mesh, ...]:
    """Read a mesh file; raise ValueError if it cannot be drawn.

    A coarse mesh has few triangles.

    The vertices are in the file's unit of length. For a COLLADA file, they are in m.
    """
    try:
        status = os.stat(path)
    except OSError as error:
        raise ValueError(f"{path}: cannot be read: {reason(error)}") from None
    key = path, status.st_mtime_ns, status.st_size
    return _coarse(*key) if coarse else _loaded(*key)


@lru_cache(maxsize=256)
def _coarse(path: Path, modified: int, size: int) -> tuple[Mesh, ...]:
    """Return the meshes of a file with at most about _LARGEST_COARSE triangles."""
    meshes = _loaded(path, modified, size)
    extent = max(float(np.ptp(mesh.vertices, axis=0).max()) for mesh in meshes)
    resolution = _RESOLUTION
    coarse = meshes
    while sum(len(mesh.faces) for mesh in coarse) > _LARGEST_COARSE:
        resolution *= 1.5
        if resolution > _COARSEST:
            break
        coarse = tuple(
            Mesh(*_weld(mesh.vertices, mesh.faces, extent * resolution), mesh.color)
            for mesh in meshes
        )
    # A part whose triangles all collapse remains as it is.
    return tuple(
        few if len(few.faces) else mesh
        for mesh, few in zip(meshes, coarse, strict=True)
    )


@lru_cache(maxsize=256)
def _loaded(path: Path, _modified: int, _size: int) -> tuple[Mesh, ...]:
    _require_plain(path)
    # The key of the cache contains the file's size and modification time, so a changed file is read
    # again.
    parts = list[tuple[Array, Indices, Color | None]]()
    if path.suffix.lower() == ".dae":
        parts = _colored(path)
    parts = parts or [(*_triangles(path), None)]
    corners = np.concatenate(
        [vertices[faces].reshape(-1, 3) for vertices, faces, _ in parts]
    )
    if not corners.size or not np.isfinite(corners).all():
        raise ValueError(f"{path}: has no triangles")
    if np.abs(corners).max() > _FARTHEST:
        raise ValueError(f"{path}: is larger than {_FARTHEST:g} m; check its unit")
    extent = float(np.ptp(corners, axis=0).max()) or 1.0  # 0 if all corners coincide
    resolution = _RESOLUTION
    while True:
        welded = [
            Mesh(*_weld(vertices, faces, extent * resolution), color)
            for vertices, faces, color in parts
        ]
        if sum(len(mesh.faces) for mesh in welded) <= _LARGEST or resolution > 0.02:
            break
        resolution *= 1.5
    seen = tuple(mesh for mesh in welded if len(mesh.faces))
    if not seen:
        raise ValueError(f"{path}: has no triangle large enough to be visible")
    return seen


# Largest size of a mesh file, and of a file to which it refers [bytes].
_LARGEST_FILE = 2**28
_MOST_NODES = 100_000  # of a COLLADA file
_FARTHEST = 1e12  # largest coordinate [m]; pages have numbers of single precision


def _require_plain(path: Path) -> None:
    """Raise ValueError if a mesh file could stop the libraries that read it.

    The file and all files to which it refers must be regular files of a bounded size, because a
    library waits for a pipe forever. The nodes of a COLLADA file must not contain themselves,
    because a library follows them until Python crashes.
    """
    kind = path.suffix.lower()
    try:
        content = read_file(path, "mesh", _LARGEST_FILE)
        for name in _references(kind, content):
            file = path.parent / name
            # A missing file is skipped by the libraries.
            if file.exists():
                require_regular(file, "material or buffer", _LARGEST_FILE)
        if kind == ".dae":
            _require_no_cycle(content)
    except (FflinError, ExpatError, TypeError, AttributeError, RecursionError) as error:
        raise ValueError(f"{path}: cannot be read: {reason(error)}") from None


def _references(kind: str, content: bytes) -> list[str]:
    """Return the paths to which a mesh file refers, as they are written in the file."""
    if kind == ".obj":
        lines = content.decode("utf-8", "replace").splitlines()
        named = [
            line.split(maxsplit=1)
            for line in lines
            if line.lstrip().startswith("mtllib")
        ]
        return [words[1].strip() for words in named if len(words) > 1]
    if kind == ".gltf":
        table = json.loads(content)
        parts = [*table.get("buffers", ()), *table.get("images", ())]
        uris = [unquote(part["uri"]) for part in parts if "uri" in part]
        return [uri for uri in uris if not uri.startswith("data:")]
    return []


def _require_no_cycle(content: bytes) -> None:
    """Raise ValueError if a node of a COLLADA file contains itself, directly or through others."""
    # {node: nodes in it}; the document is the node "".
    children: dict[str, list[str]] = {}
    # Nodes around the parser's position, outermost first.
    open_nodes: list[str] = []

    def begin(tag: str, attributes: dict[str, str]) -> None:
        name = tag.rpartition(":")[2]  # without the XML namespace
        parent = open_nodes[-1] if open_nodes else ""
        if name == "node":
            # A node without an id gets a unique one. An id in XML cannot begin with a space.
            node = attributes.get("id") or f" {len(children)}"
            children.setdefault(parent, []).append(node)
            children.setdefault(node, [])
            open_nodes.append(node)
        elif name == "instance_node":
            node = attributes.get("url", "").removeprefix("#")
            children.setdefault(parent, []).append(node)

    def end(tag: str) -> None:
        if tag.rpartition(":")[2] == "node":
            open_nodes.pop()

    parser = ParserCreate()
    parser.StartElementHandler = begin
    parser.EndElementHandler = end
    parser.Parse(content, True)
    try:
        order = list(TopologicalSorter(children).static_order())
    except CycleError:
        raise ValueError("a node contains itself") from None
    # Nodes are drawn as often as they are contained, so their number can double at every level.
    drawn = dict.fromkeys(order, 1)
    for name in order:
        drawn[name] += sum(drawn[child] for child in children.get(name, ()))
        if drawn[name] > _MOST_NODES:
            raise ValueError(f"more than {_MOST_NODES:,} nodes")


def _colored(path: Path) -> list[tuple[Array, Indices, Color | None]]:
    """Return vertices [m], faces and colour of each part of a COLLADA file; [] if malformed."""
    import trimesh

    try:
        with warnings.catch_warnings():
            # Packages that read COLLADA use deprecated functions of NumPy.
            warnings.simplefilter("ignore", DeprecationWarning)
            scene = trimesh.load_scene(path, process=False)
            pieces = scene.convert_units("meters").dump()
        meshes = [mesh for mesh in pieces if hasattr(mesh, "faces")]
        parts = list[tuple[Array, Indices, Color | None]]()
        for mesh in meshes:
            color = getattr(
                getattr(mesh.visual, "material", None), "baseColorFactor", None
            )
            if color is not None:  # None if the file gives a texture or no colour
                r, g, b, a = (float(x) / 255.0 for x in color)
                color = r, g, b, a or 1.0
            parts.append((mesh.vertices, mesh.faces, color))
    except Exception:  # a malformed file may raise anything
        return []
    return parts


def _triangles(path: Path) -> tuple[Array, Indices]:
    import coal

    try:
        mesh = coal.MeshLoader().load(str(path), np.ones(3))
    except (RuntimeError, ValueError) as error:
        raise ValueError(
            f"{path}: cannot be read: {' '.join(str(error).split())}"
        ) from None
    vertices = np.array(mesh.vertices(), dtype=float).reshape(-1, 3)
    triangles = (mesh.tri_indices(index) for index in range(mesh.num_tris))
    faces = np.array([(t[0], t[1], t[2]) for t in triangles], dtype=np.intp).reshape(
        -1, 3
    )
    return vertices, faces


def _weld(vertices: Array, faces: Indices, cell: float) -> tuple[Array, Indices]:
    """Merge all vertices in the same cell of a grid; drop triangles that collapse."""
    _, first, inverse = np.unique(
        np.round(vertices / cell).astype(np.int64),
        axis=0,
        return_index=True,
        return_inverse=True,
    )
    faces = inverse.reshape(-1)[faces]
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    # After the merge, several triangles may have the same corners; keep only one of them.
    _, kept = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    faces = faces[np.sort(kept)]
    used, compact = np.unique(faces, return_inverse=True)
    return (
        vertices[first[used]].astype(np.float32),
        compact.reshape(-1, 3).astype(np.uint32),
    )
