"""The marks of runs: those that compiled code keeps are those of the definition."""

import itertools

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.campaign.runs import (
    KINDS,
    LOOK,
    CampaignJob,
    RunStatistics,
    kinds_of,
)
from fflin.dynamics.coordinates import unwound
from fflin.dynamics.state_rows import attitude_errors, moving_errors, states_of
from fflin.kernel.loop import take
from fflin.kernel.tree import LANES
from fflin.simulation.report import DWELL, SETTLED, THERE
from fflin.simulation.run import Recording
from tests.support.campaigns import flown
from tests.support.robots import LINKS, MIMIC, free_body

STEPS = 90
FRAMES = ["hybrid", "local", "world"]


def turning(tmp_path):
    path = tmp_path / "turning.urdf"
    mimic = '<mimic joint="b" multiplier="-0.7" offset="0.2"/>'
    text = MIMIC.format(
        links=LINKS, a="prismatic", b="continuous", parent="base", mimic=mimic
    )
    path.write_text(text)
    return fflin.load(path)


def wheeled(_):
    wheel = fflin.ReactionWheel((0.0, 0.0, 1.0), name="w", inertia=0.02)
    return free_body((20.0, 30.0, 40.0)).replace(inputs=[wheel])


def flexible(_):
    return fflin.load("inspector_flexible.toml")


def arm(_):
    return fflin.load("ets_vii")


def rows_of(state, rng, inputs):
    """Return rows (steps, lanes, ..) of q, nu and u that turn far and come to rest, each so far."""
    robot = state.robot
    fade = np.exp(
        -rng.uniform(1.0, 90.0, LANES) * np.linspace(0.0, 1.0, STEPS)[:, None]
    )
    nu = fade[..., None] * rng.normal(size=(STEPS, LANES, 6 + robot.n))
    v = state.spread(nu).reshape(-1, robot.nv)
    q = np.array(
        [pin.integrate(robot.model, robot.neutral(), 2.0 * item) for item in v]
    )
    q[rng.random(len(q)) < 0.5, 3:7] *= -1.0  # the same attitude
    for row in q:
        robot.follow(row)
    return q.reshape(STEPS, LANES, -1), nu, rng.normal(size=(STEPS, LANES, inputs))


def defined(job, target, q, nu, u, stop):
    """The outcome of a run by the definitions, from all its rows at once."""
    state, dt = job.plant.state, job.plan.times.dt
    joints = 6 + state.unbounded
    first = target if target.ndim == 1 else target[0]
    x = unwound(states_of(state, q, nu), joints, first)
    e = x - target
    if target.ndim == 2:
        e = unwound(moving_errors(state.frame, x, target), joints)
    kind = kinds_of(state, state.robot.wheels)
    signed = e.copy()
    e[:, kind < 0] = 0.0
    sizes = [
        np.abs(e[:, kind == k]).max(axis=1, initial=0.0) for k in range(len(KINDS))
    ]
    sizes = np.column_stack([attitude_errors(x, target), *sizes[1:]])
    largest = sizes.max(axis=0)
    outside = sizes > np.maximum(SETTLED * largest, THERE)
    settled = np.where(outside.any(axis=0), len(x) - outside[::-1].argmax(axis=0), 0)
    late = (settled > (1.0 - DWELL) * len(x)) | (stop > 0)
    return {
        **{"q": q[-1], "v": state.spread(nu[-1:])[0], "x": x[-1], "u": u[-1]},
        **{"largest_x": np.abs(e).max(axis=0), "largest_u": np.abs(u).max(axis=0)},
        **{"errors": sizes[-1], "largest": largest},
        "settle": np.where(late, np.inf, settled * dt),
        **{"error_history": sizes[job.steps], "input_history": u[job.steps]},
        "state_errors": signed[job.steps],
        **{"stop": stop, "end": (len(x) - 1) * dt},
    }


