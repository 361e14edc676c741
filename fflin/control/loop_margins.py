"""Results of the analysis of a loop: its margins, and how they are shown."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple

from fflin.base.html import Reported
from fflin.base.tables import cut, folded, grid
from fflin.base.validation import FrozenArrays, Values

# A disk margin below this gives a warning.
FRAGILE = 0.3

Place = Literal["inputs", "outputs"]


class ChannelMargins(NamedTuple):
    """Margins of one input or output, with the loops of all others closed.

    Attributes
    ----------
    name : str
        Name of the input or output.
    gain : tuple of float
        Least and largest gain factor between which the loop is stable.
    gain_frequencies : tuple of float
        Frequencies [rad/s] of the oscillations at these factors; NaN if there is no limit.
    phase : float
        Phase margin [deg], at most 180: lag or lead at which the loop becomes unstable. NaN for a
        periodic law, which acts at several frequencies at once.
    phase_frequency : float
        Frequency [rad/s] of the oscillation at the phase margin; NaN if there is none.
    delay : float
        Delay margin [s]: additional delay at which the loop becomes unstable; may be infinite.
    disk : float
        Symmetric disk margin, at most 2.
    disk_frequency : float
        Frequency [rad/s] at which the disk margin is reached.

    Examples
    --------
    >>> lin = fflin.linearize(fflin.load("planar_detumble"))
    >>> channel = fflin.margins(fflin.lqr(lin), lin).channels[0]
    >>> channel.name, channel.phase > 60.0
    ('tau_b.x', True)
    """

    name: str
    gain: tuple[float, float]
    gain_frequencies: tuple[float, float]
    phase: float
    phase_frequency: float
    delay: float
    disk: float
    disk_frequency: float


@dataclass(frozen=True, eq=False, repr=False)
class Margins(FrozenArrays, Reported):
    r"""Margins of a linear loop for changes in each channel, and in all channels at once.

    The signal of each channel is multiplied by a complex factor
    :math:`f = (1 + \delta/2)/(1 - \delta/2)`. The disk margin is the largest number below which all
    :math:`|\delta|` may be without instability.

    Attributes
    ----------
    disk : float
        Disk margin for independent changes in all channels: the loop is stable for all smaller
        ``delta``. At most 2; 0 if the loop is unstable.
    disk_reached : float
        Size of the smallest ``delta`` that is known to make the loop unstable. It equals `disk` for
        up to three channels.
    gain : tuple of float
        Gain factors in the disk: the loop is stable if the factors of all channels are between
        these values.
    phase : float
        Phase in the disk [deg].
    frequency : float
        Frequency [rad/s] at which the disk margin is reached.
    factors : ndarray (n,) or (samples, n) of complex
        Factors f of the channels with which the loop oscillates at `frequency`. The oscillation of
        a periodic loop also has the frequencies ``frequency + 2 pi k / (samples dt)``, and row k
        contains the factors there.
    channels : tuple of ChannelMargins
        Margins of one channel at a time.
    at : {"inputs", "outputs"}
        Where the factors act.
    stable : bool
        Whether the loop is stable without changes.
    robot : str
    dt : float
        Sample time [s]; 0 in continuous time.
    delay : float
        Largest delay of an input [s] with which the margins were computed.
    samples : int
        Number of samples after which the law repeats.

    Examples
    --------
    >>> lin = fflin.linearize(fflin.load("planar_detumble"))
    >>> margins = fflin.margins(fflin.lqr(lin), lin)
    >>> margins.disk >= 2 / 3, margins.stable
    (True, True)
    """

    disk: float
    disk_reached: float
    gain: tuple[float, float]
    phase: float
    frequency: float
    factors: Values
    channels: tuple[ChannelMargins, ...]
    at: Place
    stable: bool
    robot: str
    dt: float
    delay: float
    samples: int = 1

    def __str__(self) -> str:
        where = self.at
        time = f"sampled at {self.dt:g} s" if self.dt else "continuous"
        if self.samples > 1:
            time += f", period of {self.samples} samples"
        if self.delay:
            time += f", delay {self.delay:g} s"
        if not self.stable:
            return folded([f"{self.robot}: the loop is unstable ({time}); no margins"])
        together = (
            f"{self.robot}: changes of all {where} at once, {time}: disk margin "
            f"{self.disk:.3g} at {self.frequency:.3g} rad/s, gain {self.gain[0]:.3g} to "
            f"{self.gain[1]:.3g}, phase {self.phase:.3g} deg"
        )
        if self.disk_reached > self.disk * (1.0 + 1e-3):
            together += f"; a change of {self.disk_reached:.3g} makes the loop unstable"
        if self.disk < FRAGILE:
            together += "; a small delay or model error makes the loop unstable"
        parts = [together]
        if self.samples > 1:
            parts.append(
                "a periodic law acts at several frequencies at once, so no channel has a phase "
                "margin; use its delay and disk margins"
            )
        head = [where[:-1], "gain", "phase [deg]", "delay [s]", "disk", "at [rad/s]"]
        rows = [
            [
                each.name,
                f"{each.gain[0]:.3g} to {each.gain[1]:.3g}",
                "-" if math.isnan(each.phase) else f"{each.phase:.3g}",
                f"{each.delay:.3g}",
                f"{each.disk:.3g}",
                f"{each.disk_frequency:.3g}",
            ]
            for each in self.channels
        ]
        return f"{folded(parts)}\n\n{grid(cut([head, *rows]))}"
