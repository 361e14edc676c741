"""Runs along a trajectory: what they follow, how far they are from it, what is foreseen."""

import numpy as np
import pinocchio as pin
import pytest

import fflin
from benchmarks.cases.trajectory import beside as beside_knots
from benchmarks.cases.trajectory import flown
from fflin.dynamics.state_rows import moved_by, moving_error, moving_errors
from tests.support.marks import exhaustive
from tests.support.messages import says
from tests.support.motions import beside, swung


@pytest.fixture(scope="module")
def case():
    robot = fflin.load("ets_vii")
    traj = swung(robot, spin=0.05).trajectory()
    return robot, fflin.tvlqr(fflin.linearize_trajectory(robot, traj)), traj


@pytest.mark.parametrize("frame", ["local", "hybrid", "world"])
def test_errors_of_rows_match_errors_of_points_and_are_inverted(frame):
    robot, rng = fflin.load("servicer_7dof"), np.random.default_rng(5)
    state = fflin.StateMap(robot, frame=frame)
    turns = 0.5 * rng.standard_normal((20, robot.nv))
    turns[:, 3:6] *= 4.0  # across half turns
    q = [pin.integrate(robot.model, robot.neutral(), turn) for turn in turns]
    v = rng.standard_normal((20, robot.nv))
    x = np.array([state.to_state(*item) for item in zip(q, v, strict=True)])
    e = moving_errors(frame, x[1:], x[:-1])
    for k, row in enumerate(e):
        error = moving_error(state, q[k], v[k], q[k + 1], v[k + 1])
        error[6 : 6 + robot.n] = x[k + 1, 6 : 6 + robot.n] - x[k, 6 : 6 + robot.n]
        np.testing.assert_allclose(row, error, atol=1e-13)
    np.testing.assert_allclose(moved_by(frame, x[:-1], e), x[1:], atol=1e-13)


@pytest.mark.exhaustive
def test_a_schedule_runs_as_the_feedback_along_its_trajectory(case):
    robot, schedule, traj = case
    q0, v0 = beside(robot, traj, 0.02)
    run = fflin.simulate(robot, schedule, q0=q0, v0=v0)
    assert run.t[-1] == traj.t[-1]
    assert run.frame == "local"
    assert run.tracked
    policy = fflin.TrajectoryFeedback(traj, schedule)
    np.testing.assert_array_equal(fflin.simulate(robot, policy, q0=q0, v0=v0).x, run.x)
    # Target and error are those of the time, as the feedback has them.
    state = fflin.StateMap(robot, frame="local")
    for k in (0, 137, 400):
        q, v, u = traj.point(run.t[k])
        np.testing.assert_allclose(run.target[k], state.to_state(q, v), atol=1e-13)
        e = moving_error(state, q, v, run.q[k], run.v[k])
        np.testing.assert_allclose(run.error[k], e, atol=1e-13)
        if k < 400:
            np.testing.assert_allclose(
                run.u[k], u - schedule.gain(run.t[k]) @ e, atol=1e-12
            )
    apart = [
        pin.log3(pin.XYZQUATToSE3(r[:7]).rotation.T @ pin.XYZQUATToSE3(q[:7]).rotation)
        for r, q in ((traj.point(t)[0], q) for t, q in zip(run.t, run.q, strict=True))
    ]
    np.testing.assert_allclose(
        run.attitude_error, np.degrees(np.linalg.norm(apart, axis=1)), atol=1e-9
    )
    assert says(str(run), "attitude")


@pytest.mark.exhaustive
def test_without_a_start_it_begins_on_its_trajectory(case):
    robot, schedule, traj = case
    run = fflin.simulate(robot, schedule)
    np.testing.assert_array_equal(run.q[0], traj.q[0])
    np.testing.assert_array_equal(run.v[0], traj.v[0])
    assert np.abs(run.error).max() < 1e-5


@pytest.mark.exhaustive
def test_after_the_end_the_last_configuration_is_held_at_rest():
    robot = fflin.load("planar_detumble")
    traj = swung(robot, size=0.3, spin=0.02).trajectory()
    assert np.abs(traj.v[-1]).max() > 1e-2
    schedule = fflin.tvlqr(fflin.linearize_trajectory(robot, traj))
    run = fflin.simulate(robot, schedule, duration=120.0, dt=0.02)
    after = run.t > traj.t[-1] + 1e-9
    held = fflin.StateMap(robot, frame="local").to_state(traj.q[-1], np.zeros(robot.nv))
    np.testing.assert_allclose(
        run.target[after], np.tile(held, (after.sum(), 1)), atol=1e-14
    )
    assert np.abs(run.error[-1]).max() < 1e-4


