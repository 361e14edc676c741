"""Figures of motions and linear models, with matplotlib."""

from __future__ import annotations

import importlib.util
import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fflin.errors import FileError, InputError, MissingPackageError
from fflin.files import as_path, write_whole
from fflin.linear_model import LinearModel
from fflin.motion import Motion, require_motion
from fflin.validation import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FORMATS = (".png", ".pdf", ".svg")

_COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000", "#8a6d3b")
_STYLE: dict[Any, Any] = {
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.titleweight": "bold",
    "axes.grid": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "grid.color": "#dddddd",
    "grid.linewidth": 0.6,
    "lines.linewidth": 1.4,
    "legend.frameon": False,
    "legend.fontsize": 8,
    "figure.dpi": 150,
    "savefig.dpi": 150,
}
_DASHES = ("-", "--", ":", "-.")
_GROUPS = {
    "q_b": "attitude q_b",
    "r_b": "position r_b",
    "q_m": "joints q_m",
    "omega_b": "angular velocity omega_b",
    "v_b": "velocity v_b",
    "qdot_m": "joint rates",
}


def plot_motion(motion: Motion, path: str | Path | None = None) -> Figure:
    """Draw the errors, inputs and momentum drift of a motion, linear beside nonlinear.

    Parameters
    ----------
    motion : Motion
        With a prediction, each group of states shows the nonlinear robot in full lines and the
        linear model dashed, and below it their difference.
    path : str or Path, optional
        .png, .pdf or .svg to save to.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    MissingPackageError
        If matplotlib is not installed.
    FileError
        If the ending is another or the file cannot be written.
    """
    motion = require_motion(motion)
    target = _target(path)
    with _styled() as figure_class:
        both = motion.linear is not None
        groups = _by_group(motion.state_names)
        figure = figure_class(figsize=(11.0, 10.5 if both else 8.5), layout="constrained")
        heights = [3.0, 1.2] * 2 if both else [3.0] * 2
        grid = figure.add_gridspec(
            len(heights) + 1, 3, height_ratios=[*heights, 3.0], hspace=0.06, wspace=0.06
        )
        for place, (group, indices) in enumerate(groups.items()):
            row, column = divmod(place, 3)
            axes = figure.add_subplot(grid[row * (1 + both), column])
            _histories(axes, motion, group, indices)
            if both:
                below = figure.add_subplot(grid[2 * row + 1, column], sharex=axes)
                _difference(below, motion, indices)
                axes.tick_params(labelbottom=False)
            else:
                axes.set_xlabel("t [s]")
        _inputs(figure, grid, motion, len(heights))
        _momentum(figure.add_subplot(grid[len(heights), 2]), motion)
        figure.suptitle(_title(motion, both), fontsize=11)
        return _saved(figure, target)


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
    target = _target(path)
    sets = poles if isinstance(poles, dict) else {"": poles}
    with _styled() as figure_class:
        figure = figure_class(figsize=(5.5, 5.0), layout="constrained")
        axes = figure.add_subplot()
        for number, (label, given) in enumerate(sets.items()):
            values, own_dt = _poles_of(given)
            dt = own_dt or dt
            axes.plot(
                values.real,
                values.imag,
                "x" if number == 0 else "+",
                color=_COLORS[number % len(_COLORS)],
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
        return _saved(figure, target)


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
    target = _target(path)
    with _styled() as figure_class:
        nx, nu = lin.B.shape
        size = min(1.0, 24.0 / nx)
        figure = figure_class(figsize=(2.8 + 0.26 * size * (nx + nu), 2.0 + 0.26 * size * nx))
        figure.set_layout_engine("constrained")
        axes = figure.subplots(1, 2, gridspec_kw={"width_ratios": (nx, nu)})
        entries = np.abs(np.hstack((lin.A, lin.B)))
        top = float(np.log10(entries.max()))
        # What is below the rounding of the largest entry would take all the colours.
        least = max(top - 12.0, float(np.log10(entries[entries > 0.0].min())))
        for ax, values, name, columns in zip(
            axes, (lin.A, lin.B), "AB", (lin.state_names, lin.input_names), strict=True
        ):
            image = _spy(ax, values, columns, 8.0 * size, (least, top))
            ax.set_title(f"{name} ({values.shape[0]} x {values.shape[1]})")
        axes[0].set_yticks(range(nx), lin.state_names, fontsize=8.0 * size)
        axes[1].set_yticks([])
        figure.colorbar(image, ax=axes, shrink=0.7).set_label("log10 of the magnitude")
        figure.suptitle(f"{lin.robot}, frame {lin.frame}")
        return _saved(figure, target)


def _histories(axes: Axes, motion: Motion, group: str, indices: list[int]) -> None:
    for color, i in zip(_cycle(len(indices)), indices, strict=True):
        axes.plot(motion.t, motion.x[:, i], color=color, label=_short(motion.state_names[i]))
        if motion.linear is not None:
            axes.plot(motion.t, motion.linear[:, i], "--", color=color, lw=1.0)
    units = sorted({motion.state_units[i] for i in indices})
    axes.set(title=_GROUPS[group], ylabel=_unit(units))
    axes.legend(ncols=3 if len(indices) > 4 else 1, loc="best", handlelength=1.2)
    axes.margins(x=0.0)


def _difference(axes: Axes, motion: Motion, indices: list[int]) -> None:
    assert motion.linear is not None
    for color, i in zip(_cycle(len(indices)), indices, strict=True):
        axes.plot(motion.t, motion.x[:, i] - motion.linear[:, i], color=color, lw=1.0)
    axes.set(xlabel="t [s]", ylabel="difference")
    axes.margins(x=0.0)
    axes.ticklabel_format(axis="y", scilimits=(-2, 3))


def _inputs(figure: Figure, grid: Any, motion: Motion, row: int) -> None:
    """Draw what drives the joints beside what pushes the base, whose sizes differ widely."""
    groups = _by_group(motion.input_names)
    joints = {"tau_m": groups.pop("tau_m")} if "tau_m" in groups else {}
    panels = [panel for panel in (groups, joints) if panel]
    places = (0, 1) if len(panels) == 2 else (slice(0, 2),)
    for place, panel in zip(places, panels, strict=True):
        axes = figure.add_subplot(grid[row, place])
        for style, indices in zip(
            ("-", "--", ":", "-.") * len(panel), panel.values(), strict=False
        ):
            for color, i in zip(_cycle(len(indices)), indices, strict=True):
                name = motion.input_names[i]
                label = _short(name) if panel is joints else name
                axes.step(motion.t, motion.u[:, i], style, color=color, where="post", label=label)
        shown = [i for indices in panel.values() for i in indices]
        title = "joint inputs tau_m" if panel is joints else "inputs"
        units = sorted({motion.input_units[i] for i in shown})
        axes.set(title=title, xlabel="t [s]", ylabel=_unit(units))
        axes.legend(ncols=2 if len(shown) > 4 else 1, fontsize=7, handlelength=1.6)
        axes.margins(x=0.0)


def _momentum(axes: Axes, motion: Motion) -> None:
    # Zero has no place on a logarithmic axis: nothing is below the rounding of one.
    drift = np.maximum(motion.momentum_drift, np.finfo(float).eps / 10.0)
    axes.semilogy(motion.t, drift, color=_COLORS[0])
    axes.set(title="momentum drift, relative", xlabel="t [s]")
    axes.set_ylim(1e-17, max(1e-13, 10.0 * float(drift.max())))
    axes.margins(x=0.0)


def _title(motion: Motion, both: bool) -> str:
    text = f"{motion.robot}: {motion.t[-1]:g} s, frame {motion.frame}"
    if both:
        text += "; full: nonlinear, dashed: linear"
    return f"{text}; {motion.stopped}" if motion.stopped else text


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
        return np.atleast_1d(np.asarray(given, dtype=complex)).ravel(), 0.0
    except (TypeError, ValueError):
        raise InputError(f"poles is a {type(given).__name__}, expected numbers or a Gain") from None


def _by_group(names: Sequence[str]) -> dict[str, list[int]]:
    groups: dict[str, list[int]] = {}
    for index, name in enumerate(names):
        groups.setdefault(name.partition(".")[0] if "." in name else "", []).append(index)
    return groups


def _short(name: str) -> str:
    return name.partition(".")[2] or name


def _unit(units: Sequence[str]) -> str:
    shown = [unit for unit in units if unit != "1"]
    return f"[{', '.join(shown)}]" if shown else ""


def _cycle(count: int) -> list[str]:
    return [_COLORS[i % len(_COLORS)] for i in range(count)]


class _styled:
    """The style, for as long as a figure is drawn, and the class of figures without a window."""

    def __enter__(self) -> Any:
        require_matplotlib()
        import matplotlib
        from matplotlib.figure import Figure

        self._context = matplotlib.rc_context(_STYLE)
        self._context.__enter__()
        return Figure

    def __exit__(self, *problem: object) -> None:
        self._context.__exit__(None, None, None)


def require_matplotlib() -> None:
    """Raise `MissingPackageError` where matplotlib is not installed."""
    if importlib.util.find_spec("matplotlib") is None:
        raise MissingPackageError(
            "figures need matplotlib; install it with: pip install 'fflin[plot]'"
        )


def check_figure_format(path: Path) -> None:
    """Raise `FileError` where the ending of a figure's name is no known one."""
    if path.suffix not in FORMATS:
        raise FileError(f"'{path}' ends in '{path.suffix}', expected one of {', '.join(FORMATS)}")


def _target(path: str | Path | None) -> Path | None:
    if path is None:
        return None
    target = as_path(path)
    check_figure_format(target)
    return target


def _saved(figure: Figure, target: Path | None) -> Figure:
    if target is not None:
        content = io.BytesIO()
        figure.savefig(content, format=target.suffix[1:])
        write_whole({target: content.getvalue()})
    return figure
