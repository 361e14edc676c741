"""What a simulation does with policies, events, disturbances and times that are not as they ought.

Nothing that is not finite is ever recorded, and nobody else's memory is shared.
"""

import json
import math
import re
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

import fflin
from tests.support.messages import says
from tests.support.motions import displaced, regulated, strong_thrusters
from tests.support.robots import free_body
from tests.support.weights import unit_weights


def finite(motion):
    names = (
        "t",
        "q",
        "v",
        "x",
        "u",
        "energy",
        "momentum",
        "momentum_drift",
        "prediction",
    )
    return all(np.isfinite(getattr(motion, name)).all() for name in names)


def after_half_a_second(value):
    return lambda t, q, v: np.full(6, value if t > 0.5 else 0.0)


@pytest.mark.parametrize("sample", [None, 0.1])
@pytest.mark.parametrize(
    ("policy", "message"),
    [
        (after_half_a_second(math.nan), "tau_b.x"),
        (after_half_a_second(math.inf), "tau_b.x"),
        (lambda t, q, v: None, "type NoneType"),
        (lambda t, q, v: "push", "real"),
        (lambda t, q, v: [[1.0], [1.0, 2.0]], "rows"),
        (lambda t, q, v: np.full(6, 1j), "complex128"),
        (lambda t, q, v: np.zeros((6, 1)), "(6, 1)"),
    ],
)
def test_a_policy_that_gives_no_inputs_is_refused(policy, message, sample):
    robot = free_body((20.0, 30.0, 40.0))
    with pytest.raises(fflin.InputError) as caught:
        fflin.simulate(robot, policy, duration=1.0, sample=sample)
    assert message in str(caught.value)


def test_an_infinite_command_within_limits_is_the_limit():
    robot = free_body((20.0, 30.0, 40.0))
    motion = fflin.simulate(
        robot, after_half_a_second(math.inf), duration=1.0, limits=2.0
    )
    assert finite(motion)
    assert motion.u[-1, 0] == 2.0
    with pytest.raises(fflin.InputError, match="tau_b"):
        fflin.simulate(robot, after_half_a_second(math.nan), duration=1.0, limits=2.0)


def test_a_policy_may_keep_and_change_its_arguments_and_results():
    robot = free_body((20.0, 30.0, 40.0))
    kept, u = [], np.zeros(6)

    def clean(t, q, v):
        return np.full(6, math.sin(10.0 * t))

    def careless(t, q, v):
        u[:] = clean(t, q, v)
        kept.append((t, q, v, v.copy()))
        q[:] = 7.0
        return u

    def spoil(t, q, v, *rest):
        for array in (q, v, *rest):
            array[:] = 7.0
        return 1.0

    for options in ({}, {"sample": 0.1, "delay": 0.2}):
        asked, given = (
            fflin.simulate(robot, policy, duration=1.0, **options, **watched)
            for policy, watched in (
                (clean, {}),
                (careless, {"events": [spoil], "callback": spoil}),
            )
        )
        np.testing.assert_array_equal(given.x, asked.x)
        np.testing.assert_array_equal(given.u, asked.u)
        assert given.u.any()
    assert all(np.array_equal(v, then) for _, _, v, then in kept)


def test_an_unstable_loop_has_neither_warnings_nor_an_infinite_prediction():
    robot, lin, gain = regulated("ets_vii")
    policy = fflin.StateFeedback(lin, -gain.K)
    motion = fflin.simulate(robot, policy, x0=displaced(lin, 5.0), duration=100.0)
    assert motion.stopped.startswith(("diverged at t", "left the chart at t"))
    assert finite(motion)
    held = fflin.simulate(
        robot, policy, x0=displaced(lin, 5.0), duration=2.0, limits=1e-3
    )
    assert len(held.linear) == len(held.t)
    # The linear model of a loop that is held within limits has no bounds.
    long = fflin.simulate(
        *(robot, fflin.StateFeedback(lin.discretize(5.0), -1e9 * gain.K)),
        **{"x0": displaced(lin, 5.0), "duration": 500.0, "limits": None, "every": 500},
    )
    assert finite(long)


@pytest.mark.parametrize("size", [1e200, 1e60])
def test_a_speed_whose_square_overflows_is_refused_or_a_divergence(size):
    robot = free_body((20.0, 30.0, 40.0))
    with pytest.raises(fflin.InputError, match="velocity"):
        fflin.simulate(robot, v0=[size, 0, 0, 0, 0, 0], duration=1.0)
    force = np.array([size, 0, 0, 0, 0, 0])
    motion = fflin.simulate(robot, duration=1.0, disturbance=lambda t, q, v: force)
    assert motion.stopped.startswith(
        "diverged at t = 0.01 s in steps of 0.01 s; give a smaller dt"
    )
    assert finite(motion)


