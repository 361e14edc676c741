"""Loops of uncertain robots with sampled laws: the plant of each robot is sampled exactly."""

from __future__ import annotations

from itertools import compress
from typing import NamedTuple

import numpy as np

from fflin.base.errors import InputError
from fflin.base.validation import Array, Mask
from fflin.control.delayed import law_with_memory
from fflin.control.gain import Gain, regulated_states
from fflin.control.margins import with_sensors
from fflin.control.optimal.disk import Loop, as_continuous, largest_scaled_gain
from fflin.control.optimal.largest_gain import ACCURACY, gain_crossings, largest_gain
from fflin.control.optimal.periodic_loops import (
    Harmonics,
    PeriodicLoop,
    lifted,
    monodromy,
)
from fflin.control.policy import Policy, System, loop_matrix
from fflin.dynamics.delays import HeldSystem
from fflin.uncertainty.lft import LFT

# Number of frequencies at which the quick estimates of gains are computed.
_FREQUENCIES = 6

# Entries of a law below this fraction of the largest entry of their matrix are rounding errors.
_ROUNDING = 1e-9

# Kinds of gains: (S - T)/2 at the inputs, and from the inputs to the outputs.
DISK, OUTPUTS = "disk", "outputs"


class SampledLaw(NamedTuple):
    """Sampled linear law, with the delays of its inputs and the states that it regulates.

    The law has one system for each sample of its period; laws that are not periodic have one.
    """

    systems: tuple[System, ...]
    delays: Array  # (nu,) [s]
    regulated: tuple[str, ...]
    outputs: bool  # whether the law measures outputs and not states

    @property
    def system(self) -> System:
        """The law at the first sample, which has the signals and the sample time of all."""
        return self.systems[0]

    @property
    def used(self) -> Mask:
        """Which of the measured signals (ny,) the law uses."""
        used: Mask = np.any(
            [x.B.any(axis=0) | x.D.any(axis=0) for x in self.systems], axis=0
        )
        return used


def sampled_law(gain: object) -> SampledLaw | None:
    """Return the law of a sampled gain or policy, or None if it is continuous."""
    if isinstance(gain, Gain):
        if not gain.dt:
            return None
        names = gain.state_names, gain.input_names
        system = law_with_memory(gain.K, gain.A, gain.B, gain.dt, *names)
        if gain.integrals:
            system = gain.integral_law()
        system, regulated = acting_part(system, regulated_states(gain))
        return SampledLaw((system,), gain.delay, regulated, False)
    if not isinstance(gain, Policy):
        return None
    law = gain.linear_law()
    laws = [law] if law is not None else gain.laws_of_period()
    if not laws or not laws[0].dt:
        return None
    delays = gain.input_delays
    late = np.array([delays.get(name, 0.0) for name in laws[0].outputs])
    regulated = gain.fed_back
    if not gain.senses_outputs:
        part, regulated = acting_part(laws[0], regulated)
        return SampledLaw((part,), late, regulated, False)
    if gain.model is not None:
        laws = with_sensors(laws, gain.model)
    return SampledLaw(tuple(laws), late, regulated, True)


def acting_part(
    law: System, regulated: tuple[str, ...]
) -> tuple[System, tuple[str, ...]]:
    """Return a law of states without its memory that does not act on the commands.

    The memory of a model with lags also contains the values of lagging sensors, which no command of
    a state feedback depends on. The second result are the names in `regulated` without the states
    that only this memory measures.
    """
    A, B, C, D, *_ = law
    largest_gain = max(np.abs(C).max(initial=0.0), np.abs(D).max(initial=0.0))
    kept: Mask = np.abs(C).max(axis=0, initial=0.0) > _ROUNDING * largest_gain
    # Keep also the states on which kept states depend.
    depends = np.abs(A) > _ROUNDING * np.abs(A).max(initial=0.0)
    while True:
        added = depends[kept].any(axis=0) & ~kept
        if not added.any():
            break
        kept |= added
    part = law._replace(A=A[np.ix_(kept, kept)], B=B[kept], C=C[:, kept])
    through = np.any(D, axis=0)
    measured = np.any(B, axis=0) | through
    used = np.any(part.B, axis=0) | through
    idle = set(compress(law.inputs, measured & ~used))
    return part, tuple(name for name in regulated if name not in idle)


