"""Lags and sensors of the robot in the loop of a law that measures outputs."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence

import numpy as np

from fflin.base.errors import InputError
from fflin.control.lags import (
    Lags,
    lags_of_its_robot,
    lags_of_model,
    model_of_loop,
)
from fflin.control.sensors import sensors_of_model, timing_of
from fflin.linear.model import LinearModel, refuse_frozen
from fflin.tuning.law import Matrices


def acting_lags(lin: LinearModel) -> Lags:
    """Return the lags of the robot of a model, which act in a loop that measures its outputs."""
    return lags_of_its_robot(lin, outputs=True)


def with_robot_lags(lin: LinearModel) -> LinearModel:
    """Return a model with the lags of its robot, or the model itself if it has its own lags."""
    refuse_frozen(lin, "a design about a fixed point")
    if lags_of_model(lin):
        return lin
    return model_of_loop(lin, acting_lags(lin))


def sensor_delays(lin: LinearModel, measured: Collection[int]) -> tuple[int, ...]:
    """Return the delays of the outputs of a model in samples; 0 for outputs not in `measured`.

    Raise `InputError` if a measured output has another sample time than the law, or a delay that
    is not a multiple of it.
    """
    names, sensors = [], []
    for index, (name, sensor) in enumerate(sensors_of_model(lin).items()):
        if index not in measured:
            continue
        sample = sensor.sample
        if sample is not None and not math.isclose(sample, lin.dt):
            time = f"sampled at {lin.dt:g} s" if lin.dt else "continuous"
            raise InputError(
                f"output {name} is measured every {sample:g} s, but the law is {time}; give the "
                f"sample time of the output to the law, such as dt={sample:g}, or measure other "
                "outputs"
            )
        if sensor.delay and not lin.dt:
            raise InputError(
                f"output {name} has a delay of {sensor.delay:g} s, but the law is continuous; give "
                f"the sample time of the law, of which the delay is a multiple, such as "
                f"dt={sensor.delay:g}"
            )
        names.append(name)
        sensors.append(sensor)
    delays = [0] * len(lin.output_names)
    if lin.dt:
        late = timing_of(sensors, names, lin.dt).delays
        for name, samples in zip(names, late, strict=True):
            delays[lin.output_names.index(name)] = samples
    return tuple(delays)


def with_delayed_outputs(matrices: Matrices, delays: Sequence[int]) -> Matrices:
    """Return a sampled model whose outputs are late by `delays` (ny,) samples.

    The states of the delays come after the states of the model. A delay changes the phase of an
    output, and not the gains to it.
    """
    A, B, C, D = matrices
    for index, samples in enumerate(delays):
        n = len(A)
        for place in range(samples):
            row, through = C[index : index + 1], D[index : index + 1]
            size = n + place
            A = np.block([[A, np.zeros((size, 1))], [row, np.zeros((1, 1))]])
            B = np.vstack((B, through))
            C = np.hstack((C, np.zeros((len(C), 1))))
            C[index] = 0.0
            C[index, -1] = 1.0
            D = D.copy()
            D[index] = 0.0
    return A, B, C, D
