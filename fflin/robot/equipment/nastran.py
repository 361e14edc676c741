"""Craig-Bampton superelements of Nastran, with modes that are clamped at a rigid interface."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fflin.base.errors import InputError, unknown
from fflin.base.validation import Array, Mask, vector, whole
from fflin.base.writing import as_path, reason, remember

LENGTHS = {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "in": 0.0254, "ft": 0.3048}  # [m]
MASSES = {
    "kg": 1.0,
    "g": 1e-3,
    "tonne": 1e3,
    "lb": 0.45359237,
    "slug": 14.593902937206364,
    "lbf s^2/in": 175.12683524647636,
}  # [kg]
# Names that different programs give to the mass and stiffness matrices.
_MASS, _STIFFNESS = ("mxx", "maa", "maax"), ("kxx", "kaa", "kaax")

# Largest rounding error, relative to the largest entry of a matrix. If the asymmetry, the
# stiffness that couples boundary and modes, or the stiffness of the rigid interface is larger, the
# file is refused.
_SHARE = 1e-6


class Superelement(NamedTuple):
    """Modes with a fixed interface, in SI units and the axes of Nastran's basic frame.

    `L` and `inertia` are about the origin of the interface, which is rigid.
    """

    frequency: Array  # (k,) [Hz]
    L: Array  # (6, k): translation [kg^0.5] before rotation [kg^0.5 m]
    inertia: Array  # M_rr (6, 6): translation before rotation


def read_superelement(
    op4: object, asm: object, *, origin: Any, modes: int | None, length: str, mass: str
) -> Superelement:
    """Return the modes of a superelement, see `FlexibleAppendage.from_nastran`."""
    for what, unit, known in (("length", length, LENGTHS), ("mass", mass, MASSES)):
        if not isinstance(unit, str) or unit not in known:
            raise unknown(f"unit of {what}", str(unit), known)
    files = as_path(op4), as_path(asm)
    remember(*files)
    boundary, rigid, points = _boundary(files[1])
    M, K = _matrices(files[0], len(boundary))
    rigid = rigid[boundary]
    center = points.mean(axis=0)
    if origin is not None:
        center = vector("origin", origin, 3, "a point") / LENGTHS[length]
    # Convert rigid motions about the file's basic origin to motions about the interface's origin.
    x, y, z = center
    shift = np.eye(6)
    shift[:3, 3:] = [[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]
    rigid = rigid @ shift
    _require_clamped(files[0], K, rigid, boundary)
    inner = ~boundary
    squares, shapes = _eigenpairs(files[0], K[np.ix_(inner, inner)], M[np.ix_(inner, inner)])
    if modes is not None:
        count = whole("modes", modes, 1)
        if count > len(squares):
            raise InputError(f"modes is {count}, but {files[0]} has only {len(squares)}")
        squares, shapes = squares[:count], shapes[:, :count]
    meters = np.array([1.0, 1.0, 1.0, *[LENGTHS[length]] * 3])
    kilograms = MASSES[mass]
    L = rigid.T @ M[np.ix_(boundary, inner)] @ shapes
    inertia = rigid.T @ M[np.ix_(boundary, boundary)] @ rigid
    if not inertia[0, 0] > 0.0:
        raise InputError(f"{files[0]} has a rigid mass of {inertia[0, 0]:g}, expected more than 0")
    return Superelement(
        np.sqrt(squares) / (2.0 * np.pi),
        np.sqrt(kilograms) * meters[:, None] * L,
        kilograms * np.outer(meters, meters) * 0.5 * (inertia + inertia.T),
    )


def _boundary(path: Path) -> tuple[Mask, Array, Array]:
    """Return the mask of boundary degrees of freedom, all rigid motions, and the grid points."""
    try:
        with np.printoptions():  # pyYeti changes them for the whole process
            from pyyeti import nastran
    except ImportError:
        raise InputError(
            "files of Nastran need pyYeti; install it with: pip install 'fflin[nastran]'"
        ) from None
    punched = path.suffix == ".asm" and path.with_suffix(".pch").is_file()
    try:
        # A .pch file lists the degrees of freedom that each grid point retains; without the file
        # it retains all six.
        uset, _, boundary, *kept = nastran.asm2uset(
            str(path), try_rdextrn="pv_only" if punched else False
        )
        rigid = nastran.rbgeom_uset(uset)
        points = uset.loc[(slice(None), 1), "x":"z"].values.astype(float)
    except Exception as error:  # pyYeti raises whatever its parsing meets
        raise InputError(
            f"{path} cannot be read as the assembly file (.asm) of an external superelement: "
            f"{reason(error)}"
        ) from None
    keep = kept[0] if kept else np.ones(len(rigid), dtype=bool)
    boundary = np.asarray(boundary, dtype=bool)
    if not boundary.any() or boundary.all() or not np.isfinite(points).all() or not len(points):
        raise InputError(
            f"{path} lacks boundary grids (GRID) with coordinates or modes (SPOINT); expected "
            "both, as in a Craig-Bampton superelement"
        )
    return boundary[keep], np.asarray(rigid)[keep], points


def _matrices(path: Path, size: int) -> tuple[Array, Array]:
    """Return the mass and stiffness matrices (size, size) of an output4 file."""
    from pyyeti.nastran import op4

    try:
        found: Mapping[str, object] = op4.read(str(path), sparse=False)
    except Exception as error:  # pyYeti raises whatever its parsing meets
        said = f"{path} cannot be read as an output4 file (.op4): {reason(error)}"
        raise InputError(said) from None
    by_name = {str(name).lower(): value for name, value in found.items()}
    matrices = []
    for what, names in (("mass", _MASS), ("stiffness", _STIFFNESS)):
        name = next((each for each in names if each in by_name), None)
        if name is None:
            raise InputError(
                f"{path} has no {what} matrix; expected one named {' or '.join(names)}, found "
                f"{', '.join(by_name) or 'no matrix'}"
            )
        matrix = np.asarray(by_name[name], dtype=float)
        if (
            matrix.shape != (size, size)
            or not np.isfinite(matrix).all()
            or np.abs(matrix - matrix.T).max() > _SHARE * np.abs(matrix).max()
        ):
            raise InputError(
                f"{what} matrix '{name}' of {path} has shape {matrix.shape}; expected a finite, "
                f"symmetric matrix of the {size} degrees of freedom of the .asm file"
            )
        matrices.append(0.5 * (matrix + matrix.T))
    return matrices[0], matrices[1]


def _require_clamped(path: Path, K: Array, rigid: Array, boundary: Mask) -> None:
    """Raise `InputError` unless the structure is clamped only at the boundary."""
    inner, largest = ~boundary, float(np.abs(K).max(initial=0.0))
    coupling = K[np.ix_(boundary, inner)]
    if np.abs(coupling).max(initial=0.0) > _SHARE * largest:
        raise InputError(
            f"the stiffness matrix in {path} couples boundary and modes; expected modes that are "
            "clamped at the boundary (Craig-Bampton)"
        )
    K_b = K[np.ix_(boundary, boundary)]
    size = np.abs(rigid).T @ np.abs(K_b) @ np.abs(rigid)
    if np.abs(rigid.T @ K_b @ rigid).max() > _SHARE * max(float(size.max()), 1e-300):
        raise InputError(
            f"the stiffness matrix in {path} resists a rigid motion of the boundary, because the "
            "structure is also clamped elsewhere, or because the .asm file describes other grids"
        )


def _eigenpairs(path: Path, K: Array, M: Array) -> tuple[Array, Array]:
    """Return the squared frequencies [rad^2/s^2] and the mode shapes of unit modal mass."""
    from scipy.linalg import LinAlgError, eigh

    try:
        squares, shapes = eigh(K, M)
    except LinAlgError:
        squares = np.zeros(1)
    if not squares[0] > 0.0:
        raise InputError(
            f"the modal mass or stiffness matrix in {path} is not positive definite; expected "
            "independent modes that are clamped at the boundary"
        )
    return np.asarray(squares), np.asarray(shapes)
