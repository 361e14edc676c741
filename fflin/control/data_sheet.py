"""Noise of sensors in the units of their data sheets, converted to the units of a model."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np

from fflin.base.errors import InputError, listed
from fflin.base.names import by_name, stands_for_any
from fflin.base.validation import Array, instance, quantity
from fflin.control.sensors import sensors_of_model
from fflin.control.weights import Weight
from fflin.linear.model import LinearModel
from fflin.robot.outputs import Output, SensorError, StarTracker
from fflin.robot.sensor_figures import (
    BIAS_FIGURES,
    NOISE_FIGURES,
    Figure,
    checked_figure,
)

# An intensity or a covariance, or one figure of a data sheet such as {"angle_random_walk": 0.1}.
Sheet: TypeAlias = "float | Mapping[str, float]"
Noises: TypeAlias = "Weight | Mapping[str, Sheet]"


def measurement_noise(lin: LinearModel, V: Noises | None) -> Weight:
    """Return V of `kalman` with covariances or intensities in place of figures of data sheets.

    Outputs that V does not name have the noise of the robot's sensors.
    """
    if not isinstance(V, Mapping | type(None)):
        return V
    sensors = sensors_of_model(lin)
    known = {
        name: sensor.noise
        for name, sensor in sensors.items()
        if sensor.noise is not None
    }
    given = {} if V is None else V
    keys = output_keys(given, lin.output_names)
    figures = any(isinstance(value, Mapping) for value in given.values())
    if not figures and not known and V is not None:
        return {keys[key]: value for key, value in given.items()}  # type: ignore[misc]

    def intensity(key: str, value: Sheet, unit: str) -> float:
        if not isinstance(value, Mapping):
            return value
        figure, square = _squared(f"V of '{key}'", value, unit, NOISE_FIGURES)
        if not figure.sampled:
            return square / (lin.dt or 1.0)
        return _of_samples(f"V of '{key}'", lin, square)

    def default(name: str, value: SensorError, unit: str) -> float:
        what = f"noise of output '{name}'"
        if not isinstance(value, Mapping):
            return _of_samples(what, lin, quantity(what, value) ** 2)
        figure, square = _squared(what, value, unit, NOISE_FIGURES)
        if not figure.sampled:
            return square / (sensors[name].sample or lin.dt or 1.0)
        return _of_samples(what, lin, square)

    exact = {name: name for name in known}
    values = _by_output(lin, known, exact, default)
    values |= _by_output(lin, given, keys, intensity)
    missing = [name for name in lin.output_names if name not in values]
    if V is None and missing:
        raise InputError(
            f"V is missing, and the outputs {listed(missing)} have no noise; give V, or noise= of "
            "these outputs (noise in their [[output]] of the robot file)"
        )
    return values


def _of_samples(what: str, lin: LinearModel, square: float) -> float:
    """Return the variance of a sample, or raise `InputError` for a continuous model."""
    if not lin.dt:
        raise InputError(
            f"{what} is the standard deviation of a sample, but the model is continuous; "
            "use lin.discretize(dt)"
        )
    return square


def bias_intensities(
    lin: LinearModel, noise: Mapping[str, Sheet] | None
) -> dict[int, float]:
    """Return the intensity of the random walk of each bias by the index of its output."""
    expected = "a mapping {output: intensity}"
    noise = {} if noise is None else noise
    noise = instance("bias_noise", noise, Mapping, expected)
    keys = output_keys(noise, lin.output_names)

    def intensity(key: str, value: Sheet, unit: str) -> float:
        what = f"bias_noise of '{key}'"
        if isinstance(value, Mapping):
            return _squared(what, value, unit, BIAS_FIGURES)[1]
        return quantity(what, value)

    known = {
        name: sensor.bias
        for name, sensor in sensors_of_model(lin).items()
        if sensor.bias is not None
    }

    def default(name: str, value: SensorError, unit: str) -> float:
        what = f"bias of output '{name}'"
        if isinstance(value, Mapping):
            return _squared(what, value, unit, BIAS_FIGURES)[1]
        return quantity(what, value) ** 2

    values = _by_output(lin, known, {name: name for name in known}, default)
    values |= _by_output(lin, noise, keys, intensity)
    at = sorted(lin.output_names.index(name) for name in values)
    return {i: values[lin.output_names[i]] for i in at}


class Deviations(NamedTuple):
    """Errors of measurements (ny,): noise of a sample, and change of the bias within 1 s."""

    noise: Array
    drift: Array

    def scaled(self, factor: float) -> Deviations:
        """Return the errors multiplied by a factor."""
        return Deviations(factor * self.noise, factor * self.drift)


def declared_deviations(
    names: Sequence[str],
    units: Sequence[str],
    sensors: Mapping[str, Output],
    dt: float,
) -> Deviations:
    """Return the standard deviations that the fields `noise` and `bias` of outputs declare.

    `sensors` is {name: output}, and dt [s] is the sample time of the law. A density counts per
    sample of its sensor.
    """
    noise, drift = np.zeros((2, len(names)))
    for at, (name, unit) in enumerate(zip(names, units, strict=True)):
        sensor = sensors.get(name)
        if sensor is None:
            continue
        if sensor.noise is not None:
            what = f"noise of output '{name}'"
            noise[at] = _of_sample(what, sensor.noise, unit, sensor.sample or dt)
        if sensor.bias is not None:
            what = f"bias of output '{name}'"
            drift[at] = _within_second(what, sensor.bias, unit)
    return Deviations(noise, drift)


def _of_sample(what: str, given: SensorError, unit: str, sample: float) -> float:
    """Return the standard deviation of a measurement with a sample time [s]."""
    if not isinstance(given, Mapping):
        return quantity(what, given)
    figure, square = _squared(what, given, unit, NOISE_FIGURES)
    return math.sqrt(square if figure.sampled else square / sample)


def _within_second(what: str, given: SensorError, unit: str) -> float:
    """Return the standard deviation of the change of a bias within 1 s."""
    if not isinstance(given, Mapping):
        return quantity(what, given)
    return math.sqrt(_squared(what, given, unit, BIAS_FIGURES)[1])


def output_keys(given: Iterable[str], names: Sequence[str]) -> dict[str, str]:
    """Return the key that `by_name` understands for each key, such as "*.gyroscope.*".

    The key "star_tracker" names the attitude q_b.
    """
    keys = {}
    for key in given:
        keys[key] = key
        pattern = "q_b" if key == StarTracker.WORD else f"*.{key}.*"
        if not stands_for_any(key, names) and stands_for_any(pattern, names):
            keys[key] = pattern
    return keys


def _by_output(
    lin: LinearModel,
    given: Mapping[str, Sheet],
    keys: Mapping[str, str],
    intensity: Callable[[str, Sheet, str], float],
) -> dict[str, float]:
    """Return {output: intensity} from values by name, group or pattern."""
    entries = {keys[key]: (key, value) for key, value in given.items()}
    values = {}
    for at, (key, value) in by_name("output", entries, lin.output_names).items():
        values[lin.output_names[at]] = intensity(key, value, lin.output_units[at])
    return values


def _squared(
    what: str, given: Mapping[str, float], unit: str, known: Mapping[str, Figure]
) -> tuple[Figure, float]:
    """Return the figure of a data sheet, and its square in SI units."""
    figure, value = checked_figure(what, given, [unit], known)
    return figure, (figure.factors[unit] * value) ** 2
