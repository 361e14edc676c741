"""Motions on the manifold: closed forms, orders, conservation laws, and what must be refused."""

import itertools
import math

import numpy as np
import pinocchio as pin
import pytest

import fflin
from tests.support.motions import displaced, regulated, strong_thrusters
from tests.support.robots import BUNDLED, free_body, mostly
from tests.support.weights import unit_weights


def tumbling(robot, seed=0, size=0.4):
    rng = np.random.default_rng(seed)
    state = fflin.StateMap(robot)
    q = fflin.configuration(
        robot, dict(zip(robot.joint_names, rng.normal(size=robot.n), strict=True))
    )
    return q, size * state.spread(rng.normal(size=6 + robot.n))


@pytest.mark.exhaustive
@pytest.mark.parametrize(("project", "accuracy"), [(False, 1e-12), (True, 1e-11)])
def test_torque_free_axisymmetric_body_turns_as_the_closed_form_says(project, accuracy):
    # Andrle and Crassidis 2012: J = (a, a, c). With the momentum H in inertial axes
    # R(t) = exp(H t / a) exp(-(c - a)/a omega_3 e3 t); one hour in steps of 0.1 s. Keeping the
    # momentum in inertial axes turns the attitude's rounding into an error of the spin, which
    # adds up over 36,000 steps.
    a, c, duration = 200.0, 100.0, 3600.0
    robot = free_body((a, a, c))
    omega = np.array([0.05, 0.0, 0.01])
    v0 = np.concatenate((np.zeros(3), omega))
    motion = fflin.simulate(
        robot, v0=v0, duration=duration, dt=0.1, every=360, project=project
    )
    H = np.diag([a, a, c]) @ omega
    for t, q in zip(motion.t, motion.q, strict=True):
        spin = np.array([0.0, 0.0, -(c - a) / a * omega[2] * t])
        R = pin.exp3(H * t / a) @ pin.exp3(spin)
        apart = pin.log3(R.T @ pin.XYZQUATToSE3(q).rotation)
        assert np.linalg.norm(apart) < accuracy


@pytest.mark.parametrize(
    ("method", "order"), [("cf4", 4.0), ("semi_implicit_euler", 1.0)]
)
@pytest.mark.parametrize("project", [True, False])
def test_order_of_the_methods(method, order, project):
    robot = fflin.load("canadarm2")
    q0, v0 = tumbling(robot)

    def end(dt, method=method):
        return fflin.simulate(
            robot, q0=q0, v0=v0, duration=0.8, dt=dt, method=method, project=project
        )

    exact = end(0.0005, "cf4")
    steps = (0.04, 0.02, 0.01) if order > 1.0 else (0.004, 0.002, 0.001)
    errors = []
    for dt in steps:
        motion = end(dt)
        apart = pin.difference(robot.model, exact.q[-1], motion.q[-1])
        errors.append(
            np.linalg.norm(np.concatenate((apart, motion.v[-1] - exact.v[-1])))
        )
    slopes = np.diff(np.log2(errors)) / -1.0
    assert slopes[-1] == pytest.approx(order, abs=0.1)


def test_the_order_is_four_under_a_feedback_and_a_disturbance_too():
    robot, lin, gain = regulated("ets_vii")

    def push(t, q, v):
        force = np.zeros(robot.nv)
        force[:] = 0.2 * np.cos(t + np.arange(robot.nv))
        return force

    ends = [
        fflin.simulate(
            robot,
            fflin.StateFeedback(lin, gain.K),
            x0=displaced(lin),
            duration=1.2,
            dt=dt,
            disturbance=push,
        ).x[-1]
        for dt in (0.08, 0.04, 0.02)
    ]
    first, second = (np.linalg.norm(a - b) for a, b in itertools.pairwise(ends))
    assert first / second == pytest.approx(16.0, rel=0.2)


