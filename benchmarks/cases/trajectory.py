"""From a flown trajectory to the closed loop: 101 knots of planar_detumble."""

import importlib
from collections.abc import Callable

import numpy as np
import pinocchio as pin
from scipy.integrate import solve_ivp

import fflin
from benchmarks.peers import WrongResultError
from benchmarks.robots import Array, load
from benchmarks.tables import Table, figure
from benchmarks.timing import interleaved

DURATION, KNOTS = 10.0, 101
# q_b and r_b, joints and their rates; the base's velocities cost nothing, see `DrakeTrajectory`.
_Q, _R = np.repeat((400.0, 100.0, 100.0, 0.0, 10.0), (3, 3, 3, 6, 3)), np.ones(9)
_STEPS = (0.1, 0.05, 0.025, 0.0125)  # [s], each a part of the time between knots
_ACCURACIES = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5)


def run() -> Table:
    traj = flown()
    knots = traj.robot, traj.t, traj.q, traj.v, traj.u
    along = fflin.linearize_trajectory(*knots)
    schedule = _designed(along)
    true_gains = _reference(along)
    own_error = _apart(schedule.K[np.searchsorted(schedule.t, traj.t)], true_gains)
    policy = fflin.TrajectoryFeedback(along, schedule)
    q0, v0 = beside(traj)

    def flies(dt: float) -> fflin.Motion:
        return fflin.simulate(
            *(traj.robot, policy), q0=q0, v0=v0, duration=DURATION, dt=dt, linear=False
        )

    ends = {dt: flies(dt) for dt in (*_STEPS, _STEPS[-1] / 4.0)}
    *errors, _ = (
        _apart(_end(each), _end(ends[_STEPS[-1] / 4.0])) for each in ends.values()
    )
    notes = []
    try:
        drake = importlib.import_module("benchmarks.peers.drake_trajectory")
        peer = drake.DrakeTrajectory(traj, _Q, _R)
        # The loosest that is as accurate as fflin, or the tightest there is.
        for accuracy in _ACCURACIES:
            design_error = _apart(peer.gains(peer.regulator(accuracy)), true_gains)
            if design_error <= own_error:
                break
        if not design_error < 1e-3:
            raise WrongResultError(
                f"Drake's regulator is another: gains {design_error:.1e} apart"
            )
        loop = peer.loop(peer.regulator(1e-4, system=True), peer.state(q0, v0))
        peer_error = _apart(loop.run(), loop.run(1e-9))
        best = max(
            (dt for dt, e in zip(_STEPS, errors, strict=True) if e <= peer_error),
            default=0,
        )
        dt = best or _STEPS[-1]
        drake_calls: dict[str, tuple[Callable[[], object], float]] = {
            "linear": (peer.linearize, 0.0),
            "gains": (lambda: peer.regulator(accuracy), design_error),
            "loop": (loop.run, peer_error),
        }
        notes.append(
            f"Drake's regulator is designed at accuracy {accuracy:g}, its loop at 1e-4"
        )
    except ImportError as error:
        notes, drake_calls, dt = [f"drake: not installed ({error})"], {}, _STEPS[0]
    notes.append(f"fflin's loop takes steps of {1e3 * dt:g} ms")
    own: dict[str, tuple[str, Callable[[], object], float]] = {
        "linear": ("linear models", lambda: fflin.linearize_trajectory(*knots), 0.0),
        "gains": ("regulator", lambda: _designed(along), own_error),
        "loop": ("closed loop", lambda: flies(dt), errors[_STEPS.index(dt)]),
    }
    cells = []
    for key, (title, call, error) in own.items():
        calls = {"fflin": call}
        if key in drake_calls:
            calls["Drake"] = drake_calls[key][0]
        times = interleaved(calls)
        ratio = times["Drake"].ratio(times["fflin"]) if "Drake" in times else None
        sizes = [error, drake_calls[key][1] if drake_calls else None]
        if key == "linear":  # both exact
            sizes = [None, None]
        shown = [figure(None) if size is None else f"{size:.0e}" for size in sizes]
        cells.append(
            (
                title,
                figure(times["fflin"].least * 1e3),
                shown[0],
                figure(ratio),
                shown[1],
            )
        )
    return Table(
        "Along a trajectory",
        f"planar_detumble over {KNOTS} knots of a motion of {DURATION:g} s: its linear models with "
        "fflin's check of the motion; the regulator along it; and the closed loop with an initial "
        "error of 1 deg in attitude, 3 deg in the joints and 3 deg/s. The columns are fflin's "
        "time and Drake's time divided by it. Errors are relative to the largest gain or the "
        "largest entry of the final state, compared with a tight reference.",
        ("", "fflin [ms]", "error", "Drake", "error of Drake"),
        tuple(cells),
        tuple(notes),
    )


