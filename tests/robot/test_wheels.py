"""Reaction wheels: closed forms, the same robot built otherwise, laws of momentum, then `check`."""

import pickle
from copy import deepcopy

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin import ReactionWheel
from fflin.base.rotation import skew
from fflin.robot.summary import robot_info
from tests.support.robots import FRAMES, mostly, random_point, random_pose, random_tree

# Four in any axes, on the base and on links of the arm: (axis, frame, inertia, speed).
FOUR = (
    ((1.0, 0.0, 0.0), None, 0.03, 200.0),
    ((1.0, 1.0, -1.0), "base", 0.05, -150.0),
    ((0.0, 2.0, 1.0), "link_3", 0.002, 300.0),
    ((-1.0, 0.3, 0.0), "link_3", 0.004, 120.0),
)


def spinning(robot, wheels=FOUR):
    """The robot with its own inputs and wheels with an inertia; what says their speeds."""
    added = [ReactionWheel(axis, frame, inertia) for axis, frame, inertia, _ in wheels]
    speeds = {f"wheel_{k}": wheel[-1] for k, wheel in enumerate(wheels, start=1)}
    return robot.replace(inputs=[*robot.inputs, *added]), speeds


def storing(robot, wheels=FOUR):
    """The same with the momentum only."""
    added = [
        ReactionWheel(axis, frame, momentum=J * speed)
        for axis, frame, J, speed in wheels
    ]
    return robot.replace(inputs=[*robot.inputs, *added])


def angular_jacobian(robot, q, frame):
    """Of a link in its frame's axes (3, 6 + n), in state order and base axes."""
    model, data = robot.model, robot.create_data()
    if frame is None:
        return np.eye(3, 6 + robot.n)
    local = pin.ReferenceFrame.LOCAL
    index = model.getFrameId(frame)
    jacobian = pin.computeFrameJacobian(model, data, q, index, local)[3:]
    return fflin.StateMap(robot).columns(jacobian)


def unit(axis):
    return np.array(axis) / np.linalg.norm(axis)


def everything(robot):
    """What can be measured of a robot with a tool and a link 3."""
    return robot.replace(
        outputs=[
            fflin.FramePose("tool"),
            fflin.FrameVelocity("link_3"),
            fflin.Gyroscope("link_3"),
            fflin.Accelerometer("tool"),
            fflin.Momentum(),
            fflin.CenterOfMass(),
        ]
    )


@pytest.mark.parametrize("kind", ["joints", "stored"])
@pytest.mark.parametrize("name", ["cubesat", "servicer_7dof"])
def test_gyroscopic_block_has_its_closed_form(name, kind):
    """At rest but for the wheels, A[nu, nu] = M^-1 sum J^T [h]x J: M_red^-1 [h]x of one body."""
    bare = fflin.load(name)
    wheels = (
        [(a, f, J / 1e4, s) for a, f, J, s in FOUR[:2]] if name == "cubesat" else FOUR
    )
    q = random_point(bare, np.random.default_rng(1), degrees=160.0)[0]
    if kind == "joints":
        robot, speeds = spinning(bare, wheels)
        joints = {joint.name: joint.value(q) for joint in bare.joints}
        q = fflin.configuration(robot, joints, pin.XYZQUATToSE3(q[:7]))
        v = fflin.velocity(robot, speeds)
    else:
        robot, v = storing(bare, wheels), None
    for frame in ("hybrid", "local", "world"):
        lin = fflin.linearize(robot, q, v, frame=frame)
        gyroscopic = sum(
            J.T @ skew(inertia * speed * unit(axis)) @ J
            for axis, frame_of, inertia, speed in wheels
            for J in [angular_jacobian(robot, q, frame_of)]
        )
        nv = 6 + robot.n
        expected = np.linalg.solve(lin.M, gyroscopic)
        size = np.abs(expected).max()
        assert lin.A[nv:, nv:] == pytest.approx(expected, abs=1e-11 * size)
        assert np.abs(lin.f0[nv:]).max() < 1e-12
        # A relative equilibrium: only the wheels' angles move, on which nothing depends.
        assert lin.is_equilibrium(1e-10)
    if name == "cubesat":
        reduced = np.array(bare.model.inertias[1].inertia)
        if kind == "joints":
            reduced = reduced - sum(
                J * np.outer(unit(a), unit(a)) for a, _, J, _ in wheels
            )
        total = sum(J * s * unit(a) for a, _, J, s in wheels)
        block = np.linalg.solve(reduced, skew(total))
        g = fflin.StateMap(robot).groups
        given = lin.A[g.omega_b, g.omega_b]
        assert given == pytest.approx(block, abs=1e-11 * np.abs(block).max())


