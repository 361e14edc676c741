"""Conditions on the figures of a run, such as ``attitude < 1 deg and settle < 40 s``."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from fflin.base.errors import InputError
from fflin.base.validation import Array

_COMPARED = re.compile(r"\s*(.+?)\s*(<=|>=|<|>)\s*([-+.\de]+)\s*(.*?)\s*")
_COMPARE = {"<": np.less, "<=": np.less_equal, ">": np.greater, ">=": np.greater_equal}
_DEGREE = math.pi / 180.0
_SIZES = {  # of units, in those of figures
    ("deg", "rad"): _DEGREE,
    ("rad", "deg"): 1.0 / _DEGREE,
    ("deg/s", "rad/s"): _DEGREE,
    ("mm", "m"): 1e-3,
    ("mm/s", "m/s"): 1e-3,
}


class Bound(NamedTuple):
    """One comparison of a condition, and which runs (N,) are on the right side of it."""

    name: str
    sign: str
    limit: float
    met: Any


def bounds_of(condition: str, figure: Callable[[str], tuple[Array, str]]) -> list[Bound]:
    """Return what a condition compares; `figure` returns values (N,) and unit of a name."""
    bounds = []
    for part in condition.split(" and "):
        match = _COMPARED.fullmatch(part)
        try:
            name, sign, bound, unit = match.groups() if match else ("", "", "", "")
            limit = float(bound)
        except ValueError:
            raise InputError(
                f"condition {part!r} cannot be read, expected NAME < NUMBER UNIT, such as "
                "'attitude < 1 deg'"
            ) from None
        values, own = figure(name)
        factors = [_SIZES.get((unit, each), 0.0) for each in own.split("|")]
        factor = 1.0 if unit in ("", own, *own.split("|")) else max(factors)
        if not factor:
            raise InputError(f"condition {part!r} has the unit {unit}, expected {own or 'no unit'}")
        limit *= factor
        bounds.append(Bound(name, sign, limit, _COMPARE[sign](values, limit)))
    return bounds
