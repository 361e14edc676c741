"""Differential Riccati equation, solved backwards in time with P positive semidefinite."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from typing import NamedTuple

import numpy as np
from scipy.linalg import expm

from fflin.base.errors import InputError
from fflin.base.validation import Array
from fflin.dynamics.integrators import GAUSS, HEAVY, LIGHT

# Between two knots P is a cubic; knots are added until it is this accurate, relative to P.
_ACCURACY = 1e-7
_KNOTS_LIMIT = 100_000

# Batches of intervals: one call of NumPy for many small matrices costs little more than for one.
_BATCH = 64


class Coefficients(NamedTuple):
    """A, S = B R^-1 B' and Q (.., nx, nx) of -dP/dt = A' P + P A - P S P + Q."""

    A: Array
    S: Array
    Q: Array

    def rate(self, P: Array) -> Array:
        """Return dP/dt."""
        drift = P @ self.A
        return P @ self.S @ P - drift - drift.T - self.Q


class Passage(NamedTuple):
    r"""Intervals (..): x1 = T x0 - G l1 and l0 = W x0 + T' l1, with G and W positive semidefinite.

    x is the state and l the costate at the start (0) and at the end (1) of the interval.
    """

    T: Array
    G: Array
    W: Array

    def then(self, late: Passage) -> Passage:
        """Return the passage through these intervals, and after them through `late` ones."""
        T, G, W = self
        n = T.shape[-1]
        right = np.concatenate((T, G @ late.T.mT), axis=-1)
        inner = np.linalg.solve(np.eye(n) + G @ late.W, right)
        forward, back = inner[..., :n], inner[..., n:]
        return Passage(
            late.T @ forward,
            _symmetric(late.G + late.T @ back),
            _symmetric(W + T.mT @ late.W @ forward),
        )

    def back(self, P: Array) -> Array:
        """Return P at the start, W + T' P (I + G P)^-1 T, from P at the end."""
        forward = np.linalg.solve(np.eye(len(P)) + self.G @ P, self.T)
        costate = P @ forward
        # A sum of squares, which stays positive.
        return _symmetric(self.W + forward.T @ costate + costate.T @ self.G @ costate)


def passage(early: Coefficients, late: Coefficients, h: Array) -> Passage:
    """Return passages (k,) through intervals, of order four, from coefficients at Gauss nodes."""
    pairs = zip(early, late, strict=True)
    mixed = [np.concatenate((HEAVY * a + LIGHT * b, LIGHT * a + HEAVY * b)) for a, b in pairs]
    both = _constant(Coefficients(*mixed), 0.5 * np.concatenate((h, h)))
    first, second = (Passage(*each) for each in zip(*(np.split(x, 2) for x in both), strict=True))
    return first.then(second)


def _constant(coefficients: Coefficients, h: Array) -> Passage:
    """Return passages of constant coefficients: a short exponential, doubled."""
    A, S, Q = coefficients
    n, unit = A.shape[-1], _units(*(np.abs(x).max(axis=0) for x in coefficients))
    A, S, Q = A * unit / unit[:, None], S / np.outer(unit, unit), Q * np.outer(unit, unit)
    lower = np.concatenate((-Q, -A.mT), axis=-1)
    H = np.concatenate((np.concatenate((A, -S), axis=-1), lower), axis=-2) * h[:, None, None]
    size = float(np.abs(H).sum(axis=-2).max())
    if not size < 1e300:
        raise np.linalg.LinAlgError("the coefficients are too large")
    doublings = max(0, math.ceil(math.log2(max(size, 1.0))))
    theta = expm(H / 2**doublings)
    inverse = np.linalg.inv(theta[:, n:, n:])
    found = Passage(
        inverse.mT,
        _symmetric(-theta[:, :n, n:] @ inverse),
        _symmetric(-inverse @ theta[:, n:, :n]),
    )
    for _ in range(doublings):
        found = found.then(found)
    T, G, W = found
    scale = np.outer(unit, unit)
    return Passage(T * unit[:, None] / unit, G * scale, W / scale)


def _units(A: Array, S: Array, Q: Array) -> Array:
    """Return units (nx,) of the states in which rows and columns are of similar size."""
    # Osborne's balancing; the units of the costates are the inverse ones.
    np.fill_diagonal(A, 0.0)
    unit = np.ones(len(A))
    for _ in range(12):
        drift = A * unit / unit[:, None]
        outer = np.outer(unit, unit)
        row, column = drift.sum(axis=1) + (S / outer).sum(1), drift.sum(0) + (Q * outer).sum(0)
        known = (row > 0.0) & (column > 0.0)
        unit[known] *= (row[known] / column[known]) ** 0.25
    return unit


# Part i of 2^level equal parts of the interval after knot k: (k, level, i).
_Part = tuple[int, int, int]


