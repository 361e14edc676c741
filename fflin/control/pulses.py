"""Thrusters that fire in pulses, or not below an impulse, from sample to sample."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fflin.base.errors import InputError
from fflin.base.validation import Array
from fflin.robot.inputs import Thruster


class Pulses:
    """What thrusters (place, name, thruster) that fire in pulses make of each sample's command."""

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
                    f"thruster '{name}' fires from sample to sample (on_off, least_impulse); give "
                    "the time between samples, or a policy on a sampled model"
                )
            if (item.least_impulse or 0.0) > most * self.time:
                raise InputError(
                    f"thruster '{name}' has a least impulse of {item.least_impulse:g} N s, but "
                    f"gives {most * self.time:.3g} N s in a sample; take longer samples"
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
        """Return what acts (nu,) in a step; the same array while nothing changes."""
        firing = step < self._end
        if (firing != self._firing).any():
            self._firing, self._acting = firing, self._acting.copy()
            self._acting[self.places] = np.where(firing, self._level, 0.0)
        return self._acting
