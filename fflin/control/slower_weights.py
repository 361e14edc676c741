"""Default weights that are made slower until a loop with delays or lags has its disk margin."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, TypeVar

from fflin.base.errors import FflinError
from fflin.control.gain import Gain
from fflin.control.lags import lags_of_model, robot_lags
from fflin.control.optimal.disk import disk_gain
from fflin.linear.model import LinearModel

Design = TypeVar("Design")

# Disk margin of the default weights: the loop tolerates gain factors between 1/2 and 2 (6 dB).
LEAST_DISK = 2.0 / 3.0

# The bandwidth is divided by at most _MOST. If that is not enough, the filter or the delay limits
# the margin, and a slower loop would lose more than it gains. The search interpolates at most
# _TRIALS times, and ends if the margin is above its least value by at most the fraction _ABOVE.
_MOST, _TRIALS, _ABOVE = 4.0, 6, 0.02


class Slowed(NamedTuple):
    """Factors on the bandwidth, and disk margins, of a loop that was made slower.

    Attributes
    ----------
    factor : float
        Factor by which the bandwidth of the default weights was divided.
    before, disk : float
        Disk margins with the default weights, and with the slower weights.
    """

    factor: float
    before: float
    disk: float

    def __str__(self) -> str:
        if self.disk < LEAST_DISK:
            return (
                f"the disk margin {self.before:.3g} (gain {_gain(self.before)}) is below "
                f"{LEAST_DISK:.3g} (6 dB), and a loop that is {_MOST:g} times slower "
                "does not reach it"
            )
        return (
            f"made {self.factor:.3g} times slower, which raises the disk margin from "
            f"{self.before:.3g} to {self.disk:.3g} (gain {_gain(self.disk)})"
        )


def _gain(disk: float) -> str:
    low, high = disk_gain(disk)
    return f"{low:.3g} to {high:.3g}"


def is_late(gain: Gain) -> bool:
    """Return whether the model of a gain, or its robot, has delayed or lagging inputs."""
    lin = gain._lin
    if not isinstance(lin, LinearModel):
        return False
    if lin.delay.any() or lags_of_model(lin).inputs:
        return True
    return bool(robot_lags(gain, lin).inputs)


def slowed(
    first: Design,
    redesign: Callable[[float], Design],
    margin_of: Callable[[Design], float | None],
) -> tuple[Design, Slowed | None]:
    """Return the fastest design whose loop has the disk margin `LEAST_DISK`.

    Parameters
    ----------
    first : Gain or Compensator
        Design with the default weights. It is returned if its margin suffices or is unknown, or if
        slower loops do not have the margin either.
    redesign : callable
        Function that returns the design whose bandwidth is divided by a factor.
    margin_of : callable
        Function that returns the disk margin of the loop of a design, or None if it is unknown.

    Returns
    -------
    design : Gain or Compensator
    change : Slowed or None
        None if the margin of `first` suffices or is unknown.
    """
    before = margin_of(first)
    if before is None or before >= LEAST_DISK:
        return first, None
    for factor in (_MOST, _MOST**0.5):
        try:
            design = redesign(factor)
        except FflinError:  # the weights are so small that the design fails
            continue
        disk = margin_of(design) or 0.0
        if disk >= LEAST_DISK:
            return _fastest(design, Slowed(factor, before, disk), redesign, margin_of)
    return first, Slowed(1.0, before, before)


def _fastest(
    design: Design,
    change: Slowed,
    redesign: Callable[[float], Design],
    margin_of: Callable[[Design], float | None],
) -> tuple[Design, Slowed]:
    """Return the fastest design with the margin, which is at least as fast as `design`.

    The margin is interpolated over the logarithm of the factor.
    """
    fast, least = 1.0, change.before
    for _ in range(_TRIALS):
        if change.disk <= (1.0 + _ABOVE) * LEAST_DISK:
            break
        goal = (1.0 + 0.5 * _ABOVE) * LEAST_DISK
        part = (goal - least) / (change.disk - least)
        factor = fast * (change.factor / fast) ** min(max(part, 0.1), 0.9)
        trial = redesign(factor)
        disk = margin_of(trial) or 0.0
        if disk >= LEAST_DISK:
            design = trial
            change = change._replace(factor=factor, disk=disk)
        else:
            fast, least = factor, disk
    return design, change
