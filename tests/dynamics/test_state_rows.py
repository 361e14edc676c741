"""What feedback reads off q and v, and how steps are put together, by other routes."""

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.dynamics.coordinates import unwound
from fflin.dynamics.integrators import integrator
from fflin.dynamics.state_rows import moving_error, state_history, states_of
from tests.support.marks import exhaustive
from tests.support.robots import BUNDLED, FRAMES, random_pose
from tests.support.weights import unit_weights


def anywhere(robot, rng):
    """A configuration at any turn of the base, both signs of its quaternion, and a velocity."""
    joints = dict(
        zip(robot.joint_names, rng.uniform(-3.0, 3.0, size=robot.n), strict=True)
    )
    q = fflin.configuration(robot, joints, random_pose(rng, 150.0))
    q[3:7] *= rng.choice([-1.0, 1.0])
    return q, fflin.StateMap(robot).spread(rng.normal(size=6 + robot.n))


@pytest.mark.parametrize("frame", FRAMES)
@pytest.mark.parametrize("name", [*BUNDLED, "tiago_dual"])
def test_feedback_reads_the_state_whose_angles_are_near(name, frame):
    robot = fflin.load(name)
    rng = np.random.default_rng(5)
    state = fflin.StateMap(robot, reference=random_pose(rng, 20.0), frame=frame)
    near = 5.0 * rng.normal(size=state.nx)
    for _ in range(10):
        q, v = anywhere(robot, rng)
        joints = 6 + state.unbounded
        x = unwound(states_of(state, q, state.velocities(v)), joints, near)
        np.testing.assert_allclose(x, state.to_state(q, v, near=near), atol=1e-12)
        apart = (x - near)[6 + state.unbounded]
        assert (np.abs(apart) <= np.pi + 1e-12).all()


@pytest.mark.parametrize("name", ["ets_vii", "servicer_7dof", "tiago_dual"])
def test_a_small_error_of_a_joint_keeps_its_accuracy(name):
    robot, rng = fflin.load(name), np.random.default_rng(2)
    state, at = fflin.StateMap(robot, frame="local"), slice(6, 6 + robot.n)
    for size in (1e-9, 1e-8, 1e-3, 2.0):
        q, v = anywhere(robot, rng)
        apart = size * rng.uniform(-1.0, 1.0, size=robot.n)
        turned = dict(
            zip(robot.joint_names, state.joint_positions(q) + apart, strict=True)
        )
        other = fflin.configuration(robot, turned)
        e = moving_error(state, q, v, other, v)[at]
        np.testing.assert_allclose(e, apart, rtol=0, atol=2e-15)


@pytest.mark.parametrize("frame", FRAMES)
@pytest.mark.parametrize("name", BUNDLED)
def test_rows_of_a_motion_are_its_states(name, frame):
    robot = fflin.load(name)
    rng = np.random.default_rng(6)
    state = fflin.StateMap(robot, reference=random_pose(rng, 20.0), frame=frame)
    q, v = map(np.array, zip(*(anywhere(robot, rng) for _ in range(12)), strict=True))
    near = 5.0 * rng.normal(size=state.nx)
    rows = state_history(state, q, v, near)
    for row, q_i, v_i in zip(rows, q, v, strict=True):
        near = state.to_state(q_i, v_i, near=near)
        np.testing.assert_allclose(row, near, atol=1e-13)


def test_rates_tell_the_turns_between_rows():
    robot = fflin.load("planar_detumble")
    state, t = fflin.StateMap(robot), np.linspace(0.0, 2.0, 5)
    rates = np.outer(1.0 + t, (40.0, -60.0, 0.5))
    angles = np.outer(t + 0.5 * t**2, (40.0, -60.0, 0.5))
    q = [
        fflin.configuration(robot, dict(zip(robot.joint_names, a, strict=True)))
        for a in angles
    ]
    v = np.hstack((np.zeros((5, 6)), rates))
    result = state_history(state, np.array(q), v, t=t)[:, state.groups.q_m]
    np.testing.assert_allclose(result, angles, atol=1e-12)


