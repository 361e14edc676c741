"""Gains over a robot that is free, holds something, or has a joint that jammed."""

import numpy as np
import pinocchio as pin
import pytest

import fflin

BODY = pin.Inertia(200.0, np.array([0.0, 0.0, 0.3]), np.diag([30.0, 40.0, 50.0]))


@pytest.fixture(scope="module")
def pair():
    """A robot, and the same that holds another with panels of its own."""
    robot, payload = fflin.load("ets_vii"), fflin.load("servicer_7dof")
    payload = payload.replace(stiffness={"panel_*": 50.0}, damping={"panel_*": 5.0})
    payload = fflin.jam(payload, [f"joint_{k}" for k in range(1, 8)]).robot
    return robot, fflin.capture(robot, "tool", payload).robot


def test_states_and_inputs_are_matched_by_name(pair):
    free, held = (fflin.linearize(item) for item in pair)
    assert len(held.state_names) == len(free.state_names) + 4
    gain, other = fflin.lqr(free), fflin.lqr(held)
    K = fflin.line_up(gain, held)
    same = [held.state_names.index(name) for name in free.state_names]
    assert (K[:, same] == gain.K).all() and not np.delete(K, same, axis=1).any()
    assert (fflin.line_up(other, free) == other.K[:, same]).all()
    assert (fflin.line_up(gain, free) == gain.K).all()
    # A wrong order of names is not taken for the right one.
    assert not (K[:, : len(same)] == gain.K).all()
    policy = fflin.StateFeedback(held, K)
    v = fflin.velocity(pair[1], {"joint_2": 0.01})
    motion = fflin.simulate(pair[1], policy, v0=v, duration=2.0, dt=0.02)
    assert not motion.stopped


def test_a_joint_that_jammed_takes_its_row_and_columns_along(pair):
    robot = pair[0]
    gain, lin = (
        fflin.lqr(fflin.linearize(robot)),
        fflin.linearize(fflin.jam(robot, "joint_2").robot),
    )
    K = fflin.line_up(gain, lin)
    rows = [gain.input_names.index(name) for name in lin.input_names]
    columns = [gain.state_names.index(name) for name in lin.state_names]
    assert (K == gain.K[np.ix_(rows, columns)]).all() and len(rows) == len(
        gain.input_names
    ) - 1


def test_gains_between_masses_of_a_payload(pair):
    """At a mass on the grid the gain is that mass's own, and between two it regulates."""
    robot = pair[0]
    heavy = [
        fflin.capture(
            robot, "tool", pin.Inertia(x * 200.0, BODY.lever, x * BODY.inertia)
        )
        for x in (0.5, 1.0)
    ]
    models = [fflin.linearize(item) for item in (robot, *(c.robot for c in heavy))]
    K = np.stack([fflin.line_up(fflin.lqr(lin), models[1]) for lin in models])
    between = 0.5 * (K[0] + K[2])
    for item in (K[1], between):
        assert np.linalg.eigvals(models[1].A - models[1].B @ item).real.max() < 0.0


@pytest.fixture
def lined_up(pair):
    """A schedule of the robot alone, bound to the one that holds the payload, and its point."""
    robot, held = pair
    batch = fflin.sweep(
        robot, fflin.grid(robot, {"joint_2": np.linspace(-1.0, 1.0, 3)})
    )
    gains = fflin.lqr_batch(batch, 1.0, 1.0)
    q = fflin.configuration(held, {"joint_2": 0.5})
    return gains, fflin.ScheduledFeedback(fflin.linearize(held, q), gains), q


def test_a_schedule_over_joints_goes_on_after_the_catch(pair, lined_up):
    (robot, held), (gains, policy, q) = pair, lined_up
    u = policy.bind(held)(
        0.0, q, fflin.velocity(held, {"omega_b.x": 0.01, "joint_3": 0.1})
    )
    default = fflin.configuration(robot, {"joint_2": 0.5})
    free = fflin.ScheduledFeedback(fflin.linearize(robot, default), gains)
    v = fflin.velocity(robot, {"omega_b.x": 0.01, "joint_3": 0.1})
    assert u == pytest.approx(free.bind(robot)(0.0, default, v), abs=1e-14)


@pytest.mark.compiled
def test_a_schedule_that_goes_on_is_the_same_in_either_engine(pair, lined_up):
    (_, held), (_, policy, q) = pair, lined_up
    start = {
        "q0": q,
        "v0": fflin.velocity(held, {"joint_3": 0.01}),
        "duration": 0.2,
        "dt": 0.02,
    }
    motions = [
        fflin.simulate(held, policy, **start, engine=x) for x in ("python", "compiled")
    ]
    assert motions[0].x == pytest.approx(motions[1].x, abs=1e-12)


def test_models_that_cannot_be_matched_give_a_one_line_error(pair):
    free, held = (fflin.linearize(item) for item in pair)
    gain = fflin.lqr(free)
    other = fflin.linearize(fflin.load("panda"))
    mixed = fflin.linearize(fflin.jam(pair[1], "joint_2").robot)
    for call, message in [
        (lambda: fflin.line_up(gain, other), "lacks the"),
        (lambda: fflin.line_up(gain, mixed), "other"),
        (
            lambda: fflin.line_up(
                fflin.lqr(held), fflin.linearize(pair[1], frame="local")
            ),
            "frame",
        ),
        (lambda: fflin.line_up(gain, held.discretize(0.1)), "0.0"),
        (lambda: fflin.line_up(3, held), "Gain"),
        (lambda: fflin.line_up(gain, 3), "fflin.LinearModel"),
    ]:
        with pytest.raises(fflin.InputError, match=message) as error:
            call()
        assert "\n" not in str(error.value)
