"""The figure of a campaign: bands over time, worst runs, histograms and rank correlations."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fflin.base.errors import InputError
from fflin.base.figures import COLORS, drawing
from fflin.base.names import group_of, input_keys
from fflin.base.validation import Array, whole
from fflin.campaign.campaign import Campaign
from fflin.campaign.report import ended_of, goal_met
from fflin.campaign.tally import KINDS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Shares of the runs, from the widest band to the narrowest, and how dark each is.
_BANDS = (
    (0.0, "all runs", 0.13),
    (0.05, "90 % of runs", 0.22),
    (0.25, "50 % of runs", 0.38),
)
_INK, _GOAL = COLORS[0], "#555555"
_WORST = (COLORS[1], COLORS[3], COLORS[4], COLORS[2], COLORS[7])
_DECADES, _BARS, _BINS = 6, 10, 48


def plot_campaign(campaign: Campaign, path: str | Path | None = None, *, worst: int = 3) -> Figure:
    """Draw the error histories, final errors, inputs and rank correlations of a campaign.

    The bands contain 100 %, 90 % and 50 % of the runs. The worst runs, ranked by `Campaign.about`,
    are drawn over the bands. From the moment a run is stopped early, it ranks as worse than all
    other runs. Dashed lines mark the bounds of the goals and the limits of the inputs. Without
    histories, the figure shows only the histograms and the correlations.

    Parameters
    ----------
    campaign : Campaign
        Campaign to draw; its panels over time need ``histories`` in `monte_carlo`.
    path : str or Path, optional
        File to save to: .png, .pdf or .svg.
    worst : int
        Number of worst runs to draw, at most five.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    MissingPackageError
        If matplotlib is not installed.
    FileError
        If the file has another ending or cannot be written.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> lin = fflin.linearize(robot)
    >>> policy = fflin.StateFeedback(lin, fflin.lqr(lin).K)
    >>> runs = fflin.monte_carlo(robot, policy, {"q_b": 0.02}, runs=8, duration=5.0, histories=20)
    >>> figure = fflin.plot_campaign(runs, "campaign.png")
    """
    if not isinstance(campaign, Campaign):
        said = f"campaign is a {type(campaign).__name__}, expected a Campaign"
        raise InputError(f"{said}, as fflin.monte_carlo returns it")
    top = whole("worst", worst, 0, len(_WORST))
    runs, groups = campaign.worst(top) if top else [], dict[str, list[int]]()
    for at, key in enumerate(input_keys(campaign) if campaign.times else ()):
        groups.setdefault(group_of(key), []).append(at)
    kinds = campaign.judged or ("attitude",)
    rows: list[Any] = [[(_error, kind, runs) for kind in kinds]] * bool(campaign.times)
    rows.append([(_histogram, kind) for kind in kinds])
    last = [*((_inputs, *each, runs) for each in groups.items()), (_whence,)]
    across = math.ceil(len(last) / math.ceil(len(last) / 3))
    rows += [last[at : at + across] for at in range(0, len(last), across)]
    with drawing(path, 11.0, 0.8 + 2.6 * len(rows)) as figure:
        keys: dict[str, Any] = {}
        for place, row in zip(figure.add_gridspec(len(rows), 1), rows, strict=True):
            for cell, (panel, *given) in zip(place.subgridspec(1, len(row)), row, strict=True):
                panel(axes := figure.add_subplot(cell), campaign, *given)
                keys |= dict(zip(*axes.get_legend_handles_labels()[::-1], strict=True))
        below: Any = "outside lower center"
        figure.legend(keys.values(), keys.keys(), loc=below, ncols=7, handlelength=1.8)
        title = f"{campaign.robot}: {len(campaign):,} runs of {campaign.duration:g} s; "
        goals = [goal_met(campaign, goal) for goal in campaign.goals]
        figure.suptitle("\n".join([title + ended_of(campaign), *goals]), fontsize=11)
    return figure


def _bands(
    axes: Axes, campaign: Campaign, values: Array, runs: list[int], of: Any = slice(None)
) -> None:
    """Draw bands of values (N, M) of runs over time, and some of all runs on top."""
    # Each bound is the value of a run, since means with what is infinite are no numbers.
    most = 1.15 * float(np.where(np.isfinite(values), values, 0.0).max(initial=0.0)) or 1.0
    shown, t = np.minimum(values[of], most), campaign.times
    for tail, name, dark in _BANDS:
        low, high = np.quantile(shown, (tail, 1.0 - tail), axis=0, method="inverted_cdf")
        axes.fill_between(t, low, high, color=_INK, alpha=dark, lw=0, label=name)
    half = np.quantile(shown, 0.5, axis=0, method="inverted_cdf")
    axes.plot(t, half, color=_INK, lw=1.8, label="median")
    for color, run in zip(_WORST, runs, strict=False):
        known = np.where(np.isfinite(values[run]), values[run], np.nan)
        axes.plot(t, known, color=color, lw=1.1, label=f"run {run}")
    axes.set(xlabel="t [s]", xlim=(t[0], t[-1]), ylim=(0.0, most))


def _error(axes: Axes, campaign: Campaign, kind: str, runs: list[int]) -> None:
    history = campaign.error_history[..., list(KINDS).index(kind)]
    _bands(axes, campaign, history, runs)
    ends = np.quantile(history, 0.05, axis=0, method="inverted_cdf")
    most, least = axes.get_ylim()[1], float(ends[ends > 0.0].min(initial=np.inf))
    if least < 0.05 * most:  # so that the ends are told apart
        axes.set(yscale="log", ylim=(max(0.5 * least, most * 10.0**-_DECADES), 1.5 * most))
    _goals(axes.axhline, campaign, kind)
    axes.set(title=f"{kind} error", ylabel=f"[{KINDS[kind]}]")


def _goals(draw: Any, campaign: Campaign, *names: str) -> None:
    """Draw the bounds that goals have on these figures."""
    for bound in campaign.bounds:
        if bound.name in names:
            draw(bound.limit, ls="--", lw=1.0, color=_GOAL, label="goal or limit")


def _histogram(axes: Axes, campaign: Campaign, kind: str) -> None:
    """Draw histograms of the final and the worst error of the completed runs."""
    names = {kind: ("final", _INK), f"worst {kind}": ("worst of run", COLORS[1])}
    of = {name: campaign.values(name)[~campaign.stopped] for name in names}
    values = np.append(list(of.values()), 0.0)
    most = float(values.max()) or 1.0
    least = max(float(values[values > 0.0].min(initial=most)), most * 10.0**-_DECADES)
    edges = np.linspace(0.0, 1.02 * most, _BINS)
    if least < 0.05 * most:
        edges = np.geomspace(0.8 * least, 1.3 * most, _BINS)
        axes.set_xscale("log")
    for name, (said, color) in names.items():
        kept: Any = edges
        axes.hist(of[name].clip(*edges[[0, -1]]), kept, color=color, alpha=0.55, label=said)
        for p, style in ((0.5, "-"), (0.95, "-."), (0.99, ":")):
            at = campaign.quantile(name, p).value
            if math.isfinite(at):
                axes.axvline(at, color=color, lw=1.2, ls=style, label=f"{100 * p:g}th percentile")
    _goals(axes.axvline, campaign, *names)
    axes.set(xlabel=f"{kind} error [{KINDS[kind]}]", ylabel="runs", xlim=edges[[0, -1]])


def _inputs(
    axes: Axes, campaign: Campaign, group: str, columns: list[int], runs: list[int]
) -> None:
    """Draw the largest input of a group, of the runs that were not stopped, below its limit."""
    largest = np.abs(campaign.input_history[..., columns]).max(axis=2)
    if not campaign.stopped.all():
        _bands(axes, campaign, largest, runs, ~campaign.stopped)
    limit = min(campaign.input_limits[at] for at in columns)
    if limit < 2.0 * (most := axes.get_ylim()[1]):
        axes.axhline(limit, ls="--", lw=1.0, color=_GOAL, label="goal or limit")
        axes.set_ylim(0.0, max(most, 1.08 * limit))
    units = "|".join(dict.fromkeys(campaign.input_units[at] for at in columns))
    axes.set(title=f"largest |{group}|", ylabel=f"[{units}]")


def _whence(axes: Axes, campaign: Campaign) -> None:
    """Draw rank correlations with the default figure, and the band of chance correlations."""
    found = list(campaign.sensitivity().items())[:_BARS][::-1]
    doubt = min(1.0, 3.0 / math.sqrt(len(campaign)))
    axes.axvspan(-doubt, doubt, color="#999999", alpha=0.18, lw=0)
    colors = [_INK if size > 0.0 else COLORS[1] for _, size in found]
    axes.barh([name for name, _ in found], [size for _, size in found], color=colors, height=0.7)
    axes.axvline(0.0, color="#333333", lw=0.8)
    axes.set(title=f"correlation with {campaign.about}")
    axes.set(xlabel="rank correlation (grey: not significant)")
    axes.set(xlim=(-1.0, 1.0), xticks=(-1.0, -0.5, 0.0, 0.5, 1.0))
    axes.grid(visible=False, axis="y")
    axes.tick_params(axis="y", labelsize=8)
