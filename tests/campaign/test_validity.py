"""How far the linear model and its loop reach."""

import contextlib
import os
import re
import runpy
import signal
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from scipy.linalg import expm
from scipy.stats import binomtest

import fflin
from fflin.base.intervals import clopper_pearson
from fflin.batch.run import Execution, OwnWorkers
from fflin.campaign.settling import OUTCOMES, Loop, settle
from fflin.campaign.validity import _LEVELS, _crossing, _slope
from fflin.simulation.run import go
from tests.support.campaigns import flown
from tests.support.commands import refused, run, warned
from tests.support.messages import any_wording, says
from tests.support.patience import finishing
from tests.support.weights import unit_weights

DOCS = Path(__file__).parents[2] / "docs"


def held(robot, dt=0.0, reduce=False):
    # Bent, since a straight arm has no terms of second order to show.
    bent = {name: 0.4 + 0.2 * i for i, name in enumerate(robot.joint_names)}
    lin = fflin.linearize(robot, fflin.configuration(robot, bent))
    lin = fflin.momentum_reduction(lin) if reduce else lin
    lin = lin.discretize(dt) if dt else lin
    return lin, fflin.lqr(lin, *unit_weights(lin))


@pytest.fixture(scope="module")
def arm(robots):
    return robots["planar_detumble"]


@pytest.mark.compiled
def test_prediction_error_is_of_second_order(robots, arm):
    for robot, dt in ((arm, 0.0), (robots["cubesat"], 0.2)):
        lin, gain = held(robot, dt)
        result = fflin.validity(robot, lin, gain, samples=1)
        assert result.slope == pytest.approx(2.0, abs=0.1)
        assert (np.diff(result.prediction_error[:5]) > 0.0).all()
        assert result.trusted["attitude"] > 0.0
    # A model that is wrong to first order shows it.
    robot = robots["cubesat"]
    lin, gain = held(robot)
    wrong = replace(lin, B=lin.B * 1.05)
    assert fflin.validity(robot, wrong, gain, samples=1).slope < 1.2


def test_trust_ends_where_the_error_reaches_a_tenth():
    errors = np.array([0.005, 0.01, 0.02, 0.05, 0.2, np.nan, np.nan])
    assert 1 / 8 < _crossing(errors) < 1 / 4
    assert _crossing(np.full(7, 0.05)) == 1.0
    assert _crossing(np.full(7, 0.2)) == pytest.approx(1 / 128)
    assert _slope(0.3 * _LEVELS) == pytest.approx(2.0)


def test_the_loop_matches_aba_in_world_coordinates(robots):
    """A run against an integration of (q, v) by Pinocchio, which knows nothing of the chart."""
    robot = robots["ets_vii"]
    lin, gain = held(robot)
    loop = Loop(robot, lin, gain.K)
    x = loop.displaced(np.random.default_rng(1), 40.0, 0.3, 0.5)
    job = loop.runs(False, None, 1.0, None)
    plan = job.plan_of(x - lin.x0)
    times = plan.times._replace(dt=0.02, steps=200, every=1)
    run = go(plan.replace(times=times))
    end = loop.state.to_state(run.q[-1], run.v[-1], near=x)
    data = robot.create_data()
    q, v = loop.state.to_pinocchio(x)
    h = 0.005
    for _ in range(800):

        def rate(dq, dv, q=q, v=v):
            moved, speed = pin.integrate(robot.model, q, dq), v + dv
            state = loop.state.to_state(moved, speed, near=x)
            u = lin.u0 - gain.K @ (state - lin.x0)
            frame = loop.state.chart(moved)
            u = u.copy()
            u[3:6] = frame.R.T @ u[3:6]
            tau = loop.state.lift(u)
            return speed, pin.aba(robot.model, data, moved, speed, tau).copy()

        # The midpoint rule, for which the tangent at q is good enough.
        k, a = rate(np.zeros(robot.nv), np.zeros(robot.nv))
        k, a = rate(h / 2 * k, h / 2 * a)
        q, v = pin.integrate(robot.model, q, h * k), v + h * a
    last = loop.state.to_state(q, v, near=x)
    assert end == pytest.approx(last, abs=2e-4)


