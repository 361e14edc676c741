"""Figures of linear models: poles, the pattern of A and B, and how far they are valid."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fflin.base.errors import InputError
from fflin.base.figures import COLORS, saved, styled, target_of
from fflin.base.validation import Array, number
from fflin.linear.model import LinearModel

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from fflin.analysis.validity import Validity


def plot_poles(
    poles: Any, path: str | Path | None = None, *, dt: float = 0.0, title: str = "poles"
) -> Figure:
    """Draw a pole map.

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
    with styled() as figure_class:
        figure = figure_class(figsize=(5.5, 5.0), layout="constrained")
        axes = figure.add_subplot()
        for place, (label, given) in enumerate(sets.items()):
            values, own_dt = _poles_of(given)
            dt = own_dt or dt
            axes.plot(
                values.real,
                values.imag,
                "x" if place == 0 else "+",
                color=COLORS[place % len(COLORS)],
                label=label or None,
            )
        if dt:
            angle = np.linspace(0.0, 2.0 * np.pi, 201)
            axes.plot(np.cos(angle), np.sin(angle), color="#888888", lw=0.8)
            axes.set_aspect("equal")
        else:
            axes.axvline(0.0, color="#888888", lw=0.8)
        unit = "" if dt else " [1/s]"
        axes.set(xlabel=f"real part{unit}", ylabel=f"imaginary part{unit}", title=title)
        if any(sets):
            axes.legend()
        return saved(figure, target)


def plot_matrices(lin: LinearModel, path: str | Path | None = None) -> Figure:
    """Draw which entries of A and B are not zero, and how large they are.

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
        nx, nu = lin.B.shape
        size = min(1.0, 24.0 / nx)
        letters = min(8.0, 16.0 * size)
        figure = figure_class(figsize=(2.8 + 0.26 * size * (nx + nu), 2.0 + 0.26 * size * nx))
        figure.set_layout_engine("constrained")
        axes = figure.subplots(1, 2, gridspec_kw={"width_ratios": (nx, nu)})
        entries = np.abs(np.hstack((lin.A, lin.B)))
        top = float(np.log10(entries.max() or 1.0))
        # Entries below the rounding of the largest would use up the range of colours.
        least = max(top - 12.0, float(np.log10(entries[entries > 0.0].min(initial=10.0**top))))
        for ax, values, name, columns in zip(
            axes, (lin.A, lin.B), "AB", (lin.state_names, lin.input_names), strict=True
        ):
            image = _spy(ax, values, columns, letters, (least, top))
            ax.set_title(f"{name} ({values.shape[0]} x {values.shape[1]})")
        axes[0].set_yticks(range(nx), lin.state_names, fontsize=letters)
        axes[1].set_yticks([])
        figure.colorbar(image, ax=axes, shrink=0.7).set_label("log10 of the magnitude")
        figure.suptitle(f"{lin.robot}, frame {lin.frame}")
        return saved(figure, target)


def plot_validity(validity: Validity, path: str | Path | None = None) -> Figure:
    """Draw how far a linear model foresees the nonlinear loop, and which random runs settled.

    Parameters
    ----------
    validity : Validity
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
    from fflin.analysis.displacement import shown
    from fflin.analysis.validity import TRUSTED, Validity

    if not isinstance(validity, Validity):
        raise InputError(
            f"validity is a {type(validity).__name__}, expected what fflin.validity returns"
        )
    target = target_of(path)
    percent = 100.0
    with styled() as figure_class:
        figure = figure_class(figsize=(9.0, 4.0), layout="constrained")
        left, right = figure.subplots(1, 2)
        measured = np.isfinite(validity.prediction_error)
        levels, errors = (each[measured] for each in (validity.levels, validity.prediction_error))
        left.loglog(percent * levels, percent * errors, "o-", color=COLORS[0], ms=3)
        left.axhline(percent * TRUSTED, color="#888888", lw=0.8)
        left.annotate(
            f"trusted up to {percent * TRUSTED:g} %",
            (0.01, percent * TRUSTED),
            xytext=(0, 3),
            xycoords=left.get_yaxis_transform(),
            textcoords="offset points",
            fontsize=8,
        )
        left.set_xticks(percent * validity.levels, [f"{percent * x:.3g}" for x in validity.levels])
        left.minorticks_off()
        left.set(
            title="prediction error of the linear loop",
            xlabel="displacement [% of the largest]",
            ylabel="error [% of the displacement]",
        )
        if np.isfinite(validity.slope):
            order = f"error ~ displacement^{validity.slope:.2f}"
            left.text(0.97, 0.05, order, transform=left.transAxes, ha="right")

        settled = np.array([outcome == "settled" for outcome in validity.outcomes])
        edges = np.linspace(0.0, 1.0, 11)
        counts = [np.histogram(validity.sampled[at], edges)[0] for at in (settled, ~settled)]
        middles, wide = percent * (edges[1:] + edges[:-1]) / 2.0, percent * 0.09
        right.bar(middles, counts[0], wide, color=COLORS[2], label="settled")
        right.bar(middles, counts[1], wide, bottom=counts[0], color=COLORS[1], label="not settled")
        low, high = validity.rate
        right.set(
            title=f"{validity.settled} of {len(settled)} runs settled",
            xlabel="displacement [% of the largest]",
            ylabel="runs",
        )
        right.yaxis.get_major_locator().set_params(integer=True)
        right.set_ylim(0.0, 1.25 * float(np.add(*counts).max()))
        right.legend(loc="upper left", ncols=2)
        figure.suptitle(
            f"{validity.robot}, up to {shown(validity.largest)}; {percent * low:.1f} to "
            f"{percent * high:.1f} % settle ({percent * validity.confidence:g} % confidence)",
            fontsize=10,
        )
        return saved(figure, target)


def _spy(
    axes: Axes, values: Array, columns: Sequence[str], size: float, limits: tuple[float, float]
) -> Any:
    filled = np.abs(values) > 0.0
    axes.set_xticks(range(len(columns)), columns, rotation=90, fontsize=size)
    axes.grid(visible=False)
    shown = np.full(values.shape, np.nan)
    shown[filled] = np.maximum(np.log10(np.abs(values[filled])), limits[0])
    return axes.imshow(shown, cmap="viridis", aspect="equal", vmin=limits[0], vmax=limits[1])


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
