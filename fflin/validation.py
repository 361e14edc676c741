"""Checks of what callers pass in, made once at the public door."""

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fflin.errors import InputError

Array = NDArray[np.floating[Any]]

# A quaternion or a (cos, sin) pair this far from unit length is renormalised without a word;
# farther off it is taken for a mistake.
NORM_TOLERANCE = 1e-6

# Native double precision; NumPy makes one such object, so that identity tells it.
_DOUBLE = np.dtype(np.float64)


def vector(name: str, value: ArrayLike, size: int, of_what: str) -> Array:
    """Return a float vector of the given size.

    Parameters
    ----------
    name : str
        What to call it in an error.
    value : array_like
        What the caller gave; never modified.
    size : int
        Expected number of entries.
    of_what : str
        What the entries stand for, in an error.

    Returns
    -------
    ndarray (size,)
        The caller's own array where it already is a native float vector.

    Raises
    ------
    InputError
        If the shape is another, an entry is masked, complex or not finite.
    """
    if type(value) is np.ndarray and value.dtype is _DOUBLE:
        array: Array = value
    else:
        array = _as_double(name, value)
    if array.shape != (size,):
        raise InputError(f"{name} has shape {array.shape}, expected ({size},): {of_what}")
    # The square is finite where every entry is, but for numbers beyond 1e154.
    if not math.isfinite(array.dot(array)) and not np.isfinite(array).all():
        index = int(np.flatnonzero(~np.isfinite(array))[0])
        raise InputError(f"{name}[{index}] is {array[index]}; every entry must be finite")
    return array


def number(name: str, value: Any) -> float:
    """Return a finite float, or raise `InputError` that says what was given."""
    try:
        result = float(value)
    except (TypeError, ValueError):
        raise InputError(f"{name} is {value!r}, expected a number") from None
    if not math.isfinite(result):
        raise InputError(f"{name} is {result}, expected a finite number")
    return result


def _as_double(name: str, value: ArrayLike) -> Array:
    if isinstance(value, np.ma.MaskedArray) and np.ma.getmaskarray(value).any():
        raise InputError(f"{name} has masked entries; fill them first")
    try:
        array = np.asarray(value)
    except ValueError:
        raise InputError(f"{name} is not an array: its rows differ in length") from None
    if array.dtype.kind not in "fiu":
        raise InputError(f"{name} holds {array.dtype} values, expected real numbers")
    return array.astype(np.float64)
