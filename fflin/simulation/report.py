"""Report of a motion: settling, inputs, limit violations and conserved quantities."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from dataclasses import replace
from textwrap import shorten
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from fflin.base import html
from fflin.base.names import group_of, input_keys
from fflin.base.tables import folded, grid
from fflin.base.validation import Array, Indices, Mask
from fflin.dynamics.impact import Impact
from fflin.robot.inputs import Thruster
from fflin.simulation.rotation_rates import RotationRates

if TYPE_CHECKING:
    from fflin.simulation.motion import Motion

# An error has settled once it stays below this fraction of its largest value.
SETTLED = 0.02

# If an error never exceeds THERE, it counts as zero throughout the run. The errors are in SI units,
# or in deg for the attitude. A value below _NOTHING appears as a dot in tables. Both limits exceed
# the rounding errors of a robot at rest.
THERE, _NOTHING = 1e-9, 1e-14

# An error counts as settled only if it stays small during the last part of a run. DWELL is the
# length of this part, as a fraction of all rows.
DWELL = 0.05

# The end of a run decides whether an error decays. The largest error in the last _TAIL of all rows
# is compared with the largest errors in two earlier windows of as many rows: an error grows if it
# rises through all three windows, and in the last one by the factor _GROWS. An error that remains
# changes by less than this factor.
# An error below _SEEN times its largest value is not judged.
_TAIL, _GROWS, _SEEN = 0.1, 1.05, 1e-3

TRUSTED = 0.1  # largest accepted relative error of a linear prediction

# The heading of a page shows an error as 0 below this fraction of its largest value.
_GONE = 1e-4

# Smallest limit violation that is reported, relative to the limit. Smaller violations may be
# integration errors.
_SHARE = 1e-3

# Standard gravity [m/s^2], which relates the specific impulse of a thruster to its exhaust speed.
_GRAVITY = 9.80665

# largest number of lines of a list, and of saturated inputs in a line
_MOST, _NAMED = 8, 4

_OF_PHASES = (
    "|p|: linear momentum; |h|: angular momentum about the centre of mass;\n"
    "before: total of all bodies in the impact"
)

STATES = ("q_b", "r_b", "q_m", "omega_b", "v_b", "qdot_m")
_TITLES = {
    "q_b": "attitude",
    "r_b": "position",
    "q_m": "joints",
    "qdot_m": "joint rates",
}
_PLACES = ("attitude", "position", "joints")
WHEEL_SPEEDS = "wheel speeds"
# {group: titles} of the errors of flexible appendages and liquids. These errors do not decide
# whether a motion has settled.
_OF_MODES = {"q_m": ("modes", "slosh"), "qdot_m": ("mode rates", "slosh rates")}
_ALL_OF_MODES = {title for titles in _OF_MODES.values() for title in titles}
_MODAL = "kg^0.5 m"  # unit of the amplitudes of flexible appendages

# Rotation [deg] above which modal amplitudes are inaccurate, because the modal model is linear.
_LINEAR = 5.0

# Units of angles in reports, in figures and on pages: {unit: shown unit and its factor}.
DEGREES = {
    "rad": ("deg", float(np.degrees(1.0))),
    "rad/s": ("deg/s", float(np.degrees(1.0))),
}

# A limit is drawn only if the curve reaches this fraction of the limit.
_NEAR = 1.0 / 3.0


class Curve(NamedTuple):
    """Values (N,) and limits of a state, input or wheel momentum.

    If they exist, `linear` (N,) is the linear prediction, and `reference` (N,) is the reference
    that the robot follows.
    """

    key: str  # GROUP.NAME
    group: str  # GROUP, but "speed" or "momentum" for the speed or momentum of a wheel
    name: str
    unit: str
    values: Array
    limits: Array
    linear: Array | None = None
    reference: Array | None = None

    @property
    def short(self) -> str:
        """Name of the signal without its group."""
        return self.key.partition(".")[2]

    @property
    def levels(self) -> list[float]:
        """Finite limits."""
        return [level for level in self.limits.tolist() if np.isfinite(level)]

    @property
    def near(self) -> list[float]:
        """Limits that the curve comes near: some value is at least _NEAR times the limit."""
        return [
            level
            for level in self.levels
            if level and (self.values / level).max() >= _NEAR
        ]

    def scaled(self, unit: str, factor: float) -> Curve:
        """Return the curve in another unit, in which its values are multiplied by a factor."""
        return self._replace(
            unit=unit,
            values=factor * self.values,
            limits=factor * self.limits,
            linear=None if self.linear is None else factor * self.linear,
            reference=None if self.reference is None else factor * self.reference,
        )


def curves(motion: Motion) -> Iterator[Curve]:
    """Yield the curves of states, wheel momenta and inputs; wheel angles are excluded."""
    limits = dict(zip(motion.limit_names, motion.limits, strict=True))
    inertias = dict(zip(motion.wheels, motion.wheel_inertias.tolist(), strict=False))
    unlimited = np.full(2, np.inf)
    for i, (name, unit) in enumerate(
        zip(motion.state_names, motion.state_units, strict=True)
    ):
        group, _, entry = name.partition(".")
        wheel = group in _OF_MODES and entry in motion.wheels
        kinds = [(group, unit, 1.0)]
        if wheel:
            kinds = [
                ("speed", unit, 1.0),
                ("momentum", "N m s", inertias.get(entry, 0.0)),
            ]
        for kind, of_kind, size in kinds:
            if size and not (wheel and group == "q_m"):
                bounds = size * limits.get(name, unlimited)
                values = size * motion.x[:, i]
                linear = None if motion.linear is None else size * motion.linear[:, i]
                target = size * motion.target[:, i] if motion.tracked else None
                yield Curve(name, kind, name, of_kind, values, bounds, linear, target)
    inputs = zip(
        input_keys(motion),
        motion.input_names,
        motion.input_units,
        motion.u.T,
        strict=True,
    )
    for key, name, unit, column in inputs:
        bounds = limits.get(name, unlimited)
        yield Curve(key, group_of_input(motion, key), name, unit, column, bounds)


def group_of_input(motion: Motion, key: str) -> str:
    """Return the group of an input GROUP.NAME, which is "wheel" for the motor of any wheel."""
    group, _, name = key.partition(".")
    if group == "tau_m" and name in motion.wheels:
        return "wheel"
    return group


class Passed(NamedTuple):
    """Limit violation: the value that is farthest beyond the limit, its time, and the limit."""

    name: str
    value: float
    time: float
    limit: float
    unit: str
    at_first: bool  # True if a joint is beyond its position limit from the start

    def __str__(self) -> str:
        value = f"{_shown(self.value)} {self.unit}".removesuffix(" 1")
        text = f"{_name(self.name)} {value} at {_shown(self.time)} s, limit {_shown(self.limit)}"
        if self.at_first:
            text += ", from the start"
        return text


class Saturated(NamedTuple):
    """Saturation of an input or wheel speed: the limit, and the fraction of time at the limit."""

    name: str
    limit: float
    unit: str
    share: float

    def __str__(self) -> str:
        size = f"{_shown(self.limit)} {self.unit}"
        return f"{_name(self.name)} at its limit of {size} for {_percent(self.share)} % of the run"


def passed(t: Array, signals: Iterable[Curve]) -> tuple[Passed, ...]:
    """Return the limit violations, largest relative violation first."""
    worst = []
    for curve in signals:
        if curve.group == "momentum" or not curve.levels:
            continue
        size, (low, high) = max(map(abs, curve.levels)), curve.limits
        excess = np.maximum(low - curve.values, curve.values - high)
        beyond = excess > max(_SHARE * size, 1e-12)
        at = int(excess.argmax())
        if beyond[at]:
            value = float(curve.values[at])
            first = curve.group == "q_m" and bool(beyond[0])
            limit = high if value > high else low
            one = Passed(
                curve.name, value, float(t[at]), float(limit), curve.unit, first
            )
            worst.append((-excess[at] / (size or 1e-12), one))
    return tuple(one for _, one in sorted(worst))


def saturated(
    t: Array, signals: Iterable[Curve], pulsed: Collection[str] = ()
) -> tuple[Saturated, ...]:
    """Return the inputs and wheel speeds that reach a nonzero limit, longest saturation first.

    The inputs in `pulsed` are thrusters that are off or on, so a pulse at the limit does not
    count as saturation.
    """
    held, full = np.diff(t, append=t[-1:]), list[Saturated]()
    for curve in signals:
        # Inputs are clipped exactly at their limits. Wheel speeds only approach their limits, and
        # therefore need a larger margin.
        margin = 1e-3 if curve.group == "speed" else 1e-9
        enforced = curve.group not in (*STATES, "momentum") and curve.name not in pulsed
        if not enforced:
            continue
        for limit in curve.levels:
            # A speed whose limit is not enforced passes it, and is not held there.
            beyond = curve.values * np.sign(limit) > (1.0 + margin) * abs(limit)
            if curve.group == "speed" and beyond.any():
                continue
            spent = held[np.abs(curve.values - limit) <= margin * abs(limit)]
            if limit and spent.any():
                share = float(spent.sum() / held.sum())
                full.append(Saturated(curve.name, limit, curve.unit, share))
    return tuple(sorted(full, key=lambda item: -item.share))


class Firings(NamedTuple):
    """Use of the thrusters in a motion; `pulses` is None if not every step is recorded."""

    pulses: int | None
    impulse: float  # [N s], sum of all thrusters
    # [kg]; None if a thruster that fires has no specific impulse
    propellant: float | None

    def __str__(self) -> str:
        text = f"thrusters: impulse {_shown(self.impulse)} N s"
        if self.pulses:
            text += f" in {self.pulses} pulses"
        if self.propellant is not None:
            text += f", propellant {_shown(self.propellant)} kg"
        return text


def firings(motion: Motion) -> Firings | None:
    """Return the pulses, impulse and propellant of the thrusters, or None without thrusters.

    Inputs are constant from one row to the next, so the impulse is exact if every step is recorded.
    """
    keys = input_keys(motion)
    at = [i for i, key in enumerate(keys) if group_of(key) == "thrust"]
    if not at:
        return None
    held = np.diff(motion.t)
    thrusts = motion.u[:-1, at]
    impulses = held @ thrusts
    thrusters = thrusters_of(motion)
    names = [motion.input_names[i] for i in at]
    pulsed = [
        x in thrusters and bool(thrusters[x].on_off or thrusters[x].least_impulse)
        for x in names
    ]
    on = thrusts[:, pulsed] > 0.0
    starts = np.count_nonzero(on[1:] & ~on[:-1]) + np.count_nonzero(on[:1])
    every = not motion.step or bool((held <= 1.5 * motion.step).all())
    exhaust = []
    for name in names:
        specific_impulse = thrusters[name].isp if name in thrusters else None
        exhaust.append(_GRAVITY * (specific_impulse or 0.0))
    fired = impulses > 0.0
    speeds = np.array(exhaust)[fired]
    propellant = None
    if len(speeds) and speeds.all():
        propellant = float((impulses[fired] / speeds).sum())
    pulses = int(starts) if every and any(pulsed) else None
    return Firings(pulses, float(impulses.sum()), propellant)


def thrusters_of(motion: Motion) -> dict[str, Thruster]:
    """Return the thrusters of a motion by their names; empty if its robot is not known."""
    if motion._robot is None:
        return {}
    inputs = motion._robot.named_inputs
    return {names[0]: item for item, names in inputs if isinstance(item, Thruster)}


def pulse_thrusters(motion: Motion) -> frozenset[str]:
    """Return the names of the thrusters that are off or on; empty if the robot is not known."""
    return frozenset(
        name for name, thruster in thrusters_of(motion).items() if thruster.on_off
    )


def _name(name: str) -> str:
    group, _, entry = name.partition(".")
    if group in _OF_MODES:
        return entry
    return name


def _percent(share: float) -> str:
    if share < 0.1:
        return f"{100.0 * share:.2g}"
    return f"{100.0 * share:.0f}"


def _shown(value: float) -> str:
    if abs(value) < 1000.0:
        return f"{value:.3g}"
    return f"{value:.0f}"


def settled_at(sizes: Array) -> Indices:
    """Return the row at which each error in `sizes` (N, ...) settles, or N if it never settles."""
    outside = sizes > np.maximum(SETTLED * sizes.max(axis=0), THERE)
    first = len(sizes) - outside[::-1].argmax(axis=0)
    return np.where(outside.any(axis=0), first, 0)


def is_late(settled: Array | Indices | int, count: int) -> Mask | bool:
    """Return whether errors settle too close to the end of a run of `count` rows.

    Such errors count as not settled, because they may just be passing through zero.
    """
    return settled > (1.0 - DWELL) * count


class ErrorSize(NamedTuple):
    """Initial, largest and final size of one kind of error in a motion, such as attitude errors."""

    title: str
    unit: str
    initial: float
    largest: float
    final: float
    # time [s] from which the error is settled; None if too late or never
    settled: float | None
    steered: bool  # whether the policy feeds the error back
    # "remains" or "grows" at the end of the run; empty if the error decays
    tail: str = ""

    @property
    def scale(self) -> tuple[str, float]:
        """Unit in the report, and its factor: angles are in deg, wheel speeds in rad/s."""
        if self.title == WHEEL_SPEEDS:
            return self.unit, 1.0
        return DEGREES.get(self.unit, (self.unit, 1.0))

    @property
    def last(self) -> str:
        """Title, final value and unit of this error as text."""
        unit, factor = self.scale
        return f"{self.title}\u00a0{factor * self.final:.2g}\u00a0{unit}"

    @property
    def row(self) -> list[str]:
        """Cells of the table for this error."""
        when = "not yet" if self.steered else "not controlled"
        if self.settled is not None:
            when = f"{self.settled:.3g}" if self.largest > THERE else "."
        return [*self.cells(self.initial, self.largest, self.final), when]

    def cells(self, *sizes: float) -> list[str]:
        """Return the first cells of a table for this error: title, unit and sizes."""
        unit, factor = self.scale
        return [self.title, unit, *_cells(*sizes, factor=factor)]


def _cells(*values: float, factor: float = 1.0) -> list[str]:
    return ["." if value < _NOTHING else f"{factor * value:.3g}" for value in values]


def error_sizes(motion: Motion) -> list[ErrorSize]:
    """Return the sizes of each kind of error, or an empty list if the motion has no target.

    The size of the attitude error is an angle [deg]. For every other kind, the size is the largest
    absolute error of the states of this kind. Wheel speeds and modes are separate kinds, and not
    counted as joints. Wheel angles are excluded, because nothing depends on them.
    """
    if motion.error is None or motion.attitude_error is None:
        return []
    steered = set(motion.steered or motion.state_names)
    sizes = np.abs(motion.error)
    errors = []
    kinds: dict[tuple[str, str], list[int]] = {}
    for i, (name, unit) in enumerate(
        zip(motion.state_names, motion.state_units, strict=True)
    ):
        group, _, entry = name.partition(".")
        title = _TITLES.get(group, group)
        if group == "q_m" and entry in motion.wheels:
            continue
        if group == "qdot_m" and entry in motion.wheels:
            title = WHEEL_SPEEDS
        if group in _OF_MODES and entry in motion.modes:
            title = _OF_MODES[group][not unit.startswith(_MODAL)]
        shown_unit = "deg" if group == "q_b" else unit
        kinds.setdefault((title, shown_unit), []).append(i)
    for (title, unit), indices in kinds.items():
        size = (
            motion.attitude_error
            if title == "attitude"
            else sizes[:, indices].max(axis=1)
        )
        fed_back = any(motion.state_names[i] in steered for i in indices)
        fed_back &= title not in ("position", "v_b") or pushed(motion)
        at = int(settled_at(size))
        settled = None if is_late(at, len(size)) else motion.t[at]
        sizes_of_kind = size[0], size.max(), size[-1]
        errors.append(
            ErrorSize(title, unit, *sizes_of_kind, settled, fed_back, _tail(size))
        )
    return errors


def _tail(size: Array) -> str:
    """Return whether an error (N,) remains or grows in the last rows of a run, or ""."""
    # The last three windows are compared by their largest errors, so that an oscillation about a
    # constant error counts as one that remains. An error that rises only in the last window may be
    # an overshoot.
    rows = max(int(_TAIL * len(size)), 1)
    last = size[-rows:]
    before = size[-2 * rows : -rows]
    earlier = size[-3 * rows : -2 * rows]
    if not len(earlier):
        return ""
    if last.max() <= max(_SEEN * size.max(), THERE):
        return ""
    rises = last.min() >= before.max() and before.min() >= earlier.max()
    if rises and last.max() > _GROWS * before.max():
        return "grows"
    largest = max(before.max(), earlier.max())
    if largest <= _GROWS * last.max() and last.max() <= _GROWS * largest:
        return "remains"
    return ""


def pushed(model: object) -> bool:
    """Return whether a motion or actuation has inputs that exert a force on the base."""
    return not {"F_b", "thrust"}.isdisjoint(map(group_of, input_keys(model)))


def motion_parts(motion: Motion, page: str) -> list[str]:
    """Return the report as parts of a card in HTML, one of which is `page`."""
    kinds = error_sizes(motion)
    head, *lines = _heading(motion, kinds)
    return [
        html.verdict(head, _outcome(motion, kinds)),
        *(html.paragraph(line, "note") for line in lines),
        page,
        html.folded("report", html.preformatted(motion_report(motion))),
    ]


def _outcome(motion: Motion, kinds: list[ErrorSize]) -> bool | None:
    """Return whether a motion settled; None if it has no fixed target."""
    if motion.stopped:
        return False
    if rates := _rates(motion):
        if rates.is_short:
            return None
        return bool(np.isfinite(rates.slow_after(rates.bound)))
    if motion.tracked or not kinds:
        return None
    return all(kind.settled is not None for kind in _judged(kinds))


def _judged(kinds: list[ErrorSize]) -> list[ErrorSize]:
    """Return the errors that decide whether a motion has settled."""
    steered = [kind for kind in kinds if kind.steered]
    places = [kind for kind in steered if kind.title in _PLACES]
    return places or [kind for kind in steered if kind.title not in _ALL_OF_MODES]


def motion_report(motion: Motion) -> str:
    """Return a text about settling, inputs, limit violations and conserved quantities."""
    kinds = error_sizes(motion)
    parts = [folded(_heading(motion, kinds))]
    if kinds:
        rows = [["error", "unit", "initial", "largest", "final"]]
        rows[0].append(f"settles to {100.0 * SETTLED:g} % at [s]")
        rows += [kind.row for kind in kinds]
    else:
        rows = [["change from the start", "unit", "largest", "final"]]
        for kind in error_sizes(replace(motion, target=motion.x[0])):
            if kind.title in (*_PLACES, *_OF_MODES["q_m"]):
                rows.append(kind.cells(kind.largest, kind.final))
    parts.append(f"\n{grid(rows, 'll')}\n")
    if motion.modes:
        parts.append(_largest_modes(motion))
    if kinds or motion.u.any():
        parts.append(_largest_inputs(motion))
    parts += _largest_forces(motion)
    limit_messages = [
        *(f"limit exceeded: {violation}" for violation in motion.passed),
        *map(str, motion.saturated),
    ]
    if fired := firings(motion):
        parts.append(folded([str(fired)]))
    if limit_messages:
        shown_messages = limit_messages[:_MOST]
        if len(limit_messages) > _MOST:
            shown_messages.append(f"and {len(limit_messages) - _MOST} more")
        parts.append(folded(shown_messages))
    if motion.phases:
        parts += [f"\n{grid(_phases(motion), 'll')}", _OF_PHASES, ""]
    first, last = motion.energy[[0, -1]]
    kept = f"{motion.kept} drift {motion.momentum_drift.max():.1e}".replace(
        " ", "\u00a0"
    )
    parts.append(folded([f"energy: initial {first:.6g} J, final {last:.6g} J; {kept}"]))
    if len(motion.com_drift):
        far = f"{motion.com_drift.max():.1e} m"
        parts.append(
            f"largest deviation of the centre of mass from its predicted path: {far}"
        )
    parts += _largest_difference(motion)
    return "\n".join(parts)


def _largest_difference(motion: Motion) -> list[str]:
    """Return a line with the largest difference from the linear prediction, if there is one."""
    if motion.linear is None:
        return []
    apart = np.abs(motion.x - motion.linear).max(axis=0)
    # Wheel angles are excluded: they grow without bound, and nothing depends on them.
    apart[[motion.state_names.index(f"q_m.{name}") for name in motion.wheels]] = 0.0
    most = int(apart.argmax())
    name, unit = motion.state_names[most], motion.state_units[most]
    factor = 1.0
    if name.partition(".")[2] not in motion.wheels:
        unit, factor = DEGREES.get(unit, (unit, 1.0))
    size = f"{factor * apart[most]:.3g} {unit}".removesuffix(" 1")
    return [f"largest difference from the linear model: {size} in {name}"]


def _largest_forces(motion: Motion) -> list[str]:
    """Return a line with the largest force and torque of each constraint."""
    lines = list[str]()
    columns = dict(
        zip(motion.constraint_names, motion.constraint_forces.T, strict=True)
    )
    # A name is the title of the constraint, "force" or "torque", and the axis.
    titles = dict.fromkeys(name.rsplit(".", 2)[0] for name in columns)
    for title in titles:
        sizes = list[float]()
        for kind in ("force", "torque"):
            parts = [columns[f"{title}.{kind}.{axis}"] for axis in "xyz"]
            sizes.append(float(np.linalg.norm(parts, axis=0).max()))
        line = (
            f"largest force of constraint '{title}': {sizes[0]:.4g} N; largest torque: "
            f"{sizes[1]:.4g} N m"
        )
        lines.append(folded([line]))
    return lines


def _heading(motion: Motion, kinds: list[ErrorSize]) -> list[str]:
    """Return the first lines of the report: the verdict, the run, the orbit and the notes."""
    results = []
    if (rates := _rates(motion)) and not motion.stopped:
        results.append(rates.summary())
    elif kinds or motion.stopped:
        results.append(verdict(motion, kinds))
    if fast := _fast_wheels(motion):
        results.append(fast)
    lines = []
    if results:
        lines.append("; ".join(results))
    t = motion.t
    run = f"{motion.robot}: {t[-1]:g} s"
    if motion.step:
        run += f" in steps of {motion.step:.3g} s"
    run += f", {len(t)} rows, frame {motion.frame}"
    if motion.engine == "compiled":
        run += ", compiled"
    lines.append(run)
    if motion.orbit:
        lines.append(str(motion.orbit))
    return [*lines, *motion.notes]


def _rates(motion: Motion) -> RotationRates | None:
    """Return the rotation rates of a motion whose controller only detumbles, or None."""
    if not motion._detumbling or motion.orbit is None:
        return None
    return RotationRates(motion.t, motion.q, motion.v, motion.frame, motion.orbit)


def motion_record(motion: Motion) -> dict[str, object]:
    """Return the values of the report as {name: value}, for --json."""
    t = motion.t
    copied = ["stopped", "frame", "engine", "step", "saturated", "notes"]
    copied += ["state_names", "state_units", "input_names", "input_units"]
    errors = error_sizes(motion)
    # The errors of revolute and of prismatic joints have the same title but different units. For a
    # robot with both kinds of joints, the unit is added to the title.
    count = Counter(error.title for error in errors)
    keys = []
    for error in errors:
        key = error.title
        if count[key] > 1:
            key += f" [{error.unit}]"
        keys.append(key)
    return {
        **{name: getattr(motion, name) for name in copied},
        "duration": t[-1],
        "rows": len(t),
        "errors": dict(zip(keys, errors, strict=True)),
        "x": motion.x[-1],
        "largest_inputs": np.abs(motion.u).max(axis=0),
        "thrusters": firings(motion),
        "limits_exceeded": motion.passed,
        "energy": motion.energy[[0, -1]],
        "momentum_drift": motion.momentum_drift.max(),
    }


def _phases(motion: Motion) -> list[list[str]]:
    """Return the table of phases; it has no impacts if the motion was read from a file."""
    table = [["phase", "", "t [s]", "energy [J]", "|p| [N s]", "|h| [N m s]"]]
    parts = motion._phases or motion.phases
    pairs = zip((None, *parts), parts, strict=False)
    struck = [before for before, part in pairs if not isinstance(part, Impact)]
    firsts = [
        0,
        *np.searchsorted(motion.t, motion.starts[1:], "right") - 1,
        len(motion.t),
    ]
    for k, (name, impact) in enumerate(zip(motion.phases, struck, strict=True)):
        # `lines` are the lines of the table for one phase: (label, index of a row of the motion,
        # energy to be added, momentum to be added). At an impact, the row of the motion contains
        # the values after the impact. So the line "before" adds the energy and the momentum that
        # the impact removes.
        lines = [("start", firsts[k], 0.0, np.zeros(6))]
        if isinstance(impact, Impact):
            gone = np.roll(impact.momentum - impact.momentum_after, 3)
            lines = [
                ("before", firsts[k], impact.energy_lost, gone),
                ("after", *lines[0][1:]),
            ]
        lines.append(("end", firsts[k + 1] - 1, 0.0, np.zeros(6)))
        for when, at, energy, momentum in lines:
            h, p = (motion.momentum[at] + momentum).reshape(2, 3)
            sizes = (
                motion.t[at],
                motion.energy[at] + energy,
                np.linalg.norm(p),
                np.linalg.norm(h),
            )
            shown = shorten(name, 28) if when == lines[0][0] else ""
            table.append([shown, when, *(f"{x:.4g}" for x in sizes)])
    return table


def verdict(motion: Motion, kinds: list[ErrorSize]) -> str:
    """Return one line that says when the motion settled, or which errors did not settle.

    The line also names the saturated inputs.
    """
    if motion.stopped:
        return f"stopped: {motion.stopped}"
    places = [kind for kind in kinds if kind.title in _PLACES]
    aside = [kind.last for kind in places if kind.settled is None and not kind.steered]
    text = _settling(motion, kinds, some_aside=bool(aside))
    if aside:
        text += f"; not controlled: {_and(aside)}"
    return f"{text}; saturated inputs: {_saturated_inputs(motion)}"


def _settling(motion: Motion, kinds: list[ErrorSize], *, some_aside: bool) -> str:
    """Return when the controlled errors of a motion settled, or which of them did not settle.

    `some_aside` states whether other errors of the pose are not controlled.
    """
    judged = _judged(kinds)
    if motion.tracked and not motion.phases:
        return f"tracking errors at the end: {_and([kind.last for kind in judged])}"
    moved = [kind for kind in judged if kind.largest > THERE]
    failed = [kind.last for kind in moved if kind.settled is None]
    if failed:
        return f"not settled: {_and(failed)} off target"
    if moved:
        return _settled_after(kinds, judged, moved)
    subject = ""
    if some_aside:
        subject = f"{_and([kind.title for kind in judged])} "
    return f"settled: {subject}at the target throughout the run"


def _settled_after(
    kinds: list[ErrorSize], judged: list[ErrorSize], moved: list[ErrorSize]
) -> str:
    """Return the settling time of the errors in `moved`, their band, and what remains."""
    when = max(kind.settled or 0.0 for kind in moved)
    bands = []
    for kind in moved:
        unit, factor = kind.scale
        size = SETTLED * factor * kind.largest
        bands.append(f"{size:.2g}\u00a0{unit} ({kind.title})")
    text = f"settled after {when:.3g}\u00a0s to within {_and(bands)} of the target"
    late = [kind.last for kind in kinds if kind.settled is None and kind.steered]
    if late:
        subject = "positions" if judged[0].title in _PLACES else "rates"
        text = f"{subject} {text}; not yet settled: {_and(late)}"
    for tail, trend in (("remains", "remaining"), ("grows", "drifting")):
        left = [kind.last for kind in moved if kind.tail == tail]
        if left:
            text += f"; {trend}: {_and(left)}"
    return text


def _saturated_inputs(motion: Motion) -> str:
    """Return the saturated inputs, each with the percentage of the run at a limit, or "none"."""
    fractions: dict[str, float] = {}
    for item in motion.saturated:
        fractions[item.name] = fractions.get(item.name, 0.0) + item.share
    texts = [
        f"{name}\u00a0({_percent(fraction)}\u00a0%)"
        for name, fraction in fractions.items()
    ]
    shown = texts[:_NAMED]
    if len(texts) > _NAMED:
        shown.append(f"{len(texts) - _NAMED} more")
    return ", ".join(shown) or "none"


# {unit of an error: unit and factor in the heading of a page}
_PAGE_UNITS = {**DEGREES, "m": ("mm", 1e3)}


def _in_deg_mm(kind: ErrorSize) -> str:
    """Return the title and the final value of an error as text, in deg or mm."""
    unit, factor = _PAGE_UNITS.get(kind.unit, (kind.unit, 1.0))
    return f"{kind.title} {factor * kind.final:.2g} {unit}"


def _initial_to_final(kind: ErrorSize) -> str:
    """Return the title of an error, and its initial and final value; negligible values are 0."""
    unit, factor = _PAGE_UNITS.get(kind.unit, (kind.unit, 1.0))
    negligible = max(_GONE * kind.largest, THERE)
    ends = []
    for size in (kind.initial, kind.final):
        shown = f"{factor * size:.3g}" if size > negligible else "0"
        ends.append(f"{shown} {unit}")
    return f"{kind.title} {ends[0]} to {ends[1]}"


def headline(motion: Motion) -> str:
    """Return a line for the page of a motion: what moves the robot, and how the motion ends."""
    parts = [motion._about] if motion._about else []
    if (rates := _rates(motion)) and not motion.stopped:
        return ", ".join((*parts, *rates.parts()))
    kinds = [kind for kind in error_sizes(motion) if kind.title in _PLACES]
    judged = [kind for kind in kinds if kind.steered and kind.largest > THERE]
    if judged and not motion.tracked:
        parts.append(_initial_to_final(judged[0]))
    if motion.stopped:
        parts.append(f"stopped: {motion.stopped}")
    elif motion.tracked and judged:
        parts.append(
            f"errors at the end: {_and([_in_deg_mm(kind) for kind in judged])}"
        )
    elif late := [kind.title for kind in judged if kind.settled is None]:
        parts.append(f"{_and(late)} not settled")
    elif judged:
        when = max(kind.settled or 0.0 for kind in judged)
        parts.append(f"settled after {when:.3g} s")
    elif kinds and any(kind.steered for kind in kinds):
        parts.append("at the target throughout")
    return ", ".join(parts).replace("\u00a0", " ")


def _fast_wheels(motion: Motion) -> str:
    """Return a line about the wheels that exceed their largest speeds, or an empty text."""
    speeds = {f"qdot_m.{name}" for name in motion.wheels}
    fast = [
        f"{_name(violation.name)}\u00a0{_shown(violation.value)}\u00a0{violation.unit} "
        f"(limit\u00a0{_shown(violation.limit)})"
        for violation in motion.passed
        if violation.name in speeds
    ]
    if not fast:
        return ""
    return f"wheel speed limit exceeded: {_and(fast)}"


def _and(words: list[str]) -> str:
    if len(words) > 1:
        words = [", ".join(words[:-1]), words[-1]]
    return " and ".join(words)


def _largest_modes(motion: Motion) -> str:
    """Return a table with each mode's largest amplitude, and the rotation at this amplitude."""
    rows = [["mode", "unit", "largest", "rotation [deg]", "at [s]"]]
    far = []
    for name, rotation in zip(
        motion.modes, motion.mode_rotations.tolist(), strict=True
    ):
        at = motion.state_names.index(f"q_m.{name}")
        size = np.abs(motion.x[:, at])
        unit = motion.state_units[at]
        degrees = float(np.degrees(rotation * size.max()))
        rows.append(
            [name, unit, *_cells(size.max(), degrees), f"{motion.t[size.argmax()]:.3g}"]
        )
        if degrees > _LINEAR and unit == _MODAL:
            far.append(f"{name}\u00a0{degrees:.3g}\u00a0deg")
    table = f"{grid(rows, 'll')}\n"
    if not far:
        return table
    warning = (
        "warning: the motion is not accurate, because the model is linear in the modal "
        f"amplitudes, but some amplitudes bend the structure by more than {_LINEAR:g} deg: "
        f"{_and(far)}"
    )
    return f"{table}\n{folded([warning])}"


def _largest_inputs(motion: Motion) -> str:
    largest = np.abs(motion.u).max(axis=0)
    kinds: dict[tuple[str, str], float] = {}
    for name, unit, value in zip(
        input_keys(motion), motion.input_units, largest, strict=True
    ):
        if value >= _NOTHING:
            key = (group_of_input(motion, name), unit.replace(" ", "\u00a0"))
            kinds[key] = max(kinds.get(key, 0.0), float(value))
    shown = [
        f"{name}\u00a0{value:.4g}\u00a0{unit}" for (name, unit), value in kinds.items()
    ]
    # Non-breaking spaces keep a name, its value and the unit on one line.
    return folded([f"largest inputs: {', '.join(shown) or 'none'}"])
