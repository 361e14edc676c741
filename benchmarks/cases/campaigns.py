"""A Monte Carlo of the closed loop: 60 s in steps of 0.1 s, growing with the number of runs."""

import importlib
from collections.abc import Callable, Iterator

import numpy as np

from benchmarks.cases.loops import PEERS, bare
from benchmarks.closed_loop import Loop, driven, error, with_wheels
from benchmarks.contender import Contender
from benchmarks.dispersed import draws, fflin_campaign
from benchmarks.peers import WrongResultError
from benchmarks.processes import measured
from benchmarks.tables import Table, figure
from benchmarks.timing import beside

STEP, DURATION, CORES = 0.1, 60.0, 4  # [s]
LOOPS: dict[str, Callable[[], Loop]] = {
    "cubesat": lambda: driven("cubesat", STEP, DURATION).at_rest(),
    "ets_vii": lambda: driven("ets_vii", STEP, DURATION).at_rest(),
    "cubesat, wheels": lambda: with_wheels("cubesat", STEP, DURATION).at_rest(),
}
ROUNDS = {10: 5, 100: 5, 1_000: 3, 10_000: 2}
OF_PEERS = (10, 100)  # runs; one after the other, more of them take as long each
OF_WHEELS = (10, 100, 1_000)
FLOORS = 10  # times that the floor goes through the steps of a run
# runs and [s] of the check, and the errors it allows
CHECKED, BRIEF, WORST = 8, 5.0, 1e-5
ALONE, HELD = "fflin", "fflin, held"
THREADS, WORKERS = f"fflin, {CORES} threads", f"fflin, {CORES} workers"


def run() -> Table:
    rows: list[tuple[str, ...]] = []
    notes: dict[str, None] = {}
    for name, make in LOOPS.items():
        loop = make()
        peers, said = peers_of(loop)
        notes |= dict.fromkeys(said)
        for runs in OF_WHEELS if loop.wheels else ROUNDS:
            rows += _measured(name, loop, peers, runs)
    notes |= dict.fromkeys(_of_duration("ets_vii", 1_000))
    return Table(
        "Campaign",
        f"Runs of {DURATION:g} s in steps of {STEP:g} s under state feedback, each with a random "
        "attitude and base mass. The columns are the shortest time per step and run; its ratio to "
        "four calls of pin.aba from Python as minimum, median and maximum over the rounds; and "
        "the peak memory of a process that runs only this campaign. Everything runs on one thread "
        "unless threads or workers (processes) are named. `held`: the input is computed once per "
        "step, otherwise at every stage. MuJoCo's `rollout` on threads has no feedback, so that "
        "its runs are a loop in Python. Drake's MonteCarloSimulation uses one thread in Python. "
        "Basilisk's Controller uses one process here, without retained data, and waits one second "
        f"per run for it. These three simulate one run after the other: {OF_PEERS[0]} and "
        f"{OF_PEERS[1]} runs show the growth, and more are not timed.",
        ("robot", "loop", "runs", "us", "least", "median", "most", "MiB"),
        tuple(rows),
        tuple(notes),
    )


def peers_of(loop: Loop) -> tuple[list[Callable[[int], Contender]], list[str]]:
    """Return what makes each peer's campaign of so many runs, checked, and notes on the others."""
    found: list[Callable[[int], Contender]] = []
    notes = []
    for peer, module_name in PEERS.items():
        name = module_name.replace("loop", "campaign")
        try:
            module = importlib.import_module(f"benchmarks.peers.{name}")
        except ImportError as missing:
            notes.append(f"{peer}: not installed ({missing})")
            continue
        try:
            check(module.campaign(*_brief(loop)))
        except module.REFUSALS as refusal:
            robot = f"{loop.robot.name} with wheels" if loop.wheels else loop.robot.name
            notes.append(
                f"{peer}: not on {robot}: {' '.join(str(refusal).split())[:80]}"
            )
            continue
        drawn = draws(loop, max(OF_PEERS))
        found.append(
            lambda runs, of=module.campaign, drawn=drawn: of(loop, drawn[:runs])
        )
    return found, notes


def _brief(loop: Loop) -> tuple[Loop, np.ndarray]:
    return loop.but(duration=BRIEF), draws(loop, CHECKED)


def check(contender: Contender) -> float:
    """Return how far a campaign's runs end from fflin's of the same draws, or raise.

    One that draws for itself must end as often as it was asked to, everywhere else.
    """
    contender.run()
    loop, ends = contender.loop, np.array(contender.end())
    if loop.mrp:
        apart = 0.0 if len(np.unique(ends[:, 0])) == CHECKED else np.inf
    else:
        own = fflin_campaign(ALONE, loop, CHECKED)
        own.run()
        apart = max(error(loop, *pair) for pair in zip(ends, own.end(), strict=True))
    if not apart < WORST:
        raise WrongResultError(
            f"{contender.name} on {loop.robot.name}: runs end {apart:.1e} apart"
        )
    return apart


def _measured(
    name: str, loop: Loop, peers: list[Callable[[int], Contender]], runs: int
) -> Iterator[tuple[str, ...]]:
    found = [*own(loop, runs), *(make(runs) for make in peers if runs in OF_PEERS)]
    once = bare(loop)

    def floor() -> None:
        for _ in range(FLOORS):
            once()

    for each, (taken, aba) in beside(
        floor, {e.name: e.run for e in found}, ROUNDS[runs]
    ).items():
        ratios = (figure(FLOORS * ratio / runs) for ratio in taken.ratios(aba))
        told = each not in (HELD, THREADS, WORKERS) and runs in (100, max(ROUNDS))
        peak = figure(peak_memory(name, each, runs) if told else None)
        time = figure(taken.least / loop.steps / runs * 1e6)
        yield name, each, f"{runs:,}", time, *ratios, peak


def own(loop: Loop, runs: int) -> list[Contender]:
    """Return fflin's ways to do so many runs."""
    held, smooth = loop.but(held=True), loop.but(held=False)
    if runs in OF_PEERS:
        return [fflin_campaign(HELD, held, runs), fflin_campaign(ALONE, smooth, runs)]
    found = [
        fflin_campaign(ALONE, smooth, runs),
        fflin_campaign(THREADS, smooth, runs, threads=CORES),
    ]
    several = [fflin_campaign(WORKERS, smooth, runs, workers=CORES)]
    return found + several * (runs >= max(ROUNDS))


def peak_memory(name: str, contender: str, runs: int, times: int = 1) -> float:
    """Return the peak memory [MiB] of a process that does one campaign, `times` as long."""
    source = f"from benchmarks.cases.campaigns import alone; alone{name, contender, runs, times}"
    return measured(contender, source)[1]


def alone(name: str, contender: str, runs: int, times: int) -> None:
    """Do one campaign, and load no more than it needs."""
    loop = LOOPS[name]()
    loop = loop.but(duration=times * loop.duration)
    if contender.startswith("fflin"):
        found = next(each for each in own(loop, runs) if each.name == contender)
    else:
        module_name = PEERS[contender.partition(",")[0]].replace("loop", "campaign")
        module = importlib.import_module(f"benchmarks.peers.{module_name}")
        found = module.campaign(loop, draws(loop, runs))
    found.run()


def _of_duration(name: str, runs: int) -> Iterator[str]:
    short, long = (peak_memory(name, ALONE, runs, times) for times in (1, 10))
    yield (
        f"{runs:,} runs of {name} take {figure(short)} MiB at {DURATION:g} s and {figure(long)} "
        f"MiB at {10 * DURATION:g} s"
    )
