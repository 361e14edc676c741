"""Mesh files as compact triangles: welded vertices, and one array of faces per colour."""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from fflin.base.validation import Array
from fflin.base.writing import reason

Color = tuple[float, float, float, float]
Indices: TypeAlias = "np.ndarray[Any, np.dtype[np.integer[Any]]]"

# Details smaller than this fraction of a mesh's extent are dropped, which halves most CAD meshes.
_RESOLUTION = 1.0 / 400.0

# Largest number of triangles; the grid is made coarser until a mesh has fewer.
_LARGEST = 20_000


@dataclass(frozen=True)
class Mesh:
    """Triangles of one colour."""

    vertices: Array  # (V, 3) of float32
    faces: Indices  # (F, 3) of uint32
    color: Color | None  # None without a colour in the file


def load_mesh(path: Path) -> tuple[Mesh, ...]:
    """Read a mesh file in its own unit of length; raise ValueError if nothing is visible."""
    try:
        found = os.stat(path)
    except OSError as error:
        raise ValueError(f"{path}: cannot be read: {reason(error)}") from None
    return _loaded(path, found.st_mtime_ns, found.st_size)


@lru_cache(maxsize=256)
def _loaded(path: Path, _modified: int, _size: int) -> tuple[Mesh, ...]:
    # A changed time or size of the file is a new key of the cache, so a changed file is read again.
    parts = _colored(path) if path.suffix.lower() == ".dae" else []
    parts = parts or [(*_triangles(path), None)]
    corners = np.concatenate([vertices[faces].reshape(-1, 3) for vertices, faces, _ in parts])
    if not corners.size or not np.isfinite(corners).all():
        raise ValueError(f"{path}: has no triangles")
    extent = float(np.ptp(corners, axis=0).max())
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


def _colored(path: Path) -> list[tuple[Array, Indices, Color | None]]:
    """Return vertices [m], faces and colour of each part of a COLLADA file, [] if malformed."""
    import trimesh

    try:
        scene = trimesh.load_scene(path, process=False)
        meshes = [mesh for mesh in scene.convert_units("meters").dump() if hasattr(mesh, "faces")]
        return [(mesh.vertices, mesh.faces, _color(mesh)) for mesh in meshes]
    except Exception:  # a malformed file may raise anything
        return []


def _color(mesh: Any) -> Color | None:
    color = getattr(getattr(mesh.visual, "material", None), "baseColorFactor", None)
    if color is None:
        return None  # a texture, or nothing
    r, g, b, a = (float(x) / 255.0 for x in color)
    return r, g, b, a or 1.0


def _triangles(path: Path) -> tuple[Array, Indices]:
    import coal

    try:
        mesh = coal.MeshLoader().load(str(path), np.ones(3))
    except (RuntimeError, ValueError) as error:
        raise ValueError(f"{path}: cannot be read: {' '.join(str(error).split())}") from None
    vertices = np.array(mesh.vertices(), dtype=float).reshape(-1, 3)
    triangles = (mesh.tri_indices(index) for index in range(mesh.num_tris))
    faces = np.array([(t[0], t[1], t[2]) for t in triangles], dtype=np.intp).reshape(-1, 3)
    return vertices, faces


def _weld(vertices: Array, faces: Indices, cell: float) -> tuple[Array, Indices]:
    """Merge the vertices in each cell of a grid; drop collapsed triangles."""
    if not cell:
        return vertices[:0].astype(np.float32), faces[:0].astype(np.uint32)
    _, first, inverse = np.unique(
        np.round(vertices / cell).astype(np.int64), axis=0, return_index=True, return_inverse=True
    )
    faces = inverse.reshape(-1)[faces]
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    # Several triangles may have become the same.
    _, kept = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    faces = faces[np.sort(kept)]
    used, compact = np.unique(faces, return_inverse=True)
    return (vertices[first[used]].astype(np.float32), compact.reshape(-1, 3).astype(np.uint32))
