"""Limits in a run: what they cut, what saturates, what fires in pulses, and what was passed."""

import math
import re
import warnings
from dataclasses import replace

import numpy as np
import pytest

import fflin
from tests.support.marks import exhaustive
from tests.support.messages import says
from tests.support.robots import free_body

AT = ("base", (0, 0, 0), (1, 0, 0))
INERTIA, SPEED = 0.02, 300.0


def spinner(**wheel):
    """A body with a wheel about z that stores up to INERTIA SPEED = 6 N m s."""
    options = {"inertia": INERTIA, "max_speed": SPEED, "max": 0.5} | wheel
    wheel = fflin.ReactionWheel((0, 0, 1), name="spin", **options)
    return free_body((20.0, 30.0, 40.0)).replace(inputs=[wheel])


def test_limits_of_the_robot_cut_and_given_ones_go_first():
    robot = fflin.load("servicer_7dof", limits={"tau_b": 40.0})
    u = np.full(15, 1e3)

    def acting(limits):
        motion = fflin.simulate(
            robot, lambda t, q, v: u, duration=2e-4, dt=1e-4, limits=limits
        )
        known = dict(zip(motion.limit_names, motion.limits.tolist(), strict=True))
        assert motion.limits.shape == (len(known), 2)
        return dict(zip(motion.input_names, motion.u[0], strict=True)), known

    acted, known = acting(None)
    assert set(acted.values()) == {1e3}
    assert known["tau_b.x"] == [-40.0, 40.0]
    assert known["tau_m.joint_5"] == [-100.0, 100.0]
    assert known["qdot_m.joint_5"] == [-0.4, 0.4]
    assert "F_b.x" not in known
    acted, _ = acting("urdf")
    assert (acted["tau_b.x"], acted["F_b.x"]) == (40.0, 1e3)
    assert (acted["tau_m.joint_1"], acted["tau_m.panel_left"]) == (300.0, 50.0)
    acted, known = acting(["urdf", {"joint_1": 7.0, "F_b": (-1.0, 2.0)}])
    assert (acted["tau_m.joint_1"], acted["tau_m.joint_2"], acted["F_b.y"]) == (
        7.0,
        300.0,
        2.0,
    )
    assert known["F_b.z"] == [-1.0, 2.0]
    assert known["tau_m.joint_1"] == [-7.0, 7.0]
    acted, known = acting({"joint_1": 7.0})
    assert (acted["tau_m.joint_1"], acted["tau_m.joint_2"]) == (7.0, 1e3)
    assert known["tau_m.joint_1"] == [-7.0, 7.0]
    acted, _ = acting(5.0)
    assert set(acted.values()) == {5.0}


@pytest.mark.parametrize(
    ("method", "sample", "sign"),
    [
        ("cf4", None, 1.0),
        ("semi_implicit_euler", 0.5, -1.0),
        *exhaustive(
            ("cf4", None, -1.0),
            ("cf4", 0.5, 1.0),
            ("cf4", 0.5, -1.0),
            ("semi_implicit_euler", None, 1.0),
            ("semi_implicit_euler", None, -1.0),
            ("semi_implicit_euler", 0.5, 1.0),
        ),
    ],
)
def test_a_wheel_saturates_and_no_momentum_is_lost(sign, sample, method):
    robot = spinner()
    motion = fflin.simulate(
        robot,
        lambda t, q, v: [sign],
        duration=20.0,
        sample=sample,
        method=method,
        limits="urdf",
    )
    speed = motion.x[:, motion.state_names.index("qdot_m.spin")]
    assert np.abs(speed).max() <= SPEED * (1.0 + 1e-12)
    assert speed[-1] == pytest.approx(sign * SPEED, rel=1e-9)
    # Until then the motor gives what it can: 0.5 N m for about 12 s.
    assert motion.u[0, 0] == 0.5 * sign
    full = np.abs(motion.u[:, 0]) == 0.5
    J = 1.0 / (1.0 / INERTIA + 1.0 / (40.0 - INERTIA))
    assert motion.t[full][-1] == pytest.approx(J * SPEED / 0.5, abs=0.02)
    assert np.abs(motion.u[-10:, 0]).max() < 1e-9
    assert motion.momentum_drift.max() < 1e-14
    # All that the body has is the wheel's: H = 0.
    body = motion.x[-1, motion.state_names.index("omega_b.z")]
    assert (40.0 - INERTIA) * body == pytest.approx(
        -INERTIA * (sign * SPEED + body), rel=1e-9
    )
    messages = {item.name: item for item in motion.saturated}
    assert (
        messages["spin"].limit == 0.5 * sign
        and messages["qdot_m.spin"].limit == SPEED * sign
    )
    assert messages["spin"].share == pytest.approx(full.mean(), abs=1e-3)
    assert messages["qdot_m.spin"].share == pytest.approx(1.0 - full.mean(), abs=2e-3)
    assert not motion.passed