@pytest.mark.exhaustive
def test_a_sampled_schedule_is_asked_at_its_samples():
    robot = fflin.load("ets_vii")
    traj = swung(robot, sample=0.2).trajectory()
    assert traj.hold == "previous"
    schedule = fflin.tvlqr(fflin.linearize_trajectory(robot, traj), sample=0.2)
    q0, v0 = beside(robot, traj, 0.01)
    run = fflin.simulate(robot, schedule, q0=q0, v0=v0, dt=0.02)
    held = run.u[:-1].reshape(-1, 10, run.u.shape[1])
    np.testing.assert_array_equal(held, np.repeat(held[:, :1], 10, axis=1))
    state = fflin.StateMap(robot, frame="local")
    q, v, u = traj.point(run.t[50])
    e = moving_error(state, q, v, run.q[50], run.v[50])
    np.testing.assert_allclose(run.u[50], u - schedule.gain(run.t[50]) @ e, atol=1e-12)


@pytest.mark.exhaustive
def test_a_clock_that_does_not_begin_at_zero_is_counted_from_the_first_knot(case):
    robot, schedule, traj = case
    late = fflin.Trajectory(
        robot, traj.t + 100.0, traj.q, traj.v, traj.u, hold=traj.hold
    )
    moved = fflin.tvlqr(fflin.linearize_trajectory(robot, late))
    q0, v0 = beside(robot, traj, 0.02)
    runs = [
        fflin.simulate(robot, item, q0=q0, v0=v0, linear=False)
        for item in (schedule, moved)
    ]
    np.testing.assert_allclose(runs[1].x, runs[0].x, atol=1e-9)


@pytest.mark.exhaustive
def test_thrusters_realise_the_base_commands_of_a_schedule():
    design = fflin.load("cubesat", inputs=[fflin.BaseTorque(), fflin.BaseForce()])
    traj = swung(design, size=1e-4, spin=0.02).trajectory()
    schedule = fflin.tvlqr(fflin.linearize_trajectory(design, traj))
    places = [
        (x, y, z) for x in (-0.05, 0.05) for y in (-0.05, 0.05) for z in (-0.15, 0.15)
    ]
    thrusters = [
        fflin.Thruster("base", place, -np.sign(place[axis]) * np.eye(3)[axis])
        for place in places
        for axis in range(3)
    ]
    robot = design.replace(inputs=thrusters)
    q0, v0 = beside(design, traj, 1e-3)
    alone = fflin.simulate(design, schedule, q0=q0, v0=v0)
    run = fflin.simulate(robot, fflin.Allocation(schedule, design), q0=q0, v0=v0)
    assert run.linear is None
    np.testing.assert_allclose(run.x, alone.x, atol=1e-8)
    np.testing.assert_allclose(run.target, alone.target, atol=1e-14)


@pytest.mark.exhaustive
def test_limits_that_the_trajectory_itself_breaks_are_reported(case):
    robot, schedule, _ = case
    with pytest.warns(fflin.FflinWarning, match=r"0\.\d+ N"):
        fflin.simulate(robot, schedule, duration=0.1, limits=0.05)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"frame": "hybrid"}, "'hybrid'"),
        ({"linear": True}, "TrajectoryFeedback"),
    ],
)
def test_options_that_exclude_a_trajectory_are_refused(case, options, message):
    robot, schedule, _ = case
    with pytest.raises(fflin.InputError, match=message):
        fflin.simulate(robot, schedule, **options)


def test_a_run_without_an_end_is_refused():
    robot = fflin.load("cubesat")
    with pytest.raises(fflin.InputError, match="duration"):
        fflin.simulate(robot)


def test_a_schedule_of_another_robot_is_refused(case):
    _, schedule, _ = case
    with pytest.raises(fflin.InputError):
        fflin.simulate(fflin.load("servicer_7dof"), schedule)


def test_where_nothing_holds_the_robot_a_run_ends_with_its_trajectory():
    robot = fflin.load(
        "planar_detumble",
        gravity=(0.0, 0.0, -9.81),
        inputs=[fflin.JointTorque("joint_1")],
    )
    t = np.linspace(0.0, 0.4, 9)
    fall = fflin.simulate(robot, duration=0.4, dt=0.01, every=5, frame="local")
    along = fflin.linearize_trajectory(robot, fall.trajectory())
    schedule = fflin.tvlqr(along, 1.0, 1.0, 1.0)
    assert len(t) == len(fall.t)
    assert np.abs(fflin.simulate(robot, schedule).error).max() < 1e-6
    with pytest.raises(fflin.InputError, match=r"0\.4 s"):
        fflin.simulate(robot, schedule, duration=1.0)


