"""Which limits a motion passed, and which inputs were at theirs."""

from collections.abc import Iterable
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from fflin.base.validation import Array

# Beyond its limit is what is so by more than this share of it: less is the integration's.
_SHARE = 1e-3

_MOST = 8  # lines of a report

# What has limits: its name, history (N,), unit, and least and largest value (2,).
Limited: TypeAlias = "tuple[str, Array, str, Array]"


class Passed(NamedTuple):
    """A limit that was passed: the farthest value [unit], when [s], and the limit."""

    name: str
    value: float
    time: float
    limit: float
    unit: str
    at_first: bool  # whether it was beyond from the start

    def __str__(self) -> str:
        value = f"{_shown(self.value)} {self.unit}".removesuffix(" 1")
        said = f"{_name(self.name)} {value} at {_shown(self.time)} s, limit {_shown(self.limit)}"
        return f"{said}, from the start" if self.at_first else said


class Saturated(NamedTuple):
    """An input, or a wheel's speed, that was at its limit [unit] for a share of the run."""

    name: str
    limit: float
    unit: str
    share: float

    def __str__(self) -> str:
        size, share = f"{_shown(self.limit)} {self.unit}", 100.0 * self.share
        percent = f"{share:.2g}" if share < 10.0 else f"{share:.0f}"
        return f"{_name(self.name)} at its limit of {size} for {percent} % of the run"


def passed(t: Array, histories: Iterable[Limited]) -> tuple[Passed, ...]:
    """Return what went beyond its limit, that first which did so by the largest share of it."""
    found = []
    for name, values, unit, limits in histories:
        size = float(np.abs(limits[np.isfinite(limits)]).max())
        excess = np.maximum(limits[0] - values, values - limits[1])
        at = int(excess.argmax())
        if excess[at] > max(_SHARE * size, 1e-12):
            limit = float(limits[int(values[at] > limits[1])])
            first = name.startswith("q_m.") and bool(excess[0] > max(_SHARE * size, 1e-12))
            one = Passed(name, float(values[at]), float(t[at]), limit, unit, first)
            found.append((-excess[at] / (size or 1e-12), one))
    return tuple(one for _, one in sorted(found))


def saturated(t: Array, histories: Iterable[Limited]) -> tuple[Saturated, ...]:
    """Return what was at a limit other than zero, that first which was longest."""
    held = np.diff(t, append=t[-1:])
    found = [
        Saturated(name, limit, unit, float(held[near].sum() / held.sum()))
        for name, values, unit, limits in histories
        for limit in limits[np.isfinite(limits) & (limits != 0.0)].tolist()
        # The speed of a wheel creeps up to its limit, an input is cut to it.
        if held[
            near := np.abs(values - limit) <= (1e-3 if "qdot_m." in name else 1e-9) * abs(limit)
        ].any()
    ]
    return tuple(sorted(found, key=lambda each: -each.share))


def lines(motion: Any) -> list[str]:
    """Say in a report what a motion passed, and which inputs were at their limits."""
    beyond = [f"beyond its limit: {each}" for each in motion.passed]
    said = [*beyond, *map(str, motion.saturated)]
    more = [f"and {len(said) - _MOST} more"] if len(said) > _MOST else []
    return said[:_MOST] + more


def _name(name: str) -> str:
    group, _, entry = name.partition(".")
    return entry if group in ("q_m", "qdot_m") else name


def _shown(value: float) -> str:
    return f"{value:.3g}" if abs(value) < 1000.0 else f"{value:.0f}"
