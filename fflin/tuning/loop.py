"""Lags and sensors of the robot in the loop of a law that measures outputs."""

from __future__ import annotations

import math
from collections.abc import Collection

from fflin.base.errors import InputError
from fflin.control.lags import (
    NO_LAGS,
    Lags,
    lags_of_model,
    lags_of_robot,
    model_of_loop,
)
from fflin.control.sensors import sensors_of_model
from fflin.dynamics.state import StateMap
from fflin.linear.model import LinearModel, refuse_frozen


def acting_lags(lin: LinearModel) -> Lags:
    """Return the lags of the robot of a model, which act in a loop that measures its outputs."""
    robot = lin._robot
    if robot is None:
        return NO_LAGS
    state = StateMap(robot, reference=lin.reference, frame=lin.frame)
    return lags_of_robot(robot, state, outputs=True)


def with_robot_lags(lin: LinearModel) -> LinearModel:
    """Return a model with the lags of its robot, or the model itself if it has its own lags."""
    refuse_frozen(lin, "a design about a fixed point")
    if lags_of_model(lin):
        return lin
    return model_of_loop(lin, acting_lags(lin))


def require_plain_sensors(
    lin: LinearModel, measured: Collection[int], function: str
) -> None:
    """Raise `InputError` if a measured output has a delay, or another sample time than the law."""
    for index, (name, sensor) in enumerate(sensors_of_model(lin).items()):
        if index not in measured:
            continue
        own = sensor.sample is not None and not math.isclose(sensor.sample, lin.dt)
        if own or sensor.delay:
            raise InputError(
                f"output {name} has its own sample or delay, which {function} cannot include; "
                "give outputs without these fields, and add the delay to that of the inputs"
            )
