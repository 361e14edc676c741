"""Figure of a motion with matplotlib: states, inputs, errors and drifts."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fflin.base.errors import InputError
from fflin.base.figures import COLORS, cycle, drawing
from fflin.base.names import chosen, input_keys
from fflin.base.validation import Array
from fflin.simulation.report import Curve, curves

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    from fflin.simulation.motion import Motion

_MOST_IN_A_PANEL, _ACROSS = 6, 3
# Titles of panels by the group of their curves: states, and wheels.
_STATES = {
    "q_b": "attitude q_b",
    "r_b": "position r_b",
    "q_m": "joints q_m",
    "omega_b": "angular velocity omega_b",
    "v_b": "velocity v_b",
    "qdot_m": "joint rates qdot_m",
}
_WHEELS = {"speed": "wheel speeds", "wheel": "wheel torques", "momentum": "wheel momenta"}

# A target that moves less than this between rows, in SI units, is at rest.
_STILL = 1e-12


def resting_from(motion: Motion) -> float | None:
    """Return the time [s] from which a moving target is at rest, or None."""
    places = motion.target[:, : motion.x.shape[1] // 2] if motion.tracked else motion.x[:1]
    moved = np.flatnonzero(np.abs(np.diff(places, axis=0)).max(axis=1, initial=0.0) > _STILL)
    if not len(moved) or moved[-1] + 2 >= len(places):
        return None
    return float(motion.t[moved[-1] + 1])


def draw_motion(motion: Motion, path: str | Path | None, show: Sequence[str] | None) -> Figure:
    """Draw a motion; see `plot_motion`."""
    panels, (what, errors) = _panels(motion, show), _errors(motion)
    states = [title for title in panels if title in _STATES.values()]
    others = len(panels) - len(states) + 1  # including the drift
    per_row = [3.0, 1.2][: 1 + bool(errors)]  # heights of states and of their errors below
    heights = per_row * math.ceil(len(states) / _ACROSS)
    above = len(heights)
    heights += [3.0] * math.ceil(others / _ACROSS)
    joints: dict[str, Line2D] = {}
    large: dict[str, dict[str, Line2D]] = {}
    with drawing(path, 11.0, 0.3 + sum(heights)) as figure:
        grid = figure.add_gridspec(len(heights), _ACROSS, height_ratios=heights, hspace=0.06)
        spots = [(k // _ACROSS * len(per_row), k % _ACROSS) for k in range(len(states))]
        spots += [(above + k // _ACROSS, k % _ACROSS) for k in range(others)]
        for (row, column), (title, found) in zip(spots, panels.items(), strict=False):
            axes = figure.add_subplot(grid[row, column])
            _draw(axes, motion.t, found, title, {x: y.get_color() for x, y in joints.items()})
            if motion.tracked and [title] == states[:1]:
                axes.plot([], [], color="#888888", lw=3.6, alpha=0.3, label="reference")
            lines = {str(x.get_label()): x for x in axes.get_lines()}
            named = {label: line for label, line in lines.items() if label[0] != "_"}
            if title.startswith("joint"):
                # One legend below names the joints of all panels, because their names are long.
                joints |= named if title in states or not joints else {}
                joints |= {"limit": named["limit"]} if "limit" in named else {}
            elif len(found) > _MOST_IN_A_PANEL:
                large[title] = named
            else:
                if many := len(found) > 3:
                    axes.margins(y=0.3)  # room for the names above the curves
                axes.legend(ncols=2 if many else 1, handlelength=1.4)
            if errors and title in states:
                strip = figure.add_subplot(grid[row + 1, column], sharex=axes)
                _draw(strip, motion.t, [errors[curve.key] for curve in found], width=1.0)
                strip.set_ylabel(f"{what}\n{strip.get_ylabel()}".strip())
                strip.ticklabel_format(axis="y", scilimits=(-2, 3))
                axes.tick_params(labelbottom=False)
                axes.set_xlabel("")
        for title, named in large.items():
            _below(figure, named, title, "right" if joints else "center")
        if joints:
            limit = {"limit": joints.pop("limit")} if "limit" in joints else {}
            _below(figure, joints | limit, "joints", "left" if large else "center")
        rest = None if motion.phases else resting_from(motion)
        phases = list(zip(motion.phases[1:], motion.starts[1:].tolist(), strict=True))
        marks = [*(start for _, start in phases), *([] if rest is None else [rest])]
        for axes, mark in product(figure.axes, marks):
            axes.axvline(mark, lw=0.8, ls=":", color="#555555", label="_rest")
        _draw_drifts(figure.add_subplot(grid[spots[-1]]), motion)
        for axes in figure.axes:
            axes.margins(x=0.0)
        head = [f"{motion.robot}: {motion.t[-1]:g} s, frame {motion.frame}"]
        head += ["solid: nonlinear, dashed: linear"] * (motion.linear is not None)
        head += [f"{name} at {start:g} s" for name, start in phases]
        figure.suptitle(f"{'; '.join(head)}\n{motion.stopped}".strip(), fontsize=11)
    return figure


def _panels(motion: Motion, show: Sequence[str] | None) -> dict[str, list[Curve]]:
    """Return the chosen curves of each panel by its title; panels of wheels come last."""
    names = (*motion.state_names, *input_keys(motion))
    show = [show] if isinstance(show, str) else show
    if not (show is None or isinstance(show, Sequence)):
        raise InputError(f"show is {show!r}, expected a list of names, groups or patterns")
    keys = names if show is None else [names[i] for i in chosen("state or input", show, names)]
    panels: dict[str, list[Curve]] = {}
    for curve in curves(motion):
        torque = curve.unit == "N m"
        title = "torques" if torque else "forces"
        if curve.group == "tau_m":  # most robots have only revolute or only prismatic joints
            title = "joint inputs tau_m" if torque else "joint forces tau_m"
        elif curve.group != "wheel" or curve.short in motion.wheels:
            title = (_STATES | _WHEELS).get(curve.group, title)
        if curve.key in keys:
            panels.setdefault(title, []).append(curve)
    for title in _WHEELS.values():
        panels |= {title: panels.pop(title)} if title in panels else {}
    return panels


def _errors(motion: Motion) -> tuple[str, dict[str, Curve]]:
    """Return the errors from a reference (attitude in degrees), or else from the linear model."""
    names, units, what = motion.state_names, motion.state_units, "error"
    if motion.tracked and (e := motion.error) is not None:
        units = ("deg",) * 3 + units[3:]
        sines = np.minimum(1.0, np.linalg.norm(e[:, :3], axis=1, keepdims=True))
        e[:, :3] *= np.degrees(2.0 / np.sinc(np.arcsin(sines) / np.pi))
    elif motion.linear is not None:
        what, e = "difference", motion.x - motion.linear
    else:
        return what, {}
    of, none = zip(names, units, e.T, strict=True), np.zeros(0)
    return what, {name: Curve(name, "", name, unit, x, none) for name, unit, x in of}


def _draw(
    axes: Axes,
    t: Array,
    found: Sequence[Curve],
    title: str = "",
    colors: Mapping[str, Any] | None = None,
    width: float | None = None,
) -> None:
    """Draw curves, their references (pale), predictions (dashed) and limits."""
    group = found[0].group
    if group == "q_b":
        found = _with_gaps(found)
    inputs = title and group not in _STATES and title not in _WHEELS.values()
    steps = "steps-post" if inputs or group == "wheel" else "default"
    for own, curve in zip(cycle(len(found)), found, strict=True):
        color = (colors or {}).get(curve.short, own)
        label = curve.name if inputs else curve.short
        if curve.reference is not None:
            axes.plot(t, curve.reference, color=color, lw=3.6, alpha=0.3)
        axes.plot(t, curve.values, color=color, label=label, drawstyle=steps, lw=width)
        if curve.linear is not None:
            axes.plot(t, curve.linear, color=color, ls="--", lw=1.0)
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


def _below(figure: Figure, lines: Mapping[str, Line2D], title: str, side: str) -> None:
    """Add a legend below all panels, with as many columns as fit."""
    letters = 150 if side == "center" else 75
    columns = min(len(lines), 8, max(1, letters // (max(map(len, lines)) + 6)))
    place: Any = f"outside lower {side}"
    named = list(lines.values())
    figure.legend(handles=named, loc=place, ncols=columns, handlelength=1.6, title=title)


def _draw_drifts(axes: Axes, motion: Motion) -> None:
    # A logarithmic axis has no zero, so smaller drifts are raised to the machine epsilon.
    drifts = {motion.kept: motion.momentum_drift, "centre of mass [m]": motion.com_drift}
    shown = {k: np.maximum(v, np.finfo(float).eps / 10.0) for k, v in drifts.items() if len(v)}
    for color, (label, drift) in zip(COLORS, shown.items(), strict=False):
        axes.semilogy(motion.t, drift, color=color, label=label)
    axes.set(title=f"relative {next(iter(shown))} drift", xlabel="t [s]")
    axes.set_ylim(1e-17, max(1e-13, *(10.0 * float(drift.max()) for drift in shown.values())))
    axes.legend(handlelength=1.2)
