"""One law by every road: each way to fly it gives the same motion, message and notes.

The roads are `StateFeedback`, the same law as a `LinearController` of the states, as exported C, as
a function of q and v, each in the engines that fly it, and the command line.
"""

import warnings
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.simulation.simulate import past_half_turn
from tests.support.c_code import needs_compiler
from tests.support.commands import run, warned
from tests.support.marks import exhaustive
from tests.support.messages import any_wording
from tests.support.motions import displaced
from tests.support.robots import free_body

# The roads add the terms of one law in another order, so their commands differ by some eps of the
# largest term. Over 200 steps, this adds up to some 200 times that.
TOLERANCE = 2e3 * np.finfo(float).eps

WHEELS = [
    fflin.ReactionWheel(axis, inertia=0.05, max=0.2) for axis in np.eye(3).tolist()
]


def body(**fields):
    return free_body((2.0, 3.0, 2.5)).replace(
        inputs=[fflin.BaseTorque(), fflin.BaseForce()], **fields
    )


def with_wheels():
    return free_body((2.0, 3.0, 2.5)).replace(inputs=WHEELS)


def arm():
    return fflin.load("planar_detumble")


def heavy():
    """A body that its inputs hold against gravity, so that u0 is not zero."""
    return body(gravity=(0.0, 0.001, -0.002))


def start(robot, degrees, rate):
    """A displaced start that rotates away from the target at `rate` [rad/s]."""
    x = displaced(fflin.linearize(robot), degrees, spread=0.2)
    axis = np.array([2.0, -1.0, 2.0]) / 3.0
    x[6 + robot.n : 9 + robot.n] = rate * axis
    return x


def feedback(robot, sample):
    q = robot.neutral()
    lin = fflin.linearize(robot, q, None, fflin.equilibrium(robot, q).u)
    lin = lin.discretize(sample) if sample else lin
    return fflin.StateFeedback(lin, fflin.lqr(lin).K)


def states(robot, q, v):
    """The state in the frame hybrid, written out: omega_b in base axes, v_b in world axes."""
    R = pin.Quaternion(q[3:7]).toRotationMatrix()
    shorter = q[3:6] if q[6] >= 0.0 else -q[3:6]
    joints = []
    for joint in robot.joints:
        i = joint.idx_q
        # A continuous joint has its cosine and sine in q. Its target angle is 0.
        angle = np.arctan2(q[i + 1], q[i]) if joint.unbounded else q[i]
        joints.append(angle)
    rates = [v[joint.idx_v] for joint in robot.joints]
    return np.concatenate((shorter, q[:3], joints, v[3:6], R @ v[:3], rates))


def as_function(policy, robot):
    K, u0 = np.array(policy.K), np.array(policy.lin.u0)
    return lambda t, q, v: u0 - K @ states(robot, q, v)


def roads(policy, robot, delay):
    """Return {road: (policy, options)} of the roads in Python."""
    result = {"controller": (fflin.LinearController(-policy.K, policy.lin), {})}
    # a function has no u0 that acts before its commands
    if not (delay and policy.lin.u0.any()):
        result["function"] = (
            as_function(policy, robot),
            {"sample": policy.lin.dt or None},
        )
    return result


CASES = {
    "near": {"degrees": 20.0, "rate": 0.05, "sample": 0.1},
    "past half a turn": {"degrees": 170.0, "rate": 1.5, "sample": 0.1},
    "past half a turn, continuous": {"degrees": 160.0, "rate": 1.5},
    "several turns": {"degrees": 20.0, "rate": 6.0, "sample": 0.1},
    "limits": {"degrees": 170.0, "rate": 1.0, "sample": 0.1, "limits": 0.15},
    "limits, continuous": {"degrees": 60.0, "rate": 1.0, "limits": 0.15},
    "delay": {"degrees": 150.0, "rate": 1.0, "sample": 0.1, "delay": 0.06},
    "delay and limits": {"degrees": 170.0, "rate": 1.0, "delay": 0.04, "limits": 0.15},
}
ROBOTS = {"body": body, "wheels": with_wheels, "arm": arm, "heavy": heavy}
QUICK = [
    ("body", "past half a turn"),
    ("wheels", "limits"),
    ("arm", "past half a turn, continuous"),
    ("heavy", "delay and limits"),
]
OTHERS = [
    (robot, case) for robot in ROBOTS for case in CASES if (robot, case) not in QUICK
]


