"""Plots of control loops: pole maps, Bode plots and margins."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fflin.base.errors import InputError
from fflin.base.figures import COLORS, cycle, drawing, letters_of, logarithmic
from fflin.base.validation import Array, Values, instance, number, refuse_masked
from fflin.control.gain import Gain
from fflin.control.margins import Loop, input_loops
from fflin.linear.model import LinearModel

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_LINE = "#888888"


def plot_poles(
    poles: object, path: str | Path | None = None, *, dt: float = 0.0, title: str = "poles"
) -> Figure:
    """Plot a pole map.

    The axes are logarithmic if the poles differ by more than a factor of 10.

    Parameters
    ----------
    poles : array_like or Gain or LinearModel
        Poles [1/s], an object with poles, or several sets {label: poles}.
    path : str or Path, optional
        File to write, .png, .pdf or .svg. The possible errors are listed in `plot_motion`.
    dt : float
        Sampling time [s] of poles given as numbers. If not 0, the unit circle is drawn.
    title : str
        Title of the figure.

    Returns
    -------
    matplotlib.figure.Figure

    Examples
    --------
    >>> lin = fflin.linearize(fflin.load("planar_detumble"))
    >>> figure = fflin.plot_poles(fflin.lqr(lin), "poles.png")
    """
    dt = number("dt", dt)
    sets = poles if isinstance(poles, dict) and poles else {"": poles}
    found = {str(label): _poles_of(given) for label, given in sets.items()}
    dt = next((own for _, own in found.values() if own), dt)
    with drawing(path, 6.0, 5.0) as figure:
        axes = figure.add_subplot()
        _pole_map(axes, {label: values for label, (values, _) in found.items()}, dt)
        axes.set_title(title)
        if any(sets):
            figure.legend(loc="outside lower center", ncols=4)
    return figure


def plot_loops(gain: Gain, path: str | Path | None = None) -> Figure:
    """Plot the loop gain at each input with the other loops closed: Bode plot, margins and poles.

    Parameters
    ----------
    gain : Gain
    path : str or Path, optional
        File to write, .png, .pdf or .svg. The possible errors are listed in `plot_motion`.

    Returns
    -------
    matplotlib.figure.Figure

    Examples
    --------
    >>> lin = fflin.linearize(fflin.load("planar_detumble"))
    >>> figure = fflin.plot_loops(fflin.lqr(lin), "loops.png")
    """
    instance("gain", gain, Gain, "a Gain, as from fflin.lqr")
    tall = max(8.5, 1.5 + 0.12 * len(gain.K))
    with drawing(path, 11.0, tall) as figure:
        w, response, loops = input_loops(gain)
        sizes, phases, poles = figure.subplots(3, 1)
        _bode(sizes, phases, w, response, loops)
        names = (
            f"{name}: {min(loop.phase, 180.0):.0f} deg, {loop.gain[0]:.2g} to {loop.gain[1]:.3g}"
            for name, loop in zip(gain.input_names, loops, strict=True)
        )
        figure.legend(
            sizes.get_lines()[: len(loops)],
            names,
            title="margins at each input: phase, gain factors",
            loc="outside right upper",
            fontsize=letters_of(1.3 * len(loops), 72.0 * (tall - 1.5)),
        )
        # Those of a step lie close to one, and their rates apart.
        rates = np.log(gain.poles[gain.poles != 0.0]) / gain.dt if gain.dt else gain.poles
        _pole_map(poles, {"": rates}, 0.0)
        poles.set_title("poles of A - B K as ln(z)/dt" if gain.dt else "poles of A - B K")
        low, high = gain.margins.gain
        figure.suptitle(
            f"{gain.robot}{f', sampled at {gain.dt:g} s' if gain.dt else ''}: loop of each input, "
            f"the others closed\nmargins for simultaneous changes: phase {gain.margins.phase:.3g} "
            f"deg, gain {low:.2g} to {high:.3g} (disk margin {gain.margins.disk:.3g})",
            x=0.02,
            ha="left",
        )
    return figure


def _bode(sizes: Axes, phases: Axes, w: Array, response: Values, loops: Sequence[Loop]) -> None:
    colors = cycle(len(loops))
    sizes.set_prop_cycle(color=colors)
    sizes.loglog(w, np.abs(response), lw=1.0)
    for color, values, loop in zip(colors, response.T, loops, strict=True):
        angle = np.degrees(np.unwrap(np.angle(values)))
        angle -= 360.0 * math.ceil(angle[-1] / 360.0)
        phases.semilogx(w, angle, color=color, lw=1.0)
        marked: dict[str, Any] = {"color": color, "ms": 3, "lw": 0.6, "markevery": [0]}
        for at, _ in loop.crossings:
            of = float(np.interp(math.log(at), np.log(w), angle))
            sizes.plot([at], [1.0], "o", **marked)
            phases.plot([at] * 2, [of, of - math.remainder(of - 180.0, 360.0)], "o-", **marked)
        for at, size in loop.turns:
            if w[0] <= at <= w[-1]:
                sizes.plot([at, at], [size, 1.0], "s-", **marked)
    sizes.axhline(1.0, color=_LINE, lw=0.8)
    phases.axhline(-180.0, color=_LINE, lw=0.8)
    phases.locator_params("y", nbins=6, steps=[1, 1.5, 3, 4.5, 6, 9, 10])
    sizes.set(title="loop gain (dot: gain 1, square: phase -180 deg)", ylabel="|L|")
    phases.set(title="loop phase", ylabel="[deg]")
    for axes in (sizes, phases):
        axes.set(xlabel="frequency [rad/s]", xlim=(w[0], w[-1]))


def _pole_map(axes: Axes, sets: dict[str, Values], dt: float) -> None:
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


def _poles_of(given: object) -> tuple[Values, float]:
    if isinstance(given, LinearModel):
        return np.linalg.eigvals(given.A), given.dt
    if hasattr(given, "poles"):
        return np.asarray(given.poles), float(getattr(given, "dt", 0.0))
    refuse_masked("poles", given)
    try:
        poles = np.asarray(given)
    except ValueError:
        poles = np.asarray(None)  # its rows differ in length
    right = poles.dtype.kind in "fiuc" and poles.ndim == 1 and poles.size
    if not right or not np.isfinite(poles).all():
        raise InputError(
            f"poles has type {type(given).__name__} of shape {poles.shape}, expected finite "
            "numbers "
            "(k,), a Gain, a LinearModel or {label: poles}"
        )
    return poles, 0.0
