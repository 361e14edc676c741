"""The figures of the golden record, made anew by either engine, and their comparison with it.

Whole numbers, flags and words are decisions and must be equal. Floating-point figures must agree
within 1e-12 of the largest entry of their row (the last axis); a row that is smaller than 1e-3 of
its array counts as that large, as it is what large terms leave. Less tight, and relative to the
largest entry of the array, are these:

- A, B, f0, C, D and sweeps: M is inverted, and rounding grows with its condition number. Factors of
  M by two ways differ by eps cond(M), so where 4 eps cond(M) is more than 1e-12 it takes its place.
- K of an LQR: LAPACK's last digits differ from processor to processor. The gain is designed again
  for A, B, Q and R that are changed by 1e-9 at random. How much it changes for that, times 64 eps,
  is added: an eigensolver of Hamiltonian matrices is backward stable to some multiple of eps.
- u of an allocation: thrusts that do the same are told apart by rows of 1e-7
  (`kernel.allocation.LEAST`), so rounding of the loop grows by 1e7 in them.
- the prediction error of a validity study is a difference of two motions: its rounding is that of
  the motions, of the size of the displacement, to which it is relative; their gain is of LAPACK.

Motions and campaigns are under gains rounded to 20 bits, so that they do not depend on LAPACK.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np

import fflin
from fflin.simulation.lanes import recorded
from fflin.simulation.plan import Plan, SimulationOptions
from fflin.simulation.run import go
from tests.support.motions import displaced
from tests.support.policies import (
    JETS,
    POLICIES,
    between_gains,
    coarse,
    followed,
    followed_outputs,
    plain,
    shared,
)
from tests.support.robots import BUNDLED, random_point

PATH = Path(__file__).parent / "record.npz"
ENGINES = ("python", "compiled")
TIGHT, EPS = 1e-12, np.finfo(float).eps
_TOLERANCE = "tolerance of "
_ROWS = 3  # of a motion
_LEAST_ROW = 1e-3  # of the array's largest entry


def _condition(lin):
    return max(TIGHT, 4.0 * EPS * float(np.linalg.cond(lin.M)))


def _models(name):
    """A, B, f0, C and D at a point in motion in each frame, and K of the LQR at rest."""
    robot = fflin.load(name)
    robot = robot.replace(
        outputs=[fflin.FullState(), fflin.CenterOfMass(), fflin.Momentum()]
    )
    q, v, u = random_point(robot, np.random.default_rng(1))
    result = {}
    for frame in ("hybrid", "local", "world"):
        lin = fflin.linearize(robot, q, v, u, frame=frame)
        names = ("A", "B", "f0", "C", "D") if frame == "hybrid" else ("A", "B", "f0")
        nv = len(lin.M)
        for key in names:
            value = getattr(lin, key)
            # The upper rows of A and B are of the chart alone.
            value = value if frame == "hybrid" or key == "f0" else value[nv:, :nv]
            result[f"{frame} {key}"] = value
            result[f"{_TOLERANCE}{frame} {key}"] = _condition(lin)
    lin = fflin.linearize(robot)
    result["K"] = (K := fflin.lqr(lin).K)
    rng = np.random.default_rng(2)

    def changed(x):
        return x * (1.0 + 1e-9 * rng.uniform(-1.0, 1.0, x.shape))

    gain = fflin.lqr(lin)
    other = replace(lin, A=changed(lin.A), B=changed(lin.B))
    other = fflin.lqr(other, changed(gain.Q.diagonal()), changed(gain.R.diagonal())).K
    apart = (np.abs(other - K) / np.abs(K).max(axis=1, keepdims=True)).max()
    result[f"{_TOLERANCE}K"] = TIGHT + 64.0 * EPS * float(apart) / 1e-9
    return result


def _flown(robot, policy, engine, **options):
    """Rows of a motion, and why it ended."""
    motion = fflin.simulate(robot, policy, **{"linear": False} | options, engine=engine)
    rows = np.linspace(0, len(motion.t) - 1, _ROWS + 1).astype(int)[1:]
    result = {
        key: getattr(motion, key)[rows] for key in ("t", "q", "v", "x", "u", "momentum")
    }
    largest = np.abs(motion.u).max(axis=0)
    return {
        **result,
        "rows": len(motion.t),
        "largest u": largest,
        "stopped": motion.stopped.split(" at ")[0],
    }


def _policy(make, name, engine):
    """A motion under a policy whose commands exceed their limits at first."""
    robot, policy, options = make(plain(fflin.load(name)))
    x0 = displaced(fflin.linearize(robot), degrees=20.0)
    given = {"x0": x0, "duration": 4.0, "dt": 0.02} | options
    method = "semi_implicit_euler" if POLICIES.index(make) % 3 == 2 else "cf4"
    free = fflin.simulate(robot, policy, **{"linear": False} | given, method=method)
    most = 2.0 ** math.floor(math.log2(0.5 * np.abs(free.u).max()))
    result = _flown(robot, policy, engine, **given, method=method, limits=most)
    if make is shared:
        result[f"{_TOLERANCE}u"] = result[f"{_TOLERANCE}largest u"] = 1e-7 / 1e-14 * EPS
    return result


def _forces(engine):
    """Gravity, springs, thrusters on links and stored momentum, without a policy."""
    arm = [f"joint_{k}" for k in range(1, 8)]
    robot = fflin.load(
        "canadarm2",
        gravity=(0.3, -0.2, -1.0),
        stiffness={"joint_*": 2.0},
        damping={"joint_*": 0.5},
        inputs=[
            *map(fflin.JointTorque, arm),
            fflin.Thruster("link_3", (0.2, 0.1, 0.0), (1.0, 0.5, 0.2), "jet"),
            fflin.ReactionWheel((1, 2, 2), name="storing", momentum=3.0),
        ],
    )
    lin = fflin.linearize(robot)
    K = 0.05 * np.random.default_rng(1).normal(size=lin.B.shape[::-1])
    policy = fflin.StateFeedback(lin, K)
    return _flown(
        robot, policy, engine, x0=displaced(lin), duration=2.0, dt=0.02, limits=0.2
    )


def _pulses(engine):
    """On-off thrusters, wheels that saturate, samples and a delay."""
    jets = [
        replace(jet, on_off=True, least_impulse=0.004, max=0.3) for jet in JETS[:12]
    ]
    wheels = [
        fflin.ReactionWheel(axis, name=f"w{k}", inertia=0.001, max_speed=8.0, max=0.01)
        for k, axis in enumerate(np.eye(3).tolist())
    ]
    robot = fflin.load("cubesat").replace(inputs=[*jets, *wheels])
    lin = fflin.linearize(robot)
    K = 0.1 * np.random.default_rng(3).normal(size=lin.B.shape[::-1])
    K[12:, 9:12] = -0.02 * np.eye(3)
    policy = fflin.StateFeedback(
        replace(lin.discretize(0.1), u0=0.01 + 0.0 * lin.u0), K
    )
    options = {
        "x0": displaced(lin),
        "duration": 2.0,
        "dt": 0.02,
        "delay": 0.14,
        "limits": "urdf",
    }
    return _flown(robot, policy, engine, **options)


def _stops(engine):
    """Runs that diverge, and that leave the chart where a linear model is compared with them."""
    robot = fflin.load("planar_detumble")
    lin = fflin.linearize(robot)
    K, x0 = coarse(fflin.lqr(lin).K), displaced(lin, degrees=60.0)
    tumbling = x0.copy()
    tumbling[6 + robot.n : 9 + robot.n] = 1.0
    result = {}
    for name, gain, start in (("diverged", -3.0 * K, x0), ("left", 0.0 * K, tumbling)):
        policy = fflin.StateFeedback(lin, gain)
        options = SimulationOptions(
            robot=robot, policy=policy, x0=start, duration=8.0, dt=0.01
        )
        plan = Plan(options).replace(within_chart=True)
        run = go(plan) if engine == "python" else recorded(plan)
        result |= {
            f"{name} stopped": run.stopped.split(" at ")[0],
            f"{name} rows": len(run.t),
        }
    return result


def _campaign(engine):
    """64 runs with every kind of dispersion."""
    robot = fflin.load(
        "planar_detumble",
        inputs=[
            fflin.BaseTorque(),
            fflin.BaseForce(),
            *map(fflin.JointTorque, _JOINTS),
        ],
        stiffness={"joint_*": 0.2},
        damping={"joint_*": 0.1},
    )
    lin = fflin.linearize(robot)
    policy = fflin.StateFeedback(lin, coarse(fflin.lqr(lin).K))
    given = {
        **{
            "q_b": 0.05,
            "r_b.x": (-0.1, 0.2),
            "q_m.*": 0.05,
            "omega_b": 0.02,
            "qdot_m": 0.01,
        },
        **{"base.mass": 0.1, "joint_2.com": 0.02, "joint_3.inertia": (-0.2, 0.2)},
        **{"link_1.density": (-0.2, 0.2), "*.gain": {"range": 0.05, "tied": True}},
        **{"tau_b.bias": 0.01, "F_b.x.fails": (0.5, 2.0), "F_b.misalignment": 0.05},
        **{"q_b.sensor": 1e-3, "*.noise": 1e-3, "delay": [0.0, 0.05, 0.1]},
        **{"joint_1.stiffness": (-0.5, 0.5), "*.damping": 0.1},
    }
    campaign = fflin.monte_carlo(
        *(robot, policy, given),
        **{
            "runs": 64,
            "duration": 3.0,
            "dt": 0.05,
            "sample": 0.1,
            "limits": 4.0,
            "histories": 4,
        },
        **{"goals": ["attitude < 4 deg"], "engine": engine, "threads": 1},
    )
    result = {
        key: getattr(campaign, key)
        for key in ("errors", "largest", "settle", "stop", "end")
    }
    some = {
        key: getattr(campaign, key)[::16]
        for key in ("drawn", "q", "v", "x", "u", "largest_u")
    }
    more = {
        key: getattr(campaign, key)[::16] for key in ("error_history", "input_history")
    }
    return {**result, **some, **more, "met": campaign.met("attitude < 4 deg")}


_JOINTS = ("joint_1", "joint_2", "joint_3")


def _sweep(engine):
    """Points at rest and in motion, of both kinds of joints."""
    result = {}
    for name in ("planar_detumble", "canadarm2"):
        robot = fflin.load(name)
        rng = np.random.default_rng(4)
        points = [
            random_point(robot, rng) for _ in range(24 if engine == "compiled" else 4)
        ]
        q, v, u = map(np.array, zip(*points, strict=True))
        for kind, given in (("rest", (q,)), ("motion", (q, v, u))):
            batch = fflin.sweep(robot, *given, threads=1)
            for key in ("A", "B", "f0"):
                result[f"{name} {kind} {key}"] = np.array(getattr(batch, key)[:2])
                worst = max(_condition(batch[index]) for index in range(2))
                result[f"{_TOLERANCE}{name} {kind} {key}"] = worst
    return result


def _funnel(engine):
    """A funnel of three knots around a motion."""
    robot = fflin.load("cubesat")
    v0 = np.array([0.01, 0.0, 0.0, 0.05, 0.1, -0.02])
    motion = fflin.simulate(robot, v0=v0, duration=2.0, every=20, engine="python")
    schedule = fflin.tvlqr(fflin.linearize_trajectory(robot, motion.trajectory()))
    schedule = replace(schedule, K=coarse(schedule.K), P=coarse(schedule.P))
    reach = fflin.funnel(
        *(robot, schedule, {"attitude": 2.0}),
        **{
            "within": {"attitude": 40.0},
            "samples": 8,
            "knots": 3,
            "dt": 0.05,
            "limits": 3.0,
        },
        **{"engine": engine, "threads": 1},
    )
    result = {key: getattr(reach, key) for key in ("t", "tried", "rho", "rate")}
    return {
        **result,
        "outcomes": reach.outcomes.astype(int),
        "inside": reach.inside.astype(int),
    }


def _validity(engine):
    """How far a model and its loop reach."""
    robot = fflin.load("planar_detumble")
    q = fflin.configuration(robot, dict.fromkeys(_JOINTS, 0.4))
    lin = fflin.linearize(robot, q)
    K = coarse(fflin.lqr(lin).K)
    reach = fflin.validity(
        *(robot, lin, K),
        attitude=60.0,
        joint=0.5,
        samples=8,
        limits=3.0,
        engine=engine,
        threads=1,
    )
    error = reach.prediction_error
    return {
        **{
            "sampled": reach.sampled,
            "outcomes": list(reach.outcomes),
            "inside": reach.inside,
        },
        **{
            "prediction error": error,
            "rate": np.array(reach.rate),
            "slope": reach.slope,
        },
        f"{_TOLERANCE}prediction error": 1e-9,
        f"{_TOLERANCE}slope": 1e-6,
    }


def cases():
    """Each case's name and what makes its figures by an engine."""
    made = {f"models {name}": lambda _, name=name: _models(name) for name in BUNDLED}
    for make in POLICIES:
        # There are no joints of the cubesat to lay a grid over, and a trajectory takes longest.
        robots = ["ets_vii", *([] if make is between_gains else ["cubesat"])]
        robots += [] if make in (followed, followed_outputs) else ["planar_detumble"]
        for name in robots:
            case = f"policies {make.__name__} {name}"
            made[case] = lambda engine, make=make, name=name: _policy(
                make, name, engine
            )
    whole = (_forces, _pulses, _stops, _campaign, _sweep, _funnel, _validity)
    return made | {item.__name__[1:]: item for item in whole}


