"""Figures of motions, with matplotlib."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fflin.figures import COLORS, cycle, saved, styled, target_of
from fflin.motion import Motion, require_motion

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_DASHES = ("-", "--", ":", "-.")
_GROUPS = {
    "q_b": "attitude q_b",
    "r_b": "position r_b",
    "q_m": "joints q_m",
    "omega_b": "angular velocity omega_b",
    "v_b": "velocity v_b",
    "qdot_m": "joint rates",
}


def plot_motion(motion: Motion, path: str | Path | None = None) -> Figure:
    """Draw the errors, inputs and momentum drift of a motion, linear beside nonlinear.

    Parameters
    ----------
    motion : Motion
        With a prediction, each group of states shows the nonlinear robot in full lines and the
        linear model dashed, and below it their difference.
    path : str or Path, optional
        .png, .pdf or .svg to save to.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    MissingPackageError
        If matplotlib is not installed.
    FileError
        If the ending is another or the file cannot be written.
    """
    motion = require_motion(motion)
    target = target_of(path)
    with styled() as figure_class:
        both = motion.linear is not None
        groups = _by_group(motion.state_names)
        figure = figure_class(figsize=(11.0, 10.5 if both else 8.5), layout="constrained")
        heights = [3.0, 1.2] * 2 if both else [3.0] * 2
        grid = figure.add_gridspec(
            len(heights) + 1, 3, height_ratios=[*heights, 3.0], hspace=0.06, wspace=0.06
        )
        for place, (group, indices) in enumerate(groups.items()):
            row, column = divmod(place, 3)
            axes = figure.add_subplot(grid[row * (1 + both), column])
            _histories(axes, motion, group, indices)
            if both:
                below = figure.add_subplot(grid[2 * row + 1, column], sharex=axes)
                _difference(below, motion, indices)
                axes.tick_params(labelbottom=False)
            else:
                axes.set_xlabel("t [s]")
        _inputs(figure, grid, motion, len(heights))
        _momentum(figure.add_subplot(grid[len(heights), 2]), motion)
        figure.suptitle(_title(motion, both), fontsize=11)
        return saved(figure, target)


def _histories(axes: Axes, motion: Motion, group: str, indices: list[int]) -> None:
    for color, i in zip(cycle(len(indices)), indices, strict=True):
        axes.plot(motion.t, motion.x[:, i], color=color, label=_short(motion.state_names[i]))
        if motion.linear is not None:
            axes.plot(motion.t, motion.linear[:, i], "--", color=color, lw=1.0)
    units = sorted({motion.state_units[i] for i in indices})
    axes.set(title=_GROUPS[group], ylabel=_unit(units))
    axes.legend(ncols=3 if len(indices) > 4 else 1, loc="best", handlelength=1.2)
    axes.margins(x=0.0)


def _difference(axes: Axes, motion: Motion, indices: list[int]) -> None:
    assert motion.linear is not None
    for color, i in zip(cycle(len(indices)), indices, strict=True):
        axes.plot(motion.t, motion.x[:, i] - motion.linear[:, i], color=color, lw=1.0)
    axes.set(xlabel="t [s]", ylabel="difference")
    axes.margins(x=0.0)
    axes.ticklabel_format(axis="y", scilimits=(-2, 3))


def _inputs(figure: Figure, grid: Any, motion: Motion, row: int) -> None:
    """Draw what drives the joints beside what pushes the base, whose sizes differ widely."""
    groups = _by_group(motion.input_names)
    joints = {"tau_m": groups.pop("tau_m")} if "tau_m" in groups else {}
    panels = [panel for panel in (groups, joints) if panel]
    places = (0, 1) if len(panels) == 2 else (slice(0, 2),)
    for place, panel in zip(places, panels, strict=True):
        axes = figure.add_subplot(grid[row, place])
        for style, indices in zip(
            ("-", "--", ":", "-.") * len(panel), panel.values(), strict=False
        ):
            for color, i in zip(cycle(len(indices)), indices, strict=True):
                name = motion.input_names[i]
                label = _short(name) if panel is joints else name
                axes.step(motion.t, motion.u[:, i], style, color=color, where="post", label=label)
        shown = [i for indices in panel.values() for i in indices]
        title = "joint inputs tau_m" if panel is joints else "inputs"
        units = sorted({motion.input_units[i] for i in shown})
        axes.set(title=title, xlabel="t [s]", ylabel=_unit(units))
        axes.legend(ncols=2 if len(shown) > 4 else 1, fontsize=7, handlelength=1.6)
        axes.margins(x=0.0)


def _momentum(axes: Axes, motion: Motion) -> None:
    # Zero has no place on a logarithmic axis: nothing is below the rounding of one.
    drift = np.maximum(motion.momentum_drift, np.finfo(float).eps / 10.0)
    axes.semilogy(motion.t, drift, color=COLORS[0])
    axes.set(title="momentum drift, relative", xlabel="t [s]")
    axes.set_ylim(1e-17, max(1e-13, 10.0 * float(drift.max())))
    axes.margins(x=0.0)


def _title(motion: Motion, both: bool) -> str:
    text = f"{motion.robot}: {motion.t[-1]:g} s, frame {motion.frame}"
    if both:
        text += "; full: nonlinear, dashed: linear"
    return f"{text}; {motion.stopped}" if motion.stopped else text


def _by_group(names: Sequence[str]) -> dict[str, list[int]]:
    groups: dict[str, list[int]] = {}
    for index, name in enumerate(names):
        groups.setdefault(name.partition(".")[0] if "." in name else "", []).append(index)
    return groups


def _short(name: str) -> str:
    return name.partition(".")[2] or name


def _unit(units: Sequence[str]) -> str:
    shown = [unit for unit in units if unit != "1"]
    return f"[{', '.join(shown)}]" if shown else ""