class SampledLoops:
    """Closed loops of a sampled law and the robots of an LFT; each row of deltas gives one loop."""

    def __init__(self, lft: LFT, law: SampledLaw) -> None:
        self.lft = lft
        self._laws = law.systems
        self._delays = law.delays
        self._dt = law.system.dt or 0.0
        self._kept: dict[bytes, list[tuple[Array, Array, Array, Array]]] = {}
        self._measured = measured_signals(lft, law)
        # Scaling of the inputs for DISK: the best scaling of the loop at the middle of the ranges.
        # With it, few loops seem to be worse than they are with their own best scaling.
        self._scale: Array = np.ones(len(law.system.outputs))
        middle = np.zeros(len(lft.repeats))
        if self._undamped(middle) < 0.0:
            self._scale = self._best_scale(middle)
        # Frequencies at which earlier loops had their largest gains, by kind.
        self._peaks: dict[str, list[float]] = {}

    def _best_scale(self, row: Array) -> Array:
        """Return the best scaling (nu,) of the inputs for DISK of a stable loop."""
        loop = self.loop(row, DISK)
        assert loop is not None
        return largest_scaled_gain(loop)[2]

    def _closed(self, row: Array) -> list[tuple[Array, Array, Array, Array]]:
        """Return F, G, and the matrices to commands and outputs, for each sample of a period."""
        key = row.tobytes()
        if key not in self._kept:
            A, B, *_ = self.lft.at(row)
            plant, inputs = HeldSystem(A, B, self._dt, self._delays).sampled()
            self._kept[key] = [self._with(law, plant, inputs) for law in self._laws]
        return self._kept[key]

    def _with(
        self, law: System, plant: Array, inputs: Array
    ) -> tuple[Array, Array, Array, Array]:
        """Return the matrices of `_closed` for one law and a sampled plant."""
        past = len(plant) - len(self.lft.A)
        measured = np.hstack((self._measured, np.zeros((len(self._measured), past))))
        seen = np.hstack((self.lft.C2, np.zeros((len(self.lft.C2), past))))
        through = np.zeros((len(measured), inputs.shape[1]))
        F = loop_matrix(law, System(plant, inputs, measured, through))
        G = np.vstack((inputs, np.zeros((len(law.A), inputs.shape[1]))))
        command = np.hstack((law.D @ measured, law.C))
        outputs = np.hstack((seen, np.zeros((len(seen), len(law.A)))))
        return F, G, command, outputs

    def undamped(self, rows: Array) -> Array:
        """Return minus the least damping ratio of each loop (N,); >= 0 means an unstable loop."""
        return np.array([self._undamped(row) for row in rows])

    def _transition(self, row: Array) -> Array:
        """Return the transition matrix of a loop over one period."""
        return self._closed(row)[0][0]

    def _undamped(self, row: Array) -> float:
        # Negative real poles have complex rates, so the logarithm is complex.
        poles = np.linalg.eigvals(self._transition(row)).astype(complex)
        # A pole at z = 0 has no rate. It is the pole of a delay, and as damped as possible.
        rates = np.log(poles[np.abs(poles) > np.finfo(float).tiny])
        ratios = rates.real / np.maximum(np.abs(rates), 1e-300)
        return float(ratios.max(initial=-1.0))

    def loop(self, row: Array, kind: str) -> Loop | None:
        """Return the loop of one kind of gain as a continuous loop, or None if it is unstable."""
        if self._undamped(row) >= 0.0:
            return None
        F, G, command, outputs = self._closed(row)[0]
        H, J = outputs, np.zeros((len(outputs), G.shape[1]))
        if kind == DISK:
            H, J = command, 0.5 * np.eye(G.shape[1])
        loop = as_continuous(F, G, H, J, self._dt)
        return loop.scaled(self._scale) if kind == DISK else loop

    def exact(self, row: Array, kind: str) -> float:
        """Return the largest gain of a loop, for DISK with the best scaling of the inputs."""
        loop = self.loop(row, kind)
        if loop is None:
            return np.inf
        if kind == DISK:
            value, w, _ = largest_scaled_gain(loop)
        else:
            value, w = largest_gain(*loop)
        self._peaks.setdefault(kind, []).append(min(w, 1e300))
        return float(value)

    def quick(self, rows: Array, kind: str) -> Array:
        """Return the largest gain (N,) of loops at frequencies where others had their largest."""
        frequencies = [0.0, *self._peaks.get(kind, [])[-_FREQUENCIES:]]
        values = []
        for row in rows:
            loop = self.loop(row, kind)
            if loop is None:
                values.append(np.inf)
                continue
            gains = [np.linalg.norm(loop.at(w), 2) for w in frequencies]
            values.append(float(max(gains)))
        return np.array(values)

    def above(self, rows: Array, bound: float, kind: str) -> Mask:
        """Return which loops (N,) have a gain above a bound.

        For DISK, the gain without the best scaling may be above the bound, although the gain with
        it is not.
        """
        return np.array([self._is_above(row, bound, kind) for row in rows], bool)

    def _is_above(self, row: Array, bound: float, kind: str) -> bool:
        loop = self.loop(row, kind)
        if loop is None:
            return True
        limit = bound * (1.0 + ACCURACY)
        if np.linalg.norm(loop.J, 2) >= limit:
            return True
        _, crossed = gain_crossings(*loop, limit)
        return bool(crossed.any())


