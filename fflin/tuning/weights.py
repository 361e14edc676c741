"""Weights of goals: transfer functions with one input and one output."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from fflin.base.errors import InputError
from fflin.base.validation import Array, Values, as_double, number


class Weight(NamedTuple):
    """Transfer function numerator / denominator, with the highest power first."""

    numerator: Array
    denominator: Array

    def inverse(self) -> Weight:
        """Return the inverse transfer function."""
        return Weight(self.denominator, self.numerator)

    def at(self, frequencies: Array) -> Array:
        """Return the gain at frequencies [rad/s], which may be infinite."""
        finite = np.where(np.isfinite(frequencies), frequencies, 0.0)
        above: Values = np.polyval(self.numerator, 1j * finite)
        below: Values = np.polyval(self.denominator, 1j * finite)
        last = abs(self.numerator[0] / self.denominator[0])
        gains: Array = np.where(np.isfinite(frequencies), np.abs(above / below), last)
        return gains

    @property
    def corners(self) -> list[float]:
        """Magnitudes of the poles and zeros [rad/s]."""
        roots = np.concatenate((np.roots(self.numerator), np.roots(self.denominator)))
        return [float(size) for size in np.abs(roots) if size > 0.0]

    def state_space(self) -> tuple[Array, Array, Array, Array]:
        """Return A, B, C and D."""
        lead = self.denominator[0]
        a = self.denominator[1:] / lead
        b = self.numerator / lead
        n = len(a)
        A = np.eye(n, k=-1)
        if n:
            A[0] = -a
        B = np.eye(n, 1)
        C = (b[1:] - b[0] * a)[None]
        return A, B, C, b[:1, None]


def weight_of(name: str, given: object) -> Weight:
    """Return the weight of a bound: a number, (numerator, denominator), or a system.

    Raise `InputError` unless all poles and zeros are stable and the degrees are equal.
    """
    if isinstance(given, tuple | list) and len(given) == 2:
        weight = Weight(_polynomial(name, given[0]), _polynomial(name, given[1]))
    elif hasattr(given, "A") or hasattr(given, "num") or hasattr(given, "to_tf"):
        weight = _of_system(name, given)
    else:
        value = number(name, given)
        if not value > 0.0:
            raise InputError(
                f"{name} is {value:g}, expected a positive number or a transfer function"
            )
        return Weight(np.array([value]), np.array([1.0]))
    if len(weight.numerator) != len(weight.denominator):
        degrees = len(weight.numerator) - 1, len(weight.denominator) - 1
        raise InputError(
            f"the numerator and denominator of {name} have degrees {degrees[0]} and "
            f"{degrees[1]}, expected equal degrees; add poles or zeros far outside the bandwidth, "
            "or give a number and RollOff"
        )
    for kind, polynomial in zip(("zero", "pole"), weight, strict=True):
        roots = np.roots(polynomial)
        unstable = [root for root in roots.tolist() if np.real(root) >= 0.0]
        if unstable:
            raise InputError(
                f"{name} has the {kind} {unstable[0]:.3g}, expected poles and zeros with negative "
                "real parts; use a low frequency instead of an integrator"
            )
    return weight


def _polynomial(name: str, given: object) -> Array:
    """Return the coefficients of a polynomial without leading zeros."""
    values = np.trim_zeros(np.atleast_1d(as_double(name, given)).ravel(), "f")
    if not len(values) or not np.isfinite(values).all():
        raise InputError(f"{name} has a polynomial that is zero or not finite")
    return values


def _first(given: object, key: str) -> object:
    """Return the polynomial of the first input and output of a python-control system."""
    return getattr(given, key)[0][0]


def _of_system(name: str, given: Any) -> Weight:
    """Return the weight of a SciPy or python-control system."""
    from scipy import signal

    try:
        if hasattr(given, "A"):
            top, bottom = signal.ss2tf(
                given.A,
                given.B,
                given.C,
                given.D,
            )
            size = np.abs(top).max(initial=0.0)
            top = np.where(np.abs(top) > 1e-12 * size, top, 0.0)
        elif isinstance(getattr(given, "num", None), list):
            top, bottom = _first(given, "num"), _first(given, "den")
        else:
            system: Any = given if hasattr(given, "num") else given.to_tf()
            top, bottom = system.num, system.den
    except (AttributeError, IndexError, ValueError) as error:
        raise InputError(
            f"{name} cannot be converted to a transfer function: {error}; give (numerator, "
            "denominator)"
        ) from None
    if np.ndim(top) > 1 and len(np.atleast_2d(top)) > 1:
        raise InputError(
            f"{name} has several outputs, expected one input and one output"
        )
    return Weight(_polynomial(name, np.ravel(top)), _polynomial(name, bottom))
