"""Errors of measurements at the samples of a law: bias, drift of the bias, and white noise."""

from __future__ import annotations

import math

import numpy as np

from fflin.base.validation import Array
from fflin.control.data_sheet import Deviations, declared_deviations
from fflin.control.policy import Noise, Policy
from fflin.dynamics.outputs import sensors_by_signal
from fflin.dynamics.state import StateMap
from fflin.linear.fit import signals_of
from fflin.robot.outputs import Output

# The generators of the drift have this number in their seed, so that the drift is independent of
# the noise.
_DRIFT = 1


def noise_generator(seed: float) -> np.random.Generator:
    """Return the random generator for the sensor noise of a run with the given seed."""
    return np.random.Generator(np.random.Philox(np.random.SeedSequence(int(seed))))


def drift_generator(seed: float) -> np.random.Generator:
    """Return the random generator for the drift of biases of a run with the given seed."""
    sequence = np.random.SeedSequence((int(seed), _DRIFT))
    return np.random.Generator(np.random.Philox(sequence))


class SensorErrors:
    """Function of the time t [s] of a sample that returns errors (ny,).

    It must be called once for each sample. A time that is not later than the last one starts a new
    run. The bias drifts by normal steps with the deviations `steps` (ny,) from sample to sample.
    """

    def __init__(
        self,
        bias: Array,
        noise: Array,
        steps: Array,
        seed: float,
        given: Noise | None = None,
    ) -> None:
        self._bias, self._noise, self._steps = bias, noise, steps
        self._seed, self._given = seed, given
        self._restart()

    def _restart(self) -> None:
        self._generators = noise_generator(self._seed), drift_generator(self._seed)
        self._drift = np.zeros(len(self._bias))
        self._last = -math.inf

    def __call__(self, t: float) -> Array:
        """Return the errors (ny,) at a sample."""
        if t <= self._last:
            self._restart()
        self._last = t
        of_noise, of_drift = self._generators
        size = len(self._bias)
        errors: Array = self._bias + self._noise * of_noise.standard_normal(size)
        if self._steps.any():
            errors = errors + self._drift
            self._drift = self._drift + self._steps * of_drift.standard_normal(size)
        if self._given is not None:
            errors = errors + np.asarray(self._given(t))
        return errors


def declared_errors(
    policy: Policy, state: StateMap, sample: float
) -> Deviations | None:
    """Return the errors that the outputs of a robot declare for the sensors of a law.

    `state` belongs to the simulated robot, and `sample` [s] is the sample time of the law. An
    `Allocation` measures the outputs of its `design`, whose errors also count. The result is None
    if the law is continuous, does not measure outputs, has its own noise, or its outputs declare no
    errors.
    """
    if not sample or not policy.senses_outputs:
        return None
    if policy.measurement_noise is not None:
        # The noise of the law replaces the noise of the outputs.
        return None
    sensors = _erring_outputs(state)
    units = _units_of_outputs(state)
    design = policy.commanded_robot
    if design is not None:
        measured = StateMap(design, reference=state.reference, frame=state.frame)
        sensors = _erring_outputs(measured) | sensors
        units = _units_of_outputs(measured) | units
    names = policy.sensors
    if not any(name in sensors for name in names):
        return None
    units_of_sensors = [units.get(name, "") for name in names]
    return declared_deviations(names, units_of_sensors, sensors, sample)


def _erring_outputs(state: StateMap) -> dict[str, Output]:
    """Return {name of an entry of y: its output} for the outputs that declare errors."""
    return {
        name: output
        for name, output in sensors_by_signal(state).items()
        if output.noise is not None or output.bias is not None
    }


def _units_of_outputs(state: StateMap) -> dict[str, str]:
    """Return {name of an entry of y: its unit} for the outputs of a robot."""
    names, units = signals_of(state, "output")
    return dict(zip(names, units, strict=True))


def note_on_errors(names: tuple[str, ...], sizes: Deviations, seed: int) -> str:
    """Return a note on the errors of sensors for the report of a motion."""
    parts = []
    for words, deviations in (("noise", sizes.noise), ("drifting bias", sizes.drift)):
        at = np.flatnonzero(deviations).tolist()
        groups = dict.fromkeys(names[index].rpartition(".")[0] for index in at)
        if groups:
            parts.append(f"{words} of {', '.join(groups)}")
    return (
        f"measurements contain the {' and the '.join(parts)} that the outputs declare (seed "
        f"{seed}; noise=0 leaves them out)"
    )