@pytest.mark.parametrize("torque", [0.0, 8.0])
def test_a_wheel_that_other_inputs_drive_beyond_its_limit_is_in_the_headline(torque):
    """The motor does not brake the wheel, so the body turns under it."""
    wheel = fflin.ReactionWheel(
        (0, 0, 1), name="spin", inertia=INERTIA, max_speed=2.0, max=0.5
    )
    robot = free_body((20.0, 30.0, 40.0)).replace(inputs=[fflin.BaseTorque(), wheel])
    v0 = fflin.velocity(robot, {"spin": 1.9})

    def push(t, q, v):
        return [0.0, 0.0, -torque, 0.0]

    run = {"v0": v0, "duration": 10.0, "dt": 0.1, "limits": "urdf"}
    free = fflin.simulate(robot, push, **run)
    motion = fflin.simulate(robot, push, target=fflin.linearize(robot).x0, **run)
    speed = motion.x[:, motion.state_names.index("qdot_m.spin")]
    # The wheel keeps its own rate, while the body turns the other way.
    body = torque / (40.0 - INERTIA) * motion.t
    np.testing.assert_allclose(speed, 1.9 + body, rtol=1e-9)
    exceeded = f"wheel speed limit exceeded: spin {speed[-1]:.3g} rad/s (limit 2)"
    for item in (motion, free, replace(motion, stopped="by hand")):
        headline = " ".join(str(item).partition("\nbody: ")[0].split())
        assert (exceeded in headline) == (torque > 0.0) == ("speed limit" in headline)


@pytest.mark.exhaustive
def test_the_attitude_is_lost_where_the_wheel_is_full():
    """A torque from outside of 0.1 N m fills 6 N m s in a minute; then the body turns."""
    robot = spinner()

    def hold(t, q, v):
        # What turns the wheel turns the body back.
        return [40.0 * (2.0 * 2.0 * q[5] + 2.0 * v[5])]

    def push(t, q, v):
        return [0, 0, 0, 0, 0, 0.1, 0]

    runs = {
        limits: fflin.simulate(
            robot, hold, duration=100.0, dt=0.05, limits=limits, disturbance=push
        )
        for limits in (None, "urdf")
    }
    angle = {
        limits: 2.0 * np.degrees(np.arcsin(run.x[:, 2])) for limits, run in runs.items()
    }
    early = runs["urdf"].t < 55.0
    np.testing.assert_allclose(angle["urdf"][early], angle[None][early], atol=1e-9)
    assert np.abs(angle[None]).max() < 0.1
    # 40 s of 0.1 N m on 40 kg m^2: 2 rad.
    assert angle["urdf"][-1] > 90.0
    for run in runs.values():
        assert run.momentum_drift.max() < 1e-13
    assert not runs["urdf"].passed
    (messages,) = runs[None].passed
    assert messages.name == "qdot_m.spin"
    assert messages.value == pytest.approx(500.0, rel=1e-2)
    assert says(str(messages), "spin 500 rad/s", "100 s", "300")


