"""The loops of a set of robots: how bad each is, which way it gets worse, and the worst of them."""

from __future__ import annotations

from collections.abc import Callable
from itertools import islice
from operator import itemgetter
from typing import NamedTuple

import numpy as np

from fflin.base.validation import Array
from fflin.control.margins import largest_gain
from fflin.uncertainty.lft import LFT

# Ends of a search, steps of each, and how far these go, relative to half a range; 1e9 to a corner.
_STARTS, _STEPS, _LENGTHS = 3, 25, np.array((1e9, 1.0, 0.3, 0.1, 0.03, 0.01, 1e-3))
# Loops held exactly in a step, and frequencies at which the others are judged.
_HELD, _FREQUENCIES = 3, 6


class Gain(NamedTuple):
    """From a disturbance over `scale` at the inputs to C x, and D of the disturbance."""

    C: Array
    D: Array
    scale: Array


class Loops:
    """Loops u = -K x of the robots of a fraction, deltas in rows (N, k); unstable ones are bad."""

    def __init__(self, lft: LFT, K: Array) -> None:
        self.lft, self.K = lft, K
        self.z_by_x = lft.C1 - lft.D12 @ K
        self.block = np.repeat(np.arange(len(lft.repeats)), lft.repeats.astype(int))

    def matrices(self, rows: Array) -> tuple[Array, Array]:
        """Return A - B K and B."""
        A, B, _, _ = self.lft.at(rows)
        return A - B @ self.K, B

    def undamped(self, rows: Array) -> Array:
        """Return minus the least damping ratio (N,); 0 or more where a loop is unstable."""
        poles = np.linalg.eigvals(self.matrices(rows)[0])
        return (poles.real / np.maximum(np.abs(poles), 1e-300)).max(axis=-1)

    def undamped_slope(self, delta: Array) -> tuple[float, Array]:
        """Return that of one loop, and its slope (k,) over delta."""
        from scipy.linalg import eig

        given, taken, _ = self._through(delta)
        poles, left, right = eig(self.matrices(delta)[0], left=True)
        sizes = np.maximum(np.abs(poles), 1e-300)
        at = int((poles.real / sizes).argmax())
        pole, size, y, x = poles[at], sizes[at], left[:, at].conj(), right[:, at]
        with np.errstate(all="ignore"):  # poles that coincide have no slope
            moved = (y @ given) * (taken @ x) / (y @ x)
            slope = moved.real / size - pole.real * (pole.conjugate() * moved).real / size**3
        return float(pole.real / size), self._by_block(slope)

    def gains(self, of: Gain, rows: Array, frequencies: Array) -> Array:
        """Return the largest gains (N,) at these frequencies, infinite of unstable loops."""
        F, B = self.matrices(rows)
        E = np.eye(F.shape[-1])
        found = np.zeros(len(F))
        for w in frequencies:
            response = of.C @ np.linalg.solve(1j * w * E - F, B * of.scale) + of.D
            gram = response.conj().mT @ response
            found = np.maximum(found, np.linalg.eigvalsh(gram)[..., -1].clip(0.0))
        return np.where(self.undamped(rows) >= 0.0, np.inf, np.sqrt(found))

    def gain_slope(self, of: Gain, delta: Array) -> tuple[float, Array, float]:
        """Return the largest gain of one loop over all frequencies, its slope, and where it is."""
        F, B = self.matrices(delta)
        if np.linalg.eigvals(F).real.max() >= 0.0:
            return np.inf, np.zeros(len(delta)), 0.0
        value, w = largest_gain(F, B * of.scale, of.C, of.D)
        if not np.isfinite(w):
            return value, np.zeros(len(delta)), 0.0
        given, taken, direct = self._through(delta)
        resolvent = np.linalg.inv(1j * w * np.eye(len(F)) - F)
        left, _, right = np.linalg.svd(of.C @ resolvent @ (B * of.scale) + of.D)
        v = of.scale * right[0].conj()
        u = left[:, 0].conj() @ of.C @ resolvent @ given
        return value, self._by_block((u * (taken @ (resolvent @ (B @ v)) + direct @ v)).real), w

    def _through(self, delta: Array) -> tuple[Array, Array, Array]:
        """Return what w adds to the rate of x, and z over x and u, the other blocks closed."""
        lft, d = self.lft, delta[self.block]
        E = np.eye(len(d))
        z = np.linalg.solve(E - lft.D11 * d, np.hstack((self.z_by_x, lft.D12)))
        by_w = lft.B1 @ np.linalg.inv(E - d[:, None] * lft.D11)
        return by_w, z[:, : len(lft.A)], z[:, len(lft.A) :]

    def _by_block(self, slope: Array) -> Array:
        slope = np.nan_to_num(slope, nan=0.0, posinf=0.0, neginf=0.0)
        sums: Array = np.bincount(self.block, slope, minlength=len(self.lft.repeats))
        return sums

    def least_damped(self, tried: Array, makes: Callable[[Array], bool]) -> tuple[float, Array]:
        """Return the largest `undamped` that is found from what was tried, and its deltas."""
        return _largest(self.undamped, self.undamped_slope, tried, makes)

    def largest(
        self, of: Gain, tried: Array, makes: Callable[[Array], bool]
    ) -> tuple[float, Array]:
        """Return the largest gain that is found from what was tried, and its deltas."""
        middle = np.zeros((1, tried.shape[1]))
        sizes = np.unique(np.abs(np.linalg.eigvals(self.matrices(middle[0])[0])))
        at = sorted(sizes, key=lambda w: -self.gains(of, middle, np.array((w,)))[0])
        peaks = [0.0, *at[:_FREQUENCIES]]

        def slope(delta: Array) -> tuple[float, Array]:
            value, way, w = self.gain_slope(of, delta)
            peaks.append(w)  # where others like it have theirs
            return value, way

        def quick(rows: Array) -> Array:
            return self.gains(of, rows, np.unique(peaks[-_FREQUENCIES:]))

        return _largest(quick, slope, tried, makes)


def _largest(
    quick: Callable[[Array], Array],
    slope_of: Callable[[Array], tuple[float, Array]],
    tried: Array,
    makes: Callable[[Array], bool],
) -> tuple[float, Array]:
    """Climb a figure from the worst that was tried, along its slope and one delta at a time."""
    best, at = -np.inf, tried[0]
    for start in tried[np.argsort(-quick(tried))[:_STARTS]]:
        (value, slope), delta = slope_of(start), start
        for _ in range(_STEPS):
            steps = _LENGTHS[:, None] * slope / max(np.abs(slope).max(), 1e-300)
            alone = np.where(np.eye(len(delta), dtype=bool)[:, None], ((-1.0,), (1.0,)), delta)
            trials = np.vstack((np.clip(delta + steps, -1.0, 1.0), *alone))
            worse = trials[np.argsort(-quick(trials))]
            held = list(islice(filter(makes, worse), _HELD))
            ahead = [(*slope_of(trial), trial) for trial in held]
            highest = max(ahead, key=itemgetter(0), default=(value, slope, delta))
            if not highest[0] > value + 1e-9 * abs(value) or not np.isfinite(value):
                break
            value, slope, delta = highest
        if value > best:
            best, at = value, delta
    return best, at
