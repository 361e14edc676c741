"""The worst loop over a set of robots: found by search, and how far the set is surely stable."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np

from fflin.base.errors import InputError
from fflin.base.progress import Progress
from fflin.base.tables import folded
from fflin.base.threads import in_one_thread
from fflin.base.validation import Array, as_double
from fflin.uncertainty.lft import LFT
from fflin.uncertainty.loops import Gain, Loops
from fflin.uncertainty.singular_value import largest_bound

_CORNERS = 256


@dataclass(frozen=True)
class Found:
    """The worst of one figure over the set, and the parameters that it is of."""

    value: float
    parameters: Mapping[str, float]


@dataclass(frozen=True)
class Worst:
    """The worst loop over a set of robots; prints in words.

    Attributes
    ----------
    damping : Found
        Least damping ratio of a pole.
    margin : Found
        Least disk margin at the inputs, see `Gain.margins`; 0 where a loop is unstable.
    gain : Found
        Largest gain over all frequencies from a disturbance at the inputs to the outputs.
    unstable : int
        Of the loops tried, how many were unstable.
    tried, excluded : int
        Loops tried, and draws and corners left out because they make no rigid bodies.
    safe : float
        The loop is stable for all ranges widened about their middles by this factor, by an upper
        bound of the structured singular value over a grid of frequencies; 1 or more is all of the
        set.
    """

    damping: Found
    margin: Found
    gain: Found
    unstable: int
    tried: int
    excluded: int
    safe: float

    def __str__(self) -> str:
        lines = [
            f"of {self.tried} loops tried {self.unstable} were unstable; "
            f"{self.excluded} draws and corners make no rigid bodies"
        ]
        for what, found in (
            ("least damping ratio", self.damping),
            ("least disk margin", self.margin),
            ("largest gain from a disturbance at the inputs", self.gain),
        ):
            at = ", ".join(f"{name} {value:.4g}" for name, value in found.parameters.items())
            lines.append(f"{what} {found.value:.4g} at {at}")
        if self.safe >= 1.0:
            lines.append(f"stable on all of the set, up to {self.safe:.3g} times as wide (bound)")
        else:
            lines.append(f"stable for sure on {100.0 * self.safe:.3g} % of each range (bound)")
        return folded(lines)


@in_one_thread
def searched(of: Any, lft: LFT, gain: Any, samples: int, seed: int) -> Worst:
    """Do what `Uncertain.worst` does."""
    K = as_double("gain", getattr(gain, "K", gain))
    if K.shape != lft.B2.T.shape:
        raise InputError(f"gain has shape {K.shape}, expected {lft.B2.T.shape} (nu, nx)")
    R = getattr(gain, "R", np.eye(len(K)))
    size, loops = len(lft.repeats), Loops(lft, K)
    middle = np.zeros((1, size))
    if loops.undamped(middle)[0] >= 0.0:
        raise InputError("the loop in the middle of the ranges is unstable; give another gain")
    bar = Progress()
    try:
        draws, excluded = of.draws(samples, seed=seed)
        corners = (
            np.array(list(product((-1.0, 1.0), repeat=size)))
            if 2**size <= _CORNERS
            else (2.0 * np.random.default_rng(seed).integers(0, 2, (_CORNERS, size)) - 1.0)
        )
        physical = np.array([of.makes(corner) for corner in corners])
        tried = np.vstack((draws, corners[physical], middle))
        bar.update(1, 5)
        least, at = loops.least_damped(tried, of.makes)
        damping = Found(-least, of.values(at))
        bar.update(2, 5)
        # Of the disk margin, as in control.margins.
        scale = np.sqrt(R.diagonal())
        disk = Gain(-scale[:, None] * K, 0.5 * np.eye(len(K)), 1.0 / scale)
        largest, at = loops.largest(disk, tried, of.makes)
        margin = Found(min(1.0 / largest, 2.0), of.values(at))
        bar.update(3, 5)
        whole = Gain(lft.C2, np.zeros((len(lft.C2), len(K))), np.ones(len(K)))
        largest, at = loops.largest(whole, tried, of.makes)
        bar.update(4, 5)
        return Worst(
            damping=damping,
            margin=margin,
            gain=Found(largest, of.values(at)),
            unstable=int((loops.undamped(tried) >= 0.0).sum()),
            tried=len(tried),
            excluded=excluded + int((~physical).sum()),
            safe=_safe(loops),
        )
    finally:
        bar.close()


def _safe(loops: Loops) -> float:
    """Return by how much the set may be widened: the inverse of the largest bound on mu."""
    lft, F = loops.lft, loops.matrices(np.zeros(len(loops.lft.repeats)))[0]
    poles = np.linalg.eigvals(F)

    def response(w: Array) -> Array:
        inner = 1j * w[:, None, None] * np.eye(len(F)) - F
        return loops.z_by_x @ np.linalg.solve(inner, lft.B1) + lft.D11

    rates = np.concatenate((np.abs(poles), np.abs(poles.imag)))
    largest = largest_bound(response, lft.D11, rates[rates > 0.0], lft.repeats.astype(int))
    return 1.0 / largest if largest else np.inf