@pytest.mark.parametrize("name", BUNDLED)
def test_momentum_and_energy_of_a_free_robot_are_conserved(name):
    robot = fflin.load(name)
    q0, v0 = tumbling(robot, size=0.2)
    motion = fflin.simulate(robot, q0=q0, v0=v0, duration=2.0, dt=0.005, every=4)
    assert motion.momentum_drift.max() < 1e-14
    np.testing.assert_allclose(
        motion.momentum,
        motion.momentum[:1] + 0 * motion.momentum,
        atol=1e-12 * np.abs(motion.momentum).max(),
    )
    assert np.ptp(motion.energy) < 1e-7 * motion.energy[0]
    # The centre of mass goes straight on.
    data = robot.create_data()
    com = np.array([pin.centerOfMass(robot.model, data, q).copy() for q in motion.q])
    straight = com[0] + motion.t[:, None] * motion.momentum[0, 3:] / robot.mass
    np.testing.assert_allclose(com, straight, atol=1e-9)


def test_projection_conserves_the_momentum():
    robot = fflin.load("servicer_7dof")
    q0, v0 = tumbling(robot, size=1.0)
    options = {"q0": q0, "v0": v0, "duration": 4.0, "dt": 0.02}
    kept = fflin.simulate(robot, **options).momentum_drift
    lost = fflin.simulate(robot, project=False, **options).momentum_drift
    assert np.abs(np.diff(kept)).max() < 1e-14
    assert kept.max() < 1e-14 < 1e-10 < lost.max()


@pytest.mark.parametrize("frame", mostly(["hybrid", "local", "world"], "local"))
def test_momentum_follows_the_impulse_of_wrenches_thrusters_wheels_and_gravity(frame):
    robot = fflin.load("servicer_7dof").replace(
        inputs=[
            fflin.BaseTorque(),
            fflin.BaseForce(),
            fflin.JointTorque("joint_2"),
            fflin.Thruster("tool", (0.1, 0, 0), (0.3, 0.2, 1.0)),
            fflin.ReactionWheel((0, 1, 1), momentum=30.0),
            fflin.ReactionWheel((1, 0, 0), inertia=0.03),
        ],
        gravity=(0.0, 0.1, -0.3),
        stiffness={"panel_left": 50.0},
    )
    q0, v0 = tumbling(robot)
    u = np.array([5.0, -3, 2, 10, 4, -6, 1.5, 8.0, 0.4, -0.2])
    push = np.zeros(robot.nv)
    push[:6] = 1.0, -2.0, 3.0, 0.5, -0.4, 0.2

    def motion(dt, project):
        return fflin.simulate(
            robot,
            lambda t, q, v: u * np.cos(t),
            q0=q0,
            v0=v0,
            duration=1.2,
            dt=dt,
            frame=frame,
            reference=pin.SE3(
                pin.exp3(np.array([0.3, -0.2, 0.5])), np.array([1.0, 2.0, 3.0])
            ),
            disturbance=lambda t, q, v: push,
            project=project,
        )

    kept, coarse, fine = motion(0.01, True), motion(0.01, False), motion(0.005, False)
    assert kept.momentum_drift.max() < 1e-13
    # Without the projection what is missing is the error of the method, of order four.
    ratio = coarse.momentum_drift[-1] / fine.momentum_drift[-1]
    assert 10.0 < ratio < 26.0
    # Linear momentum by hand: m g t + the turning thrust and wrench, at the fine step.
    fine = motion(0.0025, True)
    force = np.gradient(fine.momentum[:, 3:], fine.t, axis=0, edge_order=2)
    k = len(fine.t) // 2
    state = fflin.StateMap(robot, reference=fine.reference, frame=frame)
    data = robot.create_data()
    pin.framesForwardKinematics(robot.model, data, fine.q[k])
    tool = data.oMf[robot.model.getFrameId("tool")].rotation
    R = data.oMi[1].rotation
    axes = R if frame == "local" else fine.reference.rotation
    d = np.array([0.3, 0.2, 1.0]) / np.linalg.norm([0.3, 0.2, 1.0])
    acting = fine.u[k]
    expected = axes @ acting[3:6] + tool @ d * acting[7] + R @ push[:3]
    expected = expected + robot.mass * np.array(robot.gravity)
    np.testing.assert_allclose(force[k], expected, rtol=2e-4)
    assert state.names == fine.state_names


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", ["ets_vii", "servicer_7dof"])
def test_regulated_loop_converges_and_the_linear_model_predicts_it(name):
    robot, lin, gain = regulated(name)
    policy = fflin.StateFeedback(lin, gain.K)
    motion = fflin.simulate(robot, policy, x0=displaced(lin), duration=90.0, every=20)
    assert not motion.stopped
    assert np.abs(motion.error[-1]).max() < 1e-6
    assert motion.attitude_error[0] == pytest.approx(30.0, abs=1e-9)
    # Nearby the linear model foresees the nonlinear motion to second order.
    apart = []
    for share in (0.02, 0.01):
        near = lin.x0 + share * (displaced(lin) - lin.x0)
        small = fflin.simulate(robot, policy, x0=near, duration=4.0, every=10)
        apart.append(np.abs(small.x - small.linear).max())
    assert math.log2(apart[0] / apart[1]) == pytest.approx(2.0, abs=0.15)


