"""Joints of the URDF that are flown as reaction wheels, compared with `ReactionWheel`."""

import numpy as np
import pinocchio as pin
import pytest
from scipy.optimize import linear_sum_assignment

import fflin
from fflin import BaseForce, BaseTorque
from fflin.analysis.reduction import regulated_part
from fflin.campaign.runs import KINDS, kinds_of
from fflin.control.authority import point_properties
from fflin.robot.rotors import SPINNING
from tests.support.marks import exhaustive
from tests.support.wheels import AXES, matched, spun

SPEEDS = (50.0, -80.0, 120.0, 90.0)
INPUTS = {
    "wheels": (),
    "wheels and torque": (BaseTorque(),),
    "wheels, torque and force": (BaseTorque(), BaseForce()),
}
# Rounding errors of the models are eps times the inertia of the robot (65 kg m^2) divided by the
# inertia of a wheel (0.02 kg m^2) and multiplied by its speed (120 rad/s), which is 1e-10. They are
# smaller by the share of a wheel in the inertia. The Riccati equation multiplies them by its
# condition number, about 10.
CLOSE = 1e-9


def speeds_of(robot):
    return {f"wheel_{k + 1}": speed for k, speed in enumerate(SPEEDS[: robot.n - 1])}


def models(others=(), axes=AXES[:4], spinning=True, dt=0.0, moving=False, **fields):
    """The models of one satellite with wheels that are joints, and with `ReactionWheel`."""
    result = []
    satellite, twin = spun(axes, others=others, **fields)
    if not spinning:
        satellite = satellite.replace(wheel_joints=["wheel_*"])
    for robot in (satellite, twin):
        q = fflin.configuration(robot, {"arm": 0.4})
        v = fflin.velocity(robot, speeds_of(robot)) if spinning else None
        lin = fflin.linearize(robot, q, v, moving=moving)
        result.append((robot, lin.discretize(dt) if dt else lin))
    return result


@pytest.mark.parametrize("others", INPUTS)
@pytest.mark.parametrize(
    "spinning, dt", [(True, 0.1), (False, 0.0), *exhaustive((True, 0.0), (False, 0.1))]
)
def test_designs_match_reaction_wheels(others, spinning, dt):
    (_, lin), (_, other) = models(INPUTS[others], spinning=spinning, dt=dt)
    x, u = matched(lin, other)
    assert lin.wheels == other.wheels == ("wheel_1", "wheel_2", "wheel_3", "wheel_4")
    for key, rows, columns in (("A", x, x), ("B", x, u)):
        converted, expected = (
            getattr(lin, key)[np.ix_(rows, columns)],
            getattr(other, key),
        )
        assert np.abs(converted - expected).max() < CLOSE * np.abs(expected).max()
    for wheel_speeds in (None, True, False):
        gain, expected = (
            fflin.lqr(item, wheel_speeds=wheel_speeds) for item in (lin, other)
        )
        assert set(gain.regulated) == set(expected.regulated)
        assert not {f"q_m.{name}" for name in lin.wheels} & {*gain.regulated}
        assert "q_m.arm" in gain.regulated
        K = gain.K[np.ix_(u, x)]
        assert np.abs(K - expected.K).max() < 10.0 * CLOSE * np.abs(expected.K).max()
        # Double poles have the square root of the error.
        apart = np.abs(gain.poles[:, None] - expected.poles)
        assert apart[linear_sum_assignment(apart)].max() < 1e-6
        assert gain.weights == expected.weights


def test_speed_limits_of_wheels_bound_the_default_weights():
    """Speed limits of wheels that are joints count as those of `ReactionWheel` do."""
    limits = {"qdot_m.wheel_*": 10.0}
    (_, lin), (_, other) = models(spinning=False, limits=limits)
    x, u = matched(lin, other)
    gain, expected = fflin.lqr(lin), fflin.lqr(other)
    assert gain.weights == expected.weights
    assert "bandwidth limited by the speed of wheel_" in gain.weights
    assert (
        np.abs(gain.K[np.ix_(u, x)] - expected.K).max()
        < 10.0 * CLOSE * np.abs(expected.K).max()
    )


