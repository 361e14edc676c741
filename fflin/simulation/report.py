"""Report of a motion: settling, inputs, limit violations, and conserved quantities."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from textwrap import shorten
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np

from fflin.base.names import group_of, input_keys
from fflin.base.tables import folded, grid
from fflin.base.validation import Array, Indices, Mask
from fflin.dynamics.impact import Impact

if TYPE_CHECKING:
    from fflin.simulation.motion import Motion

# An error has settled when it stays below this fraction of its largest value.
SETTLED = 0.02

# If an error [SI units] never exceeds THERE, the motion is at the target throughout. An error
# below _NOTHING is not shown. Rounding errors move a robot at rest by less than both limits.
THERE, _NOTHING = 1e-9, 1e-14

# Fraction of the rows at the end of a run in which a settled error must remain small.
DWELL = 0.05

# Smallest reported violation, relative to the limit; a smaller one may be an integration error.
_SHARE = 1e-3

_MOST, _NAMED = 8, 4  # most lines of a list, and most saturated inputs named in the first line

# Signal with limits: its name, history (N,), unit, and least and largest value (2,).
Limited: TypeAlias = "tuple[str, Array, str, Array]"

_OF_PHASES = (
    "|p|: linear momentum; |h|: angular momentum about the centre of mass;\n"
    "before: total of all bodies in the impact"
)

_TITLES = {"r_b": "position", "q_m": "joints", "qdot_m": "joint rates"}
_PLACES = ("attitude", "position", "joints")
# Errors of flexible appendages and liquids, which do not count as settling.
_OF_MODES = {"q_m": ("modes", "slosh"), "qdot_m": ("mode rates", "slosh rates")}
_ALL_OF_MODES = {title for titles in _OF_MODES.values() for title in titles}
_MODAL = "kg^0.5 m"  # unit of the amplitudes of flexible appendages

# Rotation [deg] up to which a modal amplitude is accurate, because the model is linear in the
# amplitude.
_LINEAR = 5.0


class Passed(NamedTuple):
    """Limit violation: the value [unit] farthest beyond the limit, its time [s], and the limit."""

    name: str
    value: float
    time: float
    limit: float
    unit: str
    at_first: bool  # whether the violation is there from the start

    def __str__(self) -> str:
        value = f"{_shown(self.value)} {self.unit}".removesuffix(" 1")
        said = f"{_name(self.name)} {value} at {_shown(self.time)} s, limit {_shown(self.limit)}"
        return f"{said}, from the start" if self.at_first else said


class Saturated(NamedTuple):
    """Saturation of an input or wheel speed: its limit [unit] and the fraction of the run."""

    name: str
    limit: float
    unit: str
    share: float

    def __str__(self) -> str:
        size = f"{_shown(self.limit)} {self.unit}"
        return f"{_name(self.name)} at its limit of {size} for {_percent(self.share)} % of the run"


def passed(t: Array, histories: Iterable[Limited]) -> tuple[Passed, ...]:
    """Return the limit violations, with the largest relative violation first."""
    found = []
    for name, values, unit, limits in histories:
        size = float(np.abs(limits[np.isfinite(limits)]).max())
        excess = np.maximum(limits[0] - values, values - limits[1])
        at = int(excess.argmax())
        if excess[at] > max(_SHARE * size, 1e-12):
            limit = float(limits[int(values[at] > limits[1])])
            first = name.startswith("q_m.") and bool(excess[0] > max(_SHARE * size, 1e-12))
            one = Passed(name, float(values[at]), float(t[at]), limit, unit, first)
            found.append((-excess[at] / (size or 1e-12), one))
    return tuple(one for _, one in sorted(found))


def saturated(t: Array, histories: Iterable[Limited]) -> tuple[Saturated, ...]:
    """Return signals at a nonzero limit, with the longest saturation first."""
    held = np.diff(t, append=t[-1:])
    found = [
        Saturated(name, limit, unit, float(held[near].sum() / held.sum()))
        for name, values, unit, limits in histories
        for limit in limits[np.isfinite(limits) & (limits != 0.0)].tolist()
        # A wheel speed only approaches its limit, but an input is clipped exactly at its limit.
        if held[
            near := np.abs(values - limit) <= (1e-3 if "qdot_m." in name else 1e-9) * abs(limit)
        ].any()
    ]
    return tuple(sorted(found, key=lambda each: -each.share))


def limited(motion: Motion) -> Iterator[Limited]:
    """Yield the states and inputs of a motion that have limits."""
    names = motion.state_names + motion.input_names
    units = motion.state_units + motion.input_units
    columns = np.hstack((motion.x, motion.u)).T
    for name, limits in zip(motion.limit_names, motion.limits, strict=True):
        at = names.index(name)
        yield name, columns[at], units[at], limits


def _name(name: str) -> str:
    group, _, entry = name.partition(".")
    return entry if group in ("q_m", "qdot_m") else name


def _percent(share: float) -> str:
    return f"{100.0 * share:.2g}" if share < 0.1 else f"{100.0 * share:.0f}"


def _shown(value: float) -> str:
    return f"{value:.3g}" if abs(value) < 1000.0 else f"{value:.0f}"


def settled_at(sizes: Array) -> Indices:
    """Return the row from which each error (N, ..) has settled; N if an error has not settled."""
    outside = sizes > np.maximum(SETTLED * sizes.max(axis=0), THERE)
    first = len(sizes) - outside[::-1].argmax(axis=0)
    return np.where(outside.any(axis=0), first, 0)


def is_late(settled: Array | Indices | int, count: int) -> Mask | bool:
    """Return whether errors settle too late in a run of `count` rows to count as settled.

    An error that merely passes through zero at the end therefore does not count as settled.
    """
    return settled > (1.0 - DWELL) * count


class ErrorHistory(NamedTuple):
    """History (N,) of the size of one kind of error, and whether the policy feeds it back."""

    title: str
    unit: str
    size: Array
    steered: bool

    @property
    def settled(self) -> int:
        """First row from which the error is settled; N if the error has not settled."""
        return int(settled_at(self.size))

    @property
    def late(self) -> bool:
        """Whether the error settles too late or not at all."""
        return bool(is_late(self.settled, len(self.size)))

    @property
    def last(self) -> str:
        """Title, final value and unit, for a sentence."""
        return f"{self.title}\u00a0{self.size[-1]:.2g}\u00a0{self.unit}"

    def row(self, t: Array) -> list[str]:
        """Return the row of this error in the table."""
        values = (self.size[0], self.size.max(), self.size[-1])
        cells = ["." if value < _NOTHING else f"{value:.3g}" for value in values]
        not_yet = "not yet" if self.steered else "not controlled"
        when = not_yet if self.late else f"{t[self.settled]:.3g}"
        if self.size.max() <= THERE:
            when = "."
        return [self.title, self.unit, *cells, when]


def motion_report(motion: Motion) -> str:
    """Return the report of a motion: settling, inputs, violations, and conserved quantities."""
    kinds = error_histories(motion)
    head = [verdict(motion, kinds)] if kinds or motion.stopped else []
    by = ", compiled" if motion.engine == "compiled" else ""
    run = f"{motion.t[-1]:g} s, {len(motion.t)} rows, frame {motion.frame}{by}"
    circling = [str(motion.orbit)] if motion.orbit else []
    parts = [folded([*head, f"{motion.robot}: {run}", *circling, *motion.notes])]
    if not (kinds or motion.target.size):
        rows = [["change from the start", "unit", "largest", "final"]]
        gone = [each.row(motion.t) for each in error_histories(replace(motion, target=motion.x[0]))]
        rows += [
            [*each[:2], *each[3:5]] for each in gone if each[0] in (*_PLACES, *_OF_MODES["q_m"])
        ]
        parts.append(f"\n{grid(rows, 'll')}\n")
    if kinds:
        settled = f"settles to {100.0 * SETTLED:g} % at [s]"
        rows = [["error", "unit", "initial", "largest", "final", settled]]
        parts.append(f"\n{grid([*rows, *(kind.row(motion.t) for kind in kinds)], 'll')}\n")
    if motion.modes:
        parts.append(_largest_modes(motion))
    if kinds or motion.u.any():
        parts.append(_largest_inputs(motion))
    said = [*(f"limit exceeded: {each}" for each in motion.passed), *map(str, motion.saturated)]
    if said:
        more = [f"and {len(said) - _MOST} more"] if len(said) > _MOST else []
        parts.append(folded(said[:_MOST] + more))
    if motion.phases:
        parts += [f"\n{grid(_phases(motion), 'll')}", _OF_PHASES, ""]
    first, last = (f"{energy:.6g} J" for energy in motion.energy[[0, -1]])
    drift = f"{motion.momentum_drift.max():.1e}"
    kept = f"{motion.kept} drift {drift}".replace(" ", "\u00a0")
    parts.append(folded([f"energy: initial {first}, final {last}; {kept}"]))
    if len(motion.com_drift):
        far = f"{motion.com_drift.max():.1e} m"
        parts.append(f"largest deviation of the centre of mass from its predicted path: {far}")
    if motion.linear is not None:
        apart = np.abs(motion.x - motion.linear).max(axis=0)
        # Wheel angles are excluded: they grow without bound, and nothing depends on them.
        apart[[motion.state_names.index(f"q_m.{name}") for name in motion.wheels]] = 0.0
        most = int(apart.argmax())
        size = f"{apart[most]:.3g} {motion.state_units[most]}".removesuffix(" 1")
        where = f"{size} in {motion.state_names[most]}"
        parts.append(f"largest difference from the linear model: {where}")
    return "\n".join(parts)


def motion_record(motion: Motion) -> dict[str, object]:
    """Return the numbers of the report by name."""
    t = motion.t
    errors = {
        each.title: {
            "unit": each.unit,
            "initial": each.size[0],
            "largest": each.size.max(),
            "final": each.size[-1],
            "settled": None if each.late else t[each.settled],
        }
        for each in error_histories(motion)
    }
    return {
        "stopped": motion.stopped,
        "duration": t[-1],
        "rows": len(t),
        "frame": motion.frame,
        "engine": motion.engine,
        "errors": errors,
        "state_names": motion.state_names,
        "state_units": motion.state_units,
        "x": motion.x[-1],
        "input_names": motion.input_names,
        "input_units": motion.input_units,
        "largest_inputs": np.abs(motion.u).max(axis=0),
        "limits_exceeded": motion.passed,
        "saturated": motion.saturated,
        "energy": motion.energy[[0, -1]],
        "momentum_drift": motion.momentum_drift.max(),
        "notes": motion.notes,
    }


def _phases(motion: Motion) -> list[list[str]]:
    """Return the table of phases; for a motion from a file, the table lacks the impacts."""
    table = [["phase", "", "t [s]", "energy [J]", "|p| [N s]", "|h| [N m s]"]]

    def row(name: str, when: str, time: float, energy: float, momentum: Array) -> None:
        sizes = (np.linalg.norm(each) for each in (momentum[3:], momentum[:3]))
        table.append([name, when, *(f"{x:.4g}" for x in (time, energy, *sizes))])

    parts = motion._phases or motion.phases
    pairs = zip((None, *parts), parts, strict=False)
    struck = [before for before, part in pairs if not isinstance(part, Impact)]
    firsts = [0, *np.searchsorted(motion.t, motion.starts[1:], "right") - 1, len(motion.t)]
    for k, (name, impact) in enumerate(zip(motion.phases, struck, strict=True)):
        start, end = firsts[k], firsts[k + 1] - 1
        shown, energy, momentum = shorten(name, 28), motion.energy[start], motion.momentum[start]
        met = isinstance(impact, Impact)
        if met:
            change = np.roll(impact.momentum_after - impact.momentum, 3)
            row(shown, "before", motion.t[start], energy + impact.energy_lost, momentum - change)
            shown = ""
        row(shown, "after" if met else "start", motion.t[start], energy, momentum)
        row("", "end", motion.t[end], motion.energy[end], motion.momentum[end])
    return table


def error_histories(motion: Motion) -> list[ErrorHistory]:
    """Return the errors of each kind, or an empty list without a target.

    Wheel speeds and modes have their own kinds. Wheel angles are left out.
    """
    if motion.error is None or motion.attitude_error is None:
        return []
    steered = set(motion.steered or motion.state_names)
    sizes = np.abs(motion.error)
    columns: dict[tuple[str, str], list[int]] = {}
    for i, (name, unit) in enumerate(zip(motion.state_names, motion.state_units, strict=True)):
        group, _, entry = name.partition(".")
        title = _TITLES.get(group, group)
        if group == "qdot_m" and entry in motion.wheels:
            title = "wheel speeds"
        if group in _OF_MODES and entry in motion.modes:
            title = _OF_MODES[group][not unit.startswith(_MODAL)]
        if group != "q_b" and not (group == "q_m" and entry in motion.wheels):
            columns.setdefault((title, unit), []).append(i)
    attitude = any(name.startswith("q_b.") for name in steered)
    found = [ErrorHistory("attitude", "deg", motion.attitude_error, attitude)]
    for of, at in columns.items():
        fed_back = any(motion.state_names[i] in steered for i in at)
        fed_back &= of[0] not in ("position", "v_b") or pushed(motion)
        found.append(ErrorHistory(*of, sizes[:, at].max(axis=1), fed_back))
    return found


def pushed(of: object) -> bool:
    """Return whether an input of a motion or similar object is a force on the base."""
    return any(group_of(name) in ("F_b", "thrust") for name in input_keys(of))


def verdict(motion: Motion, kinds: list[ErrorHistory]) -> str:
    """Return one line: whether a motion settled at its target, and if not, why."""
    if motion.stopped:
        return f"stopped: {motion.stopped}"
    places = [kind for kind in kinds if kind.title in _PLACES]
    judged = [kind for kind in places if kind.steered] or [
        kind for kind in kinds if kind.steered and kind.title not in _ALL_OF_MODES
    ]
    moved = [kind for kind in judged if kind.size.max() > THERE]
    aside = [kind.last for kind in places if kind.late and not kind.steered]
    if motion.tracked and not motion.phases:
        said = f"tracking errors at the end: {_and([kind.last for kind in judged])}"
    elif failed := [kind.last for kind in moved if kind.late]:
        said = f"not settled: {_and(failed)} off target"
    elif moved:
        when = motion.t[max(kind.settled for kind in moved)]
        said = f"settled after {when:.3g}\u00a0s to within {100.0 * SETTLED:g}\u00a0%"
        if late := [kind.last for kind in kinds if kind.late and kind.steered]:
            what = "positions" if judged[0].title in _PLACES else "rates"
            said = f"{what} {said}; not yet settled: {_and(late)}"
    else:
        which = f"{_and([kind.title for kind in judged])} " * bool(aside)
        said = f"settled: {which}at the target throughout the run"
    if aside:
        said += f"; not controlled: {_and(aside)}"
    return f"{said}; saturated inputs: {_full(motion)}"


def _full(motion: Motion) -> str:
    """Return the inputs and wheels at a limit, each with the fraction of the run spent there."""
    shares: dict[str, float] = {}  # sum for both limits
    for each in motion.saturated:
        shares[each.name] = shares.get(each.name, 0.0) + each.share
    said = [f"{name}\u00a0({_percent(share)}\u00a0%)" for name, share in shares.items()]
    more = [f"{len(said) - _NAMED} more"] if len(said) > _NAMED else []
    return ", ".join(said[:_NAMED] + more) or "none"


def _and(words: list[str]) -> str:
    return " and ".join([", ".join(words[:-1]), words[-1]] if words[1:] else words)


def _largest_modes(motion: Motion) -> str:
    """Return the largest amplitude of each mode, and the corresponding rotation."""
    rows = [["mode", "unit", "largest", "rotation [deg]", "at [s]"]]
    far = []
    for name, rotation in zip(motion.modes, motion.mode_rotations.tolist(), strict=True):
        at = motion.state_names.index(f"q_m.{name}")
        size, unit = np.abs(motion.x[:, at]), motion.state_units[at]
        largest = float(size.max())
        degrees = float(np.degrees(rotation * largest))
        cells = ["." if value < _NOTHING else f"{value:.3g}" for value in (largest, degrees)]
        rows.append([name, unit, *cells, f"{motion.t[size.argmax()]:.3g}"])
        if degrees > _LINEAR and unit == _MODAL:
            far.append(f"{name}\u00a0{degrees:.3g}\u00a0deg")
    table = f"{grid(rows, 'll')}\n"
    if not far:
        return table
    said = (
        "warning: the motion is not accurate, because the model is linear in the modal "
        f"amplitudes, but some amplitudes bend the structure by more than {_LINEAR:g} deg: "
        f"{_and(far)}"
    )
    return f"{table}\n{folded([said])}"


def _largest_inputs(motion: Motion) -> str:
    largest = np.abs(motion.u).max(axis=0)
    kinds: dict[tuple[str, str], float] = {}
    for name, unit, value in zip(input_keys(motion), motion.input_units, largest, strict=True):
        if value >= _NOTHING:
            key = (group_of(name), unit.replace(" ", "\u00a0"))
            kinds[key] = max(kinds.get(key, 0.0), float(value))
    shown = [f"{name}\u00a0{value:.4g}\u00a0{unit}" for (name, unit), value in kinds.items()]
    # Non-breaking spaces keep a name, its value and the unit on one line.
    return folded([f"largest inputs: {', '.join(shown) or 'none'}"])