def test_sampled_feedback_is_held_and_predicted():
    robot, lin, _ = regulated("ets_vii")
    sampled = lin.discretize(0.1)
    gain = fflin.lqr(sampled, *fflin.sampled_cost(lin, 0.1, *unit_weights(lin)))
    x0 = lin.x0 + 1e-4 * (displaced(lin) - lin.x0)
    policy = fflin.StateFeedback(sampled, gain.K)
    motion = fflin.simulate(robot, policy, x0=x0, duration=2.0, dt=0.02)
    changes = np.flatnonzero(np.abs(np.diff(motion.u, axis=0)).max(axis=1) > 0.0) + 1
    assert set(changes) <= set(range(0, 101, 5))
    assert len(changes) > 10
    # Asked for at the samples, the exact hold is what happens, but for terms of second order.
    rows = fflin.simulate(robot, policy, x0=x0, duration=2.0, dt=0.02, every=5)
    np.testing.assert_allclose(rows.x, rows.linear, atol=1e-7)
    np.testing.assert_array_equal(rows.x, motion.x[::5])


def test_a_delay_shifts_the_applied_inputs():
    robot = free_body((20.0, 30.0, 40.0))

    def ramp(t, q, v):
        return np.full(6, t)

    late = fflin.simulate(robot, ramp, duration=1.0, dt=0.05, sample=0.1, delay=0.2)
    acted = late.u[:-1, 0]
    times = late.t[:-1]
    expected = np.maximum(0.0, np.floor((times - 0.2) / 0.1 + 1e-9) * 0.1)
    np.testing.assert_allclose(acted, expected, atol=1e-12)


def test_limits_by_name_and_group_and_thrusters_never_pull():
    robot = fflin.load("cubesat", inputs=fflin.load_inputs("cubesat"))
    nu = len(robot.inputs)
    asked = np.linspace(-2.0, 2.0, nu)
    names = fflin.linearize(robot).input_names
    motion = fflin.simulate(
        robot,
        lambda t, q, v: asked,
        duration=0.002,
        dt=0.001,
        limits={"thrust": 0.5, "wheel_x": (-1e-3, 2e-3)},
    )
    acted = dict(zip(names, motion.u[0], strict=True))
    for name, value in zip(names, asked, strict=True):
        if name == "wheel_x":
            assert acted[name] == 2e-3
        elif name.startswith("wheel"):
            assert acted[name] == value
        else:
            assert acted[name] == min(max(value, 0.0), 0.5)


