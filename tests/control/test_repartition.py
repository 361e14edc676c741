"""Regulators along motions whose independent coordinates change on the way."""

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.control.optimal import differential_riccati as riccati
from fflin.dynamics.state_rows import moving_error
from tests.support.constrained import Build, at, rod

# The slider is heavy, so it is the best coordinate, except near its dead centres. [kg]
SLIDER, ROD, CRANK = 10.0, 0.3, 4.8


@pytest.fixture(scope="module")
def engine():
    """A slider-crank mechanism on a held ground, which turns through a dead centre."""
    ground = pin.Inertia(5.0, np.zeros(3), np.eye(3))
    build = Build(ground)
    crank = build.add(1, pin.JointModelRZ(), at(), "crank", rod(CRANK, 0.5))
    link = build.add(crank, pin.JointModelRZ(), at(x=0.5), "link", rod(ROD, 1.2))
    build.frame("link_end", link, at(x=1.2))
    heavy = pin.Inertia(SLIDER, np.zeros(3), np.eye(3))
    build.add(1, pin.JointModelPX(), at(x=1.7), "slider", heavy)
    robot = build.robot(
        "engine",
        constraints=[
            fflin.Weld("base", placement=at(), name="ground"),
            fflin.Hinge("link_end", "slider", placement=at()),
        ],
        inputs=[fflin.JointTorque("crank"), fflin.JointTorque("slider")],
    )
    return robot, turning(robot, 0.6, -1.5)


def turning(robot, angle, rate):
    """A closed state at a crank angle, and a rate of the crank."""
    lean = -np.arcsin(0.5 * np.sin(angle) / 1.2)
    reach = 0.5 * np.cos(angle) + 1.2 * np.cos(lean) - 1.7
    joints = {"crank": angle, "link": lean - angle, "slider": reach}
    q = fflin.closed(robot, fflin.configuration(robot, joints))
    turn = np.array((-0.5 * np.sin(angle), 0.5 * np.cos(angle))) * rate
    swing = -turn[1] / (1.2 * np.cos(lean))
    rates = {
        "crank": rate,
        "link": swing - rate,
        "slider": turn[0] - 1.2 * np.sin(lean) * swing,
    }
    return fflin.closed(robot, q, fflin.velocity(robot, rates))


@pytest.fixture(scope="module")
def passing(engine):
    """Models along a motion through the dead centre, at which the slider stops."""
    robot, (q, v) = engine
    motion = fflin.simulate(
        robot, q0=q, v0=v, duration=0.6, dt=0.01, every=1, engine="python"
    )
    crank = motion.q[:, robot.joint("crank").idx_q]
    assert crank[-1] < -0.3 < 0.3 < crank[0]
    return robot, motion, fflin.linearize_trajectory(robot, motion.trajectory())


# Weights of the slider in the coordinates at the first knot.
Q, R, QF = (900.0, 40.0), (0.02, 0.03), (1500.0, 200.0)


