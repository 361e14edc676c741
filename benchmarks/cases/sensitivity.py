"""Derivatives over the ten dynamic parameters of every body, beside one inverse of M."""

import numpy as np
import pinocchio as pin

import fflin
from benchmarks.peers import WrongResultError
from benchmarks.robots import load
from benchmarks.tables import Table, figure
from benchmarks.timing import interleaved
from fflin.uncertainty.derivatives import ModelDerivatives

ROBOTS = ("ets_vii", "servicer_7dof", "canadarm2")


def run() -> Table:
    rows = []
    for name in ROBOTS:
        robot = load(name)
        model, data = robot.model, robot.create_data()
        q = pin.integrate(
            model, pin.neutral(model), np.random.default_rng(0).normal(size=model.nv)
        )
        lin = fflin.linearize(robot, q)
        found = fflin.sensitivity(lin)
        if max(found.check(["base.mass", "link_2.com.y"]).values()) > 1e-7:
            raise WrongResultError(
                f"fflin on {name}: the derivatives do not pass their check"
            )
        slopes, parameters = found._derivatives, list(found.parameters.values())
        times = interleaved(
            {
                "inverse": lambda: pin.computeMinverse(model, data, q),  # noqa: B023
                # The function of the cached property, so that each call computes them.
                "rates": lambda: ModelDerivatives._of_bodies.func(slopes),  # noqa: B023
                "matrices": lambda: slopes.over(parameters),  # noqa: B023
                "whole": lambda: fflin.sensitivity(lin).dB,  # noqa: B023
            }
        )
        inverse = times["inverse"]
        rows.append(
            (
                name,
                str(10 * (robot.n + 1)),
                figure(inverse.least * 1e6),
                figure(times["rates"].ratio(inverse)),
                str(len(parameters)),
                figure(times["matrices"].ratio(inverse)),
                figure(times["whole"].ratio(inverse)),
            )
        )
    return Table(
        "Derivatives with respect to masses",
        "Derivatives at rest with respect to the ten dynamic parameters of every body, as ratios "
        "to one `pin.computeMinverse`. The columns are the derivatives of the accelerations with "
        "respect to state and inputs, which determine A and B; of A, B, C, D and f0 for every "
        "named parameter; and these with all preparations of `sensitivity`.",
        ("robot", "parameters", "inverse [us]", "slopes", "named", "matrices", "whole"),
        tuple(rows),
    )