def test_the_prediction_matches_the_last_row_too():
    robot, lin, gain = regulated("ets_vii")
    policy = fflin.StateFeedback(lin, gain.K)
    x0 = lin.x0 + 1e-6 * (displaced(lin) - lin.x0)

    def at_16_steps(t, q, v):
        return 0.155 - t

    motion = fflin.simulate(
        robot, policy, x0=x0, duration=1.0, every=7, events=[at_16_steps]
    )
    np.testing.assert_allclose(motion.t, [0.0, 0.07, 0.14, 0.16])
    np.testing.assert_allclose(motion.x, motion.linear, atol=1e-9)
    # Between its samples a sampled model moves as the continuous one; one from a file is not known.
    sampled = fflin.StateFeedback(lin.discretize(0.3), gain.K)
    options = {"x0": x0, "duration": 1.0, "dt": 0.01, "every": 7}
    for linear in (None, lin):
        motion = fflin.simulate(robot, sampled, linear=linear, **options)
        np.testing.assert_allclose(motion.x, motion.linear, atol=1e-9)
    alone = fflin.StateFeedback(
        replace(sampled.lin, A=sampled.lin.A * (1.0 + 1e-12)), gain.K
    )
    assert fflin.simulate(robot, alone, **options).linear is None


def test_the_default_step_divides_samples_delay_and_duration():
    robot, lin, gain = regulated("ets_vii")
    policy = fflin.StateFeedback(lin.discretize(0.013), gain.K)
    motion = fflin.simulate(robot, policy, x0=displaced(lin), duration=1.0, delay=0.02)
    assert motion.t[-1] == pytest.approx(1.0)
    assert motion.t[1] == pytest.approx(0.001)
    steps = np.abs(np.diff(motion.u, axis=0)).max(axis=1)
    changes = np.flatnonzero(steps > 1e-12 * np.abs(motion.u).max()) + 1
    # At the second sample nothing has acted yet: it asks for the same as the first, to rounding.
    np.testing.assert_array_equal(changes[:3], [20, 46, 59])
    # A fast loop's step is a power of two where nothing else decides on it.
    fast, model, gain = regulated("planar_detumble")
    late = fflin.StateFeedback(model, 0.1 * gain.K)
    motion = fflin.simulate(fast, late, x0=displaced(model), duration=0.1, delay=0.02)
    assert (0.02 / motion.t[1]) % 1.0 == pytest.approx(0.0, abs=1e-9)
    with pytest.raises(fflin.InputError, match="duration"):
        fflin.simulate(robot, policy, duration=1.0, dt=0.013)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"sample": 0.0}, "sample"),
        ({"sample": "often"}, "'often'"),
        ({"duration": 1e-200}, "duration"),
        ({"dt": 1e-30}, "1e+30"),
        ({"events": None}, "functions"),
        ({"events": abs}, "functions"),
        ({"events": [lambda t, q, v: None]}, "None"),
        ({"events": [lambda t, q, v: math.nan]}, "nan"),
        ({"disturbance": np.zeros(6)}, "disturbance"),
        ({"disturbance": lambda t, q, v: "wind"}, "real"),
        ({"disturbance": lambda t, q, v: np.full(6, math.nan)}, "finite"),
        ({"method": ["cf4"]}, "method"),
        ({"linear": 3}, "fflin.LinearModel"),
    ],
)
def test_invalid_input_is_one_line(options, message):
    with pytest.raises(fflin.FflinError) as caught:
        fflin.simulate(free_body((20.0, 30.0, 40.0)), **{"duration": 1.0, **options})
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_model_that_cannot_predict_is_refused():
    robot, lin, gain = regulated("ets_vii")
    policy = fflin.StateFeedback(lin, gain.K)
    for other in (
        fflin.linearize(fflin.load("canadarm2")),
        fflin.linearize(robot, frame="local"),
        fflin.linearize(robot, moving=True),
    ):
        with pytest.raises(fflin.InputError, match="robot"):
            fflin.simulate(robot, policy, duration=1.0, linear=other)
    with pytest.raises(fflin.InputError, match="linear"):
        fflin.simulate(
            robot, lambda t, q, v: np.zeros(len(lin.u0)), duration=1.0, linear=lin
        )


def test_whole_numbers_of_numpy_are_whole_numbers():
    robot = free_body((20.0, 30.0, 40.0))
    assert len(fflin.simulate(robot, duration=1.0, every=np.int64(10)).t) == 11