def test_the_linear_model_predicts_the_wheel_that_saturates():
    robot = spinner()
    lin = fflin.linearize(robot.replace(inputs=[*robot.inputs, fflin.BaseTorque()]))
    robot = robot.replace(inputs=[*robot.inputs, fflin.BaseTorque()])
    K = np.zeros((4, len(lin.x0)))
    K[0, lin.state_names.index("q_b.z")] = 8.0
    x0 = lin.x0.copy()
    x0[2] = math.sin(math.radians(0.5))
    x0[lin.state_names.index("qdot_m.spin")] = 299.0
    for model in (lin, lin.discretize(0.1)):
        motion = fflin.simulate(
            robot, fflin.StateFeedback(model, -K), x0=x0, duration=2.0, limits="urdf"
        )
        assert motion.u[0, 0] == pytest.approx(8.0 * x0[2])
        assert motion.x[-1, -1] == pytest.approx(SPEED, rel=1e-6)
        np.testing.assert_allclose(motion.linear[:, -1], motion.x[:, -1], atol=1e-3)


@pytest.mark.parametrize("asked", [0.0, 0.5, -0.2])
def test_a_wheel_beyond_its_largest_speed_accepts_only_braking_torque(asked):
    robot = spinner()
    motion = fflin.simulate(
        robot,
        lambda t, q, v: [asked],
        v0=fflin.velocity(robot, {"spin": 301.0}),
        duration=0.5,
        limits="urdf",
    )
    np.testing.assert_array_equal(motion.u[:, 0], min(asked, 0.0))
    messages = motion.passed[0]
    assert (messages.name, messages.value, messages.time, messages.limit) == (
        "qdot_m.spin",
        301.0,
        0.0,
        SPEED,
    )


def test_a_wheel_without_a_limit_of_its_torque_stops_at_its_largest_speed():
    robot = spinner(max=None)
    motion = fflin.simulate(robot, lambda t, q, v: [0.5], duration=20.0, limits="urdf")
    speed = motion.x[:, motion.state_names.index("qdot_m.spin")]
    assert motion.u[0, 0] == 0.5 and speed[-1] == pytest.approx(SPEED, rel=1e-9)
    assert speed.max() <= SPEED * (1.0 + 1e-12)


def test_each_of_three_wheels_stops_at_its_own_largest_speed():
    speeds, axes = (100.0, 200.0, 300.0), ((1, 0, 0), (0, 1, 0), (0, 0, 1))
    wheels = [
        fflin.ReactionWheel(
            axis, name=f"w_{speed:.0f}", inertia=INERTIA, max_speed=speed
        )
        for axis, speed in zip(axes, speeds, strict=True)
    ]
    robot = free_body((20.0, 30.0, 40.0)).replace(inputs=wheels)
    motion = fflin.simulate(
        robot, lambda t, q, v: [0.5] * 3, duration=15.0, limits="urdf"
    )
    rates = motion.x[:, [motion.state_names.index(f"qdot_m.w_{x:.0f}") for x in speeds]]
    # The body turns, so that each torque also changes the speeds of the other wheels a little.
    assert rates.max(axis=0) == pytest.approx(speeds, rel=1e-4)


def test_a_least_impulse_of_a_whole_sample_is_fired():
    thruster = fflin.Thruster(*AT, max=2.0, on_off=True, least_impulse=0.2)
    robot = free_body((20.0, 30.0, 40.0)).replace(inputs=[thruster])
    motion = fflin.simulate(
        robot, lambda t, q, v: [1.0], duration=0.4, dt=0.01, sample=0.1
    )
    assert motion.u[:-1, 0].tolist() == [*[0.0] * 10, *[2.0] * 10] * 2


