"""How a command reaches the robot: held between samples, late, and within limits."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from fflin.base.errors import InputError
from fflin.base.names import by_name, input_keys
from fflin.base.validation import DOUBLE, Array, as_double, dimension, number
from fflin.dynamics.actuation import Actuation


def limits_of(actuation: Actuation, limits: Any) -> tuple[Array, Array]:
    """Return the least and the largest value (nu,) of each input.

    Parameters
    ----------
    actuation : Actuation
    limits : None, float or mapping
        Largest magnitude of all inputs, or {name of an input, a group or a pattern: largest
        magnitude, or (least, largest)}. A thruster never pulls.

    Raises
    ------
    InputError
        If a limit is negative or not a number, or a range is empty.
    UnknownNameError
        If there is no such input or group.
    """
    names, groups = actuation.names, actuation.groups
    low, high = np.full(len(names), -np.inf), np.full(len(names), np.inf)
    if limits is None:
        given: Mapping[str, Any] = {}
    elif isinstance(limits, Mapping):
        given = limits
    else:
        given = dict.fromkeys(groups, limits)
    ranges = {name: _range(name, value) for name, value in given.items()}
    for index, (least, largest) in by_name("input", ranges, input_keys(actuation)).items():
        low[index], high[index] = least, largest
    thrusters = groups.get("thrust", np.zeros(0, dtype=int))
    low[thrusters] = np.maximum(low[thrusters], 0.0)
    return low, high


def _range(name: str, value: Any) -> tuple[float, float]:
    if dimension(f"limit of '{name}'", value) == 1 and len(value) == 2:
        least, largest = (number(f"limit of '{name}'", x) for x in value)
    else:
        largest = number(f"limit of '{name}'", value)
        least = -largest
    if least > largest:
        raise InputError(
            f"limit of '{name}' is {value}, expected a magnitude of 0 or more, or (least, largest)"
        )
    return least, largest


class Law:
    """A policy whose commands are checked, and which gets copies of q and v.

    Parameters
    ----------
    policy : callable
        policy(t, q, v) -> u (nu,)
    names : tuple of str
        Of the inputs.
    limits : tuple of ndarray (nu,)
        Within which it will act.
    slow : float
        Square of the velocity beyond which it need not be finite: the motion diverges.
    """

    def __init__(
        self,
        policy: Callable[[float, Array, Array], Any],
        names: tuple[str, ...],
        limits: tuple[Array, Array],
        slow: float,
    ) -> None:
        self._policy, self._names, self._limits, self._slow = policy, names, limits, slow
        self._shape = (len(names),)

    def __call__(self, t: float, q: Array, v: Array) -> Array:
        """Return the command (nu,), or raise `InputError` where it is none."""
        u = self._policy(t, q.copy(), v.copy())
        if type(u) is not np.ndarray or u.dtype is not DOUBLE:
            u = as_double(f"policy(t, q, v) at t = {t:g} s", u)
        else:
            u = u.copy()
        if u.shape == self._shape and math.isfinite(u.dot(u)):
            return u
        names = self._names
        if u.shape != self._shape:
            raise InputError(
                f"policy(t, q, v) gave shape {u.shape} at t = {t:g} s, expected {self._shape}: "
                f"a value for each of {', '.join(names[:8])}" + (", ..." if names[8:] else "")
            )
        wrong = np.flatnonzero(~np.isfinite(np.clip(u, *self._limits)))
        if len(wrong) and float(v.dot(v)) < self._slow:
            raise InputError(
                f"policy(t, q, v) gave {u[wrong[0]]} for {names[wrong[0]]} at t = {t:g} s, "
                "expected finite numbers"
            )
        return u


class Channel:
    """A command on its way: `law` is asked at each sample, and acts `delay` steps later.

    Parameters
    ----------
    law : callable
        Returns the command (nu,) of whatever it is given.
    initial : ndarray (nu,)
        What acts until the first command arrives.
    low, high : ndarray (nu,)
    sample : int
        Steps between samples; 0 for a law that is asked at every stage of every step.
    delay : int
        Steps between a sample and its effect.
    """

    def __init__(
        self,
        law: Callable[..., Array],
        initial: Array,
        low: Array,
        high: Array,
        sample: int,
        delay: int,
    ) -> None:
        self._law, self._low, self._high = law, low, high
        self._sample, self._delay = sample, delay
        self._limited = bool(np.isfinite(low).any() or np.isfinite(high).any())
        self._pending: deque[tuple[int, Array]] = deque()
        self._held = self._within(initial)

    @property
    def continuous(self) -> bool:
        """Whether the law is asked at every stage."""
        return not self._sample

    def begin(self, step: int, *point: Any) -> Array:
        """Return what acts as a step begins."""
        if not self._sample:
            return self.ask(*point)
        if step % self._sample == 0:
            self._pending.append((step + self._delay, self.ask(*point)))
        while self._pending and self._pending[0][0] <= step:
            self._held = self._pending.popleft()[1]
        return self._held

    def ask(self, *point: Any) -> Array:
        """Return the law's command within its limits."""
        return self._within(self._law(*point))

    def _within(self, u: Array) -> Array:
        return np.minimum(np.maximum(u, self._low), self._high) if self._limited else u
