"""Controllable and observable subspaces along a motion, by the Gramians of the varying model.

A Gramian W = F F^T is never formed. Its factor F is carried from knot to knot by the transition
matrices, and is compressed by QR factorisations, so small singular values of F keep their accuracy.
"""

import math
from typing import NamedTuple

import numpy as np

from fflin.analysis import mechanics, ranks
from fflin.base.validation import Array
from fflin.linear.linear_trajectory import (
    ACCURACY,
    LinearTrajectory,
    along,
    knot_transitions,
)
from fflin.linear.linearization import Linearizer
from fflin.linear.model import LinearModel

# A factor is compressed if it has more than this many columns for each state.
_WIDEST = 4


class Split(NamedTuple):
    """Image of a factor, and the directions outside the image that were not known before.

    The columns of `image` and `rest` are orthonormal directions in units of energy, `from_x @ x`.
    """

    image: Array  # (nx, d)
    rest: Array  # (nx, k)
    to_x: Array  # (nx, nx)
    from_x: Array  # (nx, nx)
    margin: ranks.Margin  # margin of the rank d


def ends(traj: LinearTrajectory) -> tuple[LinearModel, LinearModel]:
    """Return the continuous models at the first and the last knot."""
    linearizer = Linearizer(traj.robot, moving=True)
    first, last = (
        linearizer(traj.q[k], traj.v[k], traj.u_base[k], t=float(traj.t[k]))
        for k in (0, -1)
    )
    return first, last


def transition_matrices(traj: LinearTrajectory) -> Array:
    """Return the matrices [Phi, Gamma] (N - 1, nx, nx + nu) from each knot to the next.

    They map the error at a knot and an input that is constant until the next knot.
    """
    if traj.dt:
        return np.concatenate((traj.A, traj.B), axis=2)
    return np.array([whole for _, whole in knot_transitions(traj)])


def reachable(traj: LinearTrajectory, known: Array) -> Split:
    r"""Return the errors at the end that the inputs can set from zero.

    The inputs cannot set the errors `known` (k, nx).

    The factor of the controllability Gramian obeys
    :math:`F_{i+1} = [\Phi_i F_i, \Gamma_i]`, with the transition matrix :math:`\Phi_i` and the
    input matrix :math:`\Gamma_i` of the interval i.
    """
    duration = float(traj.t[-1] - traj.t[0])
    nx = len(traj.state_names)
    to_x, from_x = _units(ends(traj)[1], duration)
    maps = transition_matrices(_refined(traj))
    pushes = from_x @ maps[:, :, nx:]
    sizes = ranks.divisors(np.linalg.norm(pushes, axis=1).max(axis=0))
    F: Array = np.zeros((nx, 0))
    for free, push in zip(from_x @ maps[:, :, :nx] @ to_x, pushes / sizes, strict=True):
        F = _compressed(np.hstack((free @ F, push)))
    return _split(traj, F, (known @ to_x).T, to_x, from_x)


def seen(traj: LinearTrajectory, known: Array) -> Split:
    r"""Return the errors at the start that the outputs determine.

    The outputs do not determine the motions `known`.

    `known` has the shape (nx, k). The factor of the observability Gramian obeys
    :math:`O_i = [C_i; O_{i+1} \Phi_i]`, with the outputs at the knots.
    """
    duration = float(traj.t[-1] - traj.t[0])
    nx = len(traj.state_names)
    to_x, from_x = _units(ends(traj)[0], duration)
    fine = _refined(traj)
    C = fine.C @ to_x
    C = C / ranks.divisors(np.linalg.norm(C, axis=2).max(axis=0))[:, None]
    free = from_x @ transition_matrices(fine)[:, :, :nx] @ to_x
    F = C[-1].T
    for k in reversed(range(len(free))):
        F = _compressed(np.hstack((free[k].T @ F, C[k].T)))
    return _split(traj, F, from_x @ known, to_x, from_x)


def _refined(traj: LinearTrajectory) -> LinearTrajectory:
    """Return the trajectory with at least nx intervals, so that few knots do not limit a rank."""
    traj.refuse_switches("controllability and observability along a motion")
    intervals = len(traj.t) - 1
    nx = len(traj.state_names)
    if traj.dt or intervals >= nx:
        return traj
    parts = intervals * math.ceil(nx / intervals)
    return along(traj.resampled((traj.t[-1] - traj.t[0]) / parts), traj.partition)


def _units(lin: LinearModel, duration: float) -> tuple[Array, Array]:
    """Return maps between states and units of energy, with the duration as the unit of time."""
    nv = len(lin.M)
    to_x, from_x = mechanics.energy_units(lin.M, lin.A[:nv, nv:])
    stretch = np.repeat((duration, 1.0), nv)
    return to_x * stretch, from_x / stretch[:, None]


def _compressed(F: Array) -> Array:
    """Return a factor (nx, nx) with the same F F^T, if F has many columns."""
    if F.shape[1] <= _WIDEST * len(F):
        return F
    triangle: Array = np.linalg.qr(F.T)[1]
    return triangle.T


def _split(
    traj: LinearTrajectory, F: Array, known: Array, to_x: Array, from_x: Array
) -> Split:
    """Split the state space by the singular values of F, apart from the columns of `known`.

    All arguments are in units of energy.
    """
    nv = len(F) // 2
    size = float(np.linalg.norm(F, 2)) if F.size else 0.0
    units = known / np.linalg.norm(known, axis=0)
    basis = np.eye(len(F))
    if known.size:
        basis = np.linalg.qr(units, mode="complete")[0]
    taken, others = np.split(basis, [known.shape[1]], axis=1)
    left, values, _ = np.linalg.svd(others.T @ F)
    values = np.pad(values, (0, len(left) - len(values)))
    # F has no part in the known directions. What it has there shows its accuracy, and so do the
    # errors of the given motion. Knots that `_refined` adds are on the curves between the given
    # knots, on which the matrices are evaluated anyway, so their errors do not count.
    leak = float(np.linalg.norm(taken.T @ F)) / max(size, 1e-300)
    error = max(ACCURACY, leak, float(traj.interval_errors.max()))
    tolerance = ranks.SAFETY * error * max(size, 1e-300)
    rank = int((values > tolerance).sum())
    margin = ranks.judged(values / tolerance, others @ left, rank)
    return Split(
        image=others @ left[:, :rank],
        rest=others @ left[:, rank:],
        to_x=to_x,
        from_x=from_x,
        margin=margin.transformed(to_x[nv:, nv:], halved=True),
    )
