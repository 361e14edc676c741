"""Open-loop gain of one channel of a loop: its crossings, and its margins of gain and phase."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from fflin.base.validation import Array, Values
from fflin.control.optimal.disk import Loop

# Eigenvalues whose real part is at most the fraction _NEAR_AXIS of their magnitude may be
# crossings. A crossing is a change of sign within one of the fractions _WIDTHS of the frequency, or
# a value of at most _TOUCHES.
_NEAR_AXIS = 1e-2
_WIDTHS = (1e-6, 1e-4, 2e-3)
_TOUCHES = 1e-10

# A loop gain below this at a phase crossing is rounding: it would be a gain margin above 1e6. A
# gain factor below it is rounding too, because the loop gain of an integrator is infinite at zero
# frequency.
_NOTHING = 1e-6


class Crossing(NamedTuple):
    """Frequency [rad/s] at which the open-loop gain is 1, and its lag [rad], 0 to 2 pi.

    An additional lag of this size makes the loop oscillate.
    """

    frequency: float
    lag: float

    @property
    def phase(self) -> float:
        """Phase [deg] of lag or lead that makes the loop oscillate."""
        return math.degrees(min(self.lag, 2.0 * math.pi - self.lag))


class ChannelLimits(NamedTuple):
    """Changes of one channel at which its loop oscillates.

    Attributes
    ----------
    gain : tuple of float
        Least and largest gain factor.
    gain_frequencies : tuple of float
        Frequencies [rad/s] of the oscillations at these factors; NaN if there is no limit.
    crossings : tuple of Crossing
        Frequencies at which the open-loop gain is 1.
    """

    gain: tuple[float, float]
    gain_frequencies: tuple[float, float]
    crossings: tuple[Crossing, ...]


class Grid(NamedTuple):
    """Frequencies (k,) [rad/s] and the responses (k,) of one channel there."""

    frequencies: Array
    responses: Values


NO_GRID = Grid(np.zeros(0), np.zeros(0, complex))


def channel_limits(loop: Loop, grid: Grid) -> ChannelLimits:
    """Return the limits of a stable continuous loop with one channel.

    Crossings between the frequencies of `grid` are found even if other poles are so fast that they
    hide the crossings from the eigenvalues. It may be empty.
    """
    low, high = (0.0, math.nan), (math.inf, math.nan)
    for frequency in [0.0, *_axis_zeros(loop, -1.0, grid), math.inf]:
        value = loop_gain(loop, frequency)
        if not (value.real < -_NOTHING and math.isfinite(value.real)):
            continue
        factor = -1.0 / value.real
        if max(low[0], _NOTHING) < factor < 1.0:
            low = factor, frequency
        if 1.0 < factor < high[0]:
            high = factor, frequency
    crossings = []
    for frequency in _axis_zeros(loop, 1.0, grid):
        lag = float(np.angle(-loop_gain(loop, frequency))) % (2.0 * math.pi)
        crossings.append(Crossing(frequency, lag))
    return ChannelLimits((low[0], high[0]), (low[1], high[1]), tuple(crossings))


def loop_gain(loop: Loop, frequency: float) -> complex:
    """Return the open-loop gain of a channel, for negative feedback, from (S - T)/2."""
    value = complex(loop.at(frequency)[0, 0])
    sensitivity = 0.5 + value
    if not abs(sensitivity):
        return complex(math.inf)
    return (0.5 - value) / sensitivity


def log_gain(loop: Loop, frequency: float) -> float:
    """Return the logarithm of the magnitude of the open-loop gain of a channel."""
    return math.log(abs(loop_gain(loop, frequency)))


def _axis_zeros(loop: Loop, sign: float, grid: Grid) -> list[float]:
    """Return the frequencies > 0 at which M(jw) + sign M(-jw) is zero, for one channel.

    With the sign 1, the real part of M is zero there, and the open-loop gain has the magnitude 1.
    With the sign -1, M and the open-loop gain are real. The frequencies are the zeros on the
    imaginary axis of a system of twice the size. Changes of sign along `grid` are also found.
    """
    from scipy.linalg import eigvals

    F, G, H, J = loop
    n = len(F)
    none = np.zeros((n, n))
    pencil = np.block(
        [
            [F, none, G],
            [none, -F, G],
            [H, -sign * H, (1.0 + sign) * J],
        ]
    )
    mass = np.diag(np.concatenate((np.ones(2 * n), [0.0])))
    zeros = eigvals(pencil, mass)
    zeros = zeros[np.isfinite(zeros) & (zeros.imag > 0.0)]
    near = zeros[np.abs(zeros.real) <= _NEAR_AXIS * np.abs(zeros)].imag
    frequencies = list[float]()
    crossings = [_crossing(loop, sign, w) for w in np.unique(near).tolist()]
    for crossing in (*_changes(loop, sign, grid), *crossings):
        apart = [abs(crossing - other) > 1e-9 * crossing for other in frequencies]
        if crossing and all(apart):
            frequencies.append(crossing)
    return frequencies


def _part(response: complex, sign: float) -> float:
    """Return the real part of a response for the sign 1, and the imaginary part for -1."""
    if sign > 0.0:
        return float(response.real)
    return float(response.imag)


def _changes(loop: Loop, sign: float, grid: Grid) -> list[float]:
    """Return the frequencies between points of a grid at which M(jw) + sign M(-jw) changes sign."""
    from scipy.optimize import brentq

    def value(frequency: float) -> float:
        return _part(loop.at(frequency)[0, 0], sign)

    signs = np.signbit([_part(response, sign) for response in grid.responses])
    at = np.flatnonzero(signs[1:] != signs[:-1])
    intervals = [grid.frequencies[k : k + 2] for k in at]
    return [float(brentq(value, *interval, rtol=1e-13)) for interval in intervals]


def _crossing(loop: Loop, sign: float, w: float) -> float:
    """Return the frequency near w at which M(jw) + sign M(-jw) is zero, or 0 if there is none."""
    from scipy.optimize import brentq

    def value(frequency: float) -> float:
        return _part(loop.at(frequency)[0, 0], sign)

    for width in _WIDTHS:
        low, high = w * (1.0 - width), w * (1.0 + width)
        if value(low) * value(high) < 0.0:
            return float(brentq(value, low, high, xtol=1e-14 * w, rtol=1e-14))
    if abs(value(w)) <= _TOUCHES:
        return w
    return 0.0