def test_energy_of_gravity_and_springs_is_part_of_the_whole():
    robot = fflin.load(
        "servicer_7dof",
        gravity=(0.3, 0.1, -0.5),
        stiffness={"panel_left": 50.0, "joint_2": 20.0},
    )
    q0 = fflin.configuration(robot, {"panel_left": 0.4, "joint_2": -0.3})
    motion = fflin.simulate(robot, q0=q0, duration=1.0, dt=0.0025, every=20)
    kinetic = motion.energy[-1] - motion.energy[0]
    assert abs(kinetic) < 1e-6 * np.abs(
        motion.v[-1, :3] @ motion.v[-1, :3] * robot.mass
    )
    # A spring at rest but bent holds k a^2 / 2.
    assert motion.energy[0] - fflin.simulate(
        robot.replace(stiffness={}), q0=q0, duration=0.01
    ).energy[0] == pytest.approx(25.0 * 0.16 + 10.0 * 0.09)


def test_the_linear_loop_matches_scipy_late_limited_and_off_a_fixed_point():
    from scipy.signal import cont2discrete

    robot = fflin.load("ets_vii", gravity=(0.0, 0.0, -0.2))
    u0 = 0.1 * np.ones(12)
    lin = fflin.linearize(robot, u=u0)
    assert not lin.is_equilibrium()
    calm = fflin.linearize(fflin.load("ets_vii"))
    K = fflin.lqr(calm, *unit_weights(calm)).K
    policy, x0 = fflin.StateFeedback(lin, K), displaced(lin)
    options = {
        "x0": x0,
        "duration": 2.0,
        "dt": 0.05,
        "limits": {"tau_b": 300.0, "tau_m": 4.0},
    }
    late = fflin.simulate(robot, policy, sample=0.1, delay=0.15, **options)
    high = np.r_[np.full(3, 300.0), np.full(3, np.inf), np.full(6, 4.0)]
    # f0 is one more input, of the value 1.
    B = np.column_stack((lin.B, lin.f0))
    Ad, Bd, *_ = cont2discrete((lin.A, B, np.eye(24), np.zeros((24, 13))), 0.05)
    e, acting, sent, rows = x0 - lin.x0, u0, {}, [x0]
    for step in range(40):
        if step % 2 == 0:
            sent[step + 3] = np.clip(u0 - K @ e, -high, high)
        acting = sent.get(step, acting)
        e = Ad @ e + Bd @ np.append(acting - u0, 1.0)
        rows.append(e + lin.x0)
    np.testing.assert_allclose(late.linear, rows, atol=1e-11)
    # Asked all the time and without limits, the loop is a matrix exponential.
    from scipy.linalg import expm

    free = fflin.simulate(robot, policy, x0=x0, duration=2.0, dt=0.01)
    flow = np.zeros((25, 25))
    flow[:24] = np.column_stack((lin.A - lin.B @ K, lin.f0))
    ends = [expm(flow * t) @ np.append(x0 - lin.x0, 1.0) for t in free.t]
    np.testing.assert_allclose(free.linear, np.array(ends)[:, :24] + lin.x0, atol=1e-6)


def test_feedback_along_a_trajectory_does_not_see_the_quaternions_sign():
    robot = fflin.load("ets_vii")
    t = np.linspace(0.0, 1.0, 5)
    q = np.tile(robot.neutral(), (5, 1))
    traj = fflin.linearize_trajectory(robot, t, q, np.zeros((5, 12)), np.zeros((5, 12)))
    lin = fflin.linearize(robot)
    Q, R = unit_weights(lin)
    policy = fflin.TrajectoryFeedback(traj, fflin.tvlqr(traj, Q, R, Q)).bind(robot)
    point, speed = fflin.StateMap(robot).to_pinocchio(displaced(lin))
    other = point.copy()
    other[3:7] *= -1.0
    asked = policy(0.5, point, speed)
    assert np.abs(asked).max() > 1.0
    np.testing.assert_array_equal(policy(0.5, other, speed), asked)
    with pytest.raises(fflin.InputError, match="Trajectory"):
        fflin.TrajectoryFeedback(3, 4)


def test_an_allocation_is_sampled_as_its_policy_is_and_refuses_an_invalid_command():
    design = fflin.load("cubesat", inputs=[fflin.BaseTorque(), fflin.BaseForce()])
    robot = design.replace(inputs=strong_thrusters())
    lin = fflin.linearize(design)
    gain = fflin.acceleration_lqr(lin, 0.04, 0.2, 1.0)
    inner = fflin.StateFeedback(lin.discretize(0.1), gain.K)
    x0 = np.r_[np.full(6, 0.1), np.zeros(6)]
    motion = fflin.simulate(
        robot, fflin.Allocation(inner, design), x0=x0, duration=1.0, dt=0.05
    )
    changes = np.flatnonzero(np.diff(motion.u, axis=0).any(axis=1)) + 1
    np.testing.assert_array_equal(changes, np.arange(2, 20, 2))
    for asked, message in (
        (lambda t, q, v: np.zeros(3), "(3,)"),
        (lambda t, q, v: "push", "real"),
        (lambda t, q, v: np.full(6, math.nan), "tau_b.x"),
    ):
        with pytest.raises(fflin.InputError) as caught:
            fflin.simulate(robot, fflin.Allocation(asked, design), duration=1.0)
        assert message in str(caught.value)
    with pytest.raises(fflin.InputError, match=r"fflin\.Robot"):
        fflin.simulate(robot, fflin.Allocation(inner, 3), duration=1.0)


