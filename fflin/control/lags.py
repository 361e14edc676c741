"""Lags in the loop of a law and a robot, and the lags for which the law was designed."""

from __future__ import annotations

import math
import warnings
from typing import NamedTuple

from fflin.base.errors import FflinWarning, InputError, listed
from fflin.base.names import LAG, input_keys, lag_name
from fflin.control.gain import Gain
from fflin.control.policy import Policy
from fflin.dynamics.outputs import sensors_by_signal
from fflin.dynamics.state import Actuation, StateMap
from fflin.linear.model import LinearModel
from fflin.robot.inputs import lags_of
from fflin.robot.robot import Robot

# Time constants that differ by less than this fraction count as equal.
_ROUNDING = 1e-9


class Lags(NamedTuple):
    """Time constants [s] of inputs and outputs with a lag, by name."""

    inputs: dict[str, float]
    outputs: dict[str, float]

    def __bool__(self) -> bool:
        return bool(self.inputs or self.outputs)


NO_LAGS = Lags({}, {})


def _positive(names: tuple[str, ...], values: list[float]) -> dict[str, float]:
    return {name: value for name, value in zip(names, values, strict=True) if value}


def lags_of_model(lin: LinearModel) -> Lags:
    """Return the lags that a model contains."""
    return Lags(
        _positive(lin.input_names, lin.lag.tolist()),
        _positive(lin.output_names, lin.output_lag.tolist()),
    )


def lags_of_robot(robot: Robot, state: StateMap, *, outputs: bool) -> Lags:
    """Return the lags of the inputs of a robot, and if `outputs` is true, of its outputs."""
    names = Actuation(state).names
    late = _positive(names, list(lags_of(robot.named_inputs)))
    sensed: dict[str, float] = {}
    if outputs:
        sensors = sensors_by_signal(state).items()
        sensed = {name: sensor.lag for name, sensor in sensors if sensor.lag}
    return Lags(late, sensed)


def robot_lags(law: Policy | Gain, lin: LinearModel) -> Lags:
    """Return the lags of the robot of a model, of the outputs only if a law measures them."""
    outputs = isinstance(law, Policy) and law.senses_outputs
    return lags_of_its_robot(lin, outputs=outputs)


def lags_of_its_robot(lin: LinearModel, *, outputs: bool) -> Lags:
    """Return the lags of the robot of a model, see `lags_of_robot`; none if it has no robot."""
    robot = lin._robot
    if robot is None:
        return NO_LAGS
    state = StateMap(robot, reference=lin.reference, frame=lin.frame)
    return lags_of_robot(robot, state, outputs=outputs)


def lags_of_commands(
    law: Policy | Gain, lin: LinearModel, robot: Robot
) -> tuple[Lags, str]:
    """Return the lags of a robot for the inputs of a model, and a sentence on neglected lags.

    Other inputs of the robot may realise the inputs of the model, as in an `Allocation`. If all of
    them have the same lag, the generalised force has this lag exactly. Different lags are
    neglected.
    """
    outputs = isinstance(law, Policy) and law.senses_outputs
    state = StateMap(robot, reference=lin.reference, frame=lin.frame)
    lags = lags_of_robot(robot, state, outputs=outputs)
    if Actuation(state).names == lin.input_names:
        return lags, ""
    times = lags_of(robot.named_inputs)
    least, largest = min(times, default=0.0), max(times, default=0.0)
    if largest - least > _ROUNDING * largest:
        sentence = (
            f"the inputs of '{robot.name}', which realise {listed(_groups(lin))}, have lags of "
            f"{least:.3g} to {largest:.3g} s; the error budget neglects them, because they differ: "
            f"give lin.with_lags({{'{_groups(lin)[0]}': {largest:.3g}}}) for the largest"
        )
        return lags._replace(inputs={}), sentence
    late = dict.fromkeys(lin.input_names, largest) if largest else {}
    return lags._replace(inputs=late), ""


def _groups(lin: LinearModel) -> list[str]:
    """Return the groups of the inputs of a model, such as "tau_b"."""
    return list(dict.fromkeys(name.partition(".")[0] for name in lin.input_names))


def designed_lags(law: Policy | Gain) -> Lags:
    """Return the lags for which a law or a gain was designed."""
    lin = law._lin if isinstance(law, Gain) else law.model
    if isinstance(lin, LinearModel):
        return lags_of_model(lin)
    if not isinstance(law, Gain):
        return NO_LAGS
    # A gain from a file contains the matrix of its model, but not the time constants.
    lags = {}
    for name in law.input_names:
        state = lag_name(name)
        if state in law.state_names:
            at = law.state_names.index(state)
            pole = float(law.A[at, at])
            lags[name] = -law.dt / math.log(pole) if law.dt else -1.0 / pole
    return Lags(lags, {})


def has_lag_states(names: tuple[str, ...]) -> bool:
    """Return whether states include the states of lags."""
    return any(name.startswith(LAG) for name in names)


def lag_difference(law: Policy | Gain, acting: Lags, place: str) -> str:
    """Return a sentence on lags of a robot that a law was not designed for, or an empty text.

    `acting` contains the lags in the loop, and `place` names the loop in the sentence.
    """
    designed = designed_lags(law)
    if not (isinstance(law, Policy) and law.senses_outputs):
        designed = designed._replace(outputs={})
    unknown = list[str]()
    for actual, known in zip(acting, designed, strict=True):
        unknown += [
            f"{name} ({value:.3g} s)"
            for name, value in actual.items()
            if not math.isclose(value, known.get(name, 0.0), rel_tol=_ROUNDING)
        ]
    missing = [
        f"{name} ({value:.3g} s)"
        for actual, known in zip(acting, designed, strict=True)
        for name, value in known.items()
        if name not in actual
    ]
    if unknown:
        return (
            f"{place} contains lags for which the law was not designed: {listed(unknown)}; design "
            "it for lin.with_lags()"
        )
    if missing:
        return (
            f"{place} lacks lags for which the law was designed: {listed(missing)}; give the "
            "robot these lags, or design the law for its own"
        )
    return ""


def warn_of_lags(law: Policy | Gain, acting: Lags, place: str) -> None:
    """Warn once if a robot has lags for which a law was not designed."""
    if message := lag_difference(law, acting, place):
        warnings.warn(message, FflinWarning, stacklevel=2)


def model_with_lags(lin: LinearModel, lags: Lags) -> LinearModel:
    """Return a continuous model with the given lags."""
    if not lags:
        return lin
    keys = dict(zip(lin.input_names, input_keys(lin), strict=True))
    late = {keys[name]: value for name, value in lags.inputs.items() if name in keys}
    sensed = {
        name: value for name, value in lags.outputs.items() if name in lin.output_names
    }
    if not (late or sensed):
        return lin
    return lin.with_lags(late, sensed)


def model_of_loop(lin: LinearModel, lags: Lags) -> LinearModel:
    """Return a model without lags, continuous or sampled, with the given lags."""
    if not lags:
        return lin
    source = lin.generator if lin.dt else lin
    if source is None:
        raise InputError(
            "the inputs or outputs of the robot have lags, but lin is sampled without them and its "
            "continuous model is unknown; give the continuous model"
        )
    source = model_with_lags(source, lags)
    if not lin.dt:
        return source
    delays = dict(zip(input_keys(lin), lin.delay.tolist(), strict=True))
    return source.discretize(lin.dt, delay=delays)
