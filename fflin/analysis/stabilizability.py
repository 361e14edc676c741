"""What inputs cannot hold and what outputs cannot see, in words."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from fflin.analysis.ranks import Margin, decided
from fflin.base.errors import (
    DetectabilityError,
    FflinWarning,
    InputError,
    StabilizabilityError,
    listed,
)
from fflin.base.validation import Array

if TYPE_CHECKING:
    from fflin.linear.model import LinearModel

# Of the smallest singular value of an equilibrated Popov-Belevitch-Hautus matrix: what computed
# eigenvalues are off by where they are repeated.
_RANK = 1e-7


def require_stabilizable(lin: LinearModel) -> None:
    """Raise `StabilizabilityError` that names what no input can hold."""
    from fflin.analysis.controllability import controllability
    from fflin.analysis.mechanics import conserved
    from fflin.analysis.names import grouped

    found = controllability(lin)
    if not found.stabilizable:
        weights = conserved(lin).weights
        words = _forces_missing(lin, weights) if len(weights) else None
        words = words or f"{', '.join(grouped(found.uncontrollable))}; add inputs"
        error = StabilizabilityError(f"the inputs cannot hold {words}{_doubts(found.notes)}")
        error.margin = found.margin
        raise error
    _warn_of_doubts(found.notes)


def require_weighed(lin: LinearModel, A: Array, Q: Array) -> None:
    """Raise `InputError` that names the modes on the boundary of stability that Q leaves out."""
    hidden, margin = hidden_modes(A.T, Q, bool(lin.dt))
    doubts = _boundary_doubts(lin, margin, "weighed by Q")
    if hidden:
        words = _dominant(np.vstack(hidden), lin.state_names)
        raise InputError(
            f"Q does not weigh {words}, which do not settle by themselves; weigh them"
            f"{_doubts(doubts)}"
        )
    _warn_of_doubts(doubts)


def require_detectable(lin: LinearModel) -> None:
    """Raise `DetectabilityError` that names what no output shows and what does not settle."""
    from fflin.analysis.names import with_rates
    from fflin.analysis.observability import observability

    found = observability(lin)
    if not found.detectable:
        error = DetectabilityError(
            f"the outputs do not show {with_rates(found.unobservable)}, which do not settle by "
            f"themselves; add outputs{_doubts(found.notes)}"
        )
        error.margin = found.margin
        raise error
    _warn_of_doubts(found.notes)


def _doubts(notes: tuple[str, ...]) -> str:
    return "".join(f"; {note}" for note in notes if note.startswith("undecided"))


def _warn_of_doubts(notes: tuple[str, ...]) -> None:
    for note in notes:
        if note.startswith("undecided"):
            warnings.warn(note, FflinWarning, stacklevel=4)


def require_disturbed(lin: LinearModel, W: Array) -> None:
    """Raise `InputError` that names the modes on the boundary that no disturbance reaches."""
    hidden, margin = hidden_modes(lin.A, W, bool(lin.dt))
    doubts = _boundary_doubts(lin, margin, "disturbed by W")
    if hidden:
        words = _dominant(np.vstack(hidden), lin.state_names)
        raise InputError(
            f"W does not disturb {words}, which do not settle by themselves: a steady filter "
            f"would not correct them; give them an intensity{_doubts(doubts)}"
        )
    _warn_of_doubts(doubts)


def _boundary_doubts(lin: LinearModel, margin: Margin, what: str) -> tuple[str, ...]:
    return tuple(
        f"undecided: {_dominant(at[None], lin.state_names)} "
        f"{'counts' if change < 0 else 'does not count'} as {what}, by {ratio:.2g} times its "
        "rounding; on another machine it may be decided otherwise"
        for ratio, at, change in margin.doubts
    )


def hidden_modes(A: Array, B: Array, discrete: bool) -> tuple[list[Array], Margin]:
    """Return left eigenvectors (k, nx) that B misses, of eigenvalues that neither decay nor grow.

    Beside them the margin of these decisions.

    Parameters
    ----------
    A : ndarray (nx, nx)
    B : ndarray (nx, nu)
    discrete : bool
    """
    poles = np.linalg.eigvals(A)
    size = max(float(np.abs(poles - discrete).max()), 1e-300)
    beyond = np.abs(poles) - 1.0 if discrete else poles.real
    # A block of four moves by the fourth root of rounding.
    still, near = complex(discrete), np.abs(beyond) <= 1e-3 * size
    candidates = [still]
    for pole in poles[near & (poles.imag >= 0.0)]:
        if all(abs(pole - other) > 1e-3 * size for other in candidates):
            candidates.append(complex(pole))
    found, margin = [], Margin()
    for pole in candidates:
        shifted = A - (pole if pole.imag else pole.real) * np.eye(len(A))
        vectors, judged = _left_null(np.column_stack((shifted, B)))
        found.append(vectors)
        margin &= judged
    return [vectors for vectors in found if len(vectors)], margin


def _left_null(matrix: Array) -> tuple[Array, Margin]:
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
    vectors: Array = left.conj().T * rows
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    margin = Margin()
    for value, vector in zip(values[-2:] / (_RANK * values[0]), vectors[-2:], strict=True):
        margin &= decided(float(value), vector)
    return vectors[values <= _RANK * values[0]], margin


def _forces_missing(lin: LinearModel, weights: Array) -> str | None:
    """Say what the conserved momenta W M nu, W (k, nv), are those of; None of another model."""
    names = lin.state_names[len(lin.M) :]
    if names[:6] != _BASE_VELOCITIES:
        return None
    involved = np.abs(weights).max(axis=0) > 0.0
    base = [f"{word}{_axes(involved[rows])}" for word, rows in _BASE_WORDS if involved[rows].any()]
    joints = [name.partition(".")[2] for name, x in zip(names[6:], involved[6:], strict=True) if x]
    if joints:
        moved = f"joint{'s' * (len(joints) > 1)} {listed(joints)}, which no input moves"
        return " and ".join((*base, moved))
    kind = "" if len(base) == 2 else "angular " if involved[:3].any() else "linear "
    what = " and ".join(base).replace("and base", "and")
    return (
        f"{what} ({kind}momentum is conserved); add inputs on the base, or design on "
        "fflin.momentum_reduction(lin)"
    )


def _axes(involved: Array) -> str:
    return "" if involved.all() else " " + "/".join(np.array(list("xyz"))[involved])


_BASE_VELOCITIES = tuple(f"{group}.{axis}" for group in ("omega_b", "v_b") for axis in "xyz")
_BASE_WORDS = (("base attitude", slice(0, 3)), ("base position", slice(3, 6)))


def _dominant(vectors: Array, names: Sequence[str]) -> str:
    """Name the states that vectors (k, nx) stand on most, one each at least."""
    sizes = np.abs(vectors)
    large = (sizes >= 0.3 * sizes.max(axis=1, keepdims=True)).any(axis=0)
    words = listed(name for name, chosen in zip(names, large, strict=True) if chosen)
    count = len(vectors)
    if large.sum() <= count:
        return words
    return f"{'a combination' if count == 1 else f'{count} combinations'} of {words}"