def test_the_speed_limit_of_a_wheel_without_motor_does_not_bound_the_loop():
    """No input accelerates this wheel relative to inertial space, so its limit has no effect."""
    satellite, _ = spun(AXES[:2], others=(BaseTorque(), BaseForce()))
    satellite = satellite.replace(
        wheel_joints=["wheel_*"],
        inputs=[*satellite.inputs[:3], fflin.JointTorque("wheel_1")],
    )
    limited = satellite.replace(limits={"qdot_m.wheel_2": 1e-3})
    gains = [fflin.lqr(fflin.linearize(item)) for item in (satellite, limited)]
    assert (gains[0].K == gains[1].K).all()


@pytest.mark.parametrize("spinning", [True, False])
def test_filters_and_reductions_match_reaction_wheels(spinning):
    (robot, lin), (twin, other) = models((BaseTorque(),), spinning=spinning)
    x, _ = matched(lin, other)
    noise = {"omega_b": 1e-4, "q_b": 1e-6, "qdot_m": 1e-4, "q_m.arm": 1e-6}
    filters = [fflin.kalman(item, noise, 1e-4) for item in (lin, other)]
    assert set(filters[0].estimated) == set(filters[1].estimated)
    assert "q_m.wheel_1" not in filters[0].estimated
    L, expected = filters[0].L[np.ix_(x, x)], filters[1].L
    assert np.abs(L - expected).max() < 100.0 * CLOSE * np.abs(expected).max()
    reduced = [
        fflin.momentum_reduction(item, wheel_speeds=False) for item in (lin, other)
    ]
    assert set(reduced[0].state_names) == set(reduced[1].state_names)
    assert not any("wheel" in name for name in reduced[0].state_names)
    at = [reduced[0].state_names.index(name) for name in reduced[1].state_names]
    difference = reduced[0].A[np.ix_(at, at)] - reduced[1].A
    assert np.abs(difference).max() < CLOSE * np.abs(reduced[1].A).max()
    # The reports of the operating points state the same momentum of the wheels.
    points = [
        point_properties(item, at.q, at.v) for item, at in ((robot, lin), (twin, other))
    ]
    assert points[0].wheel_momentum.wheels == 4
    assert points[0].wheel_momentum.total == pytest.approx(
        points[1].wheel_momentum.total
    )
    assert spinning == bool(np.abs(points[0].wheel_momentum.total).max() > 1.0)


def laws_of(lin, kind):
    """A feedback of the state, of estimated states, or a predictive control."""
    if kind == "mpc":
        return fflin.mpc(lin, horizon=6, dt=0.2, limits=None)
    gain = fflin.lqr(lin)
    if kind == "outputs":
        noise = {"omega_b": 1e-4, "q_b": 1e-6, "qdot_m": 1e-4, "q_m.arm": 1e-6}
        return fflin.OutputFeedback(
            lin, fflin.lqg(gain, fflin.kalman(lin, noise, 1e-4))
        )
    return fflin.StateFeedback(lin, gain.K)


@pytest.mark.parametrize(
    "kind, dt, engine",
    [
        ("states", 0.0, "python"),
        ("states", 0.2, "python"),
        ("outputs", 0.2, "python"),
        ("mpc", 0.2, "python"),
        pytest.param("states", 0.2, "compiled", marks=pytest.mark.compiled),
        pytest.param("outputs", 0.2, "compiled", marks=pytest.mark.compiled),
    ],
)
def test_motions_and_reports_match_reaction_wheels(kind, dt, engine):
    result = []
    for robot, lin in models(
        (BaseTorque(),), axes=AXES[:3], dt=dt if kind != "mpc" else 0.0
    ):
        law = laws_of(lin, kind)
        q0 = fflin.configuration(robot, {"arm": 0.5})
        motion = fflin.simulate(
            robot,
            law,
            q0=q0,
            v0=lin.v,
            duration=2.0,
            dt=0.05,
            engine=engine,
            linear=False,
        )
        result.append((lin, motion))
    (lin, motion), (other, twin) = result
    x, _ = matched(lin, other)
    at = [
        i
        for i, name in enumerate(other.state_names)
        if not name.startswith("q_m.wheel")
    ]
    apart = motion.x[:, x] - twin.x
    scale = np.abs(twin.x).max(axis=0) + 1.0
    assert (np.abs(apart) / scale)[:, at].max() < 1e-9
    # the arm is displaced, and the base moves with it
    assert np.abs(motion.error).max() > 0.05
    assert motion.wheels == twin.wheels
    assert motion.wheel_inertias == pytest.approx(twin.wheel_inertias, rel=1e-12)
    # Energies and rounding errors at the end of the report differ in their last digits.
    report, expected = (str(item).partition("energy:")[0] for item in (motion, twin))
    assert report == expected and "\nwheel speeds" in report


