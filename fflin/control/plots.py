"""Figures of linear models and control loops: matrices, modes, checks, poles and margins."""

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fflin.analysis.modes import Modes
from fflin.base.errors import InputError
from fflin.base.figures import (
    COLORS,
    Axes,
    Figure,
    cycle,
    drawing,
    figure_file,
    legend_below,
    letters_of,
    logarithmic,
)
from fflin.base.names import input_keys, runs
from fflin.base.pole_grid import (
    RATIOS,
    Label,
    damped_poles,
    equally_fast_poles,
    nyquist_frequency,
    oscillates,
    spaced,
)
from fflin.base.process import in_one_thread
from fflin.base.tables import counted, rounding
from fflin.base.validation import (
    Array,
    Mask,
    Values,
    dimension,
    instance,
    number,
    refuse_masked,
)
from fflin.control.closed_loop import ClosedLoop
from fflin.control.gain import Gain, asymmetry
from fflin.control.loop_margins import Margins
from fflin.control.margins import closed_loop
from fflin.control.optimal.channel_limits import NO_GRID, channel_limits
from fflin.control.optimal.disk import as_continuous
from fflin.control.periodic_closed_loop import PeriodicClosedLoop
from fflin.control.periodic_plots import plot_periodic
from fflin.control.policy import Policy
from fflin.linear.check import Check
from fflin.linear.model import LinearModel

_LINE = "#888888"

# Colour of curves of constant damping ratio and natural frequency, and the style of their labels.
_GRID = "#b8bcc4"
_GRID_TEXT: dict[str, Any] = {
    "fontsize": 7,
    "color": "#666666",
    "zorder": 0.9,
    "clip_on": True,
    "bbox": {"facecolor": "white", "edgecolor": "none", "pad": 0.6},
}
# Width and height of these labels, as fractions of the axes.
_LABEL_SIZE = (0.075, 0.055)

_POINTS = 400

# Discrete-time poles z below this magnitude belong to delays, and have no rate.
_DEADBEAT = 1e-6

# Rates below this fraction of the largest frequency are rounding errors.
_SLOWEST = 1e-9

# Largest loop gain of a Nichols plot [dB].
_DECIBELS = 60.0

# Space beside the curves and the critical points of a Nichols plot [deg].
_BESIDE = 20.0

# Largest change of the phase [rad] between two points of a Nichols plot, how often the distance of
# the points is halved, and the largest number of points.
_SMOOTH, _HALVINGS, _MOST = 0.2, 6, 4000

# Vertical offset of the plotted points of each test. Without it, the points of two independent
# computations would overlap.
_SHIFTS = (-0.15, 0.15, 0.0, 0.0, 0.0, 0.0)


class LoopMargins(NamedTuple):
    """Phase margin [deg] of a loop, and the gain factors between which the loop is stable."""

    phase: float
    gain: tuple[float, float]


