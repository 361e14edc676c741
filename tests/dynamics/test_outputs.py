"""Outputs: closed forms and laws first, then every derivative against differences."""

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.base.rotation import skew
from fflin.dynamics.outputs import Sensing
from fflin.dynamics.state import StateMap
from fflin.robot.outputs import (
    Accelerometer,
    BasePose,
    CenterOfMass,
    FramePose,
    FrameVelocity,
    FullState,
    Gyroscope,
    JointPositions,
    JointVelocities,
    Momentum,
    RelativePose,
)
from tests.support.robots import mostly, random_pose, random_tree

E, O = np.eye(3), np.zeros((3, 3))
GRAVITY = np.array([0.7, -1.3, -9.6])
ORBIT, SPEED = 7e6, 7.6e3
# Weights of f(-3h) ... f(3h) in the sixth-order central difference.
STEPS = np.array([-3.0, -2.0, -1.0, 1.0, 2.0, 3.0])
WEIGHTS = np.array([-1.0, 9.0, -45.0, 45.0, -9.0, 1.0]) / 60.0


def with_sensor(model, joint, placement):
    """A robot with a frame named imu at a placement on a joint, and one on every joint."""
    model = model.copy()
    for index, name in enumerate(model.names):
        if not model.existFrame(name):
            model.addFrame(
                pin.Frame(name, index, pin.SE3.Identity(), pin.FrameType.JOINT)
            )
    model.addFrame(pin.Frame("imu", joint, placement, pin.FrameType.OP_FRAME))
    return fflin.from_model(model)


def bundled(name):
    """A bundled robot with a sensor off the axes of its last link."""
    model = fflin.load(name).model
    return with_sensor(
        model, model.njoints - 1, random_pose(np.random.default_rng(7), 100.0)
    )


def tree(seed):
    rng = np.random.default_rng(seed)
    model = random_tree(rng, 8).model
    return with_sensor(model, model.njoints - 1, random_pose(rng, 100.0))


def moved_root():
    """A free flyer joint that itself stands turned and away in the world."""
    model = fflin.load("dual_arm").model.copy()
    model.jointPlacements[1] = random_pose(np.random.default_rng(8), 110.0)
    return with_sensor(model, 5, random_pose(np.random.default_rng(9), 40.0))


ROBOTS = {
    "servicer_7dof": lambda: bundled("servicer_7dof"),
    "dual_arm": lambda: bundled("dual_arm"),
    "ets_vii": lambda: bundled("ets_vii"),
    "moved_root": moved_root,
    "tree_1": lambda: tree(1),
    "tree_2": lambda: tree(2),
}


def point(robot, rng, degrees=None, speed=1.0):
    """A random (q, v, a)."""
    angle = rng.uniform(20.0, 160.0) if degrees is None else degrees
    joints = {joint.name: rng.uniform(-2.5, 2.5) for joint in robot.joints}
    q = fflin.configuration(robot, joints, random_pose(rng, angle))
    v, a = rng.normal(size=(2, robot.nv))
    v[:3] *= speed
    return q, v, a


