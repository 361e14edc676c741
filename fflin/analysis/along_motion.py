"""Controllable and observable subspaces along a motion, by the Gramians of the varying model.

A Gramian W = F F^T is never formed. Its factor F is carried from knot to knot by the transition
matrices, and is compressed by QR factorisations, so small singular values of F keep their accuracy.

Errors that grow during a long motion hide small singular values. An error that the inputs can set
within the last part of a motion can also be set during the whole motion, and an error that the
outputs of the first part determine is also determined by all outputs. So shorter parts can decide a
rank that the whole motion leaves undecided.
"""

import math
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np

from fflin.analysis import mechanics, ranks
from fflin.base.validation import Array, Values
from fflin.dynamics.integrators import integrate_rows
from fflin.linear.linear_trajectory import (
    ACCURACY,
    LinearTrajectory,
    along,
    transitions_between,
)
from fflin.linear.linearization import Linearizer
from fflin.linear.model import LinearModel
from fflin.linear.trajectory import Trajectory

# A factor is compressed if it has more than this many columns for each row.
_WIDEST = 4

# Number of parts of a motion. The longest is the whole motion, and each is a fourth of the next.
_PARTS = 4


class Split(NamedTuple):
    """Image of a factor, and the directions outside the image that were not known before.

    The columns of `image` and `rest` are orthonormal directions in units of energy, `from_x @ x`.
    """

    image: Array  # (nx, d)
    rest: Array  # (nx, k)
    to_x: Array  # (nx, nx)
    from_x: Array  # (nx, nx)
    ratios: Values  # (d + k,) singular values, divided by their tolerances
    margin: ranks.Margin  # margin of the rank d


def ends(traj: LinearTrajectory) -> tuple[LinearModel, LinearModel]:
    """Return the continuous models at the first and the last knot."""
    linearizer = Linearizer(traj.robot, moving=True)
    first, last = (
        linearizer(traj.q[k], traj.v[k], traj.u_base[k], t=float(traj.t[k]))
        for k in (0, -1)
    )
    return first, last


def reachable(traj: LinearTrajectory, known: Array) -> Split:
    r"""Return the errors at the end that the inputs can set from zero.

    The inputs cannot set the errors `known` (k, nx).

    The factor of the controllability Gramian obeys
    :math:`F_{i+1} = [\Phi_i F_i, \Gamma_i]`, with the transition matrix :math:`\Phi_i` and the
    input matrix :math:`\Gamma_i` of the interval i.
    """
    last = ends(traj)[1]
    motions = _motions(traj)

    def split(times: Array) -> Split:
        to_x, from_x = _units(last, times)
        maps = np.array([_transitions(motion, times) for motion in motions])
        nx = len(to_x)
        free = from_x @ maps[..., :nx] @ to_x
        pushes = from_x @ maps[..., nx:]
        pushes /= ranks.divisors(np.linalg.norm(pushes[0], axis=1).max(axis=0))
        F: Array = np.zeros((len(motions), nx, 0))
        for k in range(free.shape[1]):
            F = _compressed(np.concatenate((free[:, k] @ F, pushes[:, k]), axis=2))
        return _split(F, (known @ to_x).T, to_x, from_x)

    return _clearest(split(times) for times in _parts(traj, from_end=True))


def seen(traj: LinearTrajectory, known: Array) -> Split:
    r"""Return the errors at the start that the outputs determine.

    The outputs do not determine the motions `known`.

    `known` has the shape (nx, k). The factor of the observability Gramian obeys
    :math:`O_i = [C_i; O_{i+1} \Phi_i]`, with the outputs at the knots.
    """
    first = ends(traj)[0]
    motions = _motions(traj)

    def split(times: Array) -> Split:
        to_x, from_x = _units(first, times)
        C = np.array([_output_matrices(motion, times) for motion in motions]) @ to_x
        C /= ranks.divisors(np.linalg.norm(C[0], axis=2).max(axis=0))[:, None]
        maps = np.array([_transitions(motion, times) for motion in motions])
        free = from_x @ maps[..., : len(to_x)] @ to_x
        # The columns of F are the rows of the observability factor.
        rows = C.swapaxes(2, 3)
        F = rows[:, -1]
        for k in reversed(range(free.shape[1])):
            moved = free[:, k].swapaxes(1, 2) @ F
            F = _compressed(np.concatenate((moved, rows[:, k]), axis=2))
        return _split(F, from_x @ known, to_x, from_x)

    return _clearest(split(times) for times in _parts(traj, from_end=False))


def _parts(traj: LinearTrajectory, *, from_end: bool) -> Iterator[Array]:
    """Yield the times of short parts at the end or the start of the motion, then of the whole.

    The intervals of a continuous model are divided so that each part has at least nx intervals,
    because few intervals would limit a rank.
    """
    traj.refuse_switches("controllability and observability along a motion")
    first, last = traj.t[[0, -1]]
    shorter = [(last - first) / 4**level for level in range(_PARTS - 1, 0, -1)]
    spans = [(first, first + duration) for duration in shorter]
    if from_end:
        spans = [(last - duration, last) for duration in shorter]
    for start, end in (*spans, (first, last)):
        knots = traj.t[(traj.t >= start) & (traj.t <= end)]
        if traj.dt:
            if len(knots) > 1:
                yield knots
            continue
        knots = np.union1d(knots, (start, end))
        pieces = math.ceil(len(traj.state_names) / (len(knots) - 1))
        within = np.diff(knots)[:, None] * np.arange(pieces) / pieces
        yield np.append((knots[:-1, None] + within).ravel(), end)


