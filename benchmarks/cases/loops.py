"""A step of the closed loop: state feedback of every coordinate, 10 s in steps of 10 ms."""

import importlib
from collections.abc import Callable, Iterator

import numpy as np
import pinocchio as pin

import fflin
from benchmarks.closed_loop import Loop, driven, error, true_end, with_wheels
from benchmarks.contender import Contender
from benchmarks.peers import WrongResultError
from benchmarks.tables import Table, figure
from benchmarks.timing import interleaved

NAMES, BODY = ("cubesat", "ets_vii", "servicer_7dof"), "cubesat"
STEP, DURATION = 0.01, 10.0  # [s]
MANY = 25_000  # steps; by default, `simulate` compiles runs of more than 20,000 steps
PEERS = {"MuJoCo": "mujoco_loop", "Drake": "drake_loop", "Basilisk": "basilisk_loop"}
FLOOR = "four pin.aba"
WORST = 1e-5  # of the errors; what is further off is another loop


def run() -> Table:
    loops = {name: driven(name, STEP, DURATION) for name in NAMES}
    loops[f"{BODY}, wheels"] = with_wheels(BODY, STEP, DURATION)
    rows: list[tuple[str, ...]] = []
    notes: dict[str, None] = {}
    for name, loop in loops.items():
        found, said = contenders(loop)
        notes |= dict.fromkeys(said)
        rows += measured(name, found)
    return Table(
        "Closed-loop step",
        f"State feedback u = -K x for {DURATION:g} s in steps of {1e3 * STEP:g} ms, with every "
        "coordinate decoupled at 0.3 rad/s. The columns are the shortest time per step; its ratio "
        "to four calls of pin.aba from Python as minimum, median and maximum over the rounds; and "
        "the final error relative to the start, compared with DOP853 on Pinocchio's "
        "accelerations. `held`: the input is computed once per step, otherwise at every stage. "
        f"`{MANY:,} steps`: the same motion in shorter steps, because by default fflin compiles "
        "only runs of more than 20,000 steps. `all rows`: the call of a user, which records every "
        "step, with energy, momentum and the prediction of the linear model. All other rows record "
        "the last state alone. In the rows without a number of steps, the fixed time of a call is "
        f"divided by {DURATION / STEP:,.0f} steps. "
        "`free`: no feedback, all in C. fflin and MuJoCo use integrators of order four. Drake "
        "uses order three and its own gain in C++, in the frame `world`. MuJoCo's feedback is in "
        "Python: a callback, or code between the steps. Basilisk runs its flight software with "
        "gains that give the same motion to first order.",
        ("robot", "loop", "us", "least", "median", "most", "error"),
        tuple(rows),
        tuple(notes),
    )


def contenders(loop: Loop) -> tuple[list[Contender], list[str]]:
    """Return who runs a loop, and what is said of who does not."""
    found, notes = fflin_contenders(loop), []
    for peer, module_name in PEERS.items():
        try:
            module = importlib.import_module(f"benchmarks.peers.{module_name}")
        except ImportError as missing:
            notes.append(f"{peer}: not installed ({missing})")
            continue
        try:
            found += module.contenders(loop)
        except module.REFUSALS as refusal:
            robot = f"{loop.robot.name} with wheels" if loop.wheels else loop.robot.name
            notes.append(
                f"{peer}: not on {robot}: {' '.join(str(refusal).split())[:80]}"
            )
    return found, notes


def fflin_contenders(loop: Loop) -> list[Contender]:
    free = loop.but(held=False)
    many = free.but(dt=loop.duration / MANY)
    return [
        _fflin("fflin", free, "compiled"),
        _fflin(f"fflin, {MANY:,} steps", many, "compiled"),
        _fflin(f"fflin, {MANY:,} steps, all rows", many, "compiled", rows=True),
        _fflin("fflin, held", loop.but(held=True), "compiled"),
        _fflin("fflin, in Python", free, "python"),
    ]


def _fflin(name: str, loop: Loop, engine: str, *, rows: bool = False) -> Contender:
    kept: dict[str, fflin.Motion] = {}

    def call() -> None:
        how: dict[str, object] = {"engine": engine}
        if not rows:
            # Like the peers, keep the last state alone.
            how |= {"linear": False, "every": loop.steps}
        kept["motion"] = fflin.simulate(loop.robot, loop.policy, **how, **loop.options)

    return Contender(name, loop, call, lambda: kept["motion"].x[-1])


def measured(name: str, found: list[Contender]) -> Iterator[tuple[str, ...]]:
    """Check contenders against the truth of their loops, time them, and return their rows."""
    errors = {each.name: checked(each) for each in found}
    loop = found[0].loop
    steps = {FLOOR: loop.steps, **{each.name: each.loop.steps for each in found}}
    times = interleaved({FLOOR: bare(loop), **{each.name: each.run for each in found}})
    times = {each: taken.per(steps[each]) for each, taken in times.items()}
    for each, taken in times.items():
        ratios = (figure(ratio) for ratio in taken.ratios(times[FLOOR]))
        apart = errors.get(each)
        shown = figure(None) if apart is None else f"{apart:.0e}"
        yield name, each, figure(taken.least * 1e6), *ratios, shown


def checked(contender: Contender) -> float | None:
    """Return the error of a contender's last state, or raise where it is of another loop."""
    if contender.end is None:
        return None
    contender.run()
    loop = contender.loop
    apart = error(loop, contender.end(), true_end(loop))
    if not apart < WORST:
        raise WrongResultError(
            f"{contender.name} on {loop.robot.name}: ends {apart:.1e} apart"
        )
    return apart


def bare(loop: Loop) -> Callable[[], None]:
    """Return four calls of ABA for every step."""
    model, data = loop.robot.model, loop.robot.create_data()
    q, tau = loop.point.q, np.zeros(loop.robot.nv)
    v = np.full(loop.robot.nv, 0.1)

    def call() -> None:
        for _ in range(4 * loop.steps):
            pin.aba(model, data, q, v, tau)

    return call
