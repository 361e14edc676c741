"""How many rows a run records by itself, and what is said of a pole that makes it slow."""

from types import SimpleNamespace

import numpy as np
import pytest

import fflin
from fflin.control.tracking import poles_along
from fflin.simulation import plan
from fflin.simulation.plan import SimulationOptions
from fflin.simulation.report import motion_report
from tests.support.commands import run
from tests.support.messages import says
from tests.support.motions import displaced, regulated


def of(duration, **options):
    robot = fflin.load("planar_detumble")
    options = SimulationOptions(robot=robot, duration=duration, dt=0.01, **options)
    return plan.Plan(options).times


def test_runs_of_up_to_100000_rows_are_recorded_step_by_step():
    assert of(1000.0).every == 1
    many = of(1000.01)
    assert many.steps == 100_001 and many.every == 11
    assert 5_000 < many.rows <= 10_002
    asked = of(1000.01, every=1)
    assert asked.every == 1 and not asked.notes
    assert many.notes == (
        "one in 11 steps is recorded; every=1 (--every 1) records all 100,001 steps",
    )


@pytest.mark.parametrize(
    ("sample", "every"), [(0.01, 24), (0.03, 24), (0.5, 50), (0.07, 28)]
)
def test_recorded_rows_of_a_sampled_loop_divide_the_samples(sample, every):
    result = of(2400.0 - 2400.0 % sample, sample=sample)
    assert result.every == every
    assert result.every % result.sample == 0
    assert 4_000 < result.rows <= 10_002


def test_a_thinned_run_is_the_run_at_some_of_its_rows(monkeypatch):
    monkeypatch.setattr(plan, "_MANY_ROWS", 100)
    monkeypatch.setattr(plan, "_FEW_ROWS", 10)
    robot, lin, gain = regulated("ets_vii")
    policy = fflin.StateFeedback(lin, gain.K)
    options = {"x0": displaced(lin), "duration": 2.03, "dt": 0.01}
    thin = fflin.simulate(robot, policy, **options)
    full = fflin.simulate(robot, policy, every=1, **options)
    kept = [*range(0, 203, 21), 203]
    assert len(full.t) == 204 and not full.notes
    for key in ("t", "x", "u", "linear", "energy"):
        np.testing.assert_array_equal(getattr(thin, key), getattr(full, key)[kept])
    assert says(motion_report(thin), "one in 21", "203", "every=1 (--every 1)")
    short = fflin.simulate(robot, policy, **options | {"duration": 1.0})
    assert len(short.t) == 101 and not short.notes


def test_the_pole_that_makes_a_run_slow_is_reported():
    robot = fflin.load("ets_vii")
    lin = fflin.linearize(robot)
    K = fflin.lqr(lin).K.copy()
    rate = lin.state_names.index("qdot_m.joint_5")
    # Of the arm's own inertia about that joint, 640 1/s.
    K[lin.input_names.index("tau_m.joint_5"), rate] += 640.0 / lin.B[rate, 10]
    assert lin.input_names[10] == "tau_m.joint_5"
    policy = fflin.StateFeedback(lin, K)

    def at_once(t, q, v):
        return -1.0

    with pytest.warns(fflin.FflinWarning) as message:
        motion = fflin.simulate(robot, policy, duration=120.0, events=[at_once])
    fastest = np.abs(np.linalg.eigvals(lin.A - lin.B @ K)).max()
    (line,) = [str(item.message) for item in message]
    assert says(
        line, f"{-fastest:.3g} 1/s", "mainly qdot_m.joint_5", "0.001 s", "120,000"
    )
    assert says(line, "dt=", "sample=")
    assert motion.notes[1:] == (
        "one in 12 steps is recorded; every=1 (--every 1) records all 120,000 steps",
    )


def test_all_poles_of_a_schedule_count():
    rates = (50.0, 2.0, 300.0)
    A = np.array([[[0.0, rate], [-rate, 0.0]] for rate in rates])
    K = np.tile([[0.0, 7.0]], (3, 1, 1))
    B = np.tile([[0.0], [1.0]], (3, 1, 1))
    schedule = SimpleNamespace(t=np.array([0.0, 90.0, 90.1]), A=A, B=B, K=K, dt=0.0)
    poles = poles_along.__wrapped__(schedule)
    expected = np.concatenate([np.linalg.eigvals(item) for item in (*A, *(A - B @ K))])
    assert np.sort_complex(poles) == pytest.approx(np.sort_complex(expected))
    assert not len(poles_along.__wrapped__(SimpleNamespace(dt=0.1)))


def test_hours_that_nobody_asked_for_are_refused():
    robot = fflin.load("planar_detumble")
    with pytest.raises(fflin.InputError, match=r"2e\+07 .*every"):
        fflin.simulate(robot, duration=2e5)
    assert of(2e5, every=1000).steps == 20_000_000


def test_every_of_the_command(tmp_path):
    command = ("simulate", "planar_detumble", "--duration", 1, "-o", "m.npz")
    code, _, _ = run(*command, "--every", 25, cwd=tmp_path)
    assert code == 0
    np.testing.assert_allclose(
        fflin.Motion.load(tmp_path / "m.npz").t, [0, 0.25, 0.5, 0.75, 1.0]
    )
    assert run(*command, "--every", 0, cwd=tmp_path)[0] == 2
