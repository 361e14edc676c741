"""Figures of motions, with matplotlib."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from fflin.base.figures import COLORS, cycle, drawing
from fflin.base.validation import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

_OF_JOINTS = ("q_m", "qdot_m")
_SMOOTH = ("wheel speeds", "wheel momenta")
_MOST_IN_A_PANEL = 6
_NEAR = 1.0 / 3.0  # share of a limit that a curve comes to where it is drawn
_PALE: dict[str, Any] = {"lw": 3.6, "alpha": 0.3}  # of a reference, below what follows it
_GROUPS = {
    "q_b": "attitude q_b",
    "r_b": "position r_b",
    "q_m": "joints q_m",
    "omega_b": "angular velocity omega_b",
    "v_b": "velocity v_b",
    "qdot_m": "joint rates qdot_m",
}


class Signals(NamedTuple):
    """Histories (N, k) with names GROUP.NAME, limits (2,), linear prediction and reference."""

    values: Array
    names: Sequence[str]
    units: Sequence[str]
    limits: Mapping[str, Array]
    linear: Array | None = None
    reference: Array | None = None

    def only(self, indices: Sequence[int]) -> Signals:
        """Return some of the columns."""
        names, units = ([of[i] for i in indices] for of in (self.names, self.units))
        beside = (None if x is None else x[:, indices] for x in (self.linear, self.reference))
        return Signals(self.values[:, indices], names, units, self.limits, *beside)

    def times(self, factors: Array, unit: str, limits: Mapping[str, Array]) -> Signals:
        """Return them times (k,), in that unit and with limits of it."""
        beside = (None if x is None else factors * x for x in (self.linear, self.reference))
        return Signals(factors * self.values, self.names, [unit] * len(factors), limits, *beside)

    def unit(self, indices: Sequence[int]) -> str:
        """Return the units of some columns in brackets."""
        shown = sorted({self.units[i] for i in indices} - {"1"})
        return f"[{', '.join(shown)}]" if shown else ""


class _Panel(NamedTuple):
    """Columns of signals under a title, all of one unit."""

    signals: Signals
    indices: list[int]


def draw(
    t: Array,
    states: Signals,
    inputs: Signals,
    wheels: Mapping[str, float],
    apart: tuple[str, Signals] | None,
    drifts: Mapping[str, Array],
    *,
    title: str,
    marks: Sequence[float] = (),
    path: str | Path | None = None,
) -> Figure:
    """Draw states, what they are `apart` from, inputs, `wheels` {name: inertia} and drifts."""
    groups: dict[str, list[int]] = {}
    for index, name in enumerate(states.names):
        group, _, entry = name.partition(".")
        if group not in _OF_JOINTS or entry not in wheels:
            groups.setdefault(group, []).append(index)
    panels = _panels(states, inputs, wheels)
    across = 3 if len(groups) > 4 else 4
    # With the drift, in as few rows of up to four as there can be.
    rows = math.ceil((len(panels) + 1) / 4)
    both = apart is not None
    heights = [3.0, 1.2][: 1 + both] * math.ceil(len(groups) / across) or [0.01]
    with drawing(path, 11.0, 0.3 + 3.0 * rows + 0.9 * sum(heights)) as figure:
        above, below = figure.add_gridspec(2, 1, height_ratios=[sum(heights), 3.0 * rows])
        spaces = {"hspace": 0.06, "wspace": 0.06}
        grid = above.subgridspec(len(heights), across, height_ratios=heights, **spaces)
        spots = below.subgridspec(rows, math.ceil((len(panels) + 1) / rows), **spaces)
        places = (spots[k] for k in range(len(panels) + 1))
        lines: dict[str, Line2D] = {}
        for place, (group, indices) in enumerate(groups.items()):
            row, column = divmod(place, across)
            axes = figure.add_subplot(grid[row * (1 + both), column])
            _histories(axes, t, states, group, indices, keyed=place == 0)
            if apart is not None:
                below_it = figure.add_subplot(grid[2 * row + 1, column], sharex=axes)
                _apart(below_it, t, *apart, indices)
                axes.tick_params(labelbottom=False)
            else:
                axes.set_xlabel("t [s]")
            if group in _OF_JOINTS:
                lines |= _named(axes)
        for what, panel in panels.items():
            axes = figure.add_subplot(next(places))
            _inputs(axes, t, panel, what, {name: x.get_color() for name, x in lines.items()})
            if what.startswith("joint"):
                lines |= {name: x for name, x in _named(axes).items() if name == "limit"}
            elif len(panel.indices) > _MOST_IN_A_PANEL:
                _below(figure, _named(axes), what, "right" if groups.get("q_m") else "center")
        if groups.get("q_m"):
            # Joints are many, have long names, and are the same in three panels.
            limit = {"limit": lines.pop("limit")} if "limit" in lines else {}
            _below(figure, lines | limit, "joints", "left" if figure.legends else "center")
        for axes, mark in product(figure.axes, marks):
            axes.axvline(mark, lw=0.8, ls=":", color="#555555", label="_rest")
        _drifts(figure.add_subplot(next(places)), t, drifts)
        for axes in figure.axes:
            axes.margins(x=0.0)
        figure.suptitle(title, fontsize=11)
    return figure


def _panels(states: Signals, inputs: Signals, wheels: Mapping[str, float]) -> dict[str, _Panel]:
    """Return what acts and how wheels turn, by title."""
    found: dict[str, _Panel] = {}
    for i, (name, unit) in enumerate(zip(inputs.names, inputs.units, strict=True)):
        title = "torques" if unit == "N m" else "forces"
        if name in wheels:
            title = "wheel torques"
        elif name.startswith("tau_m."):
            # Nearly always all turn, or all slide.
            title = "joint inputs tau_m" if unit == "N m" else "joint forces tau_m"
        found.setdefault(title, _Panel(inputs, [])).indices.append(i)
    speeds = [i for i, x in enumerate(states.names) if x in {f"qdot_m.{name}" for name in wheels}]
    if speeds:
        torques = {x: found.pop(x) for x in ("wheel torques",) if x in found}
        found |= {"wheel speeds": _Panel(states, speeds)} | torques
        J = np.array([wheels[_short(states.names[i])] for i in speeds])
        if J.all():
            names = [states.names[i] for i in speeds]
            limits = {x: J[k] * states.limits[x] for k, x in enumerate(names) if x in states.limits}
            momenta = states.only(speeds).times(J, "N m s", limits)
            found["wheel momenta"] = _Panel(momenta, list(range(len(J))))
    return found


def _histories(
    axes: Axes, t: Array, states: Signals, group: str, indices: list[int], *, keyed: bool
) -> None:
    for color, i in zip(cycle(len(indices)), indices, strict=True):
        gaps = indices if group == "q_b" else []
        _curve(axes, t, states, i, gaps, color=color, label=_short(states.names[i]))
    _limits(axes, states, indices)
    axes.set(title=_GROUPS[group], ylabel=states.unit(indices))
    if keyed and states.reference is not None:
        axes.plot([], [], color="#888888", **_PALE, label="reference")
    if group not in _OF_JOINTS:
        axes.legend(handlelength=1.2)


def _curve(
    axes: Axes, t: Array, of: Signals, i: int, gaps: Sequence[int] = (), **look: Any
) -> None:
    """Draw a column over its pale reference, and the linear prediction dashed on top."""
    dashed = {"ls": "--", "lw": 1.0}
    for x, own in ((of.reference, _PALE), (of.values, look), (of.linear, dashed)):
        if x is not None:
            times, shown = _broken(t, x, gaps) if gaps else (t, x)
            axes.plot(times, shown[:, i], **{"color": look["color"]} | own)
    if of.reference is not None:
        band = of.reference[:, i], of.values[:, i]
        # Across a half turn of the base one of them may have changed its sign already.
        near = None if not gaps else (of.reference[:, gaps] * of.values[:, gaps]).sum(axis=1) >= 0.0
        axes.fill_between(t, *band, where=near, color=look["color"], alpha=0.25, lw=0.0)


def _broken(t: Array, x: Array, indices: Sequence[int]) -> tuple[Array, Array]:
    """Return times and states with a gap where the attitude goes through a turn of 180 degrees."""
    q_b = x[:, indices]
    # The vector part of a unit quaternion whose sign has changed.
    jumps = 1 + np.flatnonzero((q_b[1:] * q_b[:-1]).sum(axis=1) < -0.5)
    return np.insert(t, jumps, t[jumps]), np.insert(x, jumps, np.nan, axis=0)


def _apart(axes: Axes, t: Array, title: str, signals: Signals, indices: list[int]) -> None:
    for color, i in zip(cycle(len(indices)), indices, strict=True):
        _curve(axes, t, signals, i, color=color, lw=1.0)
    axes.set(xlabel="t [s]", ylabel=f"{title}\n{signals.unit(indices)}".strip())
    axes.ticklabel_format(axis="y", scilimits=(-2, 3))


def _inputs(axes: Axes, t: Array, panel: _Panel, title: str, colors: Mapping[str, Any]) -> None:
    """Draw a panel, in which joints have their colours."""
    signals, indices = panel
    for color, i in zip(cycle(len(indices)), indices, strict=True):
        short = _short(signals.names[i])
        _curve(
            *(axes, t, signals, i),
            color=colors.get(short, color),
            drawstyle="default" if title in _SMOOTH else "steps-post",
            label=short if title.startswith("wheel") else signals.names[i],
        )
    _limits(axes, signals, indices)
    axes.set(title=title, xlabel="t [s]", ylabel=signals.unit(indices))
    if not title.startswith("joint") and len(indices) <= _MOST_IN_A_PANEL:
        axes.legend(ncols=2 if len(indices) > 3 else 1, handlelength=1.6)


def _limits(axes: Axes, signals: Signals, indices: Sequence[int]) -> None:
    """Draw the limits that a curve comes near."""
    levels = {
        level
        for i in indices
        for level in signals.limits.get(signals.names[i], np.zeros(0)).tolist()
        if level and math.isfinite(level) and (signals.values[:, i] / level).max() >= _NEAR
    }
    for level in sorted(levels):
        label = "limit" if level == max(levels) else "_limit"
        axes.axhline(level, ls="--", lw=0.9, color="#555555", label=label)


def _named(axes: Axes) -> dict[str, Line2D]:
    """Return the lines that a legend names."""
    return {str(x.get_label()): x for x in axes.get_lines() if str(x.get_label())[0] != "_"}


def _below(figure: Figure, lines: Mapping[str, Line2D], title: str, side: str) -> None:
    """Name lines below all panels, in as many columns as there is space for."""
    letters = 150 if side == "center" else 75
    columns = min(len(lines), 8, max(1, letters // (max(map(len, lines)) + 6)))
    place: Any = f"outside lower {side}"
    named = list(lines.values())
    figure.legend(handles=named, loc=place, ncols=columns, handlelength=1.6, title=title)


def _drifts(axes: Axes, t: Array, drifts: Mapping[str, Array]) -> None:
    # Zero has no place on a logarithmic axis: nothing is below the rounding of one.
    shown = {k: np.maximum(v, np.finfo(float).eps / 10.0) for k, v in drifts.items() if len(v)}
    for color, (label, drift) in zip(COLORS, shown.items(), strict=False):
        axes.semilogy(t, drift, color=color, label=label)
    axes.set(title=f"relative {next(iter(shown))} drift", xlabel="t [s]")
    axes.set_ylim(1e-17, max(1e-13, *(10.0 * float(drift.max()) for drift in shown.values())))
    axes.legend(handlelength=1.2)


def _short(name: str) -> str:
    return name.partition(".")[2] or name
