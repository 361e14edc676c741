"""Figures of loops: where their poles are, and what each input bears."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fflin.base.errors import InputError
from fflin.base.figures import COLORS, cycle, letters_of, logarithmic, saved, styled, target_of
from fflin.base.validation import Array, number
from fflin.control.gain import Gain
from fflin.control.loops import Loop, input_loops
from fflin.linear.model import LinearModel

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_LINE = "#888888"
# The factors on a gain that are drawn; what lies beyond goes to the edge.
_FACTORS = (0.01, 100.0)


def plot_poles(
    poles: Any, path: str | Path | None = None, *, dt: float = 0.0, title: str = "poles"
) -> Figure:
    """Draw a pole map; where poles differ by more than a factor of 10, on logarithmic axes.

    Parameters
    ----------
    poles : array_like or Gain or LinearModel
        Poles [1/s], or what has them; several of these as {label: poles}.
    path : str or Path, optional
        .png, .pdf or .svg to save to.
    dt : float
        Sampling time of poles that are given as numbers; then the unit circle is drawn.
    title : str

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    MissingPackageError, FileError
        As in `plot_motion`.
    """
    target, dt = target_of(path), number("dt", dt)
    sets = poles if isinstance(poles, dict) else {"": poles}
    found = {str(label): _poles_of(given) for label, given in sets.items()}
    dt = next((own for _, own in found.values() if own), dt)
    with styled() as figure_class:
        figure = figure_class(figsize=(6.0, 5.0), layout="constrained")
        axes = figure.add_subplot()
        _pole_map(axes, {label: values for label, (values, _) in found.items()}, dt)
        axes.set_title(title)
        if any(sets):
            figure.legend(loc="outside lower center", ncols=4)
        return saved(figure, target)


def plot_loops(gain: Gain, path: str | Path | None = None) -> Figure:
    """Draw the loop of each input, the others closed: Bode plot, margins, and the poles of all.

    Parameters
    ----------
    gain : Gain
    path : str or Path, optional
        .png, .pdf or .svg to save to.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    MissingPackageError, FileError
        As in `plot_motion`.
    """
    if not isinstance(gain, Gain):
        raise InputError(f"gain is a {type(gain).__name__}, expected what fflin.lqr returns")
    target = target_of(path)
    w, response, loops = input_loops(gain)
    count = len(loops)
    with styled() as figure_class:
        figure = figure_class(figsize=(11.0, max(8.5, 2.0 + 0.12 * count)), layout="constrained")
        left, right = figure.subfigures(1, 2, width_ratios=(1.1, 1.0))
        sizes, phases, poles = left.subplots(3, 1)
        phase, factor = right.subplots(1, 2, sharey=True)
        colors = cycle(count)
        _bode(sizes, phases, w, response, loops, colors)
        _margins(phase, factor, gain, loops, colors)
        # Those of a step lie close to one, and their rates apart.
        rates = np.log(gain.poles[gain.poles != 0.0]) / gain.dt if gain.dt else gain.poles
        _pole_map(poles, {"": rates}, 0.0)
        poles.set_title("poles z of A - B K as rates ln(z)/dt" if gain.dt else "poles of A - B K")
        time = f"sampled at {gain.dt:g} s" if gain.dt else "continuous"
        figure.suptitle(
            f"{gain.robot}, {time}: loop of each input, the others closed\n"
            f"all inputs at once: disk margin {gain.margins.disk:.3g}"
        )
        return saved(figure, target)


def _bode(
    sizes: Axes,
    phases: Axes,
    w: Array,
    response: Array,
    loops: Sequence[Loop],
    colors: Sequence[str],
) -> None:
    for color, values, loop in zip(colors, response.T, loops, strict=True):
        sizes.loglog(w, np.abs(values), color=color, lw=1.0)
        angle = np.unwrap(np.angle(values))
        angle -= 2.0 * math.pi * math.ceil(angle[-1] / (2.0 * math.pi))
        phases.semilogx(w, np.degrees(angle), color=color, lw=1.0)
        for at, of in loop.crossings:
            # On the branch that the curve is on there, and as far from -180 deg.
            there = np.degrees(np.interp(math.log(at), np.log(w), angle))
            of += 360.0 * round((there - of) / 360.0)
            nearest = 360.0 * round((of - 180.0) / 360.0) + 180.0
            sizes.plot(at, 1.0, "o", color=color, ms=3)
            phases.plot([at, at], [of, nearest], "o-", color=color, ms=3, lw=0.6, markevery=[0])
        for at, size in loop.turns:
            if w[0] <= at <= w[-1]:
                sizes.plot([at, at], [size, 1.0], "s-", color=color, ms=3, lw=0.6, markevery=[0])
    sizes.axhline(1.0, color=_LINE, lw=0.8)
    phases.axhline(-180.0, color=_LINE, lw=0.8)
    phases.yaxis.get_major_locator().set_params(nbins=6, steps=[1, 1.5, 3, 4.5, 6, 9, 10])
    sizes.set(title="gain of the loop (dot: 1, square: phase -180 deg)", ylabel="|L|")
    phases.set(title="phase of the loop", ylabel="[deg]")
    for axes in (sizes, phases):
        axes.set(xlabel="frequency [rad/s]", xlim=(w[0], w[-1]))


def _margins(
    phase: Axes, factor: Axes, gain: Gain, loops: Sequence[Loop], colors: Sequence[str]
) -> None:
    for place, (loop, color) in enumerate(zip(loops, colors, strict=True)):
        phase.plot(min(loop.phase, 180.0), place, "o", color=color, ms=4)
        factor.plot(np.clip(loop.gain, *_FACTORS), [place, place], "|-", color=color, ms=6)
    margins = gain.margins
    phase.axvspan(0.0, margins.phase, color="#eeeeee", zorder=0)
    factor.axvspan(*np.clip(margins.gain, *_FACTORS), color="#eeeeee", zorder=0)
    phase.set(title="phase margin", xlabel="[deg]; grey: all at once", xlim=(0.0, 185.0))
    phase.set_xticks([0, 60, 120, 180])
    factor.set(title="factors on the gain", xlabel="grey: all at once", xscale="log")
    factor.set_xlim(*_FACTORS)
    factor.set_xticks([0.01, 0.1, 1.0, 10.0, 100.0], ["<", "0.1", "1", "10", ">"])
    factor.minorticks_off()
    size = letters_of(len(loops), 7.0 * 72.0)
    phase.set_yticks(range(len(loops)), gain.input_names, fontsize=size)
    phase.set_ylim(len(loops) - 0.5, -0.5)


def _pole_map(axes: Axes, sets: dict[str, Any], dt: float) -> None:
    for place, (label, values) in enumerate(sets.items()):
        axes.plot(
            values.real,
            values.imag,
            "x" if place == 0 else "+",
            color=COLORS[place % len(COLORS)],
            label=label or None,
        )
    if dt:
        angle = np.linspace(0.0, 2.0 * np.pi, 201)
        axes.plot(np.cos(angle), np.sin(angle), color=_LINE, lw=0.8)
        axes.set_aspect("equal")
    else:
        axes.axvline(0.0, color=_LINE, lw=0.8)
        every = np.concatenate([np.ravel(values) for values in sets.values()])
        unit = float(np.abs(every).max(initial=0.0))
        logarithmic(axes, "x", every.real, unit)
        logarithmic(axes, "y", every.imag, unit)
    of = "" if dt else " [1/s]"
    axes.set(xlabel=f"real part{of}", ylabel=f"imaginary part{of}")


def _poles_of(given: Any) -> tuple[Any, float]:
    if isinstance(given, LinearModel):
        return np.linalg.eigvals(given.A), given.dt
    if hasattr(given, "poles"):
        return np.asarray(given.poles), float(getattr(given, "dt", 0.0))
    try:
        poles = np.asarray(given)
    except ValueError:
        poles = np.asarray(None)  # its rows differ in length
    if poles.dtype.kind not in "fiuc" or not np.isfinite(poles).all():
        raise InputError(f"poles is a {type(given).__name__}, expected finite numbers or a Gain")
    return poles.ravel(), 0.0