def test_cf4_is_the_published_scheme():
    # q2 = I(q, h/2 k1), q3 = I(q, h/2 k2), q4 = I(q2, h (k3 - k1/2)), then two exponentials.
    robot = fflin.load("servicer_7dof")
    model, data = robot.model, robot.create_data()
    q, v = anywhere(robot, np.random.default_rng(7))
    h, move = 0.05, pin.integrate
    times = []

    def f(t, q, v):
        times.append(t)
        return pin.aba(model, data, q, v, np.full(model.nv, np.cos(t))).copy()

    k1, l1 = v, f(1.0, q, v)
    q2, k2 = move(model, q, h / 2 * k1), v + h / 2 * l1
    l2 = f(1.0 + h / 2, q2, k2)
    q3, k3 = move(model, q, h / 2 * k2), v + h / 2 * l2
    l3 = f(1.0 + h / 2, q3, k3)
    q4, k4 = move(model, q2, h * (k3 - k1 / 2)), v + h * l3
    l4 = f(1.0 + h, q4, k4)
    half = move(model, q, h / 12 * (3 * k1 + 2 * k2 + 2 * k3 - k4))
    expected = move(model, half, h / 12 * (-k1 + 2 * k2 + 2 * k3 + 3 * k4))
    step = integrator("cf4")(model, h).step
    for _ in range(2):  # the work space of the first step does not reach the second
        found_q, found_v = step(f, 1.0, q, v)
        np.testing.assert_allclose(found_q, expected, rtol=0.0, atol=1e-14)
        np.testing.assert_allclose(
            found_v, v + h / 6 * (l1 + 2 * l2 + 2 * l3 + l4), atol=1e-14
        )
    assert times[:4] == times[4:8]


def test_a_policy_may_keep_its_arguments():
    robot = fflin.load("servicer_7dof")
    _, v0 = anywhere(robot, np.random.default_rng(8))
    kept = []

    def policy(t, q, v):
        kept.append((q, v, q.copy(), v.copy()))
        return np.zeros(6 + robot.n)

    def push(t, q, v):
        return policy(t, q, v)[: robot.nv]

    calls = []

    def count(t, q, v, u):
        calls.append(len(kept))

    fflin.simulate(
        robot,
        policy,
        v0=0.1 * v0,
        duration=0.05,
        dt=0.01,
        disturbance=push,
        callback=count,
    )
    # Before the run, the functions are called to choose the step. In each step they are called at
    # four stages.
    assert np.diff(calls)[:-1].tolist() == [8] * 4
    assert all(
        (q == q_then).all() and (v == v_then).all() for q, v, q_then, v_then in kept
    )


def test_a_rotor_may_spin_fast_and_a_link_may_not():
    # A turn of 6 rad in a step: nothing depends on a rotor's angle. Its motor turns the body
    # about the same axis: with J of wheel and the whole about z, M^-1 says by how much.
    body = fflin.load("cubesat")
    wheel = fflin.ReactionWheel((0, 0, 1), inertia=1e-4)
    robot = body.replace(inputs=[wheel])
    v0 = fflin.velocity(robot, {"wheel_1": 600.0})
    motion = fflin.simulate(robot, lambda t, q, v: [1e-4], v0=v0, duration=1.0, dt=0.01)
    assert not motion.stopped
    # Motor torque 1e-4 N m on 1e-4 kg m^2: 1 rad/s^2 in inertial axes.
    speed = motion.v[-1, 6] + motion.v[-1, 5]
    assert speed == pytest.approx(601.0, abs=1e-3)
    assert motion.momentum_drift.max() < 1e-14
    arm = fflin.load("canadarm2")
    fast = fflin.velocity(arm, {arm.joint_names[0]: 600.0})
    assert "diverged" in fflin.simulate(arm, v0=fast, duration=1.0, dt=0.01).stopped


@pytest.mark.exhaustive
def test_momentum_is_kept_far_away():
    # In orbit about the Earth's centre, where angular momentum about the origin has no digits.
    robot = fflin.load("servicer_7dof")
    q, v = anywhere(robot, np.random.default_rng(9))
    q[:3] += (7e6, 1e6, -2e6)
    motion = fflin.simulate(robot, q0=q, v0=0.2 * v, duration=1.0, dt=0.01)
    # Of a place at 7e6 m the digits end at 1e-9 m.
    assert motion.momentum_drift.max() < 1e-9
    np.testing.assert_allclose(
        motion.momentum, np.tile(motion.momentum[:1], (101, 1)), atol=1e-8
    )


