"""Curves of constant damping ratio and of constant natural frequency, for maps of poles.

With the natural frequency w and the damping ratio zeta, a pole is
s = w (-zeta + i sqrt(1 - zeta^2)), or z = exp(s dt) if the system is sampled.
"""

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from fflin.base.validation import Array, Values

# Damping ratios whose curves are drawn.
RATIOS = (0.2, 0.4, 0.6, 0.8)

# A pole oscillates if its imaginary part exceeds this fraction of the largest pole.
_REAL = 1e-9


class Label(NamedTuple):
    """Text at a point of a picture."""

    x: float
    y: float
    text: str


def damped_poles(ratio: float, frequencies: Array, dt: float = 0.0) -> Values:
    """Return the poles (k,) with one damping ratio and natural frequencies (k,) [rad/s].

    Their imaginary parts are positive, in z up to half the sampling frequency.
    """
    rates: Values = frequencies * complex(-ratio, math.sqrt(1.0 - ratio * ratio))
    return np.exp(dt * rates) if dt else rates


def nyquist_frequency(ratio: float, dt: float) -> float:
    """Return the natural frequency [rad/s] at which a pole z becomes negative and real."""
    return math.pi / dt / math.sqrt(1.0 - ratio * ratio)


def equally_fast_poles(frequency: float, dt: float = 0.0) -> Values:
    """Return poles (k,) with one natural frequency [rad/s], from undamped to critically damped."""
    # Many points lie near both ends, because the axes may be logarithmic.
    quarter = math.pi / 2.0
    small = np.geomspace(1e-9, 0.05, 30)
    between = np.linspace(0.05, quarter - 0.05, 60)
    angles = np.concatenate((small, between, quarter - small[::-1]))
    rates: Values = frequency * (-np.sin(angles) + 1j * np.cos(angles))
    return np.exp(dt * rates) if dt else rates


def oscillates(poles: Values) -> bool:
    """Return whether any of the poles [1/s] has an imaginary part."""
    largest = float(np.abs(poles).max(initial=0.0))
    return bool((np.abs(poles.imag) > _REAL * largest).any())


def spaced(labels: Iterable[Label], width: float, height: float) -> list[Label]:
    """Return the labels that do not overlap earlier ones, if each is `width` x `height`."""
    kept = list[Label]()
    for label in labels:
        if all(
            abs(label.x - other.x) >= width or abs(label.y - other.y) >= height
            for other in kept
        ):
            kept.append(label)
    return kept
