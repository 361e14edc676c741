"""Second-order form M a + D v + K s = S u of a model at rest, and its unobservable motions."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from fflin.analysis.ranks import (
    EPS,
    Decision,
    FixedPoles,
    Margin,
    Noisy,
    decided,
    null_space,
    right_vectors,
    stacked,
)
from fflin.base.validation import Array

# Springs or dampers with a larger relative asymmetry are not symmetric.
_SYMMETRIC = 1e-8

# Poles at a relative distance below _SAME_POLE are one; below _DEFECTIVE they are taken for
# defective, of which eigenvectors say too little.
_SAME_POLE, _DEFECTIVE = 1e-9, 1e-5

# Poles that sampling brings this near to each other may hide what the continuous model shows.
_ALIASED = 1e-6

# A larger singular value is not zero even roughly. A pole is refined in a few steps, each by
# less than this part of it.
_SUSPICIOUS, _NEAR, _REFINEMENTS = 1e-3, 0.1, 8


@dataclass(frozen=True)
class SecondOrder:
    """The forces of a model, in coordinates s whose rates are the velocities."""

    M: Array
    K: Noisy
    D: Noisy
    S: Noisy  # (nv, nu)

    @cached_property
    def size(self) -> Array:
        """Roots of the diagonal of M (nv,), which make forces and speeds comparable."""
        return np.sqrt(self.M.diagonal())

    def restricted(self, R: Array) -> SecondOrder:
        """Return the system of the motions R z; what holds them to it does no work."""
        M = R.T @ self.M @ R
        K, D = ((forces @ R).after(R.T) for forces in (self.K, self.D))
        return SecondOrder(M, K, D, self.S.after(R.T))

    @property
    def acting(self) -> bool:
        """Whether there are springs or dampers."""
        return bool(self.K.values.any() or self.D.values.any())

    @cached_property
    def symmetric(self) -> bool:
        """Whether springs are symmetric, and dampers are and all take energy, or all give it."""
        units = np.outer(self.size, self.size)
        for matrix in (self.K.values / units, self.D.values / units):
            if np.abs(matrix - matrix.T).max(initial=0.0) > _SYMMETRIC * np.abs(matrix).max():
                return False
        drag = np.linalg.eigvalsh(self.D.values / units)
        return min(-drag.min(), drag.max()) <= _SYMMETRIC * np.abs(drag).max()

    @cached_property
    def poles(self) -> tuple[Any, Margin]:
        """The poles that are not zero, one of each pair, as eigenvalues approximate them."""
        rigid, margin = self._null(self.K, self.D)
        still, other = self._null(self.K)
        R = null_space(Noisy.exact(rigid.T @ self.M / self.size))[0]
        part = self.restricted(R / self.size[:, None])
        r = len(part.M)
        if not r:
            return np.zeros(0, dtype=complex), margin & other
        L = np.linalg.inv(np.linalg.cholesky(part.M))
        K, D = L @ part.K.values @ L.T, L @ part.D.values @ L.T
        zeros = still.shape[1] - rigid.shape[1]
        if D.any():
            fastest = max(np.linalg.norm(K, 2) ** 0.5, np.linalg.norm(D, 2))
            A = np.block([[np.zeros((r, r)), np.eye(r)], [-K / fastest**2, -D / fastest]])
            found = np.linalg.eigvals(A) * fastest
        else:
            roots = np.sqrt(-np.linalg.eigvalsh((K + K.T) / 2.0).astype(complex))
            found, zeros = np.concatenate((roots, -roots)), 2 * zeros
        found = found[np.argsort(np.abs(found))][zeros:]
        return found[found.imag >= 0.0], margin & other

    def _null(self, *matrices: Noisy) -> tuple[Array, Margin]:
        stack = stacked([[matrix] for matrix in matrices]) @ np.diag(1.0 / self.size)
        basis, margin = null_space(stack)
        return basis / self.size[:, None], margin.seen(1.0 / self.size)


class Hidden(NamedTuple):
    """Free motions that a measurement of positions and velocities does not observe."""

    motions: Array  # (2 nv, k), basis of the unobservable subspace, (s, ds/dt)
    shapes: tuple[tuple[complex, Any], ...]  # (nv, m), of each continuous pole or pair but zero
    fixed: FixedPoles


def hidden(system: SecondOrder, position: Noisy, velocity: Noisy, dt: float) -> Hidden | None:
    """Find the motions that ``position @ s + velocity @ ds/dt`` does not show.

    They are the null space of :math:`[p^2 M + p D + K; C_s + p C_v]` at each pole p; None where
    eigenvectors do not tell: of other K or D, of aliased or defective poles.
    """
    # Those of the pole zero come in chains of two at the most: K s = K v = D v = C_s v = 0 and
    # C_s s + C_v v = 0. What hides from the inputs are, by symmetry, those of C_s = S^T, C_v = 0.
    if not system.symmetric or (dt and _aliased(system.poles[0], dt)):
        return None
    still, margin = _still(system, position, velocity)
    motions, poles = [still], [0j] * still.shape[1]
    slowest = Decision(np.inf)
    starts, decided_zero = system.poles
    margin &= decided_zero
    missed: list[tuple[complex, Any]] = []
    for start in starts:
        shapes, pole, judged = _at_pole(system, position, velocity, complex(start))
        if any(abs(pole - other) < _SAME_POLE * abs(pole) for other, _ in missed):
            continue
        margin &= judged
        if not shapes.shape[1]:
            continue
        if not _simple(system, shapes, pole):
            return None
        missed.append((pole, shapes))
        motion = np.vstack((shapes, pole * shapes))
        pair = [pole, pole.conjugate()] if pole.imag else [pole]
        motions += [motion.real, motion.imag][: len(pair)]
        poles += [each for each in pair for _ in shapes.T]
        slow = max(-pole.real / abs(pole) / (1e2 * EPS * len(system.M)), 0.0)
        slowest = min(slowest, Decision(slow, shapes[:, 0]), key=lambda decision: decision.ratio)
    known = [pole for pole, _ in missed]
    near = [abs(a - b) < _DEFECTIVE * abs(a) for i, a in enumerate(known) for b in known[:i]]
    near += [0.0 < pole.imag < _DEFECTIVE * abs(pole) for pole in known]
    if any(near):
        return None
    fixed = FixedPoles(
        poles=np.exp(np.array(poles) * dt) if dt else np.array(poles),
        decays=not still.shape[1] and slowest.ratio > 1.0,
        margin=margin,
        settling=Margin() if still.shape[1] else decided(slowest.ratio, slowest.at),
    )
    return Hidden(np.hstack(motions), tuple(missed), fixed)


def _still(system: SecondOrder, position: Noisy, velocity: Noisy) -> tuple[Array, Margin]:
    none, empty = (Noisy.exact(np.zeros_like(m)) for m in (system.M, position.values))
    rows = [[system.K, none], [none, system.K], [none, system.D], [empty, position]]
    fast, slow = np.abs(velocity.values).max(initial=0.0), np.abs(position.values).max(initial=0.0)
    unit = slow / fast if fast and slow else 1.0
    scale = np.concatenate((1.0 / system.size, unit / system.size))
    basis, margin = null_space(stacked([*rows, [position, velocity]]) @ np.diag(scale))
    return basis * scale[:, None], margin.halved().seen(1.0 / system.size)


def _at_pole(
    system: SecondOrder, position: Noisy, velocity: Noisy, pole: complex
) -> tuple[Any, complex, Margin]:
    """Return the shapes (nv, k) that are missed at a pole, the pole refined, and the margin."""
    M, K, D = system.M, system.K.values, system.D.values
    for step in range(_REFINEMENTS):
        # Rows are scaled by what stands in them: a slow mode beside a fast one keeps its figures.
        s = pole if pole.imag else pole.real
        size = abs(s)
        weight = np.sqrt(
            size**2 * M.diagonal() + size * np.abs(D.diagonal()) + np.abs(K.diagonal())
        )
        units = np.outer(weight, weight)
        spread = 4.0 * EPS * size**2 * np.outer(system.size, system.size)
        spread = (spread + size * system.D.noise + system.K.noise) / units
        noise = (position.noise + size * velocity.noise) / weight
        pencil = (s * s * M + s * D + K) / units
        seen = (position.values + s * velocity.values) / weight
        stack = Noisy(np.vstack((pencil, seen)), np.vstack((spread, noise)))
        values, vectors, rank, margin = right_vectors(stack, 2 if pole.imag else 1)
        shapes = vectors / weight[:, None]
        refined = _root(system, shapes[:, -1], pole)
        moved = abs(refined - pole) / size
        if not 4.0 * EPS < moved < _NEAR or (step and values[-1] > _SUSPICIOUS):
            break
        pole = refined
    return shapes[:, rank:], pole, margin.seen(1.0 / weight)


def _root(system: SecondOrder, shape: Any, near: complex) -> complex:
    """Return the root of the scalar equation of a shape that is nearest to a pole."""
    left = shape
    if abs(shape @ system.M @ shape) < 0.1 * abs(shape.conj() @ system.M @ shape):
        left = shape.conj()  # where poles are equal, shape^T M shape may vanish
    a, b, c = (left @ X @ shape for X in (system.M, system.D.values, system.K.values))
    root = np.sqrt(complex(b * b - 4.0 * a * c))
    q = -(b + (root if (np.conj(b) * root).real >= 0.0 else -root)) / 2.0
    roots = [q / a, c / q] if q else [0j]
    refined = complex(min(roots, key=lambda value: abs(value - near)))
    if not near.imag:
        return complex(refined.real)
    if not system.D.values.any():
        return complex(0.0, refined.imag)
    return refined


def _simple(system: SecondOrder, shapes: Any, pole: complex) -> bool:
    """Whether a pole has as many eigenvectors as its multiplicity, beyond rounding."""
    change = shapes.T @ (2.0 * pole * system.M + system.D.values) @ shapes
    size = np.abs(shapes).T @ (2.0 * abs(pole) * np.abs(system.M) + np.abs(system.D.values))
    least = np.linalg.svd(change, compute_uv=False)[-1]
    return least > _DEFECTIVE * np.linalg.norm(size @ np.abs(shapes))


def _aliased(poles: Any, dt: float) -> bool:
    """Whether sampling maps two poles to one, or a vibration to a pole at rest."""
    s = np.concatenate((poles, np.conj(poles), [0.0])) * dt
    apart = s[:, None] - s
    turns = np.round(apart.imag / (2.0 * np.pi))
    return ((turns != 0.0) & (np.abs(apart - 2j * np.pi * turns) < _ALIASED)).any()