def prepared(name, case):
    """Return a robot, its law as `StateFeedback`, and the options of a case."""
    robot, case = ROBOTS[name](), CASES[case]
    options = {"dt": 0.02, "duration": 4.0, "limits": case.get("limits")}
    options["delay"] = case.get("delay", 0.0)
    options["x0"] = start(robot, case["degrees"], case["rate"])
    return robot, feedback(robot, case.get("sample")), options


def flown(robot, policy, **options):
    with warnings.catch_warnings():
        warnings.simplefilter("error", fflin.FflinWarning)
        return fflin.simulate(robot, policy, **options)


def commanded(policy, motion):
    """Return the size (nu,) of the terms of a command, whose rounding a limit does not reduce."""
    return (np.abs(policy.K) @ np.abs(motion.x - policy.lin.x0).T).max(axis=1)


def assert_same(motion, other, road, command=1.0):
    assert other.stopped == motion.stopped, road
    # The cosine and the sine of an angle of many turns have the rounding of the angle.
    turned = np.abs(motion.v[:, 6:]).max(initial=0.0) * motion.t[-1]
    for key in ("t", "q", "v", "u"):
        expected, given = getattr(motion, key), getattr(other, key)
        assert given.shape == expected.shape, (road, key)
        size = np.maximum(1.0, np.abs(expected).max(axis=0))
        if key == "u":
            size = np.maximum(size, command)
        if key == "q":
            size[7:] = np.maximum(size[7:], turned)
        apart = (np.abs(given - expected) / size).max()
        assert apart <= TOLERANCE, (road, key, apart)


@pytest.mark.parametrize(("name", "case"), [*QUICK, *exhaustive(*OTHERS)])
def test_a_law_flies_the_same_motion_in_each_form(name, case):
    robot, policy, options = prepared(name, case)
    motion = flown(robot, policy, **options, engine="python")
    assert not motion.stopped and np.abs(motion.u).max() > 1e-3
    # Past half a turn, q_b jumps from one end of its range to the other.
    jumps = np.linalg.norm(np.diff(motion.x[:, :3], axis=0), axis=1) > 1.0
    assert any("past 180 deg" in note for note in motion.notes) == jumps.any()
    assert (motion.linear is None) == jumps.any()
    assert motion.attitude_error.max() <= 180.0
    for road, (controller, more) in roads(policy, robot, options["delay"]).items():
        assert_same(
            motion, flown(robot, controller, **options, **more, engine="python"), road
        )


@needs_compiler
@pytest.mark.parametrize(
    ("name", "case"), [*QUICK[::3], *exhaustive(*QUICK[1:3], *OTHERS)]
)
def test_exported_c_flies_the_same_motion(tmp_path, name, case):
    robot, policy, options = prepared(name, case)
    code = fflin.CLaw(fflin.write_c(policy, tmp_path))
    motion = flown(robot, policy, **options, engine="python")
    other = flown(robot, code, **options)
    assert_same(motion, other, "C")
    # The law in C has no model, and so no prediction. The remarks about the law are the same.
    # The code contains no model, so that its motion has no note on the delay of the design.
    notes = [note for note in motion.notes if "designed for a delay" not in note]
    assert [x.partition("; the linear")[0] for x in notes] == [*other.notes]


@pytest.mark.compiled
@pytest.mark.parametrize(("name", "case"), [*QUICK, *OTHERS])
def test_both_engines_fly_the_same_motion(name, case):
    pytest.importorskip("numba")
    robot, policy, options = prepared(name, case)
    motion = flown(robot, policy, **options, engine="python")
    controller = fflin.LinearController(-policy.K, policy.lin)
    for road, by_key in {"state feedback": policy, "controller": controller}.items():
        other = flown(robot, by_key, **options, engine="compiled")
        assert_same(motion, other, road, commanded(policy, motion))
        assert other.notes == motion.notes