@pytest.mark.parametrize(("angle", "outcome"), [(170.0, "settled"), (179.0, "chart")])
def test_a_run_close_to_half_a_turn_counts_as_out_of_the_chart(robots, angle, outcome):
    lin, gain = held(robots["cubesat"])
    loop = Loop(robots["cubesat"], lin, gain.K)
    x = loop.displaced(np.random.default_rng(2), angle, 0.0, 0.0)
    runs_of = partial(loop.runs, False, None, 0.0, "python")
    result = settle(runs_of, (x - lin.x0)[None], Execution())
    assert OUTCOMES[int(result["outcome"][0])] == outcome


@pytest.mark.parametrize("predicts", [True, False])
def test_a_comparison_with_the_linear_loop_ends_at_half_a_turn(robots, predicts):
    """Although the same law continues there in a simulation."""
    lin, gain = held(robots["cubesat"])
    loop = Loop(robots["cubesat"], lin, gain.K)
    x = lin.x0.copy()
    # half of 170 deg, and a rate [rad/s] away from 0
    x[0], x[6] = np.sin(np.radians(85.0)), 2.0
    job = loop.runs(predicts, None, 0.0, "python")
    stopped = go(job.plan_of(x - lin.x0)).stopped
    assert stopped.startswith("left the chart at t = ")
    policy = fflin.StateFeedback(lin, gain.K)
    assert not fflin.simulate(robots["cubesat"], policy, x0=x, duration=1.0).stopped


def test_displacements_are_as_large_as_they_say(robots):
    robot = robots["ets_vii"]
    lin, gain = held(robot)
    loop = Loop(robot, lin, gain.K)
    x = loop.displaced(np.random.default_rng(0), 100.0, 0.3, 0.7)
    q, v = loop.state.to_pinocchio(x)
    moved = pin.XYZQUATToSE3(lin.q[:7]).actInv(pin.XYZQUATToSE3(q[:7]))
    assert np.rad2deg(np.linalg.norm(pin.log3(moved.rotation))) == pytest.approx(100.0)
    assert np.linalg.norm(moved.translation) == pytest.approx(0.3)
    assert np.abs((x - lin.x0)[6:12]).max() == pytest.approx(0.7) and not v.any()


def test_displacements_of_a_point_that_is_turned_from_the_reference(robots):
    import pinocchio as pin

    robot = robots["cubesat"]
    turned = pin.SE3(pin.exp3(np.array([0.0, 2.6, 0.0])), np.zeros(3))
    q0 = fflin.configuration(robot, base=turned)
    lin = fflin.linearize(robot, q0, reference=pin.SE3.Identity())
    loop = Loop(robot, lin, fflin.lqr(lin))
    for seed in range(8):  # on either side of a turn of 180 degrees from the reference
        x = loop.displaced(np.random.default_rng(seed), 100.0, 0.0, 0.0)
        q, _ = loop.state.to_pinocchio(x)
        moved = turned.rotation.T @ pin.XYZQUATToSE3(q[:7]).rotation
        assert np.rad2deg(np.linalg.norm(pin.log3(moved))) == pytest.approx(100.0)


@pytest.mark.compiled
@pytest.mark.process
def test_same_seed_same_result_whoever_runs_it(robots):
    robot = robots["cubesat"]
    lin, gain = held(robot)
    options = {"attitude": 170.0, "samples": 6}
    one = fflin.validity(robot, lin, gain, seed=3, **options)
    for others in (ProcessPoolExecutor(2), ThreadPoolExecutor(3)):
        with others as executor:
            two = fflin.validity(robot, lin, gain, seed=3, executor=executor, **options)
        assert two.outcomes == one.outcomes and two.slope == one.slope
        assert (two.prediction_error == one.prediction_error).all()
    other = fflin.validity(robot, lin, gain, seed=4, **options)
    assert (other.prediction_error != one.prediction_error).any()


