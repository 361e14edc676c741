"""The figure of a campaign: bands over time with the worst runs on top, histograms, and whence."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fflin.base.errors import InputError
from fflin.base.figures import COLORS, saved, styled, target_of
from fflin.base.names import group_of, input_keys
from fflin.base.validation import Array, whole
from fflin.campaign.conditions import bounds_of
from fflin.campaign.report import ended_of, goal_met
from fflin.campaign.tally import KINDS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Shares of the runs, from the widest band to the narrowest, and how dark each is.
_BANDS = ((0.0, "all", 0.13), (0.05, "90 %", 0.22), (0.25, "50 %", 0.38))
_INK, _GOAL = COLORS[0], "#555555"
_WORST = (COLORS[1], COLORS[3], COLORS[4], COLORS[2], COLORS[7])
_DECADES, _BARS, _BINS = 6, 10, 48


def plot_campaign(campaign: Any, path: str | Path | None = None, *, worst: int = 3) -> Figure:
    """Draw the errors of a campaign over time and at last, inputs, and what errors go with.

    Bands hold all runs, 90 and 50 % of them; on top are the worst runs by `Campaign.about`. A run
    that was stopped is above all others from then on. Dashed lines are the bounds of the goals and
    the limits of inputs. Without histories there are histograms alone.

    Parameters
    ----------
    campaign : Campaign
        With ``histories`` for what is drawn over time.
    path : str or Path, optional
        .png, .pdf or .svg to save to.
    worst : int
        How many runs are drawn on top, up to five.

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
    from fflin.campaign.campaign import Campaign

    if not isinstance(campaign, Campaign):
        raise InputError(
            f"campaign is a {type(campaign).__name__}, expected a Campaign, as fflin.monte_carlo "
            "returns it"
        )
    target, top = target_of(path), whole("worst", worst, 0, len(_WORST))
    runs = campaign.worst(top) if top else []
    kinds = [campaign.judged, ("attitude",)][not campaign.judged]
    groups = _groups(campaign) if campaign.times else {}
    below = math.ceil((len(groups) + 1) / 3)
    across = math.ceil((len(groups) + 1) / below)
    heights = [*[3.0] * bool(campaign.times), 2.5, *[2.5] * below]
    with styled() as figure_class:
        figure = figure_class(figsize=(11.0, 0.8 + sum(heights)), layout="constrained")
        rows = iter(figure.add_gridspec(len(heights), 1, height_ratios=heights))
        if campaign.times:
            places = next(rows).subgridspec(1, len(kinds))
            for k, kind in enumerate(kinds):
                axes = figure.add_subplot(places[k])
                _course(axes, campaign, campaign.error_history[..., list(KINDS).index(kind)], runs)
                axes.set(title=f"{kind} error", ylabel=f"[{KINDS[kind]}]")
                _scale_down(axes, campaign, kind)
                _goals(axes.axhline, campaign, (kind,))
        places = next(rows).subgridspec(1, len(kinds))
        for k, kind in enumerate(kinds):
            _histogram(figure.add_subplot(places[k]), campaign, kind)
        cells = [cell for row in rows for cell in row.subgridspec(1, across)]
        for (group, columns), cell in zip(groups.items(), cells, strict=False):
            _inputs(figure.add_subplot(cell), campaign, group, columns, runs)
        _bars(figure.add_subplot(cells[len(groups)]), campaign)
        keys: dict[str, Any] = {}
        for axes in figure.axes[:: len(kinds)][:2]:
            keys |= dict(zip(*axes.get_legend_handles_labels()[::-1], strict=True))
        place: Any = "outside lower center"
        figure.legend(keys.values(), keys.keys(), loc=place, ncols=7, handlelength=1.8)
        lines = [f"{campaign.robot}: {len(campaign):,} runs of {campaign.duration:g} s"]
        lines[0] += f"; {ended_of(campaign)}"
        lines += [goal_met(campaign, goal) for goal in campaign.goals]
        figure.suptitle("\n".join(lines), fontsize=11)
        return saved(figure, target)


def _groups(campaign: Any) -> dict[str, list[int]]:
    """Return where the inputs of each group are."""
    found: dict[str, list[int]] = {}
    for at, key in enumerate(input_keys(campaign)):
        found.setdefault(group_of(key), []).append(at)
    return found


def _course(axes: Axes, campaign: Any, values: Array, runs: list[int]) -> None:
    """Draw bands of values (N, M) over time, and some runs on top."""
    # Of what is infinite no mean is a number: each bound is one of the runs.
    most = 1.15 * float(np.where(np.isfinite(values), values, 0.0).max(initial=0.0)) or 1.0
    shown, t = np.minimum(values, most), campaign.times
    for tail, name, dark in _BANDS:
        low, high = np.quantile(shown, (tail, 1.0 - tail), axis=0, method="inverted_cdf")
        axes.fill_between(t, low, high, color=_INK, alpha=dark, lw=0, label=name)
    half = np.quantile(shown, 0.5, axis=0, method="inverted_cdf")
    axes.plot(t, half, color=_INK, lw=1.8, label="half")
    for color, run in zip(_WORST, runs, strict=False):
        known = np.where(np.isfinite(values[run]), values[run], np.nan)
        axes.plot(t, known, color=color, lw=1.1, label=f"run {run}")
    axes.set(xlabel="t [s]", xlim=(t[0], t[-1]), ylim=(0.0, most))


