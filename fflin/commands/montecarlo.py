"""The command that flies a loop many times with what is uncertain drawn at random."""

from __future__ import annotations

import argparse
import json
from typing import Any

from fflin.base.tables import headed
from fflin.commands import DONE
from fflin.commands.arguments import Commands, add_options, add_output_file, command, input_file
from fflin.commands.loops import add_loop, loop_of
from fflin.commands.points import load_robot
from fflin.commands.sweeps import executor_of, going_on
from fflin.commands.visual import add_pictures, check_figure, check_pictures, show_motion

_ROWS = 240  # at which errors and inputs are kept for a figure
_PICTURES = ("html", "png", "gif")
_PASSED = ("runs", "seed", "until", "width", "confidence", "workers", "threads")


def add_commands(commands: Commands) -> None:
    """Add montecarlo."""
    montecarlo = command(
        *(commands, "montecarlo", _montecarlo),
        "simulate a loop many times with what is uncertain drawn at random: quantiles, shares, "
        "the worst runs and what they come from",
        "fflin montecarlo ets_vii uncertain.toml --runs 1000 --plot runs.png",
    )
    add_loop(montecarlo)
    montecarlo.add_argument(
        "dispersions",
        metavar="DISPERSIONS",
        type=input_file,
        help="what is drawn at random, a table [dispersions] in TOML as fflin.load_dispersions "
        "reads it",
    )
    add_options(
        montecarlo.add_argument_group("the runs, and who does them"),
        """
        --runs N!: how many
        --seed S = 0: of the draws; 0 by default
        --until CONDITION: make no more runs once the share that meets it, 'attitude < 1 deg', is
            known to --width
        --width P = 0.02: of the interval of that share; 0.02 by default
        --confidence P = 0.95: of all intervals; 0.95 by default
        --workers N: share them among N processes
        --threads N: or among N threads; by default as many as there are cores
        --dask ADDRESS: or among the workers of a dask scheduler""",
    )
    shown = montecarlo.add_argument_group("what is kept and shown of them")
    add_options(
        shown,
        """
        --goal CONDITION*: say the share of runs that meet it, 'attitude < 1 deg and settle < 60 s',
            and draw its bounds
        --worst K = 3: say the K worst runs; 3 by default
        --json: print the figures as JSON
        --plot >FILE: draw bands over time, histograms and the worst runs into FILE: .png, .pdf or
            .svg""",
    )
    add_output_file(
        shown,
        "save the runs to FILE: .h5 (HDF5) or .npz; it grows as FILE.part, and the same command "
        "goes on from what is there",
    )
    add_options(shown, "--force: replace a file of -o that holds anything but these runs")
    add_pictures(shown, "that plays the worst run, with the paths of others as thin lines")


def _montecarlo(arguments: argparse.Namespace) -> int:
    from fflin.batch.store import output_path
    from fflin.campaign.dispersion_files import load_dispersions
    from fflin.campaign.monte_carlo import monte_carlo
    from fflin.campaign.plots import plot_campaign
    from fflin.campaign.report import campaign_record, worst_runs

    path = arguments.output_file
    check_figure(arguments.plot)
    if path:
        output_path(path)
    dispersions = load_dispersions(arguments.dispersions)
    robot = load_robot(arguments)
    check_pictures(robot, arguments)
    loop = loop_of(robot, arguments)
    options: dict[str, Any] = {name: getattr(arguments, name) for name in _PASSED} | loop.options
    options |= {"goals": arguments.goal, "histories": _ROWS if arguments.plot else 0}
    with executor_of(arguments) as executor, going_on(path, "runs") as progress:
        options |= {"executor": executor, "progress": progress, "out": path}
        options["overwrite"] = arguments.force
        campaign = monte_carlo(robot, loop.policy, dispersions, **options)
    lines = [f"wrote {path}"] if path else []
    try:
        if arguments.plot:
            plot_campaign(campaign, arguments.plot)
            lines.append(f"wrote {arguments.plot}")
        if any(getattr(arguments, name) for name in _PICTURES):
            worst = campaign.replay(campaign.worst(1)[0])
            lines += show_motion(robot, worst, arguments, campaign)
    finally:
        if arguments.json:
            print(json.dumps(campaign_record(campaign, arguments.worst), indent=2))
        else:
            print(
                "\n".join(
                    [
                        headed("montecarlo", str(campaign)),
                        *worst_runs(campaign, arguments.worst),
                        *lines,
                    ]
                )
            )
    return DONE
