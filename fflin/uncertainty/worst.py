"""Worst-case search over a set of robots, and ranges in which stability is guaranteed."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from heapq import heapify, heappop, heappush
from itertools import filterfalse, islice, pairwise, product
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np

from fflin.base import html
from fflin.base.errors import InputError
from fflin.base.names import LAG
from fflin.base.process import Progress, in_one_thread
from fflin.base.tables import folded
from fflin.base.validation import Array, Mask, shaped
from fflin.control.compensator import Compensator
from fflin.control.gain import Gain, gain_matrix, regulated_states
from fflin.control.lags import has_lag_states
from fflin.control.optimal.disk import Loop, largest_scaled_gain
from fflin.control.optimal.largest_gain import ACCURACY, gain_crossings, largest_gain
from fflin.control.policy import Policy
from fflin.dynamics.state import selection
from fflin.uncertainty import gain_bound
from fflin.uncertainty.lagging import with_lags_of_loop
from fflin.uncertainty.lft import LFT
from fflin.uncertainty.sampled_loops import (
    DISK,
    OUTPUTS,
    PeriodicLoops,
    SampledLaw,
    SampledLoops,
    acting_part,
    measured_signals,
    sampled_law,
)

if TYPE_CHECKING:
    from fflin.uncertainty.uncertain import Uncertain

_CORNERS = 256
# Largest number of steps of a local search, and trial lengths of a step relative to half a range.
# Steps are cut off at the ends of the ranges, so the length 1e9 leads to a corner of the set.
_STEPS = 25
_LENGTHS = np.array((1e9, 1.0, 0.3, 0.1, 0.03, 0.01, 1e-3))
# In each step, the exact criterion is computed for the _HELD trial points with the largest quick
# criterion. The quick criterion of a gain uses at most _FREQUENCIES frequencies. Gradients are
# finite differences with the step _DIFFERENCE.
_HELD, _FREQUENCIES, _DIFFERENCE = 3, 6, 1e-6

# Entries of an LFT below this fraction of the largest entry of their matrix are rounding errors.
_ROUNDING = 1e-9

# Function that returns a criterion for each row of deltas; larger values are worse.
Figure: TypeAlias = Callable[[Array], Array]

# Scalings are searched only for models with at most this number of signals in z. The run time of
# slycot grows with the fifth power of the number of signals.
_SIGNALS = 24
# The search over frequency begins with a grid of _LOOK frequencies. The bound of an interval is
# computed at _INSIDE frequencies. A step of the search divides one interval, or calls slycot for
# it. The search takes at most _DIVISIONS steps.
_LOOK, _INSIDE, _DIVISIONS = 120, 5, 100
# Distances of further frequencies from a resonance, in widths of its peak.
_WIDTHS = (0.0, -1.0, 1.0)
# The search ends when the largest bound of an interval is at most this factor times the largest
# bound at a single frequency.
_NEAR = 1.01

Scaling: TypeAlias = tuple[Array, Array]  # d > 0 and g, (n,) each


class Figures(NamedTuple):
    """Functions for one criterion: quick estimate, exact value, and test against a bound."""

    quick: Figure
    exact: Figure
    above: Callable[[Array, float], Mask]


@dataclass(frozen=True)
class Found:
    """Worst value of one criterion over the set, and the parameters that attain it."""

    value: float
    parameters: Mapping[str, float]


@dataclass(frozen=True, repr=False)
class Worst(html.Reported):
    """Worst-case closed loops over a set of robots; print it for a report.

    Attributes
    ----------
    damping : Found
        Least damping ratio of a pole. The poles of a periodic law are computed over one period,
        with the smallest of their possible frequencies.
    margin : Found
        Least disk margin at the inputs; 0 if a loop is unstable. For policies and sampled gains, it
        has the best scaling of the inputs, as in `margins`. For a continuous `Gain`, the inputs are
        scaled by sqrt(R_ii), so that it is a lower bound of the margin of `Gain.margins`.
    gain : Found
        Largest gain over all frequencies from a disturbance at the inputs to the outputs. Outputs
        that depend on states which the gain does not regulate are excluded.
    unstable : int
        Number of unstable loops among the loops tried.
    tried, excluded : int
        Number of loops tried, and of draws and corners excluded because they are not physically
        realisable.
    safe : float
        Factor by which all ranges may be scaled about their middles with the loop still stable. A
        value of 1 or more covers the whole set. It follows from an upper bound of the structured
        singular value over intervals of frequency, evaluated at five frequencies in each. NaN for a
        sampled law, because the sampled model is not an LFT: the worst loops are then those that
        the search finds, without a guarantee.
    """

    damping: Found
    margin: Found
    gain: Found
    unstable: int
    tried: int
    excluded: int
    safe: float

    def __str__(self) -> str:
        lines = [
            f"{self.unstable} of {self.tried} loops tried are unstable; "
            f"{self.excluded} samples and corners were excluded, because they are not physically "
            "realisable"
        ]
        for criterion, case in (
            ("least damping ratio", self.damping),
            ("least disk margin", self.margin),
            ("largest gain from a disturbance at the inputs", self.gain),
        ):
            at = ", ".join(
                f"{name} {value:.4g}" for name, value in case.parameters.items()
            )
            lines.append(f"{criterion} {case.value:.4g} at {at}")
        if np.isnan(self.safe):
            lines.append(
                "stability in the whole set is not guaranteed, because the law is sampled: the "
                "worst loops are those that the search found"
            )
            return folded(lines)
        where = f"the central {100.0 * self.safe:.3g} % of each range"
        if self.safe >= 1.0:
            where = f"all ranges, and in ranges that are {self.safe:.3g} times as wide"
        return folded([*lines, f"guaranteed stable in {where}"])


@in_one_thread
def searched(
    model: Uncertain, lft: LFT, gain: object, samples: int, seed: int
) -> Worst:
    """Search for the worst closed loops; see `Uncertain.worst`."""
    lft = with_lags_of_loop(lft, model.robot, gain)
    sampled = sampled_law(gain)
    loops: Loops | SampledLoops
    if sampled is None:
        loops, criteria = _continuous_loops(lft, gain)
    else:
        loops, criteria = _sampled_loops(lft, sampled)
    size = len(lft.repeats)
    middle = np.zeros((1, size))
    if loops.undamped(middle)[0] >= 0.0:
        raise InputError(
            "the closed loop at the middle of the ranges is unstable; give a stabilising gain"
        )
    draws, excluded = model.draws(samples, seed=seed)
    if 2**size <= _CORNERS:
        corners = np.array(list(product((-1.0, 1.0), repeat=size)))
    else:
        corners = np.random.default_rng(seed).choice((-1.0, 1.0), (_CORNERS, size))
    physical = np.array([not model.refusal(corner) for corner in corners])
    # The random draws come last. So a search with more draws begins like one with fewer draws.
    tried = np.vstack((middle, corners[physical], draws))
    cases = []
    bar = Progress()
    undamped = Figures(
        loops.undamped, loops.undamped, lambda rows, b: loops.undamped(rows) > b
    )
    for figures in (undamped, *criteria()):
        value, delta = _largest(figures, tried, model.refusal)
        cases.append(Found(value, model.values(delta)))
        bar(len(cases), 4)
    unstable = loops.undamped(tried) >= 0.0
    safe = np.nan
    if isinstance(loops, Loops):
        first = float(np.abs(tried[unstable]).max(axis=1).min(initial=np.inf))
        safe = min(_safe(loops), first)
    bar.close()
    damping, margin, gained = cases
    return Worst(
        damping=replace(damping, value=-damping.value),
        margin=replace(margin, value=min(1.0 / margin.value, 2.0)),
        gain=gained,
        unstable=int(unstable.sum()),
        tried=len(tried),
        excluded=excluded + int((~physical).sum()),
        safe=safe,
    )


def _continuous_loops(
    lft: LFT, gain: object
) -> tuple[Loops, Callable[[], list[Figures]]]:
    """Return the loops of a continuous law, and a function that returns two criteria.

    They are the disk margin, and the gain from a disturbance at the inputs to the outputs.
    """
    nu = lft.B2.shape[1]
    lft, K, regulated = _around(lft, gain)
    kept = judged_states(lft, K, regulated)
    lft = part_of(lft, kept)
    K = K[:, kept]
    loops = Loops(lft, K)

    def criteria() -> list[Figures]:
        # The disk margin is computed from (S - T)/2. Each input of a gain is scaled by sqrt(R_ii),
        # as in control.gain. The inputs of a policy have the best scaling of the middle loop.
        scale: Array = np.ones(nu)
        if isinstance(gain, Gain):
            scale = np.sqrt(gain.R.diagonal())
        if isinstance(gain, Policy):
            middle = loops.at_inputs(np.zeros(len(lft.repeats)), nu)
            scale = largest_scaled_gain(middle)[2]
        # The inputs of the loop are the inputs of the robot, and then the rates of the states of a
        # controller, which cannot be disturbed. `Channel` goes from the scaled inputs to the scaled
        # (S - T)/2, or to the outputs of the robot.
        no_rates = np.zeros(len(K) - nu)
        half_identity = np.hstack((0.5 * np.eye(nu), np.zeros((nu, len(no_rates)))))
        factors = np.concatenate((1.0 / scale, no_rates))
        disk = Channel(-scale[:, None] * K[:nu], half_identity, factors)
        through = np.zeros((len(lft.C2), len(K)))
        to_outputs = Channel(lft.C2, through, np.concatenate((np.ones(nu), no_rates)))
        of_disk = loops.figures(disk)
        if isinstance(gain, Policy):
            # As in `margins`, the inputs of a policy have the best scaling of each loop. With
            # another scaling, the gain is at least as large, so `above` finds every worse loop.
            of_disk = of_disk._replace(exact=lambda row: loops.scaled(row, nu))
        return [of_disk, loops.figures(to_outputs)]

    return loops, criteria


def _sampled_loops(
    lft: LFT, law: SampledLaw
) -> tuple[SampledLoops, Callable[[], list[Figures]]]:
    """Return the loops of a sampled law, and a function that returns the criteria as above."""
    kept = judged_states(lft, measured_signals(lft, law), law.regulated)
    kind = PeriodicLoops if len(law.systems) > 1 else SampledLoops
    loops = kind(part_of(lft, kept), law)

    def figures(kind: str) -> Figures:
        return Figures(
            lambda rows: loops.quick(rows, kind),
            lambda row: np.array((loops.exact(row[0], kind),)),
            lambda rows, bound: loops.above(rows, bound, kind),
        )

    return loops, lambda: [figures(DISK), figures(OUTPUTS)]


def _around(lft: LFT, gain: object) -> tuple[LFT, Array, Sequence[str]]:
    """Return the LFT with the states of a controller, K of u = -K x, and the judged states.

    The inputs of the result are the robot's inputs, and then the rates of the controller's states.
    """
    law = None
    if isinstance(gain, Compensator):
        raise InputError(
            "gain is a Compensator, which does not contain its model; give "
            "fflin.LinearController(compensator, lin)"
        )
    if isinstance(gain, Policy):
        law = gain.linear_law()
        if law is None:
            raise InputError(
                f"gain is a {gain.kind}, expected a linear law about a point: a Gain, a "
                "StateFeedback or a continuous LinearController"
            )
    elif isinstance(gain, Gain) and has_lag_states(gain.state_names):
        law = gain.integral_law()
    states = tuple(name for name in lft.state_names if not name.startswith(LAG))
    if law is None or (isinstance(gain, Policy) and gain.feedback_gain is not None):
        if isinstance(gain, Gain) and gain.integrals:
            lft = _with_integrals(lft, gain, states)
            states = gain.state_names
        K = shaped("gain", gain_matrix(gain), (len(lft.B2.T), len(states)), " (nu, nx)")
        regulated = regulated_states(gain)
        if isinstance(gain, Policy):
            regulated = gain.fed_back
        return lft, K @ selection(states, lft.state_names), regulated
    signals = states
    measured = selection(states, lft.state_names)
    senses_outputs = isinstance(gain, Policy) and gain.senses_outputs
    if senses_outputs:
        signals = lft.output_names
        measured = lft.C2
    names = law.inputs, law.outputs
    if names != (signals, lft.input_names):
        raise InputError(
            "the law and the robot have different inputs and outputs; give the law of this "
            "robot"
        )
    regulated = gain.fed_back if isinstance(gain, Policy) else regulated_states(gain)
    if not senses_outputs:
        law, regulated = acting_part(law, regulated)
    used: Mask = np.any(law.B, axis=0) | np.any(law.D, axis=0)
    if senses_outputs and (lft.D21[used].any() or lft.D22[used].any()):
        raise InputError(
            "the law measures outputs that depend on inputs or on uncertain parameters, such as "
            "accelerations; give a law of outputs that depend on states only"
        )
    C = np.where(used[:, None], measured, 0.0)
    K = -np.block([[law.D @ C, law.C], [law.B @ C, law.A]])
    (nx, nu), nz, nw = lft.B2.shape, len(law.A), lft.B1.shape[1]
    added = tuple(f"controller.{index}" for index in range(nz))
    larger = replace(
        lft,
        A=np.block([[lft.A, np.zeros((nx, nz))], [np.zeros((nz, nx + nz))]]),
        B1=np.vstack((lft.B1, np.zeros((nz, nw)))),
        B2=np.block([[lft.B2, np.zeros((nx, nz))], [np.zeros((nz, nu)), np.eye(nz)]]),
        C1=np.hstack((lft.C1, np.zeros((nw, nz)))),
        D12=np.hstack((lft.D12, np.zeros((nw, nz)))),
        C2=np.hstack((lft.C2, np.zeros((len(lft.C2), nz)))),
        D22=np.hstack((lft.D22, np.zeros((len(lft.C2), nz)))),
        state_names=(*lft.state_names, *added),
        input_names=(*lft.input_names, *(f"rate of {name}" for name in added)),
    )
    return larger, K, (*regulated, *added)


def judged_states(lft: LFT, K: Array, regulated: Sequence[str]) -> Mask:
    """Return which states (nx,) decide the stability of all loops with u = -K x.

    These are the states `regulated` by the gain, the states that K feeds back, and the states that
    affect any of these for some value of the parameters. For example, the angles and the speeds of
    wheels are omitted if only the wheels rotate the robot: no input can regulate the total
    momentum, which has a pole at 0. If `regulated` is empty, all states are judged.
    """
    if not regulated:
        return np.full(len(lft.A), True)
    # Omitted states have zero columns in the rows `kept` of A, and in C1. So they have zero columns
    # in these rows of A + B1 Delta (I - D11 Delta)^-1 C1, and the matrix of every loop is block
    # triangular.
    kept: Mask = np.isin(lft.state_names, regulated) | K.any(axis=0)
    kept |= np.abs(lft.C1).max(axis=0, initial=0.0) > _ROUNDING * np.abs(lft.C1).max(
        initial=0.0
    )
    least = _ROUNDING * np.abs(lft.A).max()
    while (acting := ~kept & (np.abs(lft.A[kept]) > least).any(axis=0)).any():
        kept |= acting
    return kept


def _with_integrals(lft: LFT, gain: Gain, states: tuple[str, ...]) -> LFT:
    """Return the LFT with the integrals of a gain as further states.

    `states` are the states of the robot.
    """
    if gain.model_states != states or gain.dt:
        raise InputError(
            f"the gain was designed for a model of '{gain.robot}' with other states or in discrete "
            "time; give a continuous gain of the model of the same robot"
        )
    k = len(gain.integrals)
    nx = len(lft.A)
    H = gain.H @ selection(states, lft.state_names)
    return replace(
        lft,
        A=np.block([[lft.A, np.zeros((nx, k))], [H, np.zeros((k, k))]]),
        B1=np.vstack((lft.B1, np.zeros((k, lft.B1.shape[1])))),
        B2=np.vstack((lft.B2, np.zeros((k, lft.B2.shape[1])))),
        C1=np.hstack((lft.C1, np.zeros((len(lft.C1), k)))),
        C2=np.hstack((lft.C2, np.zeros((len(lft.C2), k)))),
        state_names=(*lft.state_names, *gain.integrals),
    )


def part_of(lft: LFT, kept: Mask) -> LFT:
    """Return the LFT of the states `kept` (nx,), with the outputs that depend on no other state."""
    others = np.abs(lft.C2[:, ~kept]).max(axis=1, initial=0.0)
    seen: Mask = others <= _ROUNDING * np.abs(lft.C2).max(axis=1, initial=0.0)
    return replace(
        lft,
        A=lft.A[np.ix_(kept, kept)],
        B1=lft.B1[kept],
        B2=lft.B2[kept],
        C1=lft.C1[:, kept],
        C2=lft.C2[np.ix_(seen, kept)],
        D21=lft.D21[seen],
        D22=lft.D22[seen],
        state_names=tuple(np.array(lft.state_names)[kept].tolist()),
        output_names=tuple(np.array(lft.output_names)[seen].tolist()),
    )


class Channel(NamedTuple):
    """Channel from w to C x + D w, where scale * w is a disturbance at the inputs."""

    C: Array
    D: Array
    scale: Array


class Loops:
    """Closed loops of an LFT with u = -K x; each row of deltas (N, k) gives one loop."""

    def __init__(self, lft: LFT, K: Array) -> None:
        self.lft, self.K = lft, K

    def matrices(self, rows: Array) -> tuple[Array, Array]:
        """Return A - B K and B of each loop."""
        A, B, _, _ = self.lft.at(rows)
        return A - B @ self.K, B

    def undamped(self, rows: Array) -> Array:
        """Return minus the least damping ratio of each loop (N,); >= 0 means an unstable loop."""
        poles = np.linalg.eigvals(self.matrices(rows)[0])
        ratios: Array = (poles.real / np.maximum(np.abs(poles), 1e-300)).max(axis=-1)
        return ratios

    def gains(self, channel: Channel, rows: Array, frequencies: Array) -> Array:
        """Return the largest gain (N,) over the given frequencies; infinite for unstable loops."""
        F, B = self.matrices(rows)
        largest = np.zeros(len(F))
        for w in frequencies:
            inner = 1j * w * np.eye(F.shape[-1]) - F
            response = channel.C @ np.linalg.solve(inner, B * channel.scale) + channel.D
            gram = response.conj().mT @ response
            largest = np.maximum(largest, np.linalg.eigvalsh(gram)[..., -1])
        return np.where(self.undamped(rows) >= 0.0, np.inf, np.sqrt(largest))

    def scaled(self, row: Array, nu: int) -> Array:
        """Return the largest gain (1,) of (S - T)/2 at the inputs, with their best scaling."""
        loop = self.at_inputs(row[0], nu)
        if np.linalg.eigvals(loop.F).real.max() >= 0.0:
            return np.array((np.inf,))
        return np.array((largest_scaled_gain(loop)[0],))

    def at_inputs(self, delta: Array, nu: int) -> Loop:
        """Return (S - T)/2 at the first nu inputs for one row of deltas."""
        F, B = self.matrices(delta)
        return Loop(F, B[:, :nu], -self.K[:nu], 0.5 * np.eye(nu))

    def figures(self, channel: Channel) -> Figures:
        """Return the functions for the criterion "largest gain" of a channel."""
        middle = np.zeros((1, len(self.lft.repeats)))
        sizes = np.unique(np.abs(np.linalg.eigvals(self.matrices(middle)[0])))
        at = np.argsort(
            [-self.gains(channel, middle, np.array((w,)))[0] for w in sizes]
        )
        peaks = [0.0, *sizes[at[:_FREQUENCIES]]]

        def exact(row: Array) -> Array:
            F, B = (matrix[0] for matrix in self.matrices(row))
            if np.linalg.eigvals(F).real.max() >= 0.0:
                return np.array((np.inf,))
            value, w = largest_gain(F, B * channel.scale, channel.C, channel.D)
            # similar loops have their peak near this frequency
            peaks.append(min(w, 1e300))
            return np.array((value,))

        def above(rows: Array, bound: float) -> Mask:
            F, B = self.matrices(rows)
            unstable: Mask = np.linalg.eigvals(F).real.max(axis=-1) >= 0.0
            limit = bound * (1.0 + ACCURACY)
            _, crossed = gain_crossings(
                F, B * channel.scale, channel.C, channel.D, limit
            )
            return unstable | crossed.any(axis=-1)

        def quick(rows: Array) -> Array:
            return self.gains(channel, rows, np.unique(peaks[-_FREQUENCIES:]))

        return Figures(quick, exact, above)


def _largest(
    figures: Figures, tried: Array, refuse: Callable[[Array], str]
) -> tuple[float, Array]:
    """Return the largest criterion that local searches find, and the deltas where it occurs.

    The first search starts at the first row of `tried`. A new search starts at each later row whose
    criterion exceeds the largest criterion found so far. So the result is at least the criterion of
    every row, to the accuracy of `Figures.above`. It cannot decrease if rows are appended.
    """
    best, at = _climbed(figures, tried[0], refuse)
    ahead = tried[1:]
    while np.isfinite(best) and len(ahead := ahead[figures.above(ahead, best)]):
        if figures.exact(ahead[:1])[0] > best:
            best, at = _climbed(figures, ahead[0], refuse)
        ahead = ahead[1:]
    return best, at


def _climbed(
    figures: Figures, start: Array, refuse: Callable[[Array], str]
) -> tuple[float, Array]:
    """Maximise a criterion locally from `start`; return the maximum and its deltas.

    A step follows the gradient, or sets one delta to -1 or 1.
    """
    quick, exact, _ = figures
    value = float(exact(start[None])[0])
    delta = start
    unit = np.eye(len(start))
    for _ in range(_STEPS):
        if not np.isfinite(value):
            break
        around = quick(np.vstack((delta + _DIFFERENCE * unit, delta)))
        gradient = np.nan_to_num(around[:-1] - around[-1], posinf=1.0)
        steps = _LENGTHS[:, None] * gradient / max(np.abs(gradient).max(), 1e-300)
        alone = [np.where(unit, end, delta) for end in (-1.0, 1.0)]
        trials = np.vstack((np.clip(delta + steps, -1.0, 1.0), *alone))
        before = value
        for trial in islice(
            filterfalse(refuse, trials[np.argsort(-quick(trials))]), _HELD
        ):
            if (reached := float(exact(trial[None])[0])) > value:
                value, delta = reached, trial
        if not value > before + 1e-9 * abs(before):
            break
    return value, delta


def _safe(loops: Loops) -> float:
    """Return the inverse of the largest bound of mu over all frequencies.

    If all ranges are scaled by less than the returned factor, all loops are stable.
    """
    lft = loops.lft
    if not lft.repeats.any():
        return np.inf  # no parameter has an effect
    F = loops.matrices(np.zeros(len(loops.lft.repeats)))[0]
    poles = np.linalg.eigvals(F)

    def response(w: Array) -> Array:
        inner = 1j * w[:, None, None] * np.eye(len(F)) - F
        return (lft.C1 - lft.D12 @ loops.K) @ np.linalg.solve(inner, lft.B1) + lft.D11

    sides = [np.abs(poles.imag) + width * poles.real for width in _WIDTHS]
    rates = np.concatenate((np.abs(poles), *sides))
    largest = largest_bound(
        response, lft.D11, rates[rates > 0.0], lft.repeats.astype(int)
    )
    if not largest:
        return np.inf
    return 1.0 / largest


# Upper bounds of the structured singular value mu for real repeated parameters. With real
# parameters, mu can be a discontinuous function of the frequency. So a bound that holds at two
# frequencies may not hold between them. The bound for a fixed scaling, however, is a continuous
# function of the frequency. Therefore one scaling is used for a whole interval of frequencies.


def perron(Z: Array) -> Array:
    """Return scalings d > 0 (.., n, 1) that reduce the norm of D Z D^-1, with D = diag(d).

    The scalings are computed from the left and right Perron vectors of |Z|.
    """
    sizes = np.abs(Z) + 1e-9 * np.abs(Z).max(axis=(-2, -1), keepdims=True) + 1e-300
    right, left = np.ones((2, *Z.shape[:-1], 1))
    for _ in range(100):
        right, left = sizes @ right, sizes.mT @ left
        right, left = (
            vector / vector.max(axis=-2, keepdims=True) for vector in (right, left)
        )
    d: Array = np.sqrt(left / right)
    return d


def bound_of(Z: Array, scaling: Scaling) -> float:
    """Return the upper bound b of mu that a scaling (d, g) gives for all matrices Z (k, n, n).

    With D = diag(d) and G = diag(g), b is the smallest number >= 0 for which all matrices satisfy
    Z^H D^2 Z + j (G Z - Z^H G) <= b^2 D^2.
    """
    d, g = scaling
    scaled, turned = d[:, None] * Z / d, (g / d)[:, None] * Z / d
    form = scaled.conj().mT @ scaled + 1j * (turned - turned.conj().mT)
    return float(np.sqrt(np.linalg.eigvalsh(form)[:, -1].max().clip(0.0)))


def largest_bound(
    response: Callable[[Array], Array], end: Array, rates: Array, blocks: Array
) -> float:
    """Return the largest bound of mu for response(w) over all frequencies w.

    `end` is the response at infinity. `rates` are the magnitudes and imaginary parts of the loop's
    poles, without zeros. `blocks` contains the number of repetitions of each delta.
    """
    grid = np.geomspace(0.01 * rates.min(), 100.0 * rates.max(), _LOOK)
    grid = np.unique(np.concatenate(((0.0,), grid, rates)))
    at_end = min(bound_of(end[None], scaling) for scaling in _scalings(end, blocks))
    heap: list[tuple[float, float, float, bool, Scaling]] = []

    def best_of(
        a: float, b: float, asked: bool, *known: Scaling
    ) -> tuple[float, Scaling, float]:
        """Return the bound over [a, b], the scaling that gives it, and the bound at (a + b)/2.

        Both are the least bounds over the scalings in `known` and from `_scalings`. slycot is used
        only if `asked` is true.
        """
        Z = response(np.linspace(a, b, _INSIDE))
        middle = Z[_INSIDE // 2]
        real_blocks = blocks if asked else blocks[:0]
        scalings = [*known, *_scalings(middle, real_blocks)]
        values = [bound_of(Z, scaling) for scaling in scalings]
        least = min(bound_of(middle[None], scaling) for scaling in scalings)
        return min(values), scalings[int(np.argmin(values))], least

    for a, b in pairwise(grid.tolist()):
        value, scaling, _ = best_of(a, b, False)
        heap.append((-value, a, b, False, scaling))
    heapify(heap)
    reached = at_end
    for _ in range(_DIVISIONS):
        if -heap[0][0] <= _NEAR * reached:
            break
        value, a, b, asked, scaling = heappop(heap)
        if asked:
            half = 0.5 * (a + b)
            for low, high in ((a, half), (half, b)):
                heappush(
                    heap,
                    (-best_of(low, high, False, scaling)[0], low, high, False, scaling),
                )
        else:
            value, scaling, least = best_of(a, b, True, scaling)
            reached = max(reached, least)
            heappush(heap, (-value, a, b, True, scaling))
    return max(at_end, -heap[0][0])


def _scalings(Z: Array, blocks: Array) -> list[Scaling]:
    """Return trial scalings (d, g) for Z.

    The first scaling is from `perron`. If `blocks` is not empty, the second one minimises the bound
    locally for real deltas, and slycot's AB13MD adds a third if it is installed. For a Z with one
    complex entry, a formula replaces both.
    """
    none: Array = np.zeros(len(Z))
    scalings: list[Scaling] = [(perron(Z)[:, 0], none)]
    if 1 < len(Z) <= _SIGNALS and len(blocks):
        start = gain_bound.Scaling(np.log(scalings[0][0]), none)
        found, _ = gain_bound.improved(Z[None], start, len(Z), none[:0], 0.0)
        d = np.exp(found.log_d)
        scalings.append((d, found.h * d**2))
    if len(Z) == 1 and len(blocks) and Z[0, 0].imag:
        return [*scalings, (none + 1.0, np.abs(Z[0]) ** 2 / (2.0 * Z[0].imag))]
    try:
        from slycot import ab13md
        from slycot.exceptions import SlycotArithmeticError
    except ImportError:
        return scalings
    if 0 < len(blocks) and len(Z) <= _SIGNALS:
        try:
            # AB13MD does not support repeated real blocks. A delta that occurs once is a real
            # block; a delta that occurs several times is entered as a full complex block.
            _, d, g, *_ = ab13md(Z, blocks, np.where(blocks == 1, 1, 2))
        except SlycotArithmeticError:
            return scalings
        if d.min() > 0.0 and np.isfinite((d, g)).all():
            scalings.append((d, g))
    return scalings