QUICK = [("hybrid", True, False), ("local", False, True)]
POINTS = [
    (frame, turned, False)
    for frame in FRAMES
    for turned in (False, True)
    if (frame, turned, False) not in QUICK
]


@pytest.mark.parametrize(
    ("frame", "turned", "moving"),
    [*QUICK, *(pytest.param(*point, marks=pytest.mark.exhaustive) for point in POINTS)],
)
@pytest.mark.parametrize("kind", mostly(["joints", "stored", "both"], "both"))
def test_check_holds_in_every_block(kind, frame, turned, moving):
    rng = np.random.default_rng(2)
    bare = fflin.load("servicer_7dof")
    thruster = fflin.Thruster("tool", (0, 0, 0.1), (1, 0, 0.2))
    bare = everything(bare).replace(
        inputs=[*bare.inputs, thruster], stiffness=5.0, damping=0.3, gravity=(1, 0, -3)
    )
    robot, speeds = spinning(bare, FOUR[1:3] if kind == "both" else FOUR)
    if kind == "stored":
        robot, speeds = storing(bare), {}
    if kind == "both":
        more = ReactionWheel((0, 1, 1), "link_5", momentum=3.0, name="more")
        robot = robot.replace(inputs=[*robot.inputs, more])
    for degrees in (0.0, 160.0):
        joints = {name: rng.uniform(-2.5, 2.5) for name in robot.joint_names}
        pose = random_pose(rng, degrees)
        q = fflin.configuration(robot, joints, pose)
        rates = {name: rng.normal() for name in robot.joint_names} | speeds
        base = {
            f"{part}.{axis}": rng.normal()
            for part in ("omega_b", "v_b")
            for axis in "xyz"
        }
        v = fflin.velocity(robot, rates | base)
        u = 10.0 * rng.normal(size=len(fflin.linearize(robot).input_names))
        reference = pin.SE3.Identity() if turned else None
        lin = fflin.linearize(
            robot, q, v, u, frame=frame, reference=reference, moving=moving
        )
        result = fflin.check(robot, lin)
        assert result.ok, result
        assert any(row.block.endswith("wheel]") for row in result.rows)


def test_check_holds_on_random_trees_and_where_joints_mimic_others():
    rng = np.random.default_rng(3)
    tree = random_tree(rng, 6)
    for index in range(2, tree.model.njoints):
        tree.model.addJointFrame(index)
    panda = fflin.load("panda")
    for bare, frames in (
        (tree, ["joint_1", "joint_4", "joint_5"]),
        (panda, ["panda_link0", "panda_link4", "panda_rightfinger"]),
    ):
        wheels = [
            ReactionWheel(rng.normal(size=3), frames[0], inertia=1e-3),
            ReactionWheel(rng.normal(size=3), frames[1], momentum=2.0),
            ReactionWheel(rng.normal(size=3), frames[2], momentum=-1.0),
        ]
        robot = bare.replace(
            inputs=[fflin.BaseTorque(), *wheels], outputs=[fflin.Momentum()]
        )
        q, v, _ = random_point(robot, rng)
        v[robot.joint("wheel_1").idx_v] = 200.0
        for frame in FRAMES:
            result = fflin.check(
                robot, fflin.linearize(robot, q, v, rng.normal(size=6), frame=frame)
            )
            assert result.ok, result