def test_the_cases_are_on_both_sides_of_half_a_turn():
    robot, policy, options = prepared("body", "near")
    assert not flown(robot, policy, **options).notes
    robot, policy, options = prepared("body", "several turns")
    assert flown(robot, policy, **options).notes


def test_a_rotation_is_measured_from_a_moving_attitude_of_either_sign():
    t = np.linspace(0.0, 10.0, 101)
    none = np.zeros((len(t), 2))
    turned = np.column_stack((none, np.sin(0.5 * t), np.cos(0.5 * t)))  # by 1 rad/s
    run = SimpleNamespace(t=t, q=np.hstack((np.zeros((len(t), 3)), turned)))
    signs = np.random.default_rng(0).choice([-1.0, 1.0], (len(t), 1))
    assert past_half_turn(run, signs * turned) is None
    # pi s
    assert past_half_turn(run, turned[0]) == past_half_turn(run, -turned[0]) == t[32]
    slower = np.column_stack((none, np.sin(0.2 * t), np.cos(0.2 * t)))
    assert past_half_turn(run, signs * slower) == t[53]  # pi / 0.6 s


# exactly half a turn: its scalar part is 0
EDGE = pin.Quaternion(0.0, 0.6, 0.0, 0.8).coeffs()


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_law_is_defined_at_exactly_half_a_turn(sign):
    """The sign of the quaternion selects one of the two shortest rotations, by every road."""
    robot = fflin.load(
        "cubesat", outputs=[fflin.BasePose(), fflin.Accelerometer("base")]
    )
    robot = robot.replace(inputs=[fflin.BaseTorque(), fflin.BaseForce()])
    lin = fflin.linearize(robot).discretize(0.1)
    q0 = np.array([0.0, 0.0, 0.0, *(sign * EDGE)])
    v = np.zeros(6)
    K = fflin.lqr(lin).K
    expected = -K @ np.array([*(sign * EDGE[:3]), *np.zeros(9)])
    state = fflin.StateFeedback(lin, K)
    seen = np.zeros(lin.D.T.shape)
    seen[:, :6] = -K[:, :6]
    output = fflin.LinearController(seen, lin)
    assert lin.output_names[:3] == lin.state_names[:3]
    for policy in (state, output, fflin.Allocation(state, robot)):
        np.testing.assert_allclose(
            policy.bind(robot)(0.0, q0, v), expected, rtol=1e-12, atol=1e-15
        )
        motion = fflin.simulate(robot, policy, q0=q0, duration=0.2, engine="python")
        assert not motion.stopped
    y = fflin.outputs(robot, lin, q0, v)
    np.testing.assert_allclose(y[:3], sign * EDGE[:3], atol=1e-15)


def test_predictive_control_within_limits_is_its_regulator():
    robot, _, options = prepared("body", "past half a turn")
    policy = fflin.mpc(
        fflin.linearize(robot), horizon=10, dt=0.1, limits={"tau_b": 1e3}
    )
    regulator = fflin.StateFeedback(policy.lin, policy.gain.K)
    options["duration"] = 1.0
    motion = flown(robot, regulator, **options)
    assert motion.notes
    assert_same(motion, flown(robot, policy, **options), "mpc")


def test_a_run_of_a_campaign_is_the_motion_of_its_law():
    robot, policy, options = prepared("body", "past half a turn")
    motion = flown(robot, policy, **options)
    given = {"omega_b.x": 0.0}
    campaign = fflin.monte_carlo(
        robot, policy, given, runs=2, **options, engine="python"
    )
    assert not campaign.stopped.any()
    np.testing.assert_array_equal(campaign.q, np.tile(motion.q[-1], (2, 1)))
    largest = motion.attitude_error.max()
    np.testing.assert_allclose(campaign.values("worst attitude"), largest, rtol=1e-12)
    assert largest <= 180.0


