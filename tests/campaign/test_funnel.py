"""The region around a trajectory: against a loop that is linear, its counts, and its record."""

import numpy as np
import pinocchio as pin
import pytest
from scipy.integrate import solve_ivp

import fflin
from fflin.campaign.funnel import ellipsoid_axes, runs_from
from fflin.dynamics.state import StateMap
from fflin.dynamics.state_rows import moved_by, moving_error
from tests.support.commands import refused, run
from tests.support.messages import says

OUTCOME, DURATION = {"within": 0, "lost": 1, "beyond": 2, "missed": 3}, 12.0


@pytest.fixture(scope="module")
def still():
    """A body that is to stay where it is: tiny errors of it are those of a linear loop."""
    robot = fflin.load("cubesat")
    t = np.linspace(0.0, DURATION, 7)
    q = np.tile(fflin.configuration(robot), (7, 1))
    motion = fflin.Trajectory(robot, t, q, np.zeros((7, 6)), np.zeros((7, 6)))
    return robot, fflin.linearize_trajectory(robot, motion)


@pytest.fixture(scope="module")
def schedule(still):
    return fflin.tvlqr(still[1], 1.0, {"tau_b": 1e4, "F_b": 10.0}, 4.0)


@pytest.fixture(scope="module")
def arm(robots):
    """A planar arm on its way, its base turned far from the world's axes."""
    robot = robots["planar_detumble"]
    base = pin.SE3(pin.exp3(np.array([0.0, 3.1, 0.0])), np.zeros(3))
    q0, v0 = (
        fflin.configuration(robot, {"joint_1": 0.3}, base),
        fflin.velocity(robot, {"joint_2": 0.2}),
    )
    motion = fflin.simulate(robot, None, q0=q0, v0=v0, duration=2.0, dt=0.05, every=4)
    along = fflin.linearize_trajectory(robot, motion.trajectory())
    return robot, fflin.tvlqr(along, 1.0, 1.0, 4.0, sample=0.1)


@pytest.fixture(scope="module")
def found(arm):
    return fflin.funnel(
        *arm, {"attitude": 5.0, "joints": 0.1}, knots=3, samples=16, dt=0.05
    )


def passage(still, schedule, t):
    """What takes an error at a time to the end, of the linear loop."""
    along = still[1]

    def rate(time, e):
        A, B = along.matrices(min(time, DURATION))
        return (
            (A - B @ schedule.gain(min(time, DURATION))) @ e.reshape(12, 12)
        ).ravel()

    way = solve_ivp(rate, (t, DURATION), np.eye(12).ravel(), rtol=1e-9, atol=1e-12)
    return way.y[:, -1].reshape(12, 12)


def ends(still, schedule, t):
    """M (12, 12) such that a start of root level s, direction z, ends at level s^2 |M z|^2."""
    root = np.linalg.cholesky(schedule.P[-1])
    k = int(np.abs(schedule.t - t).argmin())
    return root.T @ passage(still, schedule, t) @ ellipsoid_axes(schedule.P[k])


def successes(M, goal, size, rng, count=4000):
    """The share of starts up to a root level that end within a level."""
    z = rng.normal(size=(count, 12))
    z *= (rng.uniform(size=count) / np.linalg.norm(z, axis=1))[:, None]
    return ((size * z @ M.T) ** 2).sum(axis=1) <= goal


@pytest.mark.compiled
def test_of_a_linear_loop_it_is_known(still, schedule):
    """No run fails below the level that the worst direction bears, and as many as should above."""
    goal, rng = 1e-8, np.random.default_rng(0)
    found = fflin.funnel(still[0], schedule, goal, knots=3, samples=120, dt=0.1)
    assert len(found.t) == 3 and found.t[0] == 0.0
    for k, t in enumerate(found.t):
        M = ends(still, schedule, t)
        bears = goal / np.linalg.norm(M, 2) ** 2
        assert found.rho[k] >= bears * (1.0 - 1.0 / 120.0) ** 2
        assert found.rho[k] < found.tried[k]
        good = (found.outcomes[k] == OUTCOME["within"]).sum()
        share = successes(M, goal, np.sqrt(found.tried[k]), rng).mean()
        assert (
            abs(good - 120 * share) < 4.0 * np.sqrt(120 * share * (1.0 - share)) + 1.0
        )
    # What is left to lose grows on the way: the linear loop's cost falls.
    assert (np.diff(found.rho) < 0.0).all() and (found.rho > goal).all()