def test_wheels_are_joints_as_if_built_by_hand():
    """A and B to the last digits of the model that has the wheel's rotor as a link of its own."""
    bare = fflin.load("dual_arm")
    axis, inertia = unit((1.0, -2.0, 0.5)), 0.02
    robot = bare.replace(
        inputs=[*bare.inputs, ReactionWheel(axis, inertia=inertia, name="w")]
    )
    model = bare.model.copy()
    hub = model.inertias[1]
    rest = hub.inertia - inertia * np.outer(axis, axis)
    model.inertias[1] = pin.Inertia(hub.mass, hub.lever, rest)
    about = pin.JointModelRevoluteUnaligned(axis)
    index = model.addJoint(1, about, pin.SE3(np.eye(3), np.array([0.1, 0.2, 0.0])), "w")
    rotor = pin.Inertia(0.0, np.zeros(3), inertia * np.outer(axis, axis))
    model.appendBodyToJoint(index, rotor, pin.SE3.Identity())
    by_hand = fflin.from_model(model)
    assert robot.joint_names == by_hand.joint_names == (*bare.joint_names, "w")
    rng = np.random.default_rng(4)
    joints = {name: rng.uniform(-2.0, 2.0) for name in robot.joint_names}
    rates = {name: rng.normal() for name in bare.joint_names} | {
        "w": 250.0,
        "omega_b.y": 0.3,
    }
    u = rng.normal(size=6 + robot.n)
    given, expected = (
        fflin.linearize(r, fflin.configuration(r, joints), fflin.velocity(r, rates), u)
        for r in (robot, by_hand)
    )
    for name in ("A", "B", "M", "f0"):
        right = getattr(expected, name)
        size = np.abs(right).max()
        assert getattr(given, name) == pytest.approx(right, abs=1e-12 * size), name


@pytest.mark.parametrize("name", ["servicer_7dof", "dual_arm"])
def test_stored_momentum_is_a_wheel_held_at_its_speed(name):
    """With its acceleration held at zero a wheel's row goes: the rest is the stored one's."""
    bare = fflin.load(name)
    links = [
        frame.name for frame in bare.model.frames if frame.type == pin.FrameType.BODY
    ]
    wheels = [
        (axis, links[k], 0.1 * J, speed) for k, (axis, _, J, speed) in enumerate(FOUR)
    ]
    robot, speeds = spinning(bare, wheels)
    stored = storing(bare, wheels)
    rng = np.random.default_rng(5)
    pose = random_pose(rng, 150.0)
    joints = {joint: rng.uniform(-2.0, 2.0) for joint in bare.joint_names}
    base = {
        f"{part}.{axis}": rng.normal() for part in ("omega_b", "v_b") for axis in "xyz"
    }
    rates = {joint: rng.normal() for joint in bare.joint_names} | base
    u = np.append(rng.normal(size=6 + bare.n), np.zeros(4))
    with_joints, without = (
        (r, fflin.configuration(r, joints, pose), fflin.velocity(r, moved))
        for r, moved in ((robot, rates | speeds), (stored, rates))
    )
    lin = fflin.linearize(*without, u, frame="local")
    nv, n = 6 + robot.n, robot.n
    wheel = np.array([name in robot.wheels for name in robot.joint_names])
    kept = np.flatnonzero(np.append(np.full(6, True), ~wheel))
    # The motor torques that hold the speeds: they move nothing but the wheels' rows.
    held = fflin.linearize(*with_joints, u, frame="local")
    lower = held.B[nv:]
    order = [
        held.input_names.index(name) for name in np.array(robot.joint_names)[wheel]
    ]
    rows = 6 + np.flatnonzero(wheel)
    u[order] = -np.linalg.solve(lower[np.ix_(rows, order)], held.f0[nv + rows])
    held = fflin.linearize(*with_joints, u, frame="local")
    assert np.abs(held.f0[nv + rows]).max() < 1e-9
    forces = held.M @ held.A[nv:]
    M = held.M[np.ix_(kept, kept)]
    columns = np.concatenate((kept, nv + kept))
    # Of a v_b in base axes d(v_b)/dt has a part, -omega x v_b, that no force makes.
    part = np.zeros((nv, 2 * nv))
    w, v_b = (held.x0[6 + n + k : 9 + n + k] for k in (0, 3))
    part[3:6, nv : nv + 3], part[3:6, nv + 3 : nv + 6] = skew(v_b), -skew(w)
    forces = forces - held.M @ part
    expected = (
        np.linalg.solve(M, forces[np.ix_(kept, columns)]) + part[np.ix_(kept, columns)]
    )
    given = lin.A[6 + bare.n :]
    assert lin.M == pytest.approx(M, abs=1e-12 * np.abs(M).max())
    assert given == pytest.approx(expected, abs=1e-11 * np.abs(expected).max())
    rates_held = np.delete(held.f0[nv:], rows)
    assert lin.f0[6 + bare.n :] == pytest.approx(
        rates_held, abs=1e-11 * np.abs(rates_held).max()
    )


