"""Spreads: inverse distribution functions of the dispersed values."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from fflin.base.errors import InputError
from fflin.base.validation import Array, number

SEED = "noise"  # what is drawn of a run's noise, which says nothing of how it ends


def inverse_of(name: str, spread: Any) -> Callable[[Array], Array]:
    """Return the inverse distribution function of a spread."""
    if hasattr(spread, "ppf"):
        try:
            middle = float(spread.ppf(0.5))
        except Exception:  # of what may call itself a distribution
            middle = np.nan
        if not np.isfinite(middle):
            raise InputError(
                f"the distribution of '{name}' has no median; give a frozen distribution"
            )
        return spread.ppf
    if isinstance(spread, tuple):
        if len(spread) != 2:
            raise InputError(f"'{name}' is {spread!r}, expected (least, largest)")
        least, largest = (number(f"'{name}'", each) for each in spread)
        if not least <= largest:
            raise InputError(f"'{name}' is ({least:g}, {largest:g}), expected (least, largest)")
        return partial(_uniform, least, largest)
    if isinstance(spread, list | np.ndarray):
        values = [number(f"'{name}'", each) for each in np.ravel(spread).tolist()]
        if not values:
            raise InputError(f"'{name}' is a list without values; give at least one")
        return partial(_choice, np.array(values))
    deviation = number(f"'{name}'", spread)
    if deviation < 0.0:
        raise InputError(f"'{name}' is {deviation:g}, expected a standard deviation of at least 0")
    return partial(_normal, deviation)


def is_closed_form(inverse: Callable[[Array], Array]) -> bool:
    """Whether an inverse is one of this module, and no distribution's that may take long."""
    return isinstance(inverse, partial) or inverse is whole_number


def _uniform(least: float, largest: float, u: Array) -> Array:
    return least + (largest - least) * u


def _choice(values: Array, u: Array) -> Array:
    return values[(u * len(values)).astype(int)]


def _normal(deviation: float, u: Array) -> Array:
    from scipy.special import ndtri

    normal: Array = deviation * ndtri(u)
    return normal


def whole_number(u: Array) -> Array:
    """Return seeds: the uniform numbers that a double tells from one another."""
    return np.floor(u * 2.0**53)


def deviation_of(name: str, spread: Any) -> Callable[[Array], Array]:
    """Return the same of a noise's deviation, which a number itself is."""
    inverse = inverse_of(name, spread)
    fixed = getattr(inverse, "func", None) is _normal
    return partial(_choice, np.array([float(spread)])) if fixed else inverse