def plot_matrices(
    lin: LinearModel, path: str | Path | None = None, *, axes: Axes | None = None
) -> Figure:
    """Draw the magnitudes of the entries of A and B; entries within rounding error stay blank.

    Parameters
    ----------
    lin : LinearModel
        Model to draw.
    path : str or Path, optional
        File to save to: .png, .pdf or .svg. See `plot_motion` for possible errors.
    axes : matplotlib.axes.Axes, optional
        Axes of a grid, such as from ``pyplot.subplots``; the figure is drawn in their place.

    Examples
    --------
    >>> lin = fflin.linearize(fflin.load("planar_detumble"))
    >>> figure = fflin.plot_matrices(lin, "matrices.png")
    """
    instance("lin", lin, LinearModel, "a fflin.LinearModel")
    nx, nu = lin.B.shape
    cell = max(0.24 * min(1.0, 24.0 / nx), min(0.12, 12.0 / nx))  # inches
    size = (4.2 + cell * (nx + nu), 2.6 + cell * nx)
    with drawing(path, *size, axes=axes) as figure:
        if axes is None:
            figure.set_layout_engine("compressed")
        from matplotlib.colors import LogNorm

        panel = figure.subplots(1, 2, gridspec_kw={"width_ratios": (nx, nu)})
        drawn = [
            np.ma.masked_where(np.abs(m) <= rounding(m), np.abs(m))
            for m in (lin.A, lin.B)
        ]
        entries = np.concatenate([m.compressed() for m in drawn])
        top = float(entries.max(initial=0.0)) or 1.0
        norm = LogNorm(float(entries.min(initial=top)), 1.01 * top)
        signals = (
            ("A", lin.state_names, lin.state_names, lin.state_units),
            ("B", lin.input_names, input_keys(lin), lin.input_units),
        )
        letters = letters_of(1, 72.0 * cell)
        for ax, sizes, (title, names, keys, units) in zip(
            panel, drawn, signals, strict=True
        ):
            image = ax.imshow(sizes, cmap="viridis_r", norm=norm)
            ax.grid(visible=False)
            ax.spines[:].set_visible(True)
            ax.set_title(f"{title} ({nx} x {len(names)})")
            ax.set_xticks(range(len(names)), names, fontsize=letters, rotation=90)
            ax.set_yticks([])
            for first, *_ in runs(keys, units)[1:]:
                ax.axvline(first - 0.5, color="#888888", lw=0.6)
            for first, *_ in runs(lin.state_names, lin.state_units)[1:]:
                ax.axhline(first - 0.5, color="#888888", lw=0.6)
        panel[0].set_yticks(range(nx), lin.state_names, fontsize=letters)
        row_label = "row" if lin.dt else "row's rate"
        figure.colorbar(image, ax=panel, shrink=0.8).set_label(
            f"magnitude, in SI units of the {row_label} per unit of the column"
        )
        time = f", sampled every {lin.dt:g} s" if lin.dt else ""
        figure.suptitle(f"{lin.robot}, frame {lin.frame}{time}")
    return figure


def plot_modes(
    modes: Modes, path: str | Path | None = None, *, axes: Axes | None = None
) -> Figure:
    """Draw the frequency, damping and shape of each mode.

    Parameters
    ----------
    modes : Modes
        Result of `fflin.modes`.
    path : str or Path, optional
        File to save to: .png, .pdf or .svg. See `plot_motion` for possible errors.
    axes : matplotlib.axes.Axes, optional
        Axes of a grid, such as from ``pyplot.subplots``; the figure is drawn in their place.

    Examples
    --------
    >>> springs = {"panel_left": 100.0, "panel_right": 90.0}  # N m/rad
    >>> robot = fflin.load("servicer_7dof", stiffness=springs)
    >>> figure = fflin.plot_modes(fflin.modes(fflin.linearize(robot)), "modes.png")
    """
    instance("modes", modes, Modes, "Modes, as fflin.modes returns")
    count = len(modes.modes)
    half = len(modes.state_names) // 2
    names, units = modes.state_names[:half], modes.state_units[:half]
    title = (
        f"{modes.robot}: {counted(len(modes.vibrations), 'vibration')}, "
        f"{counted(count - len(modes.vibrations), 'real pole')}, "
        f"{counted(modes.rigid_body, 'rigid-body mode')}"
    )
    if not count:
        with drawing(path, 6.5, 1.0, axes=axes) as figure:
            figure.suptitle(f"{title}\nno mode to draw; give a joint a stiffness")
        return figure
    with drawing(path, 5.0 + 0.2 * half, 2.6 + 0.36 * count, axes=axes) as figure:
        from matplotlib.patches import Patch

        panel = figure.add_subplot()
        colors = dict(zip(dict.fromkeys(units), COLORS, strict=False))
        labels = []
        for line, mode in enumerate(modes.modes):
            _draw_shape(
                panel, line, mode.shape[:half], [colors[unit] for unit in units]
            )
            growth = "grows" if mode.unstable else "decays"
            label = f"real, {growth} in {mode.time_constant:.3g} s"
            if mode.oscillates:
                rate = mode.frequency
                hertz = mode.frequency / (2.0 * np.pi)
                label = f"{rate:.3g} rad/s, {hertz:.3g} Hz, damping {mode.damping_ratio:.2g}"
            labels.append(label)
        panel.set_xticks(range(half), names, rotation=90, fontsize=8)
        panel.set_yticks(range(count), labels, fontsize=8)
        panel.set(ylim=(count - 0.5, -0.5), xlim=(-0.6, half - 0.4))
        patches = [
            Patch(color=color, label=f"[{unit}]") for unit, color in colors.items()
        ]
        legend_title = "largest entry: 1; outline: modulus of an entry out of phase"
        figure.legend(
            handles=patches,
            title=legend_title,
            loc="outside lower center",
            ncols=len(colors),
        )
        figure.suptitle(title)
    return figure