def all_measured(robot, frame="imu"):
    """Every output that is not a state, of a frame; of another one too where there is one."""
    last = robot.model.names[robot.model.njoints // 2]
    return [
        FramePose(frame),
        CenterOfMass(),
        FrameVelocity(frame),
        Momentum(),
        Accelerometer(frame),
        Gyroscope(frame),
        FramePose(last),
        FrameVelocity(last),
        Accelerometer(last),
        RelativePose(frame, last),
        RelativePose(last, frame),
    ]


def measure(robot, outputs, reference, gravity, q, v, a, q_star):
    """y, nonlinear, in the world and out of elementary kinematics only."""
    model, data = robot.model, robot.create_data()
    to_reference = reference.rotation.T
    pin.framesForwardKinematics(model, data, q_star)
    was = [np.array(placement.rotation) for placement in data.oMf]
    pin.forwardKinematics(model, data, q, v, a)
    pin.updateFramePlacements(model, data)
    masses = [inertia.mass for inertia in model.inertias]
    levers = [data.oMi[i].act(model.inertias[i].lever) for i in range(model.njoints)]
    com = sum(m * c for m, c in zip(masses, levers, strict=True)) / sum(masses)
    y = []
    for output in outputs:
        if isinstance(output, CenterOfMass):
            y.append(reference.actInv(com))
            continue
        if isinstance(output, Momentum):
            links = range(1, model.njoints)
            momenta = [data.oMi[i].act(model.inertias[i] * data.v[i]) for i in links]
            linear = sum(h.linear for h in momenta)
            angular = sum(h.angular for h in momenta) - np.cross(com, linear)
            y += [to_reference @ angular, to_reference @ linear]
            continue
        index = next(
            i for i, frame in enumerate(model.frames) if frame.name == output.frame
        )
        frame = model.frames[index]
        oMf = data.oMf[index]
        velocity = frame.placement.actInv(data.v[frame.parentJoint])
        rate = frame.placement.actInv(data.a[frame.parentJoint])
        w, v_f = velocity.angular, velocity.linear
        if isinstance(output, RelativePose):
            seeing = next(
                i for i, frame in enumerate(model.frames) if frame.name == output.to
            )
            relative = data.oMf[seeing].inverse() * oMf
            before = was[seeing].T @ was[index]
            y += [relative.translation, pin.log3(before.T @ relative.rotation)]
        elif isinstance(output, FramePose):
            y += [
                reference.actInv(oMf.translation),
                pin.log3(was[index].T @ oMf.rotation),
            ]
        elif isinstance(output, FrameVelocity):
            y += [w, to_reference @ oMf.rotation @ v_f]
        elif isinstance(output, Gyroscope):
            y.append(w)
        else:
            y.append(rate.linear + np.cross(w, v_f) - oMf.rotation.T @ gravity)
    return np.concatenate(y)


def differences(f, nv, step=1e-2):
    """Jacobian of f(tangent) at zero."""
    return np.column_stack(
        [sum(w * f(s * step * e) for s, w in zip(STEPS, WEIGHTS, strict=True)) / step
         for e in np.eye(nv)]
    )  # fmt: skip


def assert_derivatives(robot, q, v, a, *, gravity=GRAVITY, tolerance=1e-9):
    """Compare y and all of its derivatives to the nonlinear measurement, output by output."""
    reference = random_pose(np.random.default_rng(3), 65.0)
    outputs = all_measured(robot)
    falling = robot.replace(gravity=gravity)
    sensing = Sensing(StateMap(falling, reference=reference), outputs)
    sensed = sensing.evaluate(robot.create_data(), q, v, a)

    def y(q_, v_, a_):
        return measure(robot, outputs, reference, gravity, q_, v_, a_, q)

    expected = (
        differences(lambda d: y(pin.integrate(robot.model, q, d), v, a), robot.nv),
        differences(lambda d: y(q, v + d, a), robot.nv),
        differences(lambda d: y(q, v, a + d), robot.nv),
    )
    value = y(q, v, a)
    for rows in np.arange(len(value)).reshape(-1, 3):
        scale = max(np.abs(value[rows]).max(), 1.0)
        if sensing.names[rows[0]] == "momentum.angular.x":
            # Summed in the world it is the difference of two that hold the linear momentum.
            scale += robot.mass * np.linalg.norm(v[:3])
        assert np.abs(sensed.y[rows] - value[rows]).max() < 1e-12 * scale
        for got, difference in zip(sensed[1:], expected, strict=True):
            size = max(np.abs(difference[rows]).max(), scale)
            worst = np.abs(got[rows] - difference[rows]).max() / size
            assert worst < tolerance, sensing.names[rows[0]]


def test_rigid_body_closed_form():
    """Everything of one rigid body with a sensor off its origin, by hand."""
    rng = np.random.default_rng(1)
    cubesat = fflin.load("cubesat").model.copy()
    cubesat.inertias[1] = pin.Inertia.Random()
    mount = random_pose(rng, 75.0)
    robot = with_sensor(cubesat, 1, mount).replace(gravity=GRAVITY)
    inertia = cubesat.inertias[1]
    m, J, c = inertia.mass, inertia.inertia, inertia.lever
    p, F = mount.translation, mount.rotation.T  # base axes to frame axes
    reference = random_pose(rng, 120.0)
    outputs = all_measured(robot)[:6]
    sensing = Sensing(StateMap(robot, reference=reference), outputs)
    for _ in range(3):
        q, v, a = point(robot, rng)
        refMb = reference.actInv(pin.XYZQUATToSE3(q[:7]))
        R, r = refMb.rotation, refMb.translation
        v_b, w, a_b, w_dot = v[:3], v[3:], a[:3], a[3:]
        g = pin.XYZQUATToSE3(q[:7]).rotation.T @ GRAVITY
        force = (
            a_b
            + np.cross(w, v_b)
            - g
            + np.cross(w_dot, p)
            + np.cross(w, np.cross(w, p))
        )
        h = J @ w
        v_p, v_c = v_b + np.cross(w, p), v_b + np.cross(w, c)
        y = [
            r + R @ p,
            np.zeros(3),
            r + R @ c,
            F @ w,
            R @ v_p,
            R @ h,
            m * R @ v_c,
            F @ force,
            F @ w,
        ]
        # d(w x (w x p))/dw, and of the turning v_b.
        by_w = skew(w) @ -skew(p) - skew(np.cross(w, p)) - skew(v_b)
        by_q = [
            [R, -R @ skew(p)],
            [O, F],
            [R, -R @ skew(c)],
            [O, O],
            [O, -R @ skew(v_p)],
            [O, -R @ skew(h)],
            [O, -m * R @ skew(v_c)],
            [O, -F @ skew(g)],
            [O, O],
        ]
        by_v = [
            *[[O, O]] * 3,
            [O, F],
            [R, -R @ skew(p)],
            [O, R @ J],
            [m * R, -m * R @ skew(c)],
            [F @ skew(w), F @ by_w],
            [O, F],
        ]
        by_a = [*[[O, O]] * 7, [F, -F @ skew(p)], [O, O]]
        sensed = sensing.evaluate(robot.create_data(), q, v, a)
        expected = np.concatenate(y), np.block(by_q), np.block(by_v), np.block(by_a)
        for got, value in zip(sensed, expected, strict=True):
            assert np.abs(got - value).max() < 1e-12 * np.abs(value).max()


def test_body_spinning_about_its_sensors_axis_by_numbers():
    """At 2 rad/s about z, 0.5 m out on x: 2 m/s^2 inwards; g upwards where it stands."""
    robot = with_sensor(
        fflin.load("cubesat").model, 1, pin.SE3(E, np.array([0.5, 0.0, 0.0]))
    )
    state = StateMap(robot)
    v = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 2.0])
    data, q, rest = robot.create_data(), robot.neutral(), np.zeros(6)
    sensed = Sensing(state, [Accelerometer("imu")]).evaluate(data, q, v, rest)
    assert sensed.y == pytest.approx([-2.0, 0.0, 0.0], abs=1e-14)
    assert sensed.by_v[0] == pytest.approx([0.0, -2.0, 0.0, 0.0, 0.0, -2.0], abs=1e-14)
    down = np.array([0.0, 0.0, -9.81])
    state = StateMap(robot.replace(gravity=down))
    standing = Sensing(state, [Accelerometer("imu")]).evaluate(data, q, rest, rest)
    assert standing.y == pytest.approx([0.0, 0.0, 9.81], abs=1e-14)
    # Rolled by d to the left about x, its y axis points up by d.
    assert standing.by_q[1, 3] == pytest.approx(9.81)


