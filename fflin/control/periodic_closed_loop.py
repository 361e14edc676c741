"""Loops of a periodic law and a model, such as laws of sensors with different sample times."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from fflin.base.errors import InputError
from fflin.base.validation import Array, Values
from fflin.control.closed_loop import ClosedLoop
from fflin.control.loop_margins import ChannelMargins, Margins
from fflin.control.optimal.disk import Peak, disk_gain, disk_margin, disk_phase
from fflin.control.optimal.periodic_loops import (
    ChannelHarmonics,
    Harmonics,
    PeriodicLoop,
    difference_with_delay,
    monodromy,
)
from fflin.control.policy import System

# A loop counts as stable if 1 - |z| of each pole z of a period exceeds this.
_ROUNDING = 1e-9

# Stability is tested at this many parts of each of the first two samples of delay.
_FRACTIONS = 10


class PeriodicClosedLoop(ClosedLoop):
    """Closed loop of a model and a law whose matrices repeat after N > 1 samples.

    The perturbations of the disk margin are stable systems that do not vary with time. Their
    responses at the N harmonics of an oscillation are independent of each other.
    """

    def periodic(self, plant: System) -> PeriodicLoop:
        """Return the matrices of `closed` for each sample of the period."""
        loops = [self.closed_with(law, plant) for law in self.laws]
        return PeriodicLoop(
            *(np.array(matrices) for matrices in zip(*loops, strict=True))
        )

    def _nominal(self) -> PeriodicLoop:
        loop = self.periodic(self.with_delays(self.delays))
        if not all(np.isfinite(matrices).all() for matrices in loop):
            raise InputError(
                "the response of the loop overflows; give smaller gains, a shorter sample time or "
                "a shorter delay"
            )
        return loop

    @property
    def states(self) -> int:
        """Number of states of the loop."""
        return len(self._nominal().F[0])

    @property
    def harmonics(self) -> int:
        """Number of harmonics of all channels."""
        return len(self.laws) * len(self.channels)

    def disk_margin(self) -> float:
        """Return the disk margin for changes of all channels at once."""
        loop = self._nominal()
        if not _is_stable(loop):
            return 0.0
        return disk_margin(Harmonics(loop).peak()[0])

    def no_margins(self) -> Margins:
        """Return the margins of an unstable loop."""
        factors = np.ones((len(self.laws), len(self.channels)), complex)
        return replace(super().no_margins(), factors=factors, samples=len(self.laws))

    def margins(self) -> Margins:
        """Return the margins of all channels."""
        loop = self._nominal()
        if not _is_stable(loop):
            return self.no_margins()
        harmonics = Harmonics(loop)
        peak = harmonics.structured_peak()
        disk = disk_margin(peak.bound)
        frequency, factors = self._oscillation_of(harmonics, peak)
        channels = [
            self._channel_of(loop, harmonics, index)
            for index in range(len(self.channels))
        ]
        return Margins(
            disk=disk,
            disk_reached=disk_margin(peak.reached),
            gain=disk_gain(disk),
            phase=disk_phase(disk),
            frequency=frequency,
            factors=factors,
            channels=tuple(channels),
            stable=True,
            at=self.at,
            robot=self.lin.robot,
            dt=self.dt,
            delay=self.longest_delay,
            samples=len(self.laws),
        )

    def _oscillation_of(self, harmonics: Harmonics, peak: Peak) -> tuple[float, Values]:
        """Return the frequency [rad/s] of the strongest harmonic, and the factors from it on."""
        change = peak.perturbation.reshape(len(self.laws), -1)
        strongest = harmonics.strongest(peak.frequency, peak.perturbation)
        change = np.roll(change, -strongest, axis=0)
        frequency = self._frequency_of(peak.frequency, strongest)
        if frequency < 0.0:
            # A real loop also oscillates at the negative frequencies, with conjugate factors.
            change = np.roll(change.conj()[::-1], 1, axis=0)
        with np.errstate(divide="ignore", invalid="ignore"):
            factors = (1.0 + 0.5 * change) / (1.0 - 0.5 * change)
        return abs(frequency), factors

    def _frequency_of(self, angle: float, harmonic: int) -> float:
        """Return the frequency [rad/s], at most pi/dt, of a harmonic; may be negative."""
        whole = angle + 2.0 * math.pi * harmonic / len(self.laws)
        return math.remainder(whole, 2.0 * math.pi) / self.dt

    def _channel_of(
        self, loop: PeriodicLoop, harmonics: Harmonics, index: int
    ) -> ChannelMargins:
        """Return the margins of one channel."""
        one = loop.channel(index)
        alone = Harmonics(one)
        peak, angle, _ = alone.peak()
        channel = ChannelHarmonics(harmonics, index)
        low, high = (_limit(one, ends) for ends in channel.gain_intervals())
        return ChannelMargins(
            name=self.names[index],
            gain=(low, high),
            gain_frequencies=(
                self._oscillation(one, low),
                self._oscillation(one, high),
            ),
            phase=math.nan,
            phase_frequency=math.nan,
            delay=self._delay_of(index, channel),
            disk=disk_margin(peak),
            disk_frequency=angle / self.dt,
        )

    def _oscillation(self, channel: PeriodicLoop, factor: float) -> float:
        """Return the frequency [rad/s] at a factor on the limit, up to multiples of the period."""
        if factor == 0.0 or math.isinf(factor):
            return math.nan
        poles = np.linalg.eigvals(monodromy(channel.with_factor(factor).F))
        pole = poles[np.abs(poles).argmax()]
        return float(abs(np.angle(pole))) / (len(self.laws) * self.dt)

    def _delay_of(self, index: int, channel: ChannelHarmonics) -> float:
        """Return the least delay [s] of a channel at which the loop becomes unstable.

        Stability is tested in parts of the first two samples, because a part of a sample can make a
        loop unstable that whole samples leave stable, and then at whole samples.
        """
        if not self.is_continuous_plant:
            interval = channel.delay_interval()
            return math.inf if interval is None else (interval[0] + 1) * self.dt
        unstable = self._unstable_in_two_samples(index)
        if unstable is not None:
            return unstable
        interval = channel.delay_interval()
        if interval is None:
            return math.inf
        return self._refined_delay(index, *interval)

    def _delayed_loop(self, index: int, extra: float) -> PeriodicLoop:
        """Return the loop with an additional delay [s] in one channel."""
        return self.periodic(self.delayed_plant(index, extra, self.delays))

    def _unstable_in_two_samples(self, index: int) -> float | None:
        """Return the delay [s] within two samples at which the loop becomes unstable, or None."""
        from scipy.optimize import brentq

        def growth(extra: float) -> float:
            return self._delayed_loop(index, extra).radius - 1.0

        before = 0.0
        for part in range(1, 2 * _FRACTIONS + 1):
            extra = part * self.dt / _FRACTIONS
            if growth(extra) >= 0.0:
                return float(brentq(growth, before, extra, xtol=1e-9 * self.dt))
            before = extra
        return None

    def _refined_delay(self, index: int, samples: int, angle: float) -> float:
        """Return the delay [s] at which the loop oscillates, between two whole samples.

        The part of a sample changes the plant, and the whole samples shift the phase. If no
        oscillation is found, the whole samples are returned.
        """
        from scipy.optimize import root

        h = self.dt

        def difference(unknown: Array) -> tuple[float, float]:
            rest = min(max(unknown[1], 0.0), 1.0) * h
            late = Harmonics(self._delayed_loop(index, rest))
            value = difference_with_delay(late, index, math.exp(unknown[0]), samples)
            return value.real, value.imag

        for rest in (0.5, 0.1, 0.9):
            start = np.array([math.log(angle), rest])
            found = root(difference, start, tol=1e-12)
            if found.success and 0.0 <= found.x[1] <= 1.0:
                return (samples + float(found.x[1])) * h
        return samples * h


def _is_stable(loop: PeriodicLoop) -> bool:
    return loop.radius < 1.0 - _ROUNDING


def _limit(channel: PeriodicLoop, ends: tuple[float, float]) -> float:
    """Return the factor between two others at which the loop of a channel becomes unstable."""
    from scipy.optimize import brentq

    low, high = ends
    if low == high:
        return low

    def growth(factor: float) -> float:
        return channel.with_factor(factor).radius - 1.0

    if growth(low) * growth(high) > 0.0:
        return high if low >= 1.0 else low
    return float(brentq(growth, low, high, rtol=1e-12))