def test_a_run_that_ends_unsettled_may_settle_later_or_never():
    """Its error may grow, so that nothing is said of what it would do after the allowed time."""
    reach = {"attitude": 9.0, "position": 0.1, "joint": 0.0}
    result = fflin.Validity(
        levels=np.ones(1),
        prediction_error=np.zeros(1),
        slope=2.0,
        trusted=reach,
        sampled=np.linspace(0.1, 1.0, 4),
        outcomes=("settled", "slow", "diverged", "slow"),
        holds=reach,
        inside=1,
        inside_rate=0.05,
        rate=(0.01, 0.8),
        confidence=0.95,
        largest=reach,
        joint_unit="rad",
        robot="cubesat",
        frame="hybrid",
    )
    assert "; 2 did not settle in the allowed time, 1 diverged" in " ".join(
        str(result).split()
    )


@pytest.mark.compiled
def test_counts_have_their_confidence_intervals(robots):
    """A loop that is lost far out: the runs below the first failure, and both intervals."""
    robot = robots["ets_vii"]
    lin, gain = held(robot)
    result = fflin.validity(robot, lin, gain, attitude=174.0, samples=16)
    failed = [i for i, outcome in enumerate(result.outcomes) if outcome != "settled"]
    assert failed and result.inside == failed[0] > 0
    assert result.settled == 16 - len(failed)
    level = result.sampled[result.inside - 1]
    assert result.holds == {
        "attitude": 174.0 * level,
        "position": 0.5 * level,
        "joint": level,
    }
    assert result.inside_rate == pytest.approx(0.05 ** (1.0 / result.inside))
    assert says(str(result), f"{result.inside} of {result.inside}")
    near = fflin.validity(
        robot, lin, gain, attitude=30.0, position=0.5, joint=0.3, samples=4
    )
    assert near.settled == 4


@pytest.mark.compiled
@pytest.mark.parametrize("name", ["cubesat", "ets_vii", "planar_detumble"])
def test_both_engines_say_the_same(robots, name):
    pytest.importorskip("numba")
    lin, gain = held(robots[name], dt=0.5 * (name == "cubesat"))
    # whose light joints have a pole at -160 by the other weights
    if name == "planar_detumble":
        gain = fflin.lqr(lin)
    options = {"attitude": 170.0, "samples": 9, "seed": 5}
    one, two = (
        fflin.validity(robots[name], lin, gain, engine=engine, **options)
        for engine in ("python", "compiled")
    )
    assert one.outcomes == two.outcomes and one.slope == pytest.approx(
        two.slope, abs=1e-6
    )
    near = slice(0, 5)  # where nothing is near the edge of the chart
    assert one.prediction_error[near] == pytest.approx(
        two.prediction_error[near], rel=1e-6
    )


def test_a_linear_loop_is_predicted_to_machine_precision_and_settles_at_the_reported_time(
    robots,
):
    """A body that is only moved away: poles in closed form, and so the time to settle."""
    robot = robots["cubesat"]
    lin, gain = held(robot)
    loop = Loop(robot, lin, gain.K)
    x = loop.displaced(np.random.default_rng(3), 0.0, 0.4, 0.0)
    job = loop.runs(False, None, 0.0, None)
    times, e = job.plan.times, x - lin.x0
    step, sizes = expm(loop.rate * times.dt), []
    for _ in range(times.steps):
        sizes.append(loop.size(e))
        e = step @ e
    settles = next(k for k, size in enumerate(sizes) if size <= 1e-3 * sizes[0])
    for steps, outcome in ((settles, 1.0), (settles - 1, 0.0)):
        job.plan = job.plan.replace(times=times._replace(steps=steps))
        assert flown(job, (x - lin.x0)[None])["outcome"] == [outcome]


@pytest.mark.compiled
def test_limits_are_those_that_are_given(robots):
    robot = robots["cubesat"]
    lin, gain = held(robot)
    free = fflin.validity(robot, lin, gain, attitude=170.0, samples=8)
    weak = fflin.validity(robot, lin, gain, attitude=170.0, samples=8, limits=1e-6)
    assert free.settled == 8 and weak.settled == 0 and set(weak.outcomes) == {"slow"}


@pytest.mark.compiled
def test_fast_rotations_are_simulated_with_shorter_steps():
    robot = fflin.load("canadarm2")
    lin = fflin.linearize(robot)
    result = fflin.validity(robot, lin, fflin.lqr(lin), attitude=120.0, samples=50)
    # Some runs may leave the chart at 180 deg, but none diverges because of its step.
    assert result.settled >= 48 and "diverged" not in result.outcomes