@pytest.mark.compiled
def test_a_narrower_goal_is_a_narrower_funnel(still, schedule):
    wide, narrow = (
        fflin.funnel(still[0], schedule, goal, knots=2, samples=40, dt=0.1)
        for goal in (
            {"attitude": 1.0, "position": 0.02},
            {"attitude": 0.25, "position": 0.005},
        )
    )
    ratio = np.sqrt(wide.rho / narrow.rho)
    assert ((ratio > 2.5) & (ratio < 6.5)).all()  # 4 in a linear loop, but for chance
    kept = fflin.funnel(
        still[0],
        schedule,
        {"attitude": 1.0, "position": 0.02},
        within={"omega_b": 1e-4},
        knots=2,
    )
    with pytest.raises(fflin.UnknownNameError, match="did you mean omega_b"):
        fflin.funnel(
            still[0], schedule, {"attitude": 1.0}, within={"omega": 1e-4}, knots=2
        )
    assert (kept.rho < wide.rho).all() and OUTCOME["beyond"] in kept.outcomes
    # The errors of a start count, not only the errors at the end.
    goal = {"attitude": 1.0}
    free, bound = (
        fflin.funnel(
            still[0], schedule, goal, within=within, knots=2, samples=40, dt=0.1
        )
        for within in (None, goal)
    )
    assert bound.rho[0] < free.rho[0] and OUTCOME["beyond"] not in free.outcomes
    # No motion of its own keeps an arm to a goal that it never comes near.
    weak = fflin.funnel(
        still[0], schedule, {"attitude": 1.0}, knots=1, limits=1e-12, samples=8
    )
    strong = fflin.funnel(still[0], schedule, {"attitude": 1.0}, knots=1, samples=8)
    assert weak.rho[0] < strong.rho[0]


@pytest.mark.exhaustive
def test_confidence_intervals_have_their_stated_coverage(still, schedule):
    """The share inside that succeeds at least, over many funnels of the linear loop."""
    goal, rng = 1e-8, np.random.default_rng(1)
    M, count, held = ends(still, schedule, 0.0), 40, 0
    size = 2.0 * np.sqrt(goal) / np.linalg.norm(M, 2)
    for _ in range(200):
        z = rng.normal(size=(count, 12))
        z *= (size * (np.arange(count) + 0.5) / count / np.linalg.norm(z, axis=1))[
            :, None
        ]
        failed = ((z @ M.T) ** 2).sum(axis=1) > goal
        inside = int(failed.argmax()) if failed.any() else count
        reach = size * (inside - 0.5) / count
        held += successes(M, goal, reach, rng).mean() >= 0.05 ** (1.0 / inside)
    assert held >= 0.95 * 200


@pytest.mark.compiled
def test_it_is_the_same_whoever_does_it(arm, found):
    robot, schedule = arm
    goal = {"attitude": 5.0, "joints": 0.1}
    options = {"knots": 3, "samples": 16, "dt": 0.05}
    pytest.importorskip("numba")
    messages = []
    compiled = fflin.funnel(*arm, goal, **options, engine="compiled")
    for more in (
        {
            "threads": 3,
            "engine": "compiled",
            "progress": lambda *item: messages.append(item),
        },
        {"workers": 2, "engine": "compiled"},
        {"engine": "compiled", "threads": 1},
    ):
        again = fflin.funnel(*arm, goal, **options, **more)
        assert np.array_equal(again.outcomes, compiled.outcomes)
        assert np.array_equal(again.tried, compiled.tried)
    assert messages == [(1, 3), (2, 3), (3, 3)]
    slow = fflin.funnel(*arm, goal, **options, engine="python")
    assert np.array_equal(slow.outcomes, compiled.outcomes)
    policy = fflin.TrajectoryFeedback(schedule.trajectory(robot), schedule)
    same = fflin.funnel(robot, policy, goal, **options)
    assert np.array_equal(same.outcomes, found.outcomes)
    other = fflin.funnel(*arm, goal, **options, seed=1)
    assert not np.array_equal(other.rho, found.rho)