@pytest.mark.parametrize("name", ROBOTS)
def test_laws(name):
    robot = ROBOTS[name]()
    rng = np.random.default_rng(2)
    model, data = robot.model, robot.create_data()
    state = StateMap(robot, reference=random_pose(rng, 50.0))
    root = model.names[1]
    outputs = [
        CenterOfMass(),
        Momentum(),
        FramePose("imu"),
        FrameVelocity("imu"),
        Gyroscope(root),
    ]
    sensing = Sensing(state, outputs)
    rows = {name: index for index, name in enumerate(sensing.names)}

    def part(prefix):
        return [rows[f"{prefix}.{axis}"] for axis in "xyz"]

    q, v, a = point(robot, rng)
    sensed = sensing.evaluate(data, q, v, a)
    y, rate = sensed.y, sensed.by_q @ v
    linear = y[part("momentum.linear")]
    assert rate[part("com")] * robot.mass == pytest.approx(
        linear, abs=1e-12 * robot.mass
    )
    # A frame's velocity is the rate of its pose, and momentum and velocity are linear in v.
    assert rate[part("imu.position")] == pytest.approx(
        y[part("imu.velocity")], abs=1e-12
    )
    assert rate[part("imu.rotation")] == pytest.approx(
        y[part("imu.angular_velocity")], abs=1e-12
    )
    moving = [
        index
        for name, index in rows.items()
        if "momentum" in name or "velocity" in name
    ]
    scale = np.abs(y[moving]).max()
    assert sensed.by_v[moving] @ v == pytest.approx(y[moving], abs=1e-13 * scale)
    assert y[part(f"{root}.gyroscope")] == pytest.approx(v[3:6], abs=1e-15)
    # Without forces momentum stays as it is.
    a = pin.aba(model, data, q, v, np.zeros(robot.nv))
    forces = sensed.by_q @ v + sensed.by_v @ a
    kept = part("momentum.angular") + part("momentum.linear")
    assert (
        np.abs(forces[kept]).max()
        < 1e-11 * np.abs(sensed.by_v[kept]).max() * np.abs(a).max()
    )
    # Gyroscope and accelerometer feel no displacement of the base.
    feeling = Sensing(state, [Gyroscope("imu"), Accelerometer("imu")])
    assert not feeling.evaluate(data, q, v, a).by_q[:, :6].any()


