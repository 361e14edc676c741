"""Commands with memory: controllers that measure outputs or states, and advance their state z."""

from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np

from fflin.base.errors import InputError
from fflin.base.validation import Array, vector
from fflin.control.policy import BoundLaw, Noise
from fflin.control.sensors import (
    SensorLag,
    SensorMemory,
    lags_of_robot,
    timing_of_robot,
)
from fflin.dynamics.aba import Aba
from fflin.dynamics.outputs import KINDS, Measuring, state_indices
from fflin.dynamics.state import StateMap
from fflin.robot.outputs import Gyroscope


def next_sample(t: float, last: float, dt: float) -> float:
    """Return the time t of a sample; raise `InputError` if t is not `dt` [s] after time `last`.

    `last` is the time of the last sample, and negative before the first sample.
    """
    apart = t - last
    if last >= 0.0 and abs(apart - dt) > 1e-6 * dt:
        raise InputError(
            f"the controller is called {apart:g} s after its last sample, expected "
            f"{dt:g} s; leave out `sample`, or set `sample` to the expected value"
        )
    return t


def measured_at(state: StateMap) -> tuple[list[int], list[Gyroscope]]:
    """Return the index of each measured value, and the list of gyroscopes.

    Each measured value is a state or a rate of a gyroscope. The index of a state is its index in
    the state vector, and the indices of the gyroscope rates follow. Other sensors raise
    `InputError`.
    """
    indices, gyros = list[int](), list[Gyroscope]()
    for output in state.robot.outputs:
        if isinstance(output, Gyroscope):
            first = state.nx + 3 * len(gyros)
            indices += range(first, first + 3)
            gyros.append(output)
        elif type(output) in KINDS:
            raise InputError(f"a {type(output).__name__} is measured in Python")
        else:
            indices += state_indices(state, output)
    return indices, gyros


# Function of the command u that returns the outputs y.
Measure: TypeAlias = Callable[[Array], Array]

# Function of a controller's state z and a `Measure` that returns the command, and the next z or
# dz/dt.
Step: TypeAlias = Callable[[Array, Measure], tuple[Array, Array]]


NOT_CORRECTED = np.zeros(
    (0, 0)
)  # anti-windup gain of a law whose state is not corrected


class Sample(NamedTuple):
    """Control law ``u = u0 + C (z + jump) + D (y - y0)`` of a controller with state z.

    ``A (z + jump) + B (y - y0)`` is the next z of a sampled controller, or dz/dt of a continuous
    controller. `jump` is the change of z at a sample at which the reference changes.

    If limits change the command, ``E (applied - commanded)`` is added to the next z, or to dz/dt.
    Here E (nz, nu) is the gain of the anti-windup, which may be empty.
    """

    A: Array
    B: Array
    C: Array
    D: Array
    u0: Array
    y0: Array
    jump: Array | float = 0.0
    E: Array = NOT_CORRECTED

    def step(self, z: Array, measure: Measure) -> tuple[Array, Array]:
        """Return the command, and the next z or dz/dt."""
        z = z + self.jump
        u: Array = self.u0 + self.C @ z
        if self.D.any():
            # D acts only on outputs that do not depend on u, so `measure` can use an incomplete u.
            u = u + self.D @ (measure(u) - self.y0)
        return u, self.A @ z + self.B @ (measure(u) - self.y0)


class StateMeasuring:
    """Measurement of the full state x of a robot, for laws that measure no outputs."""

    def __init__(self, state: StateMap) -> None:
        self.state = state

    def __call__(self, x: Array, q: Array, v: Array, a: Array) -> Array:
        """Return x (nx,); see `Measuring`."""
        return x


# Function of time that returns three values: the step function of a compensator, a function that
# measures the robot's outputs or its state, and the state near which angles are unwrapped.
At: TypeAlias = Callable[[float], tuple[Step, Measuring | StateMeasuring, Array]]


