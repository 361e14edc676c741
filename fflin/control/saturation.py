"""Actuator saturation: input limits, wheel speed limits and thruster pulses."""

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from fflin.base.errors import FflinWarning, InputError, listed
from fflin.base.validation import Array
from fflin.robot.fields import Range
from fflin.robot.inputs import Thruster, named_inputs
from fflin.robot.robot import Robot


class Wheels(NamedTuple):
    r"""Wheels that turn no faster than their largest speed: :math:`u \le J (w_{max} - w) / dt`."""

    # Within a step of dt a torque u takes the speed w by u dt / J further, where J is what it turns
    # against the rest of the robot, both free; likewise below, as far as the motor can.

    names: list[str]
    at: list[int]  # where their torques stand among the inputs
    torques: Array  # least and largest (2, k) [N m]
    limits: Array  # least and largest speed (2, k) [rad/s]
    stiffness: Array  # J / dt (k,) [N m s/rad]
    speeds: Callable[..., Array]  # (k,) [rad/s], of whatever the law is given

    def cut(self, u: Array, *point: object) -> Array:
        """Return u (nu,) with torques cut that would exceed a wheel's speed limit in a step."""
        room = np.clip(self.stiffness * (self.limits - self.speeds(*point)), *self.torques)
        # It cuts, and drives nothing of itself.
        given = np.clip(u[self.at], np.minimum(room[0], 0.0), np.maximum(room[1], 0.0))
        if (given != u[self.at]).any():
            u = u.copy()
            u[self.at] = given
        return u


class Pulses:
    """Pulses of thrusters (index, name, thruster) that realise the command of each sample."""

    # What is asked for and not fired, for whole steps or the least impulse, is carried to the next.
    # `high` (nu,) is what they give; where it is infinite, one that is on-off gives its own `max`.

    def __init__(
        self, thrusters: Sequence[tuple[int, str, Thruster]], high: Array, sample: int, dt: float
    ) -> None:
        self.places = [at for at, *_ in thrusters]
        self.on_off = np.array([item.on_off for *_, item in thrusters])
        own = np.array([item.ranges[0][1] if item.on_off else np.inf for *_, item in thrusters])
        self.most = np.where(np.isfinite(high[self.places]), high[self.places], own)
        self.least = np.array([item.least_impulse or 0.0 for *_, item in thrusters])
        self._sample, self.time = sample, sample * dt
        self.quantum = np.where(self.on_off, self.most * dt, 1.0)
        self.left = np.zeros(len(thrusters))
        for (_, name, item), most in zip(thrusters, self.most.tolist(), strict=True):
            if not sample:
                raise InputError(
                    f"thruster '{name}' is pulsed (on_off, least_impulse), which needs sampled "
                    "commands; give the time between samples, or a policy on a sampled model"
                )
            if (item.least_impulse or 0.0) > most * self.time:
                raise InputError(
                    f"thruster '{name}' has a least impulse of {item.least_impulse:g} N s, but "
                    f"can give only {most * self.time:.3g} N s within a sample; give a longer "
                    "sampling time"
                )

    def begin(self, step: int, u: Array) -> None:
        """Take the command (nu,) of a sample."""
        wanted = np.minimum(u[self.places], self.most) * self.time + self.left
        steps = np.clip(np.rint(wanted / self.quantum), 0, self._sample)
        level = np.clip(wanted / self.time, 0.0, self.most)
        fired = np.where(self.on_off, steps * self.quantum, level * self.time)
        # An impulse that misses the least one by rounding is the least one.
        fires = (fired > 0.0) & (fired >= (1.0 - 1e-9) * self.least)
        self.left = wanted - fires * fired
        self._end = step + fires * np.where(self.on_off, steps, self._sample)
        self._level = np.where(self.on_off, self.most, level)
        self._firing = np.full(len(fires), False)
        self._acting = u.copy()
        self._acting[self.places] = 0.0

    def at(self, step: int) -> Array:
        """Return the applied inputs (nu,) in a step; the same array while nothing changes."""
        firing = step < self._end
        if (firing != self._firing).any():
            self._firing, self._acting = firing, self._acting.copy()
            self._acting[self.places] = np.where(firing, self._level, 0.0)
        return self._acting


class Saturation(NamedTuple):
    """Limits, wheels and pulses that act on the commands of a robot's inputs."""

    low: Array  # (nu,)
    high: Array
    wheels: Wheels | None
    pulses: Callable[[], Pulses] | None  # makes those of a run


def saturation(
    robot: Robot, limits: Mapping[str, Range], q: Array, dt: float, sample: int
) -> Saturation:
    """Return the saturation of commands at q, in steps of dt [s], `sample` steps a sample or 0."""
    inputs = {name: item for item, names in named_inputs(robot.inputs) for name in names}
    names = list(inputs)
    low, high = np.array([limits.get(name, (-math.inf, math.inf)) for name in names]).T
    low = np.maximum(low, [-math.inf if item.PULLS else 0.0 for item in inputs.values()])
    pulsed = [
        (names.index(name), name, item)
        for name, item in inputs.items()
        if isinstance(item, Thruster) and (item.on_off or item.least_impulse)
    ]
    wheels = None
    if spun := [name for name in robot.wheels if f"qdot_m.{name}" in limits]:
        at, of_v = [names.index(x) for x in spun], [robot.joint(x).idx_v for x in spun]
        mobility = pin.computeMinverse(robot.model, robot.create_data(), q).diagonal()[of_v]
        wheels = Wheels(
            spun,
            at,
            np.array((low[at], high[at])),
            np.array([limits[f"qdot_m.{name}"] for name in spun]).T,
            1.0 / (mobility * dt),
            lambda t, q, v: v[of_v],
        )
    for place, _, item in pulsed:
        high[place] = min(high[place], math.inf if item.max is None else item.max)
    pulses = partial(Pulses, pulsed, high, sample, dt) if pulsed else None
    return Saturation(low, high, wheels, pulses)


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