def test_accelerometers_do_not_measure_free_fall():
    """Under gravity and no forces an accelerometer reads what it reads without either."""
    robot = ROBOTS["servicer_7dof"]()
    q, v, _ = point(robot, np.random.default_rng(4))
    model = robot.model.copy()
    sensed = []
    for g in (np.zeros(3), GRAVITY):
        model.gravity.linear = g
        a = pin.aba(model, model.createData(), q, v, np.zeros(robot.nv))
        sensing = Sensing(StateMap(robot.replace(gravity=g)), [Accelerometer("imu")])
        sensed.append(sensing.evaluate(robot.create_data(), q, v, a).y)
    assert sensed[1] == pytest.approx(sensed[0], rel=1e-11)


@pytest.mark.parametrize("degrees", mostly([0.0, 1e-6, 90.0, 160.0], 1e-6, 160.0))
@pytest.mark.parametrize("name", mostly(ROBOTS, "ets_vii", "moved_root", "tree_2"))
def test_derivatives_match_the_nonlinear_outputs(name, degrees):
    robot = ROBOTS[name]()
    q, v, a = point(robot, np.random.default_rng(int(degrees)), degrees)
    assert_derivatives(robot, q, v, a)


@pytest.mark.parametrize("name", mostly(ROBOTS, "ets_vii", "moved_root", "tree_2"))
def test_derivatives_at_rest(name):
    robot = ROBOTS[name]()
    q, v, a = point(robot, np.random.default_rng(5))
    assert_derivatives(robot, q, 0.0 * v, 0.0 * a, gravity=np.zeros(3))


@pytest.mark.parametrize("name", mostly(ROBOTS, "ets_vii", "moved_root", "tree_2"))
def test_derivatives_at_orbital_speed(name):
    """Differences lose the digits of 7.6 km/s; the scale of each output counts them."""
    robot = ROBOTS[name]()
    q, v, a = point(robot, np.random.default_rng(6), speed=SPEED)
    assert_derivatives(robot, q, v, a)


