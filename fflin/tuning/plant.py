"""Plants of a search: matrices of linear models with their signals, in continuous time.

A model sampled at dt is transformed to continuous time by s = (2/dt) (z - 1)/(z + 1). A continuous
law closes the loop with this plant exactly as its Tustin discretisation does with the model.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from fflin.base.errors import UnknownNameError, listed
from fflin.base.names import INPUT_GROUPS, group_of, grouped
from fflin.base.validation import Array
from fflin.linear.model import LinearModel
from fflin.tuning.minimal import Reduction

# A response of the plant below this fraction of the largest counts as zero.
_ROUNDING = 1e-9


@dataclass(frozen=True, eq=False)
class Signals:
    """Names and units of measured outputs and inputs, and the matrices between them."""

    outputs: tuple[str, ...]
    inputs: tuple[str, ...]
    output_units: tuple[str, ...]
    input_units: tuple[str, ...]
    A: Array
    B: Array
    C: Array

    @cached_property
    def input_keys(self) -> tuple[str, ...]:
        """Names GROUP.ENTRY of the inputs, such as wheel.wheel_1."""
        return grouped(self.inputs, self.input_units)

    def expanded(self, key: str) -> tuple[str, ...]:
        """Return the names that a key selects: the inputs of a group such as wheel, or the key.

        Raise `UnknownNameError` for a group of inputs that only other robots have.
        """
        if key in self.inputs or any(group_of(name) == key for name in self.inputs):
            return (key,)
        names = [
            name
            for name, full in zip(self.inputs, self.input_keys, strict=True)
            if key in (full, group_of(full))
        ]
        if not names:
            self._refuse_other_group(key)
        return tuple(names) or (key,)

    def _refuse_other_group(self, key: str) -> None:
        """Raise `UnknownNameError` if a key belongs to a group of inputs of other robots."""
        group = group_of(key) or key
        groups: dict[str, list[str]] = {}
        for name, full in zip(self.inputs, self.input_keys, strict=True):
            groups.setdefault(group_of(full), []).append(name)
        known = {*groups, *self.outputs, *map(group_of, self.outputs)}
        if group not in INPUT_GROUPS or group in known or not groups:
            return
        shown = [f"{other} ({listed(names)})" for other, names in groups.items()]
        choice = " or ".join(f"'{other}'" for other in groups)
        raise UnknownNameError(
            f"no input named '{key}': the inputs of this robot are {', '.join(shown)}; give "
            f"{choice}"
        )

    @cached_property
    def _markov(self) -> tuple[Array, ...]:
        """Products C A^k B, the initial derivatives of the impulse responses."""
        products = []
        states = self.B
        for _ in range(4):
            products.append(self.C @ states)
            states = self.A @ states
        return tuple(products)

    def response(self, output: int, command: int) -> tuple[float, int]:
        """Return the gain g and order r of the fast response g / s^r of an output to an input."""
        for order, product in enumerate(self._markov, 1):
            gain = float(product[output, command])
            if abs(gain) > _ROUNDING * np.abs(product).max(initial=0.0):
                return gain, order
        return 0.0, 1


@dataclass(frozen=True, eq=False)
class Plant:
    """Plant ``x' = A x + B u, y = C x + D u``; the rows of C are outputs and then states.

    `dt` is the sample time [s] of the model before the transformation, or 0.
    """

    A: Array
    B: Array
    C: Array
    D: Array
    ny: int
    dt: float

    def time(self, frequency: float) -> float:
        """Return the frequency [rad/s] in the time of the model."""
        if not self.dt:
            return frequency
        return 2.0 * math.atan(0.5 * self.dt * frequency) / self.dt

    def warped(self, frequency: float) -> float:
        """Return the frequency of the plant for a frequency [rad/s] in the time of the model."""
        angle = 0.5 * self.dt * frequency
        if not self.dt or math.isinf(frequency):
            return frequency
        if angle >= 0.5 * math.pi:
            return math.inf
        return math.tan(angle) * 2.0 / self.dt


def signals_of(lin: LinearModel) -> Signals:
    """Return the measured outputs and inputs of a model, in continuous time and without lags."""
    source = lin.generator if lin.dt else lin
    model = lin if source is None else source.undelayed
    return Signals(
        lin.output_names,
        lin.input_names,
        lin.output_units,
        lin.input_units,
        model.A,
        model.B,
        model.C,
    )


def plant_of(
    matrices: tuple[Array, Array, Array, Array], dt: float, reduction: Reduction
) -> Plant:
    """Return the plant of a model without its hidden states."""
    A, B, C, D = matrices
    ny, nx = len(C), len(A)
    C = np.vstack((C, np.eye(nx)))
    D = np.vstack((D, np.zeros((nx, B.shape[1]))))
    A, B, C = reduction.of(A, B, C)
    if not dt:
        return Plant(A, B, C, D, ny, 0.0)
    rate = 2.0 / dt
    unit = np.eye(len(A))
    inverse = np.linalg.inv(A + unit)
    factor = math.sqrt(2.0 * rate)
    return Plant(
        rate * inverse @ (A - unit),
        factor * inverse @ B,
        factor * C @ inverse,
        D - C @ inverse @ B,
        ny,
        dt,
    )
