"""Messages about states that inputs cannot stabilise or outputs cannot observe."""

import re
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np

from fflin.analysis.controllability import controllability
from fflin.analysis.mechanics import conserved
from fflin.analysis.names import grouped, with_rates
from fflin.analysis.observability import observability
from fflin.analysis.ranks import Margin, judged
from fflin.analysis.reduction import damped_wheels
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

# A relative singular value of the equilibrated Popov-Belevitch-Hautus matrix below this counts as
# zero: repeated eigenvalues are computed with such errors.
_RANK = 1e-7


def require_stabilizable(lin: LinearModel) -> None:
    """Raise `StabilizabilityError` that names the states that inputs cannot stabilise."""
    if len(lin.A) < 2 * len(lin.M):  # with speeds of wheels without their angles
        missed = f"the inputs cannot stabilise {{}}{damped_wheels(lin) or '; add inputs'}"
        try:
            kind = StabilizabilityError
            _check_reach(lin, lin.A, lin.B, "stabilised by the inputs", missed, kind)
        except StabilizabilityError as error:
            error.args = (f"{error}{_pendulums(lin, str(error))}",)
            raise
        return
    found, words = controllability(lin), ""
    if not found.stabilizable:
        weights = conserved(lin).weights
        forces = _forces_missing(lin, weights) if len(weights) else None
        lost = forces or f"{', '.join(grouped(found.uncontrollable))}; add inputs"
        words = f"the inputs cannot stabilise {lost}{_pendulums(lin, lost)}"
    _conclude(StabilizabilityError, words, found.notes, found.margin)


def _pendulums(lin: LinearModel, lost: str) -> str:
    """Say what to do about pendulums of slosh without gravity or thrust among what is lost."""
    robot = lin._robot
    hanging = [
        f"'{joint.name}'"
        for joint in (robot.modes if robot else ())
        if not joint.prismatic
        and joint.kind == "slosh"
        and re.search(rf"(?<!\w){re.escape(joint.name)}(?!\w)", lost)
    ]
    if not hanging:
        return ""
    return (
        f"; slosh {', '.join(hanging)} is a pendulum, which has no stiffness without gravity or "
        "thrust: linearise it under the thrust (u=, moving=True), or put the mass on springs (give "
        "Slosh a frequency and no length, or Slosh.cylinder pendulum=False)"
    )


def require_detectable(lin: LinearModel) -> None:
    """Raise `DetectabilityError` that names what no output shows and what does not settle."""
    missed = "the outputs do not observe {}, which do not decay by themselves; add outputs"
    if len(lin.A) < 2 * len(lin.M):
        _check_reach(lin, lin.A.T, lin.C.T, "observed by the outputs", missed, DetectabilityError)
        return
    found = observability(lin)
    words = "" if found.detectable else missed.format(with_rates(found.unobservable))
    _conclude(DetectabilityError, words, found.notes, found.margin)


def _conclude(
    kind: type[FflinError], words: str, notes: Sequence[str], margin: Margin, depth: int = 4
) -> None:
    """Raise the error of given words with undecided ranks, or warn of undecided ranks."""
    doubts = [note for note in notes if note.startswith("undecided")]
    if words:
        error: Any = kind("; ".join((words, *doubts)))
        error.margin = margin
        raise error
    for note in doubts:
        warnings.warn(note, FflinWarning, stacklevel=depth)


def require_weighed(lin: LinearModel, A: Array, Q: Array) -> None:
    """Raise `InputError` that names the marginally stable modes without a weight in Q."""
    missed = "Q has no weight on {}, which do not decay by themselves; give these states weights"
    _check_reach(lin, A.T, _root(Q), "weighted by Q", missed)


def require_disturbed(lin: LinearModel, W: Array) -> None:
    """Raise `InputError` that names the modes on the boundary that no disturbance reaches."""
    missed = (
        "W does not excite {}, which do not decay by themselves, so that a steady-state filter "
        "would not correct these states; give the noise on these states an intensity"
    )
    _check_reach(lin, lin.A, _root(W), "excited by W", missed)


