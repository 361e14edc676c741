"""Reaction wheels hold an attitude: beside the textbook's feedback, with joints, held speeds."""

import re
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from scipy.linalg import solve_continuous_are

import fflin
from fflin import BaseForce, BaseTorque, JointTorque, ReactionWheel, Thruster
from tests.support.marks import exhaustive
from tests.support.messages import says
from tests.support.robots import free_body, mostly
from tests.support.wheels import AXES, ORTHOGONAL, PYRAMID, carrier_alone, unit, wheels

LAYOUTS = {"orthogonal": ORTHOGONAL, "pyramid": PYRAMID, "skew": AXES[:3], "six": AXES}
J = 0.02


def body():
    return free_body((3.0, 5.0, 4.0))


def wheeled(axes, *, inertia=J, others=()):
    robot = body()
    return robot.replace(inputs=[*others, *wheels(axes, inertia)])


def without_wheels(axes):
    """I - sum J a a^T, and the axes (3, k)."""
    A = np.array([unit(axis) for axis in axes]).T
    return np.diag((3.0, 5.0, 4.0)) - J * A @ A.T, A


def textbook(axes, Q, R):
    """K (k, 6) of one body, q_v' = omega/2 and I_r omega' = -A u, with q_v and omega fed back."""
    inertia, A = without_wheels(axes)
    F = np.block([[np.zeros((3, 3)), 0.5 * np.eye(3)], [np.zeros((3, 6))]])
    B = np.vstack((np.zeros((3, len(axes))), -np.linalg.solve(inertia, A)))
    P = solve_continuous_are(F, B, Q, R)
    return np.linalg.solve(R, B.T @ P)


def attitude(lin):
    return [
        lin.state_names.index(f"{g}.{axis}")
        for g in ("q_b", "omega_b")
        for axis in "xyz"
    ]


@pytest.mark.parametrize("layout", LAYOUTS)
def test_the_gain_matches_the_single_body(layout):
    axes = LAYOUTS[layout]
    lin = fflin.linearize(wheeled(axes))
    Q, R = (
        np.diag([5.0, 6.0, 7.0, 1.0, 2.0, 3.0]),
        0.5 + np.diag(0.1 * np.arange(len(axes))),
    )
    whole = np.zeros_like(lin.A)
    at = attitude(lin)
    whole[np.ix_(at, at)] = Q
    gain, K = fflin.lqr(lin, whole, R), textbook(axes, Q, R)
    assert gain.K.shape == lin.B.T.shape and gain.residual < 1e-13
    assert gain.K[:, at] == pytest.approx(K, rel=1e-9, abs=1e-9 * np.abs(K).max())
    assert not np.delete(gain.K, at, axis=1).any()
    assert set(gain.regulated) == {lin.state_names[i] for i in at}
    inertia, A = without_wheels(axes)
    B = np.vstack((np.zeros((3, len(axes))), -np.linalg.solve(inertia, A)))
    F = np.block([[np.zeros((3, 3)), 0.5 * np.eye(3)], [np.zeros((3, 6))]])
    poles = np.linalg.eigvals(F - B @ K)
    assert np.sort_complex(gain.poles) == pytest.approx(
        np.sort_complex(poles), rel=1e-6
    )
    # In the whole's own variables too, as P = S' P_z S.
    defect = lin.A.T @ gain.P + gain.P @ lin.A + gain.Q
    defect -= gain.P @ lin.B @ np.linalg.solve(R, lin.B.T @ gain.P)
    assert np.abs(defect).max() < 1e-12 * np.abs(gain.Q).max()
    # Weights on what is not regulated say nothing.
    assert (
        fflin.lqr(lin, whole + np.diag([i not in at for i in range(len(whole))]), R).K
        == gain.K
    ).all()


