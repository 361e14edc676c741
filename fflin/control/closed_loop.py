"""Loops of a linear law and a model, with factors in its channels."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property, partial

import numpy as np

from fflin.analysis.reduction import regulated_part
from fflin.base.errors import InputError, StabilizabilityError
from fflin.base.validation import Array, Indices, Mask
from fflin.control.loop_margins import ChannelMargins, Margins, Place
from fflin.control.optimal.channel_limits import (
    Crossing,
    Grid,
    channel_limits,
    log_gain,
    loop_gain,
)
from fflin.control.optimal.disk import (
    Loop,
    as_continuous,
    disk_gain,
    disk_margin,
    disk_phase,
    largest_scaled_gain,
    largest_structured_gain,
)
from fflin.control.optimal.largest_gain import largest_gain
from fflin.control.policy import System, loop_matrix
from fflin.dynamics.delays import HeldSystem, split
from fflin.linear.model import LinearModel

# Order of the Pade approximation of a delay in continuous time. Up to an angle of 6 rad its phase
# error is below 1e-9 rad.
_PADE = 10

# A pole counts as stable if its decay rate, or 1 - |z|, exceeds this fraction of the largest pole
# magnitude.
_ROUNDING = 1e-9

# Stability of a sampled loop is tested at _FRACTIONS parts of each of the first two samples of
# delay, and then at each sample up to _LONGEST. A delay may have at most _MOST_SAMPLES samples.
_FRACTIONS = 10
_LONGEST = 40
_MOST_SAMPLES = 500

# Number of frequencies of the grid on which a continuous loop with a delay is examined.
_GRID = 600


class ClosedLoop:
    """Loop of a law and a model, with factors at the inputs or at the measured signals."""

    def __init__(
        self,
        laws: Sequence[System],
        lin: LinearModel,
        delay: float,
        sample: float | None,
        at: Place,
    ) -> None:
        self.laws = laws
        self.law = law = laws[0]
        self.lin = lin
        self.at = at
        self.delay = delay
        self.dt = _sampling_time(law, lin, sample)
        self._signals_used: Mask = np.any(
            [one.D.any(axis=0) | one.B.any(axis=0) for one in laws], axis=0
        )
        self.plant = self._continuous_or_sampled(lin)
        names, acting = law.inputs, self._signals_used
        if at == "inputs":
            names = lin.input_names
            acting = np.any(
                [one.D.any(axis=1) | one.C.any(axis=1) for one in laws], axis=0
            )
        self.channels = np.flatnonzero(acting)
        self.names = [names[index] for index in self.channels]
        if not self.names:
            raise InputError("the law has no gain, so its loop has no margins")

    def _continuous_or_sampled(self, lin: LinearModel) -> System:
        """Return the plant from all inputs to the measured signals, without a delay.

        The plant is continuous if its model is known in continuous time. It contains only states
        that inputs reach and that have an effect on a measured signal.
        """
        source = lin.generator if self.dt else lin
        model = lin if source is None else source
        measured = self.law.inputs
        if set(measured) <= set(lin.output_names):
            rows = [lin.output_names.index(name) for name in measured]
            C, D = model.C[rows], model.D[rows]
        else:
            rows = [lin.state_names.index(name) for name in measured]
            C = np.eye(len(model.A))[rows]
            D = np.zeros((len(rows), model.B.shape[1]))
        kept = self.kept_states(model, C[self._signals_used])
        return System(model.A[np.ix_(kept, kept)], model.B[kept], C[:, kept], D)

    def kept_states(self, model: LinearModel, C: Array) -> list[int]:
        """Return the indices of the states of the plant; C has the rows of the used signals."""
        judged = judged_states(model, C)
        A, B, C = model.A[np.ix_(judged, judged)], model.B[judged], C[:, judged]
        return [int(judged[index]) for index in connected_states(A, B, C)]

    @property
    def is_continuous_plant(self) -> bool:
        """Whether `plant` is in continuous time."""
        return not self.dt or self.lin.generator is not None

    @cached_property
    def _held_plant(self) -> HeldSystem:
        """The continuous plant with held inputs, without a delay."""
        A, B = self.plant.A, self.plant.B
        return HeldSystem(A, B, self.dt, np.zeros(B.shape[1]))

    def with_delays(self, delays: Array) -> System:
        """Return the plant in the time of the loop, whose inputs arrive after `delays` (nu,)."""
        if not self.dt:
            return _delayed(self.plant, delays)
        if self.is_continuous_plant:
            self._require_short(delays)
            held = self._held_plant.delayed(delays)
            C, D = self.plant.C, self.plant.D
            return System(*held.sampled(), *held.outputs(C, D))
        if delays.any():
            raise InputError(
                "lin is sampled and its continuous model is unknown, so a delay cannot be added; "
                "give the continuous model"
            )
        return self.plant

    def _require_short(self, delays: Array) -> None:
        """Raise `InputError` if the delayed commands need too many states."""
        longest = float(delays.max(initial=0.0))
        if longest > _MOST_SAMPLES * self.dt:
            raise InputError(
                f"delay is {longest:g} s, more than {_MOST_SAMPLES} samples of {self.dt:g} s; give "
                "a shorter delay or a longer sample time"
            )

    def closed(self, plant: System) -> tuple[Array, Array, Array, Array]:
        """Return F, G, H and J from the changes of all channels to (S - T)/2."""
        return self.closed_with(self.law, plant)

    def closed_with(
        self, law: System, plant: System
    ) -> tuple[Array, Array, Array, Array]:
        """Return F, G, H and J of `closed` for one of the laws."""
        _, B, C, D, *_ = plant
        F = loop_matrix(law, plant)
        if self.at == "inputs":
            G = np.vstack((B, law.B @ D))
            H = np.hstack((law.D @ C, law.C))
            J = law.D @ D
        else:
            G = np.vstack((B @ law.D, law.B + law.B @ D @ law.D))
            H = np.hstack((C + D @ law.D @ C, D @ law.C))
            J = D @ law.D
        kept = self.channels
        half = 0.5 * np.eye(len(kept))
        return F, G[:, kept], H[kept], J[np.ix_(kept, kept)] + half

    @property
    def delays(self) -> Array:
        """Delays (nu,) [s] of the inputs."""
        delays = np.full(self.plant.B.shape[1], self.delay)
        if self.is_continuous_plant:
            delays += self.lin.delay
        return delays

    @property
    def longest_delay(self) -> float:
        """Largest delay [s] of an input, also if the matrices of the model contain it."""
        return self.delay + float(self.lin.delay.max(initial=0.0))

    def loop(self) -> tuple[Array, Array, Array, Array]:
        """Return F, G, H and J of `closed`, with the delay."""
        loop = self.closed(self.with_delays(self.delays))
        _require_finite(*loop)
        return loop

    @property
    def states(self) -> int:
        """Number of states of the loop."""
        return len(self.loop()[0])

    @property
    def harmonics(self) -> int:
        """Number of harmonics of all channels at which a periodic loop responds; otherwise 0."""
        return 0

    def disk_margin(self) -> float:
        """Return the disk margin for changes of all channels at once."""
        loop = self.loop()
        if not self.is_stable(loop[0]):
            return 0.0
        largest, *_ = largest_scaled_gain(as_continuous(*loop, self.dt))
        return disk_margin(largest)

    def no_margins(self) -> Margins:
        """Return the margins of an unstable loop."""
        return Margins(
            disk=0.0,
            disk_reached=0.0,
            gain=(1.0, 1.0),
            phase=0.0,
            frequency=math.nan,
            factors=np.ones(len(self.channels), complex),
            channels=(),
            stable=False,
            at=self.at,
            robot=self.lin.robot,
            dt=self.dt,
            delay=self.longest_delay,
        )

    def margins(self) -> Margins:
        """Return the margins of all channels."""
        delays = self.delays
        loop = self.loop()
        if not self.is_stable(loop[0]):
            return self.no_margins()
        system = as_continuous(*loop, self.dt)
        count = len(self.channels)
        frequencies = self._grid()
        responses = np.array([np.diagonal(system.at(w)) for w in frequencies])
        responses = responses.reshape(len(frequencies), count)
        channels = tuple(
            self._channel(
                index,
                system.channel(index),
                delays,
                Grid(frequencies, responses[:, index]),
            )
            for index in range(count)
        )
        peak = largest_structured_gain(system)
        disk = disk_margin(peak.bound)
        reached = disk_margin(peak.reached)
        change = peak.perturbation
        with np.errstate(divide="ignore", invalid="ignore"):
            factors = (1.0 + 0.5 * change) / (1.0 - 0.5 * change)
        return Margins(
            disk=disk,
            disk_reached=reached,
            gain=disk_gain(disk),
            phase=disk_phase(disk),
            frequency=self._frequency(peak.frequency),
            factors=factors,
            channels=channels,
            stable=True,
            at=self.at,
            robot=self.lin.robot,
            dt=self.dt,
            delay=self.longest_delay,
        )

    def own_rates(self) -> Array:
        """Return the magnitudes [rad/s] of the poles of the continuous loop without a delay."""
        rates: Array = np.abs(np.linalg.eigvals(self.closed(self.plant)[0]))
        return rates

    def _grid(self) -> Array:
        """Return frequencies [rad/s] between which crossings of a continuous loop are sought.

        They are needed with a delay only: the fast poles of its approximation hide crossings from
        the eigenvalues.
        """
        if self.dt or not self.delay:
            return np.zeros(0)
        rates = self.own_rates()
        rates = rates[rates > 0.0]
        return np.geomspace(0.01 * rates.min(), 100.0 * rates.max(), _GRID)

    def is_stable(self, F: Array) -> bool:
        """Return whether the loop is stable, by more than rounding errors."""
        _require_finite(F)
        poles = np.linalg.eigvals(F)
        if self.dt:
            return bool(np.abs(poles).max(initial=0.0) < 1.0 - _ROUNDING)
        # The poles of the approximation of a short delay are fast, so they set no scale for the
        # others.
        largest = self.own_rates().max(initial=0.0)
        return bool(poles.real.max(initial=-np.inf) < -_ROUNDING * largest)

    def _frequency(self, w: float) -> float:
        """Return the frequency [rad/s] of a frequency of the transformed loop."""
        if not self.dt:
            return w
        return 2.0 * math.atan(w) / self.dt

    def _channel(
        self, index: int, loop: Loop, delays: Array, grid: Grid
    ) -> ChannelMargins:
        """Return the margins of one channel."""
        peak, w_disk = largest_gain(*loop)
        limits = channel_limits(loop, grid)
        phase, phase_frequency = 180.0, math.nan
        if limits.crossings:
            nearest = min(limits.crossings, key=lambda crossing: crossing.phase)
            phase = nearest.phase
            phase_frequency = self._frequency(nearest.frequency)
        low, high = limits.gain_frequencies
        return ChannelMargins(
            name=self.names[index],
            gain=limits.gain,
            gain_frequencies=(self._frequency(low), self._frequency(high)),
            phase=phase,
            phase_frequency=phase_frequency,
            delay=self._delay_margin(index, limits.crossings, delays),
            disk=disk_margin(peak),
            disk_frequency=self._frequency(w_disk),
        )

    def _delay_margin(
        self, index: int, crossings: tuple[Crossing, ...], delays: Array
    ) -> float:
        """Return the least delay [s] of a channel at which the loop becomes unstable.

        In continuous time, the least lag of a crossing gives it. In a sampled loop, a part of a
        sample also changes the gain.
        """
        estimates = [
            (crossing.lag / self._frequency(crossing.frequency), crossing.frequency)
            for crossing in crossings
        ]
        estimate, w = min(estimates, default=(math.inf, 0.0))
        if not (self.dt and self.is_continuous_plant):
            return estimate
        unstable = self._first_unstable(index, estimate, delays)
        if unstable is not None:
            return unstable
        if math.isinf(estimate):
            return math.inf
        return self._refined(index, estimate, w, delays)

    def _first_unstable(
        self, index: int, estimate: float, delays: Array
    ) -> float | None:
        """Return the delay [s] at which the exact loop becomes unstable, or None if it is long.

        Stability is tested in fractions of the first two samples, because a part of a sample can
        make a loop unstable that whole samples leave stable, and then at each sample.
        """
        from scipy.optimize import brentq

        h = self.dt

        def growth(extra: float) -> float:
            F = self.closed(self.delayed_plant(index, extra, delays))[0]
            return float(np.abs(np.linalg.eigvals(F)).max()) - 1.0

        last = _LONGEST
        if estimate < _LONGEST * h:
            last = math.ceil(estimate / h) + 1
        fractions = np.arange(1, 2 * _FRACTIONS + 1) / _FRACTIONS
        times = h * np.concatenate((fractions, np.arange(3, last + 1)))
        before = 0.0
        for time in times.tolist():
            if growth(time) >= 0.0:
                return float(brentq(growth, before, time, xtol=1e-9 * h))
            before = time
        return None

    def _refined(self, index: int, estimate: float, w: float, delays: Array) -> float:
        """Return the delay [s] near a long estimate at which a sampled loop oscillates.

        A delay of whole samples changes only the phase of the loop gain. The search therefore finds
        the rest of the delay for which the phase lag of the loop equals the phase lag of whole
        samples. If there is none within a sample of the estimate, the estimate is returned.
        """
        from scipy.optimize import newton

        h = self.dt
        samples = max(math.floor(estimate / h) - 1, 0)

        def excess(rest: float) -> float:
            rest = min(max(rest, 0.0), 3.0 * h)
            loop = self._delayed_channel(index, rest, delays)
            level = partial(log_gain, loop)
            at = float(newton(level, w, x1=w * (1.0 + 1e-4), rtol=1e-12))
            frequency = self._frequency(at)
            lag = float(np.angle(-loop_gain(loop, at)))
            turn = 2.0 * math.pi
            expected = samples * h * frequency
            lag += turn * round((expected - lag) / turn)
            return lag / frequency - samples * h

        rest = estimate - samples * h
        try:
            found = newton(excess, rest, x1=rest + 1e-3 * h, tol=1e-10 * h)
        except (RuntimeError, ValueError, np.linalg.LinAlgError):
            return estimate
        if not abs(found - rest) <= h:
            return estimate
        return samples * h + float(found)

    def _delayed_channel(self, index: int, extra: float, delays: Array) -> Loop:
        """Return the loop of a channel with an additional delay [s] in it."""
        plant = self.delayed_plant(index, extra, delays)
        return as_continuous(*self.closed(plant), self.dt).channel(index)

    def delayed_plant(self, index: int, extra: float, delays: Array) -> System:
        """Return the sampled plant with an additional delay [s] in one channel."""
        channel = self.channels[index]
        if self.at == "inputs":
            more = delays.copy()
            more[channel] += extra
            return self.with_delays(more)
        # The output is measured within a sample, and then delayed by whole samples.
        C, D = self.plant.C, self.plant.D
        held = self._held_plant.delayed(delays)
        Ad, Bd = held.sampled()
        Cd, Dd = held.outputs(C, D)
        samples, rest = split(extra, self.dt)
        if samples:
            within = held.outputs(C[[channel]], D[[channel]], self.dt - rest)
            size = len(Ad)
            chain = np.eye(samples, k=-1)
            Ad = np.block(
                [[Ad, np.zeros((size, samples))], [np.zeros((samples, size)), chain]]
            )
            Ad[size, :size] = within[0][0]
            Bd = np.vstack((Bd, np.zeros((samples, Bd.shape[1]))))
            Bd[size] = within[1][0]
            Cd = np.hstack((Cd, np.zeros((len(Cd), samples))))
            Cd[channel] = 0.0
            Cd[channel, -1] = 1.0
            Dd[channel] = 0.0
        return System(Ad, Bd, Cd, Dd)


def _sampling_time(law: System, lin: LinearModel, sample: float | None) -> float:
    """Return the sample time [s] of the loop; 0 in continuous time."""
    times = {time for time in (law.dt, lin.dt, sample or 0.0) if time}
    if not times:
        return 0.0
    longest, least = max(times), min(times)
    if longest - least > 1e-9 * longest:
        shown = " and ".join(f"{time:g} s" for time in sorted(times))
        raise InputError(
            f"the law, the model and sample have different sample times, {shown}; give the "
            "continuous model, and a sample time only for a continuous law"
        )
    return longest


def judged_states(model: LinearModel, C: Array) -> Indices:
    """Return the indices of the states that decide about the stability of a loop.

    A law that measures only ``C x`` leaves the states outside of the regulated part alone if C has
    no entry for them. Examples are the position in orbit, the angles of wheels, and a momentum that
    turns with the orbit. They would be neutral modes of the loop.
    """
    names = model.state_names
    for wheel_speeds in (False, True):
        try:
            part = regulated_part(model, wheel_speeds)
        except StabilizabilityError:
            continue
        kept = np.isin(names, part.state_names)
        if not C[:, ~kept].any():
            return np.flatnonzero(kept)
    return np.arange(len(names))


def connected_states(A: Array, B: Array, C: Array) -> list[int]:
    """Return the indices of the states that an input reaches and that affect an output."""
    reached = B.any(axis=1)
    seen = C.any(axis=0)
    for _ in A:
        reached = reached | A[:, reached].any(axis=1)
        seen = seen | A[seen].any(axis=0)
    return np.flatnonzero(reached & seen).tolist()


def _require_finite(*matrices: Array) -> None:
    """Raise `InputError` if the matrices of a loop are not finite."""
    if not all(np.isfinite(matrix).all() for matrix in matrices):
        raise InputError(
            "the response of the loop overflows; give smaller gains, a shorter sample time or "
            "a shorter delay"
        )


def _delayed(plant: System, delays: Array) -> System:
    """Return a continuous plant with rational approximations of delays [s] at its inputs."""
    for index in np.flatnonzero(delays):
        for section in _pade(float(delays[index])):
            plant = _after_section(plant, int(index), section)
    return plant


def _pade(delay: float) -> list[System]:
    """Return the diagonal Pade approximation of a delay [s] as a chain of all-pass sections.

    The section of a complex pair of poles p has the transfer function
    (s^2 + 2 Re(p) s + |p|^2) / (s^2 - 2 Re(p) s + |p|^2).
    """
    order = np.arange(_PADE, -1, -1)
    sizes = [
        math.comb(_PADE, int(k)) * math.factorial(2 * _PADE - int(k)) for k in order
    ]
    poles = np.roots(np.array(sizes, float) / sizes[0]) / delay
    sections = []
    for pole in poles[poles.imag > 0.0]:
        size, sum_of_pair = float(np.abs(pole)), 2.0 * float(pole.real)
        sections.append(
            System(
                np.array([[0.0, size], [-size, sum_of_pair]]),
                np.array([[0.0], [size]]),
                np.array([[0.0, 2.0 * sum_of_pair / size]]),
                np.ones((1, 1)),
            )
        )
    return sections


def _after_section(plant: System, index: int, late: System) -> System:
    """Return a plant with a section before one of its inputs."""
    A, B, C, D, *_ = plant
    column = B[:, index : index + 1]
    through = D[:, index : index + 1]
    B, D = B.copy(), D.copy()
    B[:, index : index + 1] = column @ late.D
    D[:, index : index + 1] = through @ late.D
    added = np.zeros((len(late.A), B.shape[1]))
    added[:, index : index + 1] = late.B
    corner = np.zeros((len(late.A), len(A)))
    return System(
        np.block([[A, column @ late.C], [corner, late.A]]),
        np.vstack((B, added)),
        np.hstack((C, through @ late.C)),
        D,
    )
