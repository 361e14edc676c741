"""Exact sampling of linear systems whose inputs arrive late."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from functools import cache
from typing import NamedTuple, TypeAlias

import numpy as np

from fflin.base.validation import Array
from fflin.dynamics.integrators import held_exponential

# A delay that differs from a multiple of the sample time by less than this fraction of it counts
# as the multiple.
_ROUNDING = 1e-9


# Function of A (n, n), B (n, k) and a time [s] that returns the two matrices of a step.
Hold: TypeAlias = Callable[[Array, Array, float], tuple[Array, Array]]


class Delay(NamedTuple):
    """Delay ``(samples - 1) h + rest`` [s] with the sample time h and ``0 < rest <= h``.

    A delay of zero has no samples.
    """

    samples: int
    rest: float


def split(delay: float, h: float) -> Delay:
    """Return a delay [s] in samples of length h [s] and the rest of the last of them."""
    ratio = delay / h
    if ratio <= _ROUNDING:
        return Delay(0, 0.0)
    samples = int(np.ceil(ratio - _ROUNDING))
    rest = min(ratio - (samples - 1), 1.0)
    return Delay(samples, rest * h)


class HeldSystem:
    r"""Continuous system dx/dt = A x + B u whose held inputs arrive after `delays` (nu,) [s].

    With a delay of (k - 1) h + e and 0 < e <= h, the command of k samples ago acts until the time e
    of a sample, and the command of k - 1 samples ago acts from then on:

    .. math:: x(h) = \Phi(h)\,x + \Phi(h - e)\,\Gamma(e)\,u_{-k} + \Gamma(h - e)\,u_{-(k-1)},\qquad
              \Gamma(s) = \int_0^s e^{A t}\,dt\,B

    The states of the sampled system are x, and then for each input in turn its k last commands, the
    latest first.

    Parameters
    ----------
    A : ndarray (nx, nx)
    B : ndarray (nx, nu)
    h : float
        Sample time [s].
    delays : ndarray (nu,)
        Delays [s], at least 0.
    hold : callable, optional
        Function of A, B and a time [s] that returns the matrices of a step with held inputs. The
        default is exact.
    """

    def __init__(
        self,
        A: Array,
        B: Array,
        h: float,
        delays: Array,
        hold: Hold = held_exponential,
    ) -> None:
        self.A, self.B, self.h = A, B, h

        @cache
        def held(time: float) -> tuple[Array, Array]:
            if not time:
                return np.eye(len(A)), np.zeros_like(B, dtype=float)
            return hold(A, B, time)

        self._held = held
        self._delay(delays)

    def _delay(self, delays: Array) -> None:
        """Set the delays, and the indices of the past commands in the state."""
        self.delays = [split(float(delay), self.h) for delay in delays]
        counts = [delay.samples for delay in self.delays]
        ends = len(self.A) + np.cumsum([0, *counts])
        self.first = ends[:-1]
        self.size = int(ends[-1])

    def delayed(self, delays: Array) -> HeldSystem:
        """Return the same system with other delays (nu,) [s].

        A step that both systems contain is computed once.
        """
        other = copy(self)
        other._delay(delays)
        return other

    def after(self, s: float) -> tuple[Array, Array]:
        """Return the maps of the states (nx, size) and of the commands (nx, nu) to x after s [s].

        s is between 0 and h, and counts from a sample.
        """
        nx, nu = self.B.shape
        of_states = np.zeros((nx, self.size))
        of_commands = np.zeros((nx, nu))
        of_states[:, :nx], held = self._held(s)
        for index, (samples, rest) in enumerate(self.delays):
            if not samples:
                of_commands[:, index] = held[:, index]
                continue
            # The oldest command acts until the time `rest`, and the next command from then on.
            oldest = self.first[index] + samples - 1
            _, by_oldest = self._held(min(rest, s))
            transition, by_next = self._held(max(s - rest, 0.0))
            of_states[:, oldest] = transition @ by_oldest[:, index]
            if samples == 1:
                of_commands[:, index] = by_next[:, index]
            else:
                of_states[:, oldest - 1] = by_next[:, index]
        return of_states, of_commands

    def sampled(self) -> tuple[Array, Array]:
        """Return the matrices A (size, size) and B (size, nu) of the exact sampled system."""
        nx, nu = self.B.shape
        Ad = np.zeros((self.size, self.size))
        Bd = np.zeros((self.size, nu))
        Ad[:nx], Bd[:nx] = self.after(self.h)
        for index, (samples, _) in enumerate(self.delays):
            first = self.first[index]
            for place in range(first, first + samples):
                if place == first:
                    Bd[place, index] = 1.0
                else:
                    Ad[place, place - 1] = 1.0
        return Ad, Bd

    def applied(self, s: float) -> tuple[Array, Array]:
        """Return the maps of the states (nu, size) and of the commands (nu, nu) to the inputs.

        The inputs act at the time s [s] after a sample, 0 <= s < h.
        """
        nu = self.B.shape[1]
        of_states = np.zeros((nu, self.size))
        of_commands = np.zeros((nu, nu))
        for index, (samples, rest) in enumerate(self.delays):
            # Age in samples of the command that acts. At the time `rest`, the next command arrives.
            age = samples
            if samples and s >= rest:
                age = samples - 1
            if age == 0:
                of_commands[index, index] = 1.0
            else:
                # Past commands are states, the latest first.
                of_states[index, self.first[index] + age - 1] = 1.0
        return of_states, of_commands

    def outputs(self, C: Array, D: Array, s: float = 0.0) -> tuple[Array, Array]:
        """Return the output matrices of the sampled system at the time s [s] after a sample.

        D acts on the inputs that have arrived at this time.
        """
        of_states, of_commands = self.after(s)
        held_states, held_commands = self.applied(s)
        return C @ of_states + D @ held_states, C @ of_commands + D @ held_commands
