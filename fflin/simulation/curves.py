"""Curves of a motion: states and inputs with their limits, predictions and references."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from fflin.base.names import input_keys
from fflin.base.validation import Array

# A limit is drawn where a curve comes to this fraction of it.
_NEAR = 1.0 / 3.0

# Between rows a target that moves less than this, in SI units, stands still.
_STILL = 1e-12


class Curve(NamedTuple):
    """Values (N,) of a state or input, limits (2,), and prediction and reference (N,), if any."""

    key: str  # GROUP.NAME
    group: str  # "speed" and "momentum" of wheels
    name: str
    unit: str
    values: Array
    limits: Array
    linear: Array | None = None
    reference: Array | None = None

    @property
    def short(self) -> str:
        """The name without its group."""
        return self.name.partition(".")[2] or self.name

    @property
    def near(self) -> list[float]:
        """Limits that are close to the values."""
        levels: list[float] = self.limits[np.isfinite(self.limits)].tolist()
        return [level for level in levels if level and (self.values / level).max() >= _NEAR]

    def momentum(self, inertia: float) -> Curve:
        """Return the momentum [N m s] of a wheel whose speed this is."""
        linear, reference = (None if x is None else inertia * x for x in self[6:])
        scaled = inertia * self.values, inertia * self.limits, linear, reference
        return Curve(self.key, "momentum", self.name, "N m s", *scaled)


def curves(motion: Any, wheels: Mapping[str, float]) -> Iterator[Curve]:
    """Yield states and inputs, and speed and momentum of wheels {name: inertia, 0 if unknown}."""
    limits = dict(zip(motion.limit_names, motion.limits, strict=True))
    unlimited = np.full(2, np.inf)
    for i, (name, unit) in enumerate(zip(motion.state_names, motion.state_units, strict=True)):
        group, _, entry = name.partition(".")
        linear, reference = (
            None if x is None else x[:, i]
            for x in (motion.linear, motion.target if motion.tracked else None)
        )
        values = motion.x[:, i], limits.get(name, unlimited), linear, reference
        if group not in ("q_m", "qdot_m") or entry not in wheels:
            yield Curve(name, group, name, unit, *values)
        elif group == "qdot_m":
            speed = Curve(name, "speed", name, unit, *values)
            yield speed
            if wheels[entry]:
                yield speed.momentum(wheels[entry])
    inputs = zip(
        input_keys(motion), motion.input_names, motion.input_units, motion.u.T, strict=True
    )
    for key, name, unit, column in inputs:
        yield Curve(key, key.partition(".")[0], name, unit, column, limits.get(name, unlimited))


def resting_from(motion: Any) -> float | None:
    """Return the time [s] from which a moving target is at rest, or None."""
    places = motion.target[:, : motion.x.shape[1] // 2] if motion.tracked else motion.x[:1]
    moved = np.flatnonzero(np.abs(np.diff(places, axis=0)).max(axis=1, initial=0.0) > _STILL)
    if not len(moved) or moved[-1] + 2 >= len(places):
        return None
    return float(motion.t[moved[-1] + 1])