def test_orthogonal_wheels_have_the_textbooks_closed_form():
    """u = kp q_v + kd omega on the wheels: the body feels -kp q_v - kd omega (Wie, section 7.3)."""
    lin = fflin.linearize(wheeled(ORTHOGONAL))
    q1, q2, r = 8.0, 3.0, 2.0
    gain = fflin.lqr(lin, {"q_b": q1, "omega_b": q2}, {"wheel": r})
    inertia, _ = without_wheels(ORTHOGONAL)
    kp = np.sqrt(q1 / r) * np.ones(3)
    kd = np.sqrt(q2 / r + inertia.diagonal() * kp)
    expected = -np.hstack((np.diag(kp), np.diag(kd)))
    assert gain.K[:, attitude(lin)] == pytest.approx(expected, abs=1e-12)
    # Momentum alone, with the wheels' inertia left in the body.
    small = body().replace(inputs=[ReactionWheel(axis) for axis in ORTHOGONAL])
    gain = fflin.lqr(fflin.linearize(small), {"q_b": q1, "omega_b": q2}, r)
    kd = np.sqrt(q2 / r + np.array((3.0, 5.0, 4.0)) * kp)
    assert gain.K[:, :3] == pytest.approx(-np.diag(kp), abs=1e-12)
    assert gain.K[:, 6:9] == pytest.approx(-np.diag(kd), abs=1e-12)
    assert set(gain.state_names) - set(gain.regulated) == {
        f"{group}.{axis}" for group in ("r_b", "v_b") for axis in "xyz"
    }


@pytest.mark.exhaustive
@pytest.mark.parametrize("layout", mostly(LAYOUTS, "pyramid", "skew"))
def test_the_motion_matches_the_rigid_body_under_the_textbooks_law(layout):
    """With the wheels' inertia taken out of it and their momentum carried along; H is kept."""
    axes = LAYOUTS[layout]
    robot = wheeled(axes)
    lin = fflin.linearize(robot)
    gain = fflin.lqr(lin, {"q_b": 4.0, "omega_b": 1.0}, {"wheel": 0.5})
    turn = pin.SE3(pin.rpy.rpyToMatrix(0.6, -0.8, 0.5), np.zeros(3))
    q0 = fflin.configuration(robot, base=turn)
    motion = fflin.simulate(
        robot,
        fflin.StateFeedback(lin, gain.K),
        q0=q0,
        duration=12.0,
        dt=0.01,
        linear=False,
    )
    inertia, A = without_wheels(axes)
    K = gain.K[:, attitude(lin)]
    q, omega, h = pin.Quaternion(turn.rotation).coeffs(), np.zeros(3), np.zeros(3)

    def rate(state):
        q, omega, h = state[:4], state[4:7], state[7:]
        vector = q[:3] * np.copysign(1.0, q[3])
        u = -K @ np.concatenate((vector, omega))
        dq = 0.5 * np.array([*(q[3] * omega + np.cross(q[:3], omega)), -q[:3] @ omega])
        # h: momentum of the wheels about their axes, in all, in body axes.
        domega = np.linalg.solve(inertia, -A @ u - np.cross(omega, inertia @ omega + h))
        return np.concatenate((dq, domega, A @ u))

    state, step = np.concatenate((q, omega, h)), 0.01
    rows = [state]
    for _ in range(1200):
        k1 = rate(state)
        k2 = rate(state + 0.5 * step * k1)
        k3 = rate(state + 0.5 * step * k2)
        k4 = rate(state + step * k3)
        state = state + step / 6.0 * (k1 + 2 * k2 + 2 * k3 + k4)
        rows.append(state)
    rows = np.array(rows)
    at = attitude(lin)
    assert motion.x[:, at[:3]] == pytest.approx(rows[:, :3], abs=1e-7)
    assert motion.x[:, at[3:]] == pytest.approx(rows[:, 4:7], abs=1e-7)
    assert motion.attitude_error[0] > 50.0 and motion.attitude_error[-1] < 2.0
    assert motion.momentum_drift.max() < 1e-13
    assert np.abs(motion.momentum).max() < 1e-13


