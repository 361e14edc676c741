"""The modes of an undamped model, and which of them its inputs drive."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from fflin.analysis.names import combination
from fflin.analysis.ranks import EPS, Margin, split
from fflin.base.validation import Array

# Squares of frequencies that differ by less than this many roundings are taken as equal; a
# mode then mixes with the next group by at most 1e-4, which stays below the tolerance.
_EQUAL = 1e4

# Relative asymmetry of the stiffness beyond which there are no modes of (K, M).
_SYMMETRIC = 1e-8


@dataclass(frozen=True)
class Split:
    """The controllable part of the modes.

    Attributes
    ----------
    reached : ndarray (2 r, d)
        Basis of the controllable subspace, positions over rates.
    undriven : tuple of (float, ndarray (r, m))
        For each frequency squared [rad^2/s^2] the shapes that no input drives.
    margin : Margin
    """

    reached: Array
    undriven: tuple[tuple[float, Array], ...]
    margin: Margin


@dataclass(frozen=True)
class Vibrations:
    r"""Modes of :math:`K \phi = \lambda M \phi`, grouped by equal frequency.

    Attributes
    ----------
    squares : ndarray (r,)
        Frequencies squared [rad^2/s^2], ascending; negative where a stiffness is.
    shapes : ndarray (r, r)
        Velocities nu, with ``shapes.T @ M @ shapes = E``.
    groups : tuple of slice
        Of equal frequencies.
    noise : float
        Rounding of the squares.
    N, M : ndarray (r, r)
        Rates of the positions by nu, and the inertia.
    """

    squares: Array
    shapes: Array
    groups: tuple[slice, ...]
    noise: float
    N: Array
    M: Array

    def split(self, B: Array) -> Split:
        """Decide group by group what the accelerations B (r, nu) of the inputs drive."""
        drive = self.shapes.T @ self.M @ B
        sizes = np.linalg.norm(drive, axis=0)
        drive = drive[:, sizes > 0.0] / sizes[sizes > 0.0]
        driven, undriven, margin = [], [], Margin()
        for group in self.groups:
            gap = self._gap(group)
            tolerance = 10.0 * (len(self.M) * EPS + self.noise / gap)
            image, rest, decided = split(drive[group], tolerance)
            margin &= decided
            driven.append(self.shapes[:, group] @ image)
            if rest.shape[1]:
                square = float(self.squares[group].mean())
                undriven.append((square, self.shapes[:, group] @ rest))
        rates = np.hstack(driven)
        zero = np.zeros_like(rates)
        reached = np.block([[self.N @ rates, zero], [zero, rates]])
        return Split(reached, tuple(undriven), margin)

    def _gap(self, group: slice) -> float:
        gaps = [np.inf]
        if group.start:
            gaps.append(self.squares[group.start] - self.squares[group.start - 1])
        if group.stop < len(self.squares):
            gaps.append(self.squares[group.stop] - self.squares[group.stop - 1])
        return float(min(gaps))


def undamped_modes(A: Array, M: Array) -> Vibrations | None:
    """Return the modes of a model about rest, or None where it is damped or not symmetric."""
    r = len(M)
    N = A[:r, r:]
    if A[:r, :r].any() or A[r:, r:].any():
        return None
    L = np.linalg.cholesky(M)
    inverse = np.linalg.inv(L)
    K = -L.T @ A[r:, :r] @ N @ inverse.T
    size, asymmetry = float(np.abs(K).max()), float(np.abs(K - K.T).max())
    if asymmetry > _SYMMETRIC * size:
        return None
    squares, turned = np.linalg.eigh((K + K.T) / 2.0)
    noise = max(r * EPS * float(np.abs(squares).max()), asymmetry)
    edges = np.flatnonzero(np.diff(squares) > _EQUAL * noise) + 1
    bounds = [0, *edges.tolist(), r]
    groups = tuple(slice(a, b) for a, b in pairwise(bounds))
    return Vibrations(squares, inverse.T @ turned, groups, noise, N, M)


def vibration_rows(
    found: Split, modes: Vibrations, names: tuple[str, ...]
) -> tuple[Array, tuple[str, ...], Any]:
    """Return the rows (m, 2 r) that read the undriven modes, their names, and their poles."""
    r = len(modes.M)
    size = np.sqrt(modes.M.diagonal())
    rows, labels, poles = [np.zeros((0, 2 * r))], [], []
    members = tuple(name.split(".", 1)[-1] for name in names[r:])
    for square, shapes in found.undriven:
        momenta = shapes.T @ modes.M
        zero = np.zeros_like(momenta)
        rows += [np.hstack((np.linalg.solve(modes.N.T, momenta.T).T, zero))]
        rows += [np.hstack((zero, momenta))]
        still = abs(square) <= _EQUAL * modes.noise
        pole = np.sqrt(complex(0.0 if still else -square))
        kind = "drift" if still else "vibration" if square > 0.0 else "instability"
        speed = "" if still else f" at {abs(pole):.4g} rad/s"
        shown = [
            combination(s / np.abs(s * size).max() * size, members, np.ones(r)) for s in shapes.T
        ]
        for what in ("", "rate of "):
            labels += [f"{what}{kind}{speed} ({shape})" for shape in shown]
        poles += [pole, -pole] * len(shapes.T)
    values = np.array(poles)
    return np.vstack(rows), tuple(labels), values
