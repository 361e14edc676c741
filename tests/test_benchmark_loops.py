"""What the benchmarks of closed loops and campaigns hold the simulators against."""

import builtins
import itertools
import sys
from dataclasses import replace

import numpy as np
import pytest

import fflin
from benchmarks import timing
from benchmarks.cases import campaigns, loops
from benchmarks.closed_loop import driven, error, true_end, welded, with_wheels
from benchmarks.contender import Contender
from benchmarks.dispersed import SPREADS, draws, fflin_campaign, started
from benchmarks.peers import WrongResultError
from fflin.simulation import lanes

pytestmark = pytest.mark.compiled

STEP, DURATION = 0.05, 0.5
LAWS = {
    "at all times": {},
    "held": {"held": True},
    "world": {"frame": "world", "held": True},
}


@pytest.fixture(autouse=True)
def brief(monkeypatch):
    monkeypatch.setattr(timing, "CASE_SECONDS", 0.01)


def made(name):
    if name == "wheels":
        return with_wheels("cubesat", STEP, DURATION)
    return driven(name, STEP, DURATION)


def ways(names=("cubesat", "ets_vii", "servicer_7dof")):
    pairs = [
        *itertools.product(names, LAWS),
        ("wheels", "at all times"),
        ("wheels", "held"),
    ]
    return [pytest.param(*pair, id=", ".join(pair)) for pair in pairs]


@pytest.mark.parametrize(("name", "law"), ways())
def test_truth_is_the_same_motion_by_another_route(name, law):
    """Steps of 5 ms: an error of fourth order is far below; its own is SciPy's, of 1e-12."""
    loop = made(name).but(**LAWS[law])
    fine = loop.but(dt=STEP / 10.0)
    motion = fflin.simulate(
        loop.robot,
        loop.policy,
        **fine.options | ({"sample": STEP} if loop.held else {}),
    )
    assert error(loop, motion.x[-1], true_end(loop)) < 1e-8
    moved = error(loop, loop.x0, true_end(loop))
    assert moved > 1e-2


def test_parameters_of_basilisk_are_the_law_to_first_order():
    loop = made("wheels")
    other = loop.but(K=loop.K * np.where(np.arange(18) < 3, 2.0, 1.0), mrp=True)
    x = np.zeros(18)
    x[:3], x[9:12] = (3e-4, -2e-4, 1e-4), 1e-4
    assert other.command(x) == pytest.approx(loop.command(x), rel=1e-6)
    x[:3] = 0.0, 0.6, 0.0  # of a turn of which the parameter is a third
    x[9:12] = 0.0
    assert other.command(x)[1] == pytest.approx(-other.K[1, 1] / 3.0, rel=1e-12)


def test_wheels_are_counted_in_the_body():
    loop = made("wheels")
    plain = fflin.load("cubesat").model.inertias[1]
    assert welded(loop).inertia == pytest.approx(plain.inertia, rel=1e-14)
    assert welded(loop).mass == plain.mass


def test_a_different_inertia_is_detected():
    loop = made("ets_vii")
    M = fflin.linearize(loop.robot, loop.point.q).M.copy()
    loop.require_same_inertia("peer", M)
    M[3, 7] *= 1.0 + 1e-6
    with pytest.raises(WrongResultError, match="peer on ets_vii: M differs by"):
        loop.require_same_inertia("peer", M)


@pytest.mark.parametrize("wrong", [-1.0, 1.001, np.nan])
def test_contender_with_another_end_is_not_timed(wrong):
    (right, *_) = loops.fflin_contenders(made("cubesat"))
    assert loops.checked(right) < 1e-7
    other = replace(right, end=lambda: wrong * right.end())
    with pytest.raises(WrongResultError, match="fflin on cubesat: ends"):
        loops.checked(other)


def test_held_and_at_all_times_are_not_the_same_loop():
    contenders = loops.fflin_contenders(made("servicer_7dof"))
    assert [item.name for item in contenders] == [
        "fflin",
        "fflin, 25,000 steps",
        "fflin, 25,000 steps, all rows",
        "fflin, held",
        "fflin, in Python",
    ]
    first, _, _, held, in_python = contenders
    for item in (first, held, in_python):
        item.run()
    assert first.end() == pytest.approx(in_python.end(), abs=1e-12)
    assert np.abs(first.end() - held.end()).max() > 1e-5


