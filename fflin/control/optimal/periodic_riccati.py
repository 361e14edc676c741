"""Periodic Riccati equations: stabilising solutions by doubling of the period (17.5)."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np

from fflin.base.errors import StabilizabilityError
from fflin.base.validation import Array
from fflin.control.optimal import differential_riccati as riccati
from fflin.dynamics.integrators import GAUSS

# The period is doubled until the cost matrix changes by at most this, relative to its norm. After
# 2^60 periods, a cost that still grows belongs to a mode that the inputs cannot stabilise.
_STANDS, _MOST_DOUBLINGS = 1e-15, 60

# If the change is below this and no longer decreases, it is rounding error. A mode that neither
# decays nor costs anything doubles this error with every doubling.
_ROUNDED = 1e-11

# Largest accepted relative difference between P at both ends of a period.
_CLOSED = 1e-9

# Largest number of Newton steps that reduce rounding errors after the doubling, and the binary
# logarithm of the number of periods over which each of them sums errors.
_NEWTON_STEPS, _PERIODS = 4, 20


def sample_transition(weights: Array, whole: Array) -> Array:
    """Return T, G and W (3, nx, nx) of a sample, as `differential_riccati.transitions` does.

    `weights` (nx + nu, nx + nu) is the cost matrix of the sample for the error and the input, and
    `whole` (nx, nx + nu) maps both to the next error. The cross term of the cost is removed first.
    """
    nx = len(whole)
    A, B = whole[:, :nx], whole[:, nx:]
    N, R = weights[:nx, nx:], weights[nx:, nx:]
    gain = np.linalg.solve(R, np.column_stack((N.T, B.T)))
    of_cross, of_input = gain[:, :nx], gain[:, nx:]
    T = A - B @ of_cross
    G = B @ of_input
    W = weights[:nx, :nx] - N @ of_cross
    return np.array((T, 0.5 * (G + G.T), 0.5 * (W + W.T)))


def over_period(maps: Iterable[Array]) -> Array:
    """Return the transition over all given intervals, the latest interval first."""
    total: Array | None = None
    for one in maps:
        total = one if total is None else riccati.joined(one, total)
    assert total is not None
    return total


def periodic_cost(period: Array) -> Array:
    """Return the stabilising solution P (nx, nx) at the end of a period.

    `period` contains T, G and W of the whole period. The transition over 2, 4, 8 .. periods is
    formed until W no longer changes. Then it is the cost over infinitely many periods.
    """
    scale = _balance(period)
    T, G, W = period
    maps = np.array(
        (
            T * scale / scale[:, None],
            G / np.outer(scale, scale),
            W * np.outer(scale, scale),
        )
    )
    last_change = np.inf
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(_MOST_DOUBLINGS):
            before = maps[2]
            maps = riccati.joined(maps, maps)
            size = max(float(np.linalg.norm(maps[2])), 1e-300)
            change = float(np.linalg.norm(maps[2] - before)) / size
            if not np.isfinite(change):
                break
            if last_change <= _ROUNDED and change >= last_change:
                return _in_units(before, scale)
            if change <= _STANDS:
                return _in_units(maps[2], scale)
            last_change = change
    raise np.linalg.LinAlgError("the cost grows from period to period")


def _in_units(W: Array, scale: Array) -> Array:
    """Return the cost (nx, nx) in the original units of the states."""
    P: Array = W / np.outer(scale, scale)
    return P


def _balance(period: Array) -> Array:
    """Return units (nx,) of the states in which T, G and W have entries of similar size."""
    _, G, W = period
    costs = np.sqrt(np.maximum(np.abs(W.diagonal()), 1e-300))
    reach = np.sqrt(np.maximum(np.abs(G.diagonal()), 1e-300))
    known = (np.abs(W.diagonal()) > 0.0) & (np.abs(G.diagonal()) > 0.0)
    return np.where(known, np.sqrt(reach / costs), 1.0)


def repeated(
    sweep: Callable[[Array], tuple[Array, Array]], P: Array, remedy: str
) -> Array:
    """Return P at the end of a period, after steps that reduce its errors.

    For P at the end of the period, `sweep` returns P at its start, and the transition matrix of the
    closed loop over the period. Newton steps end if they no longer reduce the difference.
    """
    start, loop = sweep(P)
    apart = _difference(start, P)
    for _ in range(_NEWTON_STEPS):
        if apart <= _STANDS:
            break
        corrected: Array = P + _summed(loop, start - P)
        if not np.isfinite(corrected).all():
            corrected = start
        start_after, loop_after = sweep(corrected)
        apart_after = _difference(start_after, corrected)
        if not apart_after < apart:
            break
        P, start, loop, apart = corrected, start_after, loop_after, apart_after
    if not apart <= _CLOSED:
        raise StabilizabilityError(
            f"P differs by {apart:.1e} after one period, expected at most {_CLOSED:g}; {remedy}"
        )
    return P


def _difference(start: Array, P: Array) -> float:
    """Return the difference between P at both ends of a period, relative to the norm of P."""
    size = max(float(np.linalg.norm(P)), 1e-300)
    return float(np.linalg.norm(start - P)) / size


def _summed(loop: Array, defect: Array) -> Array:
    """Return the correction X = loop' X loop + defect (nx, nx) of a Newton step, by doubling.

    The doubling ends if X no longer changes. It also ends after 2^_PERIODS periods, because a mode
    that does not decay adds its rounding errors in every period.
    """
    total = defect
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(_PERIODS):
            added = loop.T @ total @ loop
            total = total + added
            loop = loop @ loop
            if np.linalg.norm(added) <= _STANDS * np.linalg.norm(total):
                break
    X: Array = 0.5 * (total + total.T)
    return X


def interval_maps(at: Callable[[Array], Array], times: Array) -> Array:
    """Return T, G and W (k, 3, nx, nx) between successive times."""
    maps = list[Array]()
    for first in range(0, len(times) - 1, _BATCH):
        knots = times[first : first + _BATCH + 1]
        h = np.diff(knots)
        nodes = [at(knots[:-1] + node * h) for node in GAUSS]
        maps.append(riccati.transitions(nodes[0], nodes[1], h).swapaxes(0, 1))
    return np.concatenate(maps)


_BATCH = 64


def loop_factors(maps: Array, P: Array) -> Array:
    """Return the transition matrices (k, nx, nx) of the closed loop over the intervals.

    `maps` (k, 3, nx, nx) are T, G and W, and `P` (k + 1, nx, nx) the costs at the times.
    """
    T, G = maps[:, 0], maps[:, 1]
    factors: Array = np.linalg.solve(np.eye(T.shape[-1]) + G @ P[1:], T)
    return factors
