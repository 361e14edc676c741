"""Plans of robots with constraints, and their tracking."""

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.dynamics.closure import Closure
from tests.support.constrained import Build, at
from tests.support.marks import exhaustive
from tests.support.messages import any_wording

LEVER = 0.5


@pytest.fixture(scope="module")
def door():
    """A body on a hinge of inertial space, at a distance of 0.5 m from the base's origin."""
    build = Build(pin.Inertia(8.0, np.zeros(3), np.diag((1.0, 1.5, 2.0))))
    build.frame("edge", build.base, at(x=-LEVER))
    robot = build.robot("door", constraints=[fflin.Hinge("edge")])
    fflin.closed(robot, robot.neutral())
    return robot


def opened(robot, angle):
    turn = pin.AngleAxis(angle, np.array((0.0, 0.0, 1.0))).matrix()
    place = turn @ np.array((LEVER, 0.0, 0.0)) - np.array((LEVER, 0.0, 0.0))
    return fflin.configuration(robot, base=pin.SE3(turn, place))


def off(robot, motion):
    """The largest residual of positions, and of velocities, at the knots of a motion."""
    rows = Closure(fflin.StateMap(robot)).constraints
    residual = max(np.abs(rows.residual(q)).max() for q in motion.q)
    pairs = zip(motion.q, motion.v, strict=True)
    return residual, max(np.abs(rows.jacobian(q) @ v).max() for q, v in pairs)


@pytest.mark.parametrize("angle", [0.4, *exhaustive(-2.0, 3.1)])
@pytest.mark.exhaustive
def test_the_least_effort_about_a_hinge_has_the_closed_form(door, angle):
    """Torque and force share the moment M about the hinge as (1, lever) M / (1 + lever^2). Held
    over N steps of h, M = 6 J angle (N - 1 - 2 k) / (h^2 N (N^2 - 1)) with J about the hinge."""
    count, h = 3, 2.0
    inertia = 2.0 + 8.0 * LEVER**2
    goal = opened(door, angle)
    motion = fflin.plan(
        *(door, (goal, None), count * h),
        q0=door.neutral(),
        knots=count + 1,
        limits=None,
        R=1.0,
    )
    k = np.arange(count)
    moment = (
        6.0 * inertia * angle * (count - 1 - 2 * k) / (h**2 * count * (count**2 - 1))
    )
    exact = np.zeros((count, 6))
    exact[:, 2] = moment / (1.0 + LEVER**2)
    exact[:, 4] = LEVER * exact[:, 2]
    size = np.abs(moment).max()
    np.testing.assert_allclose(motion.u[:-1], exact, atol=1e-6 * size)
    assert max(off(door, motion)) < 1e-9
    assert motion.residual.max() < 1e-8
    assert (motion.q[-1] == goal).all() and not motion.v[-1].any()


@pytest.mark.exhaustive
def test_a_plan_leaves_open_what_the_constraints_do_not_determine(door):
    """Only the attitude is prescribed, so the base's position and all rates follow or are free."""
    free = ["r_b", "omega_b", "v_b"]
    motion = fflin.plan(
        *(door, (opened(door, 1.0), None), 4.0),
        q0=door.neutral(),
        knots=4,
        free=free,
        R=1.0,
    )
    way = pin.difference(door.model, opened(door, 1.0), motion.q[-1])
    assert np.abs(way).max() < 1e-6
    assert np.abs(motion.v[-1]).max() > 0.1


def test_a_start_or_goal_that_violates_a_constraint_is_refused(door):
    apart = fflin.configuration(door, base=at(x=0.1))
    with any_wording(), pytest.raises(fflin.ConstraintError, match=r"goal.*edge"):
        fflin.plan(door, (apart, None), 4.0, q0=door.neutral())
    with any_wording(), pytest.raises(fflin.ConstraintError, match=r"start.*edge"):
        fflin.plan(door, (opened(door, 1.0), None), 4.0, q0=apart)


@pytest.fixture(scope="module")
def mast():
    """A scissor mast, and its configuration after deployment."""
    robot = fflin.load("scissor_mast")
    fflin.closed(robot, robot.neutral())
    return robot, fflin.sweep(robot, fflin.grid(robot, {"bar_3": [0.3]})).q[0]


@pytest.mark.exhaustive
def test_a_mast_deploys_within_limits_and_a_regulator_tracks_it(mast):
    """The speed limit of the slider, a joint that is no independent coordinate, is reached."""
    robot, goal = mast
    motion = fflin.plan(
        *(robot, (goal, None), 20.0),
        q0=robot.neutral(),
        knots=6,
        limits={"qdot_m.slider": 0.0065, "tau_m": 3.0},
    )
    assert max(off(robot, motion)) < 1e-9
    assert motion.optimality.stationary
    slider = motion.v[:, robot.joint("slider").idx_v]
    assert np.abs(slider).max() == pytest.approx(0.0065, rel=0.01)
    along = fflin.linearize_trajectory(robot, motion)
    schedule = fflin.tvlqr(along, sample=0.5)
    rates = {"omega_b.z": 1e-3, "v_b.x": 1e-3}
    q0, v0 = fflin.closed(robot, motion.q[0], fflin.velocity(robot, rates))
    flown = fflin.simulate(robot, schedule, q0=q0, v0=v0, engine="python")
    way = pin.difference(robot.model, flown.q[-1], goal)
    drift = fflin.simulate(robot, None, q0=q0, v0=v0, duration=20.0, engine="python")
    lost = pin.difference(robot.model, drift.q[-1], robot.neutral())
    assert np.abs(way).max() < 0.05 * np.abs(lost).max()


@pytest.mark.exhaustive
def test_two_arms_move_the_target_that_they_hold():
    robot = fflin.load("grasped_target")
    fflin.closed(robot, robot.neutral())
    grid = fflin.grid(robot, {"left_1": [0.02]}, joints={"left_2": -0.02})
    goal = fflin.sweep(robot, grid).q[0]
    motion = fflin.plan(robot, (goal, None), 9.0, q0=robot.neutral(), knots=4)
    assert max(off(robot, motion)) < 1e-9
    assert motion.residual.max() < 1e-6
    assert (motion.q[-1] == goal).all() and not motion.v[-1].any()
    schedule = fflin.tvlqr(fflin.linearize_trajectory(robot, motion), sample=3.0)
    flown = fflin.simulate(robot, schedule, q0=motion.q[0], dt=0.03, engine="python")
    way = pin.difference(robot.model, flown.q[-1], goal)
    assert np.abs(way).max() < 2e-5


@pytest.mark.exhaustive
def test_a_planned_phase_is_followed_by_a_phase_that_holds_the_goal(mast):
    robot, _ = mast
    goal = fflin.sweep(robot, fflin.grid(robot, {"bar_3": [0.1]})).q[0]
    motion = fflin.plan(robot, (goal, None), 9.0, q0=robot.neutral(), knots=4)
    law = fflin.tvlqr(fflin.linearize_trajectory(robot, motion), sample=3.0)
    moved = fflin.simulate(robot, law, q0=motion.q[0], engine="python")
    lin = fflin.linearize(robot, goal, frame="local")
    hold = fflin.StateFeedback(lin, fflin.lqr(lin).K)
    q0, v0 = moved.q[-1], moved.v[-1]
    held = fflin.simulate(
        robot, hold, q0=q0, v0=v0, duration=1.0, dt=0.02, engine="python"
    )
    whole = moved.then(held)
    assert whole.t[-1] == pytest.approx(10.0)
    assert np.abs(pin.difference(robot.model, whole.q[-1], goal)).max() < 1e-7