class PeriodicLoops(SampledLoops):
    """Closed loops of a law whose matrices repeat after N > 1 samples.

    Gains are computed for the system whose sample is one period, which has the signals of N
    samples.
    """

    def _best_scale(self, row: Array) -> Array:
        """Return the scaling (nu,) of the inputs: the mean of the best ones of all harmonics."""
        _, _, d = Harmonics(self._periodic(row, DISK)).peak()
        logarithms = np.log(d).reshape(len(self._laws), -1)
        scale: Array = np.exp(logarithms.mean(axis=0))
        return scale

    def _transition(self, row: Array) -> Array:
        """Return the transition matrix of a loop over one period."""
        return monodromy(np.array([F for F, *_ in self._closed(row)]))

    def _periodic(self, row: Array, kind: str) -> PeriodicLoop:
        """Return the loop of one kind of gain, for each sample of the period."""
        F, G, command, outputs = map(np.array, zip(*self._closed(row), strict=True))
        nu = G.shape[2]
        if kind == DISK:
            half = np.array([0.5 * np.eye(nu)] * len(F))
            return PeriodicLoop(F, G, command, half)
        return PeriodicLoop(F, G, outputs, np.zeros((len(F), outputs.shape[1], nu)))

    def loop(self, row: Array, kind: str) -> Loop | None:
        """Return the loop of one kind of gain over a period, or None if it is unstable.

        For DISK, the scaling of an input is the same at all samples.
        """
        if self._undamped(row) >= 0.0:
            return None
        matrices = lifted(self._periodic(row, kind))
        loop = as_continuous(*matrices, len(self._laws) * self._dt)
        if kind != DISK:
            return loop
        return loop.scaled(np.tile(self._scale, len(self._laws)))

    def exact(self, row: Array, kind: str) -> float:
        """Return the largest gain of a loop, for DISK with the best scaling of all harmonics."""
        if kind != DISK or self._undamped(row) >= 0.0:
            return super().exact(row, kind)
        value, angle, _ = Harmonics(self._periodic(row, kind)).peak()
        # The frequency of the system whose sample is one period, see `as_continuous`.
        w = np.tan(0.5 * len(self._laws) * angle)
        self._peaks.setdefault(kind, []).append(min(abs(float(w)), 1e300))
        return value


def measured_signals(lft: LFT, law: SampledLaw) -> Array:
    """Return the matrix (ny, nx) from the states of an LFT to the signals that a law measures."""
    system = law.system
    names = lft.output_names if law.outputs else lft.state_names
    used = law.used
    needed = [name for name, use in zip(system.inputs, used, strict=True) if use]
    missing = [name for name in needed if name not in names]
    if missing or system.outputs != lft.input_names:
        raise InputError(
            "the law and the robot have different inputs and outputs; give the law of this "
            "robot"
        )
    if not law.outputs:
        matrix = np.zeros((len(system.inputs), len(names)))
        for name in needed:
            matrix[system.inputs.index(name), names.index(name)] = 1.0
        return matrix
    matrix = np.zeros((len(system.inputs), len(lft.A)))
    for index in np.flatnonzero(used):
        at = names.index(system.inputs[index])
        if lft.D21[at].any() or lft.D22[at].any():
            raise InputError(
                "the law measures outputs that depend on inputs or on uncertain parameters, such "
                "as accelerations; give a law of outputs that depend on states only"
            )
        matrix[index] = lft.C2[at]
    return matrix