def test_a_motion_that_is_followed_comes_back_from_its_file(case, tmp_path):
    robot, schedule, traj = case
    q0, v0 = beside(robot, traj, 0.02)
    run = fflin.simulate(robot, schedule, q0=q0, v0=v0, duration=0.5)
    for name in ("a.npz", "a.mat", "a.json"):
        run.save(tmp_path / name)
        back = fflin.Motion.load(tmp_path / name)
        np.testing.assert_array_equal(back.target, run.target)
        np.testing.assert_array_equal(back.error, run.error)
        assert back.tracked


@pytest.mark.exhaustive
def test_a_loop_of_ten_seconds_comes_back_to_a_hundredth_of_a_degree():
    """Under the default weights, and inputs that are limited to a third of what they ask for."""
    traj = flown()
    robot, along = traj.robot, fflin.linearize_trajectory(traj.robot, traj)
    schedule = fflin.tvlqr(along)
    assert says(schedule.weights, "3 deg")
    q0, v0 = beside_knots(traj)
    for limit, degrees in ((None, 0.01), (20.0, 0.1)):
        run = fflin.simulate(robot, schedule, q0=q0, v0=v0, limits=limit, linear=False)
        assert run.attitude_error[0] == pytest.approx(1.0)
        assert run.attitude_error[-1] < degrees
        largest = np.abs(run.u).max()
        assert largest == 20.0 if limit else largest > 60.0


@pytest.mark.exhaustive
@pytest.mark.parametrize("sample", [None, 0.1])
def test_after_the_end_the_regulator_about_rest_acts_whatever_the_weight_at_the_end(
    sample,
):
    robot = fflin.load("planar_detumble")
    traj = swung(robot, size=0.3).trajectory()
    along = fflin.linearize_trajectory(robot, traj)
    heavy = fflin.tvlqr(along, 10.0, 0.05, 1e4, sample=sample)
    steady = fflin.tvlqr(along, 10.0, 0.05, "steady", sample=sample)
    ends = [
        fflin.TrajectoryFeedback(along, item).gain(traj.t[-1] + 1.0)
        for item in (heavy, steady)
    ]
    np.testing.assert_array_equal(*ends)
    if sample is None:
        np.testing.assert_allclose(ends[1], steady.K[-1], rtol=0.05, atol=1e-2)
    # A continuous gain that grows towards a heavy end requires very short steps.
    flown = heavy if sample else fflin.tvlqr(along, 10.0, 0.05, 1e2)
    run = fflin.simulate(robot, flown, duration=30.0 if sample else 14.0)
    assert not run.stopped
    assert np.abs(run.error[-1]).max() < 1e-3


def test_the_last_step_ends_on_the_trajectory_whatever_its_time_is_rounded_to():
    robot = fflin.load("planar_detumble")
    traj = swung(robot, 1.0, size=0.3, spin=0.02).trajectory()
    policy = fflin.TrajectoryFeedback(
        traj, fflin.tvlqr(fflin.linearize_trajectory(robot, traj))
    )
    late = np.nextafter(policy.duration, np.inf)
    for t in (policy.duration, late):
        np.testing.assert_array_equal(policy.reference(t)[1], traj.point(traj.t[-1])[1])
    assert not policy.reference(policy.duration + 1e-6)[1].any()


@pytest.mark.parametrize(
    "engine", ["python", pytest.param("compiled", marks=pytest.mark.compiled)]
)
@pytest.mark.parametrize("how", ["schedule", "option"])
def test_at_the_end_held_inputs_match_rest(engine, how):
    """The last input of a motion brakes: held on for a sample it kicks the robot out of rest."""
    robot = fflin.load("planar_detumble")
    start = fflin.velocity(robot, {"omega_b.y": 0.02})
    brake = np.linalg.lstsq(
        fflin.linearize(robot).B[9:], -start[[3, 4, 5, 0, 1, 2, 6, 7, 8]]
    )[0]
    run = fflin.simulate(
        robot,
        lambda t, q, v: brake,
        v0=start,
        duration=1.0,
        dt=0.01,
        every=10,
        frame="local",
        sample=0.1,
    )
    traj = run.trajectory()
    assert np.abs(traj.v[-1]).max() < 0.1 * np.abs(start).max()
    sample = 0.1 if how == "schedule" else None
    schedule = fflin.tvlqr(
        fflin.linearize_trajectory(robot, traj), 1.0, 1e3, sample=sample
    )
    option = {"sample": 0.1} if how == "option" else {}
    flown = fflin.simulate(
        robot, schedule, duration=3.0, dt=0.01, engine=engine, **option
    )
    at = np.searchsorted(flown.t, 1.0 - 1e-9)
    assert np.abs(flown.u[at - 1]).max() > 0.5 * np.abs(brake).max()
    assert np.abs(flown.u[at]).max() < 0.1 * np.abs(brake).max()


