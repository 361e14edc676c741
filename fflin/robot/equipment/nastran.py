"""Reader of Nastran's Craig-Bampton superelements, whose modes are clamped at an interface."""

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pinocchio as pin

from fflin.base.errors import FflinError, InputError, require_known
from fflin.base.validation import Array, Mask, vector, whole
from fflin.base.writing import as_path, read_file, reason, require_regular

LENGTHS = {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "in": 0.0254, "ft": 0.3048}  # [m]
MASSES = {
    "kg": 1.0,
    "g": 1e-3,
    "tonne": 1e3,
    "lb": 0.45359237,
    "slug": 14.593902937206364,
    "lbf s^2/in": 175.12683524647636,
}  # [kg]
# Names of the mass matrix and of the stiffness matrix in the files of different programs.
_MASS, _STIFFNESS = ("mxx", "maa", "maax"), ("kxx", "kaa", "kaax")

# Largest sizes of the files [bytes], the largest number of files that an .asm file includes, and
# the largest number of points in its lists "1001 THRU 1020". They are checked before pyYeti reads
# the files, because pyYeti takes memory for every point.
_LARGEST_OP4, _LARGEST_TEXT = 2**31, 2**26
_MOST_FILES, _MOST_POINTS = 100, 10_000

# An INCLUDE statement. Its path may continue on the next lines.
_INCLUDE = re.compile(r"^include[^'\n]*'([^']*)'.*$", re.IGNORECASE | re.MULTILINE)
# Words of a list of points; a continuation such as "+A1" is one word.
_WORD = re.compile(r"[+*]\w*|\d+|thru", re.IGNORECASE)

# Tolerance for rounding errors, relative to the largest entry of the matrix. It applies to the
# asymmetry of the mass and stiffness matrices, and to the stiffness that couples the boundary to
# the modes. For the stiffness that resists rigid motions, the tolerance is relative to `size` in
# `read_superelement`.
_SHARE = 1e-6


def read_superelement(
    op4: object,
    asm: object,
    *,
    origin: object,
    modes: int | None,
    length: str,
    mass: str,
) -> tuple[Array, Array, Array]:
    """Return (frequencies, L, M_rr) of a superelement; see `FlexibleAppendage.from_nastran`.

    The values are in SI units and in the axes of Nastran's basic frame:

    - the frequencies (k,) [Hz];
    - the participation L (6, k), first in translation [kg^0.5], then in rotation [kg^0.5 m];
    - the rigid inertia M_rr (6, 6).

    L and M_rr are about the origin of the interface.
    """
    from scipy.linalg import LinAlgError, eigh

    require_known("unit of length", [str(length)], LENGTHS)
    require_known("unit of mass", [str(mass)], MASSES)
    path, assembly = as_path(op4), as_path(asm)
    require_regular(path, ".op4", _LARGEST_OP4)
    boundary, rigid, points = _boundary(assembly)
    M, K = _matrices(path, len(boundary))
    inner = ~boundary
    rigid = rigid[boundary]
    center = points.mean(axis=0)
    if origin is not None:
        center = vector("origin", origin, 3, "a point") / LENGTHS[length]
    # Convert the rigid motions about the file's basic origin to rigid motions about `center`, the
    # origin of the interface.
    rigid = rigid @ pin.SE3(np.eye(3), center).toActionMatrix()
    inertia = rigid.T @ M[np.ix_(boundary, boundary)] @ rigid
    K_b, coupling = K[np.ix_(boundary, boundary)], K[np.ix_(boundary, inner)]
    size = np.abs(rigid).T @ np.abs(K_b) @ np.abs(rigid)
    try:
        squares, shapes = eigh(K[np.ix_(inner, inner)], M[np.ix_(inner, inner)])
    except LinAlgError:
        squares = np.zeros(1)
    # The modes must be independent and clamped at the boundary. The structure must not be clamped
    # elsewhere, and its mass must be positive.
    faults = {
        "the stiffness matrix couples boundary and modes; expected modes that are clamped at the "
        "boundary (Craig-Bampton)": np.abs(coupling).max() > _SHARE * np.abs(K).max(),
        "the stiffness matrix resists a rigid motion of the boundary, because the structure is "
        "also clamped elsewhere, or because the .asm file describes other grids": (
            np.abs(rigid.T @ K_b @ rigid).max() > _SHARE * max(size.max(), 1e-300)
        ),
        "the modal mass or stiffness matrix is not positive definite; expected independent modes "
        "that are clamped at the boundary": not squares[0] > 0.0,
        f"the rigid mass is {inertia[0, 0]:g}, expected more than 0": not inertia[0, 0]
        > 0.0,
    }
    for fault in (fault for fault, present in faults.items() if present):
        raise InputError(f"{path}: {fault}")
    count = len(squares)
    if modes is not None:
        count = whole("modes", modes, 1, len(squares))
    meters = np.array([1.0, 1.0, 1.0, *[LENGTHS[length]] * 3])
    kilograms = MASSES[mass]
    L = rigid.T @ M[np.ix_(boundary, inner)] @ shapes[:, :count]
    return (
        np.sqrt(squares[:count]) / (2.0 * np.pi),
        np.sqrt(kilograms) * meters[:, None] * L,
        kilograms * np.outer(meters, meters) * 0.5 * (inertia + inertia.T),
    )