@pytest.mark.exhaustive
def test_allocation_gives_the_wrench_with_thrusts_that_push():
    design = fflin.load("cubesat", inputs=[fflin.BaseTorque(), fflin.BaseForce()])
    robot = design.replace(inputs=strong_thrusters())
    lin = fflin.linearize(design)
    gain = fflin.acceleration_lqr(lin, 0.04, 0.2, 1.0)
    policy = fflin.Allocation(fflin.StateFeedback(lin, gain.K), design)
    bound = policy.bind(robot)
    asked = fflin.StateFeedback(lin, gain.K).bind(design)
    rng = np.random.default_rng(0)
    for _ in range(20):
        q, v = fflin.StateMap(design).to_pinocchio(0.05 * rng.normal(size=12))
        thrust = bound(0.0, q, v)
        assert (thrust >= 0.0).all()
        at = fflin.linearize(robot, q, reference=lin.reference)
        held = fflin.linearize(design, q, reference=lin.reference)
        given, wanted = at.B @ thrust, held.B @ asked(0.0, q, v)
        np.testing.assert_allclose(given, wanted, atol=1e-9 * np.abs(wanted).max())
    x0 = np.zeros(12)
    x0[:6] = 0.1, -0.05, 0.08, 0.1, 0.2, -0.1
    motion = fflin.simulate(robot, policy, x0=x0, duration=60.0, dt=0.05, sample=0.1)
    assert (motion.u >= 0.0).all()
    assert np.abs(motion.x[-1]).max() < 2e-3
    (note,) = motion.notes
    assert note == "allocation: the commanded tau_b, F_b are realised by thrust"
    assert note in str(motion)
    # Attitude and position are those relative to the model's reference, wherever it starts.
    turned = fflin.configuration(
        robot, {}, pin.SE3(pin.rpy.rpyToMatrix(0.2, 0, 0), np.zeros(3))
    )
    motion = fflin.simulate(
        robot, policy, q0=turned, duration=60.0, dt=0.05, sample=0.1
    )
    assert motion.attitude_error[0] == pytest.approx(np.degrees(0.2))
    assert motion.attitude_error[-1] < 0.2
    # A model that is sampled says when the thrusters are told.
    sampled = lin.discretize(0.1)
    held = fflin.simulate(
        robot,
        fflin.Allocation(fflin.StateFeedback(sampled, gain.K), design),
        q0=turned,
        duration=1.0,
        dt=0.05,
    )
    assert (held.u[0:-1:2] == held.u[1::2]).all() and held.u[0].any()
    # The loop is the design's, whose fastest pole the step must follow.
    stiff = fflin.acceleration_lqr(lin, 1e4, 1e4, 1.0)
    with pytest.raises(fflin.InputError, match="too large for the pole at"):
        hasty = fflin.Allocation(fflin.StateFeedback(lin, stiff.K), design)
        fflin.simulate(robot, hasty, q0=turned, duration=5.0, dt=1.0)


@pytest.mark.exhaustive
def test_feedback_along_a_trajectory_brings_the_robot_back_to_it():
    robot = fflin.load("ets_vii")
    q0, v0 = tumbling(robot, size=0.05)
    u = 0.2 * np.ones(12)
    reference = fflin.simulate(
        robot,
        lambda t, q, v: u,
        q0=q0,
        v0=v0,
        duration=6.0,
        dt=0.01,
        frame="local",
        every=5,
        sample=6.0,
    )
    traj = fflin.linearize_trajectory(
        robot, reference.t, reference.q, reference.v, reference.u
    )
    lin = fflin.linearize(robot)
    Q, R = unit_weights(lin)
    schedule = fflin.tvlqr(traj, 10.0 * Q, R, 10.0 * Q)
    off = pin.integrate(robot.model, q0, 0.02 * np.ones(robot.nv))
    policy = fflin.TrajectoryFeedback(traj, schedule)
    led = fflin.simulate(
        robot, policy, q0=off, v0=v0, duration=6.0, dt=0.01, frame="local"
    )
    free = fflin.simulate(
        robot, lambda t, q, v: u, q0=off, v0=v0, duration=6.0, dt=0.01, frame="local"
    )
    apart = [
        np.abs(pin.difference(robot.model, reference.q[-1], motion.q[-1])).max()
        for motion in (led, free)
    ]
    assert apart[0] < 0.15 * apart[1]


def test_a_policy_of_the_user_can_follow_a_reference():
    robot = fflin.load("planar_detumble")
    q, v = fflin.configuration(robot, {"joint_1": 0.2}), np.zeros(robot.nv)

    class Following(fflin.Policy):
        @property
        def reference_motion(self):
            return lambda t: (q, v, np.zeros(9))

        def bind(self, robot):
            return lambda t, q, v: np.zeros(9)

    motion = fflin.simulate(robot, Following(), duration=0.5)
    assert (motion.q[0] == q).all() and motion.tracked
    assert np.abs(motion.target - motion.x).max() < 1e-12


def test_rows_are_kept_where_a_run_is_interrupted():
    robot = free_body((20.0, 30.0, 40.0))

    def policy(t, q, v):
        if t > 0.5:
            raise KeyboardInterrupt
        return np.ones(6)

    motion = fflin.simulate(robot, policy, duration=2.0, dt=0.1)
    assert motion.stopped.startswith("interrupted at t = 0.5 s")
    assert 5 <= len(motion.t) <= 7
    assert np.isfinite(motion.x).all()


