"""Channel from command to actuator: sample and hold, delay and limits."""

import math
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np

from fflin.base.errors import InputError
from fflin.base.validation import DOUBLE, Array, as_double
from fflin.control.saturation import Saturation


class Law:
    """A policy whose commands (nu,) are checked; it gets copies of q and v."""

    def __init__(
        self,
        policy: Callable[[float, Array, Array], Any],
        names: tuple[str, ...],
        limits: tuple[Array, Array],
        slow: float,
    ) -> None:
        # Beyond `slow`, a square of the velocity, a motion diverges and may make commands infinite.
        self.policy, self._names, self._limits, self._slow = policy, names, limits, slow
        self._shape = (len(names),)
        # Of what integrates a state of its own along.
        self.advance: Any = getattr(policy, "advance", None)

    def __call__(self, t: float, q: Array, v: Array) -> Array:
        """Return the command (nu,), or raise `InputError` if it is not finite or of wrong shape."""
        u = self.policy(t, q.copy(), v.copy())
        if type(u) is not np.ndarray or u.dtype is not DOUBLE:
            u = as_double(f"policy(t, q, v) at t = {t:g} s", u)
        else:
            u = u.copy()
        if u.shape == self._shape and math.isfinite(u.dot(u)):
            return u
        names = self._names
        if u.shape != self._shape:
            raise InputError(
                f"policy(t, q, v) returned shape {u.shape} at t = {t:g} s, expected {self._shape}: "
                f"one value for each of {', '.join(names[:8])}" + (", ..." if names[8:] else "")
            )
        wrong = np.flatnonzero(~np.isfinite(np.clip(u, *self._limits)))
        if len(wrong) and float(v.dot(v)) < self._slow:
            raise InputError(
                f"policy(t, q, v) returned {u[wrong[0]]} for {names[wrong[0]]} at t = {t:g} s, "
                "expected finite numbers"
            )
        return u


class Channel:
    """A command on its way: `law` is asked at each sample, and acts `delay` steps later."""

    def __init__(
        self,
        law: Callable[..., Array],
        initial: Array,
        limits: Saturation,
        sample: int,
        delay: int,
    ) -> None:
        # In steps; `sample` is 0 of a law that is asked at every stage of every step.
        self._law, self._low, self._high = law, limits.low, limits.high
        self._sample, self._delay = sample, delay
        self._limited = bool(np.isfinite((limits.low, limits.high)).any())
        self._wheels, self._pulses = limits.wheels, limits.pulses and limits.pulses()
        self._pending: deque[tuple[int, Array]] = deque()
        self._held = self._within(initial)

    @property
    def continuous(self) -> bool:
        """Whether the law is asked at every stage."""
        return not self._sample

    @property
    def cuts(self) -> bool:
        """Whether the applied inputs may differ from the command."""
        return bool(self._limited or self._wheels or self._pulses)

    def begin(self, step: int, *point: Any) -> Array:
        """Return the applied inputs at the start of a step."""
        if not self._sample:
            return self.ask(*point)
        if step % self._sample == 0:
            self._pending.append((step + self._delay, self._within(self._law(*point))))
            if self._pulses and step < self._delay:
                self._pulses.begin(step, self._held)
        while self._pending and self._pending[0][0] <= step:
            self._held = self._pending.popleft()[1]
            if self._pulses:
                self._pulses.begin(step, self._held)
        u = self._pulses.at(step) if self._pulses else self._held
        return self._wheels.cut(u, *point) if self._wheels else u

    def ask(self, *point: Any) -> Array:
        """Return the applied inputs of the law's present command."""
        u = self._within(self._law(*point))
        return self._wheels.cut(u, *point) if self._wheels else u

    def _within(self, u: Array) -> Array:
        return np.minimum(np.maximum(u, self._low), self._high) if self._limited else u
