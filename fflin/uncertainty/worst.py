"""The worst loop over a set of robots: found by search, and how far the set is surely stable."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np

from fflin.base.errors import InputError
from fflin.base.tables import folded
from fflin.base.validation import Array, as_double
from fflin.control.margins import input_margins, largest_gain
from fflin.uncertainty.lft import LFT

# Ends of a search, evaluations of each, corners that are tried, and frequencies of the bound.
_STARTS, _STEPS, _CORNERS, _FREQUENCIES = 3, 150, 256, 80


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
    safe : float or None
        The loop is stable for all ranges widened about their middles by this factor, by an upper
        bound of the structured singular value over a grid of frequencies; 1 or more is all of the
        set. None without slycot.
    """

    damping: Found
    margin: Found
    gain: Found
    unstable: int
    tried: int
    excluded: int
    safe: float | None

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
        if self.safe is None:
            lines.append("no bound: pip install 'fflin[robust]' has the structured singular value")
        elif self.safe >= 1.0:
            lines.append(f"stable on all of the set, up to {self.safe:.3g} times as wide (bound)")
        else:
            lines.append(f"stable for sure on {100.0 * self.safe:.3g} % of each range (bound)")
        return folded(lines)


def searched(of: Any, lft: LFT, gain: Any, samples: int, seed: int) -> Worst:
    """Do what `Uncertain.worst` does."""
    K = as_double("gain", getattr(gain, "K", gain))
    if K.shape != lft.B2.T.shape:
        raise InputError(f"gain has shape {K.shape}, expected {lft.B2.T.shape} (nu, nx)")
    R = getattr(gain, "R", np.eye(len(K)))
    middle = lft.at(np.zeros(len(lft.repeats)))
    if np.linalg.eigvals(middle[0] - middle[1] @ K).real.max() >= 0.0:
        raise InputError("the loop in the middle of the ranges is unstable; give another gain")
    draws, excluded = of.draws(samples, seed=seed)
    if len(lft.repeats) > np.log2(_CORNERS):
        signs = np.random.default_rng(seed).integers(0, 2, (_CORNERS, len(lft.repeats)))
        corners = 2.0 * signs - 1.0
    else:
        corners = np.array(list(product((-1.0, 1.0), repeat=len(lft.repeats))))
    physical = np.array([of.makes(corner) for corner in corners])
    excluded += int((~physical).sum())
    tried = np.vstack((draws, corners[physical], np.zeros((1, len(lft.repeats)))))

    def loop(delta: Array) -> tuple[Array, Array, Array]:
        A, B, C, _ = lft.at(delta)
        return A - B @ K, B, C

    def damping(delta: Array) -> float:
        poles = np.linalg.eigvals(loop(delta)[0])
        return float((-poles.real / np.maximum(np.abs(poles), 1e-300)).min())

    def margin(delta: Array) -> float:
        A, B, _, _ = lft.at(delta)
        return input_margins(A, B, K, R, 0.0).disk if damping(delta) > 0.0 else 0.0

    def less_gain(delta: Array) -> float:
        F, B, C = loop(delta)
        if damping(delta) <= 0.0:
            return -np.inf
        return -largest_gain(F, B, C, np.zeros((len(C), B.shape[1])))

    def least(figure: Callable[[Array], float]) -> Found:
        value, at = _least(figure, tried, of.makes)
        return Found(value, of.values(at))

    largest = least(less_gain)
    return Worst(
        damping=least(damping),
        margin=least(margin),
        gain=Found(-largest.value, largest.parameters),
        unstable=sum(damping(delta) <= 0.0 for delta in tried),
        tried=len(tried),
        excluded=excluded,
        safe=_safe(lft, K, middle),
    )


def _least(
    figure: Callable[[Array], float], tried: Array, makes: Callable[[Array], bool]
) -> tuple[float, Array]:
    """Return the least of a figure and where it is: of what was tried, and from there downhill."""
    from scipy.optimize import minimize

    values = np.array([figure(delta) for delta in tried])
    order = np.argsort(values)
    best, at = float(values[order[0]]), tried[order[0]]

    def walled(delta: Array) -> float:
        delta = np.clip(delta, -1.0, 1.0)
        return figure(delta) if makes(delta) else float(values.max())

    for start in tried[order[:_STARTS]]:
        if not np.isfinite(best):
            break
        options = {"maxfev": _STEPS, "xatol": 1e-4, "fatol": 1e-9}
        found = minimize(walled, start, method="Nelder-Mead", options=options)
        if found.fun < best:
            best, at = float(found.fun), np.clip(found.x, -1.0, 1.0)
    return best, at


def _safe(lft: LFT, K: Array, middle: Any) -> float | None:
    """Return by how much the set may be widened: the inverse of the largest bound on mu."""
    try:
        from slycot import ab13md
    except ImportError:
        return None
    poles = np.linalg.eigvals(middle[0] - middle[1] @ K)
    sizes = np.abs(poles)
    grid = np.geomspace(0.01 * sizes.min(), 100.0 * sizes.max(), _FREQUENCIES)
    blocks = lft.repeats.astype(int)
    real = np.where(blocks == 1, 1, 2)
    F, C = lft.A - lft.B2 @ K, lft.C1 - lft.D12 @ K
    largest = float(ab13md(lft.D11, blocks, real)[0])  # at frequencies without end
    for frequency in np.sort(np.concatenate(((0.0,), grid, np.abs(poles.imag), sizes))):
        response = np.linalg.solve(1j * frequency * np.eye(len(F)) - F, lft.B1)
        Z = C @ response + lft.D11
        largest = max(largest, float(ab13md(Z, blocks, real)[0]))
    return 1.0 / largest if largest else np.inf