def _scale_down(axes: Axes, campaign: Any, kind: str) -> None:
    """Scale errors that fall by much so that their ends are told apart."""
    history = campaign.error_history[..., list(KINDS).index(kind)]
    ends = np.quantile(history, 0.05, axis=0, method="inverted_cdf")
    most, least = axes.get_ylim()[1], float(ends[ends > 0.0].min(initial=np.inf))
    if least < 0.05 * most:
        axes.set_yscale("log")
        axes.set_ylim(max(0.5 * least, most * 10.0**-_DECADES), 1.5 * most)


def _goals(draw: Any, campaign: Any, names: tuple[str, ...]) -> None:
    """Draw the bounds that goals have on these figures."""
    for goal in campaign.goals:
        for bound in bounds_of(goal, campaign.figure):
            if bound.name in names:
                draw(bound.limit, ls="--", lw=1.0, color=_GOAL, label="goal")


def _histogram(axes: Axes, campaign: Any, kind: str) -> None:
    """Draw how an error is spread, at last and at its worst, of the runs that were not stopped."""
    drawn = {"at last": (kind, _INK), "at its worst": (f"worst {kind}", COLORS[1])}
    of = {key: campaign.values(name)[~campaign.stopped] for key, (name, _) in drawn.items()}
    values = np.concatenate(list(of.values()))
    least, most = (float(x) for x in np.quantile(values, (0.0, 1.0))) if len(values) else (0.0, 1.0)
    least = max(least, most * 10.0**-_DECADES)
    edges = np.linspace(0.0, 1.02 * most or 1.0, _BINS)
    if 0.0 < least < 0.05 * most:
        edges = np.geomspace(0.8 * least, 1.3 * most, _BINS)
        axes.set_xscale("log")
    for key, (name, color) in drawn.items():
        axes.hist(of[key].clip(edges[0], edges[-1]), edges, color=color, alpha=0.55, label=key)
        for p, style in ((0.5, "-"), (0.95, "-."), (0.99, ":")):
            at = campaign.quantile(name, p).value
            if math.isfinite(at):
                axes.axvline(at, color=color, lw=1.2, ls=style, label=f"{100 * p:g} % below")
    _goals(axes.axvline, campaign, (kind, f"worst {kind}"))
    axes.set(xlabel=f"{kind} error [{KINDS[kind]}]", ylabel="runs", xlim=(edges[0], edges[-1]))


def _inputs(axes: Axes, campaign: Any, group: str, columns: list[int], runs: list[int]) -> None:
    """Draw the largest input of a group, of the runs that were not stopped, below its limit."""
    largest = np.abs(campaign.input_history[..., columns]).max(axis=2)
    kept = np.flatnonzero(~campaign.stopped)
    where = {int(run): at for at, run in enumerate(kept)}
    units = "|".join(dict.fromkeys(campaign.input_units[at] for at in columns))
    axes.set(title=f"largest of {group}" if len(columns) > 1 else group, ylabel=f"[{units}]")
    if not len(kept):
        return
    _course(axes, campaign, largest[kept], [where[run] for run in runs if run in where])
    most = axes.get_ylim()[1]
    for limit in sorted({campaign.input_limits[at] for at in columns}):
        if limit < 2.0 * most:
            axes.axhline(limit, ls="--", lw=1.0, color=_GOAL)
            axes.set_ylim(0.0, max(axes.get_ylim()[1], 1.08 * limit))


def _bars(axes: Axes, campaign: Any) -> None:
    """Draw what the worst runs go with, beside what is drawn alike by chance."""
    found = list(campaign.sensitivity().items())[:_BARS][::-1]
    names, sizes = [name for name, _ in found], [size for _, size in found]
    doubt = min(1.0, 3.0 / math.sqrt(len(campaign)))
    axes.axvspan(-doubt, doubt, color="#999999", alpha=0.18, lw=0)
    colors = [_INK if size > 0.0 else COLORS[1] for size in sizes]
    axes.barh(names, sizes, color=colors, height=0.7)
    axes.axvline(0.0, color="#333333", lw=0.8)
    axes.set(title=f"what the {campaign.about} goes with", xlabel="rank correlation; grey: chance")
    axes.set(xlim=(-1.0, 1.0), xticks=(-1.0, -0.5, 0.0, 0.5, 1.0))
    axes.grid(visible=False, axis="y")
    axes.tick_params(axis="y", labelsize=8)
