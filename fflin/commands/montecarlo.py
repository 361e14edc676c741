"""The command that flies a loop many times with what is uncertain drawn at random."""

from __future__ import annotations

import argparse
import json

from fflin.base.errors import InputError
from fflin.commands import DONE
from fflin.commands.arguments import (
    Commands,
    add_output_file,
    add_values,
    command,
    count_of,
    file_name,
    number,
    whole,
)
from fflin.commands.loop_options import add_loop
from fflin.commands.loops import loop_of
from fflin.commands.points import load_robot
from fflin.commands.sweeps import executor_of
from fflin.commands.visual import (
    add_figure,
    add_pictures,
    check_figure,
    check_pictures,
    show_motion,
)

_ROWS = 240  # at which errors and inputs are kept for a figure


def add_commands(commands: Commands) -> None:
    """Add montecarlo."""
    montecarlo = command(
        commands,
        "montecarlo",
        _montecarlo,
        "simulate a loop many times with what is uncertain drawn at random: quantiles, shares, "
        "the worst runs and what they come from",
        "fflin montecarlo ets_vii --dispersions uncertain.toml --runs 1000 --plot runs.png",
    )
    add_loop(montecarlo)
    draws, work, shown = map(
        montecarlo.add_argument_group, ("the runs", "who does them", "what is kept and shown")
    )
    draws.add_argument(
        "--dispersions",
        metavar="FILE.toml",
        type=file_name,
        required=True,
        help="what is drawn at random, a table [dispersions] as fflin.load_dispersions reads it",
    )
    draws.add_argument("--runs", metavar="N", type=count_of, required=True, help="how many")
    draws.add_argument("--seed", metavar="S", type=whole, default=0, help="of the draws; 0")
    draws.add_argument(
        "--until",
        metavar="CONDITION",
        help="make no more runs once the share that meets it, 'attitude < 1 deg', is known to "
        "--width",
    )
    for name, value, what in (("width", 0.02, "--until"), ("confidence", 0.95, "all intervals")):
        draws.add_argument(
            f"--{name}", metavar="P", type=number, default=value, help=f"of {what} ({value:g})"
        )
    work.add_argument("--workers", metavar="N", type=count_of, help="share them among N processes")
    work.add_argument("--threads", metavar="N", type=count_of, help="or threads; all cores' else")
    work.add_argument("--dask", metavar="ADDRESS", help="or the workers of a dask scheduler")
    add_values(
        shown,
        "--goal",
        "say the share of runs that meet a condition, 'attitude < 1 deg and settle < 60 s', and "
        "draw its bounds",
        metavar="CONDITION",
        read=str,
    )
    shown.add_argument(
        "--worst", metavar="K", type=whole, default=3, help="say the K worst runs (3)"
    )
    shown.add_argument("--json", action="store_true", help="print the figures as JSON")
    add_figure(shown, "draw bands of quantiles over time, histograms and the worst runs")
    add_output_file(
        shown,
        "save the runs to FILE: .h5 (HDF5) or .npz; it grows as FILE.part, and the same command "
        "goes on from what is there",
    )
    add_pictures(shown, "write a page that plays the worst run, with the paths of the others")


def _montecarlo(arguments: argparse.Namespace) -> int:
    from fflin.base.progress import Progress
    from fflin.base.writing import check_distinct
    from fflin.batch.store import output_path, part_of
    from fflin.campaign.dispersion_files import load_dispersions
    from fflin.campaign.monte_carlo import monte_carlo
    from fflin.campaign.report import campaign_record, worst_runs

    path, pictures = arguments.output_file, ("html", "png", "gif")
    check_distinct(path, arguments.plot, *(getattr(arguments, name) for name in pictures))
    check_figure(arguments.plot)
    if path:
        output_path(path)
    if arguments.workers and arguments.dask:
        raise InputError("--workers and --dask both share the work; give either")
    dispersions = load_dispersions(arguments.dispersions)
    robot = load_robot(arguments)
    check_pictures(robot, arguments)
    loop, bar, reached = loop_of(robot, arguments), Progress(), [0, arguments.runs]

    def progress(done: int, total: int) -> None:
        reached[:] = done, total
        bar.update(done, total)

    with executor_of(arguments.dask) as executor:
        try:
            campaign = monte_carlo(
                robot,
                loop.policy,
                dispersions,
                **{name: getattr(arguments, name) for name in ("runs", "seed", "until")},
                **{name: getattr(arguments, name) for name in ("width", "confidence")},
                **{name: getattr(arguments, name) for name in ("workers", "threads")},
                goals=arguments.goal,
                histories=_ROWS if arguments.plot else 0,
                executor=executor,
                progress=progress,
                out=path,
                **loop.options,
            )
        except KeyboardInterrupt:
            said = "stopped after {:,} of {:,} runs; ".format(*reached)
            if path and part_of(path).exists():
                said += f"the same command goes on from {part_of(path)}"
            else:
                said += "nothing is kept, which -o FILE.h5 would do"
            raise KeyboardInterrupt(said) from None
        finally:
            bar.close()
    lines = [f"wrote {path}"] if path else []
    try:
        if arguments.plot:
            campaign.plot(arguments.plot)
            lines.append(f"wrote {arguments.plot}")
        if any(getattr(arguments, name) for name in pictures):
            [worst] = campaign.worst(1)
            lines += show_motion(robot, campaign.replay(worst), arguments, campaign)
    finally:
        if arguments.json:
            print(json.dumps(campaign_record(campaign, arguments.worst), indent=2))
        else:
            print("\n".join([str(campaign), *worst_runs(campaign, arguments.worst), *lines]))
    return DONE
