"""A single linearisation at a point by the compiled kernel, against Pinocchio's derivatives."""

import numpy as np
import pinocchio as pin

import fflin
from benchmarks.peers import WrongResultError
from benchmarks.robots import NAMES, load, random_point
from benchmarks.tables import Table, figure
from benchmarks.timing import interleaved
from fflin.robot.catalog import bundled_directory

# What is asked: so many times `pin.computeABADerivatives`, and so much besides [s].
SHARE, BESIDE = 1.5, 5e-6
BUNDLED = sorted(path.stem for path in bundled_directory().glob("*.urdf"))
TILTED = pin.SE3(pin.exp3(np.array([0.3, 0.5, -0.2])), np.array([1.0, 2.0, 3.0]))
CASES = {
    "moving along": {"moving": True},
    "world, tilted": {"frame": "world", "reference": TILTED},
}


def run() -> Table:
    rows = []
    for name in dict.fromkeys((*BUNDLED, *NAMES)):
        point = random_point(load(name))
        robot, model, data = point.robot, point.robot.model, point.robot.create_data()
        q, v, u, tau = point.q, point.v, point.u, np.zeros(point.robot.nv)
        plain, *others = (
            fflin.Linearizer(robot, engine="compiled", **options)
            for options in ({}, *CASES.values())
        )
        slow = fflin.Linearizer(robot, engine="python")
        _check(plain(q, v, u), slow(q, v, u))
        calls = {
            "pin": lambda: pin.computeABADerivatives(model, data, q, v, tau),  # noqa: B023
            "point": lambda: plain(q, v, u),  # noqa: B023
            "at rest": lambda: plain(q),  # noqa: B023
            **{
                name: lambda each=each: each(q, v, u)  # noqa: B023
                for name, each in zip(CASES, others, strict=True)
            },
            "numpy": lambda: slow(q, v, u),  # noqa: B023
        }
        times = {name: each.least for name, each in interleaved(calls).items()}
        limit = SHARE * times["pin"] + BESIDE
        shares = (figure(times[name] / limit) for name in ("point", "at rest", *CASES, "numpy"))
        rows.append(
            (robot.name, str(robot.n), *(figure(1e6 * times[x]) for x in ("pin", "point")), *shares)
        )
    return Table(
        "One linearisation by the compiled kernel",
        "The first two columns are the times of pin.computeABADerivatives and of fflin at an "
        f"operating point. The other columns are times divided by {SHARE:g} times the first time "
        f"plus {BESIDE * 1e6:g} us: of fflin at an operating point, at rest, along a moving "
        "reference, in another frame and reference, and without the kernel.",
        ("robot", "n", "Pinocchio [us]", "fflin [us]", "point", "at rest", *CASES, "numpy"),
        tuple(rows),
    )


def _check(found: fflin.LinearModel, exact: fflin.LinearModel) -> None:
    allowed = 1e-13 * exact.certificate.condition
    pairs = (found.A, exact.A), (found.B, exact.B), (found.f0, exact.f0)
    for one, other in pairs:
        if not np.abs(one - other).max() < allowed * np.abs(other).max():
            raise WrongResultError(f"the kernel's model of {exact.robot} differs")
