"""Charts and figure of a motion: states, inputs, errors and drifts."""

import math
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from fflin.base.errors import InputError
from fflin.base.figures import (
    COLORS,
    Artist,
    Axes,
    CurveStyle,
    Figure,
    curve_styles,
    drawing,
)
from fflin.base.names import chosen, input_keys
from fflin.base.rotation import rotation_vectors
from fflin.base.validation import Array
from fflin.simulation.motion import Motion, require_motion
from fflin.simulation.report import DEGREES, STATES, Curve, curves

_MOST_IN_A_PANEL = 6
# Width [in] of the figure, by its number of columns.
_WIDTHS = {1: 7.0, 2: 8.5, 3: 11.0}
# number of characters of a legend that fit into an inch
_LETTERS = 13.6
# Title of the chart of q_b, whose curves are the components of a rotation vector in deg.
_ATTITUDE = "attitude: rotation vector"
# {(group, unit) of curves: title of their chart}, in the order of the charts.
_TITLES = {
    ("q_b", "1"): _ATTITUDE,
    ("r_b", "m"): "position",
    ("q_m", "rad"): "joints",
    ("q_m", "m"): "prismatic joints",
    ("q_m", "kg^0.5 m"): "modal amplitudes",
    ("omega_b", "rad/s"): "angular velocity",
    ("v_b", "m/s"): "velocity",
    ("qdot_m", "rad/s"): "joint rates",
    ("qdot_m", "m/s"): "prismatic joint rates",
    ("qdot_m", "kg^0.5 m/s"): "modal rates",
    ("tau_b", "N m"): "base torque",
    ("F_b", "N"): "base force",
    ("tau_m", "N m"): "joint torques",
    ("tau_m", "N"): "joint forces",
    ("thrust", "N"): "thrusters",
    ("dipole", "A m^2"): "magnetorquers",
    ("speed", "rad/s"): "wheel speed",
    ("wheel", "N m"): "wheel torque",
    ("momentum", "N m s"): "wheel momentum",
}
JOINTS, WHEELS = ("q_m", "qdot_m", "tau_m"), ("speed", "wheel", "momentum")

# A target is at rest if none of its positions changes by more than this [SI units] from one row to
# the next.
_STILL = 1e-12

_NONE = np.zeros(0)


