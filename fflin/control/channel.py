"""Channel from command to actuator: sample and hold, delay and limits."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from fflin.base.errors import InputError
from fflin.base.validation import DOUBLE, Array, as_double
from fflin.control.saturation import Saturation
from fflin.kernel import channel as rules


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
                f"policy(t, q, v) returned shape {u.shape} at t = {t:g} s, expected {self._shape} "
                "with one value for each of "
                f"{', '.join(names[:8])}" + (", ..." if names[8:] else "")
            )
        wrong = np.flatnonzero(~np.isfinite(np.clip(u, *self._limits)))
        if len(wrong) and float(v.dot(v)) < self._slow:
            raise InputError(
                f"policy(t, q, v) returned {u[wrong[0]]} for {names[wrong[0]]} at t = {t:g} s, "
                "expected finite numbers"
            )
        return u


def channel_of(limits: Saturation, initial: Array, sample: int, delay: int) -> rules.Channel:
    """Return what the kernel reads of the limits, the sample time and the delay in steps.

    `initial` (nu,) acts until the first command arrives.
    """
    slots = delay // sample + 1 if sample else 1
    channel = rules.Channel(
        low=limits.low,
        high=limits.high,
        held=initial.copy(),
        pending=np.zeros(slots * len(initial)),
        slots=slots,
        sample=sample,
        delay=np.array([float(delay)]),
        fresh=np.zeros(1),
        wheels=limits.wheels,
        pulses=limits.pulses,
    )
    rules.limit(channel, channel.held)
    return channel


class Channel:
    """The way of the commands of `law` to the inputs, by the rules of the kernel.

    `law` is called with the arguments of `begin` or `ask`. `speeds` (k,) of these arguments are
    the speeds of the wheels whose speed is limited.
    """

    def __init__(
        self,
        law: Callable[..., Array],
        initial: Array,
        limits: Saturation,
        sample: int,
        delay: int,
        speeds: Callable[..., Array],
    ) -> None:
        self._law, self._speeds, self._u = law, speeds, initial.tolist()
        self._wheels, self._pulses = len(limits.wheels.at), len(limits.pulses.at)
        self._limited = bool(np.isfinite((limits.low, limits.high)).any())
        own = channel_of(limits, initial, sample, delay)
        # The entries of a list are read faster than the entries of an array.
        self._rules = own._replace(
            low=own.low.tolist(),
            high=own.high.tolist(),
            held=own.held.tolist(),
            pending=own.pending.tolist(),
            wheels=own.wheels._replace(row=range(self._wheels)),
            pulses=own.pulses._replace(
                left=np.zeros(self._pulses),
                level=np.zeros(self._pulses),
                end=np.zeros(self._pulses),
            ),
        )

    @property
    def continuous(self) -> bool:
        """Whether the law is asked at every stage."""
        return not self._rules.sample

    @property
    def cuts(self) -> bool:
        """Whether the applied inputs may differ from the command."""
        return bool(self._limited or self._wheels or self._pulses)

    def begin(self, step: int, *point: Any) -> Array:
        """Return the applied inputs at the start of a step."""
        if not (self._rules.sample or self._limited or self._wheels):
            return self._law(*point)
        if rules.is_asked(self._rules, step):
            self._u[:] = self._law(*point).tolist()
        speeds = self._speeds(*point).tolist() if self._wheels else []
        rules.transmit(self._rules, step, speeds, self._u)
        return np.array(self._u)

    def ask(self, *point: Any) -> Array:
        """Return the applied inputs of the law's present command, if there is no sample time."""
        return self.begin(0, *point)
