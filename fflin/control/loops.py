"""The loop of each input, broken there while all others stay closed, and what it bears."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from fflin.base.validation import Array
from fflin.control.gain import Gain

_POINTS = 400

# A factor on the gain below this is none: at low frequencies a loop with an integrator is infinite.
_NOTHING = 1e-6


class Loop(NamedTuple):
    """What the loop of one input bears, the others closed.

    Attributes
    ----------
    crossings : tuple of (float, float)
        Where its gain is one: frequency [rad/s] and phase [deg], in (-360, 0].
    turns : tuple of (float, float)
        Where its phase is -180 deg: frequency [rad/s] and gain.
    """

    crossings: tuple[tuple[float, float], ...]
    turns: tuple[tuple[float, float], ...]

    @property
    def phase(self) -> float:
        """Lag or lead [deg] that it bears; infinite where its gain is never one."""
        return min((abs(180.0 + angle) for _, angle in self.crossings), default=math.inf)

    @property
    def gain(self) -> tuple[float, float]:
        """Factors between which its gain may lie."""
        factors = [1.0 / size if size else math.inf for _, size in self.turns]
        low = max((each for each in factors if _NOTHING < each < 1.0), default=0.0)
        return low, min((each for each in factors if each > 1.0), default=math.inf)


def input_loops(gain: Gain) -> tuple[Array, Array, tuple[Loop, ...]]:
    r"""Return frequencies (k,) [rad/s], the loops' responses (k, nu) there, and what each bears.

    With :math:`T = K (s E - A + B K)^{-1} B` the loop of input i is
    :math:`L_i = T_{ii}/(1 - T_{ii})`, of a sampled model at :math:`s = e^{j \omega h}`.
    """
    F, B, K, dt = gain.closed_loop, gain.B, gain.K, gain.dt

    def response(w: float) -> Array:
        s = np.exp(1j * w * dt) if dt else 1j * w
        T = np.einsum("ij,ji->i", K, np.linalg.solve(s * np.eye(len(F)) - F, B))
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(T / (1.0 - T))

    rates = np.abs(np.log(gain.poles[gain.poles != 0.0]) / dt if dt else gain.poles)
    end = math.pi / dt if dt else 100.0 * float(rates.max())
    own = np.abs(np.linalg.eigvals(gain.A).imag)
    start = min(float(rates.min()), end) / 100.0
    grid = np.geomspace(start, end, _POINTS)
    if not dt:
        grid = np.union1d(grid, own[(own > start) & (own < end)])
    values = np.array([response(w) for w in grid])
    # At the ends of the axis a loop is real, and its phase may be -180 deg there.
    ends = [(0.0, response(0.0)), *([(end, values[-1])] if dt else [])]
    return grid, values, tuple(_loop(i, response, grid, values, ends) for i in range(len(K)))


def _loop(
    i: int,
    response: Callable[[float], Array],
    grid: Array,
    values: Array,
    ends: list[tuple[float, Array]],
) -> Loop:
    def where(value: Callable[[Array], Array], among: Array) -> list[float]:
        """Return the frequencies at which a function of the response changes its sign."""
        from scipy.optimize import brentq

        signs = np.signbit(value(values[:, i]))
        at = np.flatnonzero((signs[1:] != signs[:-1]) & among[1:] & among[:-1])
        return [
            float(brentq(lambda w: float(value(response(w)[i])), grid[k], grid[k + 1])) for k in at
        ]

    # A gain that stands at one, as that of no loop does, crosses it nowhere.
    crossed = where(lambda L: np.log(np.abs(L)), np.abs(values[:, i]) > 0.0)
    turned = where(lambda L: np.imag(L), values[:, i].real < 0.0)
    turns = [(w, response(w)[i]) for w in turned] + [(w, value[i]) for w, value in ends]
    return Loop(
        tuple((w, _degrees(response(w)[i])) for w in crossed),
        tuple((w, abs(value)) for w, value in turns if value.real < 0.0),
    )


def _degrees(value: complex) -> float:
    angle = math.degrees(math.atan2(value.imag, value.real))
    return angle if angle <= 0.0 else angle - 360.0