def test_statistics_of_a_run_in_python_match_the_definition(tmp_path):
    for made, frame, follows in itertools.product(
        (turning, wheeled, flexible), FRAMES, (False, True)
    ):
        robot, rng = made(tmp_path), np.random.default_rng(3)
        options = {
            "duration": 0.01 * (STEPS - 1),
            "dt": 0.01,
            "frame": frame,
            "histories": 11,
        }
        job = CampaignJob(robot, None, {"q_b.x": 0.01}, 0, "python", options)
        state, target = job.plant.state, job.target
        q, nu, u = (item[:, 0] for item in rows_of(state, rng, len(job.plan.initial)))
        if follows:
            star = [item[:, 0] for item in rows_of(state, rng, 0)[:2]]
            target = states_of(state, *star)
        elif robot.n:
            target = target + 7.0 * (np.arange(state.nx) == 6)  # more than a turn away
        rest = [np.zeros((STEPS, size)) for size in (6, 3)]
        t, v = job.plan.times.dt * np.arange(STEPS), state.spread(nu)
        run = Recording(t, q, v, u, *rest, STEPS - 1, "", "python")
        job.target, job.path = (
            target,
            [item.ravel() for item in star] if follows else [],
        )
        outcome = job.outcome(run)
        for name, expected in defined(job, target, q, nu, u, 0.0).items():
            np.testing.assert_allclose(
                outcome[name], expected, rtol=1e-12, atol=1e-10, err_msg=name
            )
        # The kernel's statistics, uncompiled.
        marks = as_lists(RunStatistics(job)._marks)
        rows = np.hstack((q, nu, u, np.zeros((STEPS, 9))))
        for first, last in itertools.pairwise((0, 1, 33, STEPS)):
            take(marks, rows[first:last].ravel().tolist(), first, last - first)
        expected = defined(job, target, q, nu, u, 0.0)
        settled = (np.array(marks.outside) + 1.0) * 0.01
        settled[settled > 0.01 * (1.0 - DWELL) * STEPS] = np.inf
        for name, value in (
            ("largest_x", marks.largest_x),
            ("largest_u", marks.largest_u),
            ("errors", marks.sizes),
            ("largest", marks.largest),
            ("error_history", np.reshape(marks.errors, (-1, len(KINDS)))),
            ("settle", settled),
            ("input_history", np.reshape(marks.inputs, (-1, len(job.plan.initial)))),
            ("state_errors", np.reshape(marks.states, (-1, state.nx))),
            ("x", marks.law.x),
        ):
            np.testing.assert_allclose(value, expected[name], rtol=1e-12, atol=1e-10)


def test_errors_settle_within_a_fiftieth_of_the_largest_or_within_the_tolerance():
    robot = free_body((20.0, 30.0, 40.0))
    job = CampaignJob(
        robot, None, {"q_b.x": 0.01}, 0, "python", {"duration": 0.05, "dt": 0.01}
    )
    marks, nu = as_lists(RunStatistics(job)._marks), np.zeros((6, 6))
    q = np.tile(robot.neutral(), (6, 1))
    q[:, 1] = (-1.0, 0.5, 0.03, 0.01, -0.021, 0.019)
    # more than a fiftieth of 4e-9
    nu[:, 2] = (4e-9, 2e-9, 1.1e-9, 0.9e-9, 0.5e-9, 0.9e-9)
    nu[:, 4] = 0.9 * THERE
    take(marks, np.hstack((q, nu, np.zeros((6, 6 + 9)))).ravel().tolist(), 0, 6)
    last = dict(zip(KINDS, marks.outside, strict=True))
    assert (last["position"], last["omega_b"], last["v_b"]) == (4.0, 2.0, -1.0)
    assert last["attitude"] == last["joints"] == last["joint rates"] == -1.0


def as_lists(value):
    """Nested named tuples with the lists of one lane, as the kernel runs uncompiled on a run."""
    if isinstance(value, tuple):
        return type(value)._make(map(as_lists, value))
    if not isinstance(value, np.ndarray):
        return value
    return (value[:, :1].ravel() if value.ndim == 2 else value).tolist()