def test_an_unstable_loop_stops_and_says_when(tmp_path):
    robot, lin, gain = regulated("ets_vii")
    policy = fflin.StateFeedback(lin, -0.05 * gain.K)
    motion = fflin.simulate(
        robot, policy, x0=displaced(lin, 5.0), duration=60.0, dt=0.01
    )
    assert motion.stopped.startswith(("left the chart at t", "diverged at t"))
    assert motion.t[-1] < 60.0
    motion.save(tmp_path / "m.npz")
    loaded = fflin.Motion.load(tmp_path / "m.npz")
    assert np.isfinite(loaded.x).all()
    assert loaded.stopped == motion.stopped


def test_an_event_ends_the_run():
    robot = free_body((20.0, 30.0, 40.0))

    def fence(t, q, v):
        return 0.5 - q[0]

    v0 = np.array([1.0, 0, 0, 0, 0, 0])
    motion = fflin.simulate(robot, v0=v0, duration=2.0, dt=0.01, events=[fence])
    assert motion.stopped == "fence at t = 0.5 s"
    assert motion.q[-1, 0] == pytest.approx(0.5)


def test_a_body_may_turn_beyond_180_degrees_without_a_policy():
    robot = free_body((20.0, 30.0, 40.0))
    v0 = np.array([0, 0, 0, 0, 0, math.pi])
    motion = fflin.simulate(robot, v0=v0, duration=2.0, dt=0.01, target=np.zeros(12))
    assert not motion.stopped
    assert motion.attitude_error.max() == pytest.approx(180.0, abs=1.0)
    assert motion.attitude_error[-1] == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("suffix", [".npz", ".mat", ".json"])
def test_motions_are_saved_and_loaded_to_the_last_bit(tmp_path, suffix):
    robot, lin, gain = regulated("planar_detumble")
    policy = fflin.StateFeedback(lin, gain.K)
    motion = fflin.simulate(robot, policy, x0=displaced(lin), duration=0.5, every=5)
    motion.save(tmp_path / f"m{suffix}")
    loaded = fflin.Motion.load(tmp_path / f"m{suffix}")
    for name in ("t", "q", "v", "x", "u", "target", "prediction", "energy", "momentum"):
        np.testing.assert_array_equal(getattr(loaded, name), getattr(motion, name))
    assert loaded.state_names == motion.state_names
    assert loaded.reference == motion.reference
    assert repr(loaded) == repr(motion)


def test_csv_has_names_and_rows(tmp_path):
    robot = free_body((20.0, 30.0, 40.0))
    motion = fflin.simulate(robot, duration=0.1, dt=0.05)
    motion.save(tmp_path / "m.csv")
    lines = (tmp_path / "m.csv").read_text().splitlines()
    names = lines[0].split(",")
    assert names[:3] == ["t [s]", "q_b.x", "q_b.y"] and "omega_b.x [rad/s]" in names
    assert names[-1] == f"u.{motion.input_names[-1]} [{motion.input_units[-1]}]"
    assert len(lines) == 4
    values = np.array([line.split(",") for line in lines[1:]], dtype=float)
    np.testing.assert_array_equal(
        values, np.column_stack((motion.t, motion.x, motion.u))
    )


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"duration": -1.0}, "duration"),
        ({"duration": 1.0, "dt": 0.0}, "dt"),
        ({"duration": 1.0, "method": "euler"}, "method"),
        ({"duration": 1.0, "dt": 0.1, "sample": 0.15}, "dt"),
        ({"duration": 1.0, "delay": -0.1}, "delay"),
        ({"duration": 1.0, "delay": 1e9}, "duration"),
        ({"duration": 1.0, "limits": {"tau_x": 1.0}}, "tau_x"),
        ({"duration": 1.0, "limits": -2.0}, "'tau_b'"),
        ({"duration": 1.0, "limits": {"tau_b": (1.0, -1.0)}}, "least, largest"),
        ({"duration": 1.0, "x0": np.zeros(5)}, "x"),
        ({"duration": 1.0, "x0": np.zeros(24), "v0": np.zeros(12)}, "either x0"),
        ({"duration": 1.0, "every": 0}, "every"),
        ({"duration": 1.0, "events": [3]}, "function"),
        (
            {"duration": 1.0, "disturbance": lambda t, q, v: [1.0]},
            "disturbance(t, q, v)",
        ),
        ({"duration": 1.0, "frame": "base"}, "frame"),
    ],
)
def test_invalid_input_is_one_clear_line(options, message):
    robot = fflin.load("ets_vii")
    with pytest.raises(fflin.FflinError, match=r"\w") as caught:
        fflin.simulate(robot, **options)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_policies_that_do_not_fit_are_refused():
    robot, lin, gain = regulated("ets_vii")
    other = fflin.load("canadarm2")
    with pytest.raises(fflin.InputError, match="'canadarm2'"):
        fflin.simulate(other, fflin.StateFeedback(lin, gain.K), duration=1.0)
    with pytest.raises(fflin.InputError, match=r"\bK\b.*shape"):
        fflin.StateFeedback(lin, gain.K.T)
    with pytest.raises(fflin.InputError, match="policy"):
        fflin.simulate(robot, 3, duration=1.0)
    with pytest.raises(fflin.InputError, match=r"\(3,\)"):
        fflin.simulate(robot, lambda t, q, v: np.zeros(3), duration=1.0)
    with pytest.raises(fflin.InputError, match="too large for the pole at"):
        fflin.simulate(robot, fflin.StateFeedback(lin, gain.K), duration=10.0, dt=2.0)
    moving = fflin.linearize(robot, moving=True)
    with pytest.raises(fflin.InputError, match="TrajectoryFeedback"):
        fflin.StateFeedback(moving, gain.K)


