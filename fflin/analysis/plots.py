"""Figures of linear models: the pattern of A and B, natural modes, and what a check found."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fflin.analysis.modes import Mode, Modes
from fflin.base.errors import InputError
from fflin.base.figures import COLORS, letters_of, saved, styled, target_of
from fflin.base.tables import counted
from fflin.linear.check import Check
from fflin.linear.model import LinearModel

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# With more states than this, names of the groups alone can be read.
_MANY = 110

# Of the two routes to a block, one is drawn above its line and one below.
_SHIFTS = (-0.15, 0.15, 0.0, 0.0, 0.0, 0.0)


def plot_matrices(lin: LinearModel, path: str | Path | None = None) -> Figure:
    """Draw which entries of A and B are not zero, and how large they are, by groups.

    Parameters
    ----------
    lin : LinearModel
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
    if not isinstance(lin, LinearModel):
        raise InputError(f"lin is a {type(lin).__name__}, expected a fflin.LinearModel")
    target = target_of(path)
    with styled() as figure_class:
        from matplotlib.colors import LogNorm

        nx, nu = lin.B.shape
        cell = max(0.24 * min(1.0, 24.0 / nx), min(0.12, 12.0 / nx))  # inches
        figure = figure_class(
            figsize=(4.2 + cell * (nx + nu), 2.6 + cell * nx), layout="compressed"
        )
        axes = figure.subplots(1, 2, gridspec_kw={"width_ratios": (nx, nu)}, sharey=True)
        entries = np.abs(np.hstack((lin.A, lin.B)))
        top = float(entries.max()) or 1.0
        # Entries below the rounding of the largest would use up the range of colours.
        least = max(1e-12 * top, float(entries[entries > 0.0].min(initial=top)))
        norm = LogNorm(least, max(top, 1.01 * least))
        columns = (
            (lin.A, lin.state_names, lin.state_units),
            (lin.B, lin.input_names, lin.input_units),
        )
        letters = letters_of(1, 72.0 * cell)
        for ax, name, (values, names, units) in zip(axes, "AB", columns, strict=True):
            sizes = np.ma.masked_equal(np.abs(values), 0.0).clip(least, None)
            image = ax.imshow(sizes, cmap="viridis_r", aspect="equal", norm=norm)
            ax.set_title(f"{name} ({values.shape[0]} x {values.shape[1]})")
            ax.grid(visible=False)
            ax.spines[:].set_visible(True)
            _grouped(ax, "x", names, units, letters)
        _grouped(axes[1], "y", lin.state_names, lin.state_units, letters)
        axes[1].tick_params(axis="y", which="both", labelleft=False, length=0)
        for start in _groups(lin.state_names, lin.state_units)[1:]:
            axes[0].axhline(start[0] - 0.5, color="#888888", lw=0.6)
        axes[0].set_yticks(*_ticks(lin.state_names), fontsize=letters)
        figure.colorbar(image, ax=axes, shrink=0.8).set_label(
            "size, each entry in SI units of its row's rate per unit of its column"
            if not lin.dt
            else "size, each entry in SI units of its row per unit of its column"
        )
        time = f", sampled every {lin.dt:g} s" if lin.dt else ""
        figure.suptitle(f"{lin.robot}, frame {lin.frame}{time}")
        return saved(figure, target)


def _groups(names: Sequence[str], units: Sequence[str]) -> list[tuple[int, int, str]]:
    """Return (first, last, label) of the runs of names of one group, or of one unit without."""
    found: list[tuple[int, int, str, list[str]]] = []
    for i, (name, unit) in enumerate(zip(names, units, strict=True)):
        group = name.rpartition(".")[0]
        if found and found[-1][2] == group and (group or unit in found[-1][3]):
            first, _, _, others = found.pop()
            found.append((first, i, group, [*others, unit]))
        else:
            found.append((i, i, group, [unit]))
    return [
        (first, last, f"{group} [{'|'.join(dict.fromkeys(of))}]".strip())
        for first, last, group, of in found
    ]