@pytest.mark.compiled
@pytest.mark.parametrize("follows", [False, True])
@pytest.mark.parametrize("frame", FRAMES)
@pytest.mark.parametrize("made", [turning, wheeled, arm])
def test_marks_of_lanes_match_the_definition(tmp_path, made, frame, follows):
    pytest.importorskip("numba")
    robot, rng = made(tmp_path), np.random.default_rng(7)
    turn = pin.Quaternion(0.5, -0.1, 0.7, 0.3).normalized()
    options = {
        "duration": 0.01 * (STEPS - 1),
        "dt": 0.01,
        "frame": frame,
        "histories": 11,
    }
    options["reference"] = pin.SE3(turn, np.array((1.0, -2.0, 0.5)))
    q0 = pin.integrate(robot.model, robot.neutral(), 0.3 * rng.normal(size=robot.nv))
    robot.follow(q0)
    options["q0"] = q0
    job = CampaignJob(robot, None, {"q_b.x": 0.01}, 0, "compiled", options)
    state, home = job.plant.state, job.target
    q, nu, u = rows_of(state, rng, len(job.plan.initial))
    if follows:
        star = [item[:, 0] for item in rows_of(state, rng, 0)[:2]]
        home = states_of(state, *star)
        job.target, job.path = home, [item.ravel() for item in star]
    rows = np.concatenate((q, nu, u, np.zeros((STEPS, LANES, 9))), axis=2).transpose(
        0, 2, 1
    )
    stop, ends = np.arange(LANES) % 3.0, []
    for cuts in ([0, STEPS], [0, 1, 33, STEPS]):
        lanes = RunStatistics(job)
        lanes.reset()
        for first, last in itertools.pairwise(cuts):
            for _ in range(2):  # adding rows again changes nothing
                lanes.add(first, rows[first:last].copy())
        ends.append(lanes.outcome(STEPS - 1, stop))
        plain = [
            defined(job, home, *(item[:, lane] for item in (q, nu, u)), stop[lane])
            for lane in range(LANES)
        ]
        for name in job.outcome_shapes:
            expected = np.array([item[name] for item in plain])
            result = ends[-1][name]
            assert result.shape == expected.shape
            np.testing.assert_allclose(
                result, expected, rtol=1e-12, atol=1e-10, err_msg=name
            )
    assert (
        np.isfinite(ends[0]["settle"]).any() and (ends[0]["largest"][:, :2] > 0.1).all()
    )
    for name, one in ends[0].items():
        assert np.array_equal(one, ends[1][name])


def halved(first, e):
    """Whether the position error has fallen to half of the one at the start."""
    return np.linalg.norm(e[:, 3:6], axis=1) <= 0.5 * np.linalg.norm(
        first[:, 3:6], axis=1
    )


@pytest.mark.compiled
@pytest.mark.parametrize("engine", ["python", "compiled"])
def test_a_stop_condition_ends_each_run_where_it_is_first_looked_at_and_met(engine):
    if engine == "compiled":
        pytest.importorskip("numba")
    robot = fflin.load("cubesat")
    lin = fflin.linearize(robot)
    inputs = {"tau_b": 1e6, "F_b.x": 1.0, "F_b.y": 100.0, "F_b.z": 1e4}
    gain = fflin.lqr(lin, 1.0, inputs)
    policy, options = (
        fflin.StateFeedback(lin, gain.K),
        {"duration": 80.0, "dt": 0.05, "every": 1},
    )
    starts = np.zeros((10, len(lin.x0)))
    starts[:9, 3:6] = 0.2 * np.eye(3).repeat(3, axis=0) + 0.01 * np.arange(9)[:, None]
    starts[9, 5] = 1e-3
    options["histories"] = 1
    judge = lambda runs: {key: runs[key] for key in ("end", "stop")}  # noqa: E731
    job = CampaignJob(robot, policy, None, 0, engine, options, judge, halved)
    result = flown(job, starts)
    ends = []
    for start in starts:
        x = job.replay(start).x[::LOOK]
        met = np.linalg.norm(x[:, 3:6], axis=1) <= 0.5 * np.linalg.norm(start[3:6])
        ends.append(met.argmax() * LOOK * 0.05 if met.any() else 80.0)
    assert result["end"] == pytest.approx(ends)
    assert np.array_equal(result["stop"], np.where(np.array(ends) < 80.0, 3.0, 0.0))
    assert len({*ends}) > 2 and min(ends) < 80.0
