"""Plans of a receding horizon: what a sample takes in a slew that is at its limits."""

import importlib
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pinocchio as pin
import scipy.sparse as sp

import fflin
from benchmarks.peers import WrongResultError
from benchmarks.tables import Table, figure
from fflin.control.mpc import Receding

SAMPLES, STEP, DURATION = 20, 0.1, 30.0
SLEWS = {
    "servicer_7dof": (90.0, {"tau_b": 60.0, "F_b": 20.0, "tau_m": 1.0}),
    "planar_detumble": (60.0, {"tau_b": 4.0, "F_b": 2.0, "tau_m": 0.5}),
}
# Returns the first inputs of a plan, None where it is not finished.
Solver = Callable[[float, Any], Any]


def run() -> Table:
    rows, notes = [], []
    for name, (turn, limits) in SLEWS.items():
        robot = fflin.load(name)
        lin = fflin.linearize(robot)
        Q = fflin.bryson(lin, {"q_b": 0.05, "r_b": 0.1, "q_m": 0.1})
        R = fflin.bryson(lin, {"tau_b": 20.0, "F_b": 20.0, "tau_m": 5.0})
        weak = ["urdf", limits]
        policy = fflin.mpc(lin, Q, R, horizon=SAMPLES, dt=STEP, limits=weak)
        errors = _errors(robot, policy, turn, weak)
        own = Receding(policy.horizon, policy.deviation(robot))
        solvers: dict[str, Solver] = {"fflin": own.step}
        for key, make in (("PIQP", _piqp), ("OSQP", _osqp)):
            try:
                solvers[key] = make(policy)
            except ImportError as error:
                notes.append(f"{key}: not installed ({error})")
        best = None
        for key, solve in solvers.items():
            taken, found = [], []
            for k, e in enumerate(errors):
                start = time.perf_counter()
                found.append(solve(STEP * k, e))
                taken.append(1e3 * (time.perf_counter() - start))
            done = [k for k, d in enumerate(found) if d is not None]
            best = found if best is None else best
            apart = max(
                np.abs(found[k] - best[k]).max() / np.abs(best[k]).max() for k in done
            )
            if key == "PIQP" and not apart < 1e-4:
                raise WrongResultError(
                    f"{key} on {name}: the inputs differ by {apart:.1e}"
                )
            times = (taken[0], np.median(taken), np.quantile(taken, 0.99))
            cells = (
                name,
                key,
                str(robot.n),
                *map(figure, times),
                str(len(found) - len(done)),
            )
            rows.append((*cells, f"{apart:.0e}" if key != "fflin" else "–"))
        if own.unfinished:
            raise WrongResultError(
                f"fflin on {name}: {own.unfinished} plans are not found"
            )
    return Table(
        "Plans of a receding horizon",
        f"A slew at the limits of torques, speeds and joint positions, at {1 / STEP:.0f} Hz over "
        f"{SAMPLES} samples, with {DURATION / STEP:.0f} plans. The columns are the time of the "
        "first plan; the median and the 99th percentile of all plans, from the robot's state to "
        "its inputs; the number of unfinished plans; and the largest difference of their inputs "
        "from fflin's. The others solve the same program, `matrices`, scaled to a unit diagonal. "
        "OSQP starts from the previous plan and stops at its own accuracy.",
        (
            "robot",
            "solver",
            "joints",
            "first [ms]",
            "median [ms]",
            "99 % [ms]",
            "unfinished",
            "apart",
        ),
        tuple(rows),
        tuple(notes),
    )


def _errors(robot: fflin.Robot, policy: Any, turn: float, limits: Any) -> list[Any]:
    """Return the deviations of the state at the samples of the flown slew."""
    base = pin.SE3(
        pin.AngleAxis(np.radians(turn), np.array([0.8, 0.6, 0.0])).matrix(), np.zeros(3)
    )
    options = {
        "q0": fflin.configuration(robot, None, base),
        "dt": STEP / 4,
        "limits": limits,
    }
    motion = fflin.simulate(robot, policy, duration=DURATION, **options)
    return list(motion.error[:-1:4])


def _scaled(policy: Any) -> tuple[Any, ...]:
    """Return what scales inputs and rows, the program at 0, and how g and limits change with e."""
    m, nx = policy.matrices(), len(policy.lin.x0)
    size = m.H.diagonal() ** -0.5
    rows = 1.0 / np.linalg.norm(m.G * size, axis=1)
    units = [policy.matrices(e) for e in np.eye(nx)]
    of_g = size * np.array([each.g for each in units])
    finite = np.where(np.isfinite(m.low), m.low, m.high)
    moved = [np.where(np.isfinite(x.low), x.low, x.high) - finite for x in units]
    return size, rows, m, of_g, rows * np.array(moved)


def _piqp(policy: Any) -> Solver:
    piqp = importlib.import_module("piqp")
    size, rows, m, of_g, moved = _scaled(policy)
    solver, nu = piqp.DenseSolver(), len(policy.lin.u0)
    low, high = m.low * rows, m.high * rows
    program = (size[:, None] * m.H * size, m.g, np.zeros((0, len(size))), np.zeros(0))
    solver.setup(*program, rows[:, None] * m.G * size, low, high)

    def solve(_: float, e: Any) -> Any:
        solver.update(c=e @ of_g, h_l=low + e @ moved, h_u=high + e @ moved)
        found = solver.solve() == piqp.PIQP_SOLVED
        return (solver.result.x * size)[:nu] if found else None

    return solve


def _osqp(policy: Any) -> Solver:
    osqp = importlib.import_module("osqp")
    size, rows, m, of_g, moved = _scaled(policy)
    solver, nu = osqp.OSQP(), len(policy.lin.u0)
    low, high = m.low * rows, m.high * rows
    H, G = size[:, None] * m.H * size, rows[:, None] * m.G * size
    solver.setup(
        sp.csc_matrix(np.triu(H)), m.g, sp.csc_matrix(G), low, high, verbose=False
    )

    def solve(_: float, e: Any) -> Any:
        solver.update(q=e @ of_g, l=low + e @ moved, u=high + e @ moved)
        found = solver.solve()
        return (found.x * size)[:nu] if found.info.status == "solved" else None

    return solve