def test_a_trajectory_is_followed_from_beyond_half_a_turn():
    """A law along a motion at rest is the law about the point at which it rests."""
    robot = body()
    t, q = np.array([0.0, 4.0]), np.tile(robot.neutral(), (2, 1))
    rest = fflin.Trajectory(
        robot, t, q, np.zeros((2, 6)), np.zeros((2, 6)), frame="local"
    )
    along = fflin.linearize_trajectory(robot, rest)
    schedule = fflin.tvlqr(along, sample=0.1)
    # A constant gain, as the regulator about the point has.
    lin = fflin.linearize(robot, frame="local").discretize(0.1)
    steady = fflin.StateFeedback(lin, schedule.K[-1])
    constant = replace(schedule, K=np.tile(schedule.K[-1], (len(schedule.K), 1, 1)))
    policy = fflin.TrajectoryFeedback(along, constant)
    _, _, options = prepared("body", "past half a turn")
    del options["x0"]
    q0, v0 = policy.beside({"roll": 175.0})
    v0[3] = 3.0
    options |= {"q0": q0, "v0": v0, "duration": 3.0}
    motion, other = (
        flown(robot, controller, **options, engine="python")
        for controller in (steady, policy)
    )
    assert_same(motion, other, "trajectory")
    assert motion.notes[0].startswith(
        "the base rotated past 180 deg from the reference at t = "
    )
    assert (
        other.notes[0]
        == motion.notes[0]
        .replace("reference", "trajectory")
        .partition("; the linear")[0]
    )


URDF = """<robot name="body"><link name="base"><inertial><mass value="{m}"/>
<inertia ixx="{x}" iyy="{y}" izz="{z}" ixy="0" ixz="0" iyz="0"/></inertial></link>{more}</robot>"""
WHEEL = """<link name="rotor"><inertial><mass value="1"/>
<inertia ixx="0.03" iyy="0.03" izz="0.05" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="spin" type="continuous"><parent link="base"/><child link="rotor"/>
<axis xyz="0 0 1"/></joint>"""


def test_a_wheel_of_the_urdf_moves_as_the_same_reaction_wheel(tmp_path):
    """The link of a reaction wheel contains the whole wheel, the link of a URDF wheel none of it.

    The wheel has the axial inertia 0.05 kg m^2, the transverse inertia 0.03 kg m^2 and 1 kg.
    """
    whole, carrier = tmp_path / "whole.urdf", tmp_path / "carrier.urdf"
    whole.write_text(URDF.format(m=21, x=2.03, y=3.03, z=2.55, more=""))
    carrier.write_text(URDF.format(m=20, x=2.0, y=3.0, z=2.5, more=WHEEL))
    base = [fflin.BaseTorque(), fflin.BaseForce()]
    wheel = fflin.ReactionWheel((0, 0, 1), name="spin", inertia=0.05)
    of_object = fflin.load(whole, inputs=[*base, wheel])
    of_urdf = fflin.load(carrier, inputs=[*base, fflin.JointTorque("spin")])
    models = [fflin.linearize(item) for item in (of_object, of_urdf)]
    for key in ("A", "B"):
        one, other = (getattr(lin, key) for lin in models)
        np.testing.assert_allclose(one, other, atol=1e-12, err_msg=key)
    x0 = start(of_object, 170.0, 1.0)
    # speed of the wheel [rad/s], whose momentum of 5 N m s turns the body
    x0[-1] = 100.0
    options = {"x0": x0, "dt": 0.02, "duration": 4.0}
    free = [fflin.simulate(item, **options) for item in (of_object, of_urdf)]
    assert_same(*free, "free")
    K = np.zeros(models[0].B.T.shape)
    K[:3, :3], K[:3, 7:10] = 4.0 * np.eye(3), 3.0 * np.eye(3)
    pairs = zip((of_object, of_urdf), models, strict=True)
    laws = [
        fflin.simulate(item, fflin.StateFeedback(lin, K), **options)
        for item, lin in pairs
    ]
    assert_same(*laws, "law")
    assert laws[0].notes == laws[1].notes != ()


def in_python(call):
    """Return the warnings of fflin while a function is called."""
    with warnings.catch_warnings(record=True) as result:
        warnings.simplefilter("always")
        call()
    return {
        str(item.message)
        for item in result
        if issubclass(item.category, fflin.FflinWarning)
    }


