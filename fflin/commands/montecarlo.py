"""The command `montecarlo`: many simulations of a loop with random parameters."""

from __future__ import annotations

import argparse
from functools import cache
from typing import Any

from fflin.commands import options, parser
from fflin.commands.loops import add_loop, loop_of
from fflin.commands.points import load_robot
from fflin.commands.results import Report, figure_of
from fflin.commands.sweeps import executor_of, going_on
from fflin.commands.visual import add_pictures, check_pictures, pictures

_ROWS = 240  # of errors and inputs for a figure
_PASSED = ("runs", "seed", "until", "width", "confidence", "workers", "threads")


def add_commands(commands: parser.Commands) -> None:
    """Add montecarlo."""
    montecarlo = parser.command(
        commands,
        "montecarlo",
        _montecarlo,
        "simulate a control loop many times with random parameters; show quantiles, success rates "
        "and the worst runs with their causes",
        example="fflin montecarlo ets_vii uncertain.toml --runs 1000 --plot runs.png",
        common="runs seed until width confidence workers goal worst joint rpy trajectory "
        "gain schedule duration inputs output-file plot",
    )
    add_loop(montecarlo)
    montecarlo.add_argument(
        "dispersions",
        metavar="DISPERSIONS",
        type=parser.input_file,
        help="TOML file with a table [dispersions] that defines the random parameters; see "
        "fflin.load_dispersions",
    )
    runs = montecarlo.group("runs")
    runs.add("--runs", "number of runs", int, required=True)
    runs.add("--seed", "random seed", parser.whole, "S", default=0)
    runs.add(
        "--until",
        "stop when the success rate of CONDITION, such as 'attitude < 1 deg', has a confidence "
        "interval of at most --width",
        metavar="CONDITION",
    )
    width = "width of the confidence interval at which --until stops the runs"
    runs.add("--width", width, float, "P", default=0.02)
    runs.add("--confidence", "confidence level of all intervals", float, "P", default=0.95)
    runs.add("--workers", "distribute the runs over N processes", int)
    threads = "distribute the runs over N threads; by default one per core"
    runs.add("--threads", threads, int)
    dask = "distribute the runs over the workers of a dask scheduler"
    runs.add("--dask", dask, metavar="ADDRESS")
    shown = montecarlo.group(parser.OUTPUT)
    shown.add(
        "--goal",
        "report the fraction of runs that meet CONDITION, such as 'attitude < 1 deg and settle < "
        "60 s', and plot the bounds in CONDITION",
        metavar="CONDITION",
        repeatable=True,
    )
    shown.add("--worst", "list the K worst runs", parser.whole, "K", default=3)
    options.add_figure(montecarlo, "quantile bands over time, histograms and the worst runs")
    what = "the runs (after an interruption, the same command resumes from FILE.part)"
    force = "replace the file of -o even if the file contains another campaign"
    options.add_output_file(shown, what, parser.ROWS)
    shown.switch("--force", force)
    add_pictures(montecarlo, "that plays the worst run")


def _montecarlo(arguments: argparse.Namespace) -> Report:
    from fflin.campaign.monte_carlo import monte_carlo
    from fflin.campaign.report import campaign_record, worst_runs
    from fflin.campaign.spreads import load_dispersions

    path = arguments.output_file
    dispersions = load_dispersions(arguments.dispersions)
    robot = load_robot(arguments)
    check_pictures(robot, arguments)
    loop = loop_of(robot, arguments)
    settings: dict[str, Any] = {name: getattr(arguments, name) for name in _PASSED} | loop.options
    settings |= {"goals": arguments.goal, "histories": _ROWS if arguments.plot else 0}
    with executor_of(arguments) as executor, going_on(path, "runs") as progress:
        settings |= {"executor": executor, "progress": progress, "out": path}
        settings["overwrite"] = arguments.force
        campaign = monte_carlo(robot, loop.policy, dispersions, **settings)
    worst = cache(lambda: campaign.replay(campaign.worst(1)[0]))
    files = {
        path: None,
        arguments.plot: figure_of("plot_campaign", campaign),
        **pictures(robot, worst, arguments),
    }
    text = "\n".join([str(campaign), *worst_runs(campaign, arguments.worst)])
    return Report(robot.name, campaign_record(campaign, arguments.worst), text, files)
