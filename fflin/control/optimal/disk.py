"""Structured singular values of complex uncertainty in separate channels, over frequency.

A loop is a stable system M(s) = J + H (s E - F)^-1 G from the perturbations of n channels to the
signals that they perturb. The perturbation is diagonal, with one complex number for each channel.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from fflin.base.validation import Array, Values
from fflin.control.optimal.largest_gain import gain_crossings

# Relative accuracy of the largest structured singular value over frequency. With more than three
# channels it is a bound that differs from the value by more than this, and the search takes longer.
ACCURACY = 1e-7
_ACCURACY_OF_MANY = 1e-4

# The scalings of one matrix are improved until their bound falls by less than this in a step.
_CENTRED = 1e-10
_CENTRES = 60
_NEWTON = 30

# The search over frequency ends after _DIVISIONS intervals. An interval narrower than _NARROW times
# its frequency is not divided. It starts at frequencies of poles that are apart
# by the factor _APART.
_DIVISIONS = 400
_NARROW = 1e-9
_APART = 1.05
# The local maximum near one of them is at most this factor away from it.
_REACH = 10.0

# Phases of the perturbations from which their search starts, in each channel.
_PHASES = 8
# Random starts of this search if the channels are many.
_STARTS = 24
# It ends at a value that is less than this fraction below the upper bound.
_REACHED = 1e-9


class Loop(NamedTuple):
    """Stable continuous-time system J + H (s E - F)^-1 G with as many inputs as outputs."""

    F: Array
    G: Array
    H: Array
    J: Array

    def at(self, frequency: float) -> Values:
        """Return the response (n, n) at a frequency [rad/s]; may be infinite."""
        if np.isinf(frequency):
            return self.J.astype(complex)
        inner = 1j * frequency * np.eye(len(self.F)) - self.F
        response: Values = self.J + self.H @ np.linalg.solve(inner, self.G)
        return response

    def channel(self, index: int) -> Loop:
        """Return the loop of one channel, with the other channels unperturbed."""
        return Loop(
            self.F,
            self.G[:, index : index + 1],
            self.H[index : index + 1],
            self.J[index : index + 1, index : index + 1],
        )

    def scaled(self, d: Array) -> Loop:
        """Return the loop D M D^-1 with D = diag(d)."""
        return Loop(self.F, self.G / d, d[:, None] * self.H, d[:, None] * self.J / d)


def as_continuous(F: Array, G: Array, H: Array, J: Array, dt: float) -> Loop:
    """Return the loop of a stable system that is sampled at dt [s], or continuous if dt is 0.

    The bilinear map s = (z - 1)/(z + 1) preserves the values of the response, at the frequencies
    tan(w dt / 2).
    """
    if not dt:
        return Loop(F, G, H, J)
    unit = np.eye(len(F))
    inverse = np.linalg.inv(F + unit)
    factor = 2.0**0.5
    return Loop(
        inverse @ (F - unit),
        factor * inverse @ G,
        factor * H @ inverse,
        J - H @ inverse @ G,
    )


def disk_margin(peak: float) -> float:
    """Return the disk margin, at most 2, of a largest structured singular value."""
    return min(1.0 / peak, 2.0) if peak else 2.0


def disk_gain(disk: float) -> tuple[float, float]:
    """Return the gain factors in a disk."""
    most = math.inf
    if disk < 2.0:
        most = (2.0 + disk) / (2.0 - disk)
    return (2.0 - disk) / (2.0 + disk), most


def disk_phase(disk: float) -> float:
    """Return the phase [deg] in a disk."""
    return math.degrees(2.0 * math.atan(disk / 2.0))


class Peak(NamedTuple):
    """Largest structured singular value over frequency.

    Attributes
    ----------
    bound : float
        Upper bound that holds at all frequencies.
    frequency : float
        Frequency [rad/s] of the largest value; may be infinite.
    reached : float
        Largest value for which `perturbation` is known: ``reached <= mu <= bound``.
    perturbation : ndarray (n,) of complex
        Perturbation of size ``1 / reached`` with which det(E - M diag(perturbation)) is zero.
    """

    bound: float
    frequency: float
    reached: float
    perturbation: Values


def best_scaling(M: Values, d: Array | None = None) -> tuple[float, Array]:
    """Return the least norm of D M D^-1 over positive diagonal D, and diag(D).

    The norm is an upper bound of the structured singular value, and equal to it for up to three
    channels. See Packard and Doyle, Automatica 29(1), 1993. The logarithms of d minimise
    -log det(t E - N^H N) with N = D M D^-1, which is convex, for values of t that decrease to the
    square of the norm (method of centres, Boyd and El Ghaoui, Linear Algebra and its Applications
    188, 1993).
    """
    count = len(M)
    y = np.zeros(count) if d is None else np.log(d)
    if count == 1:
        return float(np.abs(M[0, 0])), np.ones(1)
    size = float(np.linalg.norm(M))
    if not size:
        return 0.0, np.ones(count)
    M = M / size
    least = _norm(M, y) ** 2
    best = least, y
    t = 1.1 * least + 1e-300
    for _ in range(_CENTRES):
        y = _centre(M, y, t)
        value = _norm(M, y) ** 2
        fell = best[0] - value
        if value < best[0]:
            best = value, y
        following = value + 0.01 * (t - value)
        if t - value <= _CENTRED * value or following >= t:
            break
        if fell < 0.0:
            y = best[1]
        t = following
    least, y = best
    return size * float(np.sqrt(least)), np.exp(y - y.mean())


def _norm(M: Values, y: Array) -> float:
    d = np.exp(y - y.mean())
    return float(np.linalg.norm(d[:, None] * M / d, 2))


def _centre(M: Values, y: Array, t: float) -> Array:
    """Return the minimiser of -log det(t E - N^H N) over y, with N = D M D^-1 and D = e^y."""
    unit = np.eye(len(M))
    value = np.inf
    for _ in range(_NEWTON):
        y = y - y.mean()
        d = np.exp(y)
        N = d[:, None] * M / d
        gram = N.conj().T @ N
        try:
            inverse = np.linalg.inv(np.linalg.cholesky(t * unit - gram))
        except np.linalg.LinAlgError:
            return y
        P = inverse.conj().T @ inverse
        value = 2.0 * float(np.log(np.abs(inverse.diagonal())).sum())
        right = N @ P
        both = right @ N.conj().T
        gradient = 2.0 * (both.diagonal() - t * P.diagonal() + 1.0).real
        # With X = diag(e^(2 y)), S = t X - M^H X M and its derivative C_i = t E_i - m_i^H m_i, the
        # second derivatives are four times the second derivatives of -log det S + sum(2 y) by 2 y.
        cross = np.abs(right) ** 2
        curvature = t * t * np.abs(P) ** 2 - t * (cross + cross.T) + np.abs(both) ** 2
        curvature = 4.0 * (
            curvature + np.diag(both.diagonal().real - t * P.diagonal().real)
        )
        damping = 1e-12 * np.abs(curvature).max() + 1e-300
        try:
            step = -np.linalg.solve(
                curvature + damping * unit + 1e-3 * damping, gradient
            )
        except np.linalg.LinAlgError:
            return y
        decrease = -float(gradient @ step)
        if not decrease > 1e-14 * (1.0 + abs(value)):
            return y
        length = min(1.0, 2.0 / max(np.abs(step).max(), 1e-300))
        for _ in range(40):
            trial = y + length * step
            scaled = np.exp(trial - trial.mean())
            moved = scaled[:, None] * M / scaled
            eigenvalues = np.linalg.eigvalsh(moved.conj().T @ moved)
            if eigenvalues[-1] < t:
                reached = -float(np.log(t - eigenvalues).sum())
                if reached <= value - 1e-4 * length * decrease:
                    break
            length *= 0.5
        else:
            return y
        y = trial
    return y


def worst_perturbation(M: Values, d: Array, bound: float) -> tuple[float, Values]:
    """Return a lower bound r of the structured singular value, and a perturbation of size 1/r.

    The spectral radius of diag(e^(i phase)) M is maximised over the phases. Its maximum is the
    structured singular value. The search starts at the phases of the singular vectors of D M D^-1,
    and at other phases. It ends where the upper bound `bound` is reached.
    """
    from scipy.optimize import minimize

    count = len(M)

    def radius(phases: Array) -> tuple[float, Values]:
        turned = np.exp(1j * phases)[:, None] * M
        values = np.linalg.eigvals(turned)
        largest = values[np.abs(values).argmax()]
        return float(np.abs(largest)), largest

    def cost(phases: Array) -> tuple[float, Array]:
        turned = np.exp(1j * phases)[:, None] * M
        values, right = np.linalg.eig(turned)
        k = int(np.abs(values).argmax())
        value = values[k]
        size = float(np.abs(value))
        if not size:
            return 0.0, np.zeros(count)
        try:
            left = np.linalg.inv(right)[k]
        except np.linalg.LinAlgError:
            return -size, np.zeros(count)
        # d value / d phase_i = left_i (i e^(i phase_i) M)_i right = i value left_i right_i
        rate = (1j * value * left * right[:, k] * np.conj(value)).real / size
        return -size, -rate

    best: tuple[float, Array] = (0.0, np.zeros(count))
    for start in _starts(M, d):
        found = minimize(cost, start, jac=True, method="BFGS", options={"gtol": 1e-12})
        for phases in (start, found.x):
            value = radius(phases)[0]
            if value > best[0]:
                best = value, phases
        if best[0] >= bound * (1.0 - _REACHED):
            break
    value, eigenvalue = radius(best[1])
    if not value:
        return 0.0, np.zeros(count, complex)
    return value, np.exp(1j * best[1]) / eigenvalue


def _starts(M: Values, d: Array) -> Iterator[Array]:
    """Return phases (n,) from which the search of the worst perturbation starts."""
    left, _, right = np.linalg.svd(d[:, None] * M / d)
    for k in range(min(2, len(M))):
        yield np.angle(right[k].conj()) - np.angle(left[:, k])
    values = np.linspace(0.0, 2.0 * np.pi, _PHASES, endpoint=False)
    if len(M) <= 3:
        for rest in np.ndindex(*(len(values),) * (len(M) - 1)):
            yield np.array([0.0, *values[list(rest)]])
    else:
        rng = np.random.default_rng(0)
        yield from rng.uniform(0.0, 2.0 * np.pi, (_STARTS, len(M)))


def largest_structured_gain(loop: Loop) -> Peak:
    """Return the largest structured singular value of a stable loop over all frequencies."""
    value, frequency, d = largest_scaled_gain(loop)
    reached, perturbation = worst_perturbation(loop.at(frequency), d, value)
    return Peak(value, frequency, reached, perturbation)


def _climbed(
    loop: Loop,
    tried: dict[float, tuple[float, Array]],
    best: float,
    frequencies: list[float],
) -> float:
    """Return the frequency [rad/s] of the local maximum of the bound near `best`.

    It lies between the neighbours of `best` among `frequencies` (sorted). What is computed is added
    to `tried`. Without it, the search by intervals approaches the maximum by halves.
    """
    from scipy.optimize import minimize_scalar

    if not 0.0 < best < np.inf:
        return best
    at = frequencies.index(best)
    low = max(frequencies[at - 1], best / _REACH)
    high = min(frequencies[at + 1], best * _REACH)
    d = tried[best][1]

    def cost(logarithm: float) -> float:
        frequency = math.exp(logarithm)
        tried[frequency] = best_scaling(loop.at(frequency), d)
        return -tried[frequency][0]

    limits = math.log(low), math.log(high)
    minimize_scalar(cost, bounds=limits, method="bounded", options={"xatol": 1e-6})
    return max(tried, key=lambda frequency: tried[frequency][0])


def largest_scaled_gain(loop: Loop) -> tuple[float, float, Array]:
    """Return the largest bound of the structured singular value of a stable loop.

    The result also contains the frequency [rad/s] at which it occurs, and the scaling there.

    The value is bounded at a few frequencies near the poles. A fixed scaling then bounds it at all
    frequencies except between the crossings of its gain, which follow from eigenvalues. The
    intervals between crossings are searched in the same way, with the best scaling at their middle.
    """
    poles = np.linalg.eigvals(loop.F)
    starts = {0.0, np.inf, *np.abs(poles).tolist(), *np.abs(poles.imag).tolist()}
    norms = {w: float(np.linalg.norm(loop.at(w), 2)) for w in _thinned(sorted(starts))}
    tried = dict[float, tuple[float, Array]]()
    best = max(norms, key=lambda w: norms[w])
    for w in sorted(norms, key=lambda w: -norms[w]):
        # The best scaling never increases the norm, so the other frequencies have lower values.
        if tried and norms[w] <= tried[best][0]:
            break
        tried[w] = best_scaling(loop.at(w))
        if tried[w][0] > tried[best][0]:
            best = w
    best = _climbed(loop, tried, best, sorted(norms))
    accuracy = ACCURACY if len(loop.J) <= 3 else _ACCURACY_OF_MANY
    intervals = [(0.0, np.inf, tried[best][1])]
    for _ in range(_DIVISIONS):
        if not intervals:
            break
        low, high, d = intervals.pop()
        level = tried[best][0] * (1.0 + accuracy)
        for a, b in _above(loop.scaled(d), level, low, high):
            middle = _middle(a, b)
            tried[middle] = best_scaling(loop.at(middle), d)
            if tried[middle][0] > tried[best][0]:
                best = middle
            scaling = tried[middle][1]
            if b - a <= _NARROW * b:
                continue
            if (a, b) == (low, high):
                intervals.append((a, middle, scaling))
                intervals.append((middle, b, scaling))
            else:
                intervals.append((a, b, scaling))
    value, d = tried[best]
    return value, best, d


def _thinned(frequencies: list[float]) -> list[float]:
    """Return the frequencies, without those that are near another one."""
    kept = frequencies[:1]
    for frequency in frequencies[1:]:
        if frequency > kept[-1] * _APART:
            kept.append(frequency)
    return kept


def _middle(low: float, high: float) -> float:
    """Return a frequency between two others; the second may be infinite."""
    if np.isinf(high):
        return 2.0 * low if low else 1.0
    return 0.5 * (low + high)


def _above(
    loop: Loop, level: float, low: float, high: float
) -> list[tuple[float, float]]:
    """Return the intervals between `low` and `high` in which the gain exceeds a level."""
    crossings, on_axis = gain_crossings(loop.F, loop.G, loop.H, loop.J, level)
    inside = np.abs(crossings.imag[on_axis])
    inside = inside[(inside > low) & (inside < high)]
    ends = [low, *np.unique(inside).tolist(), high]
    return [
        (a, b)
        for a, b in pairwise(ends)
        if np.linalg.norm(loop.at(_middle(a, b)), 2) > level
    ]
