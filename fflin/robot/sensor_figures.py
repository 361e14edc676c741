"""Figures of data sheets of sensors, and their factors to SI units."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import NamedTuple

from fflin.base.errors import InputError, require_known
from fflin.base.validation import quantity

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


def checked_figure(
    what: str,
    given: Mapping[str, float],
    units: Iterable[str],
    known: Mapping[str, Figure],
) -> tuple[Figure, float]:
    """Return the figure of a data sheet and its value; `units` are the units of the output.

    Raise `InputError` if several figures are given, the value is not positive, or the figure is for
    outputs with other units.
    """
    require_known(f"part of {what}", given, tuple(known))
    if len(given) != 1:
        raise InputError(
            f"{what} has {len(given)} figures, expected one, such as {{'{next(iter(known))}': 0.1}}"
        )
    ((name, value),) = given.items()
    figure = known[name]
    for unit in units:
        if unit in figure.factors:
            continue
        fitting = [key for key, other in known.items() if unit in other.factors]
        expected = f"; give {' or '.join(fitting)}" if fitting else ""
        raise InputError(
            f"{what} has the figure '{name}', which is for outputs in "
            f"{' or '.join(figure.factors)}, but the unit of the output is {unit}{expected}"
        )
    return figure, quantity(f"'{name}' in {what}", value, figure.unit)