def _draw_shape(axes: Axes, line: int, shape: Values, colors: Sequence[str]) -> None:
    """Draw a mode shape with a filled bar for the real part of each entry.

    For entries out of phase, draw also an outlined bar for the modulus.
    """
    # the axis points down
    x = np.arange(len(shape))
    height = -0.45
    axes.axhline(line, color="#888888", lw=0.5)
    axes.bar(x, height * shape.real, 0.7, line, color=colors)
    late = np.flatnonzero(np.abs(shape.imag) > 0.02 * np.abs(shape))
    modulus = height * np.where(shape.real < 0.0, -1.0, 1.0) * np.abs(shape)
    outline = [colors[i] for i in late.tolist()]
    axes.bar(x[late], modulus[late], 0.7, line, fill=False, edgecolor=outline, lw=0.6)


def plot_check(
    check: Check, path: str | Path | None = None, *, axes: Axes | None = None
) -> Figure:
    """Draw each error of a check together with its tolerance.

    Parameters
    ----------
    check : Check
        Result of `fflin.check`.
    path : str or Path, optional
        File to save to: .png, .pdf or .svg. See `plot_motion` for possible errors.
    axes : matplotlib.axes.Axes, optional
        Axes of a grid, such as from ``pyplot.subplots``; the figure is drawn in their place.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> lin = fflin.linearize(robot)
    >>> figure = fflin.plot_check(fflin.check(robot, lin), "check.png")
    """
    instance("check", check, Check, "a Check, as fflin.check returns")
    rows = [row for row in check.rows if row.error != 0.0]
    tests = list(dict.fromkeys(row.test for row in rows))
    main_tests = ("ABA derivatives", "differences")
    labels = {
        row: row.block if row.test in main_tests else f"{row.test}: {row.block}"
        for row in rows
    }
    names = list(dict.fromkeys(labels.values()))
    with drawing(path, 7.5, 2.2 + 0.2 * len(names), axes=axes) as figure:
        panel = figure.add_subplot()
        for shift, test, color in zip(_SHIFTS, tests, COLORS, strict=False):
            shown = [row for row in rows if row.test == test]
            lines = [names.index(labels[row]) + shift for row in shown]
            panel.plot(
                [row.error for row in shown], lines, "o", color=color, ms=4, label=test
            )
            panel.plot([row.tolerance for row in shown], lines, "|", color=color, ms=7)
        bad = check.failures
        panel.plot(
            [row.error for row in bad], [names.index(labels[row]) for row in bad], "rx"
        )
        panel.set_yticks(range(len(names)), names, fontsize=8)
        panel.set(xscale="log", ylim=(max(len(names), 1) - 0.5, -0.5))
        panel.set_xlabel("relative error (dot) and tolerance (bar)")
        verdict = f"OK: {len(check.rows)} errors within tolerance"
        if bad:
            verdict = (
                f"FAILED: {len(bad)} of {len(check.rows)} errors exceed their tolerance"
            )
        exact = len(check.rows) - len(rows)
        panel.set_title(
            f"{check.title}\n{verdict}; {exact} are zero (not drawn)", loc="left"
        )
        figure.legend(loc="outside lower center", ncols=len(tests) or 1)
    return figure


