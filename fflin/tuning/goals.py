"""Goals of a tuned law: gains, margins, decay rates, damping, variances and step responses."""

from __future__ import annotations

import math
from abc import ABC
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Literal, TypeAlias

import numpy as np

from fflin.base.errors import InputError
from fflin.base.validation import number, positive, truth
from fflin.tuning.weights import Weight, weight_of

if TYPE_CHECKING:
    from fflin.tuning.structures import Names

# Signals with sizes: names, or {name, group or pattern: size}.
Sized: TypeAlias = "Names | Mapping[str, float]"

# Relative rounding error of a time.
_ROUNDING = 1e-9

# Largest disk margin of a loop.
_LARGEST_DISK = 2.0


class Goal(ABC):
    """Goal of `tune`.

    The value of a goal is 1 or less if the goal holds. A hard goal is a constraint: the other goals
    are improved only as long as all hard goals hold.

    Attributes
    ----------
    hard : bool
        Whether the goal is a constraint.

    Examples
    --------
    >>> isinstance(fflin.Margin(0.5), fflin.Goal)
    True
    """

    hard: bool
    _LABEL: ClassVar[str] = ""

    @property
    def label(self) -> str:
        """Short text for the report."""
        return self._LABEL


def _band(band: object) -> tuple[float, float]:
    """Return the ends of a band of frequencies [rad/s]."""
    if not isinstance(band, Sequence) or len(band) != 2:
        raise InputError(f"band is {band!r}, expected (least, largest) in rad/s")
    low = number("band", band[0])
    high = math.inf
    if band[1] != math.inf:
        high = number("band", band[1])
    if not 0.0 <= low < high:
        raise InputError(
            f"band is {low:g} to {high:g} rad/s, expected 0 <= least < largest"
        )
    return low, high


def _require_signals(goal: MaxGain | RollOff | Variance) -> None:
    """Raise `InputError` if a goal has no inputs or no outputs."""
    for key, example in (("inputs", "tau_b"), ("outputs", "q_b")):
        given = getattr(goal, key)
        if isinstance(given, Sequence | Mapping) and not given:
            raise InputError(
                f"{key} are {given!r}, expected one signal or more, such as '{example}'"
            )


def shown(signals: Sized) -> str:
    """Return signals as a short text."""
    if isinstance(signals, Sequence | Mapping) and not isinstance(signals, str):
        return ", ".join(map(str, signals))
    return str(signals)


@dataclass(frozen=True, eq=False)
class MaxGain(Goal):
    """Bound of the largest gain from inputs to outputs over frequency.

    The gain is the largest singular value. Signals are named as in the model:

    - an input of the robot, such as "tau_b.x": as input of the goal, a disturbance that is added
      to the command; as output of the goal, the command of the law;
    - a measured output, such as "q_b.x": as input of the goal, an error of its sensor; as output of
      the goal, its true value. ``"error.NAME"`` is the measured value, the true value and the error
      of the sensor, which is also the tracking error for a reference of the opposite sign;
    - a state of the model, only as output of the goal.

    Parameters
    ----------
    inputs, outputs : str, sequence of str, or mapping
        Names, groups or patterns. A mapping ``{name: size}`` divides each signal by its size.
    below : float or weight
        Bound of the gain: a number, or a transfer function of frequency, as ``(numerator,
        denominator)`` or as a SciPy or python-control system with one input and one output. All its
        poles and zeros must be stable, and its degrees equal.
    band : (float, float)
        Frequencies [rad/s] at which the bound holds; all by default.
    hard : bool

    Raises
    ------
    InputError
        If there are no inputs or outputs, or the bound is not positive, or is not a stable transfer
        function with stable zeros.

    Examples
    --------
    >>> goal = fflin.MaxGain({"tau_b": 0.01}, {"q_b": 1e-3}, below=1.0)
    >>> rising = fflin.MaxGain("q_b", "error.q_b", below=([2.0, 0.01], [1.0, 0.5]))
    """

    inputs: Sized
    outputs: Sized
    below: object = 1.0
    band: tuple[float, float] = (0.0, math.inf)
    hard: bool = False

    def __post_init__(self) -> None:
        _require_signals(self)
        object.__setattr__(self, "band", _band(self.band))
        truth("hard", self.hard)
        self.weight()

    def weight(self) -> Weight:
        """Return the inverse of the bound."""
        return weight_of("below", self.below).inverse()

    @property
    def label(self) -> str:
        """Short text for the report."""
        return f"gain {shown(self.inputs)} to {shown(self.outputs)}"


