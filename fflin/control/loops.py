"""The loop of each input, broken there while all others stay closed, and what it bears."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from fflin.base.validation import Array
from fflin.control.gain import Gain

_POINTS = 400

# A factor on the gain below this is none: a loop with an integrator is infinite at rest.
_NOTHING = 1e-6


class Loop(NamedTuple):
    """Frequencies [rad/s] with the phase [deg] where the gain is 1, the gain where that is -180."""

    crossings: list[tuple[float, float]]
    turns: list[tuple[float, float]]

    @property
    def phase(self) -> float:
        """Lag or lead [deg] that it bears; infinite where its gain is never one."""
        each = (abs(math.remainder(angle - 180.0, 360.0)) for _, angle in self.crossings)
        return min(each, default=math.inf)

    @property
    def gain(self) -> tuple[float, float]:
        """Factors between which its gain may lie."""
        factors = [1.0 / size if size else math.inf for _, size in self.turns]
        low = max((each for each in factors if _NOTHING < each < 1.0), default=0.0)
        return low, min((each for each in factors if each > 1.0), default=math.inf)


def input_loops(gain: Gain) -> tuple[Array, Any, list[Loop]]:
    """Return frequencies (k,) [rad/s], the loops' responses (k, nu) there, and what each bears."""
    # With T = K (s E - A + B K)^-1 B the loop of input i is T_ii / (1 - T_ii), of a sampled model
    # at s = e^(j w h).
    fed = [gain.state_names.index(name) for name in gain.regulated or gain.state_names]
    F, B, K, dt = gain.closed_loop[np.ix_(fed, fed)], gain.B[fed], gain.K[:, fed], gain.dt

    def response(w: float) -> Any:
        s = np.exp(1j * w * dt) if dt else 1j * w
        T = np.einsum("ij,ji->i", K, np.linalg.solve(s * np.eye(len(F)) - F, B))
        with np.errstate(divide="ignore", invalid="ignore"):
            return T / (1.0 - T)

    rates = np.abs(np.log(gain.poles[gain.poles != 0.0]) / dt if dt else gain.poles)
    end = math.pi / dt if dt else 100.0 * float(rates.max())
    grid = np.geomspace(min(float(rates.min()), end) / 100.0, end, _POINTS)
    values = np.array([response(w) for w in grid])

    def changes(value: Callable[[Any], Any], i: int, among: Any) -> list[tuple[float, complex]]:
        """Return where a function of response i changes its sign, and the response there."""
        from scipy.optimize import brentq

        signs = np.signbit(value(values[:, i]))
        at = np.flatnonzero((signs[1:] != signs[:-1]) & among[1:] & among[:-1])
        found = (brentq(lambda w: value(response(w)[i]), *grid[k : k + 2], xtol=1e-12) for k in at)
        return [(w, complex(response(w)[i])) for w in found]

    loops = []
    # At the ends of the axis a loop is real, and its phase may be -180 deg there.
    ends = [(0.0, response(0.0))] + [(end, values[-1])] * bool(dt)
    for i in range(len(K)):
        crossed = changes(lambda L: np.log(np.abs(L)), i, values[:, i] != 0.0)
        turned = changes(np.imag, i, values[:, i].real < 0.0)
        turned += [(w, complex(value[i])) for w, value in ends if value[i].real < 0.0]
        angles = [(w, math.degrees(np.angle(value))) for w, value in crossed]
        loops.append(Loop(angles, [(w, abs(value)) for w, value in turned]))
    return grid, values, loops
