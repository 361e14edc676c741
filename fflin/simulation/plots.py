"""Curves of a motion, and its figure with matplotlib: states, inputs, errors and drifts."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from fflin.base.errors import InputError
from fflin.base.figures import COLORS, cycle, drawing
from fflin.base.names import chosen, input_keys
from fflin.base.validation import Array
from fflin.dynamics.coordinates import moving_errors

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    from fflin.simulation.motion import Motion

_OF_JOINTS = ("q_m", "qdot_m")
_MOST_IN_A_PANEL, _ACROSS = 6, 3
_PALE: dict[str, Any] = {"lw": 3.6, "alpha": 0.3}  # style of a reference, below the motion
_DASHED: dict[str, Any] = {"ls": "--", "lw": 1.0}  # style of a prediction, above the motion
_GROUPS = {
    "q_b": "attitude q_b",
    "r_b": "position r_b",
    "q_m": "joints q_m",
    "omega_b": "angular velocity omega_b",
    "v_b": "velocity v_b",
    "qdot_m": "joint rates qdot_m",
}
_WHEELS = {"speed": "wheel speeds", "wheel": "wheel torques", "momentum": "wheel momenta"}


# A limit is drawn if the curve reaches this fraction of the limit.
_NEAR = 1.0 / 3.0

# A target that moves less than this between rows, in SI units, is at rest.
_STILL = 1e-12


class Curve(NamedTuple):
    """Values (N,) of a state or input, limits (2,), and any prediction and reference (N,)."""

    key: str  # GROUP.NAME
    group: str  # "speed" and "momentum" of wheels
    name: str
    unit: str
    values: Array
    limits: Array
    linear: Array | None = None
    reference: Array | None = None

    @property
    def short(self) -> str:
        """Name without its group."""
        return self.name.partition(".")[2] or self.name

    @property
    def near(self) -> list[float]:
        """Limits that the values come close to."""
        levels: list[float] = self.limits[np.isfinite(self.limits)].tolist()
        return [level for level in levels if level and (self.values / level).max() >= _NEAR]


def curves(motion: Motion, wheels: Mapping[str, float]) -> Iterator[Curve]:
    """Yield curves of states, inputs, and speed and momentum of wheels {name: inertia or 0}."""
    limits = dict(zip(motion.limit_names, motion.limits, strict=True))
    unlimited = np.full(2, np.inf)
    for i, (name, unit) in enumerate(zip(motion.state_names, motion.state_units, strict=True)):
        group, _, entry = name.partition(".")
        linear, reference = (
            None if x is None else x[:, i]
            for x in (motion.linear, motion.target if motion.tracked else None)
        )
        values = motion.x[:, i], limits.get(name, unlimited), linear, reference
        if group not in ("q_m", "qdot_m") or entry not in wheels:
            yield Curve(name, group, name, unit, *values)
        elif group == "qdot_m":
            yield Curve(name, "speed", name, unit, *values)
            if size := wheels[entry]:
                momenta: Any = (None if x is None else size * x for x in values)
                yield Curve(name, "momentum", name, "N m s", *momenta)
    inputs = zip(
        input_keys(motion), motion.input_names, motion.input_units, motion.u.T, strict=True
    )
    for key, name, unit, column in inputs:
        yield Curve(key, key.partition(".")[0], name, unit, column, limits.get(name, unlimited))


def resting_from(motion: Motion) -> float | None:
    """Return the time [s] from which a moving target is at rest, or None."""
    places = motion.target[:, : motion.x.shape[1] // 2] if motion.tracked else motion.x[:1]
    moved = np.flatnonzero(np.abs(np.diff(places, axis=0)).max(axis=1, initial=0.0) > _STILL)
    if not len(moved) or moved[-1] + 2 >= len(places):
        return None
    return float(motion.t[moved[-1] + 1])


def draw_motion(motion: Motion, path: str | Path | None, show: Sequence[str] | None) -> Figure:
    """Draw a motion; see `plot_motion`."""
    states, panels = _selected(motion, show)
    what, errors = _errors(motion)
    per_row = [3.0, 1.2][: 1 + bool(errors)]  # heights of states and of their errors below
    heights = per_row * math.ceil(len(states) / _ACROSS)
    above = len(heights)
    heights += [3.0] * math.ceil((len(panels) + 1) / _ACROSS)  # rows of panels, including the drift
    with drawing(path, 11.0, 0.3 + sum(heights)) as figure:
        grid = figure.add_gridspec(len(heights), _ACROSS, height_ratios=heights, hspace=0.06)
        joints: dict[str, Line2D] = {}
        for place, (group, found) in enumerate(states.items()):
            row, column = divmod(place, _ACROSS)
            axes = figure.add_subplot(grid[row * len(per_row), column])
            _draw(axes, motion.t, found, _GROUPS[group])
            if place == 0 and motion.tracked:
                axes.plot([], [], color="#888888", **_PALE, label="reference")
            joints |= _named(axes) if group in _OF_JOINTS else {}
            if group not in _OF_JOINTS:
                axes.legend(handlelength=1.2)
            if errors:
                strip = figure.add_subplot(grid[2 * row + 1, column], sharex=axes)
                _draw(strip, motion.t, [errors[curve.key] for curve in found], lw=1.0)
                strip.set_ylabel(f"{what}\n{strip.get_ylabel()}".strip())
                strip.ticklabel_format(axis="y", scilimits=(-2, 3))
                axes.tick_params(labelbottom=False)
                axes.set_xlabel("")
        spots = [grid[above + k // _ACROSS, k % _ACROSS] for k in range(len(panels) + 1)]
        _draw_panels(figure, spots, motion.t, panels, joints if "q_m" in states else None)
        rest = None if motion.phases else resting_from(motion)
        marks = [*motion.starts[1:].tolist(), *([] if rest is None else [rest])]
        for axes, mark in product(figure.axes, marks):
            axes.axvline(mark, lw=0.8, ls=":", color="#555555", label="_rest")
        _drifts(figure.add_subplot(spots[-1]), motion)
        for axes in figure.axes:
            axes.margins(x=0.0)
        figure.suptitle(_title(motion), fontsize=11)
    return figure


def _selected(
    motion: Motion, show: Sequence[str] | None
) -> tuple[dict[str, list[Curve]], dict[str, list[Curve]]]:
    """Return the chosen states by group, and chosen inputs, wheel speeds and momenta by title."""
    names = (*motion.state_names, *input_keys(motion))
    show = [show] if isinstance(show, str) else show
    if not (show is None or isinstance(show, Sequence)):
        raise InputError(f"show is {show!r}, expected a list of names, groups or patterns")
    keys = names if show is None else [names[i] for i in chosen("state or input", show, names)]
    wheels = dict.fromkeys(motion.wheels, 0.0)
    wheels |= dict(zip(motion.wheels, motion.wheel_inertias.tolist(), strict=False))
    states: dict[str, list[Curve]] = {}
    panels: dict[str, list[Curve]] = {}
    for curve in curves(motion, wheels):
        if curve.key in keys and curve.group in _GROUPS:
            states.setdefault(curve.group, []).append(curve)
        elif curve.key in keys:
            panels.setdefault(_panel_of(curve, wheels), []).append(curve)
    for title in _WHEELS.values():  # panels of wheels come last
        panels |= {title: panels.pop(title)} if title in panels else {}
    return states, panels


def _draw_panels(
    figure: Figure,
    spots: Any,
    t: Array,
    panels: Mapping[str, list[Curve]],
    joints: dict[str, Line2D] | None,
) -> None:
    """Draw panels of inputs and wheels, with the legends for joints and large panels below."""
    lines = joints or {}
    colors = {name: line.get_color() for name, line in lines.items()}
    for place, (title, found) in enumerate(panels.items()):
        axes = figure.add_subplot(spots[place])
        steps = "default" if found[0].group in ("speed", "momentum") else "steps-post"
        _draw(axes, t, found, title, colors, drawstyle=steps)
        if title.startswith("joint"):
            lines |= {name: x for name, x in _named(axes).items() if name == "limit"}
        elif len(found) > _MOST_IN_A_PANEL:
            _below(figure, _named(axes), title, "center" if joints is None else "right")
        else:
            if many := len(found) > 3:
                axes.margins(y=0.3)  # room for the names above the curves
            axes.legend(ncols=2 if many else 1, handlelength=1.6)
    if joints is not None:
        # Put one legend below, because three panels show the same joints and joint names are long.
        limit = {"limit": lines.pop("limit")} if "limit" in lines else {}
        _below(figure, lines | limit, "joints", "left" if figure.legends else "center")


def _title(motion: Motion) -> str:
    parts = [f"{motion.robot}: {motion.t[-1]:g} s, frame {motion.frame}"]
    if motion.linear is not None:
        parts.append("solid: nonlinear, dashed: linear")
    for name, start in zip(motion.phases[1:], motion.starts[1:], strict=True):
        parts.append(f"{name} at {start:g} s")
    return "; ".join(parts) + (f"\n{motion.stopped}" if motion.stopped else "")


def _panel_of(curve: Curve, wheels: Mapping[str, float]) -> str:
    """Return the title of the panel of an input, or of speeds and momenta of wheels."""
    if curve.group in ("speed", "momentum") or curve.short in wheels:
        return _WHEELS[curve.group]
    if curve.group == "tau_m":  # most robots have only revolute or only prismatic joints
        return "joint inputs tau_m" if curve.unit == "N m" else "joint forces tau_m"
    return "torques" if curve.unit == "N m" else "forces"


def _errors(motion: Motion) -> tuple[str, dict[str, Curve]]:
    """Return the errors from a reference (attitude in degrees), or else from the linear model."""
    names, units, linear = motion.state_names, motion.state_units, motion.linear
    rows, what = [], "error"
    if motion.tracked:
        units = ("deg",) * 3 + units[3:]
        e = moving_errors(motion.frame, motion.x, motion.target)
        sines = np.minimum(1.0, np.linalg.norm(e[:, :3], axis=1, keepdims=True))
        e[:, :3] *= np.degrees(2.0 / np.sinc(np.arcsin(sines) / np.pi))
        rows = [e.T]
    elif linear is not None:
        what, rows = "difference", [(motion.x - linear).T]
    none = np.zeros(0)
    of = zip(names, units, *rows, strict=True) if rows else ()
    return what, {name: Curve(name, "", name, unit, x, none, *y) for name, unit, x, *y in of}


def _draw(
    axes: Axes,
    t: Array,
    found: Sequence[Curve],
    title: str = "",
    colors: Mapping[str, Any] | None = None,
    **look: Any,
) -> None:
    """Draw curves, their references (pale), predictions (dashed) and limits."""
    if found[0].group == "q_b":
        found = _with_gaps(found)
    full = title and found[0].group not in _GROUPS and title not in _WHEELS.values()
    for own, curve in zip(cycle(len(found)), found, strict=True):
        color = (colors or {}).get(curve.short, own)
        label = curve.name if full else curve.short
        if curve.reference is not None:
            axes.plot(t, curve.reference, color=color, **_PALE)
        axes.plot(t, curve.values, color=color, label=label, **look)
        if curve.linear is not None:
            axes.plot(t, curve.linear, color=color, **_DASHED)
    levels = sorted({level for curve in found for level in curve.near})
    for level in levels:
        label = "limit" if level == levels[-1] else "_limit"
        axes.axhline(level, ls="--", lw=0.9, color="#555555", label=label)
    units = ", ".join(sorted({curve.unit for curve in found} - {"1"}))
    axes.set(title=title, xlabel="t [s]", ylabel=units and f"[{units}]")


def _with_gaps(found: Sequence[Curve]) -> list[Curve]:
    """Return attitudes with gaps at 180 degrees, where the quaternion changes its sign."""
    broken = list(found)
    for field in ("values", "linear", "reference"):
        if getattr(found[0], field) is not None:
            rows = np.array([getattr(each, field) for each in found])
            rows[:, 1:][:, (rows[:, 1:] * rows[:, :-1]).sum(axis=0) < -0.5] = np.nan
            broken = [c._replace(**{field: row}) for c, row in zip(broken, rows, strict=True)]
    return broken


def _named(axes: Axes) -> dict[str, Line2D]:
    """Return {label: line} of the lines with a label."""
    return {str(x.get_label()): x for x in axes.get_lines() if str(x.get_label())[0] != "_"}


def _below(figure: Figure, lines: Mapping[str, Line2D], title: str, side: str) -> None:
    """Add a legend below all panels, with as many columns as fit."""
    letters = 150 if side == "center" else 75
    columns = min(len(lines), 8, max(1, letters // (max(map(len, lines)) + 6)))
    place: Any = f"outside lower {side}"
    named = list(lines.values())
    figure.legend(handles=named, loc=place, ncols=columns, handlelength=1.6, title=title)


def _drifts(axes: Axes, motion: Motion) -> None:
    # A logarithmic axis has no zero, so smaller drifts are raised to the machine epsilon.
    drifts = {motion.kept: motion.momentum_drift, "centre of mass [m]": motion.com_drift}
    shown = {k: np.maximum(v, np.finfo(float).eps / 10.0) for k, v in drifts.items() if len(v)}
    for color, (label, drift) in zip(COLORS, shown.items(), strict=False):
        axes.semilogy(motion.t, drift, color=color, label=label)
    axes.set(title=f"relative {next(iter(shown))} drift", xlabel="t [s]")
    axes.set_ylim(1e-17, max(1e-13, *(10.0 * float(drift.max()) for drift in shown.values())))
    axes.legend(handlelength=1.2)
