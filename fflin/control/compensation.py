"""What a linear law of outputs does, from sample to sample or as its states are integrated."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from fflin.base.errors import InputError
from fflin.base.validation import Array, vector
from fflin.dynamics.aba import Aba
from fflin.dynamics.output_kinds import KINDS
from fflin.dynamics.outputs import state_indices
from fflin.dynamics.state import StateMap
from fflin.robot.outputs import Gyroscope


def measured_at(state: StateMap) -> tuple[list[int], list[Gyroscope]]:
    """Return which states the outputs are, gyroscopes after them; InputError of other sensors."""
    found, gyros = list[int](), list[Gyroscope]()
    for output in state.robot.outputs:
        if isinstance(output, Gyroscope):
            first = state.nx + 3 * len(gyros)
            found += range(first, first + 3)
            gyros.append(output)
        elif type(output) in KINDS:
            raise InputError(f"a {type(output).__name__} is measured in Python")
        else:
            found += state_indices(state, output)
    return found, gyros


class Sample(NamedTuple):
    """u = u0 + C (z + jump) + D dy, then z = A (z + jump) + B dy of dy = y - y0.

    In continuous time that is dz/dt. A linear model measures y by `seen` and `through`.
    """

    A: Array
    B: Array
    C: Array
    D: Array
    u0: Array
    y0: Array
    seen: Array
    through: Array
    jump: Array | float = 0.0


class Compensation:
    """What a law does from sample to sample; its state begins at zero."""

    def __init__(self, size: int, at: Callable[[float], Sample], felt: bool = True) -> None:
        self.at, self._felt = at, felt
        self.estimate: Array = np.zeros(size)  # at the sample to come

    def step(self, t: float, measure: Callable[[Sample, Array], Array]) -> Array:
        """Return the command of a sample, at which y is measured then."""
        by = self.at(t)
        z = self.estimate + by.jump
        u: Array = by.u0 + by.C @ z
        y = measure(by, u) - by.y0
        if by.D.any():
            u = u + by.D @ y  # of what does not feel u
            y = measure(by, u) - by.y0 if self._felt else y
        self._move(by.A @ z + by.B @ y)
        return u

    def _move(self, after: Array) -> None:
        self.estimate = after


class Loop(Compensation):
    """The policy of a law on what the robot measures, relative to where it is to be.

    Without dt the state is integrated along: `advance` takes it from stage to stage.
    """

    def __init__(
        self, state: StateMap, dt: float, noise: Any, size: int, at: Any, there: Any
    ) -> None:
        felt = any(output.FEELS_ACCELERATION for output in state.robot.outputs)
        super().__init__(size, at, felt)
        self._dt, self._noise, self._there = dt, noise, there
        self._still: Array = np.zeros(state.robot.nv)
        self._aba, self._asked = Aba(state) if felt else None, -np.inf
        self._rates, self._stages = [self.estimate], 0

    def sample(self, t: float) -> tuple[Sample, StateMap, Array]:
        """Return what it does at a sample, and the chart and the state that y is relative to."""
        measure, near = self._there(t)
        return self.at(t), measure.state, near

    def __call__(self, t: float, q: Array, v: Array) -> Array:
        """Return the command at a sample or a stage."""
        apart = t - self._asked
        if self._dt and self._asked >= 0.0 and abs(apart - self._dt) > 1e-6 * self._dt:
            raise InputError(
                f"the controller is asked {apart:g} s after its last sample, expected "
                f"{self._dt:g} s; leave `sample` out"
            )
        if not self._dt and len(self.estimate) and len(self._rates) != self._stages + 1:
            raise InputError(
                "the states of a continuous controller are integrated along by fflin.simulate, "
                "which must be given itself as the policy; or sample it"
            )
        self._asked = t
        measure, near = self._there(t)
        state, x = measure.state, measure.state.read(q, v, near=near)
        noise: Any = None  # one, however often y is asked for

        def measured(_: Sample, u: Array) -> Array:
            nonlocal noise
            a = self._still
            if aba := self._aba:
                a = aba.acceleration(q, v, aba.actuation.in_base_axes(state.chart(q), u))
            y: Array = measure(x, q, v, a)
            if noise is None and self._noise is not None:
                noise = vector("noise(t)", self._noise(t), len(y), "one value for each output")
            return y if noise is None else y + noise

        return self.step(t, measured)

    def _move(self, after: Array) -> None:
        if self._dt:
            self.estimate = after
        else:
            self._rates.append(after)

    def advance(self, shares: Array, last: bool) -> None:
        """Go on to the next stage, by shares of the state as the step began and of its rates."""
        if self._dt:
            return
        self.estimate, self._stages = shares @ np.array(self._rates), self._stages + 1
        if last:
            self._rates, self._stages = [self.estimate], 0