@dataclass(frozen=True, eq=False)
class RollOff(Goal):
    """Bound of the largest gain from inputs to outputs above a frequency.

    Parameters
    ----------
    inputs, outputs : str, sequence of str, or mapping
        Signals as in `MaxGain`.
    above : float
        Frequency [rad/s] above which the bound holds.
    below : float
        Bound of the gain.
    hard : bool

    Raises
    ------
    InputError
        If a number is not positive, or there are no inputs or outputs.

    Examples
    --------
    >>> goal = fflin.RollOff("q_b", "tau_b", above=20.0, below=50.0)
    """

    inputs: Sized
    outputs: Sized
    above: float
    below: float
    hard: bool = False

    def __post_init__(self) -> None:
        _require_signals(self)
        positive("above", self.above, "rad/s")
        positive("below", self.below)
        truth("hard", self.hard)

    @property
    def band(self) -> tuple[float, float]:
        """Frequencies [rad/s] at which the bound holds."""
        return self.above, math.inf

    def weight(self) -> Weight:
        """Return the inverse of the bound."""
        return weight_of("below", self.below).inverse()

    @property
    def label(self) -> str:
        """Short text for the report."""
        return f"gain {shown(self.inputs)} to {shown(self.outputs)} above {self.above:g} rad/s"


@dataclass(frozen=True, eq=False)
class Margin(Goal):
    """Least disk margin for changes of all channels at once; see `margins`.

    The channels are scaled by constant factors, which the search chooses. The disk margin of
    `margins` uses the best factors at each frequency, so it is at least as large.

    Parameters
    ----------
    disk : float
        Least disk margin, between 0 and 2. A margin of 0.75 allows for gains of 0.45 to 2.2, and
        for a phase of 41 deg.
    at : {"inputs", "outputs"}
        Whether the inputs or the measured outputs are changed.
    hard : bool

    Raises
    ------
    InputError
        If the margin is not between 0 and 2.

    Examples
    --------
    >>> goal = fflin.Margin(0.75, hard=True)
    """

    disk: float
    at: Literal["inputs", "outputs"] = "inputs"
    hard: bool = False

    def __post_init__(self) -> None:
        disk = positive("disk", self.disk)
        if disk >= _LARGEST_DISK:
            raise InputError(f"disk is {disk:g}, expected a margin between 0 and 2")
        if not isinstance(self.at, str) or self.at not in ("inputs", "outputs"):
            raise InputError(f"at is {self.at!r}, expected 'inputs' or 'outputs'")
        truth("hard", self.hard)

    @property
    def label(self) -> str:
        """Short text for the report."""
        return f"disk margin at the {self.at}"


@dataclass(frozen=True, eq=False)
class Decay(Goal):
    """Least decay rate of all poles of the closed loop.

    Parameters
    ----------
    rate : float
        Least decay rate [1/s]: the real parts of all poles are below -rate. Modes that no input of
        the law or a goal reaches, or that none of their outputs contains, are excluded. Examples
        are the position under an attitude law, and modes of equal wings that do not turn the base.
    hard : bool

    Raises
    ------
    InputError
        If the rate is not positive.

    Examples
    --------
    >>> goal = fflin.Decay(0.05)
    """

    rate: float
    hard: bool = False
    _LABEL = "decay rate"

    def __post_init__(self) -> None:
        positive("rate", self.rate, "1/s")
        truth("hard", self.hard)


