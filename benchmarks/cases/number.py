"""Many linearisations at rest, one after the other."""

import numpy as np
import pinocchio as pin

import fflin
from benchmarks.robots import load
from benchmarks.tables import Table, figure
from benchmarks.timing import interleaved

ROBOT = "servicer_7dof"
COUNTS = (1, 10, 100, 1000, 10_000)


def run() -> Table:
    robot = load(ROBOT)
    model, data = robot.model, robot.create_data()
    rng = np.random.default_rng(0)
    neutral = pin.neutral(model)
    steps = rng.normal(size=(max(COUNTS), model.nv))
    configurations = [pin.integrate(model, neutral, step) for step in steps]
    rows = []
    for count in COUNTS:
        some = configurations[:count]

        def each(some: list[np.ndarray] = some) -> None:
            linearizer = fflin.Linearizer(robot)
            for q in some:
                linearizer(q)

        def afresh(some: list[np.ndarray] = some) -> None:
            for q in some:
                fflin.linearize(robot, q)

        def bare(some: list[np.ndarray] = some) -> None:
            for q in some:
                pin.computeMinverse(model, data, q)

        calls = {"each": each, "bare": bare}
        if count <= 1000:
            calls["afresh"] = afresh
        times = interleaved(calls)
        own = times["each"]
        fresh = times["afresh"].ratio(own) if "afresh" in times else None
        rows.append(
            (
                f"{count:,}",
                figure(own.least / count * 1e6),
                figure(fresh),
                figure(own.ratio(times["bare"])),
            )
        )
    return Table(
        "Growth with the number of points",
        f"Linearisations of {ROBOT} at rest with a new Linearizer, including its construction. The "
        "columns are the time per point, the time per call of `linearize` divided by it, and its "
        "ratio to pin.computeMinverse.",
        (
            "points",
            "fflin [us a point]",
            "linearize, each afresh",
            "fflin / computeMinverse",
        ),
        tuple(rows),
    )
