"""Figures of motions, with matplotlib."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypeAlias

import numpy as np

from fflin.base.figures import COLORS, cycle, saved, styled, target_of
from fflin.base.validation import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

_DASHES = ("-", "--", ":", "-.")
_OF_JOINTS = ("q_m", "qdot_m")
_MOST_IN_A_PANEL = 6
_GROUPS = {
    "q_b": "attitude q_b",
    "r_b": "position r_b",
    "q_m": "joints q_m",
    "omega_b": "angular velocity omega_b",
    "v_b": "velocity v_b",
    "qdot_m": "joint rates",
}


class Signals(NamedTuple):
    """Histories (N, k), with names GROUP.NAME and units."""

    values: Array
    names: Sequence[str]
    units: Sequence[str]

    def only(self, indices: Sequence[int]) -> Signals:
        """Return some of the columns."""
        names, units = ([of[i] for i in indices] for of in (self.names, self.units))
        return Signals(self.values[:, indices], names, units)

    def groups(self) -> dict[str, list[int]]:
        """Return the columns of each group."""
        groups: dict[str, list[int]] = {}
        for index, name in enumerate(self.names):
            groups.setdefault(name.partition(".")[0] if "." in name else "", []).append(index)
        return groups

    def unit(self, indices: Sequence[int]) -> str:
        """Return the units of some columns in brackets."""
        shown = sorted({self.units[i] for i in indices} - {"1"})
        return f"[{', '.join(shown)}]" if shown else ""


def draw(
    t: Array,
    states: Signals,
    inputs: Signals,
    linear: Array | None,
    drifts: Mapping[str, Array],
    *,
    title: str,
    path: str | Path | None = None,
) -> Figure:
    """Draw states, those of the linear model dashed, inputs and {label: drift} over time."""
    target = target_of(path)
    with styled() as figure_class:
        both = linear is not None
        figure = figure_class(figsize=(11.0, 10.5 if both else 8.5), layout="constrained")
        heights = [3.0, 1.2] * 2 if both else [3.0] * 2
        grid = figure.add_gridspec(
            len(heights) + 1, 3, height_ratios=[*heights, 3.0], hspace=0.06, wspace=0.06
        )
        lines: list[Line2D] = []
        for place, (group, indices) in enumerate(states.groups().items()):
            row, column = divmod(place, 3)
            axes = figure.add_subplot(grid[row * (1 + both), column])
            _histories(axes, t, states, linear, group, indices)
            if linear is not None:
                below = figure.add_subplot(grid[2 * row + 1, column], sharex=axes)
                _difference(below, t, states, linear, indices)
                axes.tick_params(labelbottom=False)
            else:
                axes.set_xlabel("t [s]")
            if group == "q_m":
                lines = [line for line in axes.get_lines() if line.get_label()[0] != "_"]
        colors = {str(line.get_label()): str(line.get_color()) for line in lines}
        _inputs(figure, grid, t, inputs, len(heights), colors)
        if lines:
            # Joints are many, have long names, and are the same in three panels.
            side: _Place = "outside lower left" if figure.legends else "outside lower center"
            _below(figure, lines, "joints", side)
        _drifts(figure.add_subplot(grid[len(heights), 2]), t, drifts)
        figure.suptitle(title, fontsize=11)
        return saved(figure, target)


def _histories(
    axes: Axes, t: Array, states: Signals, linear: Array | None, group: str, indices: list[int]
) -> None:
    times, shown = _broken(t, states.values, indices) if group == "q_b" else (t, states.values)
    for color, i in zip(cycle(len(indices)), indices, strict=True):
        axes.plot(times, shown[:, i], color=color, label=_short(states.names[i]))
        if linear is not None:
            axes.plot(t, linear[:, i], "--", color=color, lw=1.0)
    axes.set(title=_GROUPS[group], ylabel=states.unit(indices))
    if group not in _OF_JOINTS:
        axes.legend(handlelength=1.2)
    axes.margins(x=0.0)


def _broken(t: Array, x: Array, indices: list[int]) -> tuple[Array, Array]:
    """Return times and states with a gap where the attitude goes through a turn of 180 degrees."""
    q_b = x[:, indices]
    # The vector part of a unit quaternion whose sign has changed.
    jumps = 1 + np.flatnonzero((q_b[1:] * q_b[:-1]).sum(axis=1) < -0.5)
    return np.insert(t, jumps, t[jumps]), np.insert(x, jumps, np.nan, axis=0)


def _difference(axes: Axes, t: Array, states: Signals, linear: Array, indices: list[int]) -> None:
    for color, i in zip(cycle(len(indices)), indices, strict=True):
        axes.plot(t, states.values[:, i] - linear[:, i], color=color, lw=1.0)
    axes.set(xlabel="t [s]", ylabel=f"difference\n{states.unit(indices)}".strip())
    axes.margins(x=0.0)
    axes.ticklabel_format(axis="y", scilimits=(-2, 3))


def _inputs(
    figure: Figure, grid: Any, t: Array, inputs: Signals, row: int, colors: dict[str, str]
) -> None:
    """Draw what drives the joints beside what pushes the base, whose sizes differ widely.

    The joints have their colours; all other inputs are named in the panel or below the figure.
    """
    groups = inputs.groups()
    joints = {"tau_m": groups.pop("tau_m")} if "tau_m" in groups else {}
    panels = [panel for panel in (groups, joints) if panel]
    places = (0, 1) if len(panels) == 2 else (slice(0, 2),) * len(panels)
    for place, panel in zip(places, panels, strict=True):
        axes = figure.add_subplot(grid[row, place])
        shown = [i for indices in panel.values() for i in indices]
        for style, indices in zip(_DASHES * len(panel), panel.values(), strict=False):
            for color, i in zip(cycle(len(indices)), indices, strict=True):
                name = inputs.names[i]
                axes.step(
                    *(t, inputs.values[:, i], style),
                    color=colors.get(_short(name), color) if panel is joints else color,
                    where="post",
                    label=name,
                )
        title = "joint inputs tau_m" if panel is joints else "inputs"
        axes.set(title=title, xlabel="t [s]", ylabel=inputs.unit(shown))
        axes.margins(x=0.0)
        if panel is not joints and len(shown) <= _MOST_IN_A_PANEL:
            axes.legend(ncols=2 if len(shown) > 3 else 1, handlelength=1.6)
        elif panel is not joints:
            corner: _Place = "outside lower right" if colors else "outside lower center"
            _below(figure, axes.get_lines(), "inputs", corner)


_Place: TypeAlias = Literal["outside lower left", "outside lower center", "outside lower right"]


def _below(figure: Figure, lines: Sequence[Line2D], title: str, place: _Place) -> None:
    """Name lines below all panels, in as many columns as there is space for."""
    letters = 150 if place == "outside lower center" else 75
    longest = max(len(str(line.get_label())) for line in lines)
    columns = min(len(lines), 8, max(1, letters // (longest + 6)))
    figure.legend(handles=lines, loc=place, ncols=columns, handlelength=1.6, title=title)


def _drifts(axes: Axes, t: Array, drifts: Mapping[str, Array]) -> None:
    # Zero has no place on a logarithmic axis: nothing is below the rounding of one.
    shown = {k: np.maximum(v, np.finfo(float).eps / 10.0) for k, v in drifts.items() if len(v)}
    for color, (label, drift) in zip(COLORS, shown.items(), strict=False):
        axes.semilogy(t, drift, color=color, label=label)
    axes.set(title="momentum drift, relative", xlabel="t [s]")
    axes.set_ylim(1e-17, max(1e-13, *(10.0 * float(drift.max()) for drift in shown.values())))
    axes.legend(handlelength=1.2)
    axes.margins(x=0.0)


def _short(name: str) -> str:
    return name.partition(".")[2] or name