class _Mesh:
    """Passages and coefficients of parts of the intervals between knots, from last to first."""

    def __init__(self, at: Callable[[Array], Coefficients], knots: Array) -> None:
        self._at, self._knots = at, knots.tolist()
        self._passages = dict[_Part, Passage]()
        self._coefficients = dict[float, Coefficients]()

    def time(self, k: int, level: int, i: int) -> float:
        """Return the start of a part."""
        a, b = self._knots[k : k + 2]
        return b if i == 2**level else a + (b - a) * (i / 2**level)

    def passage(self, k: int, level: int, i: int) -> Passage:
        """Return the passage of a part; those of the parts before it are computed as well."""
        part = k, level, i
        if part not in self._passages:
            parts = [(k, level, j) for j in range(i, max(i - _BATCH, -1), -1)]
            while k and len(parts) < _BATCH:
                k -= 1
                parts += [(k, level, j) for j in range(2**level - 1, -1, -1)]
            self._compute(parts[:_BATCH])
        return self._passages[part]

    def coefficients(self, t: float) -> Coefficients:
        """Return the coefficients at a time."""
        if t not in self._coefficients:
            self._coefficients[t] = Coefficients(*(x[0] for x in self._at(np.array([t]))))
        return self._coefficients[t]

    def _compute(self, parts: list[_Part]) -> None:
        for known in (self._passages, self._coefficients):
            if len(known) > 16 * _BATCH:
                known.clear()
        start = np.array([self.time(*part) for part in parts])
        h = np.array([self.time(k, level, i + 1) for k, level, i in parts]) - start
        new = [t for t in start.tolist() if t not in self._coefficients]
        nodes = [start + c * h for c in GAUSS]
        found = self._at(np.concatenate((*nodes, new)))
        count = len(parts)
        early, late = (
            Coefficients(*(x[s] for x in found)) for s in (slice(count), slice(count, 2 * count))
        )
        rows = zip(*(x[2 * count :] for x in found), strict=True)
        self._coefficients |= {t: Coefficients(*row) for t, row in zip(new, rows, strict=True)}
        rows = zip(*passage(early, late, h), strict=True)
        self._passages |= {part: Passage(*row) for part, row in zip(parts, rows, strict=True)}


def solve_back(at: Callable[[Array], Coefficients], knots: Array, P: Array) -> tuple[Array, Array]:
    """Return times and P there, back from the last knot; `LinAlgError` where P changes too fast.

    `at` returns the coefficients (k, nx, nx) at times (k,).
    """
    mesh, level = _Mesh(at, knots), 0
    times, values = [float(knots[-1])], [P]
    for k in range(len(knots) - 2, -1, -1):
        # The parts left to do, the latest last.
        pending = [(level, i) for i in range(2**level)]
        errors = dict[int, float]()
        while pending:
            level, i = pending.pop()
            start, end, P = mesh.time(k, level, i), times[-1], values[-1]
            error = math.inf
            # Over a long step, the mixed coefficients can be indefinite; shorter steps follow.
            with suppress(np.linalg.LinAlgError):
                single = mesh.passage(k, level, i).back(P)
                half = mesh.passage(k, level + 1, 2 * i + 1).back(P)
                double = mesh.passage(k, level + 1, 2 * i).back(half)
                # The cubic with these values and derivatives, midway.
                bend = mesh.coefficients(start).rate(double) - mesh.coefficients(end).rate(P)
                between = 0.5 * (double + P) + 0.125 * (end - start) * bend
                # Halves are more accurate by sixteen times, of which four are kept in reserve.
                error = 0.25 * max(_apart(double, single), _apart(half, between))
            if error <= _ACCURACY:
                times += [mesh.time(k, level + 1, 2 * i + 1), start]
                values += [half, double]
                errors[level] = max(error, errors.get(level, 0.0))
            elif len(times) > _KNOTS_LIMIT or level > 40:
                raise np.linalg.LinAlgError("P changes too fast")
            else:
                pending += [(level + 1, 2 * i), (level + 1, 2 * i + 1)]
        # The interval before it begins with parts as long as the longest of this one.
        level = min(errors)
        if level and errors[level] < _ACCURACY / 64.0:
            level -= 1
    return np.array(times[::-1]), np.array(values[::-1])


def samples_back(stages: Iterable[tuple[Array, Array]], P: Array) -> tuple[Array, Array, float]:
    """Return K and P of samples, from the last on, and the worst residual."""
    # A stage is what a sample costs, of the error and the input at its start, (nx + nu, nx + nu),
    # and what takes these two to the next sample (nx, nx + nu).
    nx, gains, costs, worst = len(P), list[Array](), [P], 0.0
    for weights, whole in stages:
        total = weights + whole.T @ P @ whole
        K = np.linalg.solve(total[nx:, nx:], total[nx:, :nx])
        # A sum of squares, which stays positive.
        law = np.vstack((np.eye(nx), -K))
        P = _symmetric(law.T @ total @ law)
        if not np.isfinite(P).all():
            raise np.linalg.LinAlgError("P changes too fast")
        worst = max(worst, imbalance(np.array((P, -total[:nx, :nx], total[:nx, nx:] @ K))))
        gains.append(K)
        costs.append(P)
    return np.array(gains), np.array(costs), worst


@contextmanager
def bounded_by(remedy: str) -> Iterator[None]:
    """Raise `InputError` if P changes too fast."""
    try:
        # A P that overflows is refused, so that NumPy need not warn of it.
        with np.errstate(over="ignore", invalid="ignore"):
            yield
    except np.linalg.LinAlgError:
        raise InputError(
            f"P of the Riccati equation changes too fast to be integrated; give {remedy}"
        ) from None


def spread(B: Array, R: Array) -> Array:
    """Return B R^-1 B'."""
    return _symmetric(B @ np.linalg.solve(R, B.mT))


def imbalance(terms: Array) -> float:
    """Return the largest norm of sums (.., n, n) relative to the sum of the norms of the terms."""
    size = np.linalg.norm(terms, axis=(-2, -1)).sum(axis=0)
    sums = np.linalg.norm(terms.sum(axis=0), axis=(-2, -1))
    return float((sums / np.maximum(size, 1e-300)).max())


def _apart(first: Array, second: Array) -> float:
    return float(np.linalg.norm(first - second)) / max(float(np.linalg.norm(second)), 1e-300)


def _symmetric(matrix: Array) -> Array:
    return 0.5 * (matrix + matrix.mT)
