"""How much a loop's inputs may change before it is unstable."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from fflin.base.validation import Array

_ACCURACY = 1e-5


class Margins(NamedTuple):
    """Changes that every input tolerates at once, whatever the others do.

    Attributes
    ----------
    disk : float
        The symmetric disk margin, 2 at most; 0 where the loop is at the limit.
    gain : tuple of float
        Factors between which the gain of each input may lie.
    phase : float
        Lag or lead of each input [deg].
    """

    disk: float
    gain: tuple[float, float]
    phase: float


def input_margins(A: Array, B: Array, K: Array, R: Array, dt: float) -> Margins:
    r"""Return the margins at the inputs of a stable loop u = -K x.

    The disk margin is :math:`1/\|(S - T)/2\|_\infty` with the sensitivity S and T = E - S at the
    inputs, each counted in :math:`\sqrt{R_{ii}}`. The norm comes from eigenvalues of Hamiltonian
    matrices, not from a grid of frequencies, to five digits.

    References
    ----------
    P. Seiler, A. Packard and P. Gahinet, IEEE Control Systems 40(5), 2020. N. A. Bruinsma and
    M. Steinbuch, Systems and Control Letters 14(4), 1990.
    """
    scale = np.sqrt(R.diagonal())
    F, G, H, D = A - B @ K, B / scale, -scale[:, None] * K, 0.5 * np.eye(len(K))
    if dt:
        # The bilinear map s = (z - 1)/(z + 1) preserves the norm.
        inverse = np.linalg.inv(F + np.eye(len(F)))
        D = D - H @ inverse @ G
        F, G, H = inverse @ (F - np.eye(len(F))), 2.0**0.5 * inverse @ G, 2.0**0.5 * H @ inverse
    disk = min(1.0 / largest_gain(F, G, H, D), 2.0)
    gain = ((2.0 - disk) / (2.0 + disk), (2.0 + disk) / (2.0 - disk) if disk < 2.0 else math.inf)
    return Margins(disk, gain, math.degrees(2.0 * math.atan(disk / 2.0)))


def largest_gain(A: Array, B: Array, C: Array, D: Array) -> float:
    """Return the largest gain over all frequencies of a stable system, to five digits."""

    def gain(frequency: float) -> float:
        response = D + C @ np.linalg.solve(1j * frequency * np.eye(len(A)) - A, B)
        return float(np.linalg.norm(response, 2))

    poles = np.linalg.eigvals(A)
    norm = max(float(np.linalg.norm(D, 2)), *map(gain, {0.0, *np.abs(poles).tolist()}))
    while True:
        bound = norm * (1.0 + _ACCURACY)
        inverse = np.linalg.inv(bound**2 * np.eye(D.shape[1]) - D.T @ D)
        F = A + B @ inverse @ D.T @ C
        spread = C.T @ (np.eye(len(D)) + D @ inverse @ D.T) @ C
        crossings = np.linalg.eigvals(np.block([[F, B @ inverse @ B.T], [-spread, -F.T]]))
        # The gain crosses the bound at eigenvalues on the imaginary axis; one too many in this list
        # costs only another evaluation.
        on_axis = np.abs(crossings.real) <= 1e-6 * np.abs(crossings)
        frequencies = np.sort(np.abs(crossings.imag[on_axis]))
        between = np.concatenate((frequencies, 0.5 * (frequencies[1:] + frequencies[:-1])))
        best = max(map(gain, between.tolist()), default=0.0)
        if best <= bound:
            return max(norm, best)
        norm = best
