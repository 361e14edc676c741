"""Stability margins at the inputs of a loop: all inputs together, or one at a time."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from fflin.base.validation import Array, Values

if TYPE_CHECKING:
    from numpy.typing import NDArray


ACCURACY = 1e-5

_POINTS = 400

# A smaller gain factor counts as zero: with an integrator, the gain is infinite at rest.
_NOTHING = 1e-6


class Margins(NamedTuple):
    """Margins of gain and phase for simultaneous changes of all inputs.

    Attributes
    ----------
    disk : float
        Symmetric disk margin, at most 2; 0 at the stability boundary.
    gain : tuple of float
        Least and largest factor on the gain of each input.
    phase : float
        Phase lag or lead of each input [deg].
    """

    disk: float
    gain: tuple[float, float]
    phase: float


def input_margins(A: Array, B: Array, K: Array, R: Array, dt: float) -> Margins:
    """Return the margins at the inputs of a stable loop u = -K x, to five digits."""
    # Seiler, Packard and Gahinet, IEEE Control Systems 40(5), 2020: 1/|(S - T)/2| at the inputs,
    # each counted in sqrt(R_ii). Bruinsma and Steinbuch, Systems and Control Letters 14(4), 1990:
    # the norm by eigenvalues of Hamiltonian matrices, not from a grid of frequencies.
    scale = np.sqrt(R.diagonal())
    F, G, H, D = A - B @ K, B / scale, -scale[:, None] * K, 0.5 * np.eye(len(K))
    if dt:
        # The bilinear map s = (z - 1)/(z + 1) preserves the norm.
        inverse = np.linalg.inv(F + np.eye(len(F)))
        D = D - H @ inverse @ G
        F, G, H = inverse @ (F - np.eye(len(F))), 2.0**0.5 * inverse @ G, 2.0**0.5 * H @ inverse
    disk = min(1.0 / largest_gain(F, G, H, D)[0], 2.0)
    gain = ((2.0 - disk) / (2.0 + disk), (2.0 + disk) / (2.0 - disk) if disk < 2.0 else math.inf)
    return Margins(disk, gain, math.degrees(2.0 * math.atan(disk / 2.0)))


def largest_gain(A: Array, B: Array, C: Array, D: Array) -> tuple[float, float]:
    """Return the largest gain of a stable system, to five digits, and the frequency of it."""

    def gain(frequency: float) -> tuple[float, float]:
        response = D + C @ np.linalg.solve(1j * frequency * np.eye(len(A)) - A, B)
        return float(np.linalg.norm(response, 2)), frequency

    poles = np.linalg.eigvals(A)
    found = max((float(np.linalg.norm(D, 2)), math.inf), *map(gain, {0.0, *np.abs(poles).tolist()}))
    while True:
        bound = found[0] * (1.0 + ACCURACY)
        crossings, on_axis = gain_crossings(A, B, C, D, bound)
        frequencies = np.sort(np.abs(crossings.imag[on_axis]))
        between = np.concatenate((frequencies, 0.5 * (frequencies[1:] + frequencies[:-1])))
        best = max(map(gain, between.tolist()), default=found)
        if best[0] <= bound:
            return max(found, best)
        found = best


def gain_crossings(
    A: Array, B: Array, C: Array, D: Array, bound: float
) -> tuple[Values, NDArray[np.bool_]]:
    """Return eigenvalues (.., 2 nx), and which are imaginary: there the gain crosses the bound.

    A superfluous crossing costs only one more evaluation of the response.
    """
    inverse = np.linalg.inv(bound**2 * np.eye(D.shape[1]) - D.T @ D)
    F = A + B @ inverse @ D.T @ C
    spread = C.T @ (np.eye(len(D)) + D @ inverse @ D.T) @ C
    lower = np.concatenate((np.broadcast_to(-spread, F.shape), -F.mT), axis=-1)
    upper = np.concatenate((F, B @ inverse @ B.mT), axis=-1)
    crossings = np.linalg.eigvals(np.concatenate((upper, lower), axis=-2))
    return crossings, np.abs(crossings.real) <= 1e-6 * np.abs(crossings)


class Loop(NamedTuple):
    """Frequencies [rad/s] with the phase [deg] where the gain is 1, the gain where that is -180."""

    crossings: list[tuple[float, float]]
    turns: list[tuple[float, float]]

    @property
    def phase(self) -> float:
        """Phase margin [deg] for lag or lead; infinite if the loop gain is never 1."""
        each = (abs(math.remainder(angle - 180.0, 360.0)) for _, angle in self.crossings)
        return min(each, default=math.inf)

    @property
    def gain(self) -> tuple[float, float]:
        """Gain factors between which the loop is stable."""
        factors = [1.0 / size if size else math.inf for _, size in self.turns]
        low = max((each for each in factors if _NOTHING < each < 1.0), default=0.0)
        return low, min((each for each in factors if each > 1.0), default=math.inf)


def input_loops(gain: Any) -> tuple[Array, Values, list[Loop]]:
    """Return frequencies (k,) [rad/s], responses (k, nu) of a Gain's loops, and what each bears."""
    # With T = K (s E - A + B K)^-1 B the loop of input i is T_ii / (1 - T_ii), of a sampled model
    # at s = e^(j w h).
    fed = [gain.state_names.index(name) for name in gain.regulated or gain.state_names]
    F, B, K, dt = gain.closed_loop[np.ix_(fed, fed)], gain.B[fed], gain.K[:, fed], gain.dt

    def response(w: float) -> Values:
        s = np.exp(1j * w * dt) if dt else 1j * w
        T = np.einsum("ij,ji->i", K, np.linalg.solve(s * np.eye(len(F)) - F, B))
        with np.errstate(divide="ignore", invalid="ignore"):
            return T / (1.0 - T)

    rates = np.abs(np.log(gain.poles[gain.poles != 0.0]) / dt if dt else gain.poles)
    end = math.pi / dt if dt else 100.0 * float(rates.max())
    grid = np.geomspace(min(float(rates.min()), end) / 100.0, end, _POINTS)
    values = np.array([response(w) for w in grid])

    def changes(
        value: Callable[[Values], Array], i: int, among: NDArray[np.bool_]
    ) -> list[tuple[float, complex]]:
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