def _ticks(names: Sequence[str]) -> tuple[list[int], list[str]]:
    if len(names) > _MANY:
        return [], []
    return list(range(len(names))), [name.rpartition(".")[2] for name in names]


def _grouped(
    axes: Axes, axis: str, names: Sequence[str], units: Sequence[str], letters: float
) -> None:
    """Name the columns below and their groups above; the groups of rows at the right."""
    groups = _groups(names, units)
    middles = [(first + last) / 2.0 for first, last, _ in groups]
    labels = [label for _, _, label in groups]
    if axis == "x":
        axes.set_xticks(*_ticks(names), rotation=90, fontsize=letters)
        other = axes.secondary_xaxis("top")
        # Three axes of the base are the narrowest group that stands beside others.
        size = max(4.0, min(7.0, 0.9 * letters))
        other.set_xticks(middles, [label.replace(" ", "\n", 1) for label in labels], fontsize=size)
    else:
        other = axes.secondary_yaxis("right")
        other.set_yticks(middles, labels, fontsize=7)
    other.tick_params(length=0)
    for first, _, _ in groups[1:]:
        (axes.axvline if axis == "x" else axes.axhline)(first - 0.5, color="#888888", lw=0.6)


def plot_modes(modes: Modes, path: str | Path | None = None) -> Figure:
    """Draw the frequency and damping of each mode, and how far each position moves in it.

    Parameters
    ----------
    modes : Modes
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
    if not isinstance(modes, Modes):
        raise InputError(f"modes is a {type(modes).__name__}, expected what fflin.modes returns")
    target = target_of(path)
    count, names = len(modes.modes), modes.state_names[: len(modes.state_names) // 2]
    title = (
        f"{modes.robot}: {counted(len(modes.vibrations), 'vibration')}, "
        f"{counted(count - len(modes.vibrations), 'real pole')}, "
        f"{counted(modes.rigid_body, 'rigid-body mode')}"
    )
    with styled() as figure_class:
        if not count:
            figure = figure_class(figsize=(6.5, 1.0))
            figure.suptitle(
                f"{title}\nnothing opposes a motion; a joint with a stiffness vibrates", y=0.7
            )
            return saved(figure, target)
        from matplotlib.patches import Patch
        from matplotlib.ticker import NullFormatter

        figure = figure_class(
            figsize=(6.5 + 0.2 * len(names), 3.0 + 0.36 * count), layout="constrained"
        )
        shapes, rates, damping = figure.subplots(
            1, 3, sharey=True, gridspec_kw={"width_ratios": (0.2 * len(names) + 1.0, 1.6, 1.6)}
        )
        units = modes.state_units[: len(names)]
        colors = dict(zip(dict.fromkeys(units), COLORS, strict=False))
        for place, mode in enumerate(modes.modes):
            _bars(shapes, place, mode.shape[: len(names)], [colors[unit] for unit in units])
        grows = [COLORS[1] if mode.unstable else "#000000" for mode in modes.modes]
        rates.scatter([mode.frequency for mode in modes.modes], range(count), c=grows, s=16)
        shapes.set_xticks(range(len(names)), names, rotation=90, fontsize=8)
        shapes.set_yticks(range(count), [_said(mode) for mode in modes.modes], fontsize=8)
        shapes.set(ylim=(count - 0.5, -0.5), xlim=(-0.6, len(names) - 0.4), title="shape")
        turn = 2.0 * np.pi
        top = rates.secondary_xaxis("top", functions=(lambda w: w / turn, lambda f: turn * f))
        top.set_xlabel("[Hz]")
        rates.set(xscale="log", xlabel="[rad/s]", title="frequency")
        ends = np.log10([mode.frequency for mode in modes.modes])
        rates.set_xlim(10.0 ** np.floor(ends.min() - 0.1), 10.0 ** np.ceil(ends.max() + 0.1))
        for axis in (rates.xaxis, top.xaxis):
            axis.set_minor_formatter(NullFormatter())
        ratios = [mode.damping_ratio for mode in modes.modes]
        damping.scatter(ratios, range(count), c=grows, s=16)
        damping.set(title="damping ratio", xlabel="[1]; orange: grows")
        damping.set_xlim(1.1 * min(-0.01, *ratios), 1.1 * max(0.01, *ratios))
        figure.legend(
            handles=[Patch(color=color, label=f"[{unit}]") for unit, color in colors.items()],
            title="what moves most is 1; outline: modulus of what is out of phase",
            loc="outside lower center",
            ncols=len(colors),
        )
        figure.suptitle(title)
        return saved(figure, target)


def _bars(axes: Axes, place: int, shape: Any, colors: Sequence[str]) -> None:
    """Draw a shape as bars about its line: filled what is in phase, outlined the modulus."""
    x, half = np.arange(len(shape)), 0.45
    axes.axhline(place, color="#888888", lw=0.5)
    axes.bar(x, -half * shape.real, 0.7, place, color=colors)  # the axis points down
    late = np.flatnonzero(np.abs(shape.imag) > 0.02 * np.abs(shape))
    whole = np.where(shape.real < 0.0, half, -half) * np.abs(shape)
    outline = [colors[i] for i in late]
    axes.bar(x[late], whole[late], 0.7, place, fill=False, edgecolor=outline, lw=0.6)


def _said(mode: Mode) -> str:
    if not mode.oscillates:
        return f"real, {'grows' if mode.unstable else 'decays'} in {mode.time_constant:.3g} s"
    return (
        f"{mode.frequency:.3g} rad/s, {mode.frequency / (2.0 * np.pi):.3g} Hz, "
        f"damping {mode.damping_ratio:.2g}"
    )


def plot_check(check: Check, path: str | Path | None = None) -> Figure:
    """Draw each error that a check found beside what it must not exceed.

    Parameters
    ----------
    check : Check
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
    if not isinstance(check, Check):
        raise InputError(f"check is a {type(check).__name__}, expected what fflin.check returns")
    target = target_of(path)
    rows = [row for row in check.rows if row.error != 0.0]
    tests = list(dict.fromkeys(row.test for row in rows))
    names = list(dict.fromkeys(_place(row) for row in rows))
    with styled() as figure_class:
        figure = figure_class(figsize=(7.5, 2.2 + 0.2 * len(names)), layout="constrained")
        axes = figure.add_subplot()
        for shift, test, color in zip(_SHIFTS, tests, COLORS, strict=False):
            shown = [row for row in rows if row.test == test]
            places = [names.index(_place(row)) + shift for row in shown]
            axes.plot([row.error for row in shown], places, "o", color=color, ms=4, label=test)
            axes.plot([row.tolerance for row in shown], places, "|", color=color, ms=7)
        bad = [row for row in rows if not row.ok]
        axes.plot([row.error for row in bad], [names.index(_place(row)) for row in bad], "rx")
        axes.set_yticks(range(len(names)), names, fontsize=8)
        axes.set(xscale="log", ylim=(max(len(names), 1) - 0.5, -0.5))
        axes.set_xlabel("relative error (dot) and what it must not exceed (bar)")
        held = (
            f"FAILED: {len(bad)} of {len(check.rows)} figures"
            if bad
            else (f"OK: {len(check.rows)} figures hold")
        )
        exact = len(check.rows) - len(rows)
        axes.set_title(
            f"{check.title}\n{held}; {exact} agree to the last bit and are not drawn", loc="left"
        )
        figure.legend(loc="outside lower center", ncols=len(tests) or 1)
        return saved(figure, target)


def _place(row: Any) -> str:
    both = ("ABA derivatives", "differences")
    return row.block if row.test in both else f"{row.test}: {row.block}"
