"""Report of a campaign: outcomes, error quantiles, success rates and rank correlations."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import TYPE_CHECKING

from fflin.base import html
from fflin.base.tables import folded, grid
from fflin.campaign.runs import KINDS, MODES
from fflin.simulation.report import DEGREES, WHEEL_SPEEDS
from fflin.simulation.run import STOPS

if TYPE_CHECKING:
    from fflin.campaign.campaign import Campaign

_SHARES = (0.5, 0.95, 0.99)


def campaign_report(campaign: Campaign) -> str:
    """Return the report with success rates of goals, error quantiles and rank correlations."""
    lines = [*_outcomes(campaign), _title(campaign), *campaign.notes]
    table = grid(_quantiles(campaign), "ll")
    return "\n".join([folded(lines), "", table, "", folded(_correlations(campaign))])


def campaign_card(campaign: Campaign) -> str:
    """Return the report as a card for notebooks."""
    return html.result_card(
        campaign,
        *map(html.paragraph, _outcomes(campaign)),
        html.paragraph(_title(campaign), "note"),
        *(html.paragraph(note, "note") for note in campaign.notes),
        html.table(_quantiles(campaign), "ll"),
        html.folded("rank correlations", *map(html.paragraph, _correlations(campaign))),
    )


def _outcomes(campaign: Campaign) -> list[str]:
    """Return one line for each goal, and a line on completed and stopped runs."""
    goals = [goal_met(campaign, goal) for goal in campaign.goals]
    return [*goals, ended_of(campaign)]


def _title(campaign: Campaign) -> str:
    """Return one line with the robot, the number of runs and their duration."""
    count = len(campaign)
    title = f"{campaign.robot}: {count:,} runs"
    if count < campaign.asked:
        title += f" of {campaign.asked:,} requested"
    title += f", {campaign.duration:g} s each in steps of {campaign.dt:.3g} s"
    title += f", seed {campaign.seed}"
    if campaign.engine == "compiled":
        title += ", compiled"
    return title


def _quantiles(campaign: Campaign) -> list[list[str]]:
    """Return the table of the quantiles of all errors."""
    quantile = campaign.quantile
    rows = [["error", "unit", "median", "95 %", "99 %", "worst 95 %", "settle 95 %"]]
    for name in _errors(campaign):
        unit, factor = shown_unit(campaign, name)
        figures = [quantile(name, p).value for p in _SHARES]
        figures.append(quantile(f"worst {name}", 0.95).value)
        when = "."
        if name in KINDS:
            when = _when(quantile(f"settle {name}", 0.95).value, " s")
        rows.append([name, unit, *(f"{factor * x:.3g}" for x in figures), when])
    return rows


def _correlations(campaign: Campaign) -> list[str]:
    """Return lines with the significant rank correlations."""
    causes: dict[str, list[str]] = {}
    for name, influence in influences(campaign).items():
        first = ", ".join(
            f"{key}\u00a0{value:+.2f}" for key, value in list(influence.items())[:4]
        )
        causes.setdefault(first or "none significant", []).append(name)
    return [
        f"rank correlations with {', '.join(names)}: {first}"
        for first, names in causes.items()
    ]


def _errors(campaign: Campaign) -> list[str]:
    """Return the names of the errors in the table.

    Errors that are zero in all runs, for example of joints that a robot does not have, are left
    out.
    """
    names = [*KINDS]
    if campaign.wheels:
        names.append(WHEEL_SPEEDS)
    if campaign.modes:
        names.append(MODES)
    return [name for name in names if campaign.values(f"worst {name}").any()]


def shown_unit(campaign: Campaign, name: str) -> tuple[str, float]:
    """Return the unit in which reports and figures show a figure, and the factor to this unit.

    Angles are in deg and rates in deg/s. The speeds of wheels are in rad/s.
    """
    unit = campaign.figure(name)[1]
    kind = name.removeprefix("worst ")
    if kind == WHEEL_SPEEDS or kind.partition(".")[2] in campaign.wheels:
        return unit, 1.0
    return DEGREES.get(unit, (unit, 1.0))


def ended_of(campaign: Campaign) -> str:
    """Format the number of completed runs, and the number of stopped runs for each reason."""
    stops = ", ".join(f"{number:,} {word}" for word, number in _stops(campaign).items())
    return f"{int((campaign.stop == 0.0).sum()):,} completed; {stops or 'none stopped early'}"


def goal_met(campaign: Campaign, goal: str) -> str:
    """Format the success rate of a goal and the confidence interval of this rate."""
    met = campaign.fraction(goal, confidence=campaign.confidence)
    value, low, high = (f"{100.0 * x:.4g}" for x in met)
    sure = f"{100.0 * campaign.confidence:g} % confidence"
    return f"{campaign._with_units(goal)}: {value} % ({low} to {high} % at {sure})"


def influences(campaign: Campaign) -> dict[str, dict[str, float]]:
    """Return {quantity: {drawn value: rank correlation}} with the significant correlations only.

    The quantities are the first five of this list: `Campaign.about`, the quantities in the goals,
    the worst errors and the settling time.
    """
    doubt = 3.0 / math.sqrt(len(campaign))
    about = [campaign.about, *(x.name for x in campaign.bounds)]
    about += [*(f"worst {kind}" for kind in campaign.judged), "settle"]
    return {
        name: {k: x for k, x in campaign.sensitivity(name).items() if abs(x) > doubt}
        for name in list(dict.fromkeys(about))[:5]
    }


def worst_runs(campaign: Campaign, k: int) -> list[str]:
    """Return a table of the k worst runs, with the most influential drawn value of each run."""
    if not k:
        return []
    about, values = campaign.about, campaign.values(campaign.about)
    unit, factor = shown_unit(campaign, about)
    rows = [["run", about, "unit", "settling [s]", "end [s]", "most influential draw"]]
    ranks = campaign.drawn.argsort(axis=0).argsort(axis=0)
    weights = {key.strip("|"): abs(x) for key, x in campaign.sensitivity().items()}
    # A drawn value is influential if it is far from the median and its correlation is large. The
    # seed of the noise has no correlation, so it is never influential.
    out = abs(ranks - ranks.mean()) * [
        weights.get(name, 0.0) for name in campaign.names
    ]
    for run in campaign.worst(k):
        far = int(out[run].argmax())
        stop = STOPS[int(campaign.stop[run])]
        ended = f"{campaign.end[run]:g}"
        if stop:
            ended += f", {stop}"
        settled = _when(campaign.values("settle")[run])
        drawn = "-"
        if out[run, far]:
            drawn = f"{campaign.names[far]} = {campaign.drawn[run, far]:.3g}"
        size = f"{factor * values[run]:.3g}"
        rows.append([str(run), size, unit, settled, ended, drawn])
    return ["", grid(rows, "rrlrll"), ""]


def _when(time: float, unit: str = "") -> str:
    """Format a settling time as in the report of a motion."""
    if not math.isfinite(time):
        return "not yet"
    return f"{time:.3g}{unit}"


def campaign_record(campaign: Campaign, worst: int) -> dict[str, object]:
    """Return the report as JSON values; an estimate is [value, low, high].

    Infinity is written as null.
    """

    def plain(values: Iterable[float]) -> list[float | None]:
        return [x if math.isfinite(x) else None for x in values]

    names = [
        f"{prefix}{kind}" for kind in KINDS for prefix in ("", "worst ", "settle ")
    ]
    sure = {"confidence": campaign.confidence}
    header = [
        "robot",
        "urdf_sha256",
        "asked",
        "duration",
        "dt",
        "notes",
        "seed",
        "engine",
        "confidence",
    ]
    return {
        **{key: getattr(campaign, key) for key in header},
        "runs": len(campaign),
        "stopped": _stops(campaign),
        "units": {kind: campaign.figure(kind)[1] for kind in KINDS},
        "quantiles": {
            name: {f"{p:g}": plain(campaign.quantile(name, p, **sure)) for p in _SHARES}
            for name in names
        },
        "goals": {
            goal: plain(campaign.fraction(goal, **sure)) for goal in campaign.goals
        },
        "goes_with": influences(campaign),
        "worst": campaign.worst(worst) if worst else [],
    }


def _stops(campaign: Campaign) -> dict[str, int]:
    """Return {reason: number of runs that were stopped}."""
    counts = {
        word: int((campaign.stop == at).sum()) for at, word in enumerate(STOPS) if at
    }
    return {word: number for word, number in counts.items() if number}
