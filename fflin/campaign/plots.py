"""Figures of campaigns, of the validity of a linear model, and of funnels."""

import math
from pathlib import Path
from typing import Any

import numpy as np

from fflin.base.figures import COLORS, Axes, Figure, drawing
from fflin.base.names import group_of, input_keys
from fflin.base.validation import Array, instance, whole
from fflin.campaign.campaign import Campaign
from fflin.campaign.funnel import Funnel
from fflin.campaign.report import ended_of, goal_met, shown_unit
from fflin.campaign.runs import KINDS
from fflin.campaign.validity import Validity, shown
from fflin.simulation.report import DEGREES, TRUSTED

# Bands, widest first: (fraction of runs above the band, name, opacity). The same fraction of runs
# is below the band.
_BANDS = (
    (0.0, "all runs", 0.13),
    (0.05, "90 % of runs", 0.22),
    (0.25, "50 % of runs", 0.38),
)
_PERCENTILES = (
    (0.5, "median", "-"),
    (0.95, "95th percentile", "-."),
    (0.99, "99th percentile", ":"),
)
_INK = COLORS[0]
_GOAL = "#555555"
_WORST = (COLORS[1], COLORS[3], COLORS[4], COLORS[2], COLORS[7])
_DECADES, _BARS, _BINS = 6, 10, 48


