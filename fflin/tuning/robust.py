"""Upper bounds of goals over all values of the uncertain parameters of a plant."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from fflin.base.validation import Array, Values
from fflin.tuning.channels import Ends, channel_of
from fflin.tuning.closed_loop import ClosedLoop
from fflin.tuning.criteria import weights_at
from fflin.tuning.goals import Goal, Margin, MaxGain, RollOff
from fflin.tuning.law import Law, embedded
from fflin.tuning.minimal import Reduction
from fflin.tuning.plant import Plant, plant_of
from fflin.uncertainty.gain_bound import Channels, gain_bound
from fflin.uncertainty.lft import LFT

# Frequencies of the logarithmic grid, and how far it reaches beyond the poles.
_GRID, _BEYOND = 40, 100.0

# Distances of frequencies from a resonance in widths of its peak.
_WIDTHS = (0.0, -1.0, 1.0, -4.0, 4.0)

# Factor between the value that a search found and the first bound that is tried.
_ABOVE = 1.01

# Values of goals below this one count as this one.
_LEAST = 1e-9


class UncertainLoop:
    """Closed loop of a law and a plant whose uncertain parameters are channels."""

    def __init__(self, lft: LFT, law: Law, reduction: Reduction) -> None:
        """Close the loop of a law and a plant without its hidden states."""
        self._ny, nu = lft.D22.shape
        self._nw = len(lft.C1)
        self._nu = nu
        plant = _plant(lft, reduction)
        ny = self._ny
        law = embedded(law, range(ny), range(nu), ny + self._nw, nu + self._nw)
        self._loop = ClosedLoop(plant, law)

    def bound(self, goal: Goal, ends: Ends | None, value: float) -> tuple[float, str]:
        """Return an upper bound of the value of a goal over the whole range, and why there is none.

        The first bound that is tried is 1.01 times `value`, the largest value that is known, or 1
        if the goal just holds. The result is infinite if no bound was found, and NaN for goals
        that are not gains.
        """
        if ends is None or not isinstance(goal, MaxGain | RollOff | Margin):
            return math.nan, "no bound: only gains and margins have one"
        if not self._loop.is_stable or not math.isfinite(value):
            return math.inf, "no bound: the loop is not stable"
        channels = self._channels(goal, ends)
        level = _ABOVE * max(value, _LEAST)
        if value <= 1.0 < level:
            level = 1.0
        bound = gain_bound(channels, self._rates(ends), level)
        if math.isfinite(bound.value):
            return bound.value, ""
        reason = (
            f"no bound was found near {bound.missing:.3g} rad/s; give narrower ranges, or more "
            "damping there"
        )
        return math.inf, reason

    def _channels(self, goal: Goal, ends: Ends) -> Channels:
        """Return the response of the loop with the channels of the parameters and of a goal."""
        nw, k, m = self._nw, len(ends.sources), len(ends.sinks)
        loop = self._loop
        ones = np.ones(nw)
        everything = Ends(
            (*(("input", self._nu + i) for i in range(nw)), *ends.sources),
            (*(("output", self._ny + i) for i in range(nw)), *self._moved(ends)),
            np.concatenate((ones, ends.source_sizes)),
            np.concatenate((ones, ends.sink_sizes)),
        )
        is_margin = isinstance(goal, Margin)
        plain = MaxGain("w", "z")
        system = loop.system(channel_of(plain, everything, loop.plant))
        low, high = ends.band
        size = nw + max(k, m)

        def response(frequencies: Array) -> Values:
            values = np.zeros((len(frequencies), size, size), complex)
            inner = loop.responses(system, frequencies)
            if is_margin:
                inner[:, nw:, nw:] += 0.5 * np.eye(m)
            weights = weights_at(loop, ends, frequencies)
            middle = frequencies[len(frequencies) // 2]
            inside = low <= middle <= high
            values[:, : nw + m, : nw + k] = inner
            values[:, nw:] *= weights[:, None, None] * inside
            return values

        group: Array = np.zeros(size - nw)
        if is_margin:
            group = np.arange(size - nw, dtype=float)
        return Channels(response, nw, group)

    def _moved(self, ends: Ends) -> list[tuple[str, int]]:
        """Return the sinks of a goal among the outputs, the parameters and the states."""
        return [
            (
                kind,
                index + self._nw if kind == "output" and index >= self._ny else index,
            )
            for kind, index in ends.sinks
        ]

    def _rates(self, ends: Ends) -> Array:
        """Return frequencies [rad/s] that separate intervals."""
        poles = self._loop.poles
        sizes = np.abs(poles)
        sizes = sizes[sizes > 0.0]
        grid = np.geomspace(sizes.min() / _BEYOND, sizes.max() * _BEYOND, _GRID)
        peaks = [np.abs(poles.imag) + width * poles.real for width in _WIDTHS]
        edges: Sequence[float] = [edge for edge in ends.band if math.isfinite(edge)]
        rates = np.concatenate((grid, sizes, *peaks, edges, ends.weight.corners))
        found: Array = np.unique(rates[(rates > 0.0) & np.isfinite(rates)])
        return found


def _plant(lft: LFT, reduction: Reduction) -> Plant:
    """Return the plant with inputs (u, w), and outputs (y, z) before the states."""
    matrices = (
        lft.A,
        np.hstack((lft.B2, lft.B1)),
        np.vstack((lft.C2, lft.C1)),
        np.block([[lft.D22, lft.D21], [lft.D12, lft.D11]]),
    )
    return plant_of(matrices, 0.0, reduction)