def test_a_run_from_a_knot_is_one_of_simulate(arm):
    """What is flown from a knot is the motion that `simulate` flies from there."""
    robot, schedule = arm
    motion = schedule.trajectory(robot)
    policy = fflin.TrajectoryFeedback(motion, schedule)
    campaign = runs_from(robot, policy, (5, 10), "python", {"dt": 0.05})
    e = 0.01 * np.random.default_rng(0).normal(size=campaign.x0.size)
    x = moved_by("local", campaign.x0[None], e[None])[0]
    end = campaign.replay(x - campaign.x0)
    q, v = StateMap(robot, reference=end.reference, frame="local").to_pinocchio(x)
    error = moving_error(
        StateMap(robot, frame="local"), *motion.point(motion.t[5])[:2], q, v
    )
    assert error == pytest.approx(e, abs=1e-12)
    whole = fflin.simulate(robot, policy, dt=0.05)
    rest = campaign.replay(np.zeros(campaign.x0.size))
    apart = pin.difference(robot.model, rest.q[-1], whole.q[-1])
    assert np.abs(apart).max() < 1e-6 and rest.v[-1] == pytest.approx(
        whole.v[-1], abs=1e-6
    )


@pytest.mark.exhaustive
def test_sizes_and_contains(arm, found):
    robot, schedule = arm
    state, rng = StateMap(robot, frame="local"), np.random.default_rng(2)
    for k, t in enumerate(found.t):
        P = schedule.cost_to_go(t)
        z = rng.normal(size=(20000, len(P)))
        z /= np.linalg.norm(z, axis=1)[:, None]
        e = np.sqrt(found.rho[k]) * z @ np.linalg.inv(np.linalg.cholesky(P))
        assert (e @ P * e).sum(axis=1) == pytest.approx(found.rho[k])
        sines = np.sin(np.radians(found.attitude[k] / 2.0))
        for reach, part in (
            (sines.max(), e[:, :3]),
            (found.position[k].max(), e[:, 3:6]),
        ):
            assert (
                0.6 * reach < np.linalg.norm(part, axis=1).max() <= reach * (1.0 + 1e-9)
            )
        assert (np.abs(e[:, 6:9]).max(axis=0) <= found.joints[k] * (1.0 + 1e-9)).all()
        q, v, _ = found.trajectory.point(t)
        chart = StateMap(robot, reference=pin.XYZQUATToSE3(q[:7]), frame="local")
        for share, inside in ((0.99, True), (1.01, False)):
            x = moved_by("local", chart.to_state(q, v)[None], share * e[:1])[0]
            expected_value = chart.to_pinocchio(x)
            assert found.contains(t, q=expected_value[0], v=expected_value[1]) is inside
            assert found.contains(t, state.to_state(*expected_value)) is inside
    assert found.level(found.t[0] + 1e-3) == min(found.rho[:2])
    for arguments, words in (
        ((9.0,), "9 s"),
        ((0.0,), "q and v"),
        ((0.0, np.zeros(3)), r"\(3,\)"),
    ):
        with pytest.raises(fflin.InputError, match=words):
            found.contains(*arguments)