def test_the_command_line_flies_the_motion_of_python(tmp_path):
    """With its default limits, rule of the weights, and prediction."""
    robot = fflin.load("planar_detumble")
    lin = fflin.linearize(robot)
    sampled = lin.discretize(0.1)
    policy = fflin.StateFeedback(sampled, fflin.lqr(sampled).K)
    q0 = fflin.configuration(robot, {"joint_1": 0.3})
    for rate in (0.05, 4.0):
        v0 = fflin.velocity(robot, {"omega_b.z": rate})
        options = {"q0": q0, "v0": v0, "duration": 6.0, "dt": 0.05, "limits": "urdf"}
        motion = fflin.simulate(robot, policy, **options, linear=lin)
        file = tmp_path / f"{rate}.npz"
        given = (
            "--joint",
            "joint_1=0.3",
            "--velocity",
            f"omega_b.z={rate}",
            "--sample",
            0.1,
        )
        with any_wording():
            times = ("--duration", 6, "--dt", 0.05)
            code, *_ = run("simulate", robot.name, *given, *times, "-o", file)
        loaded = fflin.Motion.load(file)
        assert code == 0 and loaded.stopped == motion.stopped == ""
        assert loaded.notes == motion.notes
        assert bool(loaded.notes) == (rate > 1.0)
        for key in ("t", "q", "v", "u", "x", "prediction"):
            np.testing.assert_array_equal(
                getattr(loaded, key), getattr(motion, key), key
            )


def jets():
    return fflin.linearize(fflin.load("cubesat", inputs=fflin.load_inputs("cubesat")))


def fragile():
    lin = fflin.linearize(fflin.load("planar_detumble")).discretize(0.5)
    fflin.lqr(lin, weights={"rule": "identity", "q": {"q_b": 1e9}})


def displaced_joint(name, value):
    robot = fflin.load(name)
    fflin.linearize(robot, fflin.configuration(robot, {"joint_2": value}))


WARNINGS = {
    "degrees": (
        ("linearize", "servicer_7dof", "--joint", "joint_2=45"),
        lambda: displaced_joint("servicer_7dof", 45.0),
        "outside",
    ),
    "negative thrust": (
        ("lqr", "cubesat", "--inputs", "cubesat", "--no-allocate"),
        lambda: fflin.lqr(jets()),
        "negative thrust",
    ),
    "margin": (
        (
            "lqr",
            "planar_detumble",
            "--sample",
            0.5,
            "--weights",
            "identity",
            "--q",
            "q_b=1e9",
        ),
        fragile,
        "phase margin",
    ),
    "damping": (
        ("linearize", "planar_detumble"),
        lambda: fflin.linearize(fflin.load("planar_detumble")),
        "damping",
    ),
}


@pytest.mark.parametrize("case", WARNINGS)
def test_a_command_gives_the_warnings_of_the_python_call(case):
    command, call, word = WARNINGS[case]
    with any_wording():
        message = warned(*command)
    assert message == in_python(call)
    assert any(word in item for item in message)


def test_each_public_regulator_warns_and_designs_that_contain_one_do_not():
    [text] = in_python(lambda: fflin.acceleration_lqr(jets(), 1.0, 1.0, 1.0))
    assert "negative thrust" in text
    lin = fflin.linearize(fflin.load("cubesat"))
    weights = {"rule": "identity", "q": {"q_b": 1e9}}
    [text] = in_python(lambda: fflin.lqr(lin.discretize(0.5), weights=weights))
    assert "phase margin" in text
    within = {"horizon": 2, "dt": 0.5, "limits": {"tau_b": 1e9}}
    assert not in_python(lambda: fflin.mpc(lin, weights=weights, **within))


def test_a_joint_is_warned_of_only_beyond_its_limits(tmp_path):
    file = tmp_path / "hinge.urdf"
    limited = WHEEL.replace("continuous", "revolute").replace(
        "<axis", '<limit lower="-0.5" upper="1" effort="1" velocity="1"/><axis'
    )
    file.write_text(URDF.format(m=20, x=2.0, y=3.0, z=2.5, more=limited))
    robot = fflin.load(file)
    for value, beyond in ((-0.5, False), (1.0, False), (-0.6, True), (1.1, True)):
        result = in_python(
            lambda value=value: fflin.configuration(robot, {"spin": value})
        )
        message = {f"joint 'spin' at {value:g} rad is outside -0.5 to 1 rad"}
        assert result == (message if beyond else set())
