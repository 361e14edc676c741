"""Differential Riccati equation, solved backwards in time with P positive semidefinite."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve, expm

from fflin.base.errors import InputError
from fflin.base.validation import Array
from fflin.linear.sampling import GAUSS, HEAVY, LIGHT

# Between two knots P is a cubic; knots are added until it is this accurate, relative to P.
_ACCURACY = 1e-7
_KNOTS_LIMIT = 100_000


class Coefficients(NamedTuple):
    """A, S = B R^-1 B' and Q of -dP/dt = A' P + P A - P S P + Q."""

    A: Array
    S: Array
    Q: Array

    def rate(self, P: Array) -> Array:
        """Return dP/dt."""
        drift = P @ self.A
        return P @ self.S @ P - drift - drift.T - self.Q


class _Passage(NamedTuple):
    r"""An interval: x1 = T x0 - G l1 and l0 = W x0 + T' l1, with G and W positive semidefinite."""

    T: Array
    G: Array
    W: Array

    def doubled(self) -> _Passage:
        """Return the passage through two such intervals."""
        T, G, W = self
        inner = np.linalg.solve(np.eye(len(T)) + G @ W, np.hstack((T, G @ T.T)))
        forward, back = inner[:, : len(T)], inner[:, len(T) :]
        return _Passage(T @ forward, _symmetric(G + T @ back), _symmetric(W + T.T @ W @ forward))

    def back(self, P: Array) -> Array:
        """Return W + T' P (E + G P)^-1 T, a sum of squares, for a P that is positive."""
        values, directions = np.linalg.eigh(P)
        root = directions * np.sqrt(values.clip(min=0.0))
        middle = np.eye(len(P)) + root.T @ self.G @ root
        seen = root.T @ self.T
        return _symmetric(self.W + seen.T @ cho_solve(cho_factor(_symmetric(middle)), seen))


def _passage(coefficients: Coefficients, h: float) -> _Passage:
    """Return an interval of constant coefficients: a short exponential, doubled."""
    A, S, Q = coefficients
    n = len(A)
    # The costate is scaled so that Q and S are of the same size.
    large_Q, large_S = (max(float(np.linalg.norm(X, 1)), 1e-300) for X in (Q, S))
    unit = math.sqrt(large_Q / large_S)
    H = np.block([[A, -S * unit], [-Q / unit, -A.T]])
    doublings = max(0, math.ceil(math.log2(max(4.0 * h * float(np.linalg.norm(H, 1)), 1.0))))
    theta = expm(H * (h / 2**doublings))
    inverse = np.linalg.inv(theta[n:, n:])
    passage = _Passage(
        inverse.T,
        _symmetric(-theta[:n, n:] @ inverse) / unit,
        _symmetric(-inverse @ theta[n:, :n]) * unit,
    )
    for _ in range(doublings):
        passage = passage.doubled()
    return passage


def step_back(early: Coefficients, late: Coefficients, P: Array, h: float) -> Array:
    """Return P at the start of an interval of that at the end, of order four, by Gauss nodes."""
    # Where the coefficients are the same at both nodes, the step is exact.
    if all(np.array_equal(*pair) for pair in zip(early, late, strict=True)):
        return _passage(late, h).back(P)
    for first, second in ((late, early), (early, late)):
        mixed = Coefficients(*(HEAVY * a + LIGHT * b for a, b in zip(first, second, strict=True)))
        P = _passage(mixed, 0.5 * h).back(P)
    return P


def solve_back(at: Callable[[float], Coefficients], knots: Array, P: Array) -> tuple[Array, Array]:
    """Return times and P there, back from the last knot; `LinAlgError` where P changes too fast."""

    def back(a: float, b: float, P: Array) -> Array:
        early, late = (at(a + c * (b - a)) for c in GAUSS)
        return step_back(early, late, P, b - a)

    times, values = [float(knots[-1])], [P]
    for a in knots[-2::-1].tolist():
        # Intervals left to do, the latest last; with P at the start from one step, where known.
        pending: list[tuple[float, float, Array | None]] = [(a, times[-1], None)]
        while pending:
            start, end, single = pending.pop()
            P = values[-1]
            middle, h = 0.5 * (start + end), end - start
            half, accurate = None, False
            # Over a long step, the mixed coefficients can be indefinite; shorter steps follow.
            with suppress(np.linalg.LinAlgError):
                single = back(start, end, P) if single is None else single
                half = back(middle, end, P)
                double = back(start, middle, half)
                # The cubic with these values and derivatives, midway.
                bend = at(start).rate(double) - at(end).rate(P)
                between = 0.5 * (double + P) + 0.125 * h * bend
                accurate = max(_apart(single, double), _apart(between, half)) <= _ACCURACY
            if accurate and half is not None:
                times += [middle, start]
                values += [half, double]
            elif len(times) > _KNOTS_LIMIT or h < 1e-12 * abs(knots[-1] - knots[0]):
                raise np.linalg.LinAlgError("P changes too fast")
            else:
                pending += [(start, middle, None), (middle, end, half)]
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
    return _symmetric(B @ np.linalg.solve(R, B.T))


def imbalance(terms: Array) -> float:
    """Return the norm of a sum relative to the sum of the norms of its terms."""
    size = float(np.linalg.norm(terms, axis=(1, 2)).sum())
    return float(np.linalg.norm(terms.sum(axis=0))) / max(size, 1e-300)


def _apart(first: Array, second: Array) -> float:
    return float(np.linalg.norm(first - second)) / max(float(np.linalg.norm(second)), 1e-300)


def _symmetric(matrix: Array) -> Array:
    return 0.5 * (matrix + matrix.T)