def test_poles_too_far_apart_are_refused(robots):
    robot = robots["cubesat"]
    lin, gain = held(robot)
    fast = gain.K.copy()
    fast[3:, 3:6] *= 1e16
    fast[3:, 9:] *= 1e8
    with pytest.raises(fflin.InputError, match="1,000,000"):
        fflin.validity(robot, lin, fast)


def test_interval_is_clopper_and_pearsons():
    for successes, count in ((0, 10), (3, 10), (10, 10), (97, 100)):
        for confidence in (0.9, 0.99):
            exact = binomtest(successes, count).proportion_ci(
                confidence, method="exact"
            )
            result = clopper_pearson(successes, count, confidence)[1:]
            assert result == pytest.approx((exact.low, exact.high), rel=1e-9)


@pytest.mark.compiled
def test_joints_only_hold_the_reduced_model(robots):
    robot = robots["ets_vii"]
    robot = robot.replace(
        inputs=[fflin.JointTorque(name) for name in robot.joint_names]
    )
    lin, gain = held(robot, reduce=True)
    result = fflin.validity(robot, lin, gain, joint=0.5, samples=5)
    assert result.slope == pytest.approx(2.0, abs=0.1)
    assert result.settled == 5


@pytest.mark.compiled
def test_an_undefined_decision_is_not_reported(robots, arm):
    robot = robots["cubesat"]
    lin, gain = held(robot)
    # A body that is only moved away comes back as the linear model says, to the last digit.
    result = fflin.validity(robot, lin, gain, attitude=0.0, samples=1)
    assert np.isnan(result.slope) and result.trusted == result.largest
    assert result.largest == {"attitude": 0.0, "position": 0.5, "joint": 0.0}
    assert says(str(result), "0.5 m", "order")
    # One that is hurled away is nowhere foreseen.
    lin, gain = held(arm)
    result = fflin.validity(arm, lin, gain, attitude=170.0, position=1e6, samples=1)
    assert np.isnan(result.slope) and result.inside == 0
    assert set(result.trusted.values()) == {0.0}
    assert says(str(result), "85 deg", "5e+05 m", "0.5 rad")
    assert "nan" not in str(result)
    pytest.importorskip("matplotlib")
    fflin.plot_validity(result).draw_without_rendering()


@pytest.mark.compiled
def test_a_reduced_model_omits_missing_states_in_its_report(robots):
    robot = robots["ets_vii"]
    robot = robot.replace(
        inputs=[fflin.JointTorque(name) for name in robot.joint_names]
    )
    lin, gain = held(robot, reduce=True)
    result = fflin.validity(robot, lin, gain, joint=0.5, samples=2)
    assert result.largest == {"attitude": 0.0, "position": 0.0, "joint": 0.5}
    assert "deg" not in str(result)
    with pytest.raises(fflin.InputError, match="displaced"):
        fflin.validity(robot, lin, gain, joint=0.0, samples=2)


def test_invalid_input(arm):
    lin, gain = held(arm)
    for arguments, words in (
        ((arm, lin, -gain.K), "stable"),
        ((arm, lin, gain.K[:, 1:]), r"\bK\b.*shape"),
        ((arm, lin, "K"), "<U1"),
        ((arm, None, gain), "fflin.LinearModel"),
        ((None, lin, gain), "fflin.Robot"),
        ((arm.replace(inputs=[fflin.BaseTorque()]), lin, gain), "F_b"),
    ):
        with pytest.raises(fflin.InputError, match=words):
            fflin.validity(*arguments)
    for options, words in (
        ({"samples": 0}, "samples"),
        ({"seed": 1.5}, r"1\.5"),
        ({"attitude": 180.0}, "175"),
        ({"joint": -1.0}, "0 or more"),
        ({"confidence": 1.0}, "0 and 1"),
    ):
        with pytest.raises(fflin.InputError, match=words):
            fflin.validity(arm, lin, gain, **options)
    gone = fflin.linearize(arm, v=fflin.velocity(arm, {"omega_b.z": 0.1}))
    with pytest.raises(fflin.InputError, match="equilibrium at rest"):
        fflin.validity(arm, gone, gain)


