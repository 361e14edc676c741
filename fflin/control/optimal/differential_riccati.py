"""Differential Riccati equations, integrated backwards in time; P stays positive semidefinite."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress

import numpy as np
from scipy.linalg import expm, matrix_balance

from fflin.base.errors import InputError
from fflin.base.validation import Array
from fflin.dynamics.integrators import GAUSS, HEAVY, LIGHT

# Between knots, P is a cubic of time. Knots are added until the estimated relative errors of the
# integration and of the cubics are at most this.
_ACCURACY = 1e-7
_KNOTS_LIMIT = 100_000

# Number of intervals per batch. Batches save time, because a NumPy call for many small matrices
# takes little longer than a call for one.
_BATCH = 64


def rate(coefficients: Array, P: Array) -> Array:
    """Return dP/dt = P S P - A' P - P A - Q, with the coefficients A, S = B R^-1 B' and Q."""
    A, S, Q = coefficients
    drift = P @ A
    slope: Array = P @ S @ P - drift - drift.T - Q
    return slope


def joined(early: Array, late: Array) -> Array:
    """Return the transitions over pairs of successive intervals.

    `early` and `late` are the transitions T, G and W over the first and the second interval of each
    pair, see `transitions`.
    """
    (T, G, W), (T_late, G_late, W_late) = early, late
    n = T.shape[-1]
    # Eliminate the state x and the costate l between the intervals. With l = W_late x + T_late' l1,
    # the state is x = forward x0 - back l1, where (I + G W_late) [forward, back] = [T, G T_late'].
    right = np.concatenate((T, G @ T_late.mT), axis=-1)
    inner = np.linalg.solve(np.eye(n) + G @ W_late, right)
    forward, back = inner[..., :n], inner[..., n:]
    G_both = G_late + T_late @ back
    W_both = W + T.mT @ W_late @ forward
    return np.array((T_late @ forward, _symmetric(G_both), _symmetric(W_both)))


def stepped_back(transition: Array, P: Array) -> Array:
    """Return P at the start of an interval, W + T' P (I + G P)^-1 T, from P at its end."""
    T, G, W = transition
    forward = np.linalg.solve(np.eye(len(P)) + G @ P, T)
    costate = P @ forward
    # Every term is positive semidefinite, so P stays positive semidefinite.
    return _symmetric(W + forward.T @ costate + costate.T @ G @ costate)


def transitions(early: Array, late: Array, h: Array) -> Array:
    r"""Return fourth-order transitions over k intervals, from coefficients at the Gauss nodes.

    The coefficients (3, k, nx, nx) are A, S and Q at the `early` and at the `late` node. `h` (k,)
    contains the lengths of the intervals. The transitions (3, k, nx, nx) are T, G and W.

    Let an interval start with the state x0 and the costate l0, and end with x1 and l1. Then the
    Hamiltonian system has the solution ``x1 = T x0 - G l1`` and ``l0 = W x0 + T' l1``. In a short
    interval, G and W are positive semidefinite.
    """
    mixed = np.concatenate(
        (HEAVY * early + LIGHT * late, LIGHT * early + HEAVY * late), axis=1
    )
    both = _constant(mixed, 0.5 * np.concatenate((h, h)))
    return joined(both[:, : len(h)], both[:, len(h) :])


def _constant(coefficients: Array, h: Array) -> Array:
    """Return the transitions over times h (k,) for constant coefficients.

    A matrix exponential gives the transitions over a fraction of h. The fraction is then doubled
    until it is 1.
    """
    A, S, Q = coefficients
    n, (a, s, q) = A.shape[-1], np.abs(coefficients).max(axis=1)
    sizes = np.block([[a, s], [q, a.T]])
    if not sizes.max() < 1e300:
        raise np.linalg.LinAlgError("the coefficients are too large")
    # Scale the states so that rows and columns of the Hamiltonian matrix have similar sizes. The
    # costates get the inverse scales.
    _, (scale, _) = matrix_balance(sizes, permute=False, separate=True)
    unit = np.sqrt(scale[:n] / scale[n:])
    of_costs = np.outer(unit, unit)
    of_states = unit / unit[:, None]
    A, S, Q = A * of_states, S / of_costs, Q * of_costs
    H = np.block([[A, -S], [-Q, -A.mT]]) * h[:, None, None]
    size = float(np.abs(H).sum(axis=-2).max())
    doublings = max(0, math.ceil(math.log2(max(size, 1.0))))
    theta = expm(H / 2**doublings)
    inverse = np.linalg.inv(theta[:, n:, n:])
    G, W = -theta[:, :n, n:] @ inverse, -inverse @ theta[:, n:, :n]
    maps = np.array((inverse.mT, _symmetric(G), _symmetric(W)))
    for _ in range(doublings):
        maps = joined(maps, maps)
    T, G, W = maps
    return np.array((T / of_states, G * of_costs, W / of_costs))


