"""Second computations of the values of goals, for the report."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
from scipy.linalg import expm, solve_continuous_lyapunov

from fflin.base.validation import Array, Values
from fflin.control.optimal.disk import Loop, largest_scaled_gain
from fflin.control.optimal.largest_gain import gain_crossings
from fflin.tuning.channels import Channel, Ends
from fflin.tuning.closed_loop import ClosedLoop
from fflin.tuning.criteria import powers, scaled, weights_at
from fflin.tuning.goals import Goal, Margin, MaxGain, RollOff, Track, Variance
from fflin.tuning.weights import Weight

# Relative accuracy of a largest gain, and how often its level is raised at most.
_ACCURACY, _LEVELS = 1e-8, 60

# Frequencies of a sweep of a sampled loop with a weight that depends on frequency.
_SWEEP = 4000

# Least and largest number of instants of a step response, and the largest product of their distance
# and a pole. Between two instants, the oscillation of this pole rises by at most 0.13 %.
_STEPS, _TURN = (4000, 100_000), 0.1

# Goals whose value is a largest gain over frequency.
_GAINS = (MaxGain, RollOff, Margin)

System = tuple[Array, Array, Array, Array]


def second_value(
    goal: Goal, ends: Ends | None, channel: Channel | None, loop: ClosedLoop
) -> float | None:
    """Return the value of a goal by a second method; None for goals of poles.

    Gains follow from eigenvalues of Hamiltonian matrices, instead of a search over frequencies.
    Margins use the best scaling at each frequency. Variances follow from the Gramian of
    observability, and step responses from matrix exponentials.
    """
    if ends is None or channel is None:
        return None
    system = loop.system(channel)
    if isinstance(goal, Margin):
        peak, _, _ = largest_scaled_gain(Loop(*system))
        return goal.disk * peak
    if isinstance(goal, Variance):
        A, B, C, _ = system
        deviations = []
        for row in C:
            Q = solve_continuous_lyapunov(A.T, -np.outer(row, row))
            deviations.append(math.sqrt(max(float(np.trace(B.T @ Q @ B)), 0.0)))
        return max(deviations)
    if isinstance(goal, Track):
        return _step_ratio(goal, system, loop.plant.dt)
    assert isinstance(goal, MaxGain | RollOff)
    low, high = (loop.plant.warped(end) for end in ends.band)
    constant = len(ends.weight.denominator) == 1
    if loop.plant.dt and not constant:
        return _swept(loop, system, ends, low, high)
    return largest_in_band(weighted(system, ends.weight), low, high)[0]


def peak_above(
    goal: Goal,
    ends: Ends | None,
    channel: Channel | None,
    loop: ClosedLoop,
    scaling: Array,
    level: float,
) -> tuple[float, float] | None:
    """Return the largest gain of a goal and its frequency [rad/s] if it exceeds a level.

    The eigenvalues of one Hamiltonian matrix contain all frequencies at which a gain equals the
    level. The result is None if the gain is below, or if the goal is not a gain.
    """
    if channel is None or ends is None or not isinstance(goal, _GAINS):
        return None
    plant = loop.plant
    if plant.dt and len(ends.weight.denominator) > 1:
        return None
    factors = np.exp(scaling) if isinstance(goal, Margin) else None
    system = weighted(scaled(loop.system(channel), factors), ends.weight)
    low, high = (plant.warped(end) for end in ends.band)
    crossings, on_axis = gain_crossings(*system, level)
    found = np.abs(crossings.imag[on_axis])
    if not ((found > low) & (found < high)).any():
        return None
    largest, frequency = largest_in_band(system, low, high)
    return (largest, plant.time(frequency)) if largest > level else None


def weighted(system: System, weight: Weight) -> System:
    """Return a system whose outputs pass a weight."""
    A, B, C, D = system
    a, b, c, d = weight.state_space()
    m, n = len(C), len(a)
    unit = np.eye(m)
    Aw, Bw = np.kron(unit, a), np.kron(unit, b)
    Cw, gain = np.kron(unit, c), float(d[0, 0])
    return (
        np.block([[A, np.zeros((len(A), m * n))], [Bw @ C, Aw]]),
        np.vstack((B, Bw @ D)),
        np.hstack((gain * C, Cw)),
        gain * D,
    )


def largest_in_band(system: System, low: float, high: float) -> tuple[float, float]:
    """Return the largest gain of a stable system in a band of frequencies, and its frequency."""
    A, B, C, D = system

    def gain(w: float) -> tuple[float, float]:
        response: Values = D.astype(complex)
        if math.isfinite(w):
            response = D + C @ np.linalg.solve(1j * w * np.eye(len(A)) - A, B)
        return float(np.linalg.norm(response, 2)), w

    sizes = np.abs(np.linalg.eigvals(A))
    inside = sizes[(sizes > low) & (sizes < high)]
    best = max(gain(w) for w in (low, high, *inside.tolist()))
    for _ in range(_LEVELS):
        if best[0] < 1e-100:
            return best
        level = best[0] * (1.0 + _ACCURACY)
        crossings, on_axis = gain_crossings(A, B, C, D, level)
        found = np.abs(crossings.imag[on_axis])
        found = np.sort(found[(found > low) & (found < high)])
        limits = [low, *found.tolist(), high]
        middles = [_middle(a, b) for a, b in pairwise(limits)]
        highest = max(gain(w) for w in (*middles, *found.tolist()))
        if highest[0] <= level:
            return best
        best = highest
    return best


def _middle(low: float, high: float) -> float:
    """Return a frequency between two others, of which the second may be infinite."""
    if math.isinf(high):
        return 2.0 * low + 1.0
    return 0.5 * (low + high)


def _swept(
    loop: ClosedLoop, system: System, ends: Ends, low: float, high: float
) -> float:
    """Return the largest weighted gain at many frequencies of a sampled loop."""
    A, B, C, D = system
    dt = loop.plant.dt
    times = np.concatenate(
        (np.geomspace(1e-6, 1.0, _SWEEP), np.linspace(0.0, 1.0, _SWEEP))
    )
    frequencies = np.tan(0.5 * math.pi * np.unique(times) * (1.0 - 1e-12)) * 2.0 / dt
    frequencies = frequencies[(frequencies >= low) & (frequencies <= high)]
    largest = 0.0
    weights = weights_at(loop, ends, frequencies)
    for w, weight in zip(frequencies.tolist(), weights.tolist(), strict=True):
        response = D + C @ np.linalg.solve(1j * w * np.eye(len(A)) - A, B)
        largest = max(largest, weight * float(np.linalg.norm(response, 2)))
    return largest


def _step_ratio(goal: Track, system: System, dt: float) -> float:
    """Return the largest ratio of the error of a step response to its template."""
    times, errors = step_errors(goal, system, dt)
    low, high = goal.bounds(times)
    ratios = np.where(errors > 0.0, errors / high, errors / low)
    largest = float(ratios[1:].max())
    if dt:
        return largest
    # Peaks between the instants follow from parabolas, unless the template changes there.
    same = (high[2:] == high[:-2]) & (low[2:] == low[:-2])
    before, middle, after = ratios[:-2], ratios[1:-1], ratios[2:]
    is_peak = same & (middle > before) & (middle >= after)
    before, middle, after = before[is_peak], middle[is_peak], after[is_peak]
    rises = (after - before) ** 2 / (8.0 * (2.0 * middle - before - after))
    return max(largest, float((middle + rises).max(initial=0.0)))


def step_errors(goal: Track, system: System, dt: float) -> tuple[Array, Array]:
    """Return times [s] and the errors y - 1 of a unit step of the reference."""
    A, B, C, D = system
    n = len(A)
    rows: Array = C
    through: Array = D
    if dt:
        h = dt
        rate = 2.0 / dt
        inverse = np.linalg.inv(rate * np.eye(n) - A)
        factor = math.sqrt(2.0 * rate)
        advance, drive = (rate * np.eye(n) + A) @ inverse, factor * inverse @ B
        rows, through = factor * C @ inverse, D + C @ inverse @ B
    else:
        fastest = np.abs(np.linalg.eigvals(A)).max(initial=0.0)
        wanted = goal.examined * float(fastest) / _TURN
        steps = min(max(wanted, _STEPS[0]), _STEPS[1])
        # One of the instants is the settling time.
        before = math.ceil(goal.settling / goal.examined * steps)
        h = goal.settling / before
        step = expm(h * np.block([[A, B], [np.zeros((1, n + 1))]]))
        advance, drive = step[:n, :n], step[:n, n:]
    count = max(2, math.ceil(goal.examined / h - 1e-9))
    times = h * np.arange(count + 1)
    states = np.zeros((count + 1, n))
    states[1:] = powers(advance, drive[:, 0], count).cumsum(axis=0)
    errors: Array = -(states @ rows[0] + through[0, 0]) - 1.0
    return times, errors