def test_rows_have_the_floor_and_every_contender():
    result = loops.fflin_contenders(made("cubesat"))
    floor, *rows = loops.measured("cubesat", result)
    assert floor[:2] == ("cubesat", loops.FLOOR) and floor[3:6] == ("1.00",) * 3
    assert [row[1] for row in rows] == [item.name for item in result]
    for row in rows:
        least, median, most = (float(cell.replace(",", "")) for cell in row[3:6])
        assert 0.0 < least <= median <= most and float(row[6]) < loops.WORST


def test_the_long_run_is_one_that_is_compiled_by_default_and_is_timed_by_its_own_steps():
    first, many, *_ = loops.fflin_contenders(made("cubesat"))
    assert many.loop.steps == loops.MANY > lanes.LONG > first.loop.steps
    assert many.loop.duration == first.loop.duration
    times = timing.Times((2.0, 3.0)).per(many.loop.steps)
    assert times.samples == (2.0 / loops.MANY, 3.0 / loops.MANY)


def without_peers(monkeypatch):
    original_import = builtins.__import__

    def without(name, *rest):
        if name.partition(".")[0] in ("mujoco", "pydrake", "Basilisk"):
            raise ImportError(f"No module named '{name}'")
        return original_import(name, *rest)

    monkeypatch.setattr(builtins, "__import__", without)
    for module in [
        item for item in sys.modules if item.startswith("benchmarks.peers.")
    ]:
        monkeypatch.delitem(sys.modules, module)


@pytest.mark.parametrize("find", [loops.contenders, campaigns.peers_of])
def test_peers_that_are_not_there_are_named(find, monkeypatch):
    without_peers(monkeypatch)
    result, notes = find(made("cubesat"))
    assert len(result) == (5 if find is loops.contenders else 0)
    assert [note.partition(":")[0] for note in notes] == ["MuJoCo", "Drake", "Basilisk"]
    assert all("not installed" in note for note in notes)


def campaign(loop, scale=None):
    """Fly each draw of fflin's by itself, with the robot that it makes."""
    drawn, ends = draws(loop, campaigns.CHECKED), []
    scale = np.ones(4) if scale is None else scale

    def call():
        ends.clear()
        for row in drawn * scale:
            body = loop.robot.model.inertias[1]
            heavy = {
                "mass": (1.0 + row[3]) * body.mass,
                "inertia": (1.0 + row[3]) * body.inertia,
            }
            robot = loop.robot.with_mass_properties(
                {"base": heavy | {"com": body.lever}}
            )
            options = loop.but(x0=started(loop, row)).options
            ends.append(fflin.simulate(robot, loop.policy, **options).x[-1])

    return Contender("one by one", loop, call, lambda: ends)


def test_draws_of_a_campaign_are_those_that_the_peers_get():
    loop = made("ets_vii").at_rest()
    assert not loop.x0[12:].any() and loop.x0[:12].any()
    assert campaigns.check(campaign(loop)) < 1e-12
    for column in range(4):
        scale = np.ones(4)
        scale[column] = -1.0
        with pytest.raises(WrongResultError, match="one by one on ets_vii: runs end"):
            campaigns.check(campaign(loop, scale))


def test_campaign_that_draws_for_itself_must_draw():
    loop = made("wheels").but(mrp=True)
    ends = np.random.default_rng(0).normal(size=(campaigns.CHECKED, 18))
    drawn = Contender("peer", loop, lambda: None, lambda: ends)
    assert campaigns.check(drawn) == 0.0
    ends[3] = ends[4]
    with pytest.raises(WrongResultError):
        campaigns.check(drawn)


def test_campaigns_on_threads_are_the_same():
    loop = made("cubesat").at_rest()
    alone, threads = (fflin_campaign("", loop, 16, threads=count) for count in (1, 4))
    alone.run(), threads.run()
    np.testing.assert_array_equal(alone.end(), threads.end())
    assert set(SPREADS) == {"q_b", "base.density"} and draws(loop, 16).shape == (16, 4)


def test_floor_is_timed_before_and_after(monkeypatch):
    """A machine that gets slower by a half each call; the ratio is the mean's of the neighbours."""
    clock, pace = [0.0], itertools.count()

    def costs(seconds):
        def call():
            clock[0] += seconds * 1.5 ** next(pace)

        return call

    monkeypatch.setattr(timing.time, "perf_counter", lambda: clock[0])
    result = timing.beside(costs(1.0), {"a": costs(2.0), "b": costs(2.0)}, rounds=2)
    expected = 2.0 * 1.5 / ((1.0 + 1.5**2) / 2.0)
    for default, floor in result.values():
        assert default.ratios(floor) == pytest.approx([expected] * 3)