@pytest.mark.exhaustive
def test_the_coordinates_change_before_the_dead_centre(passing):
    robot, motion, along = passing
    groups = [names[0] for names in along.partition.names]
    assert groups == ["q_m.slider", "q_m.crank"]
    crank = np.interp(along.switches, motion.t, motion.q[:, robot.joint("crank").idx_q])
    assert np.abs(crank).max() < 0.4
    assert along.check().ok
    assert along[0].state_names != along[len(along) // 2].state_names
    assert "independent coordinates are" in str(along)


@pytest.mark.exhaustive
def test_the_transition_matrices_do_not_depend_on_the_coordinates(passing):
    """Over the whole motion, from the coordinates at the start to those at the end.

    The motion is interpolated between the knots with order 4, so the models agree to 2e-5. Twice
    the distance of the knots multiplies the difference by 16.
    """
    robot, motion, along = passing
    fixed = fflin.linearize_trajectory(
        robot, motion.trajectory(), independent=["crank"]
    )
    dt = 0.2
    changing, same = along.discretize(dt), fixed.discretize(dt)
    state = fflin.StateMap(robot)
    whole = [np.eye(2), np.eye(2)]
    for one, other in zip(changing.A, same.A, strict=True):
        whole = [one @ whole[0], other @ whole[1]]
    rows = [state.names.index(name) for name in along.state_names]
    start = fixed[0]._all_states[rows]
    rows = [state.names.index(name) for name in along.partition.names[-1]]
    end = fixed[len(fixed) - 1]._all_states[rows]
    expected = end @ whole[1] @ np.linalg.inv(start)
    np.testing.assert_allclose(whole[0], expected, atol=2e-5 * np.abs(expected).max())


@pytest.fixture(scope="module")
def laws(passing):
    """The models, models in the crank, and continuous gains whose coordinates change."""
    robot, motion, along = passing
    fixed = fflin.linearize_trajectory(
        robot, motion.trajectory(), independent=["crank"]
    )
    return along, fixed, fflin.tvlqr(along, Q, R, QF)


@pytest.mark.exhaustive
def test_the_cost_to_go_is_continuous_on_the_manifold(laws):
    """An error on the manifold has the same cost before and after a change."""
    along, fixed, law = laws
    assert law.residual < 1e-3
    state = fflin.StateMap(along.robot)
    rng = np.random.default_rng(1)
    assert len(along.switches) == 1
    for index, t in enumerate(along.switches):
        k = int(np.flatnonzero(law.t == t)[0])
        errors = tangent(fixed, t) @ rng.normal(size=(2, 3))
        for error in errors.T:
            costs = []
            for part, P in ((index, law.P[k]), (index + 1, law.P[k + 1])):
                names = along.partition.names[part]
                e = error[[state.names.index(name) for name in names]]
                costs.append(e @ P @ e)
            assert costs[0] == pytest.approx(costs[1], rel=1e-9)


@pytest.mark.exhaustive
def test_the_law_is_that_of_fixed_coordinates(laws):
    """The crank determines the motion everywhere. The same cost in its coordinates gives the same
    gains of all states on the manifold, to the accuracy of the interpolated motion."""
    along, fixed, law = laws
    state = fflin.StateMap(along.robot)
    rows = [state.names.index(name) for name in along.state_names]

    def at(times):
        A, B = fixed.matrices_at(times)
        maps = np.array([tangent(fixed, t) for t in times])[:, rows]
        weights = maps.mT @ np.diag(Q) @ maps
        return np.array((A, B @ np.diag(1.0 / np.array(R)) @ B.mT, weights))

    V = tangent(fixed, fixed.t[-1])[rows]
    t, P = riccati.solve_back(at, fixed.t, V.T @ np.diag(QF) @ V)
    first = fixed[0]._all_states[rows]
    np.testing.assert_allclose(first.T @ law.P[0] @ first, P[0], rtol=1e-4)
    for time in (0.1, 0.3, 0.5):
        k = int(np.abs(t - time).argmin())
        _, B = fixed.matrices(t[k])
        expected = np.diag(1.0 / np.array(R)) @ B.T @ P[k]
        names = law.partition.names[law.part(t[k])]
        kept = [state.names.index(name) for name in names]
        gains = law.gain(t[k]) @ tangent(fixed, t[k])[kept]
        np.testing.assert_allclose(gains, expected, atol=1e-4 * np.abs(expected).max())


def tangent(fixed, t):
    """The map from errors of the crank to errors of all states, at a time."""
    linearizer = fixed._linearizers[0]
    point = linearizer.on_constraints(*fixed.point(t)[:2])
    return linearizer.reduction(*point, ["q_m.crank"]).T


@pytest.mark.exhaustive
@pytest.mark.parametrize("sample", [0.2, None])
def test_a_regulator_tracks_through_the_dead_centre(passing, sample, tmp_path):
    """A small error at the start becomes the error that the linear model predicts."""
    robot, motion, along = passing
    law = fflin.tvlqr(along, Q, R, QF, sample=sample)
    law.save(tmp_path / "law.npz")
    law = fflin.GainSchedule.load(tmp_path / "law.npz")
    policy = fflin.TrajectoryFeedback(motion.trajectory(), law)
    q, v = turning(robot, 0.601, -1.5)
    options = {"duration": 0.6, "dt": 0.01, "every": 1, "engine": "python"}
    tracked = fflin.simulate(robot, policy, q0=q, v0=v, **options)
    free = fflin.simulate(robot, None, q0=q, v0=v, **options)
    crank = robot.joint("crank").idx_q
    errors = [np.abs(x.q[:, crank] - motion.q[:, crank]) for x in (tracked, free)]
    assert errors[0][-1] < 0.2 * errors[1][-1]
    assert np.abs(np.diff(tracked.u, axis=0)).max() < 1.0
    if sample:
        # After two samples, in the new coordinate. The error of second order is 3 %.
        e = moving(robot, motion, along, q, v)
        for A, B, K in zip(law.A[:2], law.B[:2], law.K[:2], strict=True):
            e = (A - B @ K) @ e
        assert law.partition.names[law.parts[2]][0] == "q_m.crank"
        difference = tracked.q[40, crank] - motion.q[40, crank]
        assert difference == pytest.approx(e[0], rel=0.05)


def moving(robot, motion, along, q, v):
    """The error of a state relative to the first knot, in the coordinates there."""
    state = fflin.StateMap(robot, frame="local")
    error = moving_error(state, motion.q[0], motion.v[0], q, v)
    return error[[state.names.index(name) for name in along.state_names]]


@pytest.mark.exhaustive
def test_designs_without_support_name_the_times_of_the_changes(passing):
    _, _, along = passing
    with pytest.raises(fflin.InputError, match=r"Kalman filters.*change at t = "):
        fflin.tvkalman(along, 1e-3, 1e-4, sample=0.1)
    with pytest.raises(fflin.InputError, match=r"predictive.*change at t = "):
        fflin.mpc(along, Q, R, horizon=4, dt=0.1, limits=None)


@pytest.mark.exhaustive
def test_predictive_control_along_a_motion_without_limits_is_the_regulator(engine):
    """Before the dead centre, one choice of coordinates suffices."""
    robot, (q, v) = engine
    options = {"duration": 0.2, "dt": 0.01, "every": 1, "engine": "python"}
    motion = fflin.simulate(robot, q0=q, v0=v, **options)
    along = fflin.linearize_trajectory(robot, motion.trajectory())
    assert not along.switches.size
    policy = fflin.mpc(along, Q, R, horizon=4, dt=0.1, limits=None)
    q, v = turning(robot, 0.601, -1.5)
    laws = policy, fflin.tvlqr(along, Q, R, sample=0.1)
    first, second = (fflin.simulate(robot, law, q0=q, v0=v, **options) for law in laws)
    assert np.abs(first.u).max() > 1e-3
    np.testing.assert_allclose(first.u, second.u, atol=1e-9)