def hub_with_wheel(joint=None, inertia=(0.01, 0.01, 0.02), travel=None, **fields):
    """A hub with one wheel through its centre of mass, about the z axis."""
    model = pin.Model()
    model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "free")
    hub = pin.Inertia(50.0, np.zeros(3), np.diag([4.0, 5.0, 6.0]))
    model.appendBodyToJoint(1, hub, pin.SE3.Identity())
    model.addJoint(1, joint or pin.JointModelRUBZ(), pin.SE3.Identity(), "wheel")
    body = pin.Inertia(2.0, np.zeros(3), np.diag(inertia))
    model.appendBodyToJoint(2, body, pin.SE3.Identity())
    model.addJointFrame(1)
    model.addJointFrame(2)
    model.addFrame(pin.Frame("rim", 2, pin.SE3.Identity(), pin.FrameType.OP_FRAME))
    if travel:
        model.lowerPositionLimit[7], model.upperPositionLimit[7] = travel
    return fflin.from_model(model, **fields)


@pytest.mark.parametrize(
    "dt, engine",
    [
        (0.0, "python"),
        (0.1, "python"),
        pytest.param(0.1, "compiled", marks=pytest.mark.compiled),
    ],
)
@pytest.mark.parametrize("drag", [0.0, 1e-4])
@pytest.mark.parametrize("joint", [pin.JointModelRUBZ, pin.JointModelRZ])
def test_at_its_own_spin_a_satellite_applies_the_inputs_of_the_operating_point(
    joint, drag, dt, engine
):
    """A continuous and a revolute joint without limits, without and with drag."""
    robot = hub_with_wheel(joint(), damping={"wheel": drag})
    v = fflin.velocity(robot, {"wheel": 100.0})
    u = fflin.equilibrium(robot, v=v).u
    lin = fflin.linearize(robot, v=v, u=u)
    lin = lin.discretize(dt) if dt else lin
    gain = fflin.lqr(lin)
    assert "q_m.wheel" not in gain.regulated and "qdot_m.wheel" in gain.regulated
    assert not gain.K[:, lin.state_names.index("q_m.wheel")].any()
    law = fflin.StateFeedback(lin, gain.K)
    motion = fflin.simulate(robot, law, v0=v, duration=3.0, dt=0.1, engine=engine)
    # Without drag, all rates of the Python engine are exactly zero. With drag, they are sums that
    # cancel up to rounding. The compiled engine rounds the conserved momentum, 100 rad/s.
    rounding = 0.0 if engine == "python" and not drag else 1e-10
    speed = motion.x[:, lin.state_names.index("qdot_m.wheel")]
    assert np.abs(speed - 100.0).max() <= rounding
    assert np.abs(motion.u - lin.u0).max() <= rounding
    verdict = str(motion).splitlines()[0]
    assert verdict.startswith("settled") and "joints" not in verdict


def test_a_symmetric_joint_at_rest_is_regulated_and_a_named_one_is_not():
    robot = hub_with_wheel()
    lin = fflin.linearize(robot)
    assert lin.ignorable[-1] == "q_m.wheel" and lin.wheels == ()
    assert regulated_part(lin) is lin and "q_m.wheel" in fflin.lqr(lin).regulated
    named = robot.replace(wheel_joints=["wh*"])
    assert named.wheel_joints == ("wheel",) and named.wheels == pytest.approx(
        {"wheel": 0.02}
    )
    lin = fflin.linearize(named)
    assert lin.wheels == ("wheel",) and "q_m.wheel" not in fflin.lqr(lin).regulated
    # The name stays with other changes, and goes with the joint.
    assert named.replace(gravity=(0, 0, -1.0)).wheels == named.wheels
    assert fflin.jam(named, ["wheel"]).robot.wheels == {}