def test_an_on_off_thruster_gives_its_own_thrust_whatever_the_run_allows():
    robot = free_body((20.0, 30.0, 40.0)).replace(
        inputs=[fflin.Thruster(*AT, max=2.0, on_off=True), fflin.BaseTorque()]
    )
    for limits, given in ((5.0, 2.0), (1.0, 1.0)):
        motion = fflin.simulate(
            robot,
            lambda t, q, v: [9.0, 0, 0, 0],
            duration=1.0,
            sample=0.1,
            limits=limits,
        )
        assert motion.u[:-1, 0].max() == given


def test_a_command_becomes_pulses_of_the_same_impulse():
    robot = free_body((20.0, 30.0, 40.0)).replace(
        inputs=[fflin.Thruster(*AT, max=2.0, on_off=True), fflin.BaseTorque()]
    )
    rng = np.random.default_rng(3)
    messages = np.column_stack((rng.uniform(-0.5, 2.5, 200), rng.normal(size=(200, 3))))
    motion = fflin.simulate(
        robot,
        lambda t, q, v: messages[round(t / 0.1)],
        duration=20.0,
        dt=0.01,
        sample=0.1,
    )
    thrust = motion.u[:-1, 0].reshape(200, 10)
    # One pulse from the beginning of each sample. Its last step has the mean thrust of this step.
    assert (np.diff(thrust, axis=1) <= 0.0).all()
    partial = (thrust > 0.0) & (thrust < 2.0)
    assert partial.sum(axis=1).max() == 1
    given = thrust.sum(axis=1) * 0.01
    asked = np.clip(messages[:, 0], 0.0, 2.0) * 0.1
    np.testing.assert_allclose(given, asked, rtol=0.0, atol=1e-14)
    given = given.cumsum()
    np.testing.assert_array_equal(motion.u[:-1:10, 1:], messages[:, 1:])
    assert robot.mass * motion.v[-1, :3] @ [1, 0, 0] < given[-1]
    assert motion.momentum_drift.max() < 1e-13


@pytest.mark.parametrize("on_off", [True, False])
def test_impulses_below_the_least_impulse_accumulate(on_off):
    thruster = fflin.Thruster(*AT, max=2.0, on_off=on_off, least_impulse=0.05)
    robot = free_body((20.0, 30.0, 40.0)).replace(inputs=[thruster])
    motion = fflin.simulate(
        robot, lambda t, q, v: [0.2], duration=2.0, dt=0.01, sample=0.1, limits="urdf"
    )
    impulse = motion.u[:-1, 0].reshape(20, 10).sum(axis=1) * 0.01
    # 0.02 N s a sample: fired at the third (0.06), and so on.
    assert set(np.round(impulse, 12)) == {0.0, 0.06}
    assert np.flatnonzero(impulse).tolist() == [2, 5, 8, 11, 14, 17]
    if on_off:
        assert set(motion.u[:, 0]) == {0.0, 2.0}
    else:
        assert motion.u[25, 0] == pytest.approx(0.6)


def test_pulses_are_delayed_and_begin_with_the_command_of_the_model():
    robot = free_body((20.0, 30.0, 40.0)).replace(
        inputs=[fflin.Thruster(*AT, max=1.0, on_off=True)]
    )
    lin = fflin.linearize(robot, u=[0.5]).discretize(0.1)
    K = np.zeros((1, 12))
    motion = fflin.simulate(
        robot, fflin.StateFeedback(lin, K), duration=1.0, dt=0.01, delay=0.2, x0=lin.x0
    )
    np.testing.assert_array_equal(
        motion.u[:-1, 0].reshape(10, 10)[:, 4:6], [[1.0, 0.0]] * 10
    )
    late = fflin.simulate(
        robot, lambda t, q, v: [0.4], duration=1.0, dt=0.01, sample=0.1, delay=0.15
    )
    assert not late.u[:15].any()
    np.testing.assert_array_equal(late.u[15:25, 0], [1.0] * 4 + [0.0] * 6)


