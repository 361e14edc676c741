"""Structures of laws: PD, PID, filters, static gains, laws of a given order, series and sums."""

from __future__ import annotations

import math
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence, Sized
from dataclasses import dataclass, field, replace
from typing import TypeAlias

import numpy as np

from fflin.base.errors import InputError, listed
from fflin.base.names import matching
from fflin.base.validation import (
    Array,
    as_double,
    function,
    instance,
    positive,
    printable,
    truth,
    whole,
)
from fflin.control.linear_controller import LinearController
from fflin.tuning.law import (
    Law,
    Matrices,
    distributed,
    embedded,
    law_of,
    repeated,
    series,
    static_law,
    total,
)
from fflin.tuning.parameters import Given, Parameter, resolved
from fflin.tuning.plant import Signals
from fflin.tuning.state_space_start import tridiagonal_gain

# Signals: a name, group or pattern, or several.
Names: TypeAlias = str | Sequence[str]

# Without a given bandwidth [rad/s], the first search starts from this one.
_BANDWIDTH = 0.3

# Units such as rad/s or 1/s^2.
_PER_SECONDS = re.compile(r"([^/]+)/s(?:\^(\d+))?")

# Relative step of the differences for laws that users define.
_STEP = 6e-6


@dataclass(frozen=True)
class Element:
    """Part of a law for a plant.

    Attributes
    ----------
    parameters : tuple of Parameter
    measured, commanded : tuple of int or None
        Indices of its signals in the plant; None if the part acts on any number of channels.
    law : callable
        Function of the values and of the number of channels that returns the `Law`.
    of_gain : callable, optional
        Function that returns start values for a static gain (commanded, measured).
    """

    parameters: tuple[Parameter, ...]
    measured: tuple[int, ...] | None
    commanded: tuple[int, ...] | None
    law: Callable[[Array, int], Law]
    of_gain: Callable[[Array], Array] | None = None

    def used(self, signals: Signals) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Return the indices of the outputs and inputs that the law connects."""
        values = np.array(
            [parameter.value or parameter.scale for parameter in self.parameters]
        )
        measured, commanded = self.measured or (), self.commanded or ()
        law = self.law(values, len(measured))
        law = embedded(
            law, measured, commanded, len(signals.outputs), len(signals.inputs)
        )
        to_law = np.abs(law.B).sum(axis=0) + np.abs(law.dB).sum(axis=(0, 1))
        through = np.abs(law.D) + np.abs(law.dD).sum(axis=0)
        from_law = np.abs(law.C).sum(axis=1) + np.abs(law.dC).sum(axis=(0, 2))
        outputs = np.flatnonzero(to_law + through.sum(axis=0))
        inputs = np.flatnonzero(from_law + through.sum(axis=1))
        return tuple(outputs.tolist()), tuple(inputs.tolist())


class Structure(ABC):
    """Structure of a controller for `tune`.

    ``a + b`` is the sum of two structures, and ``a * b`` is their series: a acts on the output
    of b. Filters such as `LowPass`, `Lead` and `Notch` act equally on all channels of the structure
    beside them.

    Examples
    --------
    >>> law = fflin.PD("q_b", "tau_b") * fflin.LowPass()
    """

    @abstractmethod
    def element(self, signals: Signals) -> Element:
        """Return the part of a law for the signals of a plant."""

    def simpler(self) -> Structure | None:
        """Return a structure with fewer states, whose parameters have the same names."""
        return None

    def __add__(self, other: object) -> Structure:
        if not isinstance(other, Structure):
            return NotImplemented
        return _Sum(self, other)

    def __mul__(self, other: object) -> Structure:
        if not isinstance(other, Structure):
            return NotImplemented
        return _Series(self, other)


@dataclass(frozen=True, eq=False)
class _Sum(Structure):
    first: Structure
    second: Structure

    def element(self, signals: Signals) -> Element:
        parts = [self.first.element(signals), self.second.element(signals)]
        if any(part.measured is None for part in parts):
            raise InputError(
                "a filter is a term of a sum, where its signals are unknown; multiply it with a "
                "structure that has signals, such as PD"
            )
        first, second = parts
        every = _united(first.measured, second.measured)
        commanded_by = _united(first.commanded, second.commanded)
        ny, nu = len(every), len(commanded_by)
        split = len(first.parameters)

        def law(values: Array, width: int) -> Law:
            laws = []
            for part, part_values in (
                (first, values[:split]),
                (second, values[split:]),
            ):
                measured = [every.index(index) for index in part.measured or ()]
                commanded = [
                    commanded_by.index(index) for index in part.commanded or ()
                ]
                part_law = part.law(part_values, len(measured))
                laws.append(embedded(part_law, measured, commanded, ny, nu))
            return total(*laws)

        parameters = (*first.parameters, *second.parameters)
        return Element(parameters, every, commanded_by, law)

    def simpler(self) -> Structure | None:
        """Return a structure with fewer states, whose parameters have the same names."""
        return _simpler(_Sum, self.first, self.second)


def _united(
    first: tuple[int, ...] | None, second: tuple[int, ...] | None
) -> tuple[int, ...]:
    """Return the indices of two sets of signals, in order."""
    return tuple(sorted({*(first or ()), *(second or ())}))


def _simpler(
    kind: Callable[[Structure, Structure], Structure],
    first: Structure,
    second: Structure,
) -> Structure | None:
    """Return a sum or series of simpler structures, or None if neither has a simpler one."""
    simpler = first.simpler(), second.simpler()
    if simpler == (None, None):
        return None
    return kind(simpler[0] or first, simpler[1] or second)


@dataclass(frozen=True, eq=False)
class _Series(Structure):
    left: Structure
    right: Structure

    def element(self, signals: Signals) -> Element:
        left, right = self.left.element(signals), self.right.element(signals)
        if left.measured is not None and right.measured is not None:
            raise InputError(
                "both structures of a series have signals, expected a filter (LowPass, Lead or "
                "Notch) before or after a structure with signals"
            )
        measured, commanded = left.measured, left.commanded
        if measured is None:
            measured, commanded = right.measured, right.commanded
        split = len(left.parameters)

        before, after = len(measured or ()), len(commanded or ())
        # A filter of all channels gives the same law before and after the structure. It is placed
        # where there are fewer channels, and so has fewer states.
        is_swapped = measured is not None and (
            (left.measured is None and before < after)
            or (right.measured is None and after < before)
        )

        def law(values: Array, width: int) -> Law:
            narrow = width if measured is None else min(before, after)
            first = left.law(
                values[:split], narrow if left.measured is None else before
            )
            second = right.law(
                values[split:], narrow if right.measured is None else before
            )
            if not is_swapped:
                return series(first, second)
            swapped = series(second, first)
            order = np.roll(np.arange(len(values)), split)
            derivatives = [stack[order] for stack in swapped[4:]]
            return Law(*swapped[:4], *derivatives)

        part = right if left.measured is None else left
        of_gain = part.of_gain

        def start(gain: Array) -> Array:
            assert of_gain is not None
            values = of_gain(gain)
            if part is left:
                return np.concatenate((values, _values(right.parameters)))
            return np.concatenate((_values(left.parameters), values))

        parameters = (*left.parameters, *right.parameters)
        known = None if of_gain is None else start
        return Element(parameters, measured, commanded, law, known)

    def simpler(self) -> Structure | None:
        """Return a structure with fewer states, whose parameters have the same names."""
        return _simpler(_Series, self.left, self.right)


def _values(parameters: Sequence[Parameter]) -> Array:
    """Return the start values of parameters."""
    return np.array([parameter.value for parameter in parameters])


def _require_name(name: object) -> None:
    """Raise `InputError` unless a name is printable or empty."""
    if not isinstance(name, str) or name:
        printable("name", name)


def input_indices(keys: object, signals: Signals) -> tuple[int, ...]:
    """Return the indices of inputs in the order of the keys; a key may be a group such as wheel."""
    if isinstance(keys, str):
        keys = (keys,)
    if isinstance(keys, Sequence) and all(isinstance(key, str) for key in keys):
        keys = [name for key in keys for name in signals.expanded(key)]
    return indices("input", keys, signals.inputs)


def indices(kind: str, keys: object, names: Sequence[str]) -> tuple[int, ...]:
    """Return the indices of signals in the order of the keys."""
    if isinstance(keys, str):
        keys = (keys,)
    if not isinstance(keys, Sequence) or not all(isinstance(key, str) for key in keys):
        raise InputError(f"{kind}s are {keys!r}, expected names, such as 'q_b'")
    every = [index for key in keys for index in matching(kind, key, names)]
    if not every:
        raise InputError(
            f"{kind}s are {keys!r}, expected at least one name; the model has "
            f"{listed(names)}"
        )
    if len({*every}) < len(every):
        twice = next(index for index in every if every.count(index) > 1)
        raise InputError(
            f"{kind}s are {keys!r}, which contain '{names[twice]}' twice; give each name once"
        )
    return tuple(every)


def quotient(above: str, below: str) -> str:
    """Return the unit of the ratio of two quantities."""
    if below in ("1", ""):
        return above or "1"
    if above == below:
        return "1"
    if above.startswith(f"{below}/"):
        return f"1{above.removeprefix(below)}"
    divisor = f"({below})" if " " in below or "/" in below else below
    return f"{above or '1'}/{divisor}"


def power_of_seconds(order: int) -> str:
    """Return the unit of a power of time."""
    return "s" if order == 1 else f"s^{order}"


def times_seconds(unit: str) -> str:
    """Return the unit of a quantity multiplied by a time."""
    rate = _PER_SECONDS.fullmatch(unit)
    if not rate:
        return "s" if unit == "1" else f"{unit} s"
    order = int(rate[2] or 1) - 1
    if not order:
        return rate[1]
    return f"{rate[1]}/{power_of_seconds(order)}"


def per_second(unit: str) -> str:
    """Return the unit of a quantity divided by a time."""
    rate = _PER_SECONDS.fullmatch(unit)
    if not rate:
        return f"{unit}/s"
    return f"{rate[1]}/{power_of_seconds(int(rate[2] or 1) + 1)}"


@dataclass(frozen=True, eq=False)
class PID(Structure):
    r"""Proportional, integral and derivative feedback, axis by axis or coupled.

    .. math:: u = -\left(k_p + \frac{k_i}{s} + \frac{k_d\, s}{1 + \mathrm{lag}\, s}\right) y

    Parameters
    ----------
    measured : str or sequence of str
        Names, groups or patterns of the measured outputs, such as "q_b".
    inputs : str or sequence of str
        Inputs of the robot, one for each measured output, in the same order; or with `distribution`
        any number of inputs, such as four wheels.
    rates : str or sequence of str, optional
        Measured rates of the outputs, such as a gyroscope. The derivative term is then ``k_d``
        times these rates, without a lag.
    kp, ki, kd : float, (least, largest) or Tunable, optional
        Gains: a number is fixed; see `Tunable`. Units: the unit of the input by the unit of the
        output; ki per second and kd times seconds. With `rates`, kd is by the unit of the rates.
    lag : float, (least, largest) or Tunable, optional
        Time constant of the derivative [s]; at least 0.01 / bandwidth by default.
    bandwidth : float, optional
        Bandwidth [rad/s] of the first start. The gains follow from the response of the plant.
    coupled : bool
        Whether the gains are full matrices. By default, each axis has its own loop.
    shared : bool
        Whether all axes have the same gains.
    distribution : array_like (nu, k), optional
        Fixed matrix from the commands of the k axes to the inputs. By default, if there are more
        inputs than axes, the axes command the accelerations of the outputs, and the pseudo-inverse
        of the response of the plant distributes them. For an attitude q_b and wheels, the units of
        kp and kd are then 1/s^2 and 1/s.
    name : str, optional
        First part of the names of the parameters, such as "roll" for "roll.kp".

    Raises
    ------
    InputError
        If the numbers of signals differ, a name is unknown, or a number is invalid.

    Examples
    --------
    >>> law = fflin.PID("q_b", "tau_b", lag=(0.1, 1.0))
    """

    measured: Names
    inputs: Names
    rates: Names | None = None
    kp: Given = None
    ki: Given = None
    kd: Given = None
    lag: Given = None
    bandwidth: float = _BANDWIDTH
    coupled: bool = False
    shared: bool = False
    distribution: object = None
    name: str = ""

    _INTEGRAL = True

    def __post_init__(self) -> None:
        positive("bandwidth", self.bandwidth, "rad/s")
        truth("coupled", self.coupled)
        truth("shared", self.shared)
        _require_name(self.name)

    def element(self, signals: Signals) -> Element:
        """Return the part of a law for the signals of a plant."""
        measured = indices("output", self.measured, signals.outputs)
        inputs = input_indices(self.inputs, signals)
        rates: tuple[int, ...] = ()
        if self.rates is not None:
            rates = indices("output", self.rates, signals.outputs)
        k = len(measured)
        matrix = self._distribution(signals, measured, inputs)
        if (matrix is None and len(inputs) != k) or (rates and len(rates) != k):
            raise InputError(
                f"{type(self).__name__} has {k} measured outputs, {len(inputs)} inputs and "
                f"{len(rates)} rates, expected the same number of each, or more inputs than "
                "measured outputs"
            )
        axes, axis_signals = inputs, signals
        if matrix is not None:
            axis_signals = self._axes(signals, measured, inputs, matrix)
            axes = tuple(range(k))
        if rates and self.lag is not None:
            raise InputError(
                "lag acts on the derivative of outputs, but the rates are measured; leave out lag, "
                "and multiply the structure by LowPass"
            )
        parameters, places = self._gain_parameters(
            axis_signals, signals, axes, measured, rates
        )
        with_lag = not rates
        if with_lag:
            start = 0.1 / self.bandwidth
            least = 0.1 * start
            lag = Parameter(f"{self._prefix}lag", "s", start, least, math.inf, start)
            parameters.append(resolved(lag, self.lag))

        def law(values: Array, width: int) -> Law:
            if with_lag:
                lag = float(values[-1])
                of_axes = _pid(values[:-1], places, k, self._INTEGRAL, lag)
            else:
                of_axes = _pid_of_rates(values, places, k, self._INTEGRAL)
            if matrix is None:
                return of_axes
            return distributed(matrix, of_axes)

        return Element(tuple(parameters), (*measured, *rates), inputs, law)

    def _gain_parameters(
        self,
        axis_signals: Signals,
        signals: Signals,
        axes: Sequence[int],
        measured: Sequence[int],
        rates: Sequence[int],
    ) -> tuple[list[Parameter], list[tuple[str, list[tuple[int, int]]]]]:
        """Return the gains, and for each of them its term and its entries in the gain matrix."""
        k = len(measured)
        pairs = [(axis, axis) for axis in range(k)]
        if self.coupled:
            pairs = [(row, column) for row in range(k) for column in range(k)]
        terms = ["kp", "kd", *(["ki"] if self._INTEGRAL else [])]
        parameters: list[Parameter] = []
        places: list[tuple[str, list[tuple[int, int]]]] = []
        for term in terms:
            given = getattr(self, term)
            groups = [[pair] for pair in pairs]
            if self.shared:
                groups = [pairs]
            for group in groups:
                row, column = group[0]
                command, signal = axes[row], measured[column]
                if term == "kd" and rates:
                    signal = rates[column]
                where = ""
                if not self.shared and k > 1:
                    where = f".{axis_signals.inputs[command]}"
                    if self.coupled:
                        where += f".{signals.outputs[signal]}"
                default = self._default(
                    axis_signals, term, command, signal, row == column
                )
                label = f"{self._prefix}{term}{where}"
                default = _named(default, label)
                parameters.append(resolved(default, given))
                places.append((term, group))
        return parameters, places

    def _distribution(
        self, signals: Signals, measured: Sequence[int], inputs: Sequence[int]
    ) -> Array | None:
        """Return the matrix from the axes to the inputs, or None if each axis has one input."""
        shape = len(inputs), len(measured)
        if self.distribution is not None:
            matrix = as_double("distribution", self.distribution)
            if matrix.shape != shape:
                raise InputError(
                    f"distribution has shape {matrix.shape}, expected {shape}: inputs and measured "
                    "outputs"
                )
            return matrix
        if shape[0] <= shape[1]:
            return None
        response = np.zeros(shape[::-1])
        for row, output in enumerate(measured):
            for column, command in enumerate(inputs):
                response[row, column] = signals.response(output, command)[0]
        if np.linalg.matrix_rank(response) < len(measured):
            raise InputError(
                f"the inputs {self.inputs!r} cannot accelerate the outputs {self.measured!r} "
                "independently of each other; give distribution=, or other inputs"
            )
        return np.asarray(np.linalg.pinv(response))

    def _axes(
        self,
        signals: Signals,
        measured: Sequence[int],
        inputs: Sequence[int],
        matrix: Array,
    ) -> Signals:
        """Return signals whose inputs are the commands of the axes."""
        units = [signals.input_units[inputs[0]] for _ in measured]
        if self.distribution is None:
            units = []
            for index in measured:
                responses = [signals.response(index, command) for command in inputs]
                order = min(order for gain, order in responses if gain)
                unit = signals.output_units[index]
                units.append(quotient(unit, power_of_seconds(order)))
        names = tuple(signals.outputs[index] for index in measured)
        B = signals.B[:, list(inputs)] @ matrix
        return replace(signals, inputs=names, input_units=tuple(units), B=B)

    @property
    def _prefix(self) -> str:
        return f"{self.name}." if self.name else ""

    def _default(
        self, signals: Signals, term: str, command: int, signal: int, diagonal: bool
    ) -> Parameter:
        """Return a parameter that starts at the bandwidth."""
        w = self.bandwidth
        gain, order = signals.response(signal, command)
        size = w**order / abs(gain) if gain else 1.0
        unit = quotient(signals.input_units[command], signals.output_units[signal])
        if term == "ki":
            size *= 0.1 * w
            unit = per_second(unit)
        if term == "kd" and self.rates is None:
            size *= 1.4 / w
            unit = times_seconds(unit)
        elif term == "kd":
            size *= 1.4
        if not diagonal:
            return Parameter(term, unit, 0.0, -math.inf, math.inf, size)
        if self.coupled:
            value = math.copysign(size, gain) if gain else 0.0
            return Parameter(term, unit, value, -math.inf, math.inf, size)
        if gain < 0.0:
            return Parameter(term, unit, -size, -math.inf, 0.0, size)
        return Parameter(term, unit, size, 0.0, math.inf, size)


def _named(parameter: Parameter, name: str) -> Parameter:
    return replace(parameter, name=name)


def _gains(
    values: Array, places: Sequence[tuple[str, list[tuple[int, int]]]], k: int
) -> tuple[dict[str, Array], list[tuple[str, Array]]]:
    """Return the gain matrices of the terms, and the derivative of each parameter."""
    gains: dict[str, Array] = {term: np.zeros((k, k)) for term in ("kp", "ki", "kd")}
    derivatives: list[tuple[str, Array]] = []
    for value, (term, pairs) in zip(values, places, strict=True):
        unit = np.zeros((k, k))
        for pair in pairs:
            unit[pair] = 1.0
        gains[term] += value * unit
        derivatives.append((term, unit))
    return gains, derivatives


def _pid(
    values: Array,
    places: Sequence[tuple[str, list[tuple[int, int]]]],
    k: int,
    integral: bool,
    lag: float,
) -> Law:
    """Return the law with a filtered derivative; the states are the filters and the integrals."""
    gains, derivatives = _gains(values, places, k)
    unit, none = np.eye(k), np.zeros((k, k))

    def matrices(kp: Array, ki: Array, kd: Array) -> tuple[Array, Array]:
        C = np.hstack((kd / lag, -ki)) if integral else kd / lag
        return C, -kp - kd / lag

    C, D = matrices(**gains)
    A, B = -unit / lag, unit / lag
    dA, dB = unit / lag**2, -unit / lag**2
    dC, dD = -gains["kd"] / lag**2, gains["kd"] / lag**2
    if integral:
        A = np.block([[A, none], [none, none]])
        dA = np.block([[dA, none], [none, none]])
        B, dB = np.vstack((B, unit)), np.vstack((dB, none))
        dC = np.hstack((dC, none))
    changes: list[Matrices] = []
    for term, change in derivatives:
        terms = {key: none for key in gains} | {term: change}
        changes.append((np.zeros_like(A), np.zeros_like(B), *matrices(**terms)))
    changes.append((dA, dB, dC, dD))
    return law_of((A, B, C, D), changes)


def _pid_of_rates(
    values: Array,
    places: Sequence[tuple[str, list[tuple[int, int]]]],
    k: int,
    integral: bool,
) -> Law:
    """Return the law with measured rates; the states are the integrals."""
    gains, derivatives = _gains(values, places, k)
    n = k if integral else 0
    A, B = np.zeros((n, n)), np.eye(2 * k)[:n]
    none = np.zeros((k, k))

    def matrices(kp: Array, ki: Array, kd: Array) -> tuple[Array, Array]:
        return -ki[:, :n], -np.hstack((kp, kd))

    changes: list[Matrices] = []
    for term, change in derivatives:
        terms = {key: none for key in gains} | {term: change}
        changes.append((A, np.zeros_like(B), *matrices(**terms)))
    return law_of((A, B, *matrices(**gains)), changes)


class PD(PID):
    r"""Proportional and derivative feedback, axis by axis or coupled.

    .. math:: u = -\left(k_p + \frac{k_d\, s}{1 + \mathrm{lag}\, s}\right) y

    The parameters are the parameters of `PID` without ki.

    Raises
    ------
    InputError
        If the numbers of signals differ, a name is unknown, ki is given, or a number is invalid.

    Examples
    --------
    >>> law = fflin.PD("q_b", "tau_b", rates="omega_b")
    >>> coupled = fflin.PD("q_b", "tau_b", coupled=True)
    """

    _INTEGRAL = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.ki is not None:
            raise InputError("PD has no integral term; leave out ki, or use PID")


class _Filter(Structure):
    """Filter of one channel, which acts equally on several channels."""

    name: str
    _NAME = ""

    def _parameters(self) -> list[tuple[Parameter, Given]]:
        raise NotImplementedError

    def _law(self, values: Array) -> Law:
        raise NotImplementedError

    def element(self, signals: Signals) -> Element:
        """Return the part of a law for the signals of a plant."""
        prefix = self.name or self._NAME
        parameters = []
        for default, given in self._parameters():
            named = _named(default, f"{prefix}.{default.name}")
            parameters.append(resolved(named, given))
        return Element(
            tuple(parameters),
            None,
            None,
            lambda values, width: repeated(self._law(values), width),
        )


def _positive(name: str, unit: str, value: float) -> Parameter:
    """Return a parameter with positive values."""
    return Parameter(name, unit, value, 0.0, math.inf, value)


def _array(*rows: Sequence[float]) -> Array:
    return np.array(rows)


@dataclass(frozen=True, eq=False)
class LowPass(_Filter):
    r"""Low-pass filter of order 1 or 2.

    .. math:: \frac{w}{s + w}\quad\mathrm{or}\quad\frac{w^2}{s^2 + 2 \zeta w s + w^2}

    Parameters
    ----------
    frequency : float, (least, largest) or Tunable, optional
        Frequency w [rad/s]; a number is fixed.
    order : {1, 2}
    damping : float, (least, largest) or Tunable, optional
        Damping ratio of order 2; fixed at 0.7 by default.
    name : str, optional
        First part of the names of the parameters.

    Raises
    ------
    InputError
        If the order is not 1 or 2, or a number is invalid.

    Examples
    --------
    >>> law = fflin.LowPass((1.0, 20.0), order=2) * fflin.PD("q_b", "tau_b")
    """

    frequency: Given = None
    order: int = 1
    damping: Given = 0.7
    name: str = ""
    _NAME = "low_pass"

    def __post_init__(self) -> None:
        whole("order", self.order, 1, 2)
        _require_name(self.name)

    def _parameters(self) -> list[tuple[Parameter, Given]]:
        frequency = _positive("frequency", "rad/s", 10.0)
        if self.order == 1:
            return [(frequency, self.frequency)]
        damping = _positive("damping", "1", 0.7)
        return [(frequency, self.frequency), (damping, self.damping)]

    def _law(self, values: Array) -> Law:
        w = float(values[0])
        if self.order == 1:
            matrices = _array([-w]), _array([w]), _array([1.0]), _array([0.0])
            zero = _array([0.0])
            return law_of(matrices, [(_array([-1.0]), _array([1.0]), zero, zero)])
        (A, B), by_w, by_damping = _second_order(w, float(values[1]))
        C, D = _array([1.0, 0.0]), _array([0.0])
        nothing = np.zeros((1, 2)), D
        return law_of((A, B, C, D), [(*by_w, *nothing), (*by_damping, *nothing)])


def _second_order(
    w: float, damping: float
) -> tuple[tuple[Array, Array], tuple[Array, Array], tuple[Array, Array]]:
    """Return A and B of an oscillator, and their derivatives with respect to w and the damping.

    The states are ``w^2 y / p`` and ``w s y / p`` with ``p = s^2 + 2 damping w s + w^2``.
    """
    A = w * _array([0.0, 1.0], [-1.0, -2.0 * damping])
    B = _array([0.0], [w])
    by_w = A / w, B / w
    by_damping = _array([0.0, 0.0], [0.0, -2.0 * w]), np.zeros((2, 1))
    return (A, B), by_w, by_damping


@dataclass(frozen=True, eq=False)
class Lead(_Filter):
    r"""Lead or lag filter with a static gain of 1.

    .. math:: \frac{1 + s/z}{1 + s/p}

    Parameters
    ----------
    zero, pole : float, (least, largest) or Tunable, optional
        Frequencies z and p [rad/s]; a number is fixed. The filter is a lead if z is below p.
    name : str, optional
        First part of the names of the parameters.

    Raises
    ------
    InputError
        If a number is invalid.

    Examples
    --------
    >>> law = fflin.Lead() * fflin.StaticGain("q_b", "tau_b")
    """

    zero: Given = None
    pole: Given = None
    name: str = ""
    _NAME = "lead"

    def __post_init__(self) -> None:
        _require_name(self.name)

    def _parameters(self) -> list[tuple[Parameter, Given]]:
        return [
            (_positive("zero", "rad/s", 0.3), self.zero),
            (_positive("pole", "rad/s", 3.0), self.pole),
        ]

    def _law(self, values: Array) -> Law:
        z, p = (float(value) for value in values)
        ratio = p / z
        matrices = _array([-p]), _array([p]), _array([1.0 - ratio]), _array([ratio])
        zero = _array([0.0])
        by_z = zero, zero, _array([ratio / z]), _array([-ratio / z])
        by_p = _array([-1.0]), _array([1.0]), _array([-1.0 / z]), _array([1.0 / z])
        return law_of(matrices, [by_z, by_p])


@dataclass(frozen=True, eq=False)
class Notch(_Filter):
    r"""Notch filter.

    .. math:: \frac{s^2 + 2 \zeta_z w s + w^2}{s^2 + 2 \zeta_p w s + w^2}

    Parameters
    ----------
    frequency : float, (least, largest) or Tunable
        Frequency w of the notch [rad/s]; a number is fixed.
    zero_damping, pole_damping : float, (least, largest) or Tunable, optional
        Damping ratios of the numerator and of the denominator.
    name : str, optional
        First part of the names of the parameters.

    Raises
    ------
    InputError
        If a number is invalid.

    Examples
    --------
    >>> law = fflin.Notch((1.0, 3.0)) * fflin.PD("q_b", "tau_b")
    """

    frequency: Given
    zero_damping: Given = (0.01, 1.0)
    pole_damping: Given = (0.1, 2.0)
    name: str = ""
    _NAME = "notch"

    def __post_init__(self) -> None:
        _require_name(self.name)

    def _parameters(self) -> list[tuple[Parameter, Given]]:
        return [
            (_positive("frequency", "rad/s", 1.0), self.frequency),
            (_positive("zero_damping", "1", 0.1), self.zero_damping),
            (_positive("pole_damping", "1", 0.7), self.pole_damping),
        ]

    def _law(self, values: Array) -> Law:
        w, zero, pole = (float(value) for value in values)
        matrices, by_w, by_pole = _second_order(w, pole)
        C, D = _array([0.0, 2.0 * (zero - pole)]), _array([1.0])
        none = np.zeros((1, 1))
        return law_of(
            (*matrices, C, D),
            [
                (*by_w, np.zeros((1, 2)), none),
                (np.zeros((2, 2)), np.zeros((2, 1)), _array([0.0, 2.0]), none),
                (*by_pole, _array([0.0, -2.0]), none),
            ],
        )


@dataclass(frozen=True, eq=False)
class StaticGain(Structure):
    """Constant gain ``u = D y``, with zeros where a pattern says so.

    Parameters
    ----------
    measured, inputs : str or sequence of str
        Names, groups or patterns of the measured outputs and of the inputs.
    pattern : array_like (nu, ny), optional
        Nonzero where an entry is tuned; all entries are tuned by default.
    gain : array_like (nu, ny), optional
        Gain from which the first search starts.
    largest : float, optional
        Bound of the magnitude of each entry, in its own unit.
    name : str, optional
        First part of the names of the parameters.

    Raises
    ------
    InputError
        If an array has a wrong shape, or a name is unknown.

    Examples
    --------
    >>> law = fflin.StaticGain(("q_b", "omega_b"), "tau_b")
    """

    measured: Names
    inputs: Names
    pattern: object = None
    gain: object = None
    largest: float = math.inf
    name: str = ""

    def __post_init__(self) -> None:
        if not isinstance(self.largest, float) or self.largest != math.inf:
            positive("largest", self.largest)
        _require_name(self.name)

    def element(self, signals: Signals) -> Element:
        """Return the part of a law for the signals of a plant."""
        measured = indices("output", self.measured, signals.outputs)
        inputs = input_indices(self.inputs, signals)
        shape = len(inputs), len(measured)
        pattern = (
            np.ones(shape) if self.pattern is None else self._array("pattern", shape)
        )
        start = np.zeros(shape) if self.gain is None else self._array("gain", shape)
        entries = [tuple(entry) for entry in np.argwhere(pattern).tolist()]
        if not entries:
            raise InputError(
                "pattern has no nonzero entry, so there is no gain to tune"
            )
        parameters = []
        dD = np.zeros((len(entries), *shape))
        for change, (row, column) in zip(dD, entries, strict=True):
            change[row, column] = 1.0
            command, signal = inputs[row], measured[column]
            parameters.append(
                _entry(
                    signals,
                    self.name or "gain",
                    command,
                    signal,
                    float(start[row, column]),
                    self.largest,
                )
            )

        def law(values: Array, width: int) -> Law:
            return static_law(np.tensordot(values, dD, 1), dD)

        def of_gain(gain: Array) -> Array:
            return np.array([gain[entry] for entry in entries])

        start_of = of_gain if self.gain is None else None
        return Element(tuple(parameters), measured, inputs, law, start_of)

    def _array(self, key: str, shape: tuple[int, int]) -> Array:
        value = as_double(key, getattr(self, key))
        if value.shape != shape:
            raise InputError(
                f"{key} has shape {value.shape}, expected {shape}: inputs and measured outputs"
            )
        return value


def _entry(
    signals: Signals,
    name: str,
    command: int,
    signal: int,
    value: float,
    largest: float,
) -> Parameter:
    """Return the parameter of an entry of a gain."""
    gain, order = signals.response(signal, command)
    scale = _BANDWIDTH**order / abs(gain) if gain else 1.0
    unit = quotient(signals.input_units[command], signals.output_units[signal])
    label = f"{name}.{signals.inputs[command]}.{signals.outputs[signal]}"
    return Parameter(label, unit, value, -largest, largest, min(scale, largest))


@dataclass(frozen=True, eq=False)
class StateSpaceLaw(Structure):
    """Law of a given order, whose A is tridiagonal and whose B, C and D are full.

    Parameters
    ----------
    order : int
        Number of states; 0 for a static gain.
    measured, inputs : str or sequence of str
        Names, groups or patterns of the measured outputs and of the inputs; all by default.
    feedthrough : bool
        Whether D is tuned; D is zero otherwise.
    bandwidth : float, optional
        Frequency [rad/s] that scales A.
    name : str, optional
        First part of the names of the parameters.
    start : LinearController, optional
        Law of this order with which the first start begins, such as ``hinf(..).reduced(order)``.

    Raises
    ------
    InputError
        If a name is unknown, a number is invalid, or `start` has another order, measures other
        outputs or has nearly dependent eigenvectors.

    Examples
    --------
    >>> law = fflin.StateSpaceLaw(2, "q_b", "tau_b")
    """

    order: int
    measured: Names = "*"
    inputs: Names = "*"
    feedthrough: bool = True
    bandwidth: float = 1.0
    name: str = ""
    start: LinearController | None = None

    def __post_init__(self) -> None:
        whole("order", self.order, 0)
        truth("feedthrough", self.feedthrough)
        positive("bandwidth", self.bandwidth, "rad/s")
        _require_name(self.name)
        if self.start is None:
            return
        instance("start", self.start, LinearController, "a fflin.LinearController")
        order = len(self.start.system.A)
        if order != self.order:
            raise InputError(
                f"start has {order} states, but order is {self.order}; give a start of this order"
            )

    def element(self, signals: Signals) -> Element:
        """Return the part of a law for the signals of a plant."""
        measured = indices("output", self.measured, signals.outputs)
        inputs = input_indices(self.inputs, signals)
        n, ny, nu = self.order, len(measured), len(inputs)
        rng = np.random.default_rng(0)
        prefix = self.name or "law"
        shape = nu + n, ny + n
        places: list[tuple[int, int]] = []
        parameters: list[Parameter] = []

        def add(label: str, place: tuple[int, int], value: float, scale: float) -> None:
            places.append(place)
            parameters.append(
                Parameter(label, "", value * scale, -math.inf, math.inf, scale)
            )

        w = self.bandwidth
        for row in range(n):
            for column in range(max(0, row - 1), min(n, row + 2)):
                value = -1.0 - row if row == column else 0.3 * rng.standard_normal()
                label = f"{prefix}.A[{row},{column}]"
                add(label, (nu + row, ny + column), value, w)
        scales = np.ones((nu, ny))
        for row, command in enumerate(inputs):
            for column, signal in enumerate(measured):
                scales[row, column] = _entry(
                    signals, prefix, command, signal, 0.0, math.inf
                ).scale
        # The scale of an entry of the gain is the product of the scales of C and B.
        of_outputs = np.exp(np.log(scales).mean(axis=0))
        of_inputs = np.exp((np.log(scales) - np.log(of_outputs)).mean(axis=1))
        for row in range(n):
            for column in range(ny):
                label = f"{prefix}.B[{row},{column}]"
                value = 0.5 * rng.standard_normal()
                add(label, (nu + row, column), value, w * of_outputs[column])
        for row in range(nu):
            for column in range(n):
                # With C = 0, the first start is the static gain.
                label = f"{prefix}.C[{row},{column}]"
                add(label, (row, ny + column), 0.0, of_inputs[row])
            for column in range(ny if self.feedthrough else 0):
                label = f"{prefix}.D[{row},{column}]"
                add(label, (row, column), 0.0, scales[row, column])
        changes = np.zeros((len(places), *shape))
        for change, place in zip(changes, places, strict=True):
            change[place] = 1.0
        if self.start is not None:
            sizes = w * of_outputs, of_inputs
            gain = tridiagonal_gain(self.start, measured, inputs, sizes)
            for index, place in enumerate(places):
                parameters[index] = replace(parameters[index], value=float(gain[place]))

        def law(values: Array, width: int) -> Law:
            gain = np.tensordot(values, changes, 1)
            split = gain[nu:, ny:], gain[nu:, :ny], gain[:nu, ny:], gain[:nu, :ny]
            return Law(
                *split,
                changes[:, nu:, ny:],
                changes[:, nu:, :ny],
                changes[:, :nu, ny:],
                changes[:, :nu, :ny],
            )

        def of_gain(gain: Array) -> Array:
            values = _values(parameters)
            for index, (row, column) in enumerate(places):
                if row < nu and column < ny:
                    values[index] = gain[row, column]
            return values

        has_gain = self.feedthrough and self.start is None
        start_of = of_gain if has_gain else None
        return Element(tuple(parameters), measured, inputs, law, start_of)

    def simpler(self) -> Structure | None:
        """Return a law with one state less; a law needs a state or a feedthrough.

        A law with a given start has no simpler law.
        """
        if self.start is None and self.order > (0 if self.feedthrough else 1):
            return replace(self, order=self.order - 1)
        return None


@dataclass(frozen=True, eq=False)
class CustomLaw(Structure):
    """Law that a function of named parameters defines.

    The derivatives are central differences of the function. The search rejects values of the
    parameters at which the matrices are not finite.

    Parameters
    ----------
    matrices : callable
        Function of a mapping {parameter: value} that returns A, B, C and D of the law from the
        measured outputs to the inputs, ``u = K y``. The number of states must not change.
    parameters : mapping
        Parameters {name: (least, largest), Tunable or number}; a number is fixed.
    measured, inputs : str or sequence of str
        Names, groups or patterns of the measured outputs and of the inputs.

    Raises
    ------
    InputError
        If a parameter has no start value and no bounds, or a matrix has a wrong shape or is not
        finite at the start values.

    Examples
    --------
    >>> def lag(k):
    ...     return [[-k["w"]]], [[k["w"]]], [[-k["k"]]], [[0.0]]
    >>> bounds = {"w": (0.1, 10.0), "k": (1.0, 1e3)}
    >>> law = fflin.CustomLaw(lag, bounds, "q_b.x", "tau_b.x")
    """

    matrices: Callable[[dict[str, float]], Sequence[object]]
    parameters: Mapping[str, Given]
    measured: Names
    inputs: Names
    _keys: tuple[str, ...] = field(default=(), init=False)

    def __post_init__(self) -> None:
        function("matrices", self.matrices, "parameters")
        if not isinstance(self.parameters, Mapping) or not self.parameters:
            raise InputError(
                f"parameters are {self.parameters!r}, expected {{name: (least, largest)}}"
            )
        object.__setattr__(self, "_keys", tuple(map(str, self.parameters)))

    def element(self, signals: Signals) -> Element:
        """Return the part of a law for the signals of a plant."""
        measured = indices("output", self.measured, signals.outputs)
        inputs = input_indices(self.inputs, signals)
        parameters = []
        for key, given in zip(self._keys, self.parameters.values(), strict=True):
            default = Parameter(key, "", math.nan, -math.inf, math.inf, 1.0)
            parameter = resolved(default, given)
            value = parameter.value
            if math.isnan(value):
                value = 0.5 * (parameter.least + parameter.largest)
            if not math.isfinite(value):
                raise InputError(
                    f"parameter '{key}' has no start value; give (least, largest) or a Tunable "
                    "with a value"
                )
            scale = abs(value) or 1.0
            parameters.append(
                Parameter(
                    key,
                    "",
                    value,
                    parameter.least,
                    parameter.largest,
                    scale,
                    parameter.fixed,
                    parameter.source,
                )
            )

        self._require_finite(_values(parameters), len(measured), len(inputs))

        def law(values: Array, width: int) -> Law:
            center = self._system(values, len(measured), len(inputs))
            changes: list[Matrices] = []
            for index, value in enumerate(values.tolist()):
                step = _STEP * max(abs(value), 1e-3 * parameters[index].scale)
                ends = []
                for sign in (1.0, -1.0):
                    moved = values.copy()
                    moved[index] += sign * step
                    ends.append(self._system(moved, len(measured), len(inputs)))
                pairs = zip(*ends, strict=True)
                A, B, C, D = ((up - down) / (2.0 * step) for up, down in pairs)
                changes.append((A, B, C, D))
            return law_of(center, changes)

        return Element(tuple(parameters), measured, inputs, law)

    def _require_finite(self, starts: Array, ny: int, nu: int) -> None:
        """Raise `InputError` if a matrix is not finite at the start values."""
        matrices = self._system(starts, ny, nu)
        for key, matrix in zip("ABCD", matrices, strict=True):
            if np.isfinite(matrix).all():
                continue
            values = zip(self._keys, starts.tolist(), strict=True)
            where = ", ".join(f"{name} = {value:g}" for name, value in values)
            raise InputError(
                f"the function of the law returned a matrix {key} that is not finite at the start "
                f"values {where}, expected finite numbers; correct the function, or give other "
                "bounds or start values"
            )

    def _system(self, values: Array, ny: int, nu: int) -> Matrices:
        """Return the matrices at the values of the parameters, with their sizes checked."""
        given = self.matrices(dict(zip(self._keys, values.tolist(), strict=True)))
        if not isinstance(given, Sized) or len(given) != 4:
            kind = type(given).__name__
            count = f" of length {len(given)}" if isinstance(given, Sized) else ""
            raise InputError(
                f"the function of the law returned a {kind}{count}, expected the four matrices A, "
                "B, C and D; return them as a tuple"
            )
        A, B, C, D = (
            np.atleast_2d(as_double(key, matrix))
            for key, matrix in zip("ABCD", given, strict=True)
        )
        n = len(A) if A.size else 0
        if not n:
            A, B, C = np.zeros((0, 0)), np.zeros((0, ny)), np.zeros((nu, 0))
        shapes = A.shape, B.shape, C.shape, D.shape
        expected = (n, n), (n, ny), (nu, n), (nu, ny)
        if shapes != expected:
            raise InputError(
                f"A, B, C and D of the law have shapes {shapes}, expected {expected}"
            )
        return A, B, C, D


class Structured:
    """Law of a structure for the signals of a plant, as a function of its free parameters."""

    def __init__(self, structure: Structure, signals: Signals) -> None:
        self._structure, self._signals = structure, signals
        element = structure.element(signals)
        if element.measured is None or element.commanded is None:
            raise InputError(
                "the structure has no signals; multiply the filter with a structure that has, such "
                "as PD"
            )
        self._element = element
        self._width = len(element.measured)
        self.used = element.used(signals)
        self._sizes = len(signals.outputs), len(signals.inputs)
        self.parameters: list[Parameter] = []
        self._place: list[int] = []
        sources: dict[int, int] = {}
        for parameter in element.parameters:
            key = id(parameter.source)
            if parameter.source is not None and key in sources:
                self._place.append(sources[key])
                continue
            index = len(self.parameters)
            if parameter.source is not None:
                sources[key] = index
            self._place.append(index)
            self.parameters.append(parameter)
        self._is_shared = len(self.parameters) < len(self._place)
        self.parameters = _distinct(self.parameters)
        self.free = [not parameter.fixed for parameter in self.parameters]
        if not any(self.free):
            raise InputError(
                "all parameters of the structure are fixed; free one of them"
            )

    @property
    def simpler(self) -> Structured | None:
        """Law with fewer states, or None."""
        structure = self._structure.simpler()
        return None if structure is None else Structured(structure, self._signals)

    @property
    def has_gain(self) -> bool:
        """Whether the law can start as a static gain."""
        return self._element.of_gain is not None

    def of_gain(self, gain: Array) -> Array:
        """Return start values for a gain (commanded, measured) of the signals in `used`."""
        element = self._element
        assert element.of_gain is not None
        assert element.measured is not None
        assert element.commanded is not None
        full = np.zeros(self._sizes[::-1])
        measured, commanded = self.used
        full[np.ix_(commanded, measured)] = gain
        values = element.of_gain(full[np.ix_(element.commanded, element.measured)])
        result = _values(self.parameters)
        for value, place in zip(values.tolist(), self._place, strict=True):
            if self.free[place]:
                result[place] = value
        return result

    def law(self, values: Array) -> Law:
        """Return the law from all outputs to all inputs, with derivatives for all parameters."""
        element = self._element
        law = element.law(values[self._place], self._width)
        law = embedded(
            law, element.measured or (), element.commanded or (), *self._sizes
        )
        if not self._is_shared:
            return law
        stacks = []
        for stack in law[4:]:
            merged = np.zeros((len(self.parameters), *stack.shape[1:]))
            np.add.at(merged, self._place, stack)
            stacks.append(merged)
        return Law(*law[:4], *stacks)


def _distinct(parameters: list[Parameter]) -> list[Parameter]:
    """Return the parameters, with numbers after names that occur again."""
    counts: dict[str, int] = {}
    result = []
    for parameter in parameters:
        name = parameter.name
        counts[name] = counts.get(name, 0) + 1
        label = name if counts[name] == 1 else f"{name}_{counts[name]}"
        result.append(_named(parameter, label))
    return result
