"""The triangles and the plain colours of a COLLADA file, which Pinocchio's loader merges."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeAlias
from xml.etree import ElementTree

import numpy as np

from fflin.base.validation import Array
from fflin.view.shapes import Color

Indices: TypeAlias = "np.ndarray[Any, np.dtype[np.integer[Any]]]"
Part: TypeAlias = "tuple[Array, Indices, Color | None]"

_NAMESPACE = re.compile(r"\{[^}]*\}")


def read_collada(path: Path) -> list[Part] | None:
    """Read a DAE file.

    Parameters
    ----------
    path : Path

    Returns
    -------
    list of (vertices (V, 3), faces (F, 3), color) or None
        In metres; None where the file holds what this does not read, such as polygons with holes.
    """
    try:
        if b"<!ENTITY" in path.read_bytes():
            return None
        root = ElementTree.parse(path).getroot()
        for element in root.iter():
            element.tag = _NAMESPACE.sub("", element.tag)
        return list(_parts(root))
    except (OSError, ElementTree.ParseError, ValueError, LookupError, AttributeError, TypeError):
        return None


def _parts(root: ElementTree.Element) -> Iterator[Part]:
    unit = root.find("asset/unit")
    top: Array = np.eye(4)
    # As ROS and Pinocchio do, and unlike COLLADA, no heed is paid to the axis that is up.
    top[:3, :3] *= float(unit.get("meter", 1.0) if unit is not None else 1.0)
    identified = {e.get("id"): e for e in root.iter() if e.get("id")}
    (scene,) = (identified[e.get("url", "")[1:]] for e in root.iter("instance_visual_scene"))
    stack = [(node, top) for node in scene.findall("node")]
    while stack:
        node, above = stack.pop()
        here = above @ _transform(node)
        stack += [(child, here) for child in node.findall("node")]
        stack += [(identified[e.get("url", "")[1:]], here) for e in node.findall("instance_node")]
        for instance in node.findall("instance_geometry"):
            bound = {
                e.get("symbol"): identified[e.get("target", "")[1:]]
                for e in instance.iter("instance_material")
            }
            mesh = identified[instance.get("url", "")[1:]].find("mesh")
            for primitive in mesh if mesh is not None else ():
                if primitive.tag not in ("triangles", "polylist", "polygons"):
                    continue
                vertices, faces = _faces(primitive, identified)
                material = bound.get(primitive.get("material"))
                color = _color(material, identified) if material is not None else None
                yield vertices @ here[:3, :3].T + here[:3, 3], faces, color


def _transform(node: ElementTree.Element) -> Array:
    total: Array = np.eye(4)
    for element in node:
        step: Array = np.eye(4)
        if element.tag == "matrix":
            step = _floats(element).reshape(4, 4)
        elif element.tag == "translate":
            step[:3, 3] = _floats(element)
        elif element.tag == "scale":
            step[:3, :3] = np.diag(_floats(element))
        elif element.tag == "rotate":
            *axis, angle = _floats(element)
            x, y, z = np.array(axis) / np.linalg.norm(axis)
            cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
            a = np.radians(angle)
            step[:3, :3] += np.sin(a) * cross + (1.0 - np.cos(a)) * cross @ cross
        elif element.tag in ("lookat", "skew"):
            raise ValueError(element.tag)
        total = total @ step
    return total


def _faces(
    primitive: ElementTree.Element, identified: dict[str | None, ElementTree.Element]
) -> tuple[Array, Indices]:
    inputs = primitive.findall("input")
    stride = 1 + max(int(e.get("offset", 0)) for e in inputs)
    (corner,) = (e for e in inputs if e.get("semantic") == "VERTEX")
    (position,) = (
        e
        for e in identified[corner.get("source", "")[1:]].findall("input")
        if e.get("semantic") == "POSITION"
    )
    source = identified[position.get("source", "")[1:]]
    array = source.find("float_array")
    vertices = _floats(array).reshape(-1, 3)
    indices = [np.array(p.text.split(), dtype=np.intp) for p in primitive.findall("p") if p.text]
    corners = [p.reshape(-1, stride)[:, int(corner.get("offset", 0))] for p in indices]
    if primitive.tag == "triangles":
        faces = [part.reshape(-1, 3) for part in corners]
    else:
        counts = primitive.findtext("vcount")
        if counts is not None:
            ends = np.cumsum([int(word) for word in counts.split()])
            corners = np.split(np.concatenate(corners), ends[:-1])
        faces = [
            np.column_stack((np.full(len(p) - 2, p[0]), p[1:-1], p[2:]))
            for p in corners
            if len(p) >= 3
        ]
    merged = np.concatenate(faces) if faces else np.empty((0, 3), dtype=np.intp)
    return vertices, merged


def _color(
    material: ElementTree.Element, identified: dict[str | None, ElementTree.Element]
) -> Color | None:
    (instance,) = material.findall("instance_effect")
    effect = identified[instance.get("url", "")[1:]]
    for shader in ("phong", "lambert", "blinn", "constant"):
        found = effect.find(f".//{shader}/diffuse/color")
        if found is not None:
            r, g, b, a = np.clip(_floats(found), 0.0, 1.0).tolist()
            return r, g, b, a if a > 0.0 else 1.0
    return None


def _floats(element: ElementTree.Element | None) -> Array:
    if element is None or not element.text:
        raise ValueError("no numbers")
    return np.array(element.text.split(), dtype=float)
