"""Sensors with their own sample times and delays, in a loop with the sample time of the law."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from fflin.base.errors import InputError
from fflin.base.validation import Array, Indices, Mask
from fflin.dynamics.outputs import sensors_by_signal
from fflin.dynamics.state import StateMap
from fflin.linear.model import LinearModel
from fflin.robot.outputs import FullState, Output

# A time that differs from a multiple of the sample time by less than this fraction of it counts
# as the multiple.
_ROUNDING = 1e-6

# Largest number of samples after which all sensors measure at the same time again.
_LONGEST = 1000

# Largest delay of a sensor in samples, because each sample adds a state for each output.
_MOST_DELAYED = 500


# A sensor without its own sample time, delay, noise and bias.
_PLAIN: Output = FullState()


class SensorTiming(NamedTuple):
    """Sample times and delays of outputs y (ny,), in samples of a law.

    An output with the period p and the delay d is measured at the samples 0, p, 2 p, ..., and
    arrives d samples later. Between two arrivals, a law receives the latest value.
    """

    periods: tuple[int, ...]
    delays: tuple[int, ...]

    @property
    def is_plain(self) -> bool:
        """Whether all outputs are measured at each sample, and arrive at once."""
        return set(self.periods) <= {1} and not any(self.delays)

    @property
    def period(self) -> int:
        """Number of samples after which the pattern of arrivals repeats."""
        return math.lcm(*self.periods)

    def arriving(self, sample: int) -> Mask:
        """Return which outputs (ny,) arrive at a sample of the law."""
        since = sample - np.array(self.delays)
        arrives: Mask = since % np.array(self.periods) == 0
        return arrives

    @property
    def oldest(self) -> int:
        """Largest number of samples from a measurement to a sample at which it is received."""
        ages = zip(self.periods, self.delays, strict=True)
        return max(period - 1 + delay for period, delay in ages)

    def measured(self, sample: int) -> Indices:
        """Return the samples (ny,) at which the values that are received at a sample were measured.

        They are 0 before the first measurement arrives.
        """
        since = sample - np.array(self.delays)
        latest = since - since % np.array(self.periods)
        measured: Indices = np.maximum(latest, 0)
        return measured


def timing_of(
    sensors: Sequence[Output], names: Sequence[str], dt: float
) -> SensorTiming:
    """Return the timing of outputs with the given names, for a law with the sample time dt [s].

    `sensors` (ny,) contains the output of each name. Raise `InputError` if a sample time or a
    delay is not a multiple of dt, or if the law is continuous.
    """
    periods, delays = [], []
    for sensor, name in zip(sensors, names, strict=True):
        if sensor.sample is None and not sensor.delay:
            periods.append(1)
            delays.append(0)
            continue
        if not dt:
            raise InputError(
                f"output {name} has its own sample or delay, but the model or the law is "
                "continuous; use a sampled one, such as lin.discretize(dt)"
            )
        sample = dt if sensor.sample is None else sensor.sample
        periods.append(_samples(f"sample of output {name}", sample, dt, least=1))
        delays.append(_samples(f"delay of output {name}", sensor.delay, dt, least=0))
    timing = SensorTiming(tuple(periods), tuple(delays))
    _require_common(timing, names, dt)
    return timing


def timing_of_model(lin: LinearModel) -> SensorTiming:
    """Return the timing of the outputs of a model; without its robot, all are plain."""
    names = lin.output_names
    if lin._robot is None:
        return SensorTiming((1,) * len(names), (0,) * len(names))
    return timing_of(list(sensors_of_model(lin).values()), names, lin.dt)


def sensors_of_model(lin: LinearModel) -> dict[str, Output]:
    """Return {name of an output of a model: sensor}; sensors are plain if the robot is unknown."""
    if lin._robot is None:
        return dict.fromkeys(lin.output_names, _PLAIN)
    state = StateMap(lin._robot, reference=lin.reference, frame=lin.frame)
    known = sensors_by_signal(state)
    return {name: known.get(name, _PLAIN) for name in lin.output_names}


def timing_of_robot(state: StateMap, dt: float) -> SensorTiming:
    """Return the timing of the outputs of a robot for a law with the sample time dt [s]."""
    sensors = sensors_by_signal(state)
    return timing_of(list(sensors.values()), list(sensors), dt)


def require_timing(designed: SensorTiming | None, state: StateMap, dt: float) -> None:
    """Raise `InputError` if the outputs of a robot have other times than the outputs of a design.

    `designed` is None if they may have any. dt [s] is the sample time of the law.
    """
    if designed is None or timing_of_robot(state, dt) == designed:
        return
    raise InputError(
        f"the outputs of '{state.robot.name}' have other sample times or delays than the outputs "
        "of the law's model; design the law for the sensors of this robot"
    )


def _samples(what: str, time: float, dt: float, *, least: int) -> int:
    """Return a time [s] as a whole number of samples of dt [s], or raise `InputError`."""
    ratio = time / dt
    count = round(ratio)
    if abs(ratio - count) <= _ROUNDING * max(1.0, ratio) and count >= least:
        if count > _MOST_DELAYED and not least:
            raise InputError(
                f"{what} is {time:g} s, more than {_MOST_DELAYED} samples of {dt:g} s; give a "
                "model with a longer sample time"
            )
        return count
    below = max(math.floor(ratio), least)
    nearest = " and ".join(f"{k * dt:g}" for k in dict.fromkeys((below, below + 1)))
    raise InputError(
        f"{what} is {time:g} s, which has no common grid with the sample time {dt:g} s; the "
        f"nearest times with a common grid are {nearest} s, or give a model with a sample time "
        "that divides it"
    )


def _require_common(timing: SensorTiming, names: Sequence[str], dt: float) -> None:
    """Raise `InputError` if the pattern of all sensors repeats only after a very long time."""
    if timing.period <= _LONGEST:
        return
    common = 1
    for period, name in zip(timing.periods, names, strict=True):
        if math.lcm(common, period) <= _LONGEST:
            common = math.lcm(common, period)
            continue
        fits = [p for p in range(1, _LONGEST + 1) if math.lcm(common, p) <= _LONGEST]
        nearest = min(fits, key=lambda p: (abs(p - period), p))
        raise InputError(
            f"sample of output {name} is {period * dt:g} s, but all outputs are measured at the "
            f"same time only every {timing.period * dt:g} s, expected at most {_LONGEST} samples "
            f"of {dt:g} s; the nearest sample with a common grid is {nearest * dt:g} s"
        )


class SensorMemory:
    """Values that a law receives from sensors with their own sample times and delays.

    Before the first measurement arrives, the law receives the values `start` (ny,).
    """

    def __init__(self, timing: SensorTiming, start: Array) -> None:
        self._timing = timing
        self._sample = 0
        longest = max(timing.delays)
        # Measurements of the latest samples, the latest first.
        self._line = np.tile(start, (longest + 1, 1))
        self._held = start.copy()
        self._delays = np.array(timing.delays)

    def received(self, y: Array) -> Array:
        """Return the values (ny,) that the law receives at this sample; the sensors see y (ny,)."""
        line = self._line
        line[0] = y
        late: Array = line[self._delays, np.arange(len(y))]
        return np.where(self._timing.arriving(self._sample), late, self._held)

    def advance(self, y: Array) -> None:
        """Proceed to the next sample; y (ny,) is what the sensors saw at this sample."""
        self._held = self.received(y)
        self._line[1:] = self._line[:-1].copy()
        self._sample += 1


class SensorLag:
    r"""Values of sensors with a lag, :math:`\dot y_s = (y - y_s) / T`, integrated with the robot.

    Parameters
    ----------
    lags : ndarray (ny,)
        Time constants T [s]; 0 for a sensor without a lag.
    start : ndarray (ny,)
        Values at the start.
    """

    def __init__(self, lags: Array, start: Array) -> None:
        self.start = start
        self._lagging = lags > 0.0
        # 1/T [1/s]; 0 for a sensor without a lag
        self.rate: Array = np.zeros(len(lags))
        self.rate[self._lagging] = 1.0 / lags[self._lagging]
        self._values = start.copy()
        self._rows = [self._values]
        self._fresh = True

    def values(self, y: Array) -> Array:
        """Return the values (ny,) of the sensors at a sample or stage; y (ny,) is measured."""
        return np.where(self._lagging, self._values, y)

    def require_integrated(self) -> None:
        """Raise `InputError` if the values were not integrated since the last call."""
        if not self._fresh:
            raise InputError(
                "outputs of the robot have a lag, which only fflin.simulate can integrate, and "
                "only for a law that is not part of an Allocation; leave out lag of the outputs"
            )
        self._fresh = False

    def advance(self, y: Array, weights: Array) -> None:
        """Add a stage of the integrator, at which y (ny,) is measured.

        `weights` (1 + s, ..) has one row for the values after each stage, see
        `Integrator.step_weights`.
        """
        self._fresh = True
        self._rows.append(self.rate * (y - self._values))
        stage = len(self._rows) - 1
        self._values = weights[stage - 1, : stage + 1] @ np.array(self._rows)
        if stage == len(weights):
            self._rows = [self._values]


def lags_of_robot(state: StateMap) -> Array:
    """Return the time constants (ny,) [s] of the outputs of a robot; 0 without a lag."""
    return np.array([sensor.lag or 0.0 for sensor in sensors_by_signal(state).values()])


class _Line(NamedTuple):
    """Indices of the states of a sensor: the past measurements, and the held value or -1."""

    past: tuple[int, ...]
    held: int


def _lines(timing: SensorTiming) -> tuple[list[_Line], int]:
    """Return the states of each sensor, and their number."""
    lines = list[_Line]()
    count = 0
    for period, delay in zip(timing.periods, timing.delays, strict=True):
        past = tuple(range(count, count + delay))
        count += delay
        held = -1
        if period > 1:
            held = count
            count += 1
        lines.append(_Line(past, held))
    return lines, count


def sensor_systems(timing: SensorTiming) -> Iterator[tuple[Array, Array, Array, Array]]:
    """Yield the matrices of the sensors at each sample: states s' = A s + B y, received C s + D y.

    All values are deviations from the values before the first measurement arrives.
    """
    lines, size = _lines(timing)
    ny = len(lines)
    sample = 0
    while True:
        A, B = np.zeros((size, size)), np.zeros((size, ny))
        C, D = np.zeros((ny, size)), np.zeros((ny, ny))
        arrives = timing.arriving(sample)
        for index, line in enumerate(lines):
            if not arrives[index]:
                C[index, line.held] = 1.0
            elif line.past:
                C[index, line.past[-1]] = 1.0
            else:
                D[index, index] = 1.0
            for place, state in enumerate(line.past):
                if place:
                    A[state, line.past[place - 1]] = 1.0
                else:
                    B[state, index] = 1.0
            if line.held >= 0:
                A[line.held], B[line.held] = C[index], D[index]
        yield A, B, C, D
        sample += 1