@pytest.mark.parametrize("name", ROBOTS)
def test_orbit_loses_no_accuracy(name):
    """Where the base is and how fast it moves along changes what it must, and no digit more."""
    robot = ROBOTS[name]().replace(gravity=GRAVITY)
    rng = np.random.default_rng(7)
    state = StateMap(robot, reference=random_pose(rng, 30.0))
    sensing = Sensing(state, all_measured(robot))
    q, v, a = point(robot, rng)
    v[:3] = 0.0
    value = sensing.evaluate(robot.create_data(), q, v, a)
    away, speed = rng.normal(size=(2, 3))
    away *= ORBIT / np.linalg.norm(away)
    speed *= SPEED / np.linalg.norm(speed)
    q_far, v_far, a_far = q.copy(), v.copy(), a.copy()
    q_far[:3] += away
    v_far[:3] = speed
    # the same motion of the base, seen from its axes
    a_far[:3] -= np.cross(v[3:6], speed)
    far = sensing.evaluate(robot.create_data(), q_far, v_far, a_far)
    oRr = state.reference.rotation
    oRb = (robot.model.jointPlacements[1] * pin.XYZQUATToSE3(q[:7])).rotation
    root = robot.model.jointPlacements[1].rotation
    R = oRr.T @ oRb
    shift = {"position": oRr.T @ root @ away, "com": oRr.T @ root @ away}
    drift = {"velocity": 1.0, "linear": robot.mass}
    for row in range(0, len(sensing.names), 3):
        rows, kind = slice(row, row + 3), sensing.names[row].split(".")[-2]
        y, by_q, by_v = (
            value.y[rows].copy(),
            value.by_q[rows].copy(),
            value.by_v[rows].copy(),
        )
        scale = 1.0
        relative = "/" in sensing.names[row]
        if kind in shift and not relative:
            y += shift[kind]
            scale = ORBIT
        elif kind in drift:
            y += drift[kind] * R @ speed
            by_q[:, 3:6] -= drift[kind] * R @ skew(speed)
            scale = drift[kind] * SPEED
        elif kind == "acceleration":
            by_v[:, 3:6] -= value.by_a[rows, :3] @ skew(speed)
            scale = SPEED
        assert (
            np.abs(far.y[rows] - y).max() < 1e-15 * scale * 4 + 1e-14 * np.abs(y).max()
        )
        # Columns of the joints: not a digit, but of the acceleration that was given.
        tolerance = 1e-11 if kind == "acceleration" else 0.0
        assert np.abs(far.by_q[rows, 6:] - by_q[:, 6:]).max(initial=0.0) <= tolerance
        assert (far.by_v[rows, 6:] == by_v[:, 6:]).all()
        assert (
            np.abs(far.by_q[rows, :6] - by_q[:, :6]).max()
            < 1e-15 * scale * 8 + tolerance
        )
        assert np.abs(far.by_v[rows, :6] - by_v[:, :6]).max() < 1e-15 * scale * 8
        assert (far.by_a[rows] == value.by_a[rows]).all()


def test_own_reference_is_the_base():
    robot = ROBOTS["dual_arm"]().replace(gravity=GRAVITY)
    q, v, a = point(robot, np.random.default_rng(8))
    base = pin.XYZQUATToSE3(q[:7])
    default = Sensing(StateMap(robot), all_measured(robot), own_reference=True)
    messages = Sensing(StateMap(robot, reference=base), all_measured(robot))
    pairs = zip(
        default.evaluate(robot.create_data(), q, v, a),
        messages.evaluate(robot.create_data(), q, v, a),
        strict=True,
    )
    for got, expected in pairs:
        assert np.abs(got - expected).max() < 1e-14 * np.abs(expected).max()


def test_states_names_and_units():
    robot = fflin.load("servicer_7dof")
    state = StateMap(robot)
    sensing = Sensing(
        state,
        [
            Gyroscope("tool"),
            JointVelocities(("joint_3", "joint_1")),
            BasePose(),
            CenterOfMass(),
            JointPositions(),
        ],
    )
    n = robot.n
    assert sensing.names[:5] == (
        *(f"tool.gyroscope.{axis}" for axis in "xyz"),
        "qdot_m.joint_3",
        "qdot_m.joint_1",
    )
    assert sensing.names[11:14] == ("com.x", "com.y", "com.z")
    assert sensing.units[:5] == ("rad/s",) * 5
    assert len(sensing.units) == len(sensing.names) == 14 + n
    assert [state.names[index] for _, index in sensing.states] == [
        sensing.names[row] for row, _ in sensing.states
    ]
    rows = [row for row, _ in sensing.states]
    assert rows == [*range(3, 11), *range(14, 14 + n)]
    assert not sensing.needs_acceleration
    q, v, a = point(robot, np.random.default_rng(9))
    sensed = sensing.evaluate(robot.create_data(), q, v, np.full(robot.nv, np.nan))
    assert sensed.by_a.shape == sensed.by_v.shape and not sensed.by_a.any()
    assert not any(part[rows].any() for part in sensed[:3])
    assert not any(np.isnan(part).any() for part in sensed[:3])

    full = Sensing(state, [FullState()])
    assert full.names == state.names and full.units == state.units
    assert full.states == [(index, index) for index in range(state.nx)]
    assert not full.evaluate(robot.create_data(), q, v, a).y.any()
    assert Sensing(state, [FullState(), Accelerometer("tool")]).needs_acceleration