def plot_poles(
    poles: object,
    path: str | Path | None = None,
    *,
    dt: float = 0.0,
    title: str = "poles",
    axes: Axes | None = None,
) -> Figure:
    """Plot a pole map.

    The axes are logarithmic if the poles differ by more than a factor of 10. If a pole oscillates,
    dashed rays, or spirals in z, mark the damping ratios 0.2 to 0.8. Dotted curves mark equal
    natural frequencies; in s, they are circles through the ticks.

    Parameters
    ----------
    poles : array_like or Gain or LinearModel
        Poles [1/s], an object with poles, or several sets {label: poles}.
    path : str or Path, optional
        File to write, .png, .pdf or .svg. See `plot_motion` for possible errors.
    dt : float
        Sample time [s], if the poles are given as numbers. If it is not 0, the unit circle is
        drawn.
    title : str
        Title of the figure.
    axes : matplotlib.axes.Axes, optional
        Axes of a grid, such as from ``pyplot.subplots``; the figure is drawn in their place.

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
    pole_sets = {str(label): _poles_of(given) for label, given in sets.items()}
    dt = next((given_dt for _, given_dt in pole_sets.values() if given_dt), dt)
    with drawing(path, 6.0, 5.0, axes=axes) as figure:
        panel = figure.add_subplot()
        _pole_map(
            panel, {label: values for label, (values, _) in pole_sets.items()}, dt
        )
        panel.set_title(title)
        if any(sets):
            figure.legend(loc="outside lower center", ncols=4)
    return figure


def plot_loops(
    policy: Policy | Gain,
    path: str | Path | None = None,
    *,
    lin: LinearModel | None = None,
    delay: float | None = None,
    sample: float | None = None,
    axes: Axes | None = None,
) -> Figure:
    """Plot the loop gain at each input with the other loops closed, and its margins.

    For a gain alone, the figure contains a Bode plot and the poles. For a policy, or if `lin`,
    `delay` or `sample` is given, it contains a Bode plot, a Nichols plot and the sensitivity of the
    loop with the exact sampled plant, as `margins` uses it.

    A periodic law, such as `MultirateFeedback`, answers one frequency with the N frequencies of its
    period. The figure then contains the largest singular values of the lifted loop, whose signals
    are these N harmonics: its gain, its sensitivity, and its eigenloci, which must not encircle -1.

    Parameters
    ----------
    policy : Policy or Gain
        Linear law about a point, as for `margins`.
    path : str or Path, optional
        File to write, .png, .pdf or .svg. See `plot_motion` for possible errors.
    lin : LinearModel, optional
        Model with which the loop is closed: by default the model for which the law was designed.
    delay : float, optional
        Delay [s] of all inputs, as in `margins`.
    sample : float, optional
        Sample time [s] with which a continuous law is executed.
    axes : matplotlib.axes.Axes, optional
        Axes of a grid, such as from ``pyplot.subplots``; the figure is drawn in their place.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    InputError
        If the policy is not linear about a point, or its model is not known.

    Examples
    --------
    >>> lin = fflin.linearize(fflin.load("planar_detumble"))
    >>> gain = fflin.lqr(lin)
    >>> figure = fflin.plot_loops(gain, "loops.png")
    >>> policy = fflin.StateFeedback(lin, gain.K)
    >>> figure = fflin.plot_loops(policy, "delayed.png", delay=0.1, sample=0.1)
    """
    if not isinstance(policy, Gain | Policy):
        raise InputError(
            f"policy has type {type(policy).__name__}, expected a linear policy, such as a "
            "StateFeedback, or a Gain, as from fflin.lqr"
        )
    figure_file(path)
    if isinstance(policy, Gain) and lin is None and not delay and sample is None:
        return _plot_gain(policy, path, axes)
    if lin is None:
        lin = policy._lin if isinstance(policy, Gain) else policy.model
    if lin is None:
        raise InputError("the model of the law is not known; give lin=")
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        closed = closed_loop(policy, lin, delay, sample)
        if isinstance(closed, PeriodicClosedLoop):
            return plot_periodic(closed, path, axes)
        w, response = loop_responses(closed)
        margins = in_one_thread(closed.margins)()
    return _plot_closed(closed, margins, w, response, path, axes)


def loop_responses(closed: ClosedLoop) -> tuple[Array, Values]:
    """Return frequencies (k,) [rad/s], and the loop gains (k, n) of the channels of a loop."""
    loop = closed.loop()
    if not closed.dt:
        rates = closed.own_rates()
        end = 100.0 * float(rates.max())
    else:
        poles = np.linalg.eigvals(loop[0])
        rates = np.abs(np.log(poles[np.abs(poles) > _DEADBEAT])) / closed.dt
        end = math.pi / closed.dt
    rates = rates[rates > _SLOWEST * end]
    start = 0.01 * min(float(rates.min(initial=end)), end)
    w = np.geomspace(start, end, _POINTS)
    system = as_continuous(*loop, closed.dt)

    def at(frequencies: Array) -> Values:
        # The bilinear map of a sampled loop warps its frequencies.
        warped = np.tan(0.5 * frequencies * closed.dt) if closed.dt else frequencies
        halves = np.array([np.diag(system.at(w)) for w in warped.tolist()])
        # Each entry is (S - T)/2 of one channel, S = 1/(1 + L) and T = L/(1 + L).
        gains: Values = (0.5 - halves) / (0.5 + halves)
        return gains

    return smooth(w, at)


def smooth(w: Array, at: Callable[[Array], Values]) -> tuple[Array, Values]:
    """Return responses (k, n) at frequencies between which their visible phases change little."""
    response = at(w)
    for _ in range(_HALVINGS):
        turns = np.abs(np.angle(response[1:] * response[:-1].conj()))
        shown = _is_visible(response)
        turns[~(shown[1:] | shown[:-1])] = 0.0
        coarse = (turns > _SMOOTH).any(axis=1)
        if not coarse.any() or len(w) > _MOST:
            break
        between = np.sqrt(w[:-1] * w[1:])[coarse]
        places = np.flatnonzero(coarse) + 1
        w = np.insert(w, places, between)
        response = np.insert(response, places, at(between), axis=0)
    return w, response


def _is_visible(response: Values) -> Mask:
    """Return which loop gains are within the limits of a Nichols plot."""
    sizes = np.abs(response)
    largest = 10.0 ** (_DECIBELS / 20.0)
    visible: Mask = (sizes <= largest) & (sizes >= 1.0 / largest)
    return visible


# A loop gain of zero has no finite decibels, and its point is not drawn.
@np.errstate(divide="ignore", invalid="ignore")
def _plot_closed(
    closed: ClosedLoop,
    margins: Margins,
    w: Array,
    response: Values,
    path: str | Path | None,
    axes: Axes | None,
) -> Figure:
    """Draw the Bode plot, the Nichols plot and the sensitivity of a loop."""
    names = list(closed.names)
    if margins.stable:
        names = [
            f"{one.name}: {one.phase:.0f} deg, {one.gain[0]:.2g} to {one.gain[1]:.3g}, "
            f"delay {one.delay:.2g} s"
            for one in margins.channels
        ]
    with drawing(path, 12.0, 8.5, axes=axes) as figure:
        (sizes, nichols), (phases, sensitivity) = figure.subplots(2, 2)
        _bode(sizes, phases, w, response)
        colors = cycle(response.shape[1])
        sensitivity.set_prop_cycle(color=colors)
        draw_nichols(nichols, response)
        size = np.abs(1.0 / (1.0 + response))
        sensitivity.semilogx(w, 20.0 * np.log10(size), lw=1.0)
        sensitivity.axhline(0.0, color=_LINE, lw=0.8)
        sensitivity.set(
            title="sensitivity 1/(1 + L)",
            xlabel="frequency [rad/s]",
            ylabel="[dB]",
            xlim=(w[0], w[-1]),
        )
        legend_below(sizes, names, "margins at each input: phase, gain factors, delay")
        time = f", sampled at {closed.dt:g} s" if closed.dt else ""
        if margins.delay:
            time += f", delay {margins.delay:g} s"
        together = "the loop is unstable"
        if margins.stable:
            low, high = margins.gain
            together = (
                f"margins for simultaneous changes: phase {margins.phase:.3g} deg, gain {low:.2g} "
                f"to {high:.3g} (disk margin {margins.disk:.3g})"
            )
        figure.suptitle(
            f"{margins.robot}{time}: open loop at each input, with the loops of all other inputs "
            f"closed\n{together}",
            x=0.02,
            ha="left",
        )
    return figure


def draw_nichols(panel: Axes, response: Values) -> None:
    """Draw the Nichols plot of loop gains (k, n)."""
    panel.set_prop_cycle(color=cycle(response.shape[1]))
    decibels = 20.0 * np.log10(np.abs(response))
    angles = np.column_stack([phase_of(values) for values in response.T])
    panel.plot(angles, decibels, lw=1.0)
    shown = angles[_is_visible(response)]
    critical = critical_phases(shown)
    panel.plot(critical, np.zeros(len(critical)), "+", color=_LINE, ms=10)
    panel.set(title="Nichols plot", xlabel="phase [deg]", ylabel="|L| [dB]")
    panel.set_ylim(-_DECIBELS, _DECIBELS)
    extent = np.concatenate((shown, critical))
    panel.set_xlim(extent.min() - _BESIDE, extent.max() + _BESIDE)
    panel.locator_params("x", nbins=8, steps=[1, 1.8, 3.6, 4.5, 9, 10])


def critical_phases(angles: Array) -> Array:
    """Return the phases [deg] of L = -1 that are at most 180 deg from the range of phases."""
    if not angles.size:
        return np.array([-180.0])
    first = math.ceil(angles.min() / 360.0)
    last = math.floor(angles.max() / 360.0) + 1
    phases: Array = 360.0 * np.arange(first, last + 1) - 180.0
    return phases


def _plot_gain(gain: Gain, path: str | Path | None, axes: Axes | None) -> Figure:
    """Draw the Bode plot and the poles of a gain."""
    tall = max(8.5, 1.5 + 0.12 * len(gain.K))
    with drawing(path, 11.0, tall, axes=axes) as figure:
        w, response, loops = input_loops(gain)
        sizes, phases, poles = figure.subplots(3, 1)
        _bode(sizes, phases, w, response)
        names = (
            f"{name}: {min(loop.phase, 180.0):.0f} deg, {loop.gain[0]:.2g} to {loop.gain[1]:.3g}"
            for name, loop in zip(gain.input_names, loops, strict=True)
        )
        lines = sizes.get_lines()[: len(loops)]
        legend_title = "margins at each input: phase, gain factors"
        letters = letters_of(1.3 * len(loops), 72.0 * (tall - 1.5))
        figure.legend(
            lines,
            names,
            title=legend_title,
            loc="outside right upper",
            fontsize=letters,
        )
        rates, title, time = gain.poles, "poles of A - B K", ""
        if gain.dt:
            # Discrete-time poles z lie close together near 1, so ln(z)/dt is drawn instead of z.
            rates = np.log(gain.poles[gain.poles != 0.0]) / gain.dt
            title = "poles of A - B K as ln(z)/dt"
            time = f", sampled at {gain.dt:g} s"
        _pole_map(poles, {"": rates}, 0.0)
        poles.set_title(title)
        low, high = gain.margins.gain
        figure.suptitle(
            f"{gain.robot}{time}: open loop at each input, with the loops of all other inputs "
            "closed\nmargins for simultaneous "
            f"changes: phase {gain.margins.phase:.3g} deg, gain {low:.2g} to {high:.3g} (disk "
            f"margin {gain.margins.disk:.3g})",
            x=0.02,
            ha="left",
        )
    return figure


def input_loops(gain: Gain) -> tuple[Array, Values, list[LoopMargins]]:
    """Return frequencies (k,) [rad/s], the loop gains (k, nu) of the inputs, and their margins."""
    # The loop gain of input i is T_ii / (1 - T_ii), with T = K (s I - A + B K)^-1 B. Here s is j w,
    # or e^(j w dt) for a sampled model.
    fed = [gain.state_names.index(name) for name in gain.regulated or gain.state_names]
    F = gain.closed_loop[np.ix_(fed, fed)]
    B = gain.B[fed]
    K = gain.K[:, fed]
    dt = gain.dt

    def response(w: float) -> Values:
        s = np.exp(1j * w * dt) if dt else 1j * w
        T: Values = np.einsum("ij,ji->i", K, np.linalg.solve(s * np.eye(len(F)) - F, B))
        with np.errstate(divide="ignore", invalid="ignore"):
            return T / (1.0 - T)

    rates = np.abs(gain.poles)
    end = 100.0 * float(rates.max())
    if dt:
        rates = np.abs(np.log(gain.poles[gain.poles != 0.0]) / dt)
        end = math.pi / dt
    grid = np.geomspace(min(float(rates.min()), end) / 100.0, end, _POINTS)
    values = np.array([response(w) for w in grid])

    loop = asymmetry(gain)
    loops = []
    for i in range(len(K)):
        limits = channel_limits(loop.channel(i), NO_GRID)
        phases = [crossing.phase for crossing in limits.crossings]
        loops.append(LoopMargins(min(phases, default=math.inf), limits.gain))
    return grid, values, loops


def _bode(sizes: Axes, phases: Axes, w: Array, response: Values) -> None:
    colors = cycle(response.shape[1])
    sizes.set_prop_cycle(color=colors)
    sizes.loglog(w, np.abs(response), lw=1.0)
    shown = []
    for color, values in zip(colors, response.T, strict=True):
        angles = phase_of(values)
        phases.semilogx(w, angles, color=color, lw=1.0)
        shown.append(angles[_is_visible(values)])
    sizes.axhline(1.0, color=_LINE, lw=0.8)
    for critical in critical_phases(np.concatenate(shown)):
        phases.axhline(critical, color=_LINE, lw=0.8)
    phases.locator_params("y", nbins=6, steps=[1, 1.5, 3, 4.5, 6, 9, 10])
    sizes.set(title="loop gain", ylabel="|L|")
    phases.set(title="loop phase", ylabel="[deg]")
    for axes in (sizes, phases):
        axes.set(xlabel="frequency [rad/s]", xlim=(w[0], w[-1]))


def phase_of(values: Values) -> Array:
    """Return the continuous phase [deg] of a response.

    It is between -360 deg and 0 at the first frequency where the gain crosses 1, or where it is
    nearest to 1. At higher frequencies, the gain of a sampled loop may be a rounding error.
    """
    angle = np.degrees(np.unwrap(np.angle(values)))
    sizes = np.abs(values)
    crossings = np.flatnonzero((sizes[1:] > 1.0) != (sizes[:-1] > 1.0))
    at = crossings[0] if len(crossings) else np.abs(sizes - 1.0).argmin()
    turns = math.ceil(angle[at] / 360.0)
    return np.asarray(angle - 360.0 * turns)


def _pole_map(axes: Axes, sets: dict[str, Values], dt: float) -> None:
    for index, (label, values) in enumerate(sets.items()):
        color = COLORS[index % len(COLORS)]
        marker = "+" if index else "x"
        axes.plot(values.real, values.imag, marker, color=color, label=label or None)
    if dt:
        angle = np.linspace(0.0, 2.0 * np.pi, 201)
        axes.plot(np.cos(angle), np.sin(angle), color=_LINE, lw=0.8)
        axes.set_aspect("equal")
        _sampled_grid(axes, dt)
    else:
        axes.axvline(0.0, color=_LINE, lw=0.8)
        every = np.concatenate([np.ravel(values) for values in sets.values()])
        unit = float(np.abs(every).max(initial=0.0))
        logarithmic(axes, "x", every.real, unit)
        logarithmic(axes, "y", every.imag, unit)
        if oscillates(every):
            _damping_grid(axes)
    unit_label = "" if dt else " [1/s]"
    axes.set(xlabel=f"real part{unit_label}", ylabel=f"imaginary part{unit_label}")


def _damping_grid(axes: Axes) -> None:
    """Draw rays of constant damping ratio, and circles of constant natural frequency.

    The circles have the radii of the ticks of an axis, so they need no labels.
    """
    left, right = axes.get_xlim()
    bottom, top = axes.get_ylim()
    if left >= 0.0 or top <= 0.0:
        return
    has_decades = axes.get_xscale() != "linear"
    ticks = axes.get_xticks() if has_decades else axes.get_yticks()
    for frequency in sorted({abs(tick) for tick in ticks.tolist()} - {0.0}):
        _grid_line(axes, equally_fast_poles(frequency), "_natural frequency", ":")
    ends = {}
    for ratio in RATIOS:
        # The ray ends at the left or upper edge.
        end = min(-left / ratio, top / math.sqrt(1.0 - ratio * ratio))
        frequencies = np.concatenate(([0.0], np.geomspace(1e-9 * end, end, 200)))
        poles = damped_poles(ratio, frequencies)
        _grid_line(axes, poles, "_damping", "--")
        ends[ratio] = poles[-1]
    axes.set(xlim=(left, right), ylim=(bottom, top))
    _label_ratios(axes, ends)


def _sampled_grid(axes: Axes, dt: float) -> None:
    """Draw spirals of constant damping ratio, and curves of constant natural frequency."""
    limits = {"xlim": axes.get_xlim(), "ylim": axes.get_ylim()}
    middles = {}
    for ratio in RATIOS:
        end = nyquist_frequency(ratio, dt)
        poles = damped_poles(ratio, np.linspace(0.0, end, 200), dt)
        _grid_line(axes, poles, "_damping", "--")
        middles[ratio] = poles[len(poles) // 2]
    for part in (0.2, 0.4, 0.6, 0.8):
        frequency = part * math.pi / dt
        poles = equally_fast_poles(frequency, dt)
        _grid_line(axes, poles, "_natural frequency", ":")
        tip = 0.96 * poles[0]
        axes.text(
            tip.real,
            tip.imag,
            f"{frequency:.3g} rad/s",
            ha="right" if tip.real > 0.0 else "left",
            va="top",
            **_GRID_TEXT,
        )
    axes.set(**limits)
    _label_ratios(axes, middles)


def _grid_line(axes: Axes, poles: Values, label: str, style: str) -> None:
    """Draw a curve of poles and its reflection at the real axis."""
    axes.grid(visible=False)
    for half in (poles, poles.conj()):
        axes.plot(
            half.real,
            half.imag,
            color=_GRID,
            lw=0.6,
            ls=style,
            label=label,
            zorder=0.8,
        )


def _label_ratios(axes: Axes, ends: Mapping[float, complex]) -> None:
    """Write damping ratios at points {ratio: pole}, each within the axes."""
    to_fraction = axes.transData + axes.transAxes.inverted()
    labels = []
    for ratio, pole in ends.items():
        x, y = to_fraction.transform((pole.real, pole.imag)).tolist()
        labels.append(Label(x, y, f"\N{GREEK SMALL LETTER ZETA} {ratio:g}"))
    width, height = _LABEL_SIZE
    for label in spaced(labels, width, height):
        axes.text(
            max(label.x, 0.01),
            label.y,
            label.text,
            ha="left" if label.x < width / 2.0 else "center",
            va="top" if label.y > 1.0 - height / 2.0 else "center",
            transform=axes.transAxes,
            **_GRID_TEXT,
        )


def _poles_of(given: object) -> tuple[Values, float]:
    if isinstance(given, LinearModel):
        return np.linalg.eigvals(given.A), given.dt
    if hasattr(given, "poles"):
        dt = float(given.dt) if hasattr(given, "dt") else 0.0
        return np.asarray(given.poles), dt
    refuse_masked("poles", given)
    flat = dimension("poles", given) == 1
    poles = np.asarray(given)
    if not (
        flat and poles.dtype.kind in "fiuc" and poles.size and np.isfinite(poles).all()
    ):
        raise InputError(
            f"poles has type {type(given).__name__} of shape {poles.shape}, expected finite "
            "numbers (k,), a Gain, a LinearModel or {label: poles}"
        )
    return poles, 0.0