def flown() -> fflin.Trajectory:
    """Return a motion under smooth torques, linear between the knots; nothing acts on the base."""
    robot, t = load("planar_detumble"), np.linspace(0.0, DURATION, KNOTS)
    s = t / DURATION
    u = np.zeros((KNOTS, 9))
    shapes = -1.8 * np.cos(np.pi * s), 0.9 + 0.0 * s, -0.6 * np.cos(2.0 * np.pi * s)
    u[:, 6:] = np.sin(np.pi * s)[:, None] ** 2 * np.transpose(shapes)
    start = {"omega_b.y": 0.05, "joint_1": 0.1, "joint_2": -0.1, "joint_3": 0.2}
    run = fflin.simulate(
        robot,
        lambda time, q, v: np.array([np.interp(time, t, each) for each in u.T]),
        q0=fflin.configuration(
            robot, {"joint_1": 0.6, "joint_2": 0.5, "joint_3": -0.8}
        ),
        v0=fflin.velocity(robot, start),
        duration=DURATION,
        dt=0.005,
        every=20,
    )
    return fflin.Trajectory(robot, t, run.q, run.v, u)


def _designed(along: fflin.LinearTrajectory) -> fflin.GainSchedule:
    return fflin.tvlqr(along, _Q, _R, _Q)


def _reference(along: fflin.LinearTrajectory) -> Array:
    """Return K (N, nu, nx) at the knots by SciPy's integration of the Riccati equation."""
    fine = along.resampled(0.0125)  # whose cubics are the motion's to 1e-9
    models = fflin.Linearizer(along.robot, moving=True)

    def rate(s: float, p: Array) -> Array:
        lin = models(*fine.point(min(max(DURATION - s, 0.0), DURATION)))
        P = p.reshape(len(_Q), -1)
        drift, PB = P @ lin.A, P @ lin.B
        return (np.diag(_Q) + drift + drift.T - PB / _R @ PB.T).ravel()

    found = solve_ivp(
        *(rate, (0.0, DURATION), np.diag(_Q).ravel()),
        **{
            "method": "LSODA",
            "rtol": 1e-9,
            "atol": 1e-8,
            "t_eval": DURATION - along.t[::-1],
        },
    )
    P = found.y.T[::-1].reshape(KNOTS, len(_Q), -1)
    return along.B.transpose(0, 2, 1) @ P / _R[:, None]


def beside(traj: fflin.Trajectory) -> tuple[Array, Array]:
    """Return q and v turned by 1 deg, 3 deg in the joints, which turn faster by 3 deg/s."""
    step, v0 = np.zeros(9), traj.v[0].copy()
    step[4], step[6:] = np.radians(1.0), np.radians(3.0)
    v0[6:] += np.radians(3.0)
    return pin.integrate(traj.robot.model, traj.q[0], step), v0


def _end(motion: fflin.Motion) -> Array:
    return motion.x[-1]


def _apart(found: Array, true: Array) -> float:
    return float(np.abs(found - true).max() / np.abs(true).max())