def test_the_linear_model_predicts_pulses():
    robot = free_body((20.0, 30.0, 40.0)).replace(
        inputs=[fflin.Thruster(*AT, max=1.0, on_off=True), fflin.BaseTorque()]
    )
    lin = fflin.linearize(robot)
    K = np.zeros((4, 12))
    K[0, 3] = K[0, 9] = 5.0
    x0 = lin.x0.copy()
    x0[3] = -0.1
    for model in (lin.discretize(0.1), lin):
        options = {} if model.dt else {"sample": 0.1}
        policy = fflin.StateFeedback(model, K)
        motion = fflin.simulate(
            robot, policy, x0=x0, duration=5.0, limits="urdf", **options
        )
        assert set(motion.u[:, 0]) > {0.0, 1.0}
        np.testing.assert_allclose(motion.linear, motion.x, atol=1e-9)


@pytest.mark.parametrize(
    ("thruster", "options", "message"),
    [
        ({"on_off": True}, {}, "'thruster_1'"),
        ({"least_impulse": 0.1}, {}, "sample"),
        (
            {"on_off": True, "least_impulse": 0.5},
            {"sample": 0.1},
            "0.5 N s",
        ),
    ],
)
def test_pulses_without_samples_are_refused_in_one_line(thruster, options, message):
    robot = free_body((20.0, 30.0, 40.0))
    robot = robot.replace(inputs=[fflin.Thruster(*AT, max=2.0, **thruster)])
    with pytest.raises(fflin.InputError, match=message):
        fflin.simulate(
            robot, lambda t, q, v: [1.0], duration=1.0, limits="urdf", **options
        )
    fflin.simulate(robot, duration=0.1)


@pytest.mark.parametrize(
    ("limits", "error", "message"),
    [
        ("none", fflin.InputError, "'none'"),
        (["urdf", "x"], fflin.InputError, "'x'"),
        (["urdf", {"nosuch": 1}], fflin.UnknownNameError, "'nosuch'"),
        ({"tau_b": -1.0}, fflin.InputError, "-1.0"),
    ],
)
def test_invalid_limits_are_refused_in_one_line(limits, error, message):
    with pytest.raises(error, match=message):
        fflin.simulate(fflin.load("cubesat"), duration=0.1, limits=limits)


def test_violations_are_reported_with_value_time_and_limit():
    robot = fflin.load("canadarm2")
    asked = np.zeros(13)
    asked[8] = 4000.0

    def drive(t, q, v):
        return asked * math.cos(math.pi * t)

    run = fflin.simulate(robot, drive, duration=1.0)
    messages = {item.name: item for item in run.passed}
    torque = messages["tau_m.joint_3"]
    assert (torque.value, torque.time, torque.limit) == (4000.0, 0.0, 3000.0)
    assert str(torque) == "tau_m.joint_3 4000 N m at 0 s, limit 3000"
    speed = messages["qdot_m.joint_3"]
    rate = run.x[:, run.state_names.index("qdot_m.joint_3")]
    assert speed.value == rate[np.abs(rate).argmax()]
    assert speed.time == run.t[np.abs(rate).argmax()]
    assert re.fullmatch(r"joint_3 2\.\d+ rad/s at 0\.\d+ s, limit 0\.2", str(speed))
    # The farthest first.
    shares = [abs(item.value / item.limit) for item in run.passed]
    assert shares == sorted(shares, reverse=True)
    cut = fflin.simulate(robot, drive, duration=1.0, limits="urdf")
    assert "tau_m.joint_3" not in {item.name for item in cut.passed}
    low, high = sorted(cut.saturated, key=lambda item: item.limit)
    assert (low.limit, high.limit) == (-3000.0, 3000.0)
    at = math.acos(0.75) / math.pi
    assert high.share == pytest.approx(at, abs=0.011)
    assert low.share == pytest.approx(at, abs=0.011)
    assert re.fullmatch(
        r"tau_m\.joint_3 at its limit of 3000 N m for 2\d % of the run", str(high)
    )