# An interval: the times of its start and end, the transitions over the whole interval, its first
# half and its second half, and the coefficients at both ends.
_Interval = tuple[float, float, Array, Array]


def _intervals(at: Callable[[Array], Array], knots: Array) -> list[_Interval]:
    """Return the k intervals between knots (k + 1,), with transitions and coefficients."""
    start = knots[:-1]
    end = knots[1:]
    middle = 0.5 * (start + end)
    count = len(start)
    # Steps: all whole intervals, then all first halves, then all second halves.
    step_starts = np.concatenate((start, start, middle))
    step_ends = np.concatenate((end, middle, end))
    h = step_ends - step_starts
    early_times = step_starts + GAUSS[0] * h
    late_times = step_starts + GAUSS[1] * h
    coefficients = at(np.concatenate((early_times, late_times, knots)))
    early, late, at_knots = np.split(coefficients, (3 * count, 6 * count), axis=1)
    maps = transitions(early, late, h)
    # from the axes (T, G or W; step) to (T, G or W; whole, first or second half; interval)
    maps = maps.reshape(3, 3, count, *coefficients.shape[2:])
    of_interval = maps.swapaxes(0, 2)
    at_knots = at_knots.swapaxes(0, 1)
    times = knots.tolist()
    return [
        (times[k], times[k + 1], of_interval[k], at_knots[k : k + 2])
        for k in range(count)
    ]


def _halves(at: Callable[[Array], Array], interval: _Interval) -> list[_Interval]:
    """Split an interval into halves, and reuse their known transitions."""
    start, end, (_, early_half, late_half), (at_start, at_end) = interval
    knots = np.linspace(start, end, 5)
    middle = float(knots[2])
    h = np.diff(knots)
    early_times = knots[:-1] + GAUSS[0] * h
    late_times = knots[:-1] + GAUSS[1] * h
    coefficients = at(np.concatenate((early_times, late_times, [middle])))
    quarters = transitions(coefficients[:, :4], coefficients[:, 4:8], h).swapaxes(0, 1)
    at_middle = coefficients[:, 8]
    first = np.array((early_half, quarters[0], quarters[1]))
    second = np.array((late_half, quarters[2], quarters[3]))
    return [
        (start, middle, first, np.array((at_start, at_middle))),
        (middle, end, second, np.array((at_middle, at_end))),
    ]


def solve_back(
    at: Callable[[Array], Array], knots: Array, P: Array
) -> tuple[Array, Array]:
    """Integrate backwards from P at the last knot, and return the times and the values of P.

    The function `at` returns the coefficients (3, k, nx, nx) at times (k,). If P changes too fast,
    raise `LinAlgError`.
    """
    steps = [*_steps_back(at, knots, P)][::-1]
    times = [time for time, _, _ in steps]
    values = [value for _, value, _ in steps]
    return np.array([*times, knots[-1]]), np.array([*values, P])


def accurate_maps(
    at: Callable[[Array], Array], knots: Array, P: Array
) -> tuple[Array, Array]:
    """Return the times of `solve_back`, and T, G and W (k, 3, nx, nx) between successive times."""
    steps = [*_steps_back(at, knots, P)][::-1]
    times = [time for time, _, _ in steps]
    maps = [transition for _, _, transition in steps]
    return np.array([*times, knots[-1]]), np.array(maps)


