"""Reduction of plants to the states that connect the inputs and outputs of a law and its goals.

A state is hidden if no input reaches it or if it affects no output. The hidden states of several
models of one plant are hidden in all of these models.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from fflin.analysis.hautus import without_left_vectors
from fflin.analysis.ranks import unit_columns
from fflin.base.validation import Array, Values
from fflin.control.closed_loop import connected_states

Matrices = tuple[Array, Array, Array, Array]

# An entry of A or B below this fraction of the largest counts as zero.
_ROUNDING = 1e-9

# A mode is hidden if a test of Hautus has a smaller singular value, for matrices of norm 1. Below
# _UNDECIDED times this value, rounding errors may decide, and the mode is kept.
_HIDDEN, _UNDECIDED = 1e-14, 1e3

# Columns of B, or rows of C, whose remaining part is smaller become zero.
_LOST = 1e-12

# Hidden states of the nominal model are hidden in another model if their coupling is smaller.
_SHARED = 1e-10

# A pole does not decay if its decay rate is below this fraction of the fastest pole.
_LASTING = 1e-9


@dataclass(frozen=True, eq=False)
class Reduction:
    """Projection of the states x of a plant: ``x[kept] = right @ xi`` and ``xi = left @ x[kept]``.

    `left` and `right` are None if no further states are hidden. `remarks` belong to the report.
    """

    kept: list[int]
    left: Array | None = None
    right: Array | None = None
    remarks: tuple[str, ...] = ()

    @property
    def size(self) -> int:
        """Number of states that remain."""
        if self.left is None:
            return len(self.kept)
        return len(self.left)

    def of(self, A: Array, B: Array, C: Array) -> tuple[Array, Array, Array]:
        """Return the reduced matrices of a model."""
        A, B, C = A[np.ix_(self.kept, self.kept)], B[self.kept], C[:, self.kept]
        if self.left is None or self.right is None:
            return A, B, C
        return self.left @ A @ self.right, self.left @ B, _projected(C.T, self.right).T


def reduction_of(
    models: Iterable[Matrices], dt: float, used: Array, inputs: Sequence[int]
) -> Reduction:
    """Return the reduction of models of one plant, the nominal model first.

    `used` (ny + nx,) marks the outputs and states that a law or a goal uses; further states are not
    used. `inputs` are the inputs of the law and the goals. A mode that no input of the law or the
    goals reaches is not hidden if it does not decay and another input reaches it, because the law
    then lacks an input.
    """
    every = [_with_states(matrices, used) for matrices in models]
    kept = sorted({index for model in every for index in _connected(*model)})
    if not kept:
        return Reduction(kept)
    every = [(A[np.ix_(kept, kept)], B[kept], C[:, kept]) for A, B, C in every]
    scales, rate = _scales(every[0][0], dt)
    every = [_scaled(model, scales, rate, dt) for model in every]
    duals = [(A.T, C.T) for A, _, C in every]
    unseen, doubts = _hidden(duals)
    seen = _complement(unseen)
    seen_models = [(seen.T @ A @ seen, _projected(B, seen)) for A, B, _ in every]
    unmoved, more = _hidden([(A, B[:, list(inputs)]) for A, B in seen_models])
    if _lasting(unmoved, seen_models[0][0].T, rate, dt):
        unmoved, more = _hidden(seen_models)
    lasting = (
        *_lasting(unseen, every[0][0], rate, dt),
        *_lasting(unmoved, seen_models[0][0].T, rate, dt),
    )
    undecided = (*doubts, *more)
    remarks = _remarks(lasting, [_in_time(pole, rate, dt) for pole in undecided])
    if not unseen.shape[1] + unmoved.shape[1]:
        return Reduction(kept, remarks=remarks)
    basis = seen @ _complement(unmoved)
    return Reduction(kept, basis.T / scales, scales[:, None] * basis, remarks)


def _with_states(matrices: Matrices, used: Array) -> tuple[Array, Array, Array]:
    """Return A, B, and the rows of the outputs and states that are used."""
    A, B, C, _ = matrices
    rows = np.vstack((C, np.eye(len(A))))
    return A, B, rows[: len(used)][used]


def _connected(A: Array, B: Array, C: Array) -> list[int]:
    """Return the indices of the states that connect inputs and outputs, without rounding errors."""
    return connected_states(_significant(A), _significant(B), C)


def _significant(matrix: Array) -> Array:
    """Return a matrix whose rounding errors are replaced by zeros."""
    size = np.abs(matrix)
    entries: Array = np.where(size > _ROUNDING * size.max(initial=0.0), matrix, 0.0)
    return entries


def _scales(A: Array, dt: float) -> tuple[Array, float]:
    """Return scales of the states that balance A, and the norm of the balanced A."""
    from scipy.linalg import matrix_balance

    rates = (A - np.eye(len(A))) / dt if dt else A
    balanced, (scales, _) = matrix_balance(rates, permute=False, separate=True)
    return scales, float(np.linalg.norm(balanced, 2)) or 1.0


def _scaled(
    model: tuple[Array, Array, Array], scales: Array, rate: float, dt: float
) -> tuple[Array, Array, Array]:
    """Return a model with scaled states, in continuous time by (A - I)/dt, in units of 1/rate."""
    A, B, C = model
    rates = (A - np.eye(len(A))) / dt if dt else A
    return rates * scales / scales[:, None] / rate, B / scales[:, None], C * scales


def _hidden(models: Sequence[tuple[Array, Array]]) -> tuple[Array, list[complex]]:
    """Return a basis (n, k) of the states that no input of any model (A, B) reaches.

    The second result contains the poles for which rounding errors may decide.
    """
    A, B = models[0]
    _, basis, margin = without_left_vectors(A, unit_columns(B), np.eye(len(A)), _HIDDEN)
    doubts = [
        complex(one.at.conj() @ A @ one.at / (one.at.conj() @ one.at))
        for one in margin.decisions
        if 1.0 < one.ratio == margin.kept < _UNDECIDED
    ][:1]
    size = -1
    while size != basis.shape[1] > 0:
        size = basis.shape[1]
        for A, B in models[1:]:
            basis = basis @ _decoupled(A, B, basis)
    return basis, doubts


def _decoupled(A: Array, B: Array, basis: Array) -> Array:
    """Return the combinations (k, m) of hidden states that are not coupled in a model (A, B)."""
    rates = A.T @ basis
    coupling = np.vstack((rates - basis @ (basis.T @ rates), unit_columns(B).T @ basis))
    _, sizes, right = np.linalg.svd(coupling)
    rank = int((sizes > _SHARED).sum())
    combinations: Array = right[rank:].T
    return combinations


def _projected(columns: Array, basis: Array) -> Array:
    """Return the components of columns; columns that are rounding errors become zero."""
    components: Array = basis.T @ columns
    sizes = np.abs(basis.T) @ np.abs(columns)
    components[:, (np.abs(components) <= _LOST * sizes).all(axis=0)] = 0.0
    return components


def _complement(basis: Array) -> Array:
    """Return an orthonormal basis of the orthogonal complement."""
    n, k = basis.shape
    if not k:
        return np.eye(n)
    complement: Array = np.linalg.qr(basis, mode="complete")[0][:, k:]
    return complement


def _in_time(pole: complex, rate: float, dt: float) -> complex:
    """Return the pole [1/s] of an eigenvalue of a scaled model."""
    if not dt:
        return rate * pole
    factor = complex(1.0 + dt * rate * pole)
    if not factor:  # the state of a delay, which is zero after one step
        return complex(-np.inf)
    return complex(np.log(factor) / dt)


def _lasting(basis: Array, A: Array, rate: float, dt: float) -> list[complex]:
    """Return the poles [1/s] of hidden states that do not decay, one of each pair."""
    rates: Values = np.linalg.eigvals(basis.T @ A @ basis)
    poles = [_in_time(complex(one), rate, dt) for one in rates if one.imag >= 0.0]
    fastest = min(rate, np.pi / dt) if dt else rate
    return [pole for pole in poles if pole.real >= -_LASTING * fastest]


def _remarks(
    lasting: Sequence[complex], undecided: Sequence[complex]
) -> tuple[str, ...]:
    """Return remarks about poles that do not decay, and about undecided poles."""
    remarks = []
    if lasting:
        remarks.append(
            f"not decaying: {_listed(lasting)} of the plant. No signal of the law or the goals "
            "depends on these motions, so no law can damp them; the goals do not count them"
        )
    if undecided:
        remarks.append(
            f"rounding errors decide whether the law and the goals affect {_listed(undecided)} of "
            "the plant; the goals count it"
        )
    return tuple(remarks)


def _listed(poles: Sequence[complex]) -> str:
    """Return poles [1/s] as text, without real parts that are rounding errors."""
    texts = []
    for pole in poles:
        is_axis = abs(pole.real) <= _LASTING * abs(pole.imag)
        texts.append(f"{pole.imag:.3g}j" if is_axis else f"{pole:.3g}")
    return f"{'pole' if len(texts) == 1 else 'poles'} {', '.join(texts)} 1/s"