@dataclass(frozen=True, eq=False)
class Damping(Goal):
    """Least damping ratio of the poles of the closed loop.

    Parameters
    ----------
    ratio : float
        Least damping ratio, between 0 and 1, of the same poles as for `Decay`.
    band : (float, float)
        Magnitudes [rad/s] of the poles to which the goal applies; all by default.
    hard : bool

    Raises
    ------
    InputError
        If the ratio is not between 0 and 1, or the band is empty.

    Examples
    --------
    >>> goal = fflin.Damping(0.5, band=(0.0, 1.0))
    """

    ratio: float
    band: tuple[float, float] = (0.0, math.inf)
    hard: bool = False
    _LABEL = "damping ratio"

    def __post_init__(self) -> None:
        ratio = positive("ratio", self.ratio)
        if ratio > 1.0:
            raise InputError(f"ratio is {ratio:g}, expected a damping ratio up to 1")
        object.__setattr__(self, "band", _band(self.band))
        truth("hard", self.hard)


@dataclass(frozen=True, eq=False)
class Variance(Goal):
    r"""Bounds of standard deviations under white noise.

    Parameters
    ----------
    inputs : mapping
        Noise ``{name: density}`` at the signals of `MaxGain`. In continuous time, the density is
        the square root of the intensity W of ``E[w(t) w(t')] = W \delta(t - t')``, as in `kalman`.
        For a sampled model, it is the standard deviation of each sample.
    outputs : mapping
        Largest standard deviation of each signal, ``{name: largest}``.
    hard : bool

    Raises
    ------
    InputError
        If a number is not positive, or there are no inputs or outputs.

    Examples
    --------
    >>> goal = fflin.Variance({"tau_b": 1e-3}, {"q_b": 1e-4})
    """

    inputs: Mapping[str, float]
    outputs: Mapping[str, float]
    hard: bool = False

    def __post_init__(self) -> None:
        for key in ("inputs", "outputs"):
            if not isinstance(getattr(self, key), Mapping):
                raise InputError(
                    f"{key} are {getattr(self, key)!r}, expected {{name: standard deviation}}"
                )
        _require_signals(self)
        truth("hard", self.hard)

    @property
    def label(self) -> str:
        """Short text for the report."""
        return f"variance of {shown(self.outputs)}"


@dataclass(frozen=True, eq=False)
class Track(Goal):
    """Step response of an output to its reference within a template.

    The law receives the measured output minus the reference.

    Parameters
    ----------
    output : str
        Name of a measured output.
    settling : float
        Time [s] after which the error stays within `within`.
    within : float
        Largest error after the settling time, as a fraction of the step; 0.05 is 5 %.
    overshoot : float
        Largest overshoot, as a fraction of the step.
    duration : float, optional
        Duration [s] that is examined; three settling times by default.
    hard : bool

    Raises
    ------
    InputError
        If a number is not positive, `within` or `overshoot` is not less than 1, or the duration is
        not longer than the settling time.

    Examples
    --------
    >>> goal = fflin.Track("q_b.x", settling=60.0, within=0.05, overshoot=0.3)
    """

    output: str
    settling: float
    within: float = 0.05
    overshoot: float = 0.2
    duration: float | None = None
    hard: bool = False

    def __post_init__(self) -> None:
        settling = positive("settling", self.settling, "s")
        for key in ("within", "overshoot"):
            fraction = positive(key, getattr(self, key))
            if fraction >= 1.0:
                raise InputError(
                    f"{key} is {fraction:g}, expected a fraction of the step, less than 1; 0.05 is "
                    "5 %"
                )
        duration = self.examined
        if not positive("duration", duration, "s") > settling:
            raise InputError(
                f"duration is {duration:g} s, expected more than the settling time of "
                f"{settling:g} s"
            )
        truth("hard", self.hard)

    @property
    def examined(self) -> float:
        """Duration [s] that is examined."""
        return 3.0 * self.settling if self.duration is None else self.duration

    @property
    def label(self) -> str:
        """Short text for the report."""
        return f"step of {self.output}"

    def bounds(self, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the least and the largest error y - 1 of a unit step at times [s]."""
        settled = times >= self.settling * (1.0 - _ROUNDING)
        low = np.where(settled, -self.within, -math.inf)
        high = np.where(settled, min(self.within, self.overshoot), self.overshoot)
        return low, high
