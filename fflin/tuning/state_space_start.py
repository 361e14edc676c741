"""Gain of a state-space law that a search begins with, from a given controller."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fflin.base.errors import InputError
from fflin.base.validation import Array
from fflin.control.linear_controller import LinearController

# Largest condition number of the eigenvectors of a controller.
_CONDITION = 1e10


def tridiagonal_gain(
    policy: LinearController,
    measured: Sequence[int],
    inputs: Sequence[int],
    sizes: tuple[Array, Array],
) -> Array:
    """Return the gain [[D, C], [B, A]] of a controller in coordinates with a tridiagonal A.

    The states are the modes of the controller. Each mode is scaled so that its rows of B and
    columns of C are similar, relative to `sizes` of the columns of B and of the rows of C. A
    sampled controller is transformed by s = (2/dt) (z - 1)/(z + 1).
    """
    A, B, C, D = _continuous(policy)
    names = policy.lin.output_names
    others = np.delete(np.arange(len(names)), list(measured))
    unused = np.delete(np.arange(len(D)), list(inputs))
    reads = np.abs(B[:, others]).any(axis=0) | np.abs(D[:, others]).any(axis=0)
    if reads.any():
        raise InputError(
            f"start measures {names[others[reads.argmax()]]}, which the structure does not "
            "measure; give the structure the outputs of start"
        )
    moves = np.abs(C[unused]).any(axis=1) | np.abs(D[unused]).any(axis=1)
    if moves.any():
        name = policy.lin.input_names[unused[moves.argmax()]]
        raise InputError(
            f"start commands {name}, which the structure does not command; give the structure "
            "the inputs of start"
        )
    B, C, D = B[:, list(measured)], C[list(inputs)], D[np.ix_(inputs, measured)]
    A, B, C = _modal(A, B, C, sizes)
    return np.block([[D, C], [B, A]])


def _continuous(policy: LinearController) -> tuple[Array, Array, Array, Array]:
    """Return the matrices of a controller in continuous time."""
    system = policy.system
    A, B, C, D = system.A, system.B, system.C, system.D
    if not policy.dt:
        return A, B, C, D
    rate = 2.0 / policy.dt
    unit = np.eye(len(A))
    inverse = np.linalg.inv(A + unit)
    factor = np.sqrt(2.0 * rate)
    return (
        rate * inverse @ (A - unit),
        factor * inverse @ B,
        factor * C @ inverse,
        D - C @ inverse @ B,
    )


def _modal(
    A: Array, B: Array, C: Array, sizes: tuple[Array, Array]
) -> tuple[Array, Array, Array]:
    """Return A, B and C in the coordinates of real modes, each with a suitable scale."""
    poles, vectors = np.linalg.eig(A)
    columns = []
    widths = []
    for pole, vector in zip(poles, vectors.T, strict=True):
        if pole.imag < 0.0:
            continue
        parts = [vector.real] if pole.imag == 0.0 else [vector.real, vector.imag]
        columns += parts
        widths.append(len(parts))
    T = np.array(columns).reshape(-1, len(A)).T
    if len(A) and np.linalg.cond(T) > _CONDITION:
        raise InputError(
            "the eigenvectors of start are nearly dependent, so that it has no modal form; give "
            "a start of another order"
        )
    A, B, C = np.linalg.solve(T, A @ T), np.linalg.solve(T, B), C @ T
    first = 0
    for width in widths:
        mode = slice(first, first + width)
        first += width
        of_rows = np.linalg.norm(B[mode] / sizes[0])
        of_columns = np.linalg.norm(C[:, mode] / sizes[1][:, None])
        if of_rows and of_columns:
            factor = np.sqrt(of_columns / of_rows)
            B[mode] *= factor
            C[:, mode] /= factor
    return A, B, C