def test_stored_momentum_is_the_limit_of_small_fast_wheels():
    """At the same momentum the difference in A, B and f0 goes with the inertia."""
    bare = fflin.load("servicer_7dof")
    rng = np.random.default_rng(10)
    joints = {name: rng.uniform(-2.0, 2.0) for name in bare.joint_names}
    rates = {name: rng.normal() for name in bare.joint_names} | {"omega_b.x": 0.4}
    u = np.append(rng.normal(size=6 + bare.n), 0.5 + np.arange(4.0))
    models = []
    for J in (None, 1e-5, 1e-6):
        momenta = [(axis, frame, J, 5.0 / (J or 1.0)) for axis, frame, *_ in FOUR]
        robot, speeds = spinning(bare, momenta) if J else (bare, {})
        if not J:
            robot = storing(bare, [(axis, frame, 5.0, 1.0) for axis, frame, *_ in FOUR])
        point = (
            fflin.configuration(robot, joints),
            fflin.velocity(robot, rates | speeds),
        )
        lin = fflin.linearize(robot, *point, u)
        kept = np.array([".wheel" not in name for name in lin.state_names])
        models.append((lin.A[np.ix_(kept, kept)], lin.B[kept], lin.f0[kept]))
    for limit, near, nearer in zip(*models, strict=True):
        far, close = (np.abs(part - limit).max() for part in (near, nearer))
        assert close < 1e-3 * np.abs(limit).max()
        assert far / close == pytest.approx(10.0, rel=0.05)


def test_motor_of_a_stored_wheel_turns_its_carrier_back():
    """Its power is minus the torque times the carrier's rate about the axis."""
    axis, frame = unit(FOUR[2][0]), FOUR[2][1]
    bare = fflin.load("servicer_7dof")
    robot = bare.replace(inputs=[ReactionWheel(axis, frame)])
    q = random_point(bare, np.random.default_rng(6))[0]
    lin = fflin.linearize(robot, q, frame="local")
    force = lin.M @ lin.B[6 + robot.n :, 0]
    expected = -angular_jacobian(robot, q, frame).T @ axis
    assert force == pytest.approx(expected, abs=1e-12)


def momentum_at(robot, q, v, u=None):
    """The model about a point whose only output is momentum in world axes."""
    watched = robot.replace(outputs=[fflin.Momentum()])
    return fflin.linearize(watched, q, v, u, reference=pin.SE3.Identity())