@pytest.mark.parametrize(
    "engine", ["python", pytest.param("compiled", marks=pytest.mark.compiled)]
)
def test_inputs_that_jump_at_knots_are_followed_to_the_integrators_order(engine):
    robot = fflin.load("ets_vii")
    u = 0.5 * np.random.default_rng(6).normal(size=(5, 12))
    options = {"duration": 2.0, "frame": "local"}
    held = fflin.simulate(
        robot,
        lambda t, q, v: u[min(int(t / 0.4 + 1e-9), 4)],
        dt=1e-3,
        sample=0.4,
        every=40,
        **options,
    )
    schedule = fflin.tvlqr(
        fflin.linearize_trajectory(robot, held.trajectory()), 1.0, 1.0, 1.0
    )
    errors = []
    for dt in (0.04, 0.02):
        run = fflin.simulate(
            robot, schedule, duration=2.0, dt=dt, engine=engine, every=int(0.4 / dt)
        )
        errors.append(np.abs(run.error).max())
    assert errors[1] < 1e-6
    assert errors[0] > 8.0 * errors[1]


@pytest.mark.exhaustive
def test_a_sample_of_inputs_that_change_has_their_mean(monkeypatch):
    robot = fflin.load("planar_detumble")
    traj = swung(robot, 2.0, size=0.5).trajectory()
    schedule = fflin.tvlqr(fflin.linearize_trajectory(robot, traj), sample=0.1)
    run = fflin.simulate(robot, schedule, dt=0.01)
    np.testing.assert_allclose(run.u[0], traj.point(0.05)[2], atol=1e-12)
    monkeypatch.setattr(fflin.TrajectoryFeedback, "ahead", 0.0)
    late = fflin.simulate(robot, schedule, dt=0.01)
    assert np.abs(run.error[::10]).max() < 0.2 * np.abs(late.error[::10]).max()


@pytest.mark.parametrize("first", [0.0, 0.3])
def test_a_run_of_just_the_trajectorys_length_needs_no_rest(first):
    robot = fflin.load(
        "planar_detumble", gravity=(0.0, 0.0, -9.81), inputs=[fflin.JointTorque("*")]
    )
    t = np.linspace(0.0, 0.7, 8)
    fall = fflin.simulate(robot, duration=0.7, dt=0.01, every=10, frame="local")
    traj = fflin.Trajectory(robot, first + t, fall.q, fall.v, fall.u)
    schedule = fflin.tvlqr(
        fflin.linearize_trajectory(robot, traj), 1.0, 1.0, 1.0, sample=0.07
    )
    for dt in (0.07, 0.01):
        run = fflin.simulate(robot, schedule, dt=dt)
        assert np.abs(run.error).max() < 1e-4


@pytest.mark.parametrize(
    ("sample", "degrees"), [(0.2, 0.1), *exhaustive((0.05, 0.01), (0.1, 0.02))]
)
def test_default_gains_of_samples_bring_errors_to_nothing_within_a_trajectory(
    sample, degrees
):
    robot = fflin.load("planar_detumble")
    traj = swung(robot, 6.0, size=0.5).trajectory().resampled(0.1)
    schedule = fflin.tvlqr(fflin.linearize_trajectory(robot, traj), sample=sample)
    offset = np.r_[
        0.0, 0.0, 0.0, 0.0, np.radians(1.0), 0.0, np.full(3, np.radians(3.0))
    ]
    q0 = pin.integrate(robot.model, traj.q[0], offset)
    run = fflin.simulate(robot, schedule, q0=q0, v0=traj.v[0], linear=False)
    assert run.attitude_error[0] == pytest.approx(1.0)
    assert run.attitude_error[-1] < degrees


def test_a_start_next_to_a_trajectory_has_the_requested_error(case):
    robot, schedule, traj = case
    policy = fflin.TrajectoryFeedback(traj, schedule)
    state = fflin.StateMap(robot, frame="local")
    q, v = policy.beside(
        {"yaw": 90.0, "q_m": 0.1, "q_m.joint_2": 0.2, "omega_b.y": 0.3}
    )
    e = moving_error(state, traj.q[0], traj.v[0], q, v)
    expected = np.zeros(state.nx)
    expected[2], expected[6 : 6 + robot.n], expected[7] = np.sqrt(0.5), 0.1, 0.2
    expected[6 + robot.n + 1] = 0.3
    np.testing.assert_allclose(e, expected, atol=1e-12)
    with pytest.raises(fflin.InputError, match="q_b"):
        policy.beside({"yaw": 1.0, "q_b": 0.1})
