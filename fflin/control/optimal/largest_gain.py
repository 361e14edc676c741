"""Largest gains of linear systems over frequency, from eigenvalues of Hamiltonian matrices."""

import math
from collections.abc import Callable

import numpy as np

from fflin.base.validation import Array, Mask, Values

# Relative accuracy of the largest gain over frequency.
ACCURACY = 1e-5

# `largest_gain` starts from the frequencies of all poles, or from about _FEW if they are more than
# _MANY.
_MANY, _FEW = 64, 8


def largest_gain(A: Array, B: Array, C: Array, D: Array) -> tuple[float, float]:
    """Return the largest gain of a stable system over all frequencies, and its frequency [rad/s].

    The gain is accurate to five digits.
    """

    def gain(frequency: float) -> tuple[float, float]:
        response = D + C @ np.linalg.solve(1j * frequency * np.eye(len(A)) - A, B)
        return float(np.linalg.norm(response, 2)), frequency

    poles = np.linalg.eigvals(A)
    starts = sorted({0.0, *np.abs(poles).tolist()})
    peak = max((float(np.linalg.norm(D, 2)), math.inf), _largest_among(gain, starts))
    while True:
        bound = peak[0] * (1.0 + ACCURACY)
        crossings, on_axis = gain_crossings(A, B, C, D, bound)
        frequencies = np.sort(np.abs(crossings.imag[on_axis]))
        between = np.concatenate(
            (frequencies, 0.5 * (frequencies[1:] + frequencies[:-1]))
        )
        best = max(map(gain, between.tolist()), default=peak)
        if best[0] <= bound:
            return max(peak, best)
        peak = best


def _largest_among(
    gain: Callable[[float], tuple[float, float]], frequencies: list[float]
) -> tuple[float, float]:
    """Return a large gain at one of the ascending frequencies: the largest, if they are few."""
    count = len(frequencies)
    step = 1
    if count > _MANY:
        step = -(-count // _FEW)
    gains = {index: gain(frequencies[index]) for index in range(0, count, step)}
    # Between the frequencies that were tried, search near the best of them.
    while step > 1:
        step = -(-step // 2)
        best = max(gains, key=lambda index: gains[index])
        for index in (best - step, best + step):
            if 0 <= index < count and index not in gains:
                gains[index] = gain(frequencies[index])
    return max(gains.values())


def gain_crossings(
    A: Array, B: Array, C: Array, D: Array, bound: float
) -> tuple[Values, Mask]:
    """Return the eigenvalues (.., 2 nx) of a Hamiltonian matrix, and a mask of the imaginary ones.

    At the frequency of each imaginary eigenvalue, a singular value of the frequency response equals
    `bound`. The mask may also mark an eigenvalue that is only nearly imaginary. A caller then
    evaluates the response once more than necessary.
    """
    inverse = np.linalg.inv(bound**2 * np.eye(D.shape[1]) - D.T @ D)
    F = A + B @ inverse @ D.T @ C
    spread = C.T @ (np.eye(len(D)) + D @ inverse @ D.T) @ C
    lower = np.concatenate((np.broadcast_to(-spread, F.shape), -F.mT), axis=-1)
    upper = np.concatenate((F, B @ inverse @ B.mT), axis=-1)
    crossings = np.linalg.eigvals(np.concatenate((upper, lower), axis=-2))
    return crossings, np.abs(crossings.real) <= 1e-6 * np.abs(crossings)