@pytest.mark.parametrize("kind", ["joints", "stored"])
def test_momentum_is_conserved_but_for_motors_of_stored_wheels(kind):
    """dH/dt = C f0 is zero, whatever the motors do; -u a where h does not take u up."""
    bare = fflin.load("servicer_7dof")
    motors = [fflin.JointTorque(name) for name in bare.joint_names]
    if kind == "joints":
        robot, speeds = spinning(bare.replace(inputs=motors))
    else:
        robot, speeds = storing(bare.replace(inputs=motors)), {}
    rng = np.random.default_rng(7)
    joints = {name: rng.uniform(-2.0, 2.0) for name in robot.joint_names}
    rates = {name: rng.normal() for name in robot.joint_names} | speeds
    q = fflin.configuration(robot, joints, random_pose(rng, 140.0))
    v = fflin.velocity(
        robot, rates | {"omega_b.x": 0.5, "omega_b.z": -1.0, "v_b.y": 0.4}
    )
    u = np.append(30.0 * rng.normal(size=bare.n), [1.0, 2.0, -3.0, 4.0])
    lin = momentum_at(robot, q, v, u)
    expected = np.zeros(6)
    if kind == "stored":
        data = robot.create_data()
        pin.framesForwardKinematics(robot.model, data, q)
        for (axis, frame, *_), torque in zip(FOUR, u[-4:], strict=True):
            index = robot.model.getFrameId(frame or "base")
            expected[:3] -= torque * data.oMf[index].rotation @ unit(axis)
    size = np.abs(lin.C).max() * np.abs(lin.f0).max()
    assert lin.C @ lin.f0 == pytest.approx(expected, abs=1e-12 * size)
    # And what is conserved: the wheels' own share is in it.
    still = momentum_at(robot, q, fflin.velocity(robot, speeds))
    data = robot.create_data()
    pin.framesForwardKinematics(robot.model, data, q)
    total = sum(
        J
        * speed
        * data.oMf[robot.model.getFrameId(frame or "base")].rotation
        @ unit(axis)
        for axis, frame, J, speed in FOUR
    )
    assert still.y0[:3] == pytest.approx(total, rel=1e-12)


def test_stored_momentum_does_no_work():
    bare = fflin.load("servicer_7dof")
    q, v, _ = random_point(bare, np.random.default_rng(8))
    plain, turned = (
        fflin.linearize(r, q, v, frame="local") for r in (bare, storing(bare))
    )
    nu = plain.x0[6 + bare.n :]
    force = plain.M @ (turned.f0 - plain.f0)[6 + bare.n :]
    assert np.abs(force).max() > 1.0
    assert abs(nu @ force) < 1e-12 * np.abs(nu).max() * np.abs(force).max()


def test_wheels_come_and_go_with_the_inputs():
    bare = fflin.load("servicer_7dof")
    robot, speeds = spinning(bare.replace(stiffness=2.0, damping={"joint_1": 1.0}))
    # After all that hangs on the carrier; two on one carrier in their own order.
    arm, panels = bare.joint_names[:7], bare.joint_names[7:]
    assert robot.joint_names == (
        *arm,
        "wheel_3",
        "wheel_4",
        *panels,
        "wheel_1",
        "wheel_2",
    )
    assert robot.mass == pytest.approx(bare.mass, rel=1e-15)
    assert bare.n == 9 and bare.model.njoints == 11
    damped = robot.replace(damping={"wheel_1": 1e-3, "joint_2": 0.5})
    assert robot.replace(damping=0.2).damping == dict.fromkeys(bare.joint_names, 0.2)
    one = damped.replace(inputs=[ReactionWheel((0, 0, 1), inertia=0.1, name="other")])
    assert one.joint_names == (*bare.joint_names, "other")
    assert one.damping == {"joint_2": 0.5} and one.stiffness == robot.stiffness
    none = damped.replace(inputs=bare.inputs)
    assert none.joint_names == bare.joint_names and not none.wheels
    assert none.model == bare.model
    again = damped.replace(inputs=damped.inputs, gravity=(0, 0, -1))
    assert again.model == damped.model and again.damping == damped.damping
    v = fflin.velocity(robot, speeds)
    A = fflin.linearize(robot, None, v).A
    for twin in (deepcopy(robot), pickle.loads(pickle.dumps(robot))):
        assert (fflin.linearize(twin, None, v).A == A).all()
        assert twin.replace(inputs=bare.inputs).joint_names == bare.joint_names
    # What Pinocchio keeps of a joint stays with it.
    for joint in bare.joints:
        moved = robot.joint(joint.name)
        for name in ("upperEffortLimit", "upperVelocityLimit", "armature", "damping"):
            values = [
                getattr(r.model, name)[j.idx_v]
                for r, j in ((bare, joint), (robot, moved))
            ]
            assert values[0] == values[1]
        limits = [
            (r.model.lowerPositionLimit[j.idx_q], r.model.upperPositionLimit[j.idx_q])
            for r, j in ((bare, joint), (robot, moved))
        ]
        assert limits[0] == limits[1]
    # Without those of the wheels, its frames are those of the bare model, in their order.
    frames, others = (
        [
            (
                f.name,
                f.type,
                model.names[f.parentJoint],
                model.frames[f.parentFrame].name,
            )
            for f in model.frames
            if f.name not in robot.wheels
        ]
        for model in (bare.model, robot.model)
    )
    assert frames == others
    assert (
        fflin.load("servicer_7dof", lock=["panel_left"], inputs=robot.inputs[:6]).n == 8
    )


