"""Linear models and regulators along motions of robots with constraints."""

import numpy as np
import pytest

import fflin
from fflin.dynamics.state_rows import moved_by, moving_error
from tests.support.constrained import strut
from tests.support.marks import exhaustive

BENT = {"left_1": 0.4, "left_2": 0.7, "right_1": -0.3, "right_2": -0.6}

# Weights on the 8 positions and on their rates: errors decay within about 0.1 s.
STIFF = np.repeat((1e7, 1e4), 8)


@pytest.fixture(scope="module")
def loop():
    """Two arms that hold each other and move freely."""
    robot = fflin.load("dual_arm", constraints=[fflin.Weld("tool_left", "tool_right")])
    q = fflin.closed(robot, fflin.configuration(robot, BENT))
    rates = {"left_1": 0.2, "left_2": -0.1, "omega_b.z": 0.1}
    q, v = fflin.closed(robot, q, fflin.velocity(robot, rates))
    motion = flown(robot, q, v)
    return robot, motion, fflin.linearize_trajectory(robot, motion.trajectory())


def flown(robot, q, v, policy=None, duration=0.4):
    return fflin.simulate(
        robot, policy, q0=q, v0=v, duration=duration, dt=0.02, every=5, engine="python"
    )


def displaced(robot, along, e):
    """A closed state beside the first knot; `e` is the error of the independent states."""
    lin = along[0]
    state = fflin.StateMap(
        robot, frame="local", reference=fflin.linearize(robot, lin.q).reference
    )
    whole = lin._all_states @ e
    x = moved_by("local", state.to_state(lin.q, lin.v)[None], whole[None])[0]
    return fflin.closed(robot, *state.to_pinocchio(x))


def transition(along):
    """The transition matrix from the first knot to the last."""
    whole = np.eye(len(along.state_names))
    for k in range(len(along.t) - 1):
        whole = along.discretize(along.t[1]).A[k] @ whole
    return whole


@pytest.mark.parametrize("column", exhaustive(6, 0, 7, 10, 15))
def test_the_transition_matrix_is_the_derivative_of_the_motion(loop, column):
    robot, motion, along = loop
    state = fflin.StateMap(robot, frame="local")
    picked = [state.names.index(name) for name in along.state_names]
    Phi = transition(along)
    step = 1e-4
    ends = []
    for sign in (1.0, -1.0):
        e = np.zeros(len(picked))
        e[column] = sign * step
        end = flown(robot, *displaced(robot, along, e))
        error = moving_error(state, motion.q[-1], motion.v[-1], end.q[-1], end.v[-1])
        ends.append(error[picked])
    difference = (ends[0] - ends[1]) / (2.0 * step)
    size = np.abs(Phi[:, column]).max()
    np.testing.assert_allclose(Phi[:, column], difference, atol=2e-6 * size)


@pytest.mark.exhaustive
def test_the_knots_are_models_about_the_moving_reference(loop):
    robot, motion, along = loop
    knot = along[3]
    expected = fflin.linearize(
        robot, motion.q[3], motion.v[3], moving=True, independent=along.independent
    )
    for key in ("A", "B", "C", "D", "M"):
        value = getattr(expected, key)
        size = np.abs(value).max(initial=1.0)
        np.testing.assert_allclose(getattr(knot, key), value, atol=1e-9 * size)
    assert knot.state_names == along.state_names == expected.state_names
    assert fflin.check(robot, knot).ok


def test_a_sampled_regulator_acts_as_the_linear_model_predicts(loop):
    """The initial error e is small, and the motion differs by the order of its square."""
    robot, motion, along = loop
    schedule = fflin.tvlqr(along, STIFF, 0.01, Qf=30.0, sample=0.1)
    policy = fflin.TrajectoryFeedback(motion.trajectory(), schedule)
    e = np.zeros(len(along.state_names))
    e[[0, 6]] = 2e-4, 3e-4
    start = displaced(robot, along, e)
    predicted = [e]
    for A, B, K in zip(schedule.A, schedule.B, schedule.K[:-1], strict=True):
        predicted.append((A - B @ K) @ predicted[-1])
    end = flown(robot, *start, policy)
    state = fflin.StateMap(robot, frame="local")
    picked = [state.names.index(name) for name in along.state_names]
    error = moving_error(state, motion.q[-1], motion.v[-1], end.q[-1], end.v[-1])
    size = np.abs(predicted).max()
    np.testing.assert_allclose(error[picked], predicted[-1], atol=2e-3 * size)
    assert np.linalg.norm(predicted[-1][:8]) < 0.5 * np.linalg.norm(e)


@pytest.mark.exhaustive
def test_a_continuous_regulator_solves_its_riccati_equation(loop):
    _, _, along = loop
    schedule = fflin.tvlqr(along, 2000.0, 0.01, Qf=30.0)
    assert schedule.residual < 1e-3
    np.testing.assert_allclose(schedule.P[-1], 30.0 * np.eye(16), atol=1e-9)


def test_the_default_regulator_holds_the_end(loop):
    _, motion, along = loop
    schedule = fflin.tvlqr(along, sample=0.1)
    policy = fflin.TrajectoryFeedback(motion.trajectory(), schedule)
    stop = policy.reference(np.inf)
    assert not stop[1].any()
    assert policy.end_gain.shape == schedule.K.shape[1:]


@pytest.mark.exhaustive
def test_coordinates_that_stop_in_a_motion_are_refused_with_the_time():
    """The slider of a strut stops where the knee is straight."""
    robot = strut(1.2, 0.9, 40.0)
    fflin.closed(robot, robot.neutral())
    q, v = fflin.closed(
        robot,
        fflin.configuration(robot, {"knee": 0.3, "shoe": -0.15, "slide": -0.02}),
        np.zeros(robot.nv),
    )
    motion = fflin.simulate(
        robot, q0=q, v0=v, duration=0.16, dt=0.004, every=10, engine="python"
    )
    knee = motion.q[:, robot.joint("knee").idx_q]
    assert knee[-1] < 0.0 < knee[0]
    flown_motion = motion.trajectory()
    along = fflin.linearize_trajectory(robot, flown_motion, independent=["knee"])
    assert len(along.state_names) == 2
    with pytest.raises(fflin.ConstraintError, match=r"q_m\.slide.*between t = "):
        fflin.linearize_trajectory(robot, flown_motion, independent=["slide"])
