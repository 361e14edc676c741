"""Figures of linear models: A and B, modes, and the errors of a check."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fflin.analysis.modes import Modes
from fflin.base.figures import COLORS, drawing, letters_of
from fflin.base.names import input_keys, runs
from fflin.base.tables import counted, rounding
from fflin.base.validation import Values, instance
from fflin.linear.check import Check
from fflin.linear.model import LinearModel

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Vertical offsets of the tests, so that the points of two independent computations do not overlap.
_SHIFTS = (-0.15, 0.15, 0.0, 0.0, 0.0, 0.0)


def plot_matrices(lin: LinearModel, path: str | Path | None = None) -> Figure:
    """Draw the magnitudes of the entries of A and B; entries within rounding error stay blank.

    Parameters
    ----------
    lin : LinearModel
        Model to draw.
    path : str or Path, optional
        File to save to: .png, .pdf or .svg. See `plot_motion` for possible errors.

    Examples
    --------
    >>> lin = fflin.linearize(fflin.load("planar_detumble"))
    >>> figure = fflin.plot_matrices(lin, "matrices.png")
    """
    instance("lin", lin, LinearModel, "a fflin.LinearModel")
    nx, nu = lin.B.shape
    cell = max(0.24 * min(1.0, 24.0 / nx), min(0.12, 12.0 / nx))  # inches
    size = (4.2 + cell * (nx + nu), 2.6 + cell * nx)
    with drawing(path, *size, compressed=True) as figure:
        from matplotlib.colors import LogNorm

        axes = figure.subplots(1, 2, gridspec_kw={"width_ratios": (nx, nu)})
        drawn = [
            np.ma.masked_where((m == 0.0) | (np.abs(m) < rounding(m)), np.abs(m))
            for m in (lin.A, lin.B)
        ]
        entries = np.concatenate([m.compressed() for m in drawn])
        top = float(entries.max(initial=0.0)) or 1.0
        norm = LogNorm(float(entries.min(initial=top)), 1.01 * top)
        signals = (
            (lin.state_names, lin.state_names, lin.state_units),
            (lin.input_names, input_keys(lin), lin.input_units),
        )
        letters = letters_of(1, 72.0 * cell)
        groups = [first for first, *_ in runs(lin.state_names, lin.state_units)[1:]]
        for ax, sizes, (names, keys, units) in zip(axes, drawn, signals, strict=True):
            image = ax.imshow(sizes, cmap="viridis_r", norm=norm)
            ax.grid(visible=False)
            ax.spines[:].set_visible(True)
            ax.set_xticks(range(len(names)), names, fontsize=letters, rotation=90)
            for first, *_ in runs(keys, units)[1:]:
                ax.axvline(first - 0.5, color="#888888", lw=0.6)
            for first in groups:
                ax.axhline(first - 0.5, color="#888888", lw=0.6)
        axes[0].set_yticks(range(nx), lin.state_names, fontsize=letters)
        axes[1].set_yticks([])
        axes[0].set_title(f"A ({nx} x {nx})")
        axes[1].set_title(f"B ({nx} x {nu})")
        of = "row" if lin.dt else "row's rate"
        figure.colorbar(image, ax=axes, shrink=0.8).set_label(
            f"magnitude, in SI units of the {of} per unit of the column"
        )
        time = f", sampled every {lin.dt:g} s" if lin.dt else ""
        figure.suptitle(f"{lin.robot}, frame {lin.frame}{time}")
    return figure


def plot_modes(modes: Modes, path: str | Path | None = None) -> Figure:
    """Draw the frequency, damping and shape of each mode.

    Parameters
    ----------
    modes : Modes
        Result of `fflin.modes`.
    path : str or Path, optional
        File to save to: .png, .pdf or .svg. See `plot_motion` for possible errors.

    Examples
    --------
    >>> springs = {"panel_left": 100.0, "panel_right": 90.0}  # N m/rad
    >>> robot = fflin.load("servicer_7dof", stiffness=springs)
    >>> figure = fflin.plot_modes(fflin.modes(fflin.linearize(robot)), "modes.png")
    """
    instance("modes", modes, Modes, "Modes, as fflin.modes returns")
    count, half = len(modes.modes), len(modes.state_names) // 2
    names, units = modes.state_names[:half], modes.state_units[:half]
    title = (
        f"{modes.robot}: {counted(len(modes.vibrations), 'vibration')}, "
        f"{counted(count - len(modes.vibrations), 'real pole')}, "
        f"{counted(modes.rigid_body, 'rigid-body mode')}"
    )
    if not count:
        with drawing(path, 6.5, 1.0) as figure:
            figure.suptitle(f"{title}\nno mode to draw; give a joint a stiffness")
        return figure
    with drawing(path, 5.0 + 0.2 * half, 2.6 + 0.36 * count) as figure:
        from matplotlib.patches import Patch

        axes = figure.add_subplot()
        colors = dict(zip(dict.fromkeys(units), COLORS, strict=False))
        labels = []
        for line, mode in enumerate(modes.modes):
            _draw_shape(axes, line, mode.shape[:half], [colors[unit] for unit in units])
            growth = "grows" if mode.unstable else "decays"
            label = f"real, {growth} in {mode.time_constant:.3g} s"
            if mode.oscillates:
                label = (
                    f"{mode.frequency:.3g} rad/s, {mode.frequency / (2.0 * np.pi):.3g} Hz, "
                    f"damping {mode.damping_ratio:.2g}"
                )
            labels.append(label)
        axes.set_xticks(range(half), names, rotation=90, fontsize=8)
        axes.set_yticks(range(count), labels, fontsize=8)
        axes.set(ylim=(count - 0.5, -0.5), xlim=(-0.6, half - 0.4))
        figure.legend(
            handles=[Patch(color=color, label=f"[{unit}]") for unit, color in colors.items()],
            title="largest entry: 1; outline: modulus of an entry out of phase",
            loc="outside lower center",
            ncols=len(colors),
        )
        figure.suptitle(title)
    return figure


def _draw_shape(axes: Axes, line: int, shape: Values, colors: Sequence[str]) -> None:
    """Draw a shape as bars on its line: the real part filled, the modulus outlined."""
    x, height = np.arange(len(shape)), -0.45  # the axis points down
    axes.axhline(line, color="#888888", lw=0.5)
    axes.bar(x, height * shape.real, 0.7, line, color=colors)
    late = np.flatnonzero(np.abs(shape.imag) > 0.02 * np.abs(shape))
    modulus = height * np.where(shape.real < 0.0, -1.0, 1.0) * np.abs(shape)
    outline = [colors[i] for i in late.tolist()]
    axes.bar(x[late], modulus[late], 0.7, line, fill=False, edgecolor=outline, lw=0.6)


def plot_check(check: Check, path: str | Path | None = None) -> Figure:
    """Draw each error of a check together with its tolerance.

    Parameters
    ----------
    check : Check
        Result of `fflin.check`.
    path : str or Path, optional
        File to save to: .png, .pdf or .svg. See `plot_motion` for possible errors.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> lin = fflin.linearize(robot)
    >>> figure = fflin.plot_check(fflin.check(robot, lin), "check.png")
    """
    instance("check", check, Check, "a Check, as fflin.check returns")
    rows = [row for row in check.rows if row.error != 0.0]
    tests = list(dict.fromkeys(row.test for row in rows))
    own = ("ABA derivatives", "differences")
    labels = {row: row.block if row.test in own else f"{row.test}: {row.block}" for row in rows}
    names = list(dict.fromkeys(labels.values()))
    with drawing(path, 7.5, 2.2 + 0.2 * len(names)) as figure:
        axes = figure.add_subplot()
        for shift, test, color in zip(_SHIFTS, tests, COLORS, strict=False):
            shown = [row for row in rows if row.test == test]
            lines = [names.index(labels[row]) + shift for row in shown]
            axes.plot([row.error for row in shown], lines, "o", color=color, ms=4, label=test)
            axes.plot([row.tolerance for row in shown], lines, "|", color=color, ms=7)
        bad = [row for row in rows if not row.ok]
        axes.plot([row.error for row in bad], [names.index(labels[row]) for row in bad], "rx")
        axes.set_yticks(range(len(names)), names, fontsize=8)
        axes.set(xscale="log", ylim=(max(len(names), 1) - 0.5, -0.5))
        axes.set_xlabel("relative error (dot) and tolerance (bar)")
        verdict = f"OK: {len(check.rows)} errors within tolerance"
        if bad:
            verdict = f"FAILED: {len(bad)} of {len(check.rows)} errors exceed their tolerance"
        exact = len(check.rows) - len(rows)
        axes.set_title(f"{check.title}\n{verdict}; {exact} are zero (not drawn)", loc="left")
        figure.legend(loc="outside lower center", ncols=len(tests) or 1)
    return figure