@pytest.mark.parametrize("factor, flown", [(0.5, False), (2.0, True), (-2.0, True)])
def test_a_joint_spins_above_a_speed(factor, flown):
    """Rates that planning or rounding leaves at a joint at rest do not make it a wheel."""
    robot = hub_with_wheel()
    v = fflin.velocity(robot, {"wheel": factor * SPINNING})
    lin = fflin.linearize(robot, v=v)
    assert lin.is_equilibrium() and lin.wheels == (("wheel",) if flown else ())
    assert ("q_m.wheel" in fflin.lqr(lin).regulated) != flown


@pytest.mark.parametrize(
    "changes, why",
    [
        ({"inertia": (0.01, 0.011, 0.02)}, "its link is not symmetric"),
        ({"joint": pin.JointModelPZ()}, "its link is not symmetric"),
        ({"stiffness": {"wheel": 1.0}}, "it has a spring"),
        ({"outputs": [fflin.FramePose("rim")]}, "an input or output is mounted"),
    ],
    ids=lambda value: value.split()[-1] if isinstance(value, str) else "",
)
def test_a_joint_that_cannot_spin_freely_is_not_a_wheel(changes, why):
    """It cannot be named, and its spin is no steady motion."""
    robot = hub_with_wheel(**changes)
    with pytest.raises(fflin.InputError, match=why):
        robot.replace(wheel_joints=["wheel"])
    v = fflin.velocity(robot, {"wheel": 2.0})
    lin = fflin.linearize(robot, v=v)
    assert lin.wheels == () and not lin.is_equilibrium()
    assert fflin.linearize(robot).is_equilibrium()


@pytest.mark.parametrize(
    "changes",
    [
        {"joint": pin.JointModelRZ(), "travel": (-3.0, 3.0)},
        {"limits": {"q_m.wheel": 100.0}},
    ],
    ids=["URDF", "robot"],
)
def test_a_rotor_with_limits_stays_a_joint(changes):
    """Its angle is regulated even if it moves, which the report of the gain states."""
    robot = hub_with_wheel(**changes)
    with pytest.raises(fflin.InputError, match="it has position limits"):
        robot.replace(wheel_joints=["wheel"])
    gain = fflin.lqr(fflin.linearize(robot))
    assert "q_m.wheel" in gain.regulated and "position limits" not in str(gain)
    lin = fflin.linearize(robot, v=fflin.velocity(robot, {"wheel": 2.0}))
    assert lin.wheels == () and lin.is_equilibrium()
    gain = fflin.lqr(lin)
    assert "q_m.wheel" in gain.regulated
    assert "has position limits" in " ".join(str(gain).split())


def test_limits_that_no_spin_reaches_are_ignored():
    robot = hub_with_wheel(pin.JointModelRZ(), travel=(-1e16, 1e16))
    lin = fflin.linearize(robot, v=fflin.velocity(robot, {"wheel": 100.0}))
    assert lin.wheels == ("wheel",) and lin.is_equilibrium()


def test_a_wheel_that_is_no_longer_balanced_is_a_joint_again():
    robot = hub_with_wheel(wheel_joints=["wheel"])
    uneven = robot.with_mass_properties(
        {"wheel": {"inertia": np.diag([0.01, 0.012, 0.02])}}
    )
    assert robot.wheels and uneven.wheels == {}
    assert "q_m.wheel" in fflin.lqr(fflin.linearize(uneven)).regulated


def test_values_for_all_joints_are_not_for_wheels():
    """As with `ReactionWheel`: springs, dampers and limits of all joints omit the wheels."""
    robot, _ = spun(AXES[:2])
    robot = robot.replace(
        wheel_joints=["wheel_*"], damping=0.3, stiffness=2.0, limits={"q_m": 1.0}
    )
    assert robot.damping == {"arm": 0.3} and robot.stiffness == {"arm": 2.0}
    assert robot.limits == {"q_m.arm": (-1.0, 1.0)}
    assert robot.replace(damping={"wheel_1": 0.1}).damping == {"wheel_1": 0.1}


