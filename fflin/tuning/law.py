"""Linear laws as functions of parameters: matrices and their derivatives, series and sums."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fflin.base.validation import Array, Mask

# Matrices A, B, C, D of a law, or their derivatives.
Matrices = tuple[Array, Array, Array, Array]


class Law(NamedTuple):
    """Law ``z' = A z + B y, u = C z + D y`` with derivatives for p parameters.

    The derivatives dA (p, nz, nz), dB, dC and dD have the parameters as their first axis.
    """

    A: Array
    B: Array
    C: Array
    D: Array
    dA: Array
    dB: Array
    dC: Array
    dD: Array

    @property
    def gain(self) -> Array:
        """The static gain [[D, C], [B, A]] from (y, z) to (u, dz/dt)."""
        return np.block([[self.D, self.C], [self.B, self.A]])

    @property
    def gain_derivatives(self) -> Array:
        """The derivatives (p, nu + nz, ny + nz) of `gain`."""
        return np.block([[self.dD, self.dC], [self.dB, self.dA]])


def law_of(matrices: Matrices, derivatives: Sequence[Matrices]) -> Law:
    """Return the law with the derivatives of each parameter."""
    stacks = []
    for index, matrix in enumerate(matrices):
        stack = np.zeros((len(derivatives), *matrix.shape))
        for row, terms in zip(stack, derivatives, strict=True):
            row[:] = terms[index]
        stacks.append(stack)
    return Law(*matrices, *stacks)


def static_law(D: Array, dD: Array) -> Law:
    """Return a law without states."""
    nu, ny = D.shape
    p = len(dD)
    return Law(
        np.zeros((0, 0)),
        np.zeros((0, ny)),
        np.zeros((nu, 0)),
        D,
        np.zeros((p, 0, 0)),
        np.zeros((p, 0, ny)),
        np.zeros((p, nu, 0)),
        dD,
    )


def without_unused_states(law: Law) -> Law:
    """Return a law without the states that no output depends on through nonzero entries."""
    used: Mask = np.asarray(law.C.any(axis=0))
    for _ in range(law.A.shape[0]):
        used = used | law.A[used].any(axis=0)
    return Law(
        law.A[used][:, used],
        law.B[used],
        law.C[:, used],
        law.D,
        law.dA[:, used][:, :, used],
        law.dB[:, used],
        law.dC[:, :, used],
        law.dD,
    )


def repeated(law: Law, width: int) -> Law:
    """Return a law of one channel that acts on each of `width` channels."""
    return Law._make(_on_diagonal(matrix, width) for matrix in law)


def _on_diagonal(matrix: Array, width: int) -> Array:
    """Return block-diagonal matrices with `width` copies of each matrix."""
    *outer, rows, columns = matrix.shape
    result = np.zeros((*outer, width * rows, width * columns))
    for index in range(width):
        row, column = index * rows, index * columns
        result[..., row : row + rows, column : column + columns] = matrix
    return result


def series(left: Law, right: Law) -> Law:
    """Return the law `left` of the output of `right`; the parameters of `left` come first."""
    corner = np.zeros((len(right.A), len(left.A)))
    A = np.block([[right.A, corner], [left.B @ right.C, left.A]])
    B = np.vstack((right.B, left.B @ right.D))
    C = np.hstack((left.D @ right.C, left.C))
    D = left.D @ right.D
    n_left, n_right = len(left.dA), len(right.dA)

    def stack(first: Array, second: Array) -> Array:
        return np.concatenate((first, second))

    def none(matrix: Array, count: int) -> Array:
        return np.zeros((count, *matrix.shape))

    dA_right = stack(none(right.A, n_left), right.dA)
    dB_right = stack(none(right.B, n_left), right.dB)
    dA_left = stack(left.dA, none(left.A, n_right))
    dC_left = stack(left.dC, none(left.C, n_right))
    dBC = stack(left.dB @ right.C, left.B @ right.dC)
    dBD = stack(left.dB @ right.D, left.B @ right.dD)
    dDC = stack(left.dD @ right.C, left.D @ right.dC)
    dDD = stack(left.dD @ right.D, left.D @ right.dD)
    corners = none(corner, n_left + n_right)
    return Law(
        A,
        B,
        C,
        D,
        np.block([[dA_right, corners], [dBC, dA_left]]),
        np.concatenate((dB_right, dBD), axis=1),
        np.concatenate((dDC, dC_left), axis=2),
        dDD,
    )


def total(first: Law, second: Law) -> Law:
    """Return the sum of two laws of the same signals; the parameters of `first` come first."""
    p, r = len(first.dA), len(second.dA)

    def diagonal(left: Array, right: Array) -> Array:
        zeros = np.zeros((*left.shape[:-2], left.shape[-2], right.shape[-1]))
        others = np.zeros((*left.shape[:-2], right.shape[-2], left.shape[-1]))
        return np.block([[left, zeros], [others, right]])

    def padded(left: Array, right: Array) -> tuple[Array, Array]:
        before = np.concatenate((left, np.zeros((r, *left.shape[1:]))))
        after = np.concatenate((np.zeros((p, *right.shape[1:])), right))
        return before, after

    return Law(
        diagonal(first.A, second.A),
        np.vstack((first.B, second.B)),
        np.hstack((first.C, second.C)),
        first.D + second.D,
        diagonal(*padded(first.dA, second.dA)),
        np.concatenate(padded(first.dB, second.dB), axis=1),
        np.concatenate(padded(first.dC, second.dC), axis=2),
        np.concatenate((first.dD, second.dD)),
    )


def distributed(matrix: Array, law: Law) -> Law:
    """Return a law whose commands pass a fixed matrix."""
    return law._replace(
        C=matrix @ law.C, D=matrix @ law.D, dC=matrix @ law.dC, dD=matrix @ law.dD
    )


def embedded(
    law: Law,
    measured: Sequence[int],
    commanded: Sequence[int],
    ny: int,
    nu: int,
) -> Law:
    """Return the law from all `ny` measured signals to all `nu` commands.

    The given law acts from the signals `measured` to the commands `commanded`.
    """
    inputs = np.zeros((len(measured), ny))
    inputs[np.arange(len(measured)), list(measured)] = 1.0
    outputs = np.zeros((nu, len(commanded)))
    outputs[list(commanded), np.arange(len(commanded))] = 1.0
    return law._replace(
        B=law.B @ inputs,
        C=outputs @ law.C,
        D=outputs @ law.D @ inputs,
        dB=law.dB @ inputs,
        dC=outputs @ law.dC,
        dD=outputs @ law.dD @ inputs,
    )