class Loop(BoundLaw):
    """Policy that measures a robot's outputs or its state, and computes the command.

    The state z of the law advances at each sample, or at each stage of the integrator if dt is 0.
    `sizes` contains the lengths of z and of the measured values y. The function `windup` returns
    the anti-windup gain E at a time [s]; see `Sample`. If outputs of the robot have their own
    sample times or delays, the law receives the values `start` (ny,) before the first measurement
    arrives. If `has_sensors` is true, the states of the law contain these sensors.
    """

    def __init__(
        self,
        state: StateMap,
        dt: float,
        sizes: tuple[int, int],
        at: At,
        noise: Noise | None = None,
        *,
        measures_state: bool = False,
        windup: Callable[[float], Array] | None = None,
        start: Array | None = None,
        has_sensors: bool = False,
    ) -> None:
        self.at, self.dt, self._noise, (nz, self._ny) = at, dt, noise, sizes
        self.measures_state = measures_state
        self.estimate: Array = np.zeros(nz)  # z at the next sample or stage
        self.rates: list[Array] = [self.estimate]
        self.stages = 0
        self._last = -np.inf
        self._at_rest: Array = np.zeros(state.robot.nv)
        self._aba: Aba | None = None
        outputs = () if measures_state else state.robot.outputs
        if any(output.FEELS_ACCELERATION for output in outputs):
            self._aba = Aba(state)
        self._time = 0.0
        # Memory of sensors with their own sample times or delays, or None.
        self.sensors: SensorMemory | None = None
        # Values of sensors with a lag, or None.
        self.lag: SensorLag | None = None
        if not measures_state:
            if not has_sensors:
                self.sensors = _sensor_memory(state, dt, start)
            lags = lags_of_robot(state)
            if lags.any():
                self.lag = SensorLag(lags, _start_of(state, start))
        if windup is not None and nz:
            self._windup = windup
            self.correct = self._correct

    def __call__(self, t: float, q: Array, v: Array) -> Array:
        """Return the command at a sample or at a stage of the integrator."""
        if self.dt:
            self._last = next_sample(t, self._last, self.dt)
        elif len(self.estimate) and len(self.rates) != self.stages + 1:
            raise InputError(
                "only fflin.simulate can integrate the states of a continuous controller; pass "
                "the LinearController itself to fflin.simulate as the policy, or sample the "
                "controller"
            )
        self._time = t
        step, measure, near = self.at(t)
        state = measure.state
        x = measure.state.read(q, v, near=near)
        if self.lag:
            self.lag.require_integrated()
        noise: Array | float = 0.0
        if self._noise is not None:
            noise = vector(
                "noise(t)", self._noise(t), self._ny, "one value for each output"
            )

        seen: Array = self._at_rest

        def measured(u: Array) -> Array:
            nonlocal seen
            a = self._at_rest
            if aba := self._aba:
                in_base = aba.actuation.in_base_axes(state.unchecked_chart(q), u)
                a = aba.acceleration(q, v, in_base)
            values = measure(x, q, v, a)
            if self.lag:
                values = self.lag.values(values)
            seen = np.asarray(values + noise)
            if self.sensors:
                return self.sensors.received(seen)
            return seen

        u, after = step(self.estimate, measured)
        if self.sensors:
            self.sensors.advance(seen)
        if self.dt:
            self.estimate = after
        elif len(self.estimate):
            self.rates.append(after)
        return u

    def observe(self, t: float, q: Array, v: Array, a: Array, weights: Array) -> None:
        """Advance the sensors with a lag by a stage of the integrator with the acceleration a.

        `weights` are the weights of `SensorLag.advance`.
        """
        assert self.lag is not None
        _, measure, near = self.at(t)
        x = measure.state.read(q, v, near=near)
        self.lag.advance(measure(x, q, v, a), weights)

    def _correct(self, difference: Array) -> None:
        """Add E (applied - commanded) to the next z, or to dz/dt at the latest stage."""
        change = self._windup(self._time) @ difference
        if self.dt:
            self.estimate = self.estimate + change
        else:
            self.rates[-1] = self.rates[-1] + change

    def advance(self, weights: Array, last: bool) -> None:
        """Set z to a weighted sum of z at the start of the step and of dz/dt at the past stages.

        `last` must be True at the last stage of a step. The state of a sampled compensator is not
        changed. A compensator without states may be called at some of the stages only, because its
        command may be held.
        """
        if not self.dt and len(self.estimate):
            self.estimate, self.stages = weights @ np.array(self.rates), self.stages + 1
            if last:
                self.rates = [self.estimate]
                self.stages = 0


def _sensor_memory(
    state: StateMap, dt: float, start: Array | None
) -> SensorMemory | None:
    """Return the memory of sensors with their own sample times or delays, or None."""
    timing = timing_of_robot(state, dt)
    if timing.is_plain:
        return None
    return SensorMemory(timing, _start_of(state, start))


def _start_of(state: StateMap, start: Array | None) -> Array:
    """Return the values at the start, or raise `InputError` if they are unknown."""
    if start is None:
        raise InputError(
            f"outputs of '{state.robot.name}' have their own sample, delay or lag, which laws "
            "along a trajectory do not support; leave out these fields of the outputs"
        )
    return start


class PredictedLaw:
    """Command of a sampled law with a state z, computed from the deviations of a linear model.

    `terms` contains the law at each sample of its period.
    """

    def __init__(
        self, terms: Sequence[Sample], measure: Callable[[Array, Array], Array]
    ) -> None:
        self._terms = terms
        self._measure = measure
        self._z: Array = np.zeros(len(terms[0].A))
        self._sample = -1

    def __call__(self, e: Array) -> Array:
        """Return the command at a sample for the deviation e (nx,), and advance z."""
        self._sample += 1
        u, self._z = self._now.step(self._z, lambda u: self._measure(e, u))
        return u

    @property
    def _now(self) -> Sample:
        """The law at the latest sample."""
        return self._terms[self._sample % len(self._terms)]

    def correct(self, difference: Array) -> None:
        """Correct z by the difference of limited and commanded inputs; see `Sample`."""
        if self._now.E.size:
            self._z = self._z + self._now.E @ difference
