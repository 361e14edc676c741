"""What is said of a motion: whether it arrived, what it took, what proves it."""

from typing import Any, NamedTuple

import numpy as np

from fflin.base.names import group_of, input_keys
from fflin.base.tables import folded, grid
from fflin.base.validation import Array
from fflin.simulation.passed import lines

# An error has settled once it stays below this share of its largest.
SETTLED = 0.02

# An error, in SI units, that is never above this was there all the time; below the other it is
# shown as none. Rounding moves a robot that stands still by less than either.
THERE, _NOTHING = 1e-9, 1e-14

# Share of the rows for which it must have stayed so by the end.
DWELL = 0.05

# Share of the run with an input at its limit from which on it is there all along.
_ALL_ALONG = 0.9

_TITLES = {"r_b": "position", "q_m": "joints", "qdot_m": "joint rates"}
_PLACES = ("attitude", "position", "joints")


class Course(NamedTuple):
    """How large (N,) an error of one kind was, and whether the policy feeds it back."""

    title: str
    unit: str
    size: Array
    steered: bool

    @property
    def settled(self) -> int:
        """The row from which on it has settled; N where it has not."""
        outside = np.flatnonzero(self.size > max(SETTLED * float(self.size.max()), THERE))
        return int(outside[-1]) + 1 if len(outside) else 0

    @property
    def late(self) -> bool:
        """Whether it has not settled: what flies through its target is there for a moment."""
        return self.settled > (1.0 - DWELL) * len(self.size)

    @property
    def last(self) -> str:
        """Its last value, for a sentence."""
        return f"{self.title}\u00a0{self.size[-1]:.2g}\u00a0{self.unit}"

    def row(self, t: Array) -> list[str]:
        """Return its row of the table."""
        values = (self.size[0], self.size.max(), self.size[-1])
        cells = ["." if value < _NOTHING else f"{value:.3g}" for value in values]
        when = "not yet" if self.late else f"{t[self.settled]:.3g}"
        if self.size.max() <= THERE:
            when = "."
        return [self.title, self.unit, *cells, when]


def motion_report(motion: Any) -> str:
    """Show whether a motion arrived, what it took, and the figures that prove it."""
    kinds = courses(motion)
    parts = [verdict(motion, kinds)] if kinds or motion.stopped else []
    by = ", compiled" if motion.engine == "compiled" else ""
    frame = f"frame {motion.frame}{by}"
    parts.append(f"{motion.robot}: {motion.t[-1]:g} s, {len(motion.t)} rows, {frame}")
    parts.extend(motion.notes)
    parts = [folded(parts)]
    if kinds:
        settled = f"within {100.0 * SETTLED:g} % after [s]"
        rows = [["error", "unit", "first", "largest", "last", settled]]
        parts.append(f"\n{grid([*rows, *(kind.row(motion.t) for kind in kinds)], 'll')}\n")
    if kinds or motion.u.any():
        parts.append(_largest_inputs(motion))
    if said := lines(motion):
        parts.append(folded(said))
    energy = motion.energy
    parts.append(
        f"energy {energy[0]:.6g} J at first, {energy[-1]:.6g} J at last; "
        f"momentum drift {motion.momentum_drift.max():.1e}"
    )
    if len(motion.com_drift):
        largest = motion.com_drift.max()
        parts.append(f"largest distance of the centre of mass from its line: {largest:.1e} m")
    if motion.linear is not None:
        apart = np.abs(motion.x - motion.linear).max(axis=0)
        # Nothing depends on the angle of a wheel, which outgrows all else.
        apart[[motion.state_names.index(f"q_m.{name}") for name in motion.wheels]] = 0.0
        most = int(apart.argmax())
        unit = motion.state_units[most].replace("1", "")
        size = f"{apart[most]:.3g} {unit}".rstrip()
        parts.append(
            f"largest difference from the linear model: {size} in {motion.state_names[most]}"
        )
    return "\n".join(parts)


def courses(motion: Any) -> list[Course]:
    """Return the errors of each kind, none where there is no target; wheels are no joints."""
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
        if group != "q_b" and not (group == "q_m" and entry in motion.wheels):
            columns.setdefault((title, unit), []).append(i)
    attitude = any(name.startswith("q_b.") for name in steered)
    return [
        Course("attitude", "deg", motion.attitude_error, attitude),
        *(
            Course(*of, sizes[:, at].max(axis=1), any(motion.state_names[i] in steered for i in at))
            for of, at in columns.items()
        ),
    ]


def verdict(motion: Any, kinds: list[Course]) -> str:
    """Say in a line whether a motion arrived at its target and what hindered it."""
    if motion.stopped:
        return f"stopped: {motion.stopped}"
    places = [kind for kind in kinds if kind.title in _PLACES]
    judged = [kind for kind in places if kind.steered] or [k for k in kinds if k.steered]
    moved = [kind for kind in judged if kind.size.max() > THERE]
    if motion.tracked:
        said = f"beside its trajectory at the end: {_and([kind.last for kind in judged])}"
    elif failed := [kind.last for kind in moved if kind.late]:
        said = f"not settled: {_and(failed)} at the end"
    elif moved:
        when = motion.t[max(kind.settled for kind in moved)]
        said = f"settled: {_and([kind.last for kind in moved])} after {when:.3g}\u00a0s"
    else:
        said = "settled: at the target from first to last"
    if aside := [kind.last for kind in places if kind.late and not kind.steered]:
        said += f"; not steered: {_and(aside)}"
    shares: dict[str, float] = {}  # at either limit
    for each in motion.saturated:
        shares[each.name] = shares.get(each.name, 0.0) + each.share
    if full := [name for name, share in shares.items() if share > _ALL_ALONG]:
        said += f"; at the limit all along: {', '.join(full)}"
    return said


def _and(words: list[str]) -> str:
    return " and ".join([", ".join(words[:-1]), words[-1]] if words[1:] else words)


def _largest_inputs(motion: Any) -> str:
    largest = np.abs(motion.u).max(axis=0)
    kinds: dict[tuple[str, str], float] = {}
    for name, unit, value in zip(input_keys(motion), motion.input_units, largest, strict=True):
        if value >= _NOTHING:
            key = (group_of(name), unit.replace(" ", "\u00a0"))
            kinds[key] = max(kinds.get(key, 0.0), float(value))
    shown = [f"{name}\u00a0{value:.4g}\u00a0{unit}" for (name, unit), value in kinds.items()]
    # Name, value and unit stay on one line.
    return folded([f"largest inputs: {', '.join(shown) or 'none'}"])