def plot_campaign(
    campaign: Campaign,
    path: str | Path | None = None,
    *,
    worst: int = 3,
    axes: Axes | None = None,
) -> Figure:
    """Draw the error histories, final errors, inputs and rank correlations of a campaign.

    The bands contain 100 %, 90 % and 50 % of the runs. The worst runs, ranked by the figure
    `Campaign.about`, are drawn over the bands. Once a run has been stopped early, it ranks as worse
    than all other runs. Dashed lines mark the bounds of the goals and the limits of the inputs. If
    the campaign has no histories, the figure shows only the histograms and the correlations.

    Parameters
    ----------
    campaign : Campaign
        Campaign to draw. The panels over time are drawn only if `monte_carlo` was called with
        `histories`.
    path : str or Path, optional
        File to save to: .png, .pdf or .svg.
    worst : int
        Number of worst runs to draw, at most five.
    axes : matplotlib.axes.Axes, optional
        Axes of a grid, such as from ``pyplot.subplots``; the figure is drawn in their place.

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
    instance(
        "campaign", campaign, Campaign, "a Campaign, as fflin.monte_carlo returns it"
    )
    top = whole("worst", worst, 0, len(_WORST))
    runs = campaign.worst(top) if top else []
    groups = dict[str, list[int]]()
    kinds = campaign.judged or ("attitude",)
    rows: list[Any] = []
    if campaign.times:
        for index, key in enumerate(input_keys(campaign)):
            groups.setdefault(group_of(key), []).append(index)
        rows.append([(_error, kind, runs) for kind in kinds])
    rows.append([(_histogram, kind) for kind in kinds])
    last: list[Any] = [
        (_inputs, group, indices, runs) for group, indices in groups.items()
    ]
    last.append((_correlations,))
    across = math.ceil(len(last) / math.ceil(len(last) / 3))
    rows += [last[at : at + across] for at in range(0, len(last), across)]
    with drawing(path, 11.0, 0.8 + 2.6 * len(rows), axes=axes) as figure:
        keys: dict[str, Any] = {}
        places = figure.add_gridspec(len(rows), 1)
        for at, row in enumerate(rows):
            cells = places[at].subgridspec(1, len(row))
            for column, (panel, *given) in enumerate(row):
                panel(place := figure.add_subplot(cells[column]), campaign, *given)
                keys |= dict(zip(*place.get_legend_handles_labels()[::-1], strict=True))
        below: Any = "outside lower center"
        figure.legend(keys.values(), keys.keys(), loc=below, ncols=7, handlelength=1.8)
        title = f"{campaign.robot}: {len(campaign):,} runs of {campaign.duration:g} s; "
        goals = [goal_met(campaign, goal) for goal in campaign.goals]
        figure.suptitle("\n".join([title + ended_of(campaign), *goals]), fontsize=11)
    return figure


def plot_validity(
    validity: Validity, path: str | Path | None = None, *, axes: Axes | None = None
) -> Figure:
    """Draw the prediction error of a linear model, and how many runs settled at each level.

    Parameters
    ----------
    validity : Validity
        Result of `fflin.validity`.
    path : str or Path, optional
        File to save to: .png, .pdf or .svg. See `plot_motion` for possible errors.
    axes : matplotlib.axes.Axes, optional
        Axes of a grid, such as from ``pyplot.subplots``; the figure is drawn in their place.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> lin = fflin.linearize(robot)
    >>> reach = fflin.validity(robot, lin, fflin.lqr(lin), samples=4)
    >>> figure = fflin.plot_validity(reach, "validity.png")
    """
    instance("validity", validity, Validity, "a Validity, as fflin.validity returns it")
    percent = 100.0
    with drawing(path, 9.0, 4.3, axes=axes) as figure:
        left, right = figure.subplots(1, 2)
        # The plotted error is divided by the displacement. Therefore the exponent of the plotted
        # error is one less than `slope`, the exponent of the absolute error.
        order = "relative error"
        if np.isfinite(validity.slope):
            order += f", ~ displacement^{validity.slope - 1.0:.2f}"
        levels, errors = percent * validity.levels, percent * validity.prediction_error
        left.loglog(levels, errors, "o-", color=COLORS[0], ms=3, label=order)
        trust = f"accepted error: {percent * TRUSTED:g} %"
        left.axhline(percent * TRUSTED, color="#888888", lw=0.8, label=trust)
        left.set_xticks(levels, [f"{x:.3g}" for x in levels])
        left.minorticks_off()
        left.set(
            title="prediction error of the linear loop",
            ylabel="error [% of the displacement]",
        )
        settled = np.array([outcome == "settled" for outcome in validity.outcomes])
        tried = percent * validity.sampled
        right.hist(
            [tried[settled], tried[~settled]],
            np.linspace(0.0, percent, 11).tolist(),
            stacked=True,
            rwidth=0.9,
            color=[COLORS[2], COLORS[1]],
            label=["settled", "not settled"],
        )
        right.set(
            title=f"{validity.settled} of {len(settled)} runs settled", ylabel="runs"
        )
        right.yaxis.get_major_locator().set_params(integer=True)
        for panel in (left, right):
            panel.set_xlabel("displacement [% of the largest]")
        low, high = validity.rate
        figure.legend(loc="outside lower center", ncols=4)
        figure.suptitle(
            f"{validity.robot}, up to {shown(validity.largest, validity.joint_unit)}; "
            f"{percent * low:.1f} to {percent * high:.1f} % of displacements settle "
            f"({percent * validity.confidence:g} % confidence)",
            fontsize=10,
        )
    return figure


def plot_funnel(
    funnel: Funnel, path: str | Path | None = None, *, axes: Axes | None = None
) -> Figure:
    """Draw the half-axes of a funnel and the success rates of the runs at each knot.

    Parameters
    ----------
    funnel : Funnel
        Result of `fflin.funnel`.
    path : str or Path, optional
        File to save to: .png, .pdf or .svg. See `plot_motion` for possible errors.
    axes : matplotlib.axes.Axes, optional
        Axes of a grid, such as from ``pyplot.subplots``; the figure is drawn in their place.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> v0 = fflin.velocity(robot, {"joint_1": 0.1})
    >>> motion = fflin.simulate(robot, v0=v0, duration=2.0, every=20)
    >>> along = fflin.linearize_trajectory(robot, motion.trajectory())
    >>> reach = fflin.funnel(robot, fflin.tvlqr(along), {"attitude": 5.0}, samples=4, knots=2)
    >>> figure = fflin.plot_funnel(reach, "funnel.png")
    """
    instance("funnel", funnel, Funnel, "a Funnel, as fflin.funnel returns it")
    t = funnel.t
    percent = 100.0
    reach = {
        "attitude [deg]": funnel.attitude,
        "position [m]": funnel.position,
        **_joint_axes(funnel),
    }
    reach = {name: axes for name, axes in reach.items() if axes.any()}
    with drawing(path, 9.0, 1.6 + 1.5 * (len(reach) + 1), axes=axes) as figure:
        panel = figure.subplots(len(reach) + 1, sharex=True)
        for ax, (name, half), color in zip(panel, reach.items(), COLORS, strict=False):
            for row in half.T:
                ax.plot(t, row, "o-", color=color, ms=3, lw=0.7)
            ax.fill_between(t, half.max(axis=1), color=color, alpha=0.15)
            ax.set(ylabel=name, ylim=(0.0, None))
        low, high = percent * funnel.rate.T
        panel[-1].fill_between(
            t, low, high, color="#888888", alpha=0.3, label="all starts tried"
        )
        inside = percent * funnel.inside_rate
        panel[-1].plot(
            t, inside, "o-", color="#000000", ms=3, label="starts inside, lower bound"
        )
        panel[-1].set(xlabel="t [s]", ylabel="success rate [%]", ylim=(0.0, 102.0))
        figure.legend(loc="outside lower center", ncols=2)
        figure.suptitle(
            f"{funnel.robot.name}: initial errors from which every run ends with "
            f"{funnel.goal}\nhalf-axes; {percent * funnel.confidence:g} % confidence",
            fontsize=10,
        )
    return figure


def _joint_axes(funnel: Funnel) -> dict[str, Array]:
    """Return the half-axes (m, k) of the joints of each unit, with angles in deg."""
    units = np.array([joint.unit for joint in funnel.robot.joints])
    axes = {}
    for unit in dict.fromkeys(units.tolist()):
        shown_unit, factor = DEGREES.get(unit, (unit, 1.0))
        axes[f"joints [{shown_unit}]"] = factor * funnel.joints[:, units == unit]
    return axes


def _bands(
    axes: Axes,
    campaign: Campaign,
    values: Array,
    runs: list[int],
    selected: Any = slice(None),
) -> None:
    """Draw values (N, M) over time: lines of `runs`, bands and median of the `selected` runs."""
    # The bands and the median show infinite values of stopped runs at the upper edge of the axes.
    # The quantiles are not interpolated between runs, because a mean of a finite value and the edge
    # has no meaning.
    most = (
        1.15 * float(np.where(np.isfinite(values), values, 0.0).max(initial=0.0)) or 1.0
    )
    shown = np.minimum(values[selected], most)
    t = campaign.times
    for tail, name, dark in _BANDS:
        low, high = np.quantile(
            shown, (tail, 1.0 - tail), axis=0, method="inverted_cdf"
        )
        axes.fill_between(t, low, high, color=_INK, alpha=dark, lw=0, label=name)
    half = np.quantile(shown, 0.5, axis=0, method="inverted_cdf")
    axes.plot(t, half, color=_INK, lw=1.8, label="median")
    for color, run in zip(_WORST, runs, strict=False):
        known = np.where(np.isfinite(values[run]), values[run], np.nan)
        axes.plot(t, known, color=color, lw=1.1, label=f"run {run}")
    axes.set(xlabel="t [s]", xlim=(t[0], t[-1]), ylim=(0.0, most))


def _error(axes: Axes, campaign: Campaign, kind: str, runs: list[int]) -> None:
    unit, factor = shown_unit(campaign, kind)
    history = factor * campaign.error_history[..., list(KINDS).index(kind)]
    _bands(axes, campaign, history, runs)
    ends = np.quantile(history, 0.05, axis=0, method="inverted_cdf")
    most = axes.get_ylim()[1]
    least = float(ends[ends > 0.0].min(initial=np.inf))
    if least < 0.05 * most:  # logarithmic, so that small final values are visible
        axes.set(
            yscale="log", ylim=(max(0.5 * least, most * 10.0**-_DECADES), 1.5 * most)
        )
    _goals(axes.axhline, campaign, kind)
    axes.set(title=f"{kind} error", ylabel=f"[{unit}]")


def _goals(draw: Any, campaign: Campaign, *names: str) -> None:
    """Draw the bounds that the goals set for the named quantities."""
    for bound in campaign.bounds:
        if bound.name in names:
            _, factor = shown_unit(campaign, bound.name)
            limit = factor * bound.limit
            draw(limit, ls="--", lw=1.0, color=_GOAL, label="goal or limit")


def _histogram(axes: Axes, campaign: Campaign, kind: str) -> None:
    """Draw histograms of the final and the largest errors, and lines at their percentiles.

    The histograms include only the completed runs. The percentiles include all runs.
    """
    names = {kind: ("final", _INK), f"worst {kind}": ("worst of run", COLORS[1])}
    unit, factor = shown_unit(campaign, kind)
    values_of = {
        name: factor * campaign.values(name)[~campaign.stopped] for name in names
    }
    values = np.append(list(values_of.values()), 0.0)
    most = float(values.max()) or 1.0
    least = max(float(values[values > 0.0].min(initial=most)), most * 10.0**-_DECADES)
    edges = np.linspace(0.0, 1.02 * most, _BINS)
    if least < 0.05 * most:
        edges = np.geomspace(0.8 * least, 1.3 * most, _BINS)
        axes.set_xscale("log")
    for name, (label, color) in names.items():
        kept: Any = edges
        axes.hist(
            values_of[name].clip(*edges[[0, -1]]),
            kept,
            color=color,
            alpha=0.55,
            label=label,
        )
        for p, mark, style in _PERCENTILES:
            at = factor * campaign.quantile(name, p).value
            if math.isfinite(at):
                axes.axvline(at, color=color, lw=1.2, ls=style, label=mark)
    _goals(axes.axvline, campaign, *names)
    axes.set(xlabel=f"{kind} error [{unit}]", ylabel="runs", xlim=edges[[0, -1]])


def _inputs(
    axes: Axes, campaign: Campaign, group: str, columns: list[int], runs: list[int]
) -> None:
    """Draw the largest magnitude in a group of inputs over time, and the group's smallest limit.

    The bands include only the completed runs. The limit is omitted if it is far above the inputs.
    """
    largest = np.abs(campaign.input_history[..., columns]).max(axis=2)
    if not campaign.stopped.all():
        _bands(axes, campaign, largest, runs, ~campaign.stopped)
    limit = min(campaign.input_limits[at] for at in columns)
    if limit < 2.0 * (most := axes.get_ylim()[1]):
        axes.axhline(limit, ls="--", lw=1.0, color=_GOAL, label="goal or limit")
        axes.set_ylim(0.0, max(most, 1.08 * limit))
    units = "|".join(dict.fromkeys(campaign.input_units[at] for at in columns))
    axes.set(title=f"largest |{group}|", ylabel=f"[{units}]")


def _correlations(axes: Axes, campaign: Campaign) -> None:
    """Draw the largest rank correlations of drawn values with the figure `Campaign.about`.

    A grey area marks correlations that are not significant.
    """
    bars = list(campaign.sensitivity().items())[:_BARS][::-1]
    doubt = min(1.0, 3.0 / math.sqrt(len(campaign)))
    axes.axvspan(-doubt, doubt, color="#999999", alpha=0.18, lw=0)
    colors = [_INK if size > 0.0 else COLORS[1] for _, size in bars]
    axes.barh(
        [name for name, _ in bars], [size for _, size in bars], color=colors, height=0.7
    )
    axes.axvline(0.0, color="#333333", lw=0.8)
    axes.set(title=f"correlation with {campaign.about}")
    axes.set(xlabel="rank correlation (grey: not significant)")
    axes.set(xlim=(-1.0, 1.0), xticks=(-1.0, -0.5, 0.0, 0.5, 1.0))
    axes.grid(visible=False, axis="y")
    axes.tick_params(axis="y", labelsize=8)
