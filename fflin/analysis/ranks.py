"""Rank decisions with their margins, and echelon forms."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from fflin.base import html
from fflin.base.tables import folded
from fflin.base.validation import Array, FrozenArrays, Indices, Values

EPS = float(np.finfo(float).eps)

# Smallest decay rate that counts as nonzero, as a fraction of the largest modulus of a pole.
# Rounding moves a defective pair of zero poles by the square root of the rounding error, so a
# slower pole may belong to such a pair. For discrete-time poles z, this is the smallest 1 - |z|
# that counts as nonzero.
DECAY = 1e-7

# Values of `RankAnalysis.method` at a point that the robot leaves, and along a trajectory.
FROZEN, GRAMIAN = "frozen", "Gramian"

# Entries of an echelon form below this count as rounding errors. The pivots are 1, and the rows are
# weighted to be comparable.
_CLEAN = 1e-10

# A tolerance is SAFETY times the rounding error. A singular value between LOST and CLEAR times its
# tolerance is undecided.
SAFETY, CLEAR, LOST = 10.0, 30.0, 0.01

# A fixed pole counts as constant, for the naming of what does not decay, if its decay rate is below
# this fraction of the fastest rate. It exceeds the square root of the rounding error.
_LASTING = 1e-6

# Forces are entries of a matrix of springs, dampers or inputs, and are compared in units of energy.
# The threshold of a force is its rounding error, but at least _FLOOR times the largest force in the
# matrix. A force below the threshold may be a rounding error. A force below _ROUNDING times the
# threshold is set to zero.
_FLOOR = 1e3 * EPS
_ROUNDING = 0.3


class Decision(NamedTuple):
    """Singular value divided by its tolerance; a ratio above 1 counts as nonzero."""

    ratio: float
    at: Values  # singular vector
    # states affected: 2 for a pair of poles, or for a momentum and its coordinate
    states: int = 1


class Margin(NamedTuple):
    """Singular values closest to their tolerances, which show how certain rank decisions are."""

    decisions: tuple[Decision, ...] = ()

    @property
    def kept(self) -> float:
        """Smallest singular value counted as nonzero, relative to its tolerance."""
        return min(
            (one.ratio for one in self.decisions if one.ratio > 1.0), default=np.inf
        )

    @property
    def dropped(self) -> float:
        """Largest singular value counted as zero, relative to its tolerance."""
        return max(
            (one.ratio for one in self.decisions if one.ratio <= 1.0), default=0.0
        )

    def __and__(self, other: Margin) -> Margin:
        return Margin(self.decisions + other.decisions)

    def transformed(self, change: Array | float, *, halved: bool = False) -> Margin:
        """Return the margin in other coordinates, with transformed singular vectors.

        A singular vector v becomes ``change @ v`` if `change` is a matrix, and ``change * v`` if it
        is a vector or a number. If `halved`, v is first replaced by its positions or its rates,
        whichever have the larger norm.
        """
        moved = []
        for one in self.decisions:
            v = one.at
            if halved:
                v = max(np.split(one.at, 2), key=np.linalg.norm)
            at = change @ v if np.ndim(change) == 2 else change * v
            moved.append(one._replace(at=at))
        return Margin(tuple(moved))

    @property
    def doubts(self) -> tuple[tuple[float, Values, int], ...]:
        """Undecided ranks as tuples (ratio, singular vector, change).

        If the rank is decided the other way, the number of controllable or observable states
        changes by `change`.
        """
        counted = [
            decision
            for decision in self.decisions
            if decision.ratio == self.kept < CLEAR
        ][:1]
        left_out = [
            decision
            for decision in self.decisions
            if decision.ratio == self.dropped > LOST
        ][:1]
        return (*((ratio, at, -states) for ratio, at, states in counted), *left_out)


class FixedPoles(NamedTuple):
    """Poles of the uncontrollable or unobservable part."""

    poles: Values = np.zeros(0)  # (k,) [1/s], or discrete-time poles
    decays: bool = True  # True if all these poles decay by more than rounding error
    margin: Margin = Margin()  # margin of the rank decisions
    settling: Margin = Margin()  # certainty that the slowest pole decays


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class RankAnalysis(html.Reported, FrozenArrays):
    """Common fields of `Controllability` and `Observability`, described in their docstrings."""

    dimension: int
    bound: int
    duration: float
    rows: Array
    basis: Array
    fixed_poles: Values
    method: str
    margin: Margin
    notes: tuple[str, ...]
    robot: str

    def __str__(self) -> str:
        return folded([*self._lines(), *self._noted()])

    def _html_parts(self) -> list[str]:
        head, *lines = self._lines()
        is_good = None
        if self.dimension == len(self.basis):
            is_good = True
        parts = [html.verdict(head, is_good)]
        parts += [html.paragraph(line) for line in lines]
        return parts + [html.paragraph(note, "note") for note in self._noted()]

    def _noted(self) -> list[str]:
        return [f"note: {note}" for note in self.notes]

    def _lines(self) -> list[str]:
        """Return the lines of the report before the notes."""
        raise NotImplementedError

    def _head(self, what: str, limit: str, decays: str) -> str:
        """Return the first line of the report, which contains the dimension.

        `limit` is the reason why `bound` is less than the number of states.
        """
        nx = len(self.basis)
        head = (
            f"{self.robot}: {self.dimension} of {nx} states are {what} ({self.method})"
        )
        frozen = "the matrices frozen at this point, which the robot leaves"
        if self.method == GRAMIAN:
            head = (
                f"{self.robot}: {self.dimension} of {nx} states are {what} along the motion of "
                f"{self.duration:g} s ({self.method})"
            )
        elif self.method == FROZEN and self.bound < nx:
            head = (
                f"{self.robot}: at most {self.bound} of {nx} states are {what}, because {limit}; "
                f"{self.dimension} of these {self.bound} by {frozen}"
            )
        elif self.method == FROZEN:
            head = (
                f"{self.robot}: {self.dimension} of {nx} states are {what} by {frozen}"
            )
        return f"{head}; {decays}"


def verdict(decided: bool | None, adjective: str) -> str:
    """Return an adjective that ends in "-able", negated or undecided if `decided` says so."""
    if decided is None:
        return f"{adjective.removesuffix('able')}ability is undecided"
    if decided:
        return adjective
    return f"not {adjective}"


class Noisy(NamedTuple):
    """Matrix with a bound on the rounding error of each entry."""

    values: Array
    noise: Array

    @classmethod
    def exact(cls, values: Array) -> Noisy:
        """Wrap a matrix that has no rounding error."""
        return cls(values, np.zeros(values.shape))

    def columns(self, part: slice) -> Noisy:
        """Return a range of columns."""
        return Noisy(self.values[:, part], self.noise[:, part])

    def __matmul__(self, right: Array) -> Noisy:
        return Noisy(self.values @ right, self.noise @ np.abs(right))

    def after(self, left: Array) -> Noisy:
        """Return ``left @ self``."""
        return Noisy(left @ self.values, np.abs(left) @ self.noise)

    @property
    def T(self) -> Noisy:
        """The transpose."""
        return Noisy(self.values.T, self.noise.T)


def stacked(rows: list[list[Noisy]]) -> Noisy:
    """Join matrices as `numpy.block` does."""
    return Noisy(
        np.block([[m.values for m in row] for row in rows]),
        np.block([[m.noise for m in row] for row in rows]),
    )


def without_rounding(forces: Noisy, rows: Array, columns: Array) -> Noisy:
    """Set entries that are rounding errors to zero.

    Entries are compared in units of energy. The unit of entry (i, j) is ``rows[i] * columns[j]``.
    The noise of entries near the threshold is raised, so that a rank that depends on such an entry
    counts as undecided.
    """
    units = rows[:, None] * columns
    size = np.abs(forces.values)
    least = np.maximum(forces.noise, _FLOOR * (size / units).max(initial=0.0) * units)
    real = size > _ROUNDING * least
    noise = np.where(
        size < CLEAR * least, np.maximum(forces.noise, least / SAFETY), forces.noise
    )
    return Noisy(np.where(real, forces.values, 0.0), np.where(real, noise, 0.0))


def right_vectors(
    values: Values, noise: Array, states: int = 1
) -> tuple[Array, Values, int, Margin]:
    """Return singular values (n,), right singular vectors (n, n), the rank, and its margin.

    They refer to the matrix `values` (m, n) with scaled rows. `noise` (m, n) bounds the rounding
    errors of its entries.
    """
    # Rows are scaled to unit length, so that a large row does not hide a small one. A row with a
    # large rounding error is scaled to a smaller length, so that it does not hide other rows.
    n = values.shape[1]
    sizes, spread = np.linalg.norm(values, axis=1), np.linalg.norm(noise, axis=1)
    real = sizes > 0.0
    if not n or not real.any():
        return np.zeros(n), np.eye(n), 0, Margin()
    least = n * EPS
    weights = 1.0 / np.maximum(sizes[real], spread[real] / least)
    tolerance = SAFETY * max(least, float(np.linalg.norm(spread[real] * weights)))
    rows = values[real] * weights[:, None]
    if not np.imag(rows).any():
        rows = np.real(rows)
    _, singular, right = np.linalg.svd(rows, full_matrices=len(rows) < n)
    singular = np.pad(singular, (0, n - len(singular)))
    rank = int((singular > tolerance).sum())
    vectors = right.conj().T
    return singular, vectors, rank, judged(singular / tolerance, vectors, rank, states)


def divisors(sizes: Array) -> Array:
    """Replace sizes of 0 by 1, so that division by the result leaves a zero vector unchanged."""
    return np.where(sizes > 0.0, sizes, 1.0)


def judged(ratios: Array, vectors: Values, rank: int, states: int = 1) -> Margin:
    """Return the margin of a rank; `ratios` are singular values divided by their tolerance."""
    near = range(max(rank - 1, 0), min(rank + 1, len(ratios)))
    return Margin(
        tuple(Decision(float(ratios[i]), vectors[:, i], states) for i in near)
    )


def null_space(
    matrix: Noisy, scale: Array | float = 1.0, states: int = 1
) -> tuple[Array, Margin]:
    """Return a basis (n, k) of the null space, and the margin of its dimension.

    The basis vectors are ``scale * y`` with orthonormal vectors y (n,).
    """
    scales = np.broadcast_to(scale, matrix.values.shape[1])
    values, noise = matrix.values * scales, matrix.noise * scales
    _, vectors, rank, margin = right_vectors(values, noise, states)
    return scales[:, None] * np.real(vectors[:, rank:]), margin.transformed(scales)


def image(matrix: Array, tolerance: float) -> tuple[Array, Array]:
    """Return orthonormal bases of the column space (m, r) and of its orthogonal complement."""
    if not matrix.size:
        return np.zeros((len(matrix), 0)), np.eye(len(matrix))
    U, values, _ = np.linalg.svd(matrix)
    rank = int((values > tolerance).sum())
    return U[:, :rank], U[:, rank:]


def lasting(F: Array, dt: float) -> Array:
    """Return an orthonormal basis (k, m) of the motions of ``dz/dt = F z`` that do not decay.

    For a sampled model, F is (A - I)/dt. A decay rate below _LASTING times the fastest rate counts
    as zero, because rounding moves a double pole at zero by the square root of the rounding error.
    """
    from scipy.linalg import schur

    if not F.size:
        return np.zeros((len(F), 0))
    least = _LASTING * float(np.abs(np.linalg.eigvals(F)).max())

    def lasts(real: float, imaginary: float) -> bool:
        rate = complex(real, imaginary)
        decay = -real
        if dt:
            decay = (1.0 - abs(1.0 + dt * rate)) / dt
        return decay <= least

    _, vectors, count = schur(F, sort=lasts)
    basis: Array = vectors[:, :count]
    return basis


def unit_columns(matrix: Array) -> Array:
    """Scale columns to unit length; omit columns that are rounding errors of the largest column."""
    sizes = np.linalg.norm(matrix, axis=0)
    real = sizes > 1e2 * EPS * sizes.max(initial=0.0)
    scaled: Array = matrix[:, real] / sizes[real]
    return scaled


def echelon(
    columns: Array, weights: Array, preferred: Array | None = None
) -> tuple[Array, Indices]:
    """Return a basis (m, r) of the column space with I in its pivot rows, and the pivots (r,).

    `columns` (m, r) must be linearly independent. `weights` (m,) make the rows comparable. Rows for
    which `preferred` is true become pivots if possible.
    """
    from scipy.linalg import qr

    size = columns.shape[1]
    if not size:
        return columns.copy(), np.zeros(0, dtype=np.intp)
    weighted = np.linalg.qr(columns * weights[:, None])[0]
    # Preferred rows are weighted by 1,000. A larger weight could select pivots so small that the
    # basis loses accuracy.
    graded = weighted
    if preferred is not None:
        graded = weighted * np.where(preferred, 1e3, 1.0)[:, None]
    pivots = np.sort(qr(graded.T, mode="r", pivoting=True)[1][:size])
    basis = np.linalg.solve(columns[pivots].T, columns.T).T
    relative = np.abs(basis) * weights[:, None] / weights[pivots]
    basis[relative < _CLEAN] = 0.0
    basis[pivots] = np.eye(size)
    return basis, pivots