@pytest.mark.parametrize("ending", [".npz", ".mat", ".json"])
@pytest.mark.parametrize("spinning", [True, False])
def test_files_keep_the_wheels(ending, spinning, tmp_path):
    (_, lin), _ = models(spinning=spinning)
    lin.save(tmp_path / f"m{ending}")
    loaded = fflin.LinearModel.load(tmp_path / f"m{ending}")
    assert loaded.wheels == lin.wheels and len(lin.wheels) == 4
    expected = fflin.lqr(lin)
    assert fflin.lqr(loaded).regulated == expected.regulated
    assert (fflin.lqr(loaded).K == expected.K).all()


@pytest.mark.parametrize("ending", ["npz", "h5"])
def test_batches_keep_the_wheels_of_each_point(ending, tmp_path):
    if ending == "h5":
        pytest.importorskip("h5py")
    robot, _ = spun(AXES[:2])
    v = [fflin.velocity(robot, item) for item in ({}, {"wheel_2": 30.0})]
    batch = fflin.sweep(robot, [robot.neutral()] * 2, v)
    batch.save(tmp_path / f"b.{ending}")
    for read in (None, robot):
        result = fflin.LinearBatch.load(tmp_path / f"b.{ending}", read)
        assert [item.wheels for item in result] == [(), ("wheel_2",)]
    named = robot.replace(wheel_joints=["wheel_1"])
    batch = fflin.sweep(named, [robot.neutral()] * 2, v)
    batch.save(tmp_path / f"n.{ending}")
    result = fflin.LinearBatch.load(tmp_path / f"n.{ending}")
    assert [item.wheels for item in result] == [("wheel_1",), ("wheel_1", "wheel_2")]


def test_the_gain_in_the_coordinates_of_tools_matches_reaction_wheels():
    (_, lin), (_, other) = models((BaseTorque(),))
    gain, expected = fflin.lqr(lin), fflin.lqr(other)
    for tool in ("pinocchio", "mujoco", "drake"):
        converted, twin = gain.to(tool), expected.to(tool)
        names, others = converted.model.state_names, twin.model.state_names
        x = [names.index(name) for name in others]
        _, u = matched(lin, other)
        K = converted.K[np.ix_(u, x)]
        assert np.abs(K - twin.K).max() < 100.0 * CLOSE * np.abs(twin.K).max()
        angles = [i for i, name in enumerate(names) if "wheel" in name][:4]
        assert not converted.K[:, angles].any()


def test_campaigns_do_not_count_the_angles_of_wheels():
    robot, twin = spun(AXES[:3], others=(BaseTorque(),))
    state = fflin.StateMap(robot)
    v = fflin.velocity(robot, speeds_of(robot))
    kind = dict(zip(state.names, kinds_of(state, robot.wheels_at(v)), strict=True))
    assert kind["q_m.wheel_1"] == -1 and kind["qdot_m.wheel_1"] == 0
    assert list(KINDS)[kind["q_m.arm"]] == "joints"
    result = []
    for item in (robot, twin):
        speeds = fflin.velocity(item, speeds_of(item))
        lin = fflin.linearize(item, v=speeds)
        law = fflin.StateFeedback(lin, fflin.lqr(lin).K)
        result.append(
            fflin.monte_carlo(
                item,
                law,
                {"q_m.arm": 0.1},
                runs=4,
                v0=speeds,
                duration=1.0,
                dt=0.05,
                engine="python",
                seed=3,
            )
        )
    assert result[0].largest == pytest.approx(result[1].largest, rel=1e-6, abs=1e-9)