@pytest.mark.exhaustive
def test_wheels_on_links_hold_base_and_joints():
    arm = fflin.load("servicer_7dof")
    motors = [JointTorque(name) for name in arm.joint_names]
    on = ("base", "link_3", "base", "panel_left")
    robot = arm.replace(
        inputs=[*motors, *wheels(AXES[:4], 2e-3, on)], gravity=(0, 0, 0)
    )
    q = fflin.configuration(robot, {"joint_2": 0.4, "joint_4": -1.1})
    lin = fflin.linearize(robot, q)
    gain = fflin.lqr(lin)
    assert len(gain.regulated) == 2 * (3 + arm.n) and gain.margins.disk > 0.4
    turned = pin.SE3(pin.rpy.rpyToMatrix(0.2, 0.1, -0.2), np.zeros(3))
    q0 = fflin.configuration(
        robot, {"joint_2": 0.5, "joint_4": -1.0, "joint_6": 0.1}, turned
    )
    duration = 7.0 / gain.margin
    motion = fflin.simulate(
        robot, fflin.StateFeedback(lin, gain.K), q0=q0, duration=duration
    )
    last = dict(zip(motion.state_names, motion.error[-1], strict=True))
    assert max(abs(last[name]) for name in gain.regulated) < 2e-3
    assert motion.attitude_error[0] > 15.0 and motion.momentum_drift.max() < 1e-12


@pytest.mark.exhaustive
@pytest.mark.parametrize("dt", [None, 0.2])
def test_the_default_bears_much_and_settles(dt):
    for layout in LAYOUTS.values():
        robot = wheeled(layout)
        lin = fflin.linearize(robot)
        lin = lin.discretize(dt) if dt else lin
        gain = fflin.lqr(lin)
        assert gain.margins.disk > (0.4 if dt else 1.15 - 2e-3)
        q0 = fflin.configuration(
            robot, base=pin.SE3(pin.rpy.rpyToMatrix(0.5, 0.1, 0.1), np.zeros(3))
        )
        motion = fflin.simulate(
            robot, fflin.StateFeedback(lin, gain.K), q0=q0, duration=60.0
        )
        assert motion.attitude_error[-1] < 0.01 * motion.attitude_error[0]
        # Wheels share the work: none spins but for the turn that is to be made.
        assert np.abs(motion.v[-1, 6:]).max() < 1e-2


def test_the_torque_of_a_wheel_limits_the_loop():
    limits = (None, 0.01, None)
    added = [
        ReactionWheel(axis, inertia=J, max=most)
        for axis, most in zip(ORTHOGONAL, limits, strict=True)
    ]
    gain = fflin.lqr(fflin.linearize(body().replace(inputs=added)))
    assert says(gain.weights, "effort", "wheel_2")
    used = np.sin(np.radians(15.0)) * np.linalg.norm(gain.K[1, :3])
    assert used == pytest.approx(0.01, rel=1e-6)


@pytest.mark.exhaustive
@pytest.mark.parametrize("spin", [0.0, -2.0])
def test_the_speed_of_a_wheel_limits_the_loop(spin):
    """Its momentum is that which the body has on the way back, beside what it has already."""
    added = [
        ReactionWheel(axis, inertia=J, max_speed=most)
        for axis, most in zip(PYRAMID[:3], (1e3, 6.0, 1e3), strict=True)
    ]
    robot = body().replace(inputs=added)
    v = fflin.velocity(robot, {"wheel_2": spin})
    lin = fflin.linearize(robot, v=v)
    gain = fflin.lqr(lin)
    assert says(gain.weights, "speed", "wheel_2")
    largest = 0.0
    for axis in np.random.default_rng(3).normal(size=(40, 3)):
        turn = pin.SE3(pin.exp3(np.radians(30.0) * unit(axis)), np.zeros(3))
        q0 = fflin.configuration(robot, base=turn)
        policy = fflin.StateFeedback(lin, gain.K)
        motion = fflin.simulate(
            robot, policy, q0=q0, v0=v, duration=2.0 / gain.margin, dt=0.2, linear=False
        )
        largest = max(largest, np.abs(motion.v[:, 7]).max())
    assert 0.85 * 6.0 < largest < 1.03 * 6.0