def figures(case, engine):
    """The figures of a case, with their tolerances."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", fflin.FflinWarning)
        made = cases()[case](engine)
    return {key: np.asarray(value) for key, value in made.items()}


def record():
    """What the record holds, by "case/figure"; tolerances are made anew and not kept."""
    return {
        f"{case}/{key}": value
        for case in cases()
        for key, value in figures(case, "python").items()
        if not key.startswith(_TOLERANCE)
    }


def kept():
    """The figures of the committed record."""
    with np.load(PATH, allow_pickle=False) as file:
        return dict(file)


def differences(case, engine, golden):
    """Say what of a case differs from the record, a line for each figure."""
    result = figures(case, engine)
    names = [key for key in result if not key.startswith(_TOLERANCE)]
    keys = {key.partition("/")[2] for key in golden if key.partition("/")[0] == case}
    message = [f"{case}/{key}: on one side alone" for key in sorted(keys ^ set(names))]
    for key in sorted(keys & set(names)):
        tolerance = float(result.get(_TOLERANCE + key, 0.0))
        least = 1.0 if tolerance else _LEAST_ROW
        tolerance = tolerance or TIGHT
        apart = _apart(result[key], golden[f"{case}/{key}"], least)
        if not apart <= tolerance:
            message.append(
                f"{case}/{key}: {apart:.2g} apart, expected at most {tolerance:.2g}"
            )
    return message


def _apart(result, expected, least):
    """How far figures are apart, relative to the largest of their row; infinite of decisions.

    A row counts as at least a share of the largest entry.
    """
    if result.shape != expected.shape or result.dtype.kind != expected.dtype.kind:
        return math.inf
    if result.dtype.kind != "f":
        return 0.0 if np.array_equal(result, expected) else math.inf
    finite = np.isfinite(expected)
    if not np.array_equal(result[~finite], expected[~finite], equal_nan=True):
        return math.inf
    if not np.isfinite(result[finite]).all():
        return math.inf
    values = np.where(finite, expected, 0.0)
    size = np.abs(np.atleast_1d(values)).max(axis=-1, keepdims=True, initial=0.0)
    size = np.maximum(size, least * size.max(initial=0.0))
    distance = np.abs(np.where(finite, result, 0.0) - values)
    return float((distance / np.where(size > 0.0, size, 1.0)).max(initial=0.0))
