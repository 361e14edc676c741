"""Channels of goals: from the disturbances of a goal to its outputs, for each plant."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from fflin.base.errors import InputError
from fflin.base.names import by_name, matching
from fflin.base.validation import Array, positive
from fflin.tuning.goals import (
    Goal,
    Margin,
    MaxGain,
    RollOff,
    Sized,
    Track,
    Variance,
)
from fflin.tuning.plant import Plant, Signals
from fflin.tuning.weights import Weight

ERROR = "error."


@dataclass(frozen=True, eq=False)
class Ends:
    """Inputs and outputs of a goal as indices of signals, with their sizes.

    `sources` and `sinks` contain pairs of a kind and an index. The kinds of sources are "input" and
    "sensor"; the kinds of sinks are "command", "output" (also for states) and "error". `watched`
    contains frequencies [rad/s] of peaks that the grid of a search missed.
    """

    sources: tuple[tuple[str, int], ...]
    sinks: tuple[tuple[str, int], ...]
    source_sizes: Array
    sink_sizes: Array
    weight: Weight = field(
        default_factory=lambda: Weight(np.array([1.0]), np.array([1.0]))
    )
    band: tuple[float, float] = (0.0, math.inf)
    watched: list[float] = field(default_factory=list)


def ends_of(
    goal: Goal,
    signals: Signals,
    states: Sequence[str],
    measured: Sequence[int],
    commanded: Sequence[int],
) -> Ends | None:
    """Return the inputs and outputs of a goal; None for goals of poles."""
    if isinstance(goal, MaxGain | RollOff):
        sources = _sources(goal.inputs, signals)
        sinks = _sinks(goal.outputs, signals, states)
        return Ends(*_split(sources, sinks), goal.weight(), goal.band)
    if isinstance(goal, Variance):
        densities = _sources(goal.inputs, signals)
        return Ends(*_split(densities, _sinks(goal.outputs, signals, states)))
    if isinstance(goal, Margin):
        ends: tuple[tuple[tuple[str, int], ...], tuple[tuple[str, int], ...]]
        if goal.at == "inputs":
            kept = tuple(commanded)
            ends = (
                tuple(("input", index) for index in kept),
                tuple(("command", index) for index in kept),
            )
        else:
            kept = tuple(measured)
            ends = (
                tuple(("sensor", index) for index in kept),
                tuple(("output", index) for index in kept),
            )
        ones = np.ones(len(kept))
        inverse = Weight(np.array([goal.disk]), np.array([1.0]))
        return Ends(*ends, ones, ones, inverse)
    if isinstance(goal, Track):
        index = matching("output", goal.output, signals.outputs)
        if len(index) != 1:
            raise InputError(
                f"'{goal.output}' is {len(index)} outputs, expected one; give a Track for each"
            )
        one = np.ones(1)
        return Ends((("sensor", index[0]),), (("output", index[0]),), one, one)
    return None


def signals_in_use(
    ends: Sequence[Ends | None],
    measured: Sequence[int],
    commanded: Sequence[int],
    size: int,
) -> tuple[Array, list[int]]:
    """Return a mask (size,) of the outputs and states in use, and the inputs in use.

    They belong to the law, which measures and commands the given signals, or to a goal.
    """
    used = np.zeros(size, bool)
    used[list(measured)] = True
    inputs = set(commanded)
    for end in ends:
        if end is None:
            continue
        for kind, index in (*end.sinks, *end.sources):
            if kind == "input":
                inputs.add(index)
            elif kind != "command":
                used[index] = True
    return used, sorted(inputs)


def _split(
    sources: dict[tuple[str, int], float], sinks: dict[tuple[str, int], float]
) -> tuple[tuple[tuple[str, int], ...], tuple[tuple[str, int], ...], Array, Array]:
    return (
        tuple(sources),
        tuple(sinks),
        np.array([*sources.values()]),
        np.array([*sinks.values()]),
    )


def _sized(given: Sized) -> dict[str, float]:
    """Return signals with their sizes."""
    if isinstance(given, str):
        return {given: 1.0}
    if isinstance(given, Mapping):
        return {
            str(key): positive(f"size of '{key}'", value)
            for key, value in given.items()
        }
    if isinstance(given, Sequence) and all(isinstance(key, str) for key in given):
        return dict.fromkeys(given, 1.0)
    raise InputError(
        f"signals are {given!r}, expected names, such as 'q_b', or {{name: size}}"
    )


def _expanded(sizes: dict[str, float], signals: Signals) -> dict[str, float]:
    """Replace groups of inputs, such as "wheel", by the names of the inputs."""
    members = {
        name: size for key, size in sizes.items() for name in signals.expanded(key)
    }
    return members | {key: size for key, size in sizes.items() if key in members}


def _sources(given: Sized, signals: Signals) -> dict[tuple[str, int], float]:
    """Return {(kind, index): size} of the inputs of a goal."""
    names = (*signals.inputs, *signals.outputs)
    chosen = by_name("signal", _expanded(_sized(given), signals), names)
    nu = len(signals.inputs)
    ends = {}
    for index, size in sorted(chosen.items()):
        kind = ("input", index) if index < nu else ("sensor", index - nu)
        ends[kind] = size
    return ends


def _sinks(
    given: Sized, signals: Signals, states: Sequence[str]
) -> dict[tuple[str, int], float]:
    """Return {(kind, index): size} of the outputs of a goal; states count after the outputs."""
    errors, others = {}, {}
    for key, size in _sized(given).items():
        if key.startswith(ERROR):
            errors[key.removeprefix(ERROR)] = size
        else:
            others[key] = size
    nu, ny = len(signals.inputs), len(signals.outputs)
    extra = [name for name in states if name not in signals.outputs]
    names = (*signals.inputs, *signals.outputs, *extra)
    ends = {}
    others = _expanded(others, signals)
    for index, size in sorted(by_name("signal", others, names).items()):
        if index < nu:
            ends["command", index] = size
        elif index < nu + ny:
            ends["output", index - nu] = size
        else:
            ends["output", ny + list(states).index(names[index])] = size
    for index, size in sorted(by_name("output", errors, signals.outputs).items()):
        ends["error", index] = size
    return ends


@dataclass(frozen=True, eq=False)
class Channel:
    """Channel from w to z of a plant, ``x' = A x + B1 w + B2 u``.

    ``z = C1 x + D11 w + D12 u, y = C2 x + D21 w + D22 u``, with A, B2, C2 and D22 of `plant`.
    """

    plant: Plant
    B1: Array
    C1: Array
    D11: Array
    D12: Array
    D21: Array


def channel_of(goal: Goal, ends: Ends, plant: Plant) -> Channel:
    """Return the channel of a goal for a plant."""
    nu, ny = plant.B.shape[1], plant.ny
    nx = len(plant.A)
    k, m = len(ends.sources), len(ends.sinks)
    B1, D21 = np.zeros((nx, k)), np.zeros((ny, k))
    through = np.zeros((len(plant.C), k))  # to the true outputs and states
    for column, (kind, index) in enumerate(ends.sources):
        if kind == "input":
            B1[:, column] = plant.B[:, index]
            through[:, column] = plant.D[:, index]
            D21[:, column] = plant.D[:ny, index]
        else:
            D21[index, column] = 1.0
    C1, D11, D12 = np.zeros((m, nx)), np.zeros((m, k)), np.zeros((m, nu))
    for row, (kind, index) in enumerate(ends.sinks):
        if kind == "command":
            D12[row, index] = 1.0
            continue
        C1[row] = plant.C[index]
        D12[row] = plant.D[index]
        D11[row] = through[index]
        if kind == "error":
            D11[row] = D21[index]
    if isinstance(goal, Margin):
        D11 = D11 + 0.5 * np.eye(m)
    sizes = ends.source_sizes
    B1, D11, D21 = B1 * sizes, D11 * sizes, D21 * sizes
    rows = ends.sink_sizes[:, None]
    channel = Channel(plant, B1, C1 / rows, D11 / rows, D12 / rows, D21)
    if isinstance(goal, Variance) and plant.dt:
        return _held_noise(channel)
    return channel


def _held_noise(channel: Channel) -> Channel:
    """Return a channel whose white noise equals the noise of the samples of a sampled model.

    The noise passes a lag sqrt(T) / (1 + s T/2) for the sample time T. The variance of the
    continuous output is then the variance of the samples.
    """
    plant = channel.plant
    k = channel.B1.shape[1]
    rate = 2.0 / plant.dt
    gain = math.sqrt(plant.dt)
    nx = len(plant.A)
    B1 = np.vstack((np.zeros((nx, k)), rate * gain * np.eye(k)))
    larger = Plant(
        np.block([[plant.A, channel.B1], [np.zeros((k, nx)), -rate * np.eye(k)]]),
        np.vstack((plant.B, np.zeros((k, plant.B.shape[1])))),
        np.hstack((plant.C[: plant.ny], channel.D21)),
        plant.D[: plant.ny],
        plant.ny,
        plant.dt,
    )
    return Channel(
        larger,
        B1,
        np.hstack((channel.C1, channel.D11)),
        np.zeros_like(channel.D11),
        channel.D12,
        np.zeros_like(channel.D21),
    )