@pytest.mark.parametrize(
    "axis", [ORTHOGONAL[0], *exhaustive(*((item,) for item in ORTHOGONAL[1:]))]
)
@pytest.mark.exhaustive
def test_a_large_wheel_turns_against_the_rest_of_the_robot(axis):
    """Its speed per momentum is that of both, the carrier free: a fifth more than of it alone."""
    added = [ReactionWheel(item, inertia=3e-3, max_speed=0.05) for item in ORTHOGONAL]
    robot = fflin.load("cubesat").replace(inputs=added)
    lin = fflin.linearize(robot)
    gain = fflin.lqr(lin)
    assert re.search("limited by the speed of wheel_[12]$", gain.weights)
    turn = pin.SE3(pin.exp3(np.radians(30.0) * unit(axis)), np.zeros(3))
    motion = fflin.simulate(
        robot,
        fflin.StateFeedback(lin, gain.K),
        q0=fflin.configuration(robot, base=turn),
        duration=2.0 / gain.margin,
        linear=False,
    )
    assert 0.4 * 0.05 < np.abs(motion.v[:, 6:]).max() <= 1.01 * 0.05


@pytest.mark.parametrize("spin", [-1.0, 3.0])
def test_a_wheel_that_is_at_its_limit_is_reported_and_quickens_nothing(spin):
    added = [ReactionWheel(item, inertia=J, max_speed=1.0) for item in ORTHOGONAL]
    robot = body().replace(inputs=added)
    still = fflin.lqr(fflin.linearize(robot))
    spun = fflin.lqr(fflin.linearize(robot, v=fflin.velocity(robot, {"wheel_2": spin})))
    assert says(still.weights, "speed of wheel_2")
    assert says(
        spun.weights, "speed of wheel_2", "at the operating point", "qdot_m.wheel_2"
    )
    assert spun.R == pytest.approx(still.R, rel=1e-9)
    # A spin slows one mode, and the record has the slowest.
    assert (
        f"decay rate at least {spun.margin:.3g} 1/s" in spun.weights
        and spun.margin < still.margin
    )


@pytest.mark.exhaustive
def test_spinning_wheels_are_held_about_their_speed():
    """A bias: the momentum stays where it is, the attitude returns, and with it the speeds."""
    robot = wheeled(AXES[:3])
    v = fflin.velocity(robot, {"wheel_1": 100.0, "wheel_3": -60.0})
    lin = fflin.linearize(robot, v=v)
    gain = fflin.lqr(lin)
    assert len(gain.regulated) == 6 and gain.margins.disk > 1.1
    start = v.copy()
    start[3:6] = 0.02, -0.01, 0.01
    motion = fflin.simulate(
        robot, fflin.StateFeedback(lin, gain.K), v0=start, duration=80.0
    )
    assert motion.attitude_error.max() > 1.0 and motion.attitude_error[-1] < 1e-2
    assert (
        np.abs(motion.v[-1, 6:] - v[6:]).max()
        < 0.2 * np.abs(motion.v[:, 6:] - v[6:]).max() + 5.0
    )


