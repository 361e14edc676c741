"""Parameters of laws: values, bounds and units, and the coordinates in which they are searched."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import TypeAlias

import numpy as np

from fflin.base.errors import InputError
from fflin.base.validation import number, printable

# A parameter without bounds is searched within these factors of its start or of its scale.
_WIDE = 1e6

# Standard deviation of the start values of a search: in the logarithm of a parameter with a sign,
# and relative to the scale of a parameter without a sign.
_SPREAD = 1.5


@dataclass(frozen=True, eq=False)
class Tunable:
    """Parameter of a structure that `tune` chooses.

    A structure accepts for each of its parameters a number, which is fixed, a pair
    ``(least, largest)``, or a `Tunable`. If the same `Tunable` is given in several places, these
    parameters are one shared parameter.

    Parameters
    ----------
    value : float, optional
        Value from which the first search starts, in the unit of the parameter. By default, the
        structure chooses it for the plant.
    least, largest : float, optional
        Bounds. By default, the bounds of the structure, such as positive values for a frequency.
    name : str, optional
        Name in the report. By default, the structure names the parameter.

    Raises
    ------
    InputError
        If a number is not finite, ``least`` is not below ``largest``, or the value is outside.

    Examples
    --------
    >>> lag = fflin.Tunable(0.5, least=0.1, largest=2.0)
    >>> law = fflin.PD("q_b", "tau_b", lag=lag)
    """

    value: float | None = None
    least: float | None = None
    largest: float | None = None
    name: str = ""

    def __post_init__(self) -> None:
        for key in ("value", "least", "largest"):
            given = getattr(self, key)
            if given is not None:
                object.__setattr__(self, key, number(key, given))
        if not isinstance(self.name, str) or self.name:
            printable("name", self.name)
        least, largest = self.least, self.largest
        if least is not None and largest is not None and not least < largest:
            raise InputError(
                f"the bounds are {least:g} and {largest:g}, expected least < largest"
            )
        value = self.value
        if value is None:
            return
        below = least is not None and value < least
        above = largest is not None and value > largest
        if below or above:
            raise InputError(
                f"value is {value:g}, expected a value between the bounds {least} and {largest}"
            )


# Value of a parameter that a user may give.
Given: TypeAlias = "Tunable | float | tuple[float, float] | None"


@dataclass(frozen=True, eq=False)
class Parameter:
    """Parameter of a law for a plant.

    `scale` is the size of a typical value. If `sign` is not 0, the parameter keeps this sign, and
    its logarithm is searched; otherwise the inverse hyperbolic sine of value / scale, which is
    linear for small values and logarithmic for large ones. `source` is the `Tunable` that the user
    gave, if any.
    """

    name: str
    unit: str
    value: float
    least: float
    largest: float
    scale: float
    fixed: bool = False
    source: Tunable | None = field(default=None)

    @property
    def sign(self) -> int:
        """The sign of all values within the bounds, or 0."""
        if self.least >= 0.0:
            return 1
        if self.largest <= 0.0:
            return -1
        return 0

    def coordinate(self, value: float) -> float:
        """Return the coordinate of a value."""
        if self.sign:
            return math.log(max(abs(value), 1e-300))
        return math.asinh(value / self.scale)

    def at(self, coordinate: float) -> tuple[float, float]:
        """Return the value at a coordinate, and its derivative."""
        if self.sign:
            value = self.sign * math.exp(coordinate)
            return value, value
        sine, cosine = math.sinh(coordinate), math.cosh(coordinate)
        return self.scale * sine, self.scale * cosine

    @property
    def bounds(self) -> tuple[float, float]:
        """Least and largest coordinate."""
        if not self.sign:
            ends = self.least / self.scale, self.largest / self.scale
            return (
                math.asinh(max(ends[0], -_WIDE)),
                math.asinh(min(ends[1], _WIDE)),
            )
        near, far = sorted((abs(self.least), abs(self.largest)))
        middle = max(abs(self.value), near) or min(self.scale, far)
        low = near if near > 0.0 else middle / _WIDE
        high = far if math.isfinite(far) else middle * _WIDE
        return math.log(low), math.log(high)

    def drawn(self, rng: np.random.Generator) -> float:
        """Return a random coordinate near the start value."""
        low, high = self.bounds
        if self.sign and math.isfinite(self.largest) and self.least > 0.0:
            return float(rng.uniform(low, high))
        start = self.coordinate(self.value) + _SPREAD * float(rng.standard_normal())
        return min(max(start, low), high)


def resolved(default: Parameter, given: Given) -> Parameter:
    """Return a parameter with the value and bounds that a user gave, and the default otherwise."""
    if given is None:
        return default
    if isinstance(given, Tunable):
        name = given.name or default.name
        least = default.least if given.least is None else given.least
        largest = default.largest if given.largest is None else given.largest
        parameter = replace(
            default, name=name, least=least, largest=largest, source=given
        )
        return _started(parameter, given.value)
    if isinstance(given, tuple | list):
        if len(given) != 2:
            raise InputError(
                f"the bounds of '{default.name}' have {len(given)} values, expected "
                "(least, largest)"
            )
        least, largest = (number(default.name, end) for end in given)
        if not least < largest:
            raise InputError(
                f"the bounds of '{default.name}' are {least:g} and {largest:g}, expected "
                "least < largest"
            )
        return _started(replace(default, least=least, largest=largest), None)
    value = number(default.name, given)
    return replace(default, value=value, fixed=True)


def _started(parameter: Parameter, value: float | None) -> Parameter:
    """Return a parameter with a start value within its bounds."""
    least, largest = parameter.least, parameter.largest
    if not least < largest:
        raise InputError(
            f"the bounds of '{parameter.name}' are {least:g} and {largest:g}, expected "
            "least < largest"
        )
    if value is not None:
        if not least <= value <= largest:
            raise InputError(
                f"the value of '{parameter.name}' is {value:g}, expected {least:g} to {largest:g}"
            )
        return replace(parameter, value=value)
    value = parameter.value
    if least <= value <= largest:
        return parameter
    finite = math.isfinite(least) and math.isfinite(largest)
    if finite and least * largest > 0.0:
        value = parameter.sign * math.sqrt(least * largest)
    elif finite:
        value = 0.5 * (least + largest)
    else:
        value = least if math.isfinite(least) else largest
    return replace(parameter, value=value)