def test_energy_counts_gravity_and_springs_from_where_they_are_zero():
    model = fflin.load("servicer_7dof").model.copy()
    model.jointPlacements[1] = random_pose(np.random.default_rng(3), 40.0)
    robot = fflin.from_model(model, gravity=(0.3, -0.2, -1.5), stiffness=20.0)
    q, v = anywhere(robot, np.random.default_rng(10))
    motion = fflin.simulate(robot, q0=q, v0=0.2 * v, duration=0.2, dt=0.0005)
    data = robot.create_data()
    pin.centerOfMass(robot.model, data, q)
    height = robot.mass * np.dot(robot.gravity, data.com[0])
    angles = np.array([joint.value(q) for joint in robot.joints])
    expected = pin.computeKineticEnergy(robot.model, data, q, 0.2 * v) - height
    expected += 10.0 * float(angles @ angles)
    assert motion.energy[0] == pytest.approx(expected, rel=1e-12)
    np.testing.assert_allclose(motion.energy, expected, rtol=1e-7)


def test_a_loop_that_rotates_past_half_a_turn_says_when():
    # No feedback at all, and a turn of 1 rad/s: half a turn after pi seconds.
    robot = fflin.load("cubesat")
    lin = fflin.linearize(robot)
    nothing = fflin.StateFeedback(lin, np.zeros(lin.B.T.shape))
    v0 = fflin.velocity(robot, {"omega_b.z": 1.0})
    motion = fflin.simulate(robot, nothing, v0=v0, duration=10.0, dt=0.01)
    assert motion.stopped == "" and motion.t[-1] == pytest.approx(10.0)
    assert motion.linear is None
    [note] = motion.notes
    assert note == (
        "the base rotated past 180 deg from the reference at t = 3.15 s; "
        "the linear prediction is omitted, because it does not hold there"
    )
    assert not fflin.simulate(robot, nothing, v0=v0, duration=10.0, linear=False).notes
    # The angle t is the same rotation as t - 2 pi, and q_b is of the shorter one.
    angle = np.mod(motion.t + np.pi, 2.0 * np.pi) - np.pi
    np.testing.assert_allclose(motion.x[:, 2], np.sin(angle / 2.0), atol=1e-12)
    np.testing.assert_allclose(
        motion.attitude_error, np.degrees(np.abs(angle)), atol=1e-5
    )


def bent(robot):
    """A model about a bent arm that is held against its springs, and a gain for it."""
    joints = dict.fromkeys(robot.joint_names, 0.4)
    q = fflin.configuration(robot, joints, random_pose(np.random.default_rng(11), 50.0))
    lin = fflin.linearize(robot, q, None, fflin.equilibrium(robot, q).u)
    return lin, fflin.lqr(lin, *unit_weights(lin))


@pytest.mark.parametrize("sample", [None, *exhaustive(0.02)])
def test_loop_about_a_bent_point_comes_to_it_and_differs_in_second_order(sample):
    robot = fflin.load("ets_vii", stiffness=3.0)
    lin, gain = bent(robot)
    assert np.abs(lin.u0).max() > 1.0 and np.abs(lin.x0).max() > 0.3
    policy = fflin.StateFeedback(lin, gain.K)

    def run(size, duration):
        x0 = lin.x0 + size * np.cos(np.arange(len(lin.x0)))
        options = {"duration": duration, "dt": sample or 0.04, "sample": sample}
        return fflin.simulate(robot, policy, x0=x0, **options)

    # What the two models differ by over the displacement halves with it.
    apart = []
    for size in (2e-4, 1e-4):
        motion = run(size, 2.0)
        apart.append(np.abs(motion.x - motion.linear).max() / size)
    assert apart[0] < 0.005
    assert apart[0] / apart[1] == pytest.approx(2.0, abs=0.02)
    end = run(0.02, 60.0)
    assert np.abs(end.error[-1]).max() < 1e-6
    np.testing.assert_allclose(end.u[-1], lin.u0, atol=1e-3)


def test_the_error_from_a_moving_reference_has_the_difference_of_the_velocities():
    """The reference itself has no error, and an error of the velocities is read back."""
    robot = fflin.load("servicer_7dof")
    state = fflin.StateMap(robot, frame="local")
    rng = np.random.default_rng(2)
    q = fflin.configuration(robot, {"joint_1": 0.4})
    v_star, change = rng.normal(size=(2, robot.nv))
    assert not moving_error(state, q, v_star, q, v_star).any()
    error = moving_error(state, q, v_star, q, v_star + change)
    expected = state.velocities(change)
    np.testing.assert_allclose(error[-len(expected) :], expected, atol=1e-14)
    assert not error[: -len(expected)].any()
