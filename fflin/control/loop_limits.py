"""Limits of efforts and speeds on a loop, and loops with springs or gravity that respect them."""

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple, TypeAlias

import numpy as np

from fflin.base.errors import listed
from fflin.base.validation import Array, Complex, Values
from fflin.control.channel import warn_beyond
from fflin.control.optimal.riccati import rates_of, solve
from fflin.linear.model import LinearModel

# A loop with springs or gravity is slowed at most this many times. The fastest loop is taken that
# leaves the efforts at least this fraction of the best.
_TRIALS, _IN_VAIN = 8, 0.9

# The report names a mode whose decay is below this fraction of the decay at rest.
_AS_SLOW = 0.9

NOT_ENOUGH = "is too small for all displacements"

Costs: TypeAlias = Callable[[float], tuple[Array, Array]]


class Limit(NamedTuple):
    """Largest bandwidth permitted by a limit, and the name of this limit."""

    bandwidth: float
    what: str


def largest_use(K: Array, size: Array, names: tuple[str, ...]) -> Array:
    """Return the largest K d of all displacements d: the base's in any direction, joints' signs."""
    groups = np.array([name.partition(".")[0] for name in names[: len(size)]])
    scaled = K[..., : len(size)] * size
    total: Array = np.abs(scaled[..., ~np.isin(groups, ("q_b", "r_b"))]).sum(axis=-1)
    for group in ("q_b", "r_b"):
        total += np.linalg.norm(scaled[..., groups == group], axis=-1)
    return total


def limits_on(what: str, room: Mapping[str, float], used: Array, power: float) -> list[Limit]:
    """Return the factors of the bandwidth at which the inputs reach their limits."""
    return [
        Limit((most / size) ** (1.0 / power), f"the {what} of {name.partition('_m.')[2] or name}")
        for (name, most), size in zip(room.items(), used.tolist(), strict=True)
        if 0.0 < most < math.inf and size > 0.0
    ]


def efforts_left(lin: LinearModel) -> dict[str, float]:
    """Return the input limits minus the inputs at the operating point."""
    inputs = zip(lin.input_names, lin.u0.tolist(), strict=True)
    return {name: lin.limits.get(name, math.inf) - abs(at) for name, at in inputs}


def growth(lin: LinearModel) -> Limit:
    """Return the largest rate of growth [1/s] of the model, and which mode has it."""
    poles, modes = np.linalg.eig(lin.A)
    rates = rates_of(poles, lin.dt).real
    fastest, k = float(rates.max()), int(rates.argmax())
    moving = listed(_moving_most(lin, modes[:, [k]]))
    return Limit(fastest, f"the unstable mode that grows by {fastest:.3g} 1/s ({moving})")


class _Trial(NamedTuple):
    """A loop that was tried: its limit, its gain and modes, and what its inputs require."""

    limit: Limit
    left: float  # factor on the bandwidth that the efforts allow, as far as it is below 1
    effort: str  # the input that allows the least
    K: Array
    rates: Values  # of the modes (nx,) [1/s]
    modes: Complex
    required: Array  # largest inputs (nu,)


