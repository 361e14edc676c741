"""Figure of a tuned law: gains and step responses with their limits, loops, and the search."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from fflin.base.figures import COLORS, GREY, Axes, Figure, cycle, drawing, letters_of
from fflin.base.validation import instance
from fflin.control.margins import closed_loop
from fflin.control.plots import draw_nichols, loop_responses
from fflin.tuning.curves import Curves, curves_of
from fflin.tuning.tuned import Tuned

_COLUMNS = 3

# Size of a panel [in].
_WIDTH, _HEIGHT = 4.2, 3.2


def plot_tuned(
    tuned: Tuned, path: str | Path | None = None, *, axes: Axes | None = None
) -> Figure:
    """Plot the goals of a tuned law with their limits, its loops, and the search.

    - For each goal `MaxGain`, `RollOff` and `Margin`, a panel shows the largest singular value of
      the closed loop over frequency, divided by the sizes of its signals, and the limit in red. For
      `Track`, a panel shows the step response and its template. Grey curves belong to the other
      models of the search.
    - A Nichols plot shows the loop gain at each input, with all other loops closed, see
      `plot_loops`.
    - Two panels show the largest values of the soft and of the hard goals, and the parameters
      divided by their final values, in each step of the search.

    Parameters
    ----------
    tuned : Tuned
    path : str or Path, optional
        File to write, .png, .pdf or .svg. See `plot_motion` for possible errors.
    axes : matplotlib.axes.Axes, optional
        Axes of a grid, such as from ``pyplot.subplots``; the figure is drawn in their place.

    Returns
    -------
    matplotlib.figure.Figure

    Examples
    --------
    >>> lin = fflin.linearize(fflin.load("planar_detumble"))
    >>> law = fflin.PD("q_b", "tau_b", rates="omega_b")
    >>> tuned = fflin.tune(lin, law, fflin.Margin(0.8), starts=1)
    >>> figure = fflin.plot_tuned(tuned, "tuned.png")
    """
    instance("tuned", tuned, Tuned, "a Tuned, as fflin.tune returns it")
    curves = [found for item in tuned._loops if (found := curves_of(item)) is not None]
    count = len(curves) + 3
    rows = math.ceil(count / _COLUMNS)
    size = _COLUMNS * _WIDTH, rows * _HEIGHT + 0.6
    with drawing(path, *size, axes=axes) as figure:
        panels = figure.subplots(rows, _COLUMNS, squeeze=False).ravel().tolist()
        for panel in panels[count:]:
            panel.set_axis_off()
        for panel, item in zip(panels, curves, strict=False):
            _draw_goal(panel, item)
        nichols, goals, parameters = panels[len(curves) : count]
        _draw_loops(nichols, tuned)
        _draw_goals(goals, tuned)
        _draw_parameters(parameters, tuned)
        verdict = "all goals hold" if tuned.met else "not all goals hold"
        figure.suptitle(
            f"{tuned.lin.robot}: {verdict}; the largest value is {tuned.factor:.4g} of its limit",
            x=0.02,
            ha="left",
        )
    return figure


def _draw_goal(panel: Axes, item: Curves) -> None:
    """Draw the curves of a goal with its limits."""
    for row in item.values[:0:-1]:
        panel.plot(item.where, row, color=GREY, lw=0.7)
    panel.plot(item.where, item.values[0], color=COLORS[2], lw=1.2)
    for limit in (item.low, item.high):
        shown = np.where(np.isfinite(limit), limit, math.nan)
        panel.plot(item.where, shown, color=COLORS[0], lw=1.4)
    panel.set_title(item.title)
    if item.over_time:
        panel.set(xlabel="time [s]", ylabel="response to a unit step")
        return
    panel.set_xscale("log")
    panel.set_yscale("log")
    panel.set(xlabel="frequency [rad/s]", ylabel="largest singular value")
    panel.set_xlim(item.where[0], item.where[-1])


def _draw_loops(panel: Axes, tuned: Tuned) -> None:
    """Draw the Nichols plot of the nominal loop at each input that the law commands."""
    with np.errstate(all="ignore"):
        _, response = loop_responses(closed_loop(tuned, tuned.lin, None, None))
        used = np.flatnonzero(np.abs(response).max(axis=0) > 0.0)
        draw_nichols(panel, response[:, used])


def _draw_goals(panel: Axes, tuned: Tuned) -> None:
    """Draw the largest values of the goals in each step."""
    steps = np.arange(len(tuned.history))
    labels = {"soft goals": COLORS[2], "hard goals": COLORS[5]}
    for (label, color), values in zip(labels.items(), tuned.history.T, strict=True):
        if (values > 0.0).any():
            shown = np.where(values > 0.0, values, math.nan)
            panel.semilogy(steps, shown, color=color, label=label)
    panel.axhline(1.0, color=COLORS[0], lw=0.8)
    panel.locator_params("x", integer=True)
    panel.set(
        title="goals in the search", xlabel="step", ylabel="largest value by its limit"
    )
    panel.legend()


def _draw_parameters(panel: Axes, tuned: Tuned) -> None:
    """Draw the parameters in each step, divided by their final values."""
    names = list(tuned.parameters)
    final = np.array(list(tuned.parameters.values()))
    history = tuned.parameter_history
    moved: list[int] = []
    if len(history):
        moved = np.flatnonzero(np.ptp(history, axis=0) > 0.0).tolist()
    for index, color in zip(moved, cycle(len(moved)), strict=True):
        scale = final[index] or 1.0
        panel.plot(history[:, index] / scale, color=color, lw=1.0, label=names[index])
    panel.locator_params("x", integer=True)
    panel.set(
        title="parameters in the search", xlabel="step", ylabel="value by the final one"
    )
    if len(moved) and (history[:, moved] * np.sign(final[moved]) > 0.0).all():
        panel.set_yscale("log")
    if len(moved):
        panel.legend(
            loc="upper left",
            bbox_to_anchor=(1.0, 1.0),
            fontsize=letters_of(1.4 * len(moved), 72.0 * _HEIGHT),
        )