@pytest.mark.exhaustive
def test_it_prints_saves_and_is_drawn(arm, found, tmp_path):
    assert max(map(len, str(found).splitlines())) <= 80 and says(
        str(found), "95 % confidence"
    )
    assert len(found.rate) == 3 and (found.rate[:, 0] <= found.rate[:, 1]).all()
    for ending in ("npz", "json", "mat"):
        found.save(tmp_path / f"a.{ending}")
        again = fflin.Funnel.load(tmp_path / f"a.{ending}", arm[0])
        assert str(again) == str(found) and np.array_equal(again.P, found.P)
    with pytest.raises(fflin.FileError, match="Funnel"):
        arm[1].save(tmp_path / "s.npz")
        fflin.Funnel.load(tmp_path / "s.npz", arm[0])
    pytest.importorskip("matplotlib")
    figure = fflin.plot_funnel(found, tmp_path / "a.png")
    (panel,) = [ax for ax in figure.axes if ax.get_ylabel().startswith("joints")]
    assert panel.get_ylabel() == "joints [deg]"
    shown = np.array([line.get_ydata() for line in panel.get_lines()]).T
    np.testing.assert_allclose(shown, np.degrees(found.joints), rtol=1e-12)
    with pytest.raises(fflin.InputError, match=r"fflin\.funnel"):
        fflin.plot_funnel(3)


@pytest.mark.compiled
def test_command(arm, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    robot, schedule = arm
    schedule.save("gains.npz")
    given = (
        "funnel",
        "planar_detumble",
        "--schedule",
        "gains.npz",
        "--knots",
        "2",
        "--samples",
    )
    kept = ("-o", "f.npz", "--plot", "f.png", "--seed", "3")
    goal = ("--goal", "attitude=5", "--goal", "joints=0.1", "--limits", "none")
    code, out, err = run(*given, "8", *goal, "--dt", "0.05", *kept, "--threads", "2")
    assert code == 0 and not err and out.count("wrote") == 2
    made = fflin.funnel(
        robot,
        schedule,
        {"attitude": 5.0, "joints": 0.1},
        knots=2,
        samples=8,
        seed=3,
        dt=0.05,
    )
    assert np.array_equal(fflin.Funnel.load("f.npz", robot).outcomes, made.outcomes)
    assert "goal" in refused(*given, "8")
    assert "'attitud'" in refused(*given, "8", "--goal", "attitud=1")
    assert "--schedule" in refused("funnel", "cubesat", *goal)


def test_invalid_input(arm):
    robot, schedule = arm
    good = {"attitude": 1.0}
    for arguments, options, words in (
        ((3, schedule, good), {}, r"robot\b.*\bint\b"),
        ((robot, 3, good), {}, "GainSchedule"),
        ((robot, schedule, {}), {}, "goal"),
        ((robot, schedule, {"attitude": -1.0}), {}, "'attitude'"),
        ((robot, schedule, 0.0), {}, "'level'"),
        ((robot, schedule, "near"), {}, "'near'"),
        ((robot, schedule, good), {"within": 3}, "within"),
        ((robot, schedule, good), {"knots": 0}, "knots"),
        ((robot, schedule, good), {"knots": []}, "knots"),
        ((robot, schedule, good), {"samples": 0}, "samples"),
        ((robot, schedule, good), {"confidence": 1}, "0 and 1"),
        ((robot, schedule, good), {"duration": 3.0}, "'duration'"),
        ((robot, schedule, good), {"workers": 0}, "workers"),
    ):
        with pytest.raises(fflin.FflinError, match=words):
            fflin.funnel(*arguments, **options)


def test_draws_do_not_depend_on_the_rounding_of_eigenvectors():
    """Equal eigenvalues have no unique eigenvectors; the symmetric root is unique."""
    rng = np.random.default_rng(5)
    P = np.kron(np.diag([4.0, 1.0, 9.0, 0.0]), [[1.0, 0.5], [0.5, 1.0]])
    W = ellipsoid_axes(P)
    np.testing.assert_allclose(P @ W @ W.T @ P, P, rtol=0, atol=1e-12)
    for _ in range(4):
        noise = np.pad(rng.normal(size=(6, 6)), (0, 2))
        other = ellipsoid_axes(P + 1e-15 * (noise + noise.T))
        np.testing.assert_allclose(other, W, rtol=0, atol=1e-10)