def test_an_allocation_to_the_same_inputs_returns_the_command():
    # The force is held in reference axes, while the base is turned.
    robot = fflin.load("ets_vii")
    lin = fflin.linearize(robot)
    asked = np.arange(1.0, 13.0)
    policy = fflin.Allocation(lambda t, q, v: asked, robot).bind(robot)
    q, v = fflin.StateMap(robot).to_pinocchio(displaced(lin, 100.0))
    np.testing.assert_allclose(policy(0.0, q, v), asked, rtol=1e-6)


def test_the_attitude_error_is_the_angle_to_the_target_that_is_turned_too():
    robot = fflin.load("cubesat")
    aim = pin.SE3(pin.exp3(np.array([0.9, -0.4, 0.7])), np.zeros(3))
    at = pin.SE3(pin.exp3(np.array([-0.5, 1.1, 0.3])), np.zeros(3))
    lin = fflin.linearize(
        robot, fflin.configuration(robot, base=aim), reference=pin.SE3.Identity()
    )
    K = fflin.acceleration_lqr(fflin.linearize(robot), 1.0, 1.0, 1.0).K
    motion = fflin.simulate(
        robot,
        fflin.StateFeedback(lin, K),
        q0=fflin.configuration(robot, base=at),
        duration=0.01,
    )
    angle = np.degrees(np.linalg.norm(pin.log3(aim.rotation.T @ at.rotation)))
    assert motion.attitude_error[0] == pytest.approx(angle, abs=1e-9)


def test_a_motion_with_unequal_rows_is_refused(tmp_path):
    motion = fflin.simulate(free_body((20.0, 30.0, 40.0)), duration=0.1)
    motion.save(tmp_path / "m.json")
    record = json.loads((tmp_path / "m.json").read_text())
    record["x"] = record["x"][:-1]
    (tmp_path / "m.json").write_text(json.dumps(record))
    with pytest.raises(fflin.FileError, match="Motion"):
        fflin.Motion.load(tmp_path / "m.json")


def test_a_motion_that_is_not_finite_is_not_saved(tmp_path):
    from dataclasses import replace

    motion = fflin.simulate(free_body((20.0, 30.0, 40.0)), duration=0.1)
    bad = replace(motion, x=math.nan * motion.x)
    for name in ("m.npz", "m.json", "m.mat", "m.csv"):
        with pytest.raises(fflin.InputError, match="finite"):
            bad.save(tmp_path / name)
    assert not list(tmp_path.iterdir())


def test_a_step_that_a_fast_gain_makes_short_is_reported_once():
    robot = free_body((20.0, 30.0, 40.0))
    lin = fflin.linearize(robot)
    K = fflin.lqr(lin, 1.0, 1.0).K

    def at_once(t, q, v):
        return -1.0

    with pytest.warns(fflin.FflinWarning) as messages:
        fflin.simulate(
            robot, fflin.StateFeedback(lin, 1e6 * K), duration=2.0, events=[at_once]
        )
    (message,) = [str(item.message) for item in messages]
    poles = np.abs(np.linalg.eigvals(lin.A - lin.B @ (1e6 * K)))
    assert says(message, f"{poles.max():.3g} 1/s", "dt=")
    steps = max(
        int(item.replace(",", "")) for item in re.findall(r"\d[\d,]{4,}", message)
    )
    assert 1e5 < steps <= 2.0 * 2.0 * poles.max() + 1.0
    # Neither where the step is given, nor where it is not the pole that asks for so many.
    for gain, times in ((1e6, {"dt": 1e-5}), (1.0, {"duration": 2000.0})):
        policy = fflin.StateFeedback(lin, gain * K)
        fflin.simulate(robot, policy, **{"duration": 2.0} | times, events=[at_once])


def test_a_gain_that_is_not_finite_is_reported_to_hold_nan():
    lin = fflin.linearize(free_body((20.0, 30.0, 40.0)))
    with pytest.raises(fflin.InputError, match=r"K\[0, 0\] is nan"):
        fflin.StateFeedback(lin, np.full((6, 12), np.nan))
    with pytest.raises(fflin.InputError, match=r"\(6, 6\)"):
        fflin.StateFeedback(lin, np.eye(6))