def resting_from(motion: Motion) -> float | None:
    """Return the time [s] at which a moving target comes to rest.

    Return None if the target never moves or never comes to rest, or if the motion has phases.
    """
    places = (
        motion.target[:, : motion.x.shape[1] // 2] if motion.tracked else motion.x[:1]
    )
    moved = np.flatnonzero(
        np.abs(np.diff(places, axis=0)).max(axis=1, initial=0.0) > _STILL
    )
    if motion.phases or not len(moved) or moved[-1] + 2 >= len(places):
        return None
    return float(motion.t[moved[-1] + 1])


def plot_motion(
    motion: Motion,
    path: str | Path | None = None,
    *,
    show: Sequence[str] | None = None,
    axes: Axes | None = None,
) -> Figure:
    """Draw the errors, inputs and momentum drift of a motion, with the linear prediction.

    Angles are in deg. The attitude is drawn as the rotation vector of q_b, whose length is the
    angle from the reference.

    Parameters
    ----------
    motion : Motion
        Motion to draw. If the motion has a prediction, solid lines show the nonlinear robot,
        dashed lines show the linear model, and the panel below each group of states shows the
        difference. If the robot follows a trajectory, pale lines show the reference, the panel
        below each group shows the error, and a dotted line marks the time at which the reference
        comes to rest.
    path : str or Path, optional
        File to which the figure is saved: .png, .pdf or .svg.
    show : sequence of str, optional
        States and inputs to draw: names, groups or patterns such as ``q_m``, ``thrust``,
        ``*.hinge_*``. By default, all states and inputs are drawn.
    axes : matplotlib.axes.Axes, optional
        Axes of a grid, such as from ``pyplot.subplots``; the figure is drawn in their place.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    MissingPackageError
        If matplotlib is not installed.
    FileError
        If `path` has another ending or the file cannot be written.
    UnknownNameError
        If a name in `show` matches no state or input.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> v0 = fflin.velocity(robot, {"joint_1": 0.1})
    >>> motion = fflin.simulate(robot, v0=v0, duration=2.0, every=20)
    >>> figure = fflin.plot_motion(motion, "motion.png", show=["q_b", "*.joint_1"])
    """
    error_label, errors = _errors(require_motion(motion))
    drawn = charts(motion, show)
    states = [title for title, chart in drawn.items() if chart[0].group in STATES]
    others = len(drawn) - len(states) + 1  # including the drift
    per_row = [3.0]  # height of a chart of states
    if errors:
        per_row.append(1.2)  # height of the errors below
    columns = min(max(_WIDTHS), max(len(states), others))
    width = _WIDTHS[columns]
    heights = per_row * math.ceil(len(states) / columns)
    above = len(heights)
    heights += [3.0] * math.ceil(others / columns)
    spots = [(k // columns * len(per_row), k % columns) for k in range(len(states))]
    spots += [(above + k // columns, k % columns) for k in range(others)]
    styles = styles_of(motion)
    legends: dict[str, dict[str, Artist]] = {}
    with drawing(path, width, 0.3 + sum(heights), axes=axes) as figure:
        grid = figure.add_gridspec(
            len(heights), columns, height_ratios=heights, hspace=0.06
        )
        for (row, column), (title, chart) in zip(spots, drawn.items(), strict=False):
            panel = figure.add_subplot(grid[row, column])
            group = chart[0].group
            is_state = title in states and title != _ATTITUDE
            panel.set_title(f"{title} {group}" if is_state else title)
            chart_styles = styles[family_of(group)]
            _draw(panel, motion.t, _in_degrees(motion, chart), chart_styles)
            if motion.tracked and [title] == states[:1]:
                panel.plot(
                    [], [], color="#888888", lw=3.6, alpha=0.3, label="reference"
                )
            if group in JOINTS or len(chart) > _MOST_IN_A_PANEL:
                # Long joint names, or many names, do not fit into a chart. Their legends are below
                # all charts. One legend names the joints of all charts.
                legend = "joints" if group in JOINTS else title
                named = legends.setdefault(legend, {})
                named.update(zip(*panel.get_legend_handles_labels()[::-1], strict=True))
            else:
                if many := len(chart) > 3:
                    panel.margins(y=0.3)  # room for the names above the curves
                panel.legend(ncols=2 if many else 1, handlelength=1.4)
            if errors and title in states:
                strip = figure.add_subplot(grid[row + 1, column], sharex=panel)
                below = [errors[curve.key] for curve in chart]
                _draw_errors(strip, motion.t, below, chart_styles, error_label)
                panel.tick_params(labelbottom=False)
                panel.set_xlabel("")
        _name_below(figure, legends, width)
        starts, rest = motion.starts[1:].tolist(), resting_from(motion)
        marks = starts if rest is None else [rest]
        for panel, mark in product(figure.axes, marks):
            panel.axvline(mark, lw=0.8, ls=":", color="#555555", label="_rest")
        _draw_drifts(figure.add_subplot(grid[spots[-1]]), motion)
        for panel in figure.axes:
            panel.margins(x=0.0)
        figure.suptitle(_heading(motion), fontsize=11)
    return figure


def _heading(motion: Motion) -> str:
    """Return the heading of the figure of a motion."""
    parts = [f"{motion.robot}: {motion.t[-1]:g} s, frame {motion.frame}"]
    if motion.linear is not None:
        parts.append("solid: nonlinear, dashed: linear")
    phases = zip(motion.phases[1:], motion.starts[1:].tolist(), strict=True)
    parts += [f"{name} at {start:g} s" for name, start in phases]
    return f"{'; '.join(parts)}\n{motion.stopped}".strip()


def family_of(group: str) -> str:
    """Return the first of all groups in whose charts a name has the same colour."""
    return next((family[0] for family in (JOINTS, WHEELS) if group in family), group)


def styles_of(motion: Motion) -> dict[str, dict[str, CurveStyle]]:
    """Return {family of groups: {short name: style}} for all curves of a motion.

    The styles do not depend on the curves that are shown, so a joint has the same colour in all
    figures and pages of a motion. The change of a curve counts relative to the largest change in
    its chart.
    """
    changes: dict[str, dict[str, float]] = {}
    for chart in charts(motion).values():
        family = changes.setdefault(family_of(chart[0].group), {})
        spans = [float(np.ptp(curve.values)) for curve in chart]
        largest = max(spans) or 1.0
        for curve, span in zip(chart, spans, strict=True):
            share = span / largest
            family[curve.short] = max(share, family.get(curve.short, 0.0))
    return {group: curve_styles(family) for group, family in changes.items()}


def charts(motion: Motion, show: Sequence[str] | None = None) -> dict[str, list[Curve]]:
    """Return {chart title: curves} for the signals in `show`; curves of a chart share a unit."""
    names = (*motion.state_names, *input_keys(motion))
    show = [show] if isinstance(show, str) else show
    if not (show is None or isinstance(show, Sequence)):
        raise InputError(
            f"show is {show!r}, expected a list of names, groups or patterns"
        )
    keys = (
        names
        if show is None
        else [names[i] for i in chosen("state or input", show, names)]
    )
    curves_of_title: dict[str, list[Curve]] = {title: [] for title in _TITLES.values()}
    for curve in curves(motion):
        if curve.key in keys:
            title = _TITLES.get(
                (curve.group, curve.unit), f"{curve.group} in {curve.unit}"
            )
            curves_of_title.setdefault(title, []).append(curve)
    return {title: chart for title, chart in curves_of_title.items() if chart}


def _errors(motion: Motion) -> tuple[str, dict[str, Curve]]:
    """Return the label and the curves {state: curve} of the panels below the charts of states.

    If the motion follows a reference, the curves are the errors from the reference. Otherwise, the
    curves are the differences from the linear prediction. If there is neither a
    reference nor a prediction, there are no curves.
    """
    label = "error"
    if motion.tracked and (e := motion.error) is not None:
        rotations = np.degrees(rotation_vectors(e[:, :3]))
    elif motion.linear is not None:
        label = "difference"
        e = motion.x - motion.linear
        flown, predicted = (
            np.degrees(rotation_vectors(x[:, :3])) for x in (motion.x, motion.linear)
        )
        rotations = flown - predicted
    else:
        return label, {}
    errors = {}
    for i, (name, unit) in enumerate(
        zip(motion.state_names, motion.state_units, strict=True)
    ):
        if i < 3:
            error = Curve(name, "", name, "deg", rotations[:, i], _NONE)
        else:
            shown_unit, factor = DEGREES.get(unit, (unit, 1.0))
            error = Curve(name, "", name, shown_unit, factor * e[:, i], _NONE)
        errors[name] = error
    return label, errors


def _in_degrees(motion: Motion, chart: list[Curve]) -> list[Curve]:
    """Return the curves of a chart with angles in deg, and q_b as a rotation vector in deg.

    Speeds of wheels stay in rad/s.
    """
    group, unit = chart[0].group, chart[0].unit
    if group == "q_b":
        return _rotations(motion, chart)
    if unit not in DEGREES or group == "speed":
        return chart
    return [curve.scaled(*DEGREES[unit]) for curve in chart]


def _rotations(motion: Motion, chart: list[Curve]) -> list[Curve]:
    """Return curves of q_b as components of rotation vectors [deg].

    At 180 deg, the vector changes its sign. The curves have a gap there.
    """
    columns = [motion.state_names.index(curve.key) for curve in chart]
    shown: list[dict[str, Any]] = [
        {**curve._asdict(), "unit": "deg"} for curve in chart
    ]
    fields: tuple[tuple[str, Array | None], ...] = (
        ("values", motion.x),
        ("linear", motion.linear),
        ("reference", motion.target if motion.tracked else None),
    )
    for field, x in fields:
        if x is None:
            continue
        q_b = x[:, :3]
        rows = np.degrees(rotation_vectors(q_b))
        rows[1:][(q_b[1:] * q_b[:-1]).sum(axis=1) < -0.5] = np.nan
        for curve, column in zip(shown, columns, strict=True):
            curve[field] = rows[:, column]
    return [Curve(**curve) for curve in shown]


def _draw(
    axes: Axes,
    t: Array,
    chart: Sequence[Curve],
    styles: Mapping[str, CurveStyle],
    width: float | None = None,
) -> None:
    """Draw curves and their limits, with references in pale colours and predictions dashed."""
    group, unit = chart[0].group, chart[0].unit
    steps = "default" if group in ("", *STATES, "speed", "momentum") else "steps-post"
    # Grey curves are drawn below the others. One name at the end of the legend counts them.
    order = sorted(chart, key=lambda curve: not styles[curve.short].is_named)
    grey = sum(not styles[curve.short].is_named for curve in chart)
    for k, curve in enumerate(order):
        style = styles[curve.short]
        color = style.color
        label = curve.short
        if not style.is_named:
            label = f"{grey} more" if k == len(order) - 1 else f"_{curve.short}"
        if curve.reference is not None:
            axes.plot(t, curve.reference, color=color, lw=3.6, alpha=0.3)
        axes.plot(
            t,
            curve.values,
            color=color,
            label=label,
            drawstyle=steps,
            lw=width,
            ls=style.line,
            zorder=2.0 if style.is_named else 1.5,
        )
        if curve.linear is not None:
            axes.plot(t, curve.linear, color=color, ls="--", lw=1.0)
    levels = sorted({level for curve in chart for level in curve.near})
    for level in levels:
        label = "limit" if level == levels[-1] else "_limit"
        axes.axhline(level, ls="--", lw=0.9, color="#555555", label=label)
    label = "" if unit == "1" else f"[{unit}]"
    axes.set(xlabel="t [s]", ylabel=label)


def _draw_errors(
    axes: Axes,
    t: Array,
    errors: Sequence[Curve],
    styles: Mapping[str, CurveStyle],
    label: str,
) -> None:
    """Draw the errors of a chart of states, which is above these axes."""
    _draw(axes, t, errors, styles, width=1.0)
    axes.set_ylabel(f"{label}\n{axes.get_ylabel()}".strip())
    axes.ticklabel_format(axis="y", scilimits=(-2, 3))


def _name_below(
    figure: Figure, legends: Mapping[str, Mapping[str, Artist]], width: float
) -> None:
    """Add legends below all charts, with as many columns as fit in a width [in]."""
    for title, named in legends.items():
        letters = _LETTERS * width / len(legends)
        side = "left" if title == "joints" else "right"
        if len(legends) == 1:
            side = "center"
        columns = min(len(named), 8, max(1, int(letters / (max(map(len, named)) + 6))))
        names = sorted(named, key="limit".__eq__)  # the limit last
        lines = [named[name] for name in names]
        place: Any = f"outside lower {side}"
        figure.legend(
            lines, names, loc=place, ncols=columns, handlelength=1.6, title=title
        )


def _draw_drifts(axes: Axes, motion: Motion) -> None:
    # A logarithmic axis cannot show zero, so drifts below a tenth of the machine epsilon are drawn
    # at this value.
    drifts = {
        motion.kept: motion.momentum_drift,
        "centre of mass [m]": motion.com_drift,
    }
    shown = {
        k: np.maximum(v, np.finfo(float).eps / 10.0)
        for k, v in drifts.items()
        if len(v)
    }
    for color, (label, drift) in zip(COLORS, shown.items(), strict=False):
        axes.semilogy(motion.t, drift, color=color, label=label)
    axes.set(title=f"relative {next(iter(shown))} drift", xlabel="t [s]")
    largest = [float(drift.max()) for drift in shown.values()]
    axes.set_ylim(1e-17, max(1e-13, 10.0 * max(largest)))
    axes.legend(handlelength=1.2)