def test_travel_is_a_limit_too():
    robot = fflin.load("servicer_7dof")
    v0 = fflin.velocity(robot, {"panel_left": 0.5, "panel_right": -0.1})
    (messages,) = fflin.simulate(robot, v0=v0, duration=2.0).passed
    assert messages.name == "q_m.panel_left"
    assert messages.limit == 0.6
    assert str(messages).startswith("panel_left ")
    assert says(str(messages), "rad", "2 s", "0.6")


@pytest.mark.parametrize("ending", [".npz", ".mat", ".json"])
def test_limits_are_saved_and_loaded_and_older_files_have_none(tmp_path, ending):
    robot = fflin.load("servicer_7dof", limits={"tau_b.x": (-1e9, 3.0)})
    robot = robot.replace(inputs=[*robot.inputs, fflin.Thruster(*AT)])
    motion = fflin.simulate(robot, duration=0.02)
    assert np.isinf(motion.limits).any()
    motion.save(tmp_path / f"m{ending}")
    result = fflin.Motion.load(tmp_path / f"m{ending}")
    assert result.limit_names == motion.limit_names
    np.testing.assert_array_equal(result.limits, motion.limits)
    bare = fflin.simulate(fflin.load("ets_vii"), duration=0.02)
    assert bare.limits.shape == (0, 2)
    bare.save(tmp_path / f"b{ending}")
    assert fflin.Motion.load(tmp_path / f"b{ending}").limits.shape == (0, 2)
    assert not bare.passed
    assert not bare.saturated


def held_up(**limits):
    """An arm under gravity, its model about the point where its inputs hold it, and their u."""
    robot = fflin.load("canadarm2", gravity=(0.0, 0.0, -0.05), limits=limits)
    q = fflin.configuration(robot, {"joint_2": 0.4})
    return robot, q, fflin.equilibrium(robot, q).u


def test_limits_that_cannot_hold_the_robot_are_reported_before_the_run():
    robot, q, u = held_up()
    names = fflin.linearize(robot).input_names
    most = int(np.abs(u[6:]).argmax()) + 6
    small = float(f"{0.5 * abs(u[most]):.3g}")
    robot, q, u = held_up(**{names[most]: small})
    lin = fflin.linearize(robot, q, u=u)
    gain = fflin.lqr(lin, weights="identity")
    policy = fflin.StateFeedback(lin, gain.K)
    message = "the input limits are too small for 'canadarm2' at its target: "
    message += f"{names[most]} requires {u[most]:.3g} N m, its limit is "
    message += f"{np.sign(u[most]) * small:g}"
    with pytest.warns(fflin.FflinWarning, match=re.escape(message)) as messages:
        fflin.simulate(robot, policy, q0=q, duration=0.02, limits="urdf")
    assert len(messages) == 1
    for limits in (None, ["urdf", {names[most]: 2.1 * small}]):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            fflin.simulate(robot, policy, q0=q, duration=0.02, limits=limits)


def test_allocation_respects_limits_and_distributes_force_over_several_thrusters():
    body = free_body((20.0, 30.0, 40.0))
    thrusters = [fflin.Thruster(*AT, max=1.0), fflin.Thruster(*AT, max=9.0)]
    design = body.replace(inputs=[fflin.BaseForce()])
    asked = fflin.Allocation(
        lambda t, q, v: [5.0 if t < 0.05 else 20.0, 0.0, 0.0], design
    )
    motion = fflin.simulate(
        body.replace(inputs=thrusters), asked, duration=0.1, dt=0.01
    )
    np.testing.assert_allclose(motion.u[:4], [[1.0, 4.0]] * 4, rtol=1e-6)
    np.testing.assert_allclose(motion.u[6:], [[1.0, 9.0]] * 5, rtol=1e-6)
