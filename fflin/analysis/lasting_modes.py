"""Tests whether inputs, outputs or noise reach the modes that do not decay by themselves."""

import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np

from fflin.analysis import ranks
from fflin.base.errors import DetectabilityError, FflinError, FflinWarning, listed
from fflin.base.validation import Array, Values

# A singular value of the scaled Popov-Belevitch-Hautus matrix [A - p I, B] counts as zero if it is
# below this fraction of the largest singular value. The fraction is this large because a repeated
# eigenvalue p has a relative rounding error of about this size.
_RANK = 1e-7


def conclude(
    kind: type[FflinError], words: str, notes: Sequence[str], margin: ranks.Margin
) -> None:
    """Raise an error with the message `words` and the undecided ranks in `notes`.

    If `words` is empty, warn about each undecided rank instead.
    """
    doubts = [note for note in notes if note.startswith("undecided")]
    if words:
        error: Any = kind("; ".join((words, *doubts)))
        error.margin = margin
        raise error
    for note in doubts:
        warnings.warn(note, FflinWarning, stacklevel=4)


def root_of(W: Array) -> Array:
    """Return L with W = L L^T, for a positive semidefinite W (m, m) with entries of any units."""
    # The condition number of L is the square root of the condition number of W, so the rank of L is
    # easier to decide than the rank of W.
    size = ranks.divisors(np.sqrt(W.diagonal()))
    values, vectors = np.linalg.eigh(W / np.outer(size, size))
    rounding = len(W) * np.finfo(float).eps * values[-1:].max(initial=0.0)
    root: Array = (
        size[:, None] * vectors * np.sqrt(np.where(values > rounding, values, 0.0))
    )
    return root


def reached(
    names: Sequence[str],
    dt: float,
    A: Array,
    B: Array,
    what: str,
    complaint: str,
    *,
    unstable: bool = False,
    spans: bool = False,
) -> tuple[str, list[str], ranks.Margin]:
    """Test whether the columns of B excite every mode of A on the stability boundary.

    If `unstable`, test the unstable modes as well. If `spans`, the message names one state for each
    mode, and not the largest states of all modes. Return three results: an error message, or "" if
    B excites all tested modes; notes on undecided ranks; and the margin of the rank decisions.
    """
    discrete = bool(dt)
    poles = np.linalg.eigvals(A)
    size = max(float(np.abs(poles - discrete).max()), 1e-300)
    beyond = np.abs(poles) - 1.0 if discrete else poles.real
    # Rounding moves the eigenvalues of a Jordan block of size four by the fourth root of the
    # rounding error. Poles closer than 1e-3 `size` therefore count as equal, and poles closer than
    # this to the stability boundary count as marginally stable. `size` is the largest modulus of a
    # pole, or of z - 1 for discrete-time poles z.
    candidates = [complex(discrete)]
    growing = (beyond > 0.0) & unstable
    for pole in poles[
        ((np.abs(beyond) <= 1e-3 * size) | growing) & (poles.imag >= 0.0)
    ]:
        if all(abs(pole - other) > 1e-3 * size for other in candidates):
            candidates.append(complex(pole))
    missed, margin = list[Values](), ranks.Margin()
    for pole in candidates:
        vectors, of_pole = _left_vectors(A, B, pole)
        missed += list(vectors)
        margin &= of_pole
    words = ""
    if missed:
        name = _spanning if spans and len(missed) > 1 else _dominant
        words = complaint.format(name(np.array(missed), names))
    return words, _doubts(margin, names, what), margin