def test_a_q_or_v_from_before_the_inputs_were_replaced_names_the_wheels_that_left():
    robot = fflin.load("planar_detumble")
    wheels = [
        ReactionWheel((1, 0, 0), inertia=0.01, name=name) for name in ("roll", "pitch")
    ]
    full = robot.replace(inputs=[*robot.inputs, *wheels])
    left = full.replace(inputs=robot.inputs)
    kept = full.replace(inputs=[*robot.inputs, wheels[1]])
    q, v = full.neutral(), np.zeros(full.nv)
    both = "the coordinates roll, pitch were removed with the replaced inputs or appendages"
    for call in (
        lambda: fflin.linearize(left, q),
        lambda: fflin.linearize(left, v=v),
        lambda: fflin.simulate(left, q0=q, duration=1.0),
        lambda: fflin.StateMap(left).to_state(q, v),
        lambda: fflin.linearize(left.replace(inputs=robot.inputs[:2]), q),
    ):
        with pytest.raises(fflin.InputError, match=rf"(q|v)0? has shape .*{both}"):
            call()
    with pytest.raises(fflin.InputError, match="the coordinates roll were removed"):
        fflin.linearize(kept, q)
    for other, wrong in ((robot, q), (full, np.append(q, 0.0)), (left, q[:5])):
        with pytest.raises(fflin.InputError, match=r"has shape") as error:
            fflin.linearize(other, wrong)
        assert "were removed" not in str(error.value)
    assert fflin.linearize(left.replace(inputs=full.inputs), q).A.shape[0] == 2 * (
        6 + full.n
    )


def test_wheels_are_shown_and_named():
    robot, speeds = spinning(fflin.load("servicer_7dof"))
    rows = [line.split() for line in robot_info(robot).splitlines()]
    shown = {row[0]: row[1] for row in rows if len(row) > 1}
    assert {shown[name] for name in speeds} == {"wheel"} and shown["joint_1"] != "wheel"
    lin = fflin.linearize(robot, None, fflin.velocity(robot, speeds))
    assert (
        lin.input_names[-4:] == tuple(speeds) and lin.input_units[-4:] == ("N m",) * 4
    )
    assert {f"qdot_m.{name}" for name in speeds} < set(lin.state_names)
    u = fflin.effort(robot, {"wheel_2": 0.5})
    assert np.flatnonzero(u).tolist() == [lin.input_names.index("wheel_2")]


@pytest.mark.parametrize("fields", [{"inertia": 0.002}, {"momentum": 0.5}])
def test_axis_is_fixed_in_its_frame(fields):
    """In a frame that stands turned on its link, and in the link's own."""
    model = fflin.load("servicer_7dof").model.copy()
    tilt, axis = random_pose(np.random.default_rng(9), 70.0), unit((1.0, 2.0, -0.5))
    link = model.frames[model.getFrameId("link_3")]
    placement = link.placement * tilt
    joint, kind = link.parentJoint, pin.FrameType.OP_FRAME
    model.addFrame(pin.Frame("tilted", joint, placement, kind))
    bare = fflin.from_model(model)
    models = []
    for turned, frame in ((axis, "tilted"), (tilt.rotation @ axis, "link_3")):
        robot = bare.replace(inputs=[ReactionWheel(turned, frame, **fields)])
        joints = dict.fromkeys(bare.joint_names, 0.4)
        rates = dict.fromkeys(robot.joint_names, 0.5) | {"omega_b.x": 0.3}
        point = fflin.configuration(robot, joints), fflin.velocity(robot, rates)
        models.append(fflin.linearize(robot, *point, [0.3]))
    for name in ("A", "B", "f0"):
        given, expected = (getattr(lin, name) for lin in models)
        assert given == pytest.approx(expected, abs=1e-12 * np.abs(expected).max())


