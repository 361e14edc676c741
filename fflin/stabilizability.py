"""What inputs cannot hold and what outputs cannot see, in words."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from fflin.errors import DetectabilityError, InputError, StabilizabilityError, listed
from fflin.validation import Array

if TYPE_CHECKING:
    from fflin.linear_model import LinearModel

# Of the smallest singular value of an equilibrated Popov-Belevitch-Hautus matrix: what computed
# eigenvalues are off by where they are repeated.
_RANK = 1e-7


def require_stabilizable(lin: LinearModel) -> None:
    """Raise `StabilizabilityError` that names what no input can hold."""
    hidden = hidden_modes(lin.A, lin.B, bool(lin.dt), margin=False)
    if not hidden:
        return
    left = np.vstack([vectors for _, vectors in hidden])
    words = _forces_missing(lin, left) or _dominant(left, lin.state_names)
    raise StabilizabilityError(f"the inputs cannot hold {words}")


def require_weighed(lin: LinearModel, A: Array, Q: Array) -> None:
    """Raise `InputError` that names the modes on the boundary of stability that Q leaves out."""
    hidden = hidden_modes(A.T, Q, bool(lin.dt), margin=True)
    if hidden:
        words = _dominant(np.vstack([vectors for _, vectors in hidden]), lin.state_names)
        raise InputError(f"Q does not weigh {words}, which do not settle by themselves; weigh them")


def require_detectable(lin: LinearModel) -> None:
    """Raise `DetectabilityError` that names what no output shows and what does not settle."""
    hidden = hidden_modes(lin.A.T, lin.C.T, bool(lin.dt), margin=False)
    if hidden:
        words = _dominant(np.vstack([vectors for _, vectors in hidden]), lin.state_names)
        raise DetectabilityError(
            f"the outputs do not show {words}, which do not settle by themselves; add outputs"
        )


def require_disturbed(lin: LinearModel, W: Array) -> None:
    """Raise `InputError` that names the modes on the boundary that no disturbance reaches."""
    hidden = hidden_modes(lin.A, W, bool(lin.dt), margin=True)
    if hidden:
        words = _dominant(np.vstack([vectors for _, vectors in hidden]), lin.state_names)
        raise InputError(
            f"W does not disturb {words}, which do not settle by themselves: a steady filter "
            "would not correct them; give them an intensity"
        )


def hidden_modes(
    A: Array, B: Array, discrete: bool, *, margin: bool
) -> list[tuple[complex, Array]]:
    """Return the eigenvalues that do not decay and left eigenvectors (k, nx) that B misses.

    Parameters
    ----------
    A : ndarray (nx, nx)
    B : ndarray (nx, nu)
    discrete : bool
    margin : bool
        Only those on the boundary of stability.
    """
    poles = np.linalg.eigvals(A)
    size = max(float(np.abs(poles - discrete).max()), 1e-300)
    beyond = np.abs(poles) - 1.0 if discrete else poles.real
    # A block of four moves by the fourth root of rounding.
    near = np.abs(beyond) <= 1e-3 * size if margin else beyond >= -1e-3 * size
    still = complex(discrete)
    candidates = [still] + [
        complex(pole)
        for pole in poles[near & (poles.imag >= 0.0)]
        if abs(pole - still) > 1e-3 * size
    ]
    found: list[tuple[complex, Array]] = []
    for pole in candidates:
        if any(abs(pole - other) <= 1e-3 * size for other, _ in found):
            continue
        shifted = A - pole * np.eye(len(A)) if pole.imag else A - pole.real * np.eye(len(A))
        vectors = _left_null(np.column_stack((shifted, B)))
        if len(vectors):
            found.append((pole, vectors))
    return found


def _left_null(matrix: Array) -> Array:
    """Return the left null space (k, rows) of a matrix, its rows and columns of unlike units."""
    rows, columns = np.ones(len(matrix)), np.ones(matrix.shape[1])
    scaled = matrix
    for _ in range(4):
        sizes = np.sqrt(np.abs(scaled).max(axis=1))
        rows /= np.where(sizes > 0.0, sizes, 1.0)
        sizes = np.sqrt(np.abs(scaled).max(axis=0))
        columns /= np.where(sizes > 0.0, sizes, 1.0)
        scaled = rows[:, None] * matrix * columns
    left, values, _ = np.linalg.svd(scaled)
    null: Array = left[:, values <= _RANK * values[0]].conj().T * rows
    return null / np.linalg.norm(null, axis=1, keepdims=True)


def _forces_missing(lin: LinearModel, left: Array) -> str | None:
    """Say which generalised forces are missing, about a point where momentum is conserved."""
    m = len(lin.A) // 2
    names = lin.state_names
    if len(names) != 2 * m or names[m : m + 6] != _BASE_VELOCITIES or lin.M.shape != (m, m):
        return None
    # A left vector is M z on the velocities, where z is a force that no input makes.
    if np.abs(left.imag).max(initial=0.0) > 0.0:
        return None
    forces = np.linalg.svd(np.linalg.solve(lin.M, left.real[:, m:].T).T)[2][: len(left)]
    involved = np.linalg.norm(forces, axis=0) > 1e-6
    base = [word for word, rows in _BASE_WORDS if involved[rows].any()]
    joints = [
        name.partition(".")[2] for name, x in zip(names[m + 6 :], involved[6:], strict=True) if x
    ]
    if joints:
        moved = f"joint{'s' * (len(joints) > 1)} {listed(joints)}, which no input moves"
        return " and ".join((*base, moved))
    both = len(base) == 2
    kind = "momentum" if both else f"{_MOMENTA[base[0]]} momentum"
    return (
        f"{'base attitude and position' if both else base[0]} ({kind} is conserved); add inputs "
        "on the base, or design on fflin.momentum_reduction(lin)"
    )


_BASE_VELOCITIES = tuple(f"{group}.{axis}" for group in ("omega_b", "v_b") for axis in "xyz")
_BASE_WORDS = (("base attitude", slice(0, 3)), ("base position", slice(3, 6)))
_MOMENTA = {"base attitude": "angular", "base position": "linear"}


def _dominant(vectors: Array, names: Sequence[str]) -> str:
    """Name the states that vectors (k, nx) stand on most, one each at least."""
    sizes = np.abs(vectors)
    large = (sizes >= 0.3 * sizes.max(axis=1, keepdims=True)).any(axis=0)
    return listed(name for name, chosen in zip(names, large, strict=True) if chosen)
