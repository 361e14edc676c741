"""Loops with matrices that repeat after N samples: their stability, and changes of channels.

A loop x_{k+1} = F_j x_k + G_j w_k, z_k = H_j x_k + J_j w_k with j = k mod N has perturbations w of
n channels. A signal with the angle theta [rad] per sample causes signals at the N harmonics
theta + 2 pi k/N. The response relates the harmonics of all channels. It is the frequency response
of a system that does not vary with time, so structured singular values apply to it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cached_property, partial
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from fflin.base.validation import Array, Mask, Values
from fflin.control.optimal.disk import Peak, best_scaling, worst_perturbation

# Number of angles of a grid on a linear and on a logarithmic scale, and the smallest angle relative
# to the largest.
_LINEAR, _DECADES, _SMALLEST = 250, 350, 1e-7
# Angles near each pole, in units of its decay per sample.
_NEAR = np.array(
    [-8.0, -4.0, -2.0, -1.0, -0.5, -0.2, 0.0, 0.2, 0.5, 1.0, 2.0, 4.0, 8.0]
)
# Angles are apart by at least this fraction of an angle.
_APART = 1e-6

# Relative accuracy of the largest structured singular value, and the most local maxima examined.
_ACCURACY = 1e-7
_MAXIMA = 4
_MOST_SCALINGS = 60

# Angles are added until the phase changes by at most _STEP [rad] between neighbours. There are at
# most _REFINEMENTS rounds, which end above _MOST_ANGLES angles.
_STEP = 1.0
_REFINEMENTS = 30
_MOST_ANGLES = 20000

# Ladder of gain factors, and of whole samples of delay.
_LARGEST_FACTOR = 1e6
_FACTOR = 1.01
_EACH_SAMPLE = 40
_SAMPLES = 1.03
_MOST_SAMPLES = 10**5


class PeriodicLoop(NamedTuple):
    """Loop with the matrices F (N, nx, nx), G (N, nx, n), H (N, n, nx) and J (N, n, n)."""

    F: Array
    G: Array
    H: Array
    J: Array

    @property
    def radius(self) -> float:
        """Largest magnitude of the poles of a period."""
        poles = np.linalg.eigvals(monodromy(self.F))
        return float(np.abs(poles).max(initial=0.0))

    def channel(self, index: int) -> PeriodicLoop:
        """Return the loop of one channel, with the other channels unperturbed."""
        part = slice(index, index + 1)
        return PeriodicLoop(
            self.F, self.G[:, :, part], self.H[:, part], self.J[:, part, part]
        )

    def with_factor(self, factor: float) -> PeriodicLoop:
        """Return the loop of one channel whose signal is multiplied by a factor."""
        more = factor - 1.0
        # J is 1/2 plus the direct response to a change.
        through = more / (1.0 - more * (self.J - 0.5))
        return self._replace(F=self.F + self.G @ (through * self.H))


def monodromy(F: Array) -> Array:
    """Return the transition matrix (nx, nx) of a period of the matrices F (N, nx, nx)."""
    product = np.eye(F.shape[1])
    for one in F:
        product = one @ product
    return product


def lifted(loop: PeriodicLoop) -> tuple[Array, Array, Array, Array]:
    """Return A, B, C and D of a system whose sample is a period of the loop.

    Its signals are the signals of all N samples: the n channels of the first sample come first.
    """
    count, size, channels = loop.G.shape
    rows = loop.H.shape[1]
    A, B = np.eye(size), np.zeros((size, count * channels))
    C, D = np.zeros((count * rows, size)), np.zeros((count * rows, count * channels))
    for j, (F, G, H, J) in enumerate(zip(*loop, strict=True)):
        inputs = slice(j * channels, (j + 1) * channels)
        outputs = slice(j * rows, (j + 1) * rows)
        C[outputs], D[outputs] = H @ A, H @ B
        D[outputs, inputs] += J
        A, B = F @ A, F @ B
        B[:, inputs] += G
    return A, B, C, D


def steady_states(F: Array, G: Values, angle: float = 0.0) -> Values:
    """Return the steady states (N, nx, k) at each sample, for inputs e^(j angle sample).

    F (N, nx, nx) and G (N, nx, k) repeat after N samples. The factor e^(j angle sample) of the
    states is left out.
    """
    count, size = F.shape[:2]
    z = np.exp(1j * angle) if angle else 1.0
    effect = np.zeros_like(G[0] * z)
    for k in range(count):
        effect = F[k] @ effect + G[k] * z**k
    over_period = z**count * np.eye(size) - monodromy(F)
    states = [np.linalg.solve(over_period, effect)]
    for k in range(count - 1):
        states.append((F[k] @ states[-1] + G[k]) / z)
    result: Values = np.array(states)
    return result


def steady_covariances(F: Array, W: Array) -> Array:
    """Return the covariances (N, nx, nx) of the states at each sample, for white noise.

    F (N, nx, nx) and the covariances W (N, nx, nx) of the noise repeat after N samples.
    """
    from scipy.linalg import solve_discrete_lyapunov

    total = np.zeros(F.shape[1:])
    for one, noise in zip(F, W, strict=True):
        total = one @ total @ one.T + noise
    covariances = [solve_discrete_lyapunov(monodromy(F), total)]
    for one, noise in zip(F[:-1], W[:-1], strict=True):
        covariances.append(one @ covariances[-1] @ one.T + noise)
    return np.array(covariances)


class Harmonics:
    """Response of a periodic loop, at the angles of a grid and at others."""

    def __init__(self, loop: PeriodicLoop) -> None:
        self.count, _, self.channels = loop.G.shape
        self._lifted = lifted(loop)

    @cached_property
    def angles(self) -> Array:
        """Angles [rad] of the grid, which are dense near the poles."""
        return self._grid()

    @cached_property
    def responses(self) -> Values:
        """Responses (k, N n, N n) at the angles of the grid."""
        return self.at(self.angles)

    def _grid(self) -> Array:
        """Return ascending angles [rad], from 0 to pi/N."""
        end = math.pi / self.count
        poles = np.linalg.eigvals(self._lifted[0])
        poles = poles[np.abs(poles) > _SMALLEST]
        middles = np.abs(np.angle(poles)) / self.count
        widths = np.abs(np.log(np.abs(poles))) / self.count
        near = (middles[:, None] + widths[:, None] * _NEAR).ravel()
        near = near[(near > 0.0) & (near < end)]
        angles = np.concatenate(
            (
                np.linspace(0.0, end, _LINEAR),
                end * np.geomspace(_SMALLEST, 1.0, _DECADES),
                near,
            )
        )
        angles = np.unique(angles)
        apart = np.diff(angles, prepend=-1.0) > _APART * angles
        return angles[apart]

    def at(self, angles: Array) -> Values:
        """Return the responses (k, N n, N n) at angles (k,) [rad].

        The entries of a harmonic are adjacent.
        """
        A, B, C, D = self._lifted
        periods = np.exp(1j * self.count * angles)[:, None, None]
        inner = periods * np.eye(len(A)) - A
        lifted = D + C @ np.linalg.solve(inner, B.astype(complex))
        steps = np.arange(self.count)
        harmonics = 2.0 * math.pi * np.outer(steps, steps) / self.count
        shifts = angles[:, None, None] * steps[:, None] + harmonics
        basis = np.exp(1j * shifts) / math.sqrt(self.count)
        basis = np.kron(basis, np.eye(self.channels))
        response: Values = basis.conj().mT @ lifted @ basis
        return response

    def one(self, angle: float) -> Values:
        """Return the response (N n, N n) at an angle [rad]."""
        response: Values = self.at(np.array([angle]))[0]
        return response

    def peak(self) -> tuple[float, float, Array]:
        """Return the largest bound of the structured singular value, its angle, and the scaling.

        It is bounded at the angles of the grid, and then between the neighbours of the largest
        local maxima.
        """
        bounds = np.linalg.norm(self.responses, 2, axis=(1, 2))
        tried = dict[int, tuple[float, Array]]()
        best = 0.0
        for _ in range(_MOST_SCALINGS):
            index = int(bounds.argmax())
            if index in tried and bounds[index] <= best * (1.0 + _ACCURACY):
                break
            value, d = best_scaling(self.responses[index])
            tried[index] = value, d
            best = max(best, value)
            scaled = d[:, None] * self.responses / d
            bounds = np.minimum(bounds, np.linalg.norm(scaled, 2, axis=(1, 2)))
            bounds[index] = value
        values = {index: value for index, (value, _) in tried.items()}
        maxima = [
            self._climbed(index, *tried[index]) for index in _separate_maxima(values)
        ]
        return max(maxima, key=lambda result: result[0])

    def _climbed(
        self, index: int, value: float, d: Array
    ) -> tuple[float, float, Array]:
        """Return the local maximum of the bound near an angle of the grid."""
        from scipy.optimize import minimize_scalar

        best = value, float(self.angles[index]), d
        last = len(self.angles) - 1
        ends = self.angles[max(index - 1, 0)], self.angles[min(index + 1, last)]

        def cost(angle: float) -> float:
            nonlocal best
            bound, scaling = best_scaling(self.one(angle), best[2])
            if bound > best[0]:
                best = bound, angle, scaling
            return -bound

        width = ends[1] - ends[0]
        options = {"xatol": 1e-6 * width, "maxiter": 40}
        minimize_scalar(cost, bounds=ends, method="bounded", options=options)
        return best

    def structured_peak(self) -> Peak:
        """Return the largest structured singular value; its frequency is an angle [rad].

        The perturbation has one value for each harmonic of each channel.
        """
        value, angle, d = self.peak()
        reached, perturbation = worst_perturbation(self.one(angle), d, value)
        return Peak(value, angle, reached, perturbation)

    def strongest(self, angle: float, perturbation: Values) -> int:
        """Return the strongest harmonic of the oscillation that a perturbation causes."""
        loop = self.one(angle) * perturbation
        values, vectors = np.linalg.eig(loop)
        vector = vectors[:, np.abs(values - 1.0).argmin()]
        powers = (np.abs(vector) ** 2).reshape(self.count, self.channels).sum(axis=1)
        return int(powers.argmax())


def _separate_maxima(values: dict[int, float]) -> list[int]:
    """Return the indices of the _MAXIMA largest values, of which no two are neighbours."""
    chosen = list[int]()
    for index in sorted(values, key=lambda index: -values[index]):
        if all(abs(index - other) > 1 for other in chosen):
            chosen.append(index)
    return chosen[:_MAXIMA]


class ChannelHarmonics:
    """Effects of a factor and of a delay of whole samples in one channel of a stable loop."""

    def __init__(self, harmonics: Harmonics, index: int) -> None:
        self._harmonics = harmonics
        self._part = slice(index, None, harmonics.channels)
        self._steps = 2.0 * math.pi * np.arange(harmonics.count) / harmonics.count
        self._unit = np.eye(harmonics.count)
        self._angles = harmonics.angles
        self._response = self._of_channel(harmonics.responses)
        # Eigenvalues (k, N) of the responses, which give the determinants for all factors.
        self._eigenvalues = np.linalg.eigvals(self._response)

    def _of_channel(self, responses: Values) -> Values:
        """Return the responses (k, N, N) of the channel's signal to a signal added to it."""
        values: Values = responses[:, self._part, self._part] - 0.5 * self._unit
        return values

    def gain_intervals(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Return the intervals of factors, below 1 and above 1, in which stability is lost.

        The first is (0, 0) and the second (inf, inf) if there is no limit.
        """
        count = math.ceil(math.log(_LARGEST_FACTOR) / math.log(_FACTOR))
        factors = (_FACTOR ** np.arange(count + 1)).tolist()
        larger = self._first_unstable(factors)
        smaller = self._first_unstable([1.0 / factor for factor in factors])
        low = smaller[::-1] if smaller else (0.0, 0.0)
        high = larger or (math.inf, math.inf)
        return low, high

    def _first_unstable(self, factors: list[float]) -> tuple[float, float] | None:
        """Return the first factor that makes the loop unstable, after the factor before it."""
        for before, factor in pairwise(factors):
            if self._is_unstable(partial(self._with_factor, factor)):
                return before, factor
        return None

    def delay_interval(self) -> tuple[int, float] | None:
        """Return the largest delay in whole samples before the loop becomes unstable.

        Up to 40 samples, each delay is tried, and then delays in steps of 3 %. The second value is
        the angle [rad] of the oscillation at a slightly longer delay. None if the loop stays
        stable.
        """
        before, samples = 0, 1
        while not self._is_unstable(partial(self._with_delay, samples)):
            before = samples
            samples += 1
            if samples > _EACH_SAMPLE:
                samples = math.floor(samples * _SAMPLES)
            if samples > _MOST_SAMPLES:
                return None
        while samples - before > 1:
            middle = (samples + before) // 2
            if self._is_unstable(partial(self._with_delay, middle)):
                samples = middle
            else:
                before = middle
        sizes = np.abs(self._with_delay(samples))
        return before, float(self._angles[sizes.argmin()])

    def _with_factor(self, factor: float) -> Values:
        """Return det(E - (factor - 1) response) at all angles."""
        values: Values = np.prod(1.0 - (factor - 1.0) * self._eigenvalues, axis=1)
        return values

    def _with_delay(self, samples: int) -> Values:
        """Return det(E - (delay - E) response) at all angles."""
        harmonics = self._angles[:, None] + self._steps
        more = np.exp(-1j * samples * harmonics) - 1.0
        values: Values = np.linalg.det(self._unit - more[:, :, None] * self._response)
        return values

    def _is_unstable(self, difference: Callable[[], Values]) -> bool:
        """Return whether a determinant encircles zero for angles from 0 to pi/N.

        Then the changed loop is unstable, because the original loop is stable. The values for other
        angles follow by symmetry. Angles are added where the phase changes fast.
        """
        for _ in range(_REFINEMENTS):
            values = difference()
            steps = np.angle(values[1:] / values[:-1])
            fast = np.abs(steps) > _STEP
            if not fast.any() or len(values) > _MOST_ANGLES:
                break
            self._refine(fast)
        return bool(abs(steps.sum()) > 0.5 * math.pi)

    def _refine(self, fast: Mask) -> None:
        """Add an angle in the middle of some of the intervals."""
        at = np.flatnonzero(fast)
        angles = 0.5 * (self._angles[at] + self._angles[at + 1])
        response = self._of_channel(self._harmonics.at(angles))
        self._angles = np.insert(self._angles, at + 1, angles)
        self._response = np.insert(self._response, at + 1, response, axis=0)
        eigenvalues = np.linalg.eigvals(response)
        self._eigenvalues = np.insert(self._eigenvalues, at + 1, eigenvalues, axis=0)


def difference_with_delay(
    harmonics: Harmonics, index: int, angle: float, samples: int
) -> complex:
    """Return det(E - (delay - E) response) of a channel; zero at the angle of an oscillation."""
    part = slice(index, None, harmonics.channels)
    unit = np.eye(harmonics.count)
    response = harmonics.one(angle)[part, part] - 0.5 * unit
    steps = 2.0 * math.pi * np.arange(harmonics.count) / harmonics.count
    more = np.exp(-1j * samples * (angle + steps)) - 1.0
    return complex(np.linalg.det(unit - more[:, None] * response))