def _motions(traj: LinearTrajectory) -> list[LinearTrajectory]:
    """Return the models along the motion, and along the motion with its errors.

    The knots of the second motion are the integrated ends of the intervals before them.
    The difference of the two models shows the accuracy of the results. If the knots are accurate,
    the second motion is left out.
    """
    gaps = traj.gaps
    if gaps.errors.max() <= ACCURACY:
        return [traj]
    first = 0.0
    if traj.period:
        first = 1.0
    displacements = np.vstack((first * gaps.q[-1:], gaps.q))
    jumps = np.vstack((first * gaps.v[-1:], gaps.v))
    q = integrate_rows(traj.robot.model, traj.q, displacements)
    v = traj.v + jumps
    if traj.dt:
        moved = along(Trajectory._of(traj, q=q, v=v), traj.partition)
        return [traj, moved.discretize(traj.dt)]
    return [traj, LinearTrajectory._of(traj, q=q, v=v)]


def _transitions(traj: LinearTrajectory, times: Array) -> Array:
    """Return the matrices [Phi, Gamma] (m, nx, nx + nu) from each time to the next.

    They map the error at a time and an input that is constant until the next time.
    """
    if traj.dt:
        rows = np.searchsorted(traj.t, times[:-1])
        return np.concatenate((traj.A[rows], traj.B[rows]), axis=2)
    return np.array([whole for _, whole in transitions_between(traj, times)])


def _output_matrices(traj: LinearTrajectory, times: Array) -> Array:
    """Return the output matrices C (m, ny, nx) at times of the motion."""
    if traj.dt:
        return traj.C[np.searchsorted(traj.t, times)]
    return traj.outputs_at(times)


def _units(lin: LinearModel, times: Array) -> tuple[Array, Array]:
    """Return maps between states and units of energy, with the duration as the unit of time."""
    nv = len(lin.M)
    to_x, from_x = mechanics.energy_units(lin.M, lin.A[:nv, nv:])
    stretch = np.repeat((float(times[-1] - times[0]), 1.0), nv)
    return to_x * stretch, from_x / stretch[:, None]


def _compressed(F: Array) -> Array:
    """Return factors (k, nx, c) with the same products F_i F_j^T, if they have many columns."""
    rows = F.reshape(-1, F.shape[2])
    if F.shape[2] <= _WIDEST * len(rows):
        return F
    triangle: Array = np.linalg.qr(rows.T)[1]
    return triangle.T.reshape(*F.shape[:2], -1)


def _split(factors: Array, known: Array, to_x: Array, from_x: Array) -> Split:
    """Split the state space by the singular values of F, apart from the columns of `known`.

    `factors` (k, nx, c) contains F of the motion and of the motion with its errors. All arguments
    are in units of energy.
    """
    F = factors[0]
    nv = len(F) // 2
    size = float(np.linalg.norm(F, 2)) if F.size else 0.0
    units = known / np.linalg.norm(known, axis=0)
    basis = np.eye(len(F))
    if known.size:
        basis = np.linalg.qr(units, mode="complete")[0]
    taken, others = np.split(basis, [known.shape[1]], axis=1)
    left, values, _ = np.linalg.svd(others.T @ F)
    values = np.pad(values, (0, len(left) - len(values)))
    directions = others @ left
    # F has no part in the known directions. What it has there shows its accuracy, and so does the
    # difference to the motion with errors.
    leak = float(np.linalg.norm(taken.T @ F)) / max(size, 1e-300)
    rounding = max(ACCURACY, leak) * max(size, 1e-300)
    differences = np.linalg.norm(directions.T @ (factors[-1] - F), axis=1)
    ratios = values / (ranks.SAFETY * np.maximum(rounding, differences))
    order = np.argsort(-ratios, kind="stable")
    ratios = ratios[order]
    directions = directions[:, order]
    rank = int((ratios > 1.0).sum())
    margin = ranks.judged(ratios, directions, rank)
    return Split(
        image=directions[:, :rank],
        rest=directions[:, rank:],
        to_x=to_x,
        from_x=from_x,
        ratios=ratios,
        margin=margin.transformed(to_x[nv:, nv:], halved=True),
    )


def _clearest(splits: Iterable[Split]) -> Split:
    """Return the first split of full rank without doubts, or the one with the most decided values.

    Among equals, the split of the longest part is returned, which comes last.
    """
    best: Split | None = None
    most = -1
    for split in splits:
        if not split.margin.doubts and not split.rest.size:
            return split
        decided = int((split.ratios >= ranks.CLEAR).sum())
        if decided >= most:
            best = split
            most = decided
    assert best is not None
    return best
