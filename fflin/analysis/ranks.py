"""Rank decisions, echelon forms and controllable subspaces, each with its distance from doubt."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from fflin.base.validation import Array

EPS = float(np.finfo(float).eps)

# What an echelon form leaves of a coefficient that is zero, relative to a pivot of 1.
_CLEAN = 1e-10

# An eigenvector that inputs of unit length see by less than this, or that has a neighbour this
# near, is decided by singular values; the others are seen without doubt.
_SUSPICIOUS = 1e-3

# A tolerance is this many times the rounding, and singular values between these parts of it are
# within doubt.
SAFETY, CLEAR, LOST = 10.0, 30.0, 0.01

# Eigenvalues nearer than this are one: a defective one moves by the root of round-off. The
# Rayleigh quotient of the singular vector converges quadratically to it.
_SAME_POLE, _REFINEMENTS = 1e-9, 4


class Margin(NamedTuple):
    """How far rank decisions are from doubt, as ratios to their tolerances.

    Attributes
    ----------
    kept : float
        The smallest singular value that counted; infinite where there was none to decide.
    dropped : float
        The largest that did not; zero where there was none.
    kept_at, dropped_at : ndarray or None
        The directions of these.
    kept_count, dropped_count : int
        How many states hang on each: two on a pair of poles, or a momentum and what it drives.
    """

    kept: float = np.inf
    dropped: float = 0.0
    kept_at: Any = None
    dropped_at: Any = None
    kept_count: int = 1
    dropped_count: int = 1

    def __and__(self, other: Margin) -> Margin:
        """Return the nearer to doubt of two."""
        kept = self if self.kept <= other.kept else other
        dropped = self if self.dropped >= other.dropped else other
        return Margin(
            *(kept.kept, dropped.dropped, kept.kept_at, dropped.dropped_at),
            *(kept.kept_count, dropped.dropped_count),
        )

    def seen(self, change: Array, count: int | None = None) -> Margin:
        """Return it with the directions in other coordinates, ``change * v`` or ``change @ v``."""
        kept, dropped = (
            v if v is None else change * v if change.ndim == 1 else change @ v
            for v in (self.kept_at, self.dropped_at)
        )
        changed = self._replace(kept_at=kept, dropped_at=dropped)
        return changed._replace(kept_count=count, dropped_count=count) if count else changed

    def halved(self) -> Margin:
        """Return it with the positions or the rates of the directions, whichever are larger."""
        kept, dropped = (
            v if v is None else max(np.split(v, 2), key=np.linalg.norm)
            for v in (self.kept_at, self.dropped_at)
        )
        return self._replace(kept_at=kept, dropped_at=dropped)

    @property
    def doubts(self) -> tuple[tuple[float, Any, int], ...]:
        """The decisions within rounding: their ratios, directions, and by how much they differ.

        The last is negative where less would count.
        """
        kept = (self.kept, self.kept_at, -self.kept_count)
        dropped = (self.dropped, self.dropped_at, self.dropped_count)
        return (kept,) * int(self.kept < CLEAR) + (dropped,) * int(self.dropped > LOST)


def decided(ratio: float, direction: Any, count: int = 1) -> Margin:
    """Return the margin of one decision: of what counts where the ratio is above 1."""
    if ratio > 1.0:
        return Margin(kept=ratio, kept_at=direction, kept_count=count)
    return Margin(dropped=ratio, dropped_at=direction, dropped_count=count)


def even_rows(values: Any, noise: Array) -> tuple[Any, float]:
    """Return rows of unit length, or shorter so that none has more rounding, and a tolerance.

    None hides behind another, and none that is rounding itself hides the others.
    """
    least = values.shape[1] * EPS
    sizes, spread = np.linalg.norm(values, axis=1), np.linalg.norm(noise, axis=1)
    real = sizes > 0.0
    sizes, spread = sizes[real], spread[real]
    weights = 1.0 / np.maximum(sizes, spread / least)
    tolerance = SAFETY * max(least, float(np.linalg.norm(spread * weights)))
    return values[real] * weights[:, None], tolerance


def right_vectors(values: Any, noise: Array, count: int = 1) -> tuple[Array, Any, int, Margin]:
    """Return n singular values of `even_rows`, right vectors (n, n), the rank, and its margin."""
    n = values.shape[1]
    rows, tolerance = even_rows(values, noise)
    if not n or not len(rows):
        return np.zeros(n), np.eye(n), 0, Margin()
    rows = rows if np.imag(rows).any() else np.real(rows)
    _, singular, right = np.linalg.svd(rows, full_matrices=len(rows) < n)
    singular = np.pad(singular, (0, n - len(singular)))
    rank, vectors = int((singular > tolerance).sum()), right.conj().T
    return singular, vectors, rank, judged(singular / tolerance, vectors, rank, count)


def judged(ratios: Array, vectors: Any, rank: int, count: int = 1) -> Margin:
    """Return the margin of a rank, of singular values as ratios to the tolerance."""
    margin = Margin()
    for index in range(max(rank - 1, 0), min(rank + 1, len(ratios))):
        margin &= decided(float(ratios[index]), vectors[:, index], count)
    return margin


def null_space(matrix: tuple[Array, Array]) -> tuple[Array, Margin]:
    """Return the null space (n, k) of a matrix, orthonormal, with bounds of its entries' rounding.

    Rows are scaled by `even_rows`.
    """
    _, vectors, rank, margin = right_vectors(*matrix)
    return vectors[:, rank:], margin


def split(matrix: Array, tolerance: float) -> tuple[Array, Array, Margin]:
    """Split the space of a matrix's columns by singular values.

    Returns
    -------
    image, rest : ndarray (m, r), (m, m - r)
        Orthonormal: what the columns span, and what is orthogonal to it.
    margin : Margin
    """
    rows = len(matrix)
    if not matrix.size:
        return np.zeros((rows, 0)), np.eye(rows), Margin()
    U, values, _ = np.linalg.svd(matrix)
    rank = int((values > tolerance).sum())
    kept = float(values[rank - 1]) if rank else np.inf
    dropped = float(values[rank]) if rank < len(values) else 0.0
    return U[:, :rank], U[:, rank:], Margin(kept / float(tolerance), dropped / float(tolerance))


def unit_columns(matrix: Array) -> Array:
    """Scale columns to unit length; those that are rounding of the others are left out."""
    sizes = np.linalg.norm(matrix, axis=0)
    real = sizes > 1e2 * EPS * sizes.max(initial=0.0)
    return matrix[:, real] / sizes[real]


def echelon(columns: Array, weights: Array, preferred: Array | None = None) -> tuple[Array, Array]:
    """Return a basis (m, r) of the same columns whose rows at r pivots are the identity.

    Parameters
    ----------
    columns : ndarray (m, r)
        Of full column rank.
    weights : ndarray (m,)
        Makes rows of different units comparable.
    preferred : ndarray (m,) of bool, optional
        Rows to look for pivots in first.

    Returns
    -------
    basis : ndarray (m, r)
    pivots : ndarray (r,) of int
        Ascending.
    """
    from scipy.linalg import qr

    size = columns.shape[1]
    if not size:
        return columns.copy(), np.zeros(0, dtype=np.intp)
    weighted = np.linalg.qr(columns * weights[:, None])[0]
    # A preferred row is a thousand times as good as another: less than what a bad pivot costs.
    graded = weighted if preferred is None else weighted * np.where(preferred, 1e3, 1.0)[:, None]
    pivots = np.sort(qr(graded.T, mode="r", pivoting=True)[1][:size])
    basis = np.linalg.solve(columns[pivots].T, columns.T).T
    relative = np.abs(basis) * weights[:, None] / weights[pivots]
    basis[relative < _CLEAN] = 0.0
    basis[pivots] = np.eye(size)
    return basis, pivots


def reached_by(A: Array, B: Array, tolerance: float) -> tuple[Array, Array, Array, Margin]:
    """Split the state space of (A, B), eigenvalue by eigenvalue (Popov, Belevitch, Hautus).

    The left vectors with ``w [A - s E, B] = 0`` are found at every eigenvalue s as singular
    vectors, and split off by an orthogonal transformation, until there are none: so that the
    whole of a defective eigenvalue goes. A staircase would carry the rounding of a weak step into
    the next.

    Parameters
    ----------
    A : ndarray (m, m)
        Of size about 1.
    B : ndarray (m, k)
        With columns of unit length.
    tolerance : float
        Size of a perturbation of (A, B) that is taken for rounding.

    Returns
    -------
    reached : ndarray (m, d)
        Orthonormal basis of the controllable subspace.
    rest : ndarray (m, m - d)
        Orthonormal; ``rest.T @ x`` is what no input acts on.
    F : ndarray (m - d, m - d)
        Its dynamics.
    margin : Margin
    """
    inside, margin = np.eye(len(A)), Margin()
    split_off: Array = np.zeros((len(A), 0))
    while inside.shape[1]:
        lost, found = _left_vectors(inside.T @ A @ inside, inside.T @ B, tolerance)
        margin &= found.seen(inside)
        if not lost.shape[1]:
            break
        split_off = np.hstack((split_off, inside @ lost))
        inside = inside @ split(lost, 0.5)[1]
    return inside, split_off, split_off.T @ A @ split_off, margin


def _left_vectors(A: Array, B: Array, tolerance: float) -> tuple[Array, Margin]:
    """Return an orthonormal real basis (m, k) of the left eigenvectors that B does not see."""
    from scipy.linalg import eig

    poles, left = eig(A, left=True, right=False)
    unseen = np.linalg.norm(left.conj().T @ B, axis=1) < _SUSPICIOUS
    distances = np.abs(poles[:, None] - poles) + np.eye(len(A))
    near = unseen | (distances.min(axis=1) < _SUSPICIOUS)
    # A defective zero splits into poles of the root of rounding: it is tested itself, and first.
    candidates = [0j, *poles[(poles.imag >= 0.0) & near]]
    found: Array = np.zeros((len(A), 0))
    margin, known = Margin(), np.zeros(0, dtype=complex)
    for pole in candidates:
        vectors, at, decision = _at_pole(A, B, complex(pole), tolerance)
        if (np.abs(known - at) < _SAME_POLE).any():
            continue
        margin &= decision
        if not vectors.shape[1]:
            continue
        known = np.append(known, at)
        parts = np.hstack((vectors.real, vectors.imag)) if abs(at.imag) > _SAME_POLE else vectors
        parts = np.real(parts)
        # Of poles that were told apart only by rounding the vectors are the same.
        new = parts - found @ (found.T @ parts)
        found = np.hstack((found, split(new, _SUSPICIOUS)[0]))
    return found, margin


def _at_pole(A: Array, B: Array, pole: complex, tolerance: float) -> tuple[Array, complex, Margin]:
    """Return the left vectors (m, k) at a pole, the pole itself, and the margin."""
    size = len(A)
    for _ in range(_REFINEMENTS):
        shift = pole.real if abs(pole.imag) < _SAME_POLE else pole
        U, values, _ = np.linalg.svd(np.hstack((A - shift * np.eye(size), B)))
        last = U[:, -1]
        refined = complex(last.conj() @ A @ last)
        if not pole or abs(refined - pole) < EPS or values[-1] > _SUSPICIOUS:
            break
        pole = refined
    rank = int((values > tolerance).sum())
    count = 2 if abs(shift.imag) > _SAME_POLE else 1
    return U[:, rank:], complex(shift), judged(values / tolerance, U, rank, count)
