"""Plots of control loops: pole maps, Bode plots and margins."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from fflin.base.errors import InputError
from fflin.base.figures import COLORS, cycle, drawing, letters_of, logarithmic
from fflin.base.validation import Array, Mask, Values, instance, number, refuse_masked
from fflin.control.gain import Gain
from fflin.linear.model import LinearModel

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_LINE = "#888888"

_POINTS = 400

# A gain factor below this counts as zero, because an integrator has infinite gain at zero
# frequency.
_NOTHING = 1e-6


class LoopMargins(NamedTuple):
    """Phase margin [deg] of a loop, and the range of gain factors for which the loop is stable."""

    phase: float
    gain: tuple[float, float]


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
        File to write, .png, .pdf or .svg. See `plot_motion` for possible errors.
    dt : float
        Sampling time [s], if the poles are given as numbers. If it is not 0, the unit circle is
        drawn.
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
        File to write, .png, .pdf or .svg. See `plot_motion` for possible errors.

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
        _bode(sizes, phases, w, response)
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
        # Discrete-time poles crowd near 1, so their rates ln(z)/dt are drawn.
        rates = np.log(gain.poles[gain.poles != 0.0]) / gain.dt if gain.dt else gain.poles
        _pole_map(poles, {"": rates}, 0.0)
        poles.set_title("poles of A - B K as ln(z)/dt" if gain.dt else "poles of A - B K")
        low, high = gain.margins.gain
        figure.suptitle(
            f"{gain.robot}{f', sampled at {gain.dt:g} s' if gain.dt else ''}: open loop at each "
            "input, with the loops of all other inputs closed\nmargins for simultaneous "
            f"changes: phase {gain.margins.phase:.3g} deg, gain {low:.2g} to {high:.3g} (disk "
            f"margin {gain.margins.disk:.3g})",
            x=0.02,
            ha="left",
        )
    return figure


def input_loops(gain: Gain) -> tuple[Array, Values, list[LoopMargins]]:
    """Return frequencies (k,) [rad/s], the loop gains (k, nu) of the inputs, and their margins."""
    # With T = K (s I - A + B K)^-1 B, the loop gain of input i is T_ii / (1 - T_ii). For a sampled
    # model, s is e^(j w dt).
    fed = [gain.state_names.index(name) for name in gain.regulated or gain.state_names]
    F, B, K, dt = gain.closed_loop[np.ix_(fed, fed)], gain.B[fed], gain.K[:, fed], gain.dt

    def response(w: float) -> Values:
        s = np.exp(1j * w * dt) if dt else 1j * w
        T = np.einsum("ij,ji->i", K, np.linalg.solve(s * np.eye(len(F)) - F, B))
        with np.errstate(divide="ignore", invalid="ignore"):
            return T / (1.0 - T)

    rates = np.abs(np.log(gain.poles[gain.poles != 0.0]) / dt if dt else gain.poles)
    end = math.pi / dt if dt else 100.0 * float(rates.max())
    grid = np.geomspace(min(float(rates.min()), end) / 100.0, end, _POINTS)
    values = np.array([response(w) for w in grid])

    def changes(value: Callable[[Values], Array], i: int, among: Mask) -> list[complex]:
        """Return the responses of loop i at which the function `value` changes its sign."""
        from scipy.optimize import brentq

        signs = np.signbit(value(values[:, i]))
        at = np.flatnonzero((signs[1:] != signs[:-1]) & among[1:] & among[:-1])
        found = (brentq(lambda w: value(response(w)[i]), *grid[k : k + 2], xtol=1e-12) for k in at)
        return [complex(response(w)[i]) for w in found]

    loops = []
    # At both ends of the frequency axis, the loop gain is real and its phase may be -180 deg.
    ends = [response(0.0)] + [values[-1]] * bool(dt)
    for i in range(len(K)):
        crossed = changes(lambda L: np.log(np.abs(L)), i, values[:, i] != 0.0)
        turned = changes(np.imag, i, values[:, i].real < 0.0)
        turned += [value[i] for value in ends if value[i].real < 0.0]
        angles = [math.degrees(np.angle(value)) - 180.0 for value in crossed]
        phase = min((abs(math.remainder(x, 360.0)) for x in angles), default=math.inf)
        factors = [1.0 / abs(value) if value else math.inf for value in turned]
        low = max((x for x in factors if _NOTHING < x < 1.0), default=0.0)
        high = min((x for x in factors if x > 1.0), default=math.inf)
        loops.append(LoopMargins(phase, (low, high)))
    return grid, values, loops


def _bode(sizes: Axes, phases: Axes, w: Array, response: Values) -> None:
    colors = cycle(response.shape[1])
    sizes.set_prop_cycle(color=colors)
    sizes.loglog(w, np.abs(response), lw=1.0)
    for color, values in zip(colors, response.T, strict=True):
        angle = np.degrees(np.unwrap(np.angle(values)))
        angle -= 360.0 * math.ceil(angle[-1] / 360.0)
        phases.semilogx(w, angle, color=color, lw=1.0)
    sizes.axhline(1.0, color=_LINE, lw=0.8)
    phases.axhline(-180.0, color=_LINE, lw=0.8)
    phases.locator_params("y", nbins=6, steps=[1, 1.5, 3, 4.5, 6, 9, 10])
    sizes.set(title="loop gain", ylabel="|L|")
    phases.set(title="loop phase", ylabel="[deg]")
    for axes in (sizes, phases):
        axes.set(xlabel="frequency [rad/s]", xlim=(w[0], w[-1]))


def _pole_map(axes: Axes, sets: dict[str, Values], dt: float) -> None:
    for index, (label, values) in enumerate(sets.items()):
        axes.plot(
            values.real,
            values.imag,
            "x" if index == 0 else "+",
            color=COLORS[index % len(COLORS)],
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
            "numbers (k,), a Gain, a LinearModel or {label: poles}"
        )
    return poles, 0.0