def _steps_back(
    at: Callable[[Array], Array], knots: Array, P: Array
) -> Iterator[tuple[float, Array, Array]]:
    """Yield the time, P and the transitions T, G and W of each accurate step, the latest first."""
    count = 0
    for last in range(len(knots) - 1, 0, -_BATCH):
        # Intervals still to be integrated; the latest interval is the last entry.
        pending = _intervals(at, knots[max(last - _BATCH, 0) : last + 1])
        while pending:
            interval = pending.pop()
            start, end, (whole, early, late), (at_start, at_end) = interval
            middle = 0.5 * (start + end)
            error = math.inf
            # The coefficients of a long step may be indefinite, because beta in (10.3) is negative.
            # The step may then fail, and shorter steps are tried.
            with suppress(np.linalg.LinAlgError):
                single, half = stepped_back(whole, P), stepped_back(late, P)
                double = stepped_back(early, half)
                # `between` is the Hermite cubic of P at the middle of the interval.
                bend = rate(at_start, double) - rate(at_end, P)
                between = 0.5 * (double + P) + 0.125 * (end - start) * bend
                # The method has fourth order, so the error of two half steps is a fifteenth of
                # their difference from one whole step. The error of the cubics over the half
                # intervals is a sixteenth of the error of the cubic over the whole interval. To be
                # safe, a quarter is assumed in both cases.
                error = 0.25 * max(_apart(double, single), _apart(half, between))
            if error <= _ACCURACY:
                yield middle, half, late
                yield start, double, early
                P = double
                count += 2
            elif count >= _KNOTS_LIMIT or not start < middle < end:
                raise np.linalg.LinAlgError("P changes too fast")
            else:
                pending += _halves(at, interval)


def samples_back(
    stages: Iterable[tuple[Array, Array]], P: Array
) -> tuple[Array, Array, float]:
    """Return K of all samples, P at all sample times, and the largest relative residual.

    K and P begin with the last sample. The first P is the argument `P`.
    """
    # Each stage has two matrices. The first (nx + nu, nx + nu) is the cost matrix for the error at
    # the start of a sample and the input. The second (nx, nx + nu) maps this error and the input to
    # the next error.
    nx = len(P)
    gains = list[Array]()
    costs = [P]
    worst = 0.0
    for weights, whole in stages:
        total = weights + whole.T @ P @ whole
        K = np.linalg.solve(total[nx:, nx:], total[nx:, :nx])
        # `total` is positive semidefinite, so this form keeps P positive semidefinite.
        law = np.vstack((np.eye(nx), -K))
        P = _symmetric(law.T @ total @ law)
        if not np.isfinite(P).all():
            raise np.linalg.LinAlgError("P changes too fast")
        worst = max(
            worst, imbalance(np.array((P, -total[:nx, :nx], total[:nx, nx:] @ K)))
        )
        gains.append(K)
        costs.append(P)
    return np.array(gains), np.array(costs), worst


@contextmanager
def bounded_by(remedy: str) -> Iterator[None]:
    """Replace a `LinAlgError` of the integration by an `InputError` that recommends `remedy`."""
    try:
        # NumPy's warnings are not needed, because an overflow of P raises an error.
        with np.errstate(over="ignore", invalid="ignore"):
            yield
    except np.linalg.LinAlgError:
        raise InputError(
            f"P of the Riccati equation changes too fast to be integrated; give {remedy}"
        ) from None


def imbalance(terms: Array) -> float:
    """Return the largest norm of a sum of matrices, relative to the sum of the norms of its terms.

    `terms` (k, .., n, n) contains the k terms of each sum.
    """
    size = np.linalg.norm(terms, axis=(-2, -1)).sum(axis=0)
    sums = np.linalg.norm(terms.sum(axis=0), axis=(-2, -1))
    return float((sums / np.maximum(size, 1e-300)).max())


def _apart(first: Array, second: Array) -> float:
    return float(np.linalg.norm(first - second)) / max(
        float(np.linalg.norm(second)), 1e-300
    )


def _symmetric(matrix: Array) -> Array:
    return 0.5 * (matrix + matrix.mT)