@pytest.mark.exhaustive
def test_speeds_come_back_where_something_else_turns_the_body():
    """To the point's, neither despun nor drifting, slowly beside the attitude."""
    robot = wheeled(AXES[:3], others=[BaseTorque()])
    v = fflin.velocity(robot, {"wheel_2": 80.0})
    lin = fflin.linearize(robot, v=v)
    gain = fflin.lqr(lin)
    assert {f"qdot_m.wheel_{k}" for k in (1, 2, 3)} < set(gain.regulated)
    assert says(gain.weights, "q_b.x, q_b.z", "wheel speeds", f"{gain.margin:.3g} 1/s")
    assert gain.margin == pytest.approx(0.02, rel=0.05) and gain.margins.disk > 1.1
    off = fflin.velocity(robot, {"wheel_1": 20.0, "wheel_2": 60.0})
    policy = fflin.StateFeedback(lin, gain.K)
    motion = fflin.simulate(
        robot, policy, v0=off, duration=300.0, dt=0.05, linear=False
    )
    assert np.abs(motion.v[-1] - v).max() < 0.1 and motion.attitude_error[-1] < 0.005
    assert motion.attitude_error.max() < 2.0
    loose = fflin.lqr(lin, wheel_speeds=False)
    assert not any(name.startswith("qdot_m.") for name in loose.regulated)
    Q = gain.Q.copy()
    at = lin.state_names.index("qdot_m.wheel_2")
    Q[at, at] += 1e-3
    quick = fflin.lqr(lin, Q, gain.R)
    assert [(np.abs(g.poles) < 0.022).sum() for g in (gain, quick)] == [3, 2]
    sampled = fflin.lqr(lin.discretize(0.1))
    assert sampled.margin == pytest.approx(0.1 * 0.02, rel=0.05)
    named = fflin.lqr(lin, {"q_b": 1.0, "omega_b": 1.0, "qdot_m.wheel_*": 1e-4}, 1.0)
    assert set(named.regulated) == set(gain.regulated)
    with pytest.raises(fflin.InputError, match=r"qdot_m\.wheel"):
        fflin.lqr(lin, {"q_b": 1.0, "omega_b": 1.0}, 1.0)


@pytest.mark.exhaustive
def test_four_wheels_turn_against_each_other_on_request():
    robot = wheeled(PYRAMID)
    lin = fflin.linearize(robot)
    gain, loose = fflin.lqr(lin, wheel_speeds=True), fflin.lqr(lin)
    assert sum(name.startswith("qdot_m.") for name in gain.regulated) == 1
    assert gain.margin == pytest.approx(0.02, rel=0.05)
    # Their momenta are none together, and nothing turns.
    idle = fflin.velocity(robot, {f"wheel_{k}": 50.0 * (-1) ** k for k in range(1, 5)})
    for design, left in ((gain, 0.2), (loose, 50.0)):
        policy = fflin.StateFeedback(lin, design.K)
        motion = fflin.simulate(
            robot, policy, v0=idle, duration=300.0, dt=0.1, linear=False
        )
        assert np.abs(motion.v[-1, 6:]).max() <= left + 1e-6
        assert motion.attitude_error.max() < 0.3
    assert np.abs(motion.v[-1] - idle).max() < 1e-6


def test_unregulated_states_are_reported(tmp_path):
    lin = fflin.linearize(wheeled(ORTHOGONAL))
    gain = fflin.lqr(lin)
    assert says(str(gain), "not regulated: r_b.x, r_b.y, r_b.z, q_m.wheel_1")
    free = str(fflin.lqr(fflin.linearize(wheeled(PYRAMID))))
    assert says(free, "wheel_speeds=True")
    one = wheeled(ORTHOGONAL, others=[Thruster("base", (0, 0, 0), (1, 0, 0))])
    part = fflin.lqr(fflin.linearize(one))
    assert says(str(part), "not regulated: r_b.y, r_b.z, q_m.wheel_1")
    assert "not regulated" not in str(fflin.lqr(fflin.linearize(body())))
    for ending in ("npz", "mat", "json"):
        gain.save(tmp_path / f"g.{ending}")
        back = fflin.Gain.load(tmp_path / f"g.{ending}")
        assert back.regulated == gain.regulated and (back.poles == gain.poles).all()
        old = replace(gain, regulated=())
        old.save(tmp_path / f"o.{ending}")
        assert fflin.Gain.load(tmp_path / f"o.{ending}").regulated == ()
    whole = fflin.lqr(fflin.linearize(body()))
    assert whole.regulated == whole.state_names
    assert replace(whole, regulated=()).margins == whole.margins