@pytest.mark.exhaustive
def test_a_wheel_may_turn_many_times_a_step():
    robot = fflin.load("cubesat", inputs=fflin.load_inputs("cubesat"))
    v0 = fflin.velocity(robot, {"wheel_x": 500.0, "omega_b.y": 0.01})
    motion = fflin.simulate(robot, v0=v0, duration=20.0, dt=0.02, every=50)
    assert not motion.stopped
    assert motion.momentum_drift.max() < 1e-14
    assert np.ptp(motion.energy) < 1e-9 * motion.energy[0]
    fine = fflin.simulate(robot, v0=v0, duration=20.0, dt=0.005, every=200)
    np.testing.assert_allclose(motion.v[:, 3:6], fine.v[:, 3:6], atol=1e-9)


@pytest.mark.parametrize("part, unstable", [(0.98, False), (1.02, True)])
def test_a_gain_that_is_sampled_too_slowly_is_reported(part, unstable):
    """Each axis is a double integrator with u = -J (w^2 angle + sqrt(2) w rate).

    By the criterion of Jury, its loop with commands held for h is stable if w h < sqrt(2).
    """
    w = 0.5
    robot = free_body((20.0, 30.0, 40.0)).replace(inputs=[fflin.BaseTorque()])
    lin = fflin.linearize(robot)
    J, K = np.diag((20.0, 30.0, 40.0)), np.zeros((3, 12))
    K[:, :3] = 2.0 * w**2 * J  # q_b is half of the angle
    K[:, 6:9] = np.sqrt(2.0) * w * J
    sample = part * np.sqrt(2.0) / w
    policy, options = (
        fflin.StateFeedback(lin, K),
        {"duration": 4 * sample, "dt": sample / 20},
    )
    assert not fflin.simulate(robot, policy, **options).notes
    notes = fflin.simulate(robot, policy, sample=sample, **options).notes
    assert any("sampled linear loop is unstable" in note for note in notes) == unstable
    # A gain that was designed for this sample time has the same loop, without the advice.
    notes = fflin.simulate(
        robot, fflin.StateFeedback(lin.discretize(sample), K), **options
    ).notes
    assert [
        note for note in notes if "unstable" in note and "held" not in note
    ] == list(notes)
    assert bool(notes) == unstable


def test_a_state_feedback_of_the_wrong_sign_is_reported():
    robot = free_body((20.0, 30.0, 40.0))
    lin = fflin.linearize(robot)
    policy = fflin.StateFeedback(lin, -fflin.lqr(lin).K)
    assert (
        "the linear loop is unstable"
        in fflin.simulate(robot, policy, duration=1.0).notes[0]
    )