@pytest.mark.exhaustive
def test_command_line():
    code, out, err = run("validity", "cubesat", "--samples", "4", "--jobs", "2")
    assert code == 0 and not err
    assert says(out, "4 of 4") and max(map(len, out.splitlines())) <= 80
    assert "--jobs" in refused("validity", "cubesat", "--jobs", "0")
    assert "175 deg" in refused("validity", "cubesat", "--attitude", "200")


@pytest.mark.process
def test_jobs_are_at_most_one_for_each_core(monkeypatch):
    # The workers have two short runs, for which they must not compile.
    monkeypatch.setenv("NUMBA_DISABLE_JIT", "1")
    command = ("validity", "cubesat", "--samples", 2, "--jobs")
    with any_wording():  # it names the cores
        code, out, _ = run(*command, 10**15)
        messages = warned(*command, 99999)
    assert code == 0 and says(out, "of 2", "settled")
    assert any("99999" in message for message in messages)


@pytest.mark.compiled
def test_progress_is_reported_up_to_every_run(robots):
    robot = robots["cubesat"]
    lin, gain = held(robot)
    for executor in (None, ThreadPoolExecutor(2)):
        messages = []
        more = {
            "executor": executor,
            "progress": lambda *item, messages=messages: messages.append(item),
        }
        fflin.validity(robot, lin, gain, samples=40, **more)
        done = [item for item, _ in messages]
        assert done == sorted(set(done)) and len(done) > 8
        assert {total for _, total in messages} == {done[-1]} == {28 + 40}
    with pytest.raises(fflin.InputError, match="progress"):
        fflin.validity(robot, lin, gain, progress=3)


@pytest.mark.process
def test_a_process_that_dies_is_one_line(robots, monkeypatch):
    robot = robots["cubesat"]
    lin, gain = held(robot)
    # A function of Python's own, for which a worker imports nothing.
    monkeypatch.setattr(
        Loop, "__reduce__", lambda _: (signal.raise_signal, (signal.SIGKILL,))
    )
    for pool in (
        OwnWorkers(1),
        ProcessPoolExecutor(1, mp_context=get_context("spawn")),
    ):
        with (
            pool as executor,
            pytest.raises(fflin.FflinError, match=r"died|terminated abruptly"),
        ):
            fflin.validity(robot, lin, gain, samples=2, executor=executor)


@pytest.mark.process
@pytest.mark.skipif(os.name != "posix", reason="no pseudo-terminal")
@pytest.mark.parametrize("jobs", ["1", "2"])
def test_it_shows_a_bar_on_a_terminal_and_ends_at_ctrl_c(jobs):
    import pty

    ours, theirs = pty.openpty()
    with (
        subprocess.Popen(
            [
                sys.executable,
                "-m",
                "fflin",
                "validity",
                "cubesat",
                "--samples",
                "2000",
                "--jobs",
                jobs,
            ],
            stderr=theirs,
            start_new_session=True,
            env={**os.environ, "NUMBA_DISABLE_JIT": "1"},
        ) as process,
        finishing(process),
    ):
        os.close(theirs)
        message = b""
        while b"s left" not in message:
            message += os.read(ours, 4096)
        os.killpg(process.pid, signal.SIGINT)
        with contextlib.suppress(OSError):  # Linux tells the end so
            while more := os.read(ours, 4096):
                message += more
    os.close(ours)
    assert process.returncode == 130
    # The bar is taken away before the line.
    assert message.endswith(b"\r\x1b[2Kfflin: stopped\r\n")


@pytest.mark.exhaustive
def test_the_table_of_frames_is_the_output_of_its_command():
    frames = runpy.run_path(str(DOCS / "scripts" / "frames.py"))
    table = (DOCS / "conventions.md").read_text(encoding="utf-8")
    design = "acceleration_lqr(lin, 1, 1, 1)"
    result = frames["settled"](fflin.load("servicer_7dof"), design, 150.0)
    assert re.search(
        rf"`{re.escape(design)}`, servicer_7dof \|.* {result} \|$", table, re.MULTILINE
    )