def test_an_equilibrium_that_inputs_cannot_hold_is_refused():
    for count, words in (
        (1, "angular momentum y/z"),
        (2, "angular momentum z"),
    ):
        with pytest.raises(fflin.StabilizabilityError, match=f"{words}"):
            fflin.lqr(fflin.linearize(wheeled(ORTHOGONAL[:count])))
    arm = fflin.load("ets_vii")
    idle = arm.replace(inputs=[JointTorque("joint_1"), *wheels(ORTHOGONAL, 1.0)])
    with pytest.raises(
        fflin.StabilizabilityError, match=r"momentum of joint_2, .* joint_3"
    ):
        fflin.lqr(fflin.linearize(idle))


def test_damping_of_wheels_is_reported_to_be_why_nothing_is_held():
    """Their speeds stay in the model with it, and the momentum of all that no input changes."""
    names = [f"wheel_{k}" for k in (1, 2, 3)]
    lin = fflin.linearize(
        wheeled(ORTHOGONAL).replace(damping=dict.fromkeys(names, 1e-7))
    )
    words = "remove the damping of the wheels"
    reduced = fflin.momentum_reduction(lin)
    for model in (lin, lin.discretize(0.1), reduced):
        for weights in ((), (1.0, 1.0)):
            with pytest.raises(fflin.StabilizabilityError, match=words):
                fflin.lqr(model, *weights)
    with pytest.raises(fflin.StabilizabilityError) as messages:
        fflin.lqr(fflin.linearize(wheeled(ORTHOGONAL[:1])))
    assert "damping" not in str(messages.value)
    helped = wheeled(ORTHOGONAL, others=[BaseTorque()]).replace(
        damping={"wheel_1": 1e-7}
    )
    assert fflin.lqr(fflin.linearize(helped)).margin > 0.0


def test_a_body_that_turns_is_held_too():
    """Dual spin, about the axis of a wheel: speeds matter to the body, and nothing is pushed."""
    robot = wheeled(ORTHOGONAL, others=[BaseTorque()])
    v = fflin.velocity(robot, {"omega_b.z": 0.1, "wheel_3": 50.0})
    lin = fflin.linearize(robot, v=v, moving=True)
    gain = fflin.lqr(lin, wheel_speeds=False)
    assert not any(name.startswith(("r_b", "v_b", "q_m")) for name in gain.regulated)
    assert {"qdot_m.wheel_1", "qdot_m.wheel_2"} < set(gain.regulated)
    at = [lin.state_names.index(name) for name in gain.regulated]
    S = np.eye(len(lin.A))[at]
    assert np.abs(S @ lin.A - S @ lin.A @ S.T @ S).max() < 1e-15
    assert gain.poles.real.max() < -0.05 and gain.margins.disk > 1.0
    push = robot.replace(inputs=[*robot.inputs, Thruster("base", (0, 0, 0), (1, 0, 0))])
    lin = fflin.linearize(push, v=v, moving=True)
    # In axes that turn what pushes along x pushes along y later; z stays unpushed.
    with pytest.raises(fflin.StabilizabilityError, match=r"v_b\.z"):
        fflin.lqr(lin)


def test_the_closed_form_holds_too():
    """The regulator on accelerations is the one of the same cost by the Riccati equation."""
    for others, count in (([], 6), ([BaseTorque(), BaseForce()], 12)):
        robot = wheeled(AXES[:3], others=others)
        lin = fflin.linearize(robot)
        gain = fflin.acceleration_lqr(lin, 3.0, {"omega_b": 1.0}, 2.0)
        assert len(gain.regulated) == count == len(gain.poles) and gain.residual < 1e-13
        if count == 12:  # more inputs than accelerations: R is singular
            continue
        same = fflin.lqr(lin, gain.Q, gain.R)
        assert same.regulated == gain.regulated
        assert gain.K == pytest.approx(same.K, abs=1e-7 * np.abs(gain.K).max())
        assert gain.P == pytest.approx(same.P, abs=1e-7 * np.abs(gain.P).max())


