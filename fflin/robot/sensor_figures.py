"""Figures of data sheets of sensors, and their factors to SI units."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

_DEGREE = math.pi / 180.0
_HOUR = 3600.0
_ARC_SECOND = _DEGREE / _HOUR


class Figure(NamedTuple):
    """One figure of a data sheet.

    Attributes
    ----------
    unit : str
        Unit of the figure.
    factors : mapping
        Factor from the figure to the standard deviation in SI units, by the unit of the output. An
        output with another unit cannot have this figure.
    sampled : bool
        Whether the figure is the standard deviation of a sample. If False, it is a density, whose
        square is divided by the sample time.
    """

    unit: str
    factors: Mapping[str, float]
    sampled: bool = False


# The unit "1" is the unit of the vector part of a quaternion, which is half of a small rotation.
NOISE_FIGURES = {
    "angle_random_walk": Figure("deg/sqrt(h)", {"rad/s": _DEGREE / _HOUR**0.5}),
    "velocity_random_walk": Figure("m/s/sqrt(h)", {"m/s^2": 1.0 / _HOUR**0.5}),
    "noise_equivalent_angle": Figure(
        "arc seconds", {"1": 0.5 * _ARC_SECOND, "rad": _ARC_SECOND}, sampled=True
    ),
}

# Bias instability counts as the standard deviation of the change of the bias within one hour.
BIAS_FIGURES = {
    "bias_instability": Figure("deg/h", {"rad/s": _DEGREE / _HOUR**1.5}),
    "rate_random_walk": Figure("deg/h/sqrt(h)", {"rad/s": _DEGREE / _HOUR**1.5}),
}