def test_invalid_wheels_are_reported_in_a_line():
    robot = fflin.load("servicer_7dof")
    none = ReactionWheel((0, 0, 1))
    cases = {
        "axis": lambda: ReactionWheel((0, 0, 0)),
        "(0, 1)": lambda: ReactionWheel((0, 1)),
        "0 kg m^2": lambda: ReactionWheel((0, 0, 1), None, 0),
        "nan": lambda: ReactionWheel((0, 0, 1), inertia=float("nan")),
        "'a'": lambda: ReactionWheel((0, 0, 1), momentum="a"),
        "momentum": lambda: ReactionWheel((0, 0, 1), inertia=1.0, momentum=1.0),
        "1000 kg m^2": (
            lambda: robot.replace(inputs=[ReactionWheel((0, 0, 1), inertia=1000.0)])
        ),
        "joint 'joint_3'": (
            lambda: robot.replace(
                inputs=[ReactionWheel((0, 0, 1), "link_3", inertia=10.0)]
            )
        ),
        "'bas'": (
            lambda: robot.replace(inputs=[ReactionWheel((0, 0, 1), "bas", inertia=0.1)])
        ),
        "'too'": (
            lambda: fflin.linearize(
                robot.replace(inputs=[ReactionWheel((0, 0, 1), "too")])
            )
        ),
        "'joint_3' has the name": lambda: robot.replace(
            inputs=[ReactionWheel((0, 0, 1), inertia=0.1, name="joint_3")]
        ),
        "wheel_2": lambda: robot.replace(
            inputs=[ReactionWheel((0, 0, 1), name="wheel_2"), none]
        ),
        "wheel 'wheel_1'": (
            lambda: fflin.velocity(robot.replace(inputs=[none]), {"wheel_1": 100.0})
        ),
        "joint named 'wheel_1'": lambda: robot.replace(
            inputs=[fflin.JointTorque("wheel_1"), ReactionWheel((0, 0, 1), inertia=0.1)]
        ),
    }
    for words, call in cases.items():
        with pytest.raises(fflin.FflinError) as caught:
            call()
        assert words in str(caught.value) and "\n" not in str(caught.value), str(
            caught.value
        )
    # All wheels of a carrier together count.
    pair = [ReactionWheel((0, 0, 1), "link_3", inertia=J) for J in (0.01, 10.0)]
    with pytest.raises(fflin.InputError, match="'wheel_2'"):
        robot.replace(inputs=pair)


def test_axes_of_any_length_are_directions():
    for scale in (1e-300, 1.0, 1e300):
        axis = ReactionWheel((3.0 * scale, 0.0, -4.0 * scale)).axis
        assert axis == pytest.approx((0.6, 0.0, -0.8), rel=1e-15)


def test_a_wheel_that_becomes_a_constant_momentum_keeps_the_limit_of_its_input():
    spun = fflin.ReactionWheel((0, 0, 1), inertia=0.01, name="wz")
    limits = {"wheel.wz": 0.05, "qdot_m.wz": 100.0}
    robot = fflin.load(
        "planar_detumble", inputs=[fflin.BaseTorque(), spun], limits=limits
    )
    still = fflin.ReactionWheel((0, 0, 1), momentum=0.1, name="wz")
    changed = robot.replace(inputs=[fflin.BaseTorque(), still])
    assert changed.limits == {"wz": (-0.05, 0.05)}
    assert robot.replace(inputs=[fflin.BaseTorque()]).limits == {}
