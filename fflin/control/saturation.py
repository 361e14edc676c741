"""Actuator saturation: input limits, wheel speed limits and thruster pulses."""

import math
import warnings
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from fflin.base.errors import FflinWarning, InputError, listed
from fflin.base.validation import Array
from fflin.kernel.arguments import empty
from fflin.kernel.channel import PULSES, WHEELS, Pulses, Wheels
from fflin.robot.fields import Range
from fflin.robot.inputs import Thruster, named_inputs
from fflin.robot.robot import Robot


class Saturation(NamedTuple):
    """Limits, wheels and pulses that act on the commands of a robot's inputs."""

    low: Array  # (nu,)
    high: Array
    wheels: Wheels = empty(WHEELS)
    wheel_names: tuple[str, ...] = ()  # in the order of `wheels`
    pulses: Pulses = empty(PULSES)


def input_limits(robot: Robot, limits: Mapping[str, Range]) -> tuple[Array, Array]:
    """Return the least and the largest value (nu,) of each input; thrusts are never negative."""
    inputs = {name: item for item, names in named_inputs(robot.inputs) for name in names}
    low, high = np.array([limits.get(name, (-math.inf, math.inf)) for name in inputs]).T
    low = np.maximum(low, [-math.inf if item.PULLS else 0.0 for item in inputs.values()])
    for index, (_, item) in _pulsed(robot).items():
        high[index] = min(high[index], math.inf if item.max is None else item.max)
    return low, high


def saturation(
    robot: Robot, limits: Mapping[str, Range], q: Array, dt: float, sample: int, *, pulsed: bool
) -> Saturation:
    """Return the saturation of commands at q, in steps of dt [s], `sample` steps a sample or 0.

    `pulsed` says whether there are commands that pulsed thrusters must realise.
    """
    low, high = input_limits(robot, limits)
    within = Saturation(low, high)
    if spun := [name for name in robot.wheels if f"qdot_m.{name}" in limits]:
        names = [name for _, group in named_inputs(robot.inputs) for name in group]
        at, of_v = [names.index(x) for x in spun], [robot.joint(x).idx_v for x in spun]
        mobility = pin.computeMinverse(robot.model, robot.create_data(), q).diagonal()[of_v]
        least_speed, most_speed = np.array([limits[f"qdot_m.{name}"] for name in spun]).T
        wheels = Wheels(
            at=np.array(at),
            row=np.array([6 + robot.joint_names.index(name) for name in spun]),
            least_torque=low[at],
            most_torque=high[at],
            least_speed=least_speed,
            most_speed=most_speed,
            stiffness=1.0 / (mobility * dt),
        )
        within = within._replace(wheels=wheels, wheel_names=tuple(spun))
    if pulsed and (thrusters := _pulsed(robot)):
        return within._replace(pulses=_pulses(thrusters, high, sample, dt))
    return within


def _pulsed(robot: Robot) -> dict[int, tuple[str, Thruster]]:
    """Return the pulsed thrusters {index of the input: (name, thruster)}."""
    inputs = ((name, item) for item, names in named_inputs(robot.inputs) for name in names)
    return {
        index: (name, item)
        for index, (name, item) in enumerate(inputs)
        if isinstance(item, Thruster) and (item.on_off or item.least_impulse)
    }


def _pulses(
    thrusters: Mapping[int, tuple[str, Thruster]], high: Array, sample: int, dt: float
) -> Pulses:
    """Return pulsed thrusters {input: (name, thruster)}; `high` (nu,) is the limit of the inputs.

    Where it is infinite, an on-off thruster gives its own `max`.
    """
    at, items = list(thrusters), [item for _, item in thrusters.values()]
    on_off = np.array([item.on_off for item in items])
    own = np.array([item.ranges[0][1] if item.on_off else np.inf for item in items])
    most = np.where(np.isfinite(high[at]), high[at], own)
    for (name, item), largest in zip(thrusters.values(), most.tolist(), strict=True):
        if not sample:
            raise InputError(
                f"thruster '{name}' is pulsed (on_off, least_impulse), which needs sampled "
                "commands; give sample=, or a policy for a sampled model"
            )
        if (item.least_impulse or 0.0) > largest * sample * dt:
            raise InputError(
                f"thruster '{name}' has a least impulse of {item.least_impulse:g} N s, but "
                f"can give only {largest * sample * dt:.3g} N s within a sample; give a longer "
                "sample time"
            )
    return Pulses(
        at=np.array(at),
        on_off=on_off,
        most=most,
        least=np.array([item.least_impulse or 0.0 for item in items]),
        quantum=np.where(on_off, most * dt, 1.0),
        left=np.zeros(len(at)),
        level=np.zeros(len(at)),
        end=np.zeros(len(at)),
        time=sample * dt,
    )


def warn_beyond(
    robot: str,
    where: str,
    names: Sequence[str],
    units: Sequence[str],
    asked: Array,
    low: Array,
    high: Array,
) -> None:
    """Warn of inputs that are asked, in any of the rows (N, nu), for more than their limits."""
    bounds = np.where(asked > 0.0, high, low)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.nan_to_num(np.abs(asked / bounds), posinf=np.inf)
    worst = share.argmax(axis=0)
    beyond = [
        f"{name} requires {asked[row, k]:.3g} {unit}, its limit is {bounds[row, k]:g}"
        for k, (name, unit, row) in enumerate(zip(names, units, worst, strict=True))
        if share[row, k] > 1.0 + 1e-6
    ]
    if beyond:
        said = f"the input limits are too small for '{robot}' {where}: {listed(beyond)}"
        warnings.warn(said, FflinWarning, stacklevel=3)