def _root(W: Array) -> Array:
    """Return a factor L (m, m) with W = L L^T, of a semidefinite matrix of unlike units."""
    # It has the root of W's condition, and so reaches what W reaches with less doubt.
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
    """Raise an error where B misses a mode on the boundary, or warn of what is undecided."""
    discrete = bool(lin.dt)
    poles = np.linalg.eigvals(A)
    size = max(float(np.abs(poles - discrete).max()), 1e-300)
    beyond = np.abs(poles) - 1.0 if discrete else poles.real
    # Rounding moves a Jordan block of four by its fourth root.
    candidates = [complex(discrete)]
    growing = (beyond > 0.0) & (error is not InputError)
    for pole in poles[((np.abs(beyond) <= 1e-3 * size) | growing) & (poles.imag >= 0.0)]:
        if all(abs(pole - other) > 1e-3 * size for other in candidates):
            candidates.append(complex(pole))
    missed, margin = list[Values](), Margin()
    for pole in candidates:
        shifted = A - (pole if pole.imag else pole.real) * np.eye(len(A))
        matrix = np.column_stack((shifted, B))
        # Rows and columns have unlike units; they are brought to comparable sizes.
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
        f"undecided: {_dominant(at[None], lin.state_names)} is taken as "
        f"{'' if change < 0 else 'not '}{what}; the test value is "
        f"{ratio:.2g} times its rounding error; another machine may decide otherwise"
        for ratio, at, change in margin.doubts
    )
    words = complaint.format(_dominant(np.array(missed), lin.state_names)) if missed else ""
    _conclude(error, words, doubts, margin, 5)


def _forces_missing(lin: LinearModel, weights: Array) -> str | None:
    """Name the coordinates of the conserved momenta W M nu, W (k, nv); None for other models."""
    names = lin.state_names[-len(lin.M) :]
    if names[:3] == _BASE_VELOCITIES[:3] and names[3:4] != ("v_b.x",):
        # The position has left, which nothing pushes.
        names = (*_BASE_VELOCITIES, *names[3:])
        weights = np.insert(weights, [3, 3, 3], 0.0, axis=1)
    if names[:6] != _BASE_VELOCITIES:
        return None
    involved = np.abs(weights).max(axis=0) > 0.0
    base = []
    for word, rows in _BASE_WORDS:
        axes = [axis for axis, x in zip("xyz", involved[rows], strict=True) if x]
        if axes:
            base.append(word if len(axes) == 3 else f"{word} {'/'.join(axes)}")
    joints = [name.partition(".")[2] for name, x in zip(names[6:], involved[6:], strict=True) if x]
    if joints:
        moved = f"joint{'s' * (len(joints) > 1)} {listed(joints)}, which no input moves"
        advice = "; give each of these joints a spring (--stiffness, stiffness=) or a motor"
        return " and ".join((*base, moved)) + advice
    kind = "" if len(base) == 2 else "angular " if involved[:3].any() else "linear "
    what = " and ".join(base).replace("and base", "and")
    return (
        f"{what} ({kind}momentum is conserved); add inputs on the base, or design on "
        "fflin.momentum_reduction(lin)"
    )


_BASE_VELOCITIES = tuple(f"{group}.{axis}" for group in ("omega_b", "v_b") for axis in "xyz")
_BASE_WORDS = (("base attitude", slice(0, 3)), ("base position", slice(3, 6)))


def _dominant(vectors: Values, names: Sequence[str]) -> str:
    """Name the largest states of vectors (k, nx), at least one for each vector."""
    sizes = np.abs(vectors)
    large = (sizes >= 0.3 * sizes.max(axis=1, keepdims=True)).any(axis=0)
    words = listed(name for name, chosen in zip(names, large, strict=True) if chosen)
    count = len(vectors)
    if large.sum() <= count:
        return words
    return f"{'a combination' if count == 1 else f'{count} combinations'} of {words}"