@pytest.mark.exhaustive
def test_a_filter_estimates_the_regulated_states():
    robot = wheeled(AXES[:3]).replace(
        outputs=[fflin.BasePose(), fflin.JointVelocities()]
    )
    lin = fflin.linearize(robot).discretize(0.1)
    gain = fflin.lqr(lin)
    result = fflin.kalman(lin, {"wheel": 1e-4}, 1e-6, G=lin.B)
    assert result.estimated == gain.regulated and result.residual < 1e-11
    at = [lin.state_names.index(name) for name in result.estimated]
    assert not np.delete(result.L, at, axis=0).any()
    seen = [i for i, name in enumerate(lin.output_names) if result.L[:, i].any()]
    assert len(seen) == 3  # the attitude, and neither position nor the wheels' speeds
    loop = np.linalg.eigvals((lin.A - result.L @ lin.C)[np.ix_(at, at)])
    assert np.sort(np.abs(loop)) == pytest.approx(
        np.sort(np.abs(result.poles)), abs=1e-9
    )
    compensator = fflin.lqg(gain, result)
    assert compensator.state_names == gain.regulated and compensator.A.shape == (6, 6)
    q0 = fflin.configuration(
        robot, base=pin.SE3(pin.rpy.rpyToMatrix(0.3, 0.1, 0), np.ones(3))
    )
    policy = fflin.OutputFeedback(lin, compensator)
    motion = fflin.simulate(robot, policy, q0=q0, duration=80.0)
    assert motion.attitude_error[-1] < 0.02


def test_a_filter_and_a_gain_of_unlike_speeds_are_refused():
    robot = wheeled(AXES[:3], others=[BaseTorque()])
    lin = fflin.linearize(robot)
    W, loose = (
        {name: 1e-3 for name in ("q_b", "omega_b", "qdot_m")},
        {"wheel_speeds": False},
    )
    both = fflin.kalman(lin, W, 1e-4)
    assert both.estimated == fflin.lqr(lin).regulated
    fflin.lqg(fflin.lqr(lin, **loose), both)
    with pytest.raises(fflin.InputError, match="wheel_speeds"):
        fflin.lqg(fflin.lqr(lin), fflin.kalman(lin, W, 1e-4, **loose))
    blind = fflin.linearize(robot.replace(outputs=[fflin.BasePose()]))
    with pytest.raises(fflin.DetectabilityError, match=r"qdot_m\.wheel"):
        fflin.kalman(blind, W, 1e-4)
    assert len(fflin.kalman(blind, W, 1e-4, **loose).poles) == 6


def test_the_carrier_without_its_wheels_is_the_body_that_is_designed_for():
    """By BaseTorque on the robot whose base lacks J a a^T, with the sign turned."""
    arm = fflin.load("ets_vii")
    motors = [JointTorque(name) for name in arm.joint_names]
    robot = arm.replace(inputs=[*motors, *wheels(ORTHOGONAL, 2.0)])
    lin = fflin.linearize(robot)
    other = carrier_alone(arm, [(2.0, axis) for axis in ORTHOGONAL])
    other = other.replace(inputs=[*motors, BaseTorque()])
    beside = fflin.momentum_reduction(fflin.linearize(other))
    gain = fflin.lqr(lin, {"q_b": 3.0, "q_m": 2.0, "omega_b": 1.0, "qdot_m": 1.0}, 0.7)
    same = fflin.lqr(
        beside, {"q_b": 3.0, "q_m": 2.0, "omega_b": 1.0, "qdot_m": 1.0}, 0.7
    )
    at = [lin.state_names.index(name) for name in beside.state_names]
    sign = np.array([1.0] * arm.n + [-1.0] * 3)
    assert gain.K[:, at] == pytest.approx(
        sign[:, None] * same.K, abs=1e-8 * np.abs(same.K).max()
    )
