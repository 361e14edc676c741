"""Messages about states that inputs cannot stabilise or outputs cannot observe."""

import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np

from fflin.analysis.controllability import controllability
from fflin.analysis.mechanics import conserved, grouped
from fflin.analysis.observability import observability
from fflin.analysis.ranks import Margin, judged
from fflin.base.errors import (
    DetectabilityError,
    FflinError,
    FflinWarning,
    InputError,
    StabilizabilityError,
    listed,
)
from fflin.base.validation import Array, Values
from fflin.linear.model import LinearModel

# Relative singular values of the equilibrated Popov-Belevitch-Hautus matrix below this count as
# zero, because repeated eigenvalues have errors of this size.
_RANK = 1e-7


def require_stabilizable(lin: LinearModel) -> None:
    """Raise `StabilizabilityError` if there are states that the inputs cannot stabilise."""
    missed = "the inputs cannot stabilise {}; add inputs"
    if len(lin.A) < 2 * len(lin.M):  # the model has wheel speeds without wheel angles
        robot = lin._robot
        if robot and any(robot.damping.get(name) for name in robot.wheels):
            missed += ", or remove the damping of the wheels"
        _check_reach(lin, lin.A, lin.B, "stabilised by the inputs", missed, StabilizabilityError)
        return
    found, words = controllability(lin), ""
    if not found.stabilizable:
        # Name the momenta and the other states, but not the coordinates whose rates are the
        # momenta.
        count = len(conserved(lin).weights)
        lost = (*found.uncontrollable[:count], *found.uncontrollable[2 * count :])
        words = missed.format(listed(grouped(lost)))
        if count:
            words += (
                ", add a spring to any joint that no input moves (--stiffness, stiffness=), or "
                "design on fflin.momentum_reduction(lin)"
            )
    _conclude(StabilizabilityError, words, found.notes, found.margin)


def require_detectable(lin: LinearModel) -> None:
    """Raise `DetectabilityError` if there are unobservable motions that do not decay."""
    missed = "the outputs do not observe {}, whose motion does not decay by itself; add outputs"
    if len(lin.A) < 2 * len(lin.M):
        _check_reach(lin, lin.A.T, lin.C.T, "observed by the outputs", missed, DetectabilityError)
        return
    found = observability(lin)
    words = "" if found.detectable else missed.format(listed(found.unobservable))
    _conclude(DetectabilityError, words, found.notes, found.margin)


def _conclude(
    kind: type[FflinError], words: str, notes: Sequence[str], margin: Margin, depth: int = 4
) -> None:
    """Raise an error with `words` and the undecided ranks; without `words`, warn of these ranks."""
    doubts = [note for note in notes if note.startswith("undecided")]
    if words:
        error: Any = kind("; ".join((words, *doubts)))
        error.margin = margin
        raise error
    for note in doubts:
        warnings.warn(note, FflinWarning, stacklevel=depth)


def require_weighed(lin: LinearModel, A: Array, Q: Array) -> None:
    """Raise `InputError` if a marginally stable mode has no weight in Q."""
    missed = "Q has no weight on {}, whose motion does not decay by itself; add a weight there"
    _check_reach(lin, A.T, _root(Q), "weighted by Q", missed)


def require_disturbed(lin: LinearModel, W: Array) -> None:
    """Raise `InputError` if no disturbance excites a marginally stable mode."""
    missed = (
        "W does not excite {}, whose motion does not decay by itself, so a steady-state filter "
        "would not correct its estimate; give the noise there a positive intensity"
    )
    _check_reach(lin, lin.A, _root(W), "excited by W", missed)


def _root(W: Array) -> Array:
    """Return L (m, m) with W = L L^T, for a semidefinite W whose entries have different units."""
    # The condition number of L is the square root of the condition number of W, so the rank of L is
    # easier to decide.
    size = np.sqrt(W.diagonal())
    size = np.where(size > 0.0, size, 1.0)
    values, vectors = np.linalg.eigh(W / np.outer(size, size))
    rounding = len(W) * np.finfo(float).eps * values[-1:].max(initial=0.0)
    return size[:, None] * vectors * np.sqrt(np.where(values > rounding, values, 0.0))


def _check_reach(
    lin: LinearModel,
    A: Array,
    B: Array,
    what: str,
    complaint: str,
    error: type[FflinError] = InputError,
) -> None:
    """Raise an error if B does not reach a mode on the stability boundary; warn if undecided."""
    discrete = bool(lin.dt)
    poles = np.linalg.eigvals(A)
    size = max(float(np.abs(poles - discrete).max()), 1e-300)
    beyond = np.abs(poles) - 1.0 if discrete else poles.real
    # Rounding moves the eigenvalues of a Jordan block of size four by the fourth root of the
    # rounding error. Poles closer than 1e-3 of the largest therefore count as equal.
    candidates = [complex(discrete)]
    growing = (beyond > 0.0) & (error is not InputError)
    for pole in poles[((np.abs(beyond) <= 1e-3 * size) | growing) & (poles.imag >= 0.0)]:
        if all(abs(pole - other) > 1e-3 * size for other in candidates):
            candidates.append(complex(pole))
    missed, margin = list[Values](), Margin()
    for pole in candidates:
        shifted = A - (pole if pole.imag else pole.real) * np.eye(len(A))
        matrix = np.column_stack((shifted, B))
        # Rows and columns have different units, so they are scaled to comparable sizes.
        rows, columns, scaled = np.ones(len(matrix)), np.ones(matrix.shape[1]), matrix
        for _ in range(4):
            sizes = np.sqrt(np.abs(scaled).max(axis=1))
            rows /= np.where(sizes > 0.0, sizes, 1.0)
            sizes = np.sqrt(np.abs(scaled).max(axis=0))
            columns /= np.where(sizes > 0.0, sizes, 1.0)
            scaled = rows[:, None] * matrix * columns
        left, values, _ = np.linalg.svd(scaled)
        vectors: Values = left.conj().T * rows
        vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
        ratios = values / (_RANK * values[0])
        rank = int((ratios > 1.0).sum())
        missed += list(vectors[rank:])
        margin &= judged(ratios, vectors.T, rank)
    doubts = tuple(
        f"undecided: {_dominant(at[None], lin.state_names)} counts as "
        f"{'' if change < 0 else 'not '}{what}, but the test value is only {ratio:.2g} times its "
        "rounding error, so another machine may decide otherwise"
        for ratio, at, change in margin.doubts
    )
    words = complaint.format(_dominant(np.array(missed), lin.state_names)) if missed else ""
    _conclude(error, words, doubts, margin, 5)


def _dominant(vectors: Values, names: Sequence[str]) -> str:
    """Name the largest states of vectors (k, nx), at least one for each vector."""
    sizes = np.abs(vectors)
    large = (sizes >= 0.3 * sizes.max(axis=1, keepdims=True)).any(axis=0)
    words = listed(name for name, chosen in zip(names, large, strict=True) if chosen)
    count = len(vectors)
    if large.sum() <= count:
        return words
    return f"{'a combination' if count == 1 else f'{count} combinations'} of {words}"
