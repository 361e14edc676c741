"""LQR gains of the linear model at rest."""

import importlib
from collections.abc import Callable

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_continuous_are

import fflin
from benchmarks.peers import WrongResultError
from benchmarks.robots import Array, load, random_point
from benchmarks.tables import Table, figure
from benchmarks.timing import interleaved

NAMES = ("cubesat", "ur5", "servicer_7dof", "talos")
OWN = "fflin"
Solver = Callable[[fflin.LinearModel, Array, Array], Array]


def run() -> Table:
    solvers, notes = _solvers()
    reference = next(iter(solvers))
    rows = []
    for name in NAMES:
        point = random_point(load(name))
        lin = fflin.linearize(point.robot, point.q)
        Q = np.eye(len(lin.A))
        # a weight on torque over inertia
        R = np.diag(np.maximum(lin.M.diagonal(), 1e-3) ** -2.0)
        gains = {key: solve(lin, Q, R) for key, solve in solvers.items()}
        for key, gain in gains.items():
            error = (
                np.abs(gain - gains[reference]).max() / np.abs(gains[reference]).max()
            )
            if not error < 1e-6:
                raise WrongResultError(
                    f"{key} on {name}: the gain differs by {error:.1e}"
                )
        calls = {
            key: (lambda solve=solve, lin=lin, Q=Q, R=R: solve(lin, Q, R))
            for key, solve in solvers.items()
        }
        times = interleaved(calls)
        own = times.pop(reference)
        rows.append(
            (
                name,
                str(point.robot.n),
                figure(own.least * 1e3),
                *(figure(each.ratio(own)) for each in times.values()),
            )
        )
    return Table(
        "LQR",
        "The gain of the model at rest with weights on every state and input. The first column is "
        f"the time of {reference}; the times of the others are divided by it.",
        (
            "robot",
            "n",
            f"{reference} [ms]",
            *(key for key in solvers if key != reference),
        ),
        tuple(rows),
        tuple(notes),
    )


def _scipy(lin: fflin.LinearModel, Q: Array, R: Array) -> Array:
    P = solve_continuous_are(lin.A, lin.B, Q, R)
    return cho_solve(cho_factor(R), lin.B.T @ P)


def _solvers() -> tuple[dict[str, Solver], list[str]]:
    solvers: dict[str, Solver] = {}
    notes = []
    own = getattr(fflin, "lqr", None)
    if own is not None:
        solvers[OWN] = lambda lin, Q, R: own(lin, Q, R).K
    solvers["scipy"] = _scipy
    try:
        control = importlib.import_module("control")
        solvers["control.lqr"] = lambda lin, Q, R: control.lqr(lin.A, lin.B, Q, R)[0]
    except ImportError as error:
        notes.append(f"control: not installed ({error})")
    try:
        drake = importlib.import_module("pydrake.systems.controllers")
        solvers["Drake"] = lambda lin, Q, R: drake.LinearQuadraticRegulator(
            lin.A, lin.B, Q, R
        )[0]
    except ImportError as error:
        notes.append(f"drake: not installed ({error})")
    return solvers, notes
