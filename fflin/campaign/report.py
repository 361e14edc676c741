"""What is said of a campaign: how its runs ended, how large their errors were, and whence."""

from __future__ import annotations

import math
from typing import Any

from fflin.base.tables import folded, grid
from fflin.campaign.tally import KINDS, STOPS


def campaign_report(campaign: Any) -> str:
    """Show the quantiles of the errors, and what they go with."""
    count, quantile = len(campaign), campaign.quantile
    by = ", compiled" if campaign.engine == "compiled" else ""
    few = f" of {campaign.asked:,} asked for" if count < campaign.asked else ""
    title = f"{campaign.robot}: {count:,} runs{few}, {campaign.duration:g} s each"
    stops = {word: int((campaign.stop == at).sum()) for at, word in enumerate(STOPS) if at}
    said = ", ".join(f"{number:,} {word}" for word, number in stops.items() if number)
    ended = f"{count - sum(stops.values()):,} came to their end; {said or 'none was stopped'}"
    rows = [["error", "unit", "half", "95 %", "99 %", "worst 95 %", "settled after [s]"]]
    for name, unit in KINDS.items():
        figures = [quantile(name, p).value for p in (0.5, 0.95, 0.99)]
        figures += [quantile(f"{of} {name}", 0.95).value for of in ("worst", "settle")]
        rows.append([name, unit, *(f"{x:.3g}" for x in figures)])
    told, doubt = [], 3.0 / math.sqrt(count)  # of what is drawn alike by chance
    for name in [f"worst {kind}" for kind in campaign.judged[:2]] or [campaign.about]:
        found = [item for item in campaign.sensitivity(name).items() if abs(item[1]) > doubt]
        first = ", ".join(f"{key}\u00a0{value:+.2f}" for key, value in found[:4])
        told.append(f"{name} goes with (rank correlation): {first or 'nothing that is told'}")
    head = folded([f"{title}, seed {campaign.seed}{by}", ended])
    return "\n".join([head, "", grid(rows, "ll"), "", folded(told)])