@contextmanager
def _read_as(path: Path, kind: str) -> Iterator[None]:
    try:
        yield
    except FflinError:
        raise
    except ImportError:
        raise InputError(
            "Nastran files need pyYeti: pip install 'fflin[nastran]'"
        ) from None
    except Exception as error:  # pyYeti may raise any error
        raise InputError(f"{path} cannot be read as {kind}: {reason(error)}") from None


def _boundary(path: Path) -> tuple[Mask, Array, Array]:
    """Return the boundary mask, the rigid motions and the grid positions of a superelement.

    The mask (m,) is true for the degrees of freedom of the boundary, and false for the modes. The
    columns of the rigid motions (m, 6) are unit translations and rotations about the basic origin.
    The positions (grids, 3) are in basic coordinates, in the file's unit of length.
    """
    # A .pch file lists the degrees of freedom that each grid point retains. Without this file,
    # each grid point retains all six.
    punch = path.with_suffix(".pch")
    punched = path.suffix == ".asm" and punch.exists() and "pv_only"
    with (
        _read_as(path, "the assembly file (.asm) of an external superelement"),
        TemporaryDirectory(prefix="fflin-") as folder,
    ):
        with np.printoptions():  # importing pyYeti changes these options
            from pyyeti import nastran
        # pyYeti reads copies, which include no other files.
        copy = Path(folder, "a.asm")
        copy.write_text(_complete(path), "utf-8")
        if punched:
            copy.with_suffix(".pch").write_text(_complete(punch), "utf-8")
        uset, _, boundary_mask, *kept = nastran.asm2uset(str(copy), try_rdextrn=punched)
        rigid = np.asarray(nastran.rbgeom_uset(uset))
        points = uset.loc[(slice(None), 1), "x":"z"].values.astype(float)
    keep = np.ones(len(rigid), dtype=bool)
    if kept:
        keep = kept[0]
    boundary = np.asarray(boundary_mask, dtype=bool)
    if (
        not boundary.any()
        or boundary.all()
        or not np.isfinite(points).all()
        or not len(points)
    ):
        raise InputError(
            f"{path} lacks boundary grids (GRID) with coordinates or modes (SPOINT); expected "
            "both, as in a Craig-Bampton superelement"
        )
    return boundary[keep], rigid[keep], points


def _complete(path: Path) -> str:
    """Return the text of a Nastran file, in which included files replace INCLUDE statements.

    Raise `InputError` if the text has too many files, characters or points.
    """
    read = list[Path]()
    size = 0

    def text_of(file: Path) -> str:
        nonlocal size
        read.append(file)
        if len(read) > _MOST_FILES:
            raise InputError(
                f"{path} includes more than {_MOST_FILES} files, or includes itself"
            )
        content = read_file(file, "Nastran", _LARGEST_TEXT - size)
        size += len(content)
        return _INCLUDE.sub(
            lambda match: text_of(included(file, match[1])), content.decode()
        )

    def included(file: Path, written: str) -> Path:
        # A bare file name is relative to the file that includes it, any other path to the first.
        name = "".join(line.strip() for line in written.splitlines())
        folder = path.parent if os.path.dirname(name) else file.parent
        return folder / name

    text = text_of(path)
    if (points := _listed_points(text)) > _MOST_POINTS:
        raise InputError(
            f"{path} lists {points:,} points with THRU, expected at most {_MOST_POINTS:,}"
        )
    return text


def _listed_points(text: str) -> int:
    """Return the number of points in all lists such as ``1001 THRU 1020``."""
    words = [word for word in _WORD.findall(text) if word[0] not in "+*"]
    points = 0
    for first, between, last in zip(words, words[1:], words[2:], strict=False):
        if between.lower() == "thru" and first.isdigit() and last.isdigit():
            points += abs(int(last) - int(first)) + 1
    return points


def _matrices(path: Path, size: int) -> list[Array]:
    """Return the mass and stiffness matrices (size, size) of an output4 file."""
    with _read_as(path, "an output4 file (.op4)"):
        from pyyeti.nastran import op4

        file_matrices = op4.read(str(path), sparse=False)
        by_name = {
            str(name).lower(): np.asarray(x, dtype=float)
            for name, x in file_matrices.items()
        }
    matrices = []
    for kind, names in (("mass", _MASS), ("stiffness", _STIFFNESS)):
        name = next((candidate for candidate in names if candidate in by_name), None)
        if name is None:
            raise InputError(
                f"{path} has no {kind} matrix; expected one named {' or '.join(names)}, found "
                f"{', '.join(by_name) or 'no matrix'}"
            )
        matrix = by_name[name]
        if (
            matrix.shape != (size, size)
            or not np.isfinite(matrix).all()
            or np.abs(matrix - matrix.T).max() > _SHARE * np.abs(matrix).max()
        ):
            raise InputError(
                f"{kind} matrix '{name}' of {path} has shape {matrix.shape}; expected a finite, "
                f"symmetric matrix of the {size} degrees of freedom of the .asm file"
            )
        matrices.append(0.5 * (matrix + matrix.T))
    return matrices