def slowed(
    lin: LinearModel, costs: Costs, size: Array, driven: Array, limit: Limit, least: Limit
) -> tuple[Limit, str]:
    """Slow a loop with springs or gravity until it respects the limits; report what it achieves.

    The loop is slowed down to `least` and no further. Displacements `size` (m,) require efforts at
    the start, and displacements `driven` also on the way back. The latter omit joints without a
    motor, which springs or gravity move.
    """
    trials = list[_Trial]()
    for _ in range(_TRIALS):
        Q, R = costs(limit.bandwidth)
        try:
            K = solve(lin.A, lin.B, Q, R, None, lin.dt).K
        except np.linalg.LinAlgError:
            break
        poles, modes = np.linalg.eig(lin.A - lin.B @ K)
        rates = rates_of(poles, lin.dt)
        time = np.geomspace(0.1 / np.abs(rates).max(), 3.0 / np.abs(rates).min(), 60)
        decaying = (K @ modes) * np.exp(rates * time[:, None])[:, None]
        later = (decaying @ np.linalg.inv(modes)[:, : len(size)]).real
        use = np.maximum(
            largest_use(K, size, lin.state_names),
            largest_use(later, driven, lin.state_names).max(axis=0),
        )
        left, what = min(limits_on("effort", efforts_left(lin), use, 2.0), default=Limit(1.0, ""))
        trials.append(_Trial(limit, left, what, K, rates, modes, np.abs(lin.u0) + use))
        if left >= 1.0 - 1e-6:
            return limit, _achieved(lin, trials[-1])
        if limit.bandwidth <= least.bandwidth:
            break
        # What springs and gravity require remains, however slow the loop is.
        slower = Limit(min(max(left, 0.3), 0.8) * limit.bandwidth, what)
        limit = max(slower, least)
    if not trials:
        return limit, ""  # the regulator raises with the reason
    most = max(trial.left for trial in trials)
    trial = next(x for x in trials if x.left >= _IN_VAIN * most)
    limit, effort = trial.limit, trial.effort
    high = np.array([lin.limits.get(name, math.inf) for name in lin.input_names])
    where = "to return from the displacements of the default weights"
    required = trial.required[None]
    warn_beyond(lin.robot, where, lin.input_names, lin.input_units, required, -high, high)
    held = limit.what == least.what  # a slower loop loses an unstable mode
    what = f"{limit.what}; {effort} {NOT_ENOUGH}" if held else f"{effort}, which {NOT_ENOUGH}"
    return limit._replace(what=what), _achieved(lin, trial)


def _achieved(lin: LinearModel, trial: _Trial) -> str:
    """Return a report of a loop's bandwidth and decay, and of modes slower than at rest."""
    decay, fast = -trial.rates.real, np.abs(trial.rates)
    said = f"bandwidth at least {fast.min():.3g} rad/s, decay rate at least {decay.min():.3g} 1/s, "
    said += f"damping ratio at least {(decay / fast).min():.2g}"
    slow = np.flatnonzero(decay < _AS_SLOW * math.sqrt(0.5) * trial.limit.bandwidth)
    if vibrating := _vibrations(lin, trial, slow.tolist()):
        said += (
            "; decaying by their own damping only: "
            f"{listed(list(dict.fromkeys(vibrating.values())))}"
        )
    slow = np.setdiff1d(slow, list(vibrating)).astype(int)
    if names := _moving_most(lin, trial.modes[:, slow]):
        said += f"; slowed by springs, gravity or motion: {listed(names)}"
    return said


def _vibrations(lin: LinearModel, trial: _Trial, slow: list[int]) -> dict[int, str]:
    """Return {index: mode of an appendage} of the slow modes of a loop that vibrate with it."""
    robot, m = lin._robot, len(lin.M)
    if robot is None or not robot.modes:
        return {}
    names = [name.removeprefix("q_m.") for name in lin.state_names[:m]]
    stiffness = np.array([robot.stiffness.get(name, 0.0) for name in names])
    of_modes = np.isin(names, [joint.name for joint in robot.modes])
    found = {}
    for k in slow:
        energy = stiffness * np.abs(trial.modes[:m, k]) ** 2
        rate = trial.rates[k]
        if energy[of_modes].sum() > 0.5 * energy.sum() and abs(rate.imag) > 2.0 * abs(rate.real):
            found[k] = names[int((energy * of_modes).argmax())]
    return found


def _moving_most(lin: LinearModel, modes: Complex) -> list[str]:
    """Return the coordinates that modes (nx, k) move most, weighed by inertia."""
    m = len(lin.M)
    large = np.abs(modes[:m]) * np.sqrt(lin.M.diagonal())[:, None]
    among = (large > 0.5 * large.max(axis=0, initial=0.0)).any(axis=1)
    return [name for name, here in zip(lin.state_names[:m], among, strict=False) if here]
