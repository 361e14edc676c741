r"""Upper bounds of gains over all values of real uncertain parameters.

For the response M from (w, d) to (z, e) with w = Delta z, a bound b holds if scalings d > 0 and g
of the channels satisfy, at each frequency,

.. math:: X^H X + j (H X - X^H H) \le 1,\quad X = D M_b D^{-1},

where M_b is M with the rows of e divided by b, D = diag(d), H = diag(h), and h is zero for e. See
M. K. H. Fan, A. L. Tits and J. C. Doyle, IEEE Transactions on Automatic Control 36(1), 1991. One
scaling is used for a whole interval of frequencies, because the bound of real parameters can be a
discontinuous function of the frequency.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from fflin.base.validation import Array, Mask, Values

# Frequencies of an interval at which its scaling is examined.
_INSIDE = 5

# Steps of a search for a scaling, and how often an interval is halved until the bound is raised.
_STEPS, _HALVINGS = 60, 4

# Largest number of searches without a scaling.
_FAILURES = 60

# Factors by which a bound is raised at first and later, and the largest ratio to the given level.
_FIRST, _RAISE, _LARGEST = (1.001, 1.01, 1.02, 1.05), 1.1, 20.0

# Smallest relative size of an entry in the scalings of the start.
_LEAST = 1e-9

# Steps of the iteration for the scalings of the start.
_BALANCING = 30


class Channels(NamedTuple):
    """Square response M(w) (n, m, m) at frequencies (n,) [rad/s] with its channels.

    The first `parameters` channels belong to real parameters. `group` contains a number for each of
    the other channels; channels with equal numbers have one common scaling.
    """

    response: Callable[[Array], Values]
    parameters: int
    group: Array


class Scaling(NamedTuple):
    """Logarithms of d, and h, of all channels (m,)."""

    log_d: Array
    h: Array


class Bound(NamedTuple):
    """Upper bound of a gain; if it is infinite, the frequency [rad/s] near which none was found."""

    value: float
    missing: float = math.nan


def gain_bound(channels: Channels, rates: Array, level: float) -> Bound:
    """Return an upper bound of the gain from d to e over all parameters, at least `level`.

    Parameters
    ----------
    channels : Channels
    rates : ndarray (k,)
        Frequencies [rad/s] that separate the first intervals.
    level : float
        Least bound that is tried, such as the largest gain that a search found.

    Returns
    -------
    Bound
        Bound; infinite if no bound below 20 times `level` was found in a limited number of
        searches. Each interval of frequencies is examined at five frequencies.
    """
    edges = [0.0, *np.unique(rates[rates > 0.0]).tolist(), math.inf]
    waiting = [(a, b, 0) for a, b in pairwise(edges)][::-1]
    known: Scaling | None = None
    bound = level
    raises = list(_FIRST)
    failures = 0
    while waiting:
        a, b, halved = waiting.pop()
        responses = _within(channels, a, b)
        scaling, holds = _scaling_for(channels, responses, bound, known)
        if holds:
            known = scaling
            continue
        failures += 1
        if failures > _FAILURES:
            return Bound(math.inf, a)
        if halved < _HALVINGS and math.isfinite(b):
            middle = 0.5 * (a + b)
            waiting += [(middle, b, halved + 1), (a, middle, halved + 1)]
            continue
        bound *= raises.pop(0) if raises else _RAISE
        if bound > _LARGEST * level:
            return Bound(math.inf, a)
        waiting.append((a, b, halved))
    return Bound(bound)


def _within(channels: Channels, low: float, high: float) -> Values:
    """Return the responses at frequencies of an interval."""
    if math.isinf(high):
        return channels.response(np.array([low, 3.0 * low, 30.0 * low, math.inf]))
    return channels.response(np.linspace(low, high, _INSIDE))


def _scaling_for(
    channels: Channels, responses: Values, bound: float, known: Scaling | None
) -> tuple[Scaling, bool]:
    """Return a scaling for a bound, and whether the bound holds at all responses."""
    count = channels.parameters
    rows = np.ones(responses.shape[-1])
    rows[count:] = 1.0 / bound
    M = rows[:, None] * responses
    starts = [_balanced(M, channels)]
    if known is not None:
        starts.insert(0, known)
    results = []
    for start in starts:
        value, _, _ = _largest(M, start)
        if value <= 1.0:
            return start, True
        results.append((value, start))
    results.sort(key=lambda result: result[0])
    for _, start in results:
        scaling, value = improved(M, start, count, channels.group, 1.0)
        if value <= 1.0:
            return scaling, True
    return results[0][1], False


def _balanced(M: Values, channels: Channels) -> Scaling:
    """Return scalings from the Perron vectors of the largest sizes of the entries."""
    sizes = np.abs(M).max(axis=0)
    sizes = sizes + _LEAST * sizes.max() + 1e-300
    right = left = np.ones(len(sizes))
    for _ in range(_BALANCING):
        right, left = sizes @ right, sizes.T @ left
        right, left = right / right.max(), left / left.max()
    log_d = 0.5 * np.log(left / right)
    return Scaling(_with_groups(log_d, channels), np.zeros(len(sizes)))


def _with_groups(log_d: Array, channels: Channels) -> Array:
    """Return logarithms of scalings that are equal in each group."""
    result = log_d.copy()
    others = log_d[channels.parameters :]
    for number in np.unique(channels.group):
        members = np.flatnonzero(channels.group == number)
        result[channels.parameters + members] = others[members].mean()
    return result


def _largest(M: Values, scaling: Scaling) -> tuple[float, Array, Array]:
    """Return the largest eigenvalue for a scaling, and its derivatives by log d and h."""
    h = scaling.h
    ratios = scaling.log_d[:, None] - scaling.log_d
    # A step of the line search can be too long.
    with np.errstate(all="ignore"):
        X = np.exp(ratios) * M
        turned = h[:, None] * X
        form = X.conj().mT @ X + 1j * (turned - turned.conj().mT)
    if not np.isfinite(form).all():
        return math.inf, np.zeros(len(h)), np.zeros(len(h))
    sizes, vectors = np.linalg.eigh(form)
    at = int(sizes[:, -1].argmax())
    X, v = X[at], vectors[at][:, -1]
    w = X @ v
    back = X.conj().T @ (w - 1j * h * v)
    of_log_d = 2.0 * (np.abs(w) ** 2 - (back.conj() * v).real)
    of_log_d = of_log_d + 2.0 * (1j * v.conj() * h * w).real
    of_h = -2.0 * (v.conj() * w).imag
    return float(sizes[at, -1]), of_log_d, of_h


def improved(
    M: Values, start: Scaling, count: int, group: Array, target: float
) -> tuple[Scaling, float]:
    """Return a scaling of matrices M (n, m, m) with a smaller largest eigenvalue of the form.

    The first `count` channels belong to real parameters, and `group` is as in `Channels`. The
    search ends if the eigenvalue is at most `target`.
    """
    from scipy.optimize import minimize

    groups: list[Mask] = [
        np.concatenate((np.zeros(count, bool), group == number))
        for number in np.unique(group)
    ]
    best = start, math.inf

    def scaling_of(x: Array) -> Scaling:
        log_d, h = np.zeros(len(start.log_d)), np.zeros(len(start.h))
        log_d[:count], h[:count] = x[:count], x[count : 2 * count]
        for members, value in zip(groups, x[2 * count :], strict=True):
            log_d[members] = value
        return Scaling(log_d, h)

    def value(x: Array) -> tuple[float, Array]:
        nonlocal best
        scaling = scaling_of(x)
        largest, of_log_d, of_h = _largest(M, scaling)
        if largest < best[1]:
            best = scaling, largest
        if best[1] <= target:
            raise StopIteration
        shared = [float(of_log_d[members].sum()) for members in groups]
        return largest, np.concatenate((of_log_d[:count], of_h[:count], shared))

    first = [float(start.log_d[members][0]) for members in groups]
    x0 = np.concatenate((start.log_d[:count], start.h[:count], first))
    with suppress(StopIteration):
        minimize(value, x0, jac=True, method="BFGS", options={"maxiter": _STEPS})
    return best