def test_speed_limits_of_wheels_are_enforced():
    """A commanded torque is reduced near the largest speed, as for `ReactionWheel`."""
    motions = []
    for robot in spun(AXES[:3], others=(BaseTorque(),)):
        lin = fflin.linearize(robot, v=fflin.velocity(robot, {"wheel_1": 100.0}))
        law = fflin.StateFeedback(lin, fflin.lqr(lin, 1.0, 1.0).K)
        names = ("wheel_1", "tau_m.wheel_1")
        motor = next(i for i, name in enumerate(lin.input_names) if name in names)
        v0 = fflin.velocity(robot, {"wheel_1": 99.0})
        limits = {"qdot_m.wheel_1": 99.5}
        motion = fflin.simulate(robot, law, v0=v0, duration=1.0, dt=0.01, limits=limits)
        speed = motion.x[:, lin.state_names.index("qdot_m.wheel_1")]
        assert speed.max() < 99.5 + 1e-6 and speed[-1] > 99.4
        motions.append(motion.u[:, motor])
    # The gains agree to 10 CLOSE, and the torques are about 1 N m.
    assert motions[0] == pytest.approx(motions[1], abs=10.0 * CLOSE)


def test_speed_limits_of_all_joints_do_not_apply_to_wheels():
    """As with `ReactionWheel`, whose speeds are far above the speeds of joints."""
    for robot in spun(AXES[:3], others=(BaseTorque(),)):
        lin = fflin.linearize(robot, v=fflin.velocity(robot, speeds_of(robot)))
        law = fflin.StateFeedback(lin, fflin.lqr(lin).K)
        q0 = fflin.configuration(robot, {"arm": 0.3})
        motion = fflin.simulate(
            robot, law, q0=q0, v0=lin.v, duration=1.0, dt=0.05, limits={"qdot_m": 10.0}
        )
        assert not motion.passed and not motion.saturated
        limited = {name for name in motion.limit_names if name.startswith("qdot_m")}
        assert limited == {"qdot_m.arm"}
        policy = fflin.mpc(lin, horizon=3, dt=0.2, limits={"qdot_m": 10.0})
        assert policy.horizon.limited == ("qdot_m.arm",)


def test_a_planned_motion_leaves_the_angle_of_a_spinning_wheel_free():
    """As with `ReactionWheel`: the goal's angle is 0, but the wheel turns by 4 rad on the way."""
    robot = hub_with_wheel()
    v = fflin.velocity(robot, {"wheel": 2.0})
    goal = (robot.neutral(), v)
    motion = fflin.plan(robot, goal, 2.0, v0=v, knots=5)
    joint = robot.joint("wheel")
    assert joint.value(motion.q[-1]) == pytest.approx(4.0 - 2.0 * np.pi, abs=1e-6)
    assert np.abs(motion.u).max() < 1e-6


def test_a_wheel_without_a_motor_keeps_its_momentum():
    """A spinning wheel that no input drives: its speed follows from the rotation of the hub."""
    robot = hub_with_wheel(inputs=[BaseTorque(), BaseForce()])
    lin = fflin.linearize(robot, v=fflin.velocity(robot, {"wheel": 50.0}))
    for wheel_speeds in (None, True, False):
        gain = fflin.lqr(lin, wheel_speeds=wheel_speeds)
        assert (
            not any("wheel" in name for name in gain.regulated)
            and len(gain.regulated) == 12
        )
    # The hub feels the gyroscopic torque -omega x h of h = 50 * 0.02 about z.
    at = [lin.state_names.index(f"omega_b.{axis}") for axis in "xy"]
    gyro = lin.A[np.ix_(at, at)]
    assert gyro == pytest.approx(
        np.array([[0.0, -1.0 / 4.01], [1.0 / 5.01, 0.0]]), rel=1e-9
    )


def test_the_wrist_of_a_moving_arm_is_not_a_wheel():
    # The last link of ets_vii is symmetric about its joint, which has no limits.
    robot = fflin.load("ets_vii")
    wrist = robot.joint_names[-1]
    assert wrist in robot.free_rotors
    assert set(robot.wheels_at(fflin.velocity(robot, {wrist: 0.1}))) == {wrist}
    assert not robot.wheels_at(fflin.velocity(robot, {"joint_*": 0.1}))
    lin = fflin.linearize(robot, v=fflin.velocity(robot, {"joint_2": 0.1, wrist: 0.1}))
    assert lin.wheels == ()