def require_distinguished(
    names: Sequence[str], A: Array, C: Array, added: int, poles: Sequence[complex]
) -> None:
    """Raise `DetectabilityError` if the outputs cannot distinguish an added state from others.

    The last `added` states are disturbances and biases, and `poles` are their poles. The message
    names each added state that belongs to an eigenvector of A in the kernel of C, together with the
    states that it cannot be distinguished from.
    """
    is_added = np.array([i >= len(names) - added for i in range(len(names))])
    pairs, hidden = list[str](), list[str]()
    margin, notes = ranks.Margin(), list[str]()
    for pole in poles:
        vectors, of_pole = _left_vectors(A.T, C.T, pole)
        margin &= of_pole
        notes += _doubts(of_pole, names, "distinguished by the outputs")
        parts = np.vstack((vectors.real, vectors.imag)).T
        space, _ = ranks.image(parts, 1e-6)
        basis, pivots = ranks.echelon(space, np.ones(len(names)), is_added)
        for column, pivot in zip(basis.T, pivots, strict=True):
            sizes = np.round(np.abs(column), 6)
            others = [names[i] for i in np.argsort(-sizes, kind="stable") if column[i]]
            others.remove(names[pivot])
            if others:
                pairs.append(f"{names[pivot]} from {' and '.join(others[:3])}")
            else:
                hidden.append(names[pivot])
    words = list[str]()
    if pairs:
        words.append(f"the outputs cannot distinguish {', '.join(pairs)}")
    if hidden:
        words.append(f"the outputs do not show {listed(hidden)}")
    if words:
        words.append("omit these disturbances or biases, or add outputs")
    conclude(DetectabilityError, "; ".join(words), notes, margin)


def _left_vectors(A: Array, B: Array, pole: complex) -> tuple[Values, ranks.Margin]:
    """Return the left null vectors (k, n) of [A - p I, B] at a pole p, and the rank margin."""
    shift = pole if pole.imag else pole.real
    shifted = A - shift * np.eye(len(A))
    matrix = np.column_stack((shifted, B))
    # Rows and columns have different units, so they are scaled to comparable sizes.
    rows = np.ones(len(matrix))
    columns = np.ones(matrix.shape[1])
    scaled = matrix
    for _ in range(4):
        rows /= ranks.divisors(np.sqrt(np.abs(scaled).max(axis=1)))
        columns /= ranks.divisors(np.sqrt(np.abs(scaled).max(axis=0)))
        scaled = rows[:, None] * matrix * columns
    left, values, _ = np.linalg.svd(scaled)
    vectors: Values = left.conj().T * rows
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    ratios = values / (_RANK * values[0])
    rank = int((ratios > 1.0).sum())
    return vectors[rank:], ranks.judged(ratios, vectors.T, rank)


def _doubts(margin: ranks.Margin, names: Sequence[str], what: str) -> list[str]:
    """Return notes on undecided ranks."""
    doubts = list[str]()
    for ratio, at, change in margin.doubts:
        decision = what if change < 0 else f"not {what}"
        doubts.append(
            f"undecided: {_dominant(at[None], names)} counts as {decision}, but the test "
            f"value is only {ratio:.2g} times its rounding error, so another machine may decide "
            "otherwise"
        )
    return doubts


def _dominant(vectors: Values, names: Sequence[str]) -> str:
    """Name the states with the largest entries in vectors (k, nx), for a message."""
    # The vectors may be any basis of their space. The lengths of the projections of the coordinate
    # axes onto this space do not depend on the basis.
    basis, _ = np.linalg.qr(vectors.T)
    sizes = np.linalg.norm(basis, axis=1)
    large = sizes >= 0.3 * sizes.max()
    words = listed(name for name, chosen in zip(names, large, strict=True) if chosen)
    count = len(vectors)
    if large.sum() <= count:
        return words
    if count == 1:
        return f"a combination of {words}"
    return f"{count} combinations of {words}"


def _spanning(vectors: Values, names: Sequence[str]) -> str:
    """Name states that determine a vector of the space of vectors (k, nx), for a message.

    They are states of the base if possible, as for the momenta of the robot.
    """
    space, _ = ranks.image(np.vstack((vectors.real, vectors.imag)).T, 1e-6)
    of_base = [not name.partition(".")[0].endswith("_m") for name in names]
    _, pivots = ranks.echelon(space, np.ones(len(names)), np.array(of_base))
    return listed(names[i] for i in pivots)