def test_units_of_measured_outputs():
    sensing = Sensing(StateMap(fflin.load("cubesat")), [
        FramePose("base"), FrameVelocity("base"), Momentum(), Accelerometer("base"),
    ])  # fmt: skip
    units = dict(zip(sensing.names, sensing.units, strict=True))
    assert [unit for name, unit in units.items() if name.endswith(".y")] == [
        "m", "rad", "rad/s", "m/s", "N m s", "N s", "m/s^2",
    ]  # fmt: skip


def test_a_link_comes_before_a_joint_of_its_name():
    robot = fflin.load("dual_arm")
    model = robot.model.copy()
    placement = random_pose(np.random.default_rng(10), 20.0)
    model.addFrame(pin.Frame("left_1", 3, placement, pin.FrameType.BODY))
    model.addFrame(pin.Frame("imu", 3, placement, pin.FrameType.OP_FRAME))
    robot = fflin.from_model(model)
    sensing = Sensing(StateMap(robot), [FramePose("left_1"), FramePose("imu")])
    q, v, a = point(robot, np.random.default_rng(11))
    sensed = sensing.evaluate(robot.create_data(), q, v, a)
    assert (sensed.y[:6] == sensed.y[6:]).all()


@pytest.mark.parametrize(
    "outputs, error, message",
    [
        ([FramePose("tol")], fflin.UnknownNameError, "'tol'"),
        ([Gyroscope("universe")], fflin.UnknownNameError, "'universe'"),
        ([JointPositions(("joint_99",))], fflin.UnknownNameError, "'joint_99'"),
        ([Momentum(), Momentum()], fflin.InputError, "'momentum.angular.x'"),
        ([FullState(), BasePose()], fflin.InputError, "'q_b.x'"),
        (["tool"], fflin.InputError, "'tool'"),
    ],
)
def test_an_impossible_value_is_refused(outputs, error, message):
    with pytest.raises(error, match=message):
        Sensing(StateMap(fflin.load("servicer_7dof")), outputs)


def test_relative_pose_of_a_planar_arm_in_closed_form():
    """A joint about y, seen from the one before it."""
    robot = fflin.load("planar_detumble")
    robot = robot.replace(
        outputs=[RelativePose(robot.joint_names[1], robot.joint_names[0])]
    )
    joint = robot.joint(robot.joint_names[1])
    arm = robot.model.jointPlacements[robot.model.getJointId(joint.name)].translation
    angle = 0.7
    q = fflin.configuration(
        robot, {joint.name: angle}, random_pose(np.random.default_rng(4), 100.0)
    )
    lin = fflin.linearize(robot, q)
    assert np.abs(lin.y0 - [*arm, 0.0, 0.0, 0.0]).max() < 1e-15
    expected = np.zeros((6, len(lin.A)))
    # A joint's own frame turns with it and stays where it is.
    expected[3:, lin.state_names.index(f"q_m.{joint.name}")] = [0.0, 1.0, 0.0]
    assert np.abs(lin.C - expected).max() < 1e-15
    assert fflin.check(robot, lin).ok


@pytest.mark.parametrize("degrees", [0.0, 170.0])
def test_relative_pose_does_not_see_the_base(degrees):
    robot = fflin.load("dual_arm")
    frames = robot.joint_names[-1], robot.joint_names[2]
    robot = robot.replace(outputs=[RelativePose(*frames)])
    rng = np.random.default_rng(5)
    q, v, _ = point(robot, rng, degrees)
    lin = fflin.linearize(robot, q, v)
    groups = StateMap(robot).groups
    assert not lin.C[:, groups.q_b].any() and not lin.C[:, groups.r_b].any()
    assert fflin.check(robot, lin).ok
    # The other way round it is the inverse: p' = -R^T p.
    back = fflin.linearize(robot.replace(outputs=[RelativePose(*frames[::-1])]), q, v)
    assert np.linalg.norm(back.y0[:3]) == pytest.approx(
        np.linalg.norm(lin.y0[:3]), rel=1e-13
    )
