"""What acts of a command: within limits, up to the largest speed of a wheel, in pulses."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from fflin.base.validation import Array
from fflin.control.pulses import Pulses
from fflin.robot.fields import Range
from fflin.robot.inputs import Thruster, named_inputs
from fflin.robot.robot import Robot


class Wheels(NamedTuple):
    r"""Wheels that turn no faster than their largest speed.

    Within a step of dt a torque u takes the speed w of a wheel by u dt / J further, where J is what
    it turns against the rest of the robot, both free: :math:`u \le J (w_{max} - w) / dt`, and
    likewise below.

    Attributes
    ----------
    names : list of str
    at : list of int
        Where their torques stand among the inputs.
    speeds, torques : ndarray (2, k)
        Least and largest [rad/s], [N m].
    stiffness : ndarray (k,)
        J / dt [N m s/rad].
    """

    names: list[str]
    at: list[int]
    speeds: Array
    torques: Array
    stiffness: Array

    def cut(self, u: Array, speeds: Array) -> Array:
        """Return u (nu,) without what would take a wheel beyond its speed within a step."""
        told = u[self.at]
        # The motor's own limits are kept where a wheel is too fast already.
        room = np.clip(self.stiffness * (self.speeds - speeds), *self.torques)
        given = np.clip(told, *room)
        if (given == told).all():
            return u
        u = u.copy()
        u[self.at] = given
        return u


class Saturation(NamedTuple):
    """What acts of a command of the inputs of a robot.

    Attributes
    ----------
    low, high : ndarray (nu,)
    wheels : Wheels or None
    pulses : callable or None
        Makes the `Pulses` of a run.
    """

    low: Array
    high: Array
    wheels: Wheels | None = None
    pulses: Callable[[], Pulses] | None = None


def saturation(
    robot: Robot, limits: Mapping[str, Range], q: Array, dt: float, sample: int
) -> Saturation:
    """Return what acts of a command of a robot at q (nq,), in steps of dt [s].

    `limits` is {name of an input, or qdot_m of a wheel: (least, largest)}; `sample` is how many
    steps lie between samples, 0 where there are none.
    """
    inputs = [(name, item) for item, names in named_inputs(robot.inputs) for name in names]
    names = [name for name, _ in inputs]
    open_ = (-math.inf, math.inf)
    low, high = np.array([limits.get(name, open_) for name in names]).T
    thrusters = [(k, x, item) for k, (x, item) in enumerate(inputs) if isinstance(item, Thruster)]
    for k, *_ in thrusters:
        low[k] = max(low[k], 0.0)
    pulsed = [each for each in thrusters if each[2].on_off or each[2].least_impulse]
    wheels = None
    if spun := [name for name in robot.wheels if f"qdot_m.{name}" in limits]:
        at = [names.index(name) for name in spun]
        speeds = np.array([limits[f"qdot_m.{name}"] for name in spun]).T
        mobility = pin.computeMinverse(robot.model, robot.create_data(), q).diagonal()
        stiffness = 1.0 / (mobility[[robot.joint(name).idx_v for name in spun]] * dt)
        wheels = Wheels(spun, at, speeds, np.array((low, high))[:, at], stiffness)
    return Saturation(
        low, high, wheels, partial(Pulses, pulsed, high, sample, dt) if pulsed else None
    )
