"""Upper bounds of the structured singular value of parameters that are real and repeated."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fflin.base.validation import Array

# Signals up to which slycot is asked, whose time grows with the fifth power of them.
_SIGNALS = 24
# Frequencies of a first look, and those put between the neighbours of the largest, twice.
_LOOK, _CLOSER = 120, 12


def scaled(Z: Array) -> tuple[Array, Array]:
    """Return d Z / d (.., n, n) of the d > 0 that are best for |Z|, and its largest gains (..)."""
    # By Perron's vectors of |Z|; the gains are bounds for deltas on a signal each.
    sizes = np.abs(Z) + 1e-9 * np.abs(Z).max(axis=(-2, -1), keepdims=True) + 1e-300
    right, left = np.ones((2, *Z.shape[:-1], 1))
    for _ in range(100):
        right, left = sizes @ right, sizes.mT @ left
        right, left = (each / each.max(axis=-2, keepdims=True) for each in (right, left))
    d = np.sqrt(left / right)
    Z = d * Z / d.mT
    return Z, np.linalg.svd(Z, compute_uv=False)[..., 0]


def largest_bound(
    response: Callable[[Array], Array], end: Array, rates: Array, blocks: Array
) -> float:
    """Return the largest bound of Z = response(w), `end` at infinity, for a loop of such rates."""
    grid = np.geomspace(0.01 * rates.min(), 100.0 * rates.max(), _LOOK)
    grid, largest = np.unique(np.concatenate(((0.0,), grid, rates))), 0.0
    for closer in range(3):
        Z = response(grid)
        Z, bounds = scaled(Z if closer else np.concatenate((Z, end[None])))
        for at in np.argsort(-bounds):
            if bounds[at] <= largest:
                break
            bounds[at] = min(bounds[at], _by_slycot(Z[at], blocks))
            largest = max(largest, float(bounds[at]))
        at = int(bounds[: len(grid)].argmax())
        grid = np.linspace(grid[max(at - 1, 0)], grid[min(at + 1, len(grid) - 1)], _CLOSER)
    return largest


def _by_slycot(Z: Array, blocks: Array) -> float:
    """Return the bound of AB13MD: a delta on one signal is real, a repeated one a full block."""
    try:
        from slycot import ab13md
        from slycot.exceptions import SlycotArithmeticError
    except ImportError:
        return np.inf
    try:
        kinds = np.where(blocks == 1, 1, 2)
        return float(ab13md(Z, blocks, kinds)[0]) if len(Z) <= _SIGNALS else np.inf
    except SlycotArithmeticError:
        return np.inf
