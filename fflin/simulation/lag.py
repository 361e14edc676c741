"""First-order lag of the actuators in the Python engine."""

from __future__ import annotations

import numpy as np

from fflin.base.validation import Array
from fflin.dynamics.integrators import Integrator


class ActuatorLag:
    r"""Inputs that follow their commands by :math:`\dot u_a = (u - u_a) / T`.

    A command that is constant during a step gives the exact exponential. Commands that change
    during a step are integrated with the stages of the method.

    Parameters
    ----------
    lags : ndarray (nu,)
        Time constants T [s]; 0 for an input without a lag.
    initial : ndarray (nu,)
        Inputs that act at the start.
    method : type of Integrator
    h : float
        Step [s].
    held : bool
        Whether commands are constant during a step.
    """

    def __init__(
        self,
        lags: Array,
        initial: Array,
        method: type[Integrator],
        h: float,
        *,
        held: bool,
    ) -> None:
        self._now = initial.copy()
        self._lagging = lags > 0.0
        self._held = held
        self._rate = np.zeros(len(lags))
        self._rate[self._lagging] = 1.0 / lags[self._lagging]
        self._last = len(method.nodes) - 1
        self._stage = 0  # index of the next stage of the step
        # Fraction of the difference from the command that remains at each stage and at the end.
        times = h * np.array((*method.nodes, 1.0))
        decay = np.exp(-np.outer(times, self._rate))
        self._decay = np.where(self._lagging, decay, 0.0)
        self._weights = method.step_weights(h)[1]
        # Values at the start of the step, and then the derivative at each stage.
        self._rows: list[Array] = []

    def acting(self, u: Array) -> Array:
        """Return the inputs (nu,) that act at the next stage under the command u (nu,)."""
        stage = self._stage
        self._stage = 0 if stage == self._last else stage + 1
        if self._held:
            difference = self._now - u
            acting: Array = u + self._decay[stage] * difference
            if stage == self._last:
                self._now = u + self._decay[-1] * difference
            return acting
        if stage == 0:
            self._rows = [self._now]
        acting = np.where(self._lagging, self._now, u)
        self._rows.append(self._rate * (u - self._now))
        self._now = self._weights[stage, : stage + 2] @ np.array(self._rows)
        return acting
