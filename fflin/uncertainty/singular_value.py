"""Upper bounds of the structured singular value for real repeated parameters.

For real parameters it is discontinuous in the frequency, if a pole crosses the axis. Values on a
grid of frequencies then say nothing about the frequencies between. So one scaling is used for each
whole interval.
"""

from __future__ import annotations

from collections.abc import Callable
from heapq import heapify, heappop, heappush
from itertools import pairwise
from typing import TypeAlias

import numpy as np

from fflin.base.validation import Array

# Signals up to which slycot is asked, whose time grows with the fifth power of them.
_SIGNALS = 24
# Frequencies of a first look, those at which an interval is held, and how often intervals are
# divided or slycot is asked.
_LOOK, _HELD, _STEPS = 120, 5, 100
# How near to the bound of one frequency that of its interval is enough.
_NEAR = 1.01

Scaling: TypeAlias = tuple[Array, Array]  # d > 0 and g, (n,) each


def perron(Z: Array) -> Array:
    """Return the d > 0 (.., n, 1) that make d Z / d small, by Perron's vectors of |Z|."""
    sizes = np.abs(Z) + 1e-9 * np.abs(Z).max(axis=(-2, -1), keepdims=True) + 1e-300
    right, left = np.ones((2, *Z.shape[:-1], 1))
    for _ in range(100):
        right, left = sizes @ right, sizes.mT @ left
        right, left = (each / each.max(axis=-2, keepdims=True) for each in (right, left))
    d: Array = np.sqrt(left / right)
    return d


def held(Z: Array, scaling: Scaling) -> float:
    """Return the least b with Z^H D^2 Z + j (G Z - Z^H G) <= b^2 D^2 for all of Z (k, n, n)."""
    d, g = scaling
    scaled, turned = d[:, None] * Z / d, (g / d)[:, None] * Z / d
    form = scaled.conj().mT @ scaled + 1j * (turned - turned.conj().mT)
    return float(np.sqrt(np.linalg.eigvalsh(form)[:, -1].max().clip(0.0)))


def largest_bound(
    response: Callable[[Array], Array], end: Array, rates: Array, blocks: Array
) -> float:
    """Return the largest bound of Z = response(w), `end` at infinity, for a loop of such rates."""
    grid = np.geomspace(0.01 * rates.min(), 100.0 * rates.max(), _LOOK)
    grid = np.unique(np.concatenate(((0.0,), grid, rates)))
    at_end = min(held(end[None], each) for each in _scalings(end, blocks))
    heap: list[tuple[float, float, float, bool, Scaling]] = []

    def best_of(a: float, b: float, asked: bool, *known: Scaling) -> tuple[float, Scaling, float]:
        """Return the bound of an interval with its scaling, and the bound of its middle alone."""
        Z = response(np.linspace(a, b, _HELD))
        middle = Z[_HELD // 2]
        found = [*known, *_scalings(middle, blocks if asked else blocks[:0])]
        values = [held(Z, each) for each in found]
        least = min(held(middle[None], each) for each in found)
        return min(values), found[int(np.argmin(values))], least

    for a, b in pairwise(grid.tolist()):
        value, by, _ = best_of(a, b, False)
        heap.append((-value, a, b, False, by))
    heapify(heap)
    reached = at_end
    for _ in range(_STEPS):
        if -heap[0][0] <= _NEAR * reached:
            break
        value, a, b, asked, by = heappop(heap)
        if asked:
            half = 0.5 * (a + b)
            for low, high in ((a, half), (half, b)):
                heappush(heap, (-best_of(low, high, False, by)[0], low, high, False, by))
        else:
            value, by, least = best_of(a, b, True, by)
            reached = max(reached, least)
            heappush(heap, (-value, a, b, True, by))
    return max(at_end, -heap[0][0])


def _scalings(Z: Array, blocks: Array) -> list[Scaling]:
    """Return scalings that are good for Z, with the scaling of AB13MD if blocks are given."""
    none: Array = np.zeros(len(Z))
    found: list[Scaling] = [(perron(Z)[:, 0], none)]
    if len(Z) == 1 and len(blocks) and Z[0, 0].imag:
        return [*found, (none + 1.0, np.abs(Z[0]) ** 2 / (2.0 * Z[0].imag))]
    try:
        from slycot import ab13md
        from slycot.exceptions import SlycotArithmeticError
    except ImportError:
        return found
    if 0 < len(blocks) and len(Z) <= _SIGNALS:
        try:
            # A delta on one signal is real, a repeated one a full block.
            _, d, g, *_ = ab13md(Z, blocks, np.where(blocks == 1, 1, 2))
        except SlycotArithmeticError:
            return found
        if d.min() > 0.0 and np.isfinite((d, g)).all():
            found.append((d, g))
    return found
